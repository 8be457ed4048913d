"""What several checks read of one message: taken apart once by the bench, for however many look at it."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from operator import itemgetter
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from companion.checks.finding import known, number
from companion.dialect import Fields

UINT16_MAX: Final = 65535.0
FIX_3D: Final = mavlink.GPS_FIX_TYPE_3D_FIX
STILL_M_S: Final = 0.5  # below, a receiver states no course
LONGEST_STEP_S: Final = 2.5
METRES_A_DEGREE: Final = 111_319.5  # of latitude, WGS 84 equatorial radius times pi / 180
STANDARD_GRAVITY_M_S2: Final = 9.80665
MG_M_S2: Final = STANDARD_GRAVITY_M_S2 / 1000.0
MG_A_GAUSS: Final = 1000.0  # HIGHRES_IMU's unit

# Instance of the sensor by message; HIGHRES_IMU says its own.
INSTANCES: Final = {"RAW_IMU": 0, "SCALED_IMU": 0, "SCALED_IMU2": 1, "SCALED_IMU3": 2}

# Where the values are in the rows that the flight keeps of ATTITUDE and of the first inertial sensor.
ANGLES, PITCH_AND_YAW, RATES = slice(0, 3), slice(1, 3), slice(3, 6)
GYRO, ACCELERATION, MAGNETIC = slice(0, 3), slice(3, 6), slice(6, 9)

Triple = tuple[float, float, float]


class Imu(NamedTuple):
    """An inertial message, body FRD; None where it holds no such sensor."""

    instance: int
    gyro_rad_s: Triple | None
    acceleration_m_s2: Triple | None
    field_mg: Triple | None


# All of them numbers by their definitions; picked at once, for there are thousands of these messages.
Picked = Callable[[Fields], tuple[float, ...]]
_INERTIAL: Final[Picked] = itemgetter("xgyro", "ygyro", "zgyro", "xacc", "yacc", "zacc", "xmag", "ymag", "zmag")
_ATTITUDE: Final[Picked] = itemgetter("roll", "pitch", "yaw", "rollspeed", "pitchspeed", "yawspeed")
NONE: Final[Triple] = (math.nan, math.nan, math.nan)


def imu(name: str, fields: Fields, ardupilot: bool) -> Imu | None:
    """None where the message tells nothing that can be compared.

    RAW_IMU has units only with ArduPilot, which sends it like SCALED_IMU (GCS_Common.cpp); elsewhere it is counts.
    """
    if name == "RAW_IMU" and not ardupilot:
        return None
    if name == "HIGHRES_IMU":
        instance, rate, force, field_scale = int(number(fields, "id")), 1.0, 1.0, MG_A_GAUSS
    else:
        instance, rate, force, field_scale = INSTANCES[name], 1e-3, MG_M_S2, 1.0
    gx, gy, gz, ax, ay, az, mx, my, mz = _INERTIAL(fields)
    field_mg = (mx * field_scale, my * field_scale, mz * field_scale) if mx or my or mz else None
    if not (ax or ay or az):  # no accelerometer reads that: there is none (SCALED_IMU3 often holds a compass alone)
        return Imu(instance, None, None, field_mg)
    return Imu(instance, (gx * rate, gy * rate, gz * rate), (ax * force, ay * force, az * force), field_mg)


def attitude(fields: Fields) -> tuple[float, ...]:
    """ATTITUDE: ANGLES, then RATES."""
    return _ATTITUDE(fields)


class Step(NamedTuple):
    """What a GPS position did beyond the receiver's own velocity, from one sample to the next."""

    t_s: float
    dt_s: float
    north_m: float
    east_m: float


class _Sample(NamedTuple):
    stamp_us: float
    t_s: float
    latitude_deg: float
    longitude_deg: float
    velocity_north_m_s: float
    velocity_east_m_s: float


@dataclass(slots=True)
class Steps:
    """From GPS_RAW_INT to steps; None where two samples cannot be compared."""

    _last: _Sample | None = None

    def take(self, fields: Fields, t_s: float) -> Step | None:
        speed_m_s = known(number(fields, "vel"), UINT16_MAX) / 100.0
        course_deg = known(number(fields, "cog"), UINT16_MAX) / 100.0
        if math.isnan(course_deg) and speed_m_s < STILL_M_S:
            course_deg = 0.0
        if number(fields, "fix_type") < FIX_3D or math.isnan(speed_m_s + course_deg):
            self._last = None
            return None
        course_rad = math.radians(course_deg)
        new = _Sample(
            number(fields, "time_usec"),
            t_s,
            number(fields, "lat") * 1e-7,
            number(fields, "lon") * 1e-7,
            speed_m_s * math.cos(course_rad),
            speed_m_s * math.sin(course_rad),
        )
        old = self._last
        if old is not None and new.stamp_us == old.stamp_us and new.stamp_us > 0.0:
            return None  # the stream is faster than the receiver
        self._last = new
        if old is None:
            return None
        dt_s = new.t_s - old.t_s
        own_s = (new.stamp_us - old.stamp_us) / 1e6
        if own_s > 0.0 and abs(own_s - dt_s) < 1.5:
            dt_s = own_s
        if not 0.0 < dt_s <= LONGEST_STEP_S:
            return None
        east_scale = METRES_A_DEGREE * math.cos(math.radians(new.latitude_deg))
        north_m = (new.latitude_deg - old.latitude_deg) * METRES_A_DEGREE
        east_m = (new.longitude_deg - old.longitude_deg) * east_scale
        north_m -= 0.5 * (new.velocity_north_m_s + old.velocity_north_m_s) * dt_s
        east_m -= 0.5 * (new.velocity_east_m_s + old.velocity_east_m_s) * dt_s
        return Step(t_s, dt_s, north_m, east_m)
