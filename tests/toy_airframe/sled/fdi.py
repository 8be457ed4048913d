"""Fault detection and isolation for the sled: is it as fast as its thruster was told to make it?

A nominal sled follows the commanded speed with a first-order lag; how far the measured speed stays from it is the residual.
A sled that is too slow has lost thrust; one that is too fast is wrong in a way that no hypothesis here explains.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi.kernel import Compiler
from fdi.verdict import NO_FAULT, Fault, Phase, Signature, Verdict
from fdi.windows import MovingAverage

CHANNELS = ("armed", "velocity_north_m_s", "output_1_us")
PARAMETERS = ("SERVO1_FUNCTION",)
FAULTS = (Fault("thruster_loss", "thruster_loss", None, "thruster has lost thrust", "1"),)  # size: the share lost
RESIDUALS = (
    "speed",  # m/s, how far off the nominal sled
    "surplus",  # m/s, how much faster than it
)
SIGNALS = ("speed_command_m_s", "speed_m_s")
SIGNATURES = (Signature("thruster_loss", {"speed": "+", "surplus": "0"}),)

ARMED, SPEED, OUTPUT = range(3)
# What lies outside is no measurement: unknown, like NaN.  A pulse of zero: the output is not driven.
LOW, HIGH = np.array([0.0, -100.0, 500.0]), np.array([1.0, 100.0, 2500.0])
THRUSTER_LOSS = 0  # index into FAULTS
STAMP_TOLERANCE_S = 5e-7  # half the resolution of a stamp
STATE = ("function", "nominal_m_s", "unknown_rows", "phase", "fault", "since_rows", "quiet_rows")

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Config:
    """The `[monitor]` table."""

    period_s: float
    gap_s: float
    function_throttle: int
    zero_us: float
    speed_m_s_per_us: float
    time_constant_s: float
    window_s: float
    speed_threshold_m_s: float
    surplus_threshold_m_s: float
    confirm_s: float
    clear_s: float
    confidence: float
    delay_s: float

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} = {getattr(self, name)} must be a number above 0")
        if self.confidence > 1.0:
            raise ValueError(f"confidence = {self.confidence} is no share; give at most 1")
        if self.clear_s < self.window_s:
            raise ValueError(f"clear_s = {self.clear_s} must not be shorter than window_s = {self.window_s}")


class Monitor:
    """Sleds side by side; one row of the grid a step.

    `Verdict.confidence` is the share of simulated flights in which the naming was right, half of them healthy.  `size` is
    the share of thrust lost, over the window of the residual; `onset_s` the time since detection plus the median delay.
    """

    def __init__(self, config: Config, flights: int, compiler: Compiler | None = None) -> None:
        """Raises ValueError if flights is below 1."""
        if flights < 1:
            raise ValueError(f"flights = {flights}: a batch has at least one flight")
        self.config = config
        self.flights = flights
        self._share = 1.0 - math.exp(-config.period_s / config.time_constant_s)
        self._gap_rows = config.gap_s / config.period_s + 0.5
        self.function = np.full(flights, float(config.function_throttle))  # until told: the normal one
        self.nominal_m_s = np.full(flights, math.nan)  # NaN: not begun
        self.unknown_rows = np.full(flights, math.inf)  # rows since the residuals were known
        self.phase = np.full(flights, int(Phase.HEALTHY), dtype=np.int64)
        self.fault = np.full(flights, NO_FAULT, dtype=np.int64)
        self.since_rows = np.zeros(flights)  # since detection
        self.quiet_rows = np.zeros(flights)  # below the threshold since
        # Three blocks of flights: distance from the nominal speed, surplus over it, and the nominal speed itself.
        self.window = MovingAverage(3 * flights, max(1, round(config.window_s / config.period_s)))

    @property
    def state(self) -> dict[str, FloatArray]:
        """Everything the next step depends on: copies, (flight, ...), by name.  Assigning such a dict resumes there.

        Assigning a dict with other names or shapes raises ValueError.
        """
        return {name: array.astype(np.float64) for name, array in self._arrays().items()}

    @state.setter
    def state(self, state: Mapping[str, FloatArray]) -> None:
        arrays = self._arrays()
        if {name: array.shape for name, array in state.items()} != {name: array.shape for name, array in arrays.items()}:
            raise ValueError("the state is not one of this monitor: names or shapes differ")
        for name, array in arrays.items():
            array[...] = state[name]

    def _arrays(self) -> dict[str, NDArray[np.float64] | NDArray[np.int64]]:
        """Views of all state, flights first."""
        arrays: dict[str, NDArray[np.float64] | NDArray[np.int64]] = {name: getattr(self, name) for name in STATE}
        for name, part in (("ring", self.window.ring), ("sum", self.window.turn_sum), ("cursor", self.window.cursor)):
            arrays[f"window_{name}"] = np.moveaxis(part.reshape(3, self.flights, *part.shape[1:]), 1, 0)
        return arrays

    def told(self, flight: int, parameters: Mapping[str, float]) -> None:
        """Take note of the function of output 1: while it is not the throttle, nothing is judged."""
        function = parameters.get(PARAMETERS[0], self.function[flight])
        if function != self.function[flight]:
            self.function[flight] = function
            self._forget(np.array([flight]))

    def step(self, values: FloatArray, age_s: FloatArray) -> Verdict:
        """Judge one row of the grid: values and age_s, (flight, channel) in the order of CHANNELS.

        Raises ValueError on a wrong shape.
        """
        shape = (self.flights, len(CHANNELS))
        if values.shape != shape or age_s.shape != shape:
            raise ValueError(f"values have shape {values.shape}, age_s {age_s.shape}; this monitor takes {shape} of both")
        known = (values >= LOW) & (values <= HIGH)
        armed = known[:, ARMED] & (values[:, ARMED] > 0.5)
        idle = known[:, ARMED] & ~armed
        if idle.any():
            self._forget(np.flatnonzero(idle))
        command_m_s = np.where(known[:, OUTPUT], self._speed_m_s(values[:, OUTPUT]), math.nan)
        speed_m_s = np.where(known[:, SPEED], values[:, SPEED], math.nan)
        fresh = age_s[:, SPEED] < self.config.period_s - STAMP_TOLERANCE_S  # each measurement counts once
        self._compare(armed & (self.function == self.config.function_throttle), command_m_s, speed_m_s, fresh)
        means = self.window.mean().reshape(3, -1)
        judged = self.unknown_rows <= self._gap_rows
        self._decide(judged, means[0] > self.config.speed_threshold_m_s, means[1] > self.config.surplus_threshold_m_s)
        isolated = self.phase == Phase.ISOLATED
        size = np.full(self.flights, math.nan)
        np.divide(-means[1], means[2], out=size, where=isolated & judged & (means[2] > 0.0))
        return Verdict(
            phase=np.where(judged | (self.phase != Phase.HEALTHY), self.phase, int(Phase.WARMING)),
            fault=self.fault.copy(),
            confidence=np.where(isolated, self.config.confidence, 0.0),
            size=np.minimum(np.maximum(size, 0.0), 1.0),
            onset_s=np.where(
                self.phase == Phase.HEALTHY, math.nan, self.since_rows * self.config.period_s + self.config.delay_s
            ),
            residuals=np.where(judged[:, None], means[:2].T, math.nan),
            thresholds=np.array([self.config.speed_threshold_m_s, self.config.surplus_threshold_m_s]),
            signals=np.stack((command_m_s, speed_m_s), axis=1),
        )

    def _speed_m_s(self, output_us: FloatArray) -> FloatArray:
        return np.maximum((output_us - self.config.zero_us) * self.config.speed_m_s_per_us, 0.0)

    def _compare(
        self, judged: NDArray[np.bool_], command_m_s: FloatArray, speed_m_s: FloatArray, fresh: NDArray[np.bool_]
    ) -> None:
        """Let the nominal sleds follow their commands, and put the measured ones beside them; all (flight,)."""
        commanded = judged & ~np.isnan(command_m_s)
        begins = commanded & ~np.isnan(speed_m_s) & np.isnan(self.nominal_m_s)
        followed_m_s = self.nominal_m_s + self._share * (command_m_s - self.nominal_m_s)
        self.nominal_m_s = np.where(begins, speed_m_s, np.where(commanded, followed_m_s, self.nominal_m_s))
        taken = commanded & fresh & ~np.isnan(speed_m_s)
        surplus_m_s = np.where(taken, speed_m_s - self.nominal_m_s, math.nan)
        nominal_m_s = np.where(taken, self.nominal_m_s, math.nan)
        self.window.push(np.concatenate((np.abs(surplus_m_s), surplus_m_s, nominal_m_s)))
        self.unknown_rows = np.where(taken, 0.0, self.unknown_rows + 1.0)
        lost = (self.unknown_rows > self._gap_rows) & ~np.isnan(self.nominal_m_s)
        if lost.any():
            self._restart(np.flatnonzero(lost))

    def _decide(self, judged: NDArray[np.bool_], above: NDArray[np.bool_], too_fast: NDArray[np.bool_]) -> None:
        """Alarm, naming after confirm_s, and clearing after clear_s below the threshold; all (flight,)."""
        raised = self.phase != Phase.HEALTHY
        self.since_rows = np.where(raised, self.since_rows + 1.0, 0.0)
        self.phase[judged & above & ~raised] = Phase.DETECTED
        self.quiet_rows = np.where(judged, np.where(raised & ~above, self.quiet_rows + 1.0, 0.0), self.quiet_rows)
        confirmed = (self.phase == Phase.DETECTED) & judged & above
        confirmed &= self.since_rows * self.config.period_s >= self.config.confirm_s - STAMP_TOLERANCE_S
        self.phase[confirmed & too_fast] = Phase.INCONCLUSIVE
        self.phase[confirmed & ~too_fast] = Phase.ISOLATED
        self.fault[confirmed & ~too_fast] = THRUSTER_LOSS
        cleared = np.flatnonzero(self.quiet_rows * self.config.period_s >= self.config.clear_s - STAMP_TOLERANCE_S)
        if cleared.size:
            self._take_back(cleared)

    def _take_back(self, flights: NDArray[np.int64]) -> None:
        self.phase[flights] = Phase.HEALTHY
        self.fault[flights] = NO_FAULT
        self.since_rows[flights] = 0.0
        self.quiet_rows[flights] = 0.0

    def _restart(self, flights: NDArray[np.int64]) -> None:
        """The nominal sled begins anew where the next measurement finds the real one."""
        self.nominal_m_s[flights] = math.nan
        for block in range(3):
            self.window.empty(flights + block * self.flights)

    def _forget(self, flights: NDArray[np.int64]) -> None:
        """Back to before arming; the function of the output stays as told."""
        self._restart(flights)
        self._take_back(flights)
        self.unknown_rows[flights] = math.inf
