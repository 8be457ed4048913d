"""The parafoil's tables: what its monitor listens to, what can break, and which residual tells of what."""

import math
from types import MappingProxyType

from fdi.verdict import Fault, Signature

CHANNELS = (
    "armed",  # 1 from release to touchdown
    "velocity_north_m_s",
    "velocity_east_m_s",
    "altitude_m",  # above sea level
    "output_1_us",  # commands to the motors, by output
    "output_2_us",
    "wheel_distance_1_m",  # line encoders on the motors' spools, by output
    "wheel_distance_2_m",
    "yaw_rate_rad_s",  # body FRD
    "pitch_rate_rad_s",
    "roll_rad",
    "pitch_rad",
    "turn_rate_command_rad_s",  # positive to the right
    "wind_speed_m_s",
    "wind_direction_rad",  # where it blows from
)

# A value outside is no measurement but a fault of the wire or of the sensor: unknown, like NaN.
LIMITS = MappingProxyType(
    {
        "armed": (0.0, 1.0),
        "velocity_north_m_s": (-150.0, 150.0),
        "velocity_east_m_s": (-150.0, 150.0),
        "altitude_m": (-500.0, 15000.0),
        "output_1_us": (500.0, 2500.0),  # 0: the output is not driven
        "output_2_us": (500.0, 2500.0),
        "wheel_distance_1_m": (-1.0, 5.0),
        "wheel_distance_2_m": (-1.0, 5.0),
        "yaw_rate_rad_s": (-10.0, 10.0),
        "pitch_rate_rad_s": (-10.0, 10.0),
        "roll_rad": (-math.pi, math.pi),
        "pitch_rad": (-math.pi / 2.0, math.pi / 2.0),
        "turn_rate_command_rad_s": (-10.0, 10.0),
        "wind_speed_m_s": (0.0, 100.0),
        "wind_direction_rad": (-2.0 * math.pi, 2.0 * math.pi),
    }
)

PARAMETERS = ("SERVO1_FUNCTION", "SERVO2_FUNCTION")

# Motors go by output (left: output 1), whatever its function; lines go by the edge of the canopy.
FAULTS = (
    Fault("motor:left", "motor", "left", "left motor stuck or limited", "m"),
    Fault("motor:right", "motor", "right", "right motor stuck or limited", "m"),
    Fault("broken_line:left", "broken_line", "left", "left control line broken"),
    Fault("broken_line:right", "broken_line", "right", "right control line broken"),
    Fault("crossed_lines", "crossed_lines", None, "control lines crossed"),
)

RESIDUALS = (
    "heading_rate",  # paper: rad2/s2, of the healthy hypothesis; ours: the largest of the last three
    "motor_1",  # m, by output
    "motor_2",
    "broken_left",  # paper: rad2/s2, each of its own hypothesis; ours: its sum of log likelihood ratios
    "broken_right",
    "crossed",
)

SIGNALS = ("turn_rate_command_rad_s", "turn_rate_rad_s")


def _signature(fault_id: str, *marks: str) -> Signature:
    return Signature(fault_id, dict(zip(RESIDUALS, marks, strict=True)))


# Of the paper's residuals: a fault's own observer follows the faulty vehicle, so that its residual stays quiet while the
# others trip.  Ours are the other way round: what speaks for a fault is above its threshold when it is named.
SIGNATURES = (
    #          fault                heading_rate  motor_1  motor_2  broken_left  broken_right  crossed
    _signature("motor:left", "+", "+", "0", ".", ".", "."),
    _signature("motor:right", "+", "0", "+", ".", ".", "."),
    _signature("broken_line:left", "+", "0", "0", "0", "+", "+"),
    _signature("broken_line:right", "+", "0", "0", "+", "0", "+"),
    _signature("crossed_lines", "+", "0", "0", "+", "+", "0"),
)
