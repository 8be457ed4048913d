"""From the fleet's channels to the payloads of the regular messages, by the airframe's table.

What is not known is not invented.  The rule, for a channel that is NaN:
- a float field carries NaN;
- an integer field carries the value that MAVLink's definition gives for "unknown" (`UNKNOWN`), where it gives one;
- otherwise the whole message stays away, as GLOBAL_POSITION_INT does without a position;
- except GPS_RAW_INT, which exists to say so: without a position it goes out with fix_type NO_FIX and everything unknown.
A field that the airframe's table does not mention is "unknown" where the definition has such a value, else zero.

The time stamp of a message is that of its sample: boot clock less the age of the first channel in the stream's table (the
first, because slower sensors ride along in faster messages, as the barometer does in HIGHRES_IMU).  A held value sent twice
so carries one stamp, and whoever takes rows from the link sees the same ages as whoever takes them from the fleet.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl.autopilot.frames import Layout, Packed, layout
from sitl.vehicle import Stream

UNKNOWN: Mapping[tuple[str, str], int] = {  # MAVLink common.xml, `invalid` attributes and field descriptions
    ("GPS_RAW_INT", "eph"): 0xFFFF,
    ("GPS_RAW_INT", "epv"): 0xFFFF,
    ("GPS_RAW_INT", "vel"): 0xFFFF,
    ("GPS_RAW_INT", "cog"): 0xFFFF,
    ("GPS_RAW_INT", "satellites_visible"): 0xFF,
    ("GPS_RAW_INT", "yaw"): 0,
    ("GPS2_RAW", "eph"): 0xFFFF,
    ("GPS2_RAW", "epv"): 0xFFFF,
    ("GPS2_RAW", "vel"): 0xFFFF,
    ("GPS2_RAW", "cog"): 0xFFFF,
    ("GPS2_RAW", "satellites_visible"): 0xFF,
    ("GLOBAL_POSITION_INT", "hdg"): 0xFFFF,
    ("SCALED_PRESSURE", "temperature_press_diff"): 0,
    ("SERVO_OUTPUT_RAW", "servo1_raw"): 0,  # ArduPilot's zero: no pulse
    ("SERVO_OUTPUT_RAW", "servo2_raw"): 0,
    ("SERVO_OUTPUT_RAW", "servo3_raw"): 0,
    ("SERVO_OUTPUT_RAW", "servo4_raw"): 0,
    ("SERVO_OUTPUT_RAW", "servo5_raw"): 0,
    ("SERVO_OUTPUT_RAW", "servo6_raw"): 0,
    ("SERVO_OUTPUT_RAW", "servo7_raw"): 0,
    ("SERVO_OUTPUT_RAW", "servo8_raw"): 0,
    ("SYS_STATUS", "voltage_battery"): 0xFFFF,
    ("SYS_STATUS", "current_battery"): -1,
    ("SYS_STATUS", "battery_remaining"): -1,
    ("BATTERY_STATUS", "temperature"): 0x7FFF,
    ("BATTERY_STATUS", "current_battery"): -1,
    ("BATTERY_STATUS", "current_consumed"): -1,
    ("BATTERY_STATUS", "energy_consumed"): -1,
    ("BATTERY_STATUS", "battery_remaining"): -1,
    ("DISTANCE_SENSOR", "covariance"): 0xFF,
    ("RC_CHANNELS", "rssi"): 0xFF,
}

GPS_FIX_TYPE_NO_FIX = 1
LONGEST_AGE_S = 1.0  # a stamp is never put back further than this: whoever has no sample at all must not stop the clock

_TICKS: Mapping[str, int] = {"time_boot_ms": 1000, "time_usec": 1}  # us a tick
_WRAP: Mapping[str, int] = {"I": 0xFFFFFFFF, "Q": 0xFFFFFFFFFFFFFFFF}
_FLOAT_MAX = 3.4028234663852886e38

REQUEST_GROUPS: Mapping[int, frozenset[str]] = {  # REQUEST_DATA_STREAM, MAV_DATA_STREAM; ArduPilot's GCS_MAVLink_*.cpp
    1: frozenset({"RAW_IMU", "SCALED_IMU", "SCALED_PRESSURE", "HIGHRES_IMU"}),
    2: frozenset({"SYS_STATUS", "GPS_RAW_INT", "NAV_CONTROLLER_OUTPUT", "MISSION_CURRENT", "EXTENDED_SYS_STATE"}),
    3: frozenset({"SERVO_OUTPUT_RAW", "RC_CHANNELS"}),
    6: frozenset({"GLOBAL_POSITION_INT", "LOCAL_POSITION_NED"}),
    10: frozenset({"ATTITUDE", "ATTITUDE_TARGET"}),
    11: frozenset({"VFR_HUD"}),
    12: frozenset({"WIND", "SYSTEM_TIME", "VIBRATION", "EKF_STATUS_REPORT", "WHEEL_DISTANCE", "BATTERY_STATUS", "RPM"}),
}


@dataclass(frozen=True, slots=True)
class _Plan:
    """One stream: where its columns lie among all columns, and which slot of the payload each of them fills."""

    layout: Layout
    columns: slice
    leading: int  # channel whose age stamps the message, -1: none
    slots: tuple[tuple[int, bool], ...]  # slot, integer; in the order of the columns
    times: tuple[tuple[int, int, int], ...]  # slot, us a tick, mask
    template: tuple[float | bytes, ...]
    fix_slot: int  # GPS_RAW_INT's fix_type, else -1
    without_fix: tuple[float | bytes, ...]  # what GPS_RAW_INT says without a position


class StreamTable:
    """Packs the regular messages of one vehicle; one row of the fleet at a time."""

    def __init__(self, streams: Sequence[Stream], channels: Sequence[str]) -> None:
        """Raises KeyError for a message, field or channel that does not exist."""
        index = {channel: c for c, channel in enumerate(channels)}
        columns: list[int] = []
        scale: list[float] = []
        offset: list[float] = []
        unknown: list[float] = []
        low: list[float] = []
        high: list[float] = []
        double: list[bool] = []
        plans: list[_Plan] = []
        for stream in streams:
            where = layout(stream.message)
            start = len(columns)
            slots: list[tuple[int, bool]] = []
            for field in stream.fields:
                if field.channel not in index:
                    raise KeyError(f"stream {stream.message} wants channel {field.channel}, which the fleet does not have")
                slot, code = where.slot(field.name)
                integer = code not in "fd"
                nothing = float(UNKNOWN.get((stream.message, field.name), math.nan)) if integer else math.nan
                lowest, highest = _range(code, nothing)
                columns.append(index[field.channel])
                scale.append(field.scale)
                offset.append(field.offset)
                unknown.append(nothing)
                low.append(lowest)
                high.append(highest)
                double.append(code == "d")
                slots.append((slot, integer))
            template = _template(stream, where, stream.constants)
            is_gps = "fix_type" in where.first_slot
            without_fix = _template(stream, where, {"fix_type": GPS_FIX_TYPE_NO_FIX} if is_gps else {})
            times = tuple(
                (where.first_slot[name], tick, _WRAP[where.code[name]])
                for name, tick in _TICKS.items()
                if name in where.first_slot
            )
            plans.append(
                _Plan(
                    where,
                    slice(start, len(columns)),
                    columns[start] if len(columns) > start else -1,
                    tuple(slots),
                    times,
                    template,
                    where.first_slot["fix_type"] if is_gps else -1,
                    without_fix,
                )
            )
        self._plans = tuple(plans)
        self._columns = np.array(columns, dtype=np.intp)
        self._scale = np.array(scale)
        self._offset = np.array(offset)
        self._unknown = np.array(unknown)
        self._low = np.array(low)
        self._high = np.array(high)
        self._single = ~np.array(double, dtype=bool)
        self._integer = np.isfinite(self._high)
        self._wire: list[float] = []
        self._values = np.zeros(len(channels))
        self._age_s = np.zeros(len(channels))
        self._now_us = 0

    def take(self, values: NDArray[np.float64], age_s: NDArray[np.float64], now_us: int) -> None:
        """Take the row to pack from: (channel,) values in SI and their ages, at boot time now_us."""
        wire = values[self._columns] * self._scale + self._offset
        # One test for the usual row: all finite, and nothing that a float32 cannot carry.
        usual = bool((np.abs(wire) < _FLOAT_MAX).all())
        wire = np.where(self._integer, np.minimum(np.maximum(np.rint(wire), self._low), self._high), wire)
        if not usual:
            too_large = self._single & (np.abs(wire) >= _FLOAT_MAX)
            wire = np.where(too_large, np.copysign(np.inf, wire), wire)
            wire = np.where(np.isnan(wire), self._unknown, wire)
        self._wire = wire.tolist()
        self._values, self._age_s = values, age_s
        self._now_us = now_us

    def pack(self, stream: int) -> Packed | None:
        """Message number `stream` of the row last taken; None where it would have to invent a value."""
        plan = self._plans[stream]
        slots = list(plan.template)
        wire = self._wire[plan.columns]
        for (slot, integer), value in zip(plan.slots, wire, strict=True):
            if not integer:
                slots[slot] = value
            elif value == value:
                slots[slot] = int(value)
            elif plan.fix_slot < 0:
                return None
            else:
                slots = list(plan.without_fix)
                break
        stamp_us = self._stamp_us(plan.leading)
        for slot, tick_us, mask in plan.times:
            slots[slot] = stamp_us // tick_us & mask
        return Packed(plan.layout, plan.layout.format.pack(*slots))

    def has_fix(self) -> bool:
        """Whether the row last taken has a position, for vehicles that send GPS_RAW_INT; True for all others."""
        return all(
            value == value
            for plan in self._plans
            if plan.fix_slot >= 0
            for (_, integer), value in zip(plan.slots, self._wire[plan.columns], strict=True)
            if integer
        )

    def _stamp_us(self, leading: int) -> int:
        age_s = float(self._age_s[leading]) if leading >= 0 and self._values[leading] == self._values[leading] else 0.0
        return max(0, self._now_us - round(min(age_s, LONGEST_AGE_S) * 1e6)) if age_s > 0.0 else self._now_us


def _range(code: str, unknown: float) -> tuple[float, float]:
    """What an integer field holds; the value that means "unknown" is not given to a known quantity at the edge."""
    if code in "fd":
        return -math.inf, math.inf
    bits = 8 * struct.calcsize("<" + code)
    # Beyond 2**53 a float64 no longer holds every integer: the largest below the edge that it does hold.
    high = float(2 ** (bits - 1) - 1 if code.islower() else 2**bits - 1)
    if bits == 64:
        high = math.nextafter(float(2 ** (bits - 1) if code.islower() else 2**bits), 0.0)
    low = -float(2 ** (bits - 1)) if code.islower() else 0.0
    return low, high - 1.0 if unknown == high else high


def _template(stream: Stream, where: Layout, constants: Mapping[str, float]) -> tuple[float | bytes, ...]:
    slots = list(where.blank)
    for (message, name), value in UNKNOWN.items():
        if message == stream.message:
            slots[where.slot(name)[0]] = value
    for name, constant in constants.items():
        slot, code = where.slot(name)
        slots[slot] = constant if code in "fd" else round(constant)
    return tuple(slots)
