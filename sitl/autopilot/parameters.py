"""The parameters of the simulated autopilot, kept as ArduPilot keeps them, and how it meets a PARAM_SET.

Values on the wire are plain casts to float32 (not PX4's reinterpreted bytes); types are the parameter's own, whatever the
request says.  Source: MAVLink parameter protocol; ArduPilot GCS_Param.cpp, AP_Param::set_value.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from sitl.autopilot.misbehaviour import PARAMETERS as SWITCHES
from sitl.autopilot.misbehaviour import Misbehaviour, ParameterMode
from sitl.vehicle import Parameter

INT32 = 6  # MAV_PARAM_TYPE_INT32
REAL32 = 9  # MAV_PARAM_TYPE_REAL32

OWN: tuple[Parameter, ...] = (
    Parameter("SYSID_THISMAV", 1.0, True, 1.0, 255.0, False),  # obeyed from the next boot on
    Parameter("SYS_FAILURE_EN", 1.0, True, 0.0, 1.0, False),  # guard of MAV_CMD_INJECT_FAILURE
    Parameter("BATT_LOW_VOLT", 10.5, False, 0.0, 60.0, False),  # V, below it the battery counts as unhealthy
    Parameter("SIM_BATT_VOLTAGE", 12.6, False, 0.0, 60.0, False),  # V
    Parameter("STAT_BOOTCNT", 1.0, True, 0.0, 1e6, False),
)
READ_ONLY = frozenset({"STAT_BOOTCNT"})


class Refusal(IntEnum):
    """Why a value is not taken; the numbers are those of MAV_PARAM_ERROR."""

    NONE = 0
    UNKNOWN_NAME = 1
    OUT_OF_RANGE = 2
    READ_ONLY = 5


@dataclass(frozen=True, slots=True)
class Meeting:
    """What becomes of one PARAM_SET."""

    refusal: Refusal  # why an honest autopilot would not take it
    applied: bool
    stored: float  # the value that is to be applied, as the parameter's type holds it
    echoed: bool
    echo: float
    delay_s: float = 0.0


class Parameters:
    """All parameters of one vehicle: the airframe's, the autopilot's own, and the switches of its misbehaviour."""

    def __init__(self, airframe: Sequence[Parameter], sysid: int, switches: Misbehaviour) -> None:
        """Raises ValueError for a name twice or too long for its 16 bytes."""
        self.rows: tuple[Parameter, ...] = (*airframe, *OWN, *(row for row, _ in SWITCHES))
        self.names = tuple(row.name for row in self.rows)
        for name in self.names:
            if self.names.count(name) > 1:
                raise ValueError(f"parameter {name} is in the tables twice")
            if not 0 < len(name.encode()) <= 16:
                raise ValueError(f"parameter {name!r} does not fit MAVLink's 16 bytes")
        self._row: Mapping[str, Parameter] = {row.name: row for row in self.rows}
        self._switches = switches
        self._switch: Mapping[str, str] = {row.name: field for row, field in SWITCHES}
        self._values = {row.name: held(row, row.default) for row in self.rows}
        self._values["SYSID_THISMAV"] = float(sysid)

    def row(self, name: str) -> Parameter:
        """Table row; raises KeyError for an unknown name."""
        return self._row[name]

    def __contains__(self, name: str) -> bool:
        return name in self._row

    def value(self, name: str) -> float:
        """Value as stored.  Raises KeyError for an unknown name."""
        return float(getattr(self._switches, self._switch[name])) if name in self._switch else self._values[name]

    def store(self, name: str, value: float) -> None:
        """Keep a value, which must be one that `meet` gave as `stored`."""
        if name in self._switch:
            setattr(self._switches, self._switch[name], int(value) if self._row[name].integer else value)
            self._switches.sets_met = 0
        else:
            self._values[name] = value

    def held(self, name: str, value: float) -> float:
        """The value as this parameter's type keeps it."""
        return held(self._row[name], value)

    def refusal(self, name: str, value: float) -> Refusal:
        """Why an honest autopilot would not take this value; NONE if it would."""
        if name not in self._row:
            return Refusal.UNKNOWN_NAME
        row = self._row[name]
        if name in READ_ONLY:
            return Refusal.READ_ONLY
        if not math.isfinite(value) or not row.minimum <= held(row, value) <= row.maximum:
            return Refusal.OUT_OF_RANGE
        return Refusal.NONE

    def meet(self, name: str, value: float) -> Meeting:
        """How this PARAM_SET is met, misbehaviour included; nothing is stored yet.

        As on ArduPilot nothing answers an unknown name or a value that is no number; a refused value is answered by
        the old one.
        """
        refusal = self.refusal(name, value)
        if refusal is Refusal.UNKNOWN_NAME or not math.isfinite(value):
            return Meeting(refusal, False, math.nan, False, math.nan)
        old, new = self.value(name), held(self._row[name], value)
        mode = ParameterMode.HONEST
        if self._switches.concerns(name) and self._switches.sets_met > self._switches.parameter_after:
            mode = ParameterMode(self._switches.parameter_mode)
        if mode is ParameterMode.IGNORE:
            return Meeting(refusal, False, new, False, math.nan)
        if mode is ParameterMode.LIE:
            return Meeting(Refusal.NONE, False, new, True, new)
        if refusal is not Refusal.NONE or mode is ParameterMode.REFUSE:
            return Meeting(refusal, False, new, True, old)
        if mode is ParameterMode.SILENT:
            return Meeting(refusal, True, new, False, math.nan)
        if mode is ParameterMode.LATE:
            return Meeting(refusal, True, new, True, new, self._switches.parameter_delay_s)
        return Meeting(refusal, True, new, True, new + 1.0 if mode is ParameterMode.WRONG else new)


def held(row: Parameter, value: float) -> float:
    """The value as the parameter's type keeps it: float32, or an integer cut off after ArduPilot's 0.01."""
    if not math.isfinite(value):
        return value
    if row.integer:
        return float(int(min(max(value + math.copysign(0.01, value), -2147483648.0), 2147483647.0)))
    with np.errstate(over="ignore"):
        return float(np.float32(value))
