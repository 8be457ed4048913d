"""Tables of the simulated parafoil: its channels, what of them travels in which message, parameters, injections."""

import math

from sitl.parafoil.dynamics import TRAVEL_M
from sitl.vehicle import Field, Injection, Parameter, Stream, Vehicle

CHANNELS: tuple[str, ...] = (
    "velocity_north_m_s",  # GPS
    "velocity_east_m_s",
    "velocity_down_m_s",
    "latitude_rad",
    "longitude_rad",
    "altitude_m",  # above sea level
    "height_m",  # above the target
    "course_rad",  # 0..2 pi
    "ground_speed_m_s",
    "climb_rate_m_s",
    "heading_rad",  # the yaw angle as 0..2 pi
    "roll_rad",
    "pitch_rad",
    "yaw_rad",
    "roll_rate_rad_s",  # body rates, of the gyro
    "pitch_rate_rad_s",
    "yaw_rate_rad_s",
    "acceleration_x_m_s2",  # specific force
    "acceleration_y_m_s2",
    "acceleration_z_m_s2",
    "pressure_altitude_m",
    "pressure_pa",
    "airspeed_m_s",  # horizontal, the navigation filter's
    "wheel_distance_1_m",  # encoder of the spool of output 1
    "wheel_distance_2_m",
    "output_1_us",  # what the motors have just followed
    "output_2_us",
    "turn_rate_command_rad_s",  # what that came from
    "nav_bearing_rad",
    "target_bearing_rad",
    "target_distance_m",
    "altitude_error_m",  # height to spare
    "wind_speed_m_s",
    "wind_direction_rad",  # where it blows from, 0..2 pi
    "landed",  # 0 or 1
)

LEFT_TOGGLE, RIGHT_TOGGLE = 77, 78  # output functions

_DEG = math.degrees(1.0)
_DEG_E7 = _DEG * 1e7
_CENTIDEG = _DEG * 100.0
# HIGHRES_IMU.fields_updated: acceleration, gyro (bits 0-5), absolute pressure (9), pressure altitude (11), temperature (12)
_IMU_FIELDS = 0b1_1010_0011_1111
# ATTITUDE_TARGET.type_mask: roll rate, pitch rate, throttle and attitude are to be ignored, the yaw rate is meant
_YAW_RATE_ONLY = 1 | 2 | 64 | 128

STREAMS = (
    Stream(
        "GLOBAL_POSITION_INT",
        5.0,
        5.0,
        (
            Field("lat", "latitude_rad", _DEG_E7),
            Field("lon", "longitude_rad", _DEG_E7),
            Field("alt", "altitude_m", 1000.0),
            Field("relative_alt", "height_m", 1000.0),
            Field("vx", "velocity_north_m_s", 100.0),
            Field("vy", "velocity_east_m_s", 100.0),
            Field("vz", "velocity_down_m_s", 100.0),
            Field("hdg", "heading_rad", _CENTIDEG),
        ),
    ),
    Stream(
        "GPS_RAW_INT",
        5.0,
        5.0,
        (
            Field("lat", "latitude_rad", _DEG_E7),
            Field("lon", "longitude_rad", _DEG_E7),
            Field("alt", "altitude_m", 1000.0),
            Field("alt_ellipsoid", "altitude_m", 1000.0),
            Field("vel", "ground_speed_m_s", 100.0),
            Field("cog", "course_rad", _CENTIDEG),
        ),
        # 3-D fix, dilutions 0.8 and 1.2, accuracies in mm, mm/s
        {
            "fix_type": 3,
            "eph": 80,
            "epv": 120,
            "satellites_visible": 14,
            "h_acc": 1200,
            "v_acc": 1500,
            "vel_acc": 100,
        },
    ),
    Stream(
        "ATTITUDE",
        10.0,
        50.0,
        (
            Field("roll", "roll_rad"),
            Field("pitch", "pitch_rad"),
            Field("yaw", "yaw_rad"),
            Field("rollspeed", "roll_rate_rad_s"),
            Field("pitchspeed", "pitch_rate_rad_s"),
            Field("yawspeed", "yaw_rate_rad_s"),
        ),
    ),
    Stream(
        "HIGHRES_IMU",
        10.0,
        50.0,
        (
            Field("xacc", "acceleration_x_m_s2"),
            Field("yacc", "acceleration_y_m_s2"),
            Field("zacc", "acceleration_z_m_s2"),
            Field("xgyro", "roll_rate_rad_s"),
            Field("ygyro", "pitch_rate_rad_s"),
            Field("zgyro", "yaw_rate_rad_s"),
            Field("abs_pressure", "pressure_pa", 0.01),
            Field("pressure_alt", "pressure_altitude_m"),
        ),
        {"temperature": 15.0, "fields_updated": _IMU_FIELDS},
    ),
    Stream("SCALED_PRESSURE", 5.0, 5.0, (Field("press_abs", "pressure_pa", 0.01),), {"temperature": 1500}),
    Stream(
        "VFR_HUD",
        5.0,
        5.0,
        (
            Field("airspeed", "airspeed_m_s"),
            Field("groundspeed", "ground_speed_m_s"),
            Field("heading", "heading_rad", _DEG),
            Field("alt", "pressure_altitude_m"),
            Field("climb", "climb_rate_m_s"),
        ),
    ),
    Stream(
        "WHEEL_DISTANCE",
        10.0,
        50.0,
        (Field("distance[0]", "wheel_distance_1_m"), Field("distance[1]", "wheel_distance_2_m")),
        {"count": 2},
    ),
    Stream(
        "SERVO_OUTPUT_RAW",
        10.0,
        50.0,
        (Field("servo1_raw", "output_1_us"), Field("servo2_raw", "output_2_us")),
    ),
    Stream(
        "NAV_CONTROLLER_OUTPUT",
        2.0,
        2.0,
        (
            Field("nav_roll", "roll_rad", _DEG),
            Field("nav_pitch", "pitch_rad", _DEG),
            Field("nav_bearing", "nav_bearing_rad", _DEG),
            Field("target_bearing", "target_bearing_rad", _DEG),
            Field("wp_dist", "target_distance_m"),
            Field("alt_error", "altitude_error_m"),
        ),
    ),
    Stream(
        "WIND",
        2.0,
        2.0,
        (Field("direction", "wind_direction_rad", _DEG), Field("speed", "wind_speed_m_s")),
    ),
    Stream(
        "ATTITUDE_TARGET",
        10.0,
        50.0,
        (Field("body_yaw_rate", "turn_rate_command_rad_s"),),
        {"type_mask": _YAW_RATE_ONLY, "q[0]": 1.0},
    ),
)


