"""What a simulated autopilot does wrong when asked to, so that those who talk to it can be tested.

Every switch is a field of one record; those that are parameters too (`PARAMETERS`) can be set over the link.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from sitl.vehicle import Parameter


class ParameterMode(IntEnum):
    """How a PARAM_SET is met; the numbers are those of SIM_PRM_MODE."""

    HONEST = 0
    REFUSE = 1  # nothing applied, the old value echoed
    LIE = 2  # nothing applied, the new value echoed
    SILENT = 3  # applied, no echo
    IGNORE = 4  # nothing applied, no echo
    LATE = 5  # applied, echoed after `parameter_delay_s`
    WRONG = 6  # applied, a value one higher echoed


class CommandMode(IntEnum):
    """How a command is met; the numbers are those of SIM_CMD_MODE."""

    HONEST = 0
    DENY = 1
    REJECT = 2  # MAV_RESULT_TEMPORARILY_REJECTED
    IGNORE = 3  # not done, no answer
    LIE = 4  # not done, accepted
    LATE = 5  # done, answered after `command_delay_s`


@dataclass(slots=True)
class Misbehaviour:
    """The switches; all off as built."""

    parameter_mode: int = ParameterMode.HONEST
    parameter_name: str = ""  # the one parameter concerned; empty: all but the SIM_ ones, by which this is ended
    parameter_after: int = 0  # so many settings are met honestly first
    parameter_delay_s: float = 2.0
    reboot_at_set: int = 0  # the autopilot reboots at this PARAM_SET, counted from 1, before it is applied; 0: never
    command_mode: int = CommandMode.HONEST
    command_delay_s: float = 2.0
    link_loss: float = 0.0  # share of outgoing frames lost
    link_duplication: float = 0.0  # share sent twice
    link_swap: float = 0.0  # share sent after the frame that follows it
    flood_hz: float = 0.0  # useless frames to every client
    sets_met: int = 0  # settings counted for the two counting switches, since a switch was last set over the link

    def concerns(self, name: str) -> bool:
        """Whether settings of this parameter are met as the switches say; counts it if so."""
        if name != self.parameter_name and (self.parameter_name or name.startswith("SIM_")):
            return False
        self.sets_met += 1
        return True

    @property
    def spoils_links(self) -> bool:
        """Whether frames are lost, doubled or swapped."""
        return self.link_loss > 0.0 or self.link_duplication > 0.0 or self.link_swap > 0.0


PARAMETERS: tuple[tuple[Parameter, str], ...] = (  # and the field of `Misbehaviour` in which each one lives
    (Parameter("SIM_PRM_MODE", 0.0, True, 0.0, 6.0, False), "parameter_mode"),
    (Parameter("SIM_PRM_AFTER", 0.0, True, 0.0, 1e6, False), "parameter_after"),
    (Parameter("SIM_PRM_DELAY", 2.0, False, 0.0, 600.0, False), "parameter_delay_s"),
    (Parameter("SIM_PRM_REBOOT", 0.0, True, 0.0, 1e6, False), "reboot_at_set"),
    (Parameter("SIM_CMD_MODE", 0.0, True, 0.0, 5.0, False), "command_mode"),
    (Parameter("SIM_CMD_DELAY", 2.0, False, 0.0, 600.0, False), "command_delay_s"),
    (Parameter("SIM_LINK_LOSS", 0.0, False, 0.0, 1.0, False), "link_loss"),
    (Parameter("SIM_LINK_DUP", 0.0, False, 0.0, 1.0, False), "link_duplication"),
    (Parameter("SIM_LINK_SWAP", 0.0, False, 0.0, 1.0, False), "link_swap"),
    (Parameter("SIM_FLOOD", 0.0, False, 0.0, 10000.0, False), "flood_hz"),
)


class BadLink:
    """Loses, doubles and swaps the frames of one client; the same seed and frames, the same result."""

    def __init__(self, seed: int) -> None:
        self._random = np.random.Generator(np.random.PCG64(seed))
        self._held: bytes = b""

    @property
    def holds(self) -> bool:
        """Whether a frame still waits for the one that it is to follow."""
        return bool(self._held)

    def spoil(self, frames: Sequence[bytes], switches: Misbehaviour) -> list[bytes]:
        """What arrives of these frames, in the order of arrival; a frame may wait for the next call."""
        arriving: list[bytes] = []
        for frame in frames:
            loss, duplication, swap = self._random.random(3)
            if loss < switches.link_loss:
                continue
            copies = [frame, frame] if duplication < switches.link_duplication else [frame]
            if swap < switches.link_swap and not self._held:
                self._held = frame
                continue
            arriving += copies
            if self._held:
                arriving.append(self._held)
                self._held = b""
        return arriving
