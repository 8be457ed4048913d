"""Wrapping of angles, for the kernels of the plants."""

import math

from sitl.kernel import plant_kernel

TURN_RAD = 2.0 * math.pi


@plant_kernel
def wrap_pi(angle_rad: float) -> float:
    """The same angle in (-pi, pi], rad."""
    return angle_rad - TURN_RAD * math.ceil((angle_rad - math.pi) / TURN_RAD)


@plant_kernel
def wrap_turn(angle_rad: float) -> float:
    """The same angle in [0, 2 pi), rad: compass headings on the wire."""
    wrapped = angle_rad - TURN_RAD * math.floor(angle_rad / TURN_RAD)
    return 0.0 if wrapped >= TURN_RAD else wrapped  # a tiny negative angle rounds up to a whole turn