def _servo(number: int, function: int) -> tuple[Parameter, ...]:
    """Parameters of one output.  Only its function acts here; the rest is what ground stations expect to find."""
    return (
        Parameter(f"SERVO{number}_FUNCTION", function, True, 0, 150),
        Parameter(f"SERVO{number}_MIN", 1000, True, 500, 2200, acts=False),
        Parameter(f"SERVO{number}_MAX", 2000, True, 800, 2200, acts=False),
        Parameter(f"SERVO{number}_TRIM", 1000, True, 800, 2200, acts=False),
        Parameter(f"SERVO{number}_REVERSED", 0, True, 0, 1, acts=False),
    )


PARAMETERS = (
    *_servo(1, LEFT_TOGGLE),
    *_servo(2, RIGHT_TOGGLE),
    Parameter("SIM_FLT_TYPE", 0, True, 0, 4),  # 1 stuck, 2 saturation, 3 broken line, 4 crossed; setting it arms the fault
    Parameter("SIM_FLT_SIDE", 0, True, 0, 1),  # 0 left, 1 right
    Parameter("SIM_FLT_VALUE", 0.5, False, -1.0, TRAVEL_M),  # m; < 0: stuck where it is
    Parameter("SIM_FLT_TIME", -1.0, False, -1.0, 1e5),  # s after release; < 0: now
    Parameter("SIM_FLT_CLEAR", 0.0, False, 0.0, 1e5),  # s after release; 0: never
    Parameter("SIM_FLT_SLACK", 0.0, False, 0.0, TRAVEL_M),  # m, both lines
    Parameter("SIM_GPS_NOISE", 1.0, False, 0.0, 100.0),  # factor
    Parameter("SIM_GPS_DISABLE", 0, True, 0, 1),
    Parameter("PF_TURN_DIR", 0, True, -1, 1),  # +1 right turns only, -1 left turns only
    Parameter("PF_STUCK_SIDE", 0, True, 0, 2),  # 1 left, 2 right, by function
    Parameter("PF_STUCK_VALUE", 0.0, False, 0.0, TRAVEL_M),  # m
    Parameter("PF_LIMIT_L", TRAVEL_M, False, 0.0, TRAVEL_M),  # m
    Parameter("PF_LIMIT_R", TRAVEL_M, False, 0.0, TRAVEL_M),  # m
    Parameter("PF_PROBE", 0, True, 0, 1),
)

SYSTEM_SERVO, FAILURE_OK, FAILURE_STUCK = 102, 0, 2  # FAILURE_UNIT, FAILURE_TYPE

VEHICLE = Vehicle(
    name="parafoil",
    mav_type=28,  # MAV_TYPE_PARAFOIL
    modes={"AUTO": 10, "MANUAL": 0},
    streams=STREAMS,
    parameters=PARAMETERS,
    injections=(
        Injection(SYSTEM_SERVO, FAILURE_STUCK, 2, "INJECT_SERVO_STUCK"),
        Injection(SYSTEM_SERVO, FAILURE_OK, 2, "INJECT_SERVO_OK"),
    ),
    fault_ids=("motor:left", "motor:right", "broken_line:left", "broken_line:right", "crossed_lines"),
    steps_s=(0.1, 0.02),
)
