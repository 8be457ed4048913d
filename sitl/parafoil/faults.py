"""What can break: motors that stick or saturate, lines that tear, lines that are crossed; as records and as kernels.

Sides are physical: "left" of a motor is output 1, whatever its function; "left" of a line is the left edge of the canopy.
Source: Stoeckle, Fejzic, Breger, How, "Fault Detection and Isolation for Autonomous Parafoils"; sizes are ours.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sitl.kernel import plant_kernel
from sitl.parafoil import config
from sitl.parafoil.dynamics import TRAVEL_M, motor_step
from sitl.vehicle import Injected, check_faults

# rows and columns of a flight's faults, (FAULTS, 4); a clearing time of infinity is never
MOTOR_1, MOTOR_2, BROKEN_LEFT, BROKEN_RIGHT, CROSSED = range(5)
FAULTS = 5
KIND, VALUE_M, ONSET_MS, CLEAR_MS = range(4)
NONE, STUCK, SATURATION, PRESENT = 0.0, 1.0, 2.0, 3.0
WHERE_IT_IS_M = -1.0  # value of a motor that sticks without running anywhere

_KINDS = {"stuck": STUCK, "saturation": SATURATION}
_IDS = ("motor:left", "motor:right", "broken_line:left", "broken_line:right", "crossed_lines")


@plant_kernel
def fault_acts(fault: NDArray[np.float64], t_ms: int) -> bool:
    """Whether a fault, (4,), acts in a step that begins at t_ms."""
    return bool(fault[KIND] != NONE and fault[ONSET_MS] <= t_ms < fault[CLEAR_MS])


@plant_kernel
def faulty_motor_step(
    fault: NDArray[np.float64],
    t_ms: int,
    position_m: float,
    command_m: float,
    lag_s: float,
    rate_m_s: float,
    dt_s: float,
) -> float:
    """Next position of a motor, m, as `motor_step`, with its fault: stuck runs to a value at its rate, without lag."""
    if fault_acts(fault, t_ms):
        if fault[KIND] == STUCK:
            if fault[VALUE_M] < 0.0:
                return position_m
            step = fault[VALUE_M] - position_m
            return float(position_m + min(max(step, -rate_m_s * dt_s), rate_m_s * dt_s))
        command_m = min(command_m, max(fault[VALUE_M], 0.0))
    return motor_step(position_m, command_m, lag_s, rate_m_s, dt_s)


@plant_kernel
def pulled_lines(
    faults: NDArray[np.float64], t_ms: int, motor_1_m: float, motor_2_m: float, slack_m: float
) -> tuple[float, float]:
    """Deflections of the canopy's left and right edge, m, from the positions of both motors."""
    left = max(motor_1_m - slack_m, 0.0)
    right = max(motor_2_m - slack_m, 0.0)
    if fault_acts(faults[CROSSED], t_ms):
        left, right = right, left
    if fault_acts(faults[BROKEN_LEFT], t_ms):
        left = 0.0
    if fault_acts(faults[BROKEN_RIGHT], t_ms):
        right = 0.0
    return left, right


def no_faults() -> NDArray[np.float64]:
    """Faults of a sound vehicle, (FAULTS, 4)."""
    faults = np.zeros((FAULTS, 4))
    faults[:, CLEAR_MS] = np.inf
    return faults


def check(faults: Sequence[Injected | None]) -> None:
    """Raise ValueError, a sentence for the user, for the first fault that this vehicle cannot have."""
    check_faults(faults, _IDS)
    for fault in faults:
        if fault is None:
            continue
        name, slash, kind = fault.id.partition("/")
        if slash and (name.partition(":")[0] != "motor" or kind not in _KINDS):
            raise ValueError(f"unknown fault {fault.id!r}; a kind may follow motor only: {', '.join(_KINDS)}")
        if fault.value is not None and not (name.startswith("motor") and fault.value <= TRAVEL_M):
            raise ValueError(f"fault {fault.id!r} cannot have the value {fault.value:g}; a motor takes up to {TRAVEL_M:g} m")
        if not (fault.onset_s >= 0.0 and math.isfinite(fault.onset_s)):
            raise ValueError(f"fault {fault.id!r} begins at {fault.onset_s:g} s; give seconds after release, >= 0")
        if fault.clear_s is not None and not fault.clear_s > fault.onset_s:
            raise ValueError(f"fault {fault.id!r} ends at {fault.clear_s:g} s, before it begins; give a later time")


def resolve(fault: Injected, sizes: config.Faults, chance: NDArray[np.float64]) -> Injected:
    """The fault with nothing left open: side and kind by even chance, value from its range.

    chance: (3,), uniform numbers of the flight for side, kind and value, drawn whether needed or not, so that a flight
    is the same with any fault.
    """
    name, _, kind = fault.id.partition("/")
    fault_class, _, side = name.partition(":")
    if fault_class == "crossed_lines":
        return fault
    side = side or ("left" if chance[0] < 0.5 else "right")
    if fault_class != "motor":
        return Injected(f"{fault_class}:{side}", fault.onset_s, None, fault.clear_s)
    kind = kind or ("stuck" if chance[1] < 0.5 else "saturation")
    low, high = sizes.stuck_m if kind == "stuck" else sizes.saturation_m
    value = fault.value if fault.value is not None else low + (high - low) * float(chance[2])
    return Injected(f"motor:{side}/{kind}", fault.onset_s, value, fault.clear_s)


def install(faults: NDArray[np.float64], fault: Injected) -> None:
    """Write a resolved fault into a flight's faults, (FAULTS, 4)."""
    name, _, kind = fault.id.partition("/")
    faults[_IDS.index(name)] = (
        _KINDS.get(kind, PRESENT),
        0.0 if fault.value is None else fault.value,
        round(fault.onset_s * 1000.0),
        np.inf if fault.clear_s is None else round(fault.clear_s * 1000.0),
    )


def installed(faults: NDArray[np.float64]) -> tuple[Injected, ...]:
    """The resolved faults in a flight's faults, (FAULTS, 4)."""
    kinds = {number: name for name, number in _KINDS.items()}
    return tuple(
        Injected(
            f"{name}/{kinds[row[KIND]]}" if row[KIND] in kinds else name,
            float(row[ONSET_MS]) / 1000.0,
            float(row[VALUE_M]) if row[KIND] in kinds else None,
            None if np.isinf(row[CLEAR_MS]) else float(row[CLEAR_MS]) / 1000.0,
        )
        for name, row in zip(_IDS, faults, strict=True)
        if row[KIND] != NONE
    )
