"""From MAVLink messages to SI samples: one table for the live path and for logs.

The table is data: message, field, channel, and what the field says when the autopilot does not know.  The factor to SI
is not written down a second time: it follows from the unit that MAVLink's definition states and from the suffix of the
channel's name, and a row whose two units do not fit is refused when the table is compiled.
"""

import math
from collections import Counter
from dataclasses import dataclass, field
from enum import Enum
from typing import Final, NamedTuple

from companion.dialect import Definition, by_name
from companion.frames import Frame


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the decode table."""

    message: str
    field: str  # array elements as "distance[0]"
    channel: str
    unknown: float | None = None  # wire value that means "not known"
    mask: int = 0  # for bit fields: the channel is 1.0 where any of these bits is set, else 0.0
    instance: tuple[str, int] | None = None  # only messages in which this field has this value


UINT16_MAX: Final = 0xFFFF

TABLE: Final[tuple[Row, ...]] = (
    Row("HEARTBEAT", "base_mode", "armed", mask=0x80),  # MAV_MODE_FLAG_SAFETY_ARMED
    Row("EXTENDED_SYS_STATE", "landed_state", "landed_state", unknown=0),
    Row("GLOBAL_POSITION_INT", "lat", "latitude_rad"),
    Row("GLOBAL_POSITION_INT", "lon", "longitude_rad"),
    Row("GLOBAL_POSITION_INT", "alt", "altitude_m"),
    Row("GLOBAL_POSITION_INT", "relative_alt", "height_m"),
    Row("GLOBAL_POSITION_INT", "vx", "velocity_north_m_s"),
    Row("GLOBAL_POSITION_INT", "vy", "velocity_east_m_s"),
    Row("GLOBAL_POSITION_INT", "vz", "velocity_down_m_s"),
    Row("GPS_RAW_INT", "fix_type", "gps_fix_type"),
    Row("GPS_RAW_INT", "satellites_visible", "gps_satellites", unknown=255),
    Row("GPS_RAW_INT", "vel", "ground_speed_m_s", unknown=UINT16_MAX),
    Row("GPS_RAW_INT", "cog", "course_rad", unknown=UINT16_MAX),
    Row("ATTITUDE", "roll", "roll_rad"),
    Row("ATTITUDE", "pitch", "pitch_rad"),
    Row("ATTITUDE", "yaw", "yaw_rad"),
    Row("ATTITUDE", "rollspeed", "roll_rate_rad_s"),
    Row("ATTITUDE", "pitchspeed", "pitch_rate_rad_s"),
    Row("ATTITUDE", "yawspeed", "yaw_rate_rad_s"),
    Row("ATTITUDE_TARGET", "body_yaw_rate", "turn_rate_command_rad_s"),
    Row("HIGHRES_IMU", "xacc", "acceleration_x_m_s2"),
    Row("HIGHRES_IMU", "yacc", "acceleration_y_m_s2"),
    Row("HIGHRES_IMU", "zacc", "acceleration_z_m_s2"),
    Row("SCALED_PRESSURE", "press_abs", "pressure_pa"),
    Row("VFR_HUD", "alt", "pressure_altitude_m"),
    Row("VFR_HUD", "climb", "climb_rate_m_s"),
    Row("VFR_HUD", "airspeed", "airspeed_m_s"),
    Row("WIND", "speed", "wind_speed_m_s"),
    Row("WIND", "direction", "wind_direction_rad"),  # where it blows from
    Row("NAV_CONTROLLER_OUTPUT", "nav_bearing", "nav_bearing_rad"),
    Row("NAV_CONTROLLER_OUTPUT", "target_bearing", "target_bearing_rad"),
    Row("NAV_CONTROLLER_OUTPUT", "wp_dist", "target_distance_m"),
    Row("NAV_CONTROLLER_OUTPUT", "alt_error", "altitude_error_m"),
    Row("WHEEL_DISTANCE", "distance[0]", "wheel_distance_1_m"),
    Row("WHEEL_DISTANCE", "distance[1]", "wheel_distance_2_m"),
    *(
        Row("SERVO_OUTPUT_RAW", f"servo{output}_raw", f"output_{output}_us", unknown=0, instance=("port", 0))
        for output in range(1, 17)
    ),
)

# unit on the wire -> (dimension, factor to SI).  Factors are written so that one multiplication is exact to the last bit
# of what MAVLink means: 1e-7 degrees, centimetres, millibars.
WIRE_UNITS: Final = {
    "": ("1", 1.0),
    "rad": ("rad", 1.0),
    "deg": ("rad", math.pi / 180.0),
    "cdeg": ("rad", math.pi / 18_000.0),
    "degE7": ("rad", math.pi / 180.0e7),
    "rad/s": ("rad_s", 1.0),
    "mrad/s": ("rad_s", 1e-3),
    "deg/s": ("rad_s", math.pi / 180.0),
    "m": ("m", 1.0),
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "dam": ("m", 10.0),
    "m/s": ("m_s", 1.0),
    "cm/s": ("m_s", 1e-2),
    "mm/s": ("m_s", 1e-3),
    "m/s/s": ("m_s2", 1.0),
    "mG": ("m_s2", 9.80665e-3),
    "Pa": ("pa", 1.0),
    "hPa": ("pa", 100.0),
    "us": ("us", 1.0),
    "V": ("v", 1.0),
    "mV": ("v", 1e-3),
    "A": ("a", 1.0),
    "cA": ("a", 1e-2),
    "Hz": ("hz", 1.0),
}

# dimension -> largest magnitude that can be meant.  What lies beyond is no measurement of a vehicle: it is counted and
# treated as if the message had not come.
PLAUSIBLE: Final = {
    "1": 1e9,
    "rad": 4.0 * math.pi,
    "rad_s": 100.0,
    "m": 1e6,
    "m_s": 1e4,
    "m_s2": 1e4,
    "pa": 2e5,
    "us": 1e5,
    "v": 1e3,
    "a": 1e4,
    "hz": 1e5,
}

_SUFFIXES: Final = sorted((dimension for dimension in PLAUSIBLE if dimension != "1"), key=len, reverse=True)


def dimension_of(channel: str) -> str:
    """The dimension that a channel's name states by its suffix: "velocity_north_m_s" -> "m_s"; "1" if it states none."""
    return next((suffix for suffix in _SUFFIXES if channel.endswith("_" + suffix)), "1")


