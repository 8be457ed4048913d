"""What an airframe's simulator offers to the autopilot layer, the command line and the ensembles: tables and a protocol.

`sitl/<airframe>.py` exports `Config` (frozen dataclass, filled from the `[sitl]` table of the configuration), `Fleet`
(the plant with its sensors, guidance and faults, batched) and `VEHICLE` (the tables below).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Field:
    """One message field: wire value = channel * scale + offset, rounded where the field is an integer."""

    name: str  # pymavlink's field name; array elements as "distance[0]"
    channel: str  # a channel of the fleet, SI, unit in its name
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True, slots=True)
class Stream:
    """One message that the autopilot sends regularly.  Time fields are filled in by the autopilot from its own clock."""

    message: str  # "GLOBAL_POSITION_INT"
    stock_hz: float  # rate as a stock autopilot sends it
    fast_hz: float  # rate of `--rates fast`
    fields: tuple[Field, ...]
    constants: Mapping[str, float] = field(default_factory=dict)  # fields that never change


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of the autopilot; a change is handed to `Fleet.command` under the same name if `acts`."""

    name: str  # at most 16 bytes
    default: float
    integer: bool  # INT32 (else REAL32)
    minimum: float = -np.inf
    maximum: float = np.inf
    acts: bool = True  # the fleet knows it; False: the autopilot keeps it and nothing happens


@dataclass(frozen=True, slots=True)
class Injection:
    """One combination of MAV_CMD_INJECT_FAILURE that has an effect here, and the fleet command that makes it."""

    unit: int  # FAILURE_UNIT
    type: int  # FAILURE_TYPE
    instances: int  # valid instances are 1..instances; 0 means all of them
    command: str  # name for `Fleet.command`; the instance (1-based) is its value


@dataclass(frozen=True, slots=True)
class Injected:
    """A fault to happen in one flight.  `value` None: drawn from the airframe's range with the flight's own seed."""

    id: str  # CLASS[:PLACE][/KIND]; what is left open is drawn
    onset_s: float  # since release (arming)
    value: float | None = None
    clear_s: float | None = None  # since release


@dataclass(frozen=True, slots=True)
class Vehicle:
    """The tables of one simulated airframe."""

    name: str
    mav_type: int
    modes: Mapping[str, int]  # name -> custom_mode; the first is the one it flies in.  A change goes to `command` as "MODE"
    streams: tuple[Stream, ...]
    parameters: tuple[Parameter, ...]
    injections: tuple[Injection, ...]
    fault_ids: tuple[str, ...]  # CLASS[:PLACE] of every fault that can be injected
    steps_s: tuple[float, ...]  # step sizes the fleet accepts, the stock one first


class Fleet(Protocol):
    """Many flights of one airframe at once: built as `Fleet(config, seeds, faults)`, faults one per seed or None."""

    channels: tuple[str, ...]

    @property
    def home(self) -> tuple[float, float, float]:
        """What relative heights and the target count from: latitude, longitude (rad), altitude above sea level (m)."""

    def step(self, dt_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Advance every flight; -> (values, age_s), (flight, channel), as `observe`.  dt_s must not change in a flight."""

    def observe(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What the sensors say now: (values, age_s), (flight, channel); age > 0 where the sensor did not sample now."""

    def command(self, flight: int, name: str, value: float) -> None:
        """What a parameter or a command does.  Raises KeyError for a name the airframe does not know."""

    @property
    def landed(self) -> NDArray[np.bool_]:
        """(flight,), True from touchdown on; a landed flight stays where it is."""


def parse_fault(text: str) -> Injected:
    """Read `ID[=VALUE]@T` (T: seconds after release).  Raises ValueError with a sentence for the user."""
    body, at, onset = text.partition("@")
    fault_id, equals, value = body.partition("=")
    try:
        if not at or not fault_id or (equals and not value):
            raise ValueError
        return Injected(fault_id, float(onset), float(value) if equals else None)
    except ValueError:
        raise ValueError(
            f"fault {text!r} is not ID[=VALUE]@SECONDS, as in crossed_lines@120 or motor:left/stuck=0.9@60"
        ) from None


def check_faults(faults: Sequence[Injected | None], known: tuple[str, ...]) -> None:
    """Raise ValueError naming the first fault whose id does not begin with one of `known` (CLASS[:PLACE])."""
    for fault in faults:
        if fault is not None and not any(
            name == fault.id.partition("/")[0] or name.startswith(fault.id.partition("/")[0] + ":") for name in known
        ):
            raise ValueError(f"unknown fault {fault.id!r}; this airframe knows {', '.join(known)}")
