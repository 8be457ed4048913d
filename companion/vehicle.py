"""Who is on the link: which vehicle is believed, whether it is armed, whether it is still there.

Pure; all times are arrival stamps.  A vehicle is a system whose HEARTBEAT names an autopilot; its type comes from the
heartbeat, never from its ids.  Nobody else is believed.
"""

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion.frames import Frame

CHOICE_US: Final = 3_000_000  # autopilots are collected for so long before one is taken
SILENT_AFTER_US: Final = 5_000_000  # four heartbeats may be lost
LOST_AFTER_US: Final = 30_000_000

# Components that carry an autopilot's flag set wrongly or watch others fly; never the vehicle itself.
NO_VEHICLE: Final = frozenset(
    {mavlink.MAV_TYPE_GCS, mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_TYPE_GIMBAL, mavlink.MAV_TYPE_ADSB}
)


class LinkState(StrEnum):
    """How the vehicle's link stands."""

    NONE = "none"  # no vehicle yet
    UP = "up"
    SILENT = "silent"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """What of a HEARTBEAT matters here."""

    sysid: int
    compid: int
    autopilot: int
    type: int
    armed: bool
    mode: int


def heartbeat(frame: Frame) -> Heartbeat:
    """Read a HEARTBEAT frame."""
    fields = frame.fields()
    number = {name: value for name, value in fields.items() if isinstance(value, int)}
    armed = bool(number["base_mode"] & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    return Heartbeat(frame.sysid, frame.compid, number["autopilot"], number["type"], armed, number["custom_mode"])


@dataclass(slots=True)
class Watch:
    """The one vehicle that is listened to.

    pinned_sysid: only this system is taken, None: the first whose autopilot beats, if it is the only one.
    """

    pinned_sysid: int | None = None
    sysid: int | None = None
    compid: int | None = None
    autopilot: int | None = None
    type: int | None = None
    armed: bool = False
    mode: int | None = None
    link: LinkState = LinkState.NONE
    heard_us: int = 0
    rivals: tuple[int, ...] = ()  # systems among which we could not choose
    _heard_first_us: int | None = None
    _candidates: dict[int, Heartbeat] = field(default_factory=dict)

    @property
    def known(self) -> bool:
        return self.sysid is not None

    def is_autopilot(self, frame: Frame) -> bool:
        """Does this frame come from the autopilot that is believed?"""
        return frame.sysid == self.sysid and frame.compid == self.compid

    def offer(self, beat: Heartbeat, arrival_us: int) -> None:
        """A heartbeat while no vehicle has been taken."""
        if beat.autopilot == mavlink.MAV_AUTOPILOT_INVALID or beat.type in NO_VEHICLE:
            return
        if self.pinned_sysid is not None and beat.sysid != self.pinned_sysid:
            return
        if self._heard_first_us is None:
            self._heard_first_us = arrival_us
        self._candidates.setdefault(beat.sysid, beat)

    def choose(self, arrival_us: int) -> int | None:
        """Take a vehicle if the time has come: the stamp at which it had come, once; else None."""
        if self.known or self._heard_first_us is None:
            return None
        ripe_us = self._heard_first_us + (CHOICE_US if self.pinned_sysid is None else 0)
        if arrival_us < ripe_us:
            return None
        if len(self._candidates) > 1:
            self.rivals = tuple(sorted(self._candidates))
            return None
        (beat,) = self._candidates.values()
        self.sysid, self.compid, self.autopilot, self.type = beat.sysid, beat.compid, beat.autopilot, beat.type
        self.heard_us = ripe_us
        self.link = LinkState.UP
        return ripe_us

    def silence(self, arrival_us: int) -> tuple[LinkState, int] | None:
        """The next change of the link that silence has brought by now: (state, when); None if there is none."""
        if arrival_us - self.heard_us <= SILENT_AFTER_US:
            return None  # asked at every frame, and nearly always so
        for before, after, limit_us in (
            (LinkState.UP, LinkState.SILENT, SILENT_AFTER_US),
            (LinkState.SILENT, LinkState.LOST, LOST_AFTER_US),
        ):
            if self.link is before and arrival_us - self.heard_us > limit_us:
                self.link = after
                return after, self.heard_us + limit_us
        return None