class ClockKind(Enum):
    """What time a message carries."""

    NONE = "none"
    BOOT_MS = "boot_ms"  # uint32, milliseconds since boot
    USEC32 = "usec32"  # uint32, microseconds since boot, wraps after 71 minutes
    USEC64 = "usec64"  # uint64, microseconds since boot or since 1970, the definition leaves it open


class Sampled(NamedTuple):
    """What one message says: its own time, and values by the channel's index."""

    clock: ClockKind
    stamp: int  # as on the wire; 0 where there is none
    values: tuple[tuple[int, float], ...]


class _Pick(NamedTuple):  # taken apart for every message
    position: int  # in the unpacked tuple
    channel: int
    factor: float
    unknown: float | None
    mask: int
    limit: float


@dataclass(frozen=True, slots=True)
class _Plan:
    clock: ClockKind
    clock_position: int
    instance: tuple[int, int] | None  # position, value
    picks: tuple[_Pick, ...]


def _position(message: Definition, name: str) -> int:
    base, bracket, index = name.partition("[")
    start = message.starts[message.fields.index(base)]
    return start + int(index.rstrip("]")) if bracket else start


def _clock(message: Definition) -> tuple[ClockKind, int]:
    for name, kind in zip(message.fields, message.types, strict=True):
        if name == "time_boot_ms":
            return ClockKind.BOOT_MS, _position(message, name)
        if name == "time_usec":
            return (ClockKind.USEC32 if kind == "uint32_t" else ClockKind.USEC64), _position(message, name)
    return ClockKind.NONE, 0


def _pick(row: Row, message: Definition, channel: int) -> _Pick:
    base = row.field.partition("[")[0]
    unit = message.units.get(base, "")
    dimension = dimension_of(row.channel)
    if unit not in WIRE_UNITS:
        raise ValueError(f"{row.message}.{row.field} is in {unit}, for which there is no factor")
    wire_dimension, factor = WIRE_UNITS[unit]
    if unit and wire_dimension != dimension:
        raise ValueError(f"{row.message}.{row.field} is in {unit}, channel {row.channel} says {dimension}")
    return _Pick(_position(message, row.field), channel, factor, row.unknown, row.mask, PLAUSIBLE[dimension])


@dataclass(slots=True)
class Decoder:
    """The table compiled for the channels that one airframe needs.

    counts: "not_finite" and "absurd" values that were treated as absent.  Raises ValueError for a channel that no row
    delivers, and for a row whose units do not fit.
    """

    channels: tuple[str, ...]
    counts: Counter[str] = field(default_factory=Counter)
    _plans: dict[int, tuple[_Plan, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        index = {channel: position for position, channel in enumerate(self.channels)}
        if missing := set(self.channels) - {row.channel for row in TABLE}:
            raise ValueError(f"no message delivers the channel {', '.join(sorted(missing))}")
        grouped: dict[tuple[str, tuple[str, int] | None], list[Row]] = {}
        for row in TABLE:
            if row.channel in index:
                grouped.setdefault((row.message, row.instance), []).append(row)
        for (name, instance), rows in grouped.items():
            message = by_name(name)
            clock, clock_position = _clock(message)
            plan = _Plan(
                clock,
                clock_position,
                (_position(message, instance[0]), instance[1]) if instance else None,
                tuple(_pick(row, message, index[row.channel]) for row in rows),
            )
            self._plans[message.id] = (*self._plans.get(message.id, ()), plan)

    @property
    def messages(self) -> tuple[str, ...]:
        """Names of the messages that deliver something here."""
        return tuple(dict.fromkeys(row.message for row in TABLE if row.channel in self.channels))

    def decode(self, frame: Frame) -> Sampled | None:
        """The samples of one checked frame; None if it delivers none of the channels."""
        plans = self._plans.get(frame.message_id)
        if plans is None or frame.definition is None:
            return None
        flat = frame.definition.unpack(frame.payload)
        for plan in plans:
            if plan.instance is not None and flat[plan.instance[0]] != plan.instance[1]:
                continue
            stamp = flat[plan.clock_position] if plan.clock is not ClockKind.NONE else 0
            assert isinstance(stamp, int)  # every clock field is an integer on the wire
            return Sampled(plan.clock, stamp, self._values(plan.picks, flat))
        return None

    def _values(self, picks: tuple[_Pick, ...], flat: tuple[int | float | bytes, ...]) -> tuple[tuple[int, float], ...]:
        values: list[tuple[int, float]] = []
        for position, channel, factor, unknown, mask, limit in picks:
            raw = flat[position]
            assert not isinstance(raw, bytes)  # no row of the table names a text field
            if raw == unknown:
                continue
            if mask:
                values.append((channel, 1.0 if int(raw) & mask else 0.0))
                continue
            value = raw * factor
            if -limit <= value <= limit:
                values.append((channel, value))
            else:
                self.counts["absurd" if math.isfinite(value) else "not_finite"] += 1
        return tuple(values)
