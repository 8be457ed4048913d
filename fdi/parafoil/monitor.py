"""The monitor of the parafoil paper: heading-rate detection, motor residuals, fault-specific observers.

Inside, arrays are (..., flight) and every operation goes element by element over the flights, so that a flight has the
same bits alone and in company.  The equations are the paper's; the choices it leaves open are in docs/parafoil_method.md.
"""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from fdi.ekf import HEADING_RATE, WIND_EAST, WIND_NORTH
from fdi.observer import observer_output, observer_step
from fdi.parafoil.config import Config
from fdi.parafoil.isolation import STATE as ISOLATION_STATE
from fdi.parafoil.isolation import TwoPhaseIsolation
from fdi.parafoil.tables import CHANNELS, LIMITS, PARAMETERS
from fdi.verdict import Phase, Verdict
from fdi.windows import MovingAverage

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
StateArray = FloatArray | BoolArray | IntArray

HYPOTHESES = ("healthy", "broken_left", "broken_right", "crossed")  # the bank of heading-rate observers
STAMP_TOLERANCE_S = 5e-7  # half the resolution of a stamp

_AT = {name: index for index, name in enumerate(CHANNELS)}
ARMED, NORTH, EAST, ALTITUDE = (_AT[name] for name in CHANNELS[:4])
OUTPUTS = slice(_AT["output_1_us"], _AT["output_2_us"] + 1)
ENCODERS = slice(_AT["wheel_distance_1_m"], _AT["wheel_distance_2_m"] + 1)
WIND = slice(_AT["wind_speed_m_s"], _AT["wind_direction_rad"] + 1)
GYRO = [_AT[name] for name in ("yaw_rate_rad_s", "pitch_rate_rad_s", "roll_rad", "pitch_rad")]
TURN_COMMAND = _AT["turn_rate_command_rad_s"]
LOW, HIGH = (np.array([LIMITS[name][end] for name in CHANNELS])[:, None] for end in (0, 1))

# Everything a step depends on, besides the three windows; each array ends in the axis of flights.
STATE = (
    "running", "seen_unarmed", "unsettled", "functions", "forecast_m_s", "fix_ago_s", "air", "covariance",
    "motor_m", "command_gap", "observers", "warm_up", "turn_ago", "motor_ago",
)  # fmt: skip


class Parafoil:
    """The paper's monitor over a batch of flights; one row of the grid a step.

    `Verdict.confidence` is the share of the design flights in which that way of naming that class was right, a fifth of
    them healthy; 0 while no fault is named.  `size` is always unknown: the method does not measure it.  `onset_s` is the
    time since detection plus the median delay of detection in the design flights.
    """

    def __init__(self, config: Config, flights: int) -> None:
        """flights: length of the batch's leading axis.  Raises ValueError if it is below 1."""
        if flights < 1:
            raise ValueError(f"flights = {flights}: a batch has at least one flight")
        self.config = config
        self.flights = flights
        self._derive()
        n = flights
        self.functions = np.empty((2, n))
        self.functions[0] = config.outputs.function_left  # until told: the normal assignment
        self.functions[1] = config.outputs.function_right
        self._assign()
        self.running = np.zeros(n, dtype=np.bool_)
        self.seen_unarmed = np.zeros(n, dtype=np.bool_)  # so that arming is release, not a start in mid-flight
        self.unsettled = np.zeros(n, dtype=np.bool_)  # started without a forecast, wind not yet found
        self.forecast_m_s = np.full((2, n), math.nan)  # north, east
        self.fix_ago_s = np.full(n, math.inf)  # age of the newest fix
        self.air = np.zeros((5, n))  # state of the wind and heading filter
        self.covariance = np.zeros((5, 5, n))
        self.motor_m = np.zeros((2, n))  # nominal motors, by output
        self.command_gap = np.zeros(n)  # rows without the commands of both outputs
        self.observers = np.zeros((4, 4, n))  # state, hypothesis, flight
        self.warm_up = np.zeros(n)  # rows still to wait
        self.turn_ago = np.full(n, math.inf)  # rows since a heading-rate residual was known
        self.motor_ago = np.full((2, n), math.inf)  # likewise each motor residual
        self.isolation = TwoPhaseIsolation(config.paper, config.period_s, n)
        windows = config.paper.windows
        self.heading_rate = MovingAverage(n, self._rows(windows.heading_rate_s))
        self.motors = MovingAverage(2 * n, self._rows(windows.motor_s))
        self.fault_specific = MovingAverage(3 * n, self._rows(windows.fault_specific_s))

    def _rows(self, seconds: float) -> int:
        return max(1, round(seconds / self.config.period_s))

    def _derive(self) -> None:
        """Constants of the step, from the configuration."""
        config = self.config
        model = config.lateral_model
        self._motor_share = 1.0 - math.exp(-config.period_s / config.motor.lag_s)
        self._motor_step_m = config.motor.rate_m_s * config.period_s
        self._transition = np.array(config.observer.transition)
        self._input = np.array(config.observer.input)
        self._feedback = np.array(config.observer.feedback)
        self._output = np.array(model.output)
        steady = -np.linalg.solve(np.array(model.dynamics), np.array(model.input))  # state per metre held for ever
        self._gain = float(self._output @ steady)
        self._steady_turn = steady / self._gain  # state of a steady turn, per rad/s
        self._gap_rows = config.gap_s / config.period_s + 0.5
        limits = config.paper.thresholds
        self._thresholds = np.array(
            [
                limits.heading_rate_rad2_s2,
                limits.motor_m,
                limits.motor_m,
                limits.broken_rad2_s2,
                limits.broken_rad2_s2,
                limits.crossed_rad2_s2,
            ]
        )

    @property
    def state(self) -> dict[str, FloatArray]:
        """Everything the next step depends on: copies, (flight, ...), by name.  Assigning such a dict resumes there.

        Assigning a dict with other names or shapes raises ValueError.
        """
        return {name: np.moveaxis(array, -1, 0).astype(np.float64) for name, array in self._arrays().items()}

    @state.setter
    def state(self, state: Mapping[str, FloatArray]) -> None:
        arrays = self._arrays()
        shapes = {name: (self.flights, *array.shape[:-1]) for name, array in arrays.items()}
        if {name: array.shape for name, array in state.items()} != shapes:
            raise ValueError("the state is not one of this monitor: names or shapes differ")
        for name, array in arrays.items():
            array[...] = np.moveaxis(state[name], 0, -1)
        self._assign()

    def _arrays(self) -> dict[str, StateArray]:
        """Views of all state, by name; flights are the last axis."""
        arrays: dict[str, StateArray] = {name: getattr(self, name) for name in STATE}
        arrays |= {name: getattr(self.isolation, name) for name in ISOLATION_STATE}
        windows = (("turn", self.heading_rate), ("motor", self.motors), ("line", self.fault_specific))
        for name, window in windows:
            for part, array in (("ring", window.ring), ("turn_sum", window.turn_sum), ("cursor", window.cursor)):
                arrays[f"{name}_window_{part}"] = np.moveaxis(array.reshape(-1, self.flights, *array.shape[1:]), 1, -1)
        return arrays

    def told(self, flight: int, parameters: Mapping[str, float]) -> None:
        """Take note of the output functions that the vehicle itself reports; both, or the one that is known.

        Motors and encoders go by output, turns by function: after a swap the left toggle is on output 2.  A swap is taken
        as the mending of crossed lines, so that the left function still pulls the left edge.  On a change the observers
        begin anew, the windows are emptied, a verdict is taken back and turns are not judged for the time of a warm-up,
        which the vehicle needs to leave the spiral that a crossed one flies; the wind and heading filter goes on.
        """
        told = np.array([parameters.get(name, self.functions[i, flight]) for i, name in enumerate(PARAMETERS)])
        if np.array_equal(told, self.functions[:, flight], equal_nan=True):
            return
        self.functions[:, flight] = told
        self._assign()
        flights = np.array([flight])
        self._restart_turns(flights)
        self.warm_up[flights] = self._rows(self.config.warm_up_s)  # leaving a spiral is beyond the linear model
        self._forget_motors(flights)
        self.isolation.clear(flights)

    def step(self, values: FloatArray, age_s: FloatArray) -> Verdict:
        """Judge one row of the grid: values and age_s, (flight, channel) in the order of CHANNELS.

        A value that is NaN or beyond its limits is unknown.  Raises ValueError on a wrong shape.
        """
        shape = (self.flights, len(CHANNELS))
        if values.shape != shape or age_s.shape != shape:
            raise ValueError(f"values have shape {values.shape}, age_s {age_s.shape}; this monitor takes {shape} of both")
        row = np.ascontiguousarray(values.T)
        age = np.ascontiguousarray(age_s.T)
        known = (row >= LOW) & (row <= HIGH) & (age < math.inf)
        age = np.where(known, age, 0.0)
        fresh = known & (age < self.config.period_s - STAMP_TOLERANCE_S)
        self._arm(row, known)
        self._navigate(row, age, known, fresh)
        commanded = self._move_motors(row, age, known)
        turn_known = self._observe(commanded & known[ARMED])
        self._compare_motors(row, fresh)
        turn_mean, motor_mean = self.heading_rate.mean(), self.motors.mean().reshape(2, -1)
        line_mean = self.fault_specific.mean().reshape(3, -1)
        motors_known: BoolArray = (self.motor_ago[0] <= self._gap_rows) & (self.motor_ago[1] <= self._gap_rows)
        self.isolation.step(turn_known, motors_known, turn_mean, motor_mean, line_mean)
        return self._verdict(row, known, turn_mean, motor_mean, line_mean)

    def _arm(self, row: FloatArray, known: BoolArray) -> None:
        """Reset what is not armed, start what is; remember the wind that is reported up to the first fix."""
        armed = row[ARMED] > 0.5
        idle = known[ARMED] & ~armed
        if idle.any():
            self.seen_unarmed |= idle
            landed = np.flatnonzero(idle & self.running)
            if landed.size:
                self._reset(landed)
        start = known[ARMED] & armed & ~self.running
        if start.any():
            flights = np.flatnonzero(start)
            self.running[flights] = True
            self._restart_motors(flights, row, known)
        waiting = np.isinf(self.fix_ago_s)
        if waiting.any():
            # After release the vehicle reports its own estimate, no longer the forecast: the first value is kept.
            take = waiting & known[WIND].all(axis=0) & (~self.running | np.isnan(self.forecast_m_s[0]))
            flights = np.flatnonzero(take)
            speed_m_s, direction_rad = row[WIND][:, flights]
            self.forecast_m_s[0, flights] = -speed_m_s * np.cos(direction_rad)
            self.forecast_m_s[1, flights] = -speed_m_s * np.sin(direction_rad)

    def _reset(self, flights: IntArray) -> None:
        """Back to before release; the functions of the outputs stay as told."""
        self.running[flights] = False
        self.unsettled[flights] = False
        self.forecast_m_s[:, flights] = math.nan
        self.fix_ago_s[flights] = math.inf
        self.air[:, flights] = 0.0
        self.covariance[..., flights] = 0.0
        self.motor_m[:, flights] = 0.0
        self.command_gap[flights] = 0.0
        self.warm_up[flights] = 0.0
        self._restart_turns(flights)
        self._forget_motors(flights)
        self.isolation.clear(flights)

    def _restart_turns(self, flights: IntArray) -> None:
        """Observers into the steady turn that the filter sees (to rest in straight flight), their windows empty.

        From rest a vehicle found in a spiral would look faulty for as long as the observers need to follow.
        """
        self.observers[..., flights] = self._steady_turn[:, None, None] * self.air[HEADING_RATE, flights]
        self.turn_ago[flights] = math.inf
        self.isolation.quiet[flights] = 0.0
        self.heading_rate.empty(flights)
        for hypothesis in range(3):
            self.fault_specific.empty(flights + hypothesis * self.flights)

    def _forget_motors(self, flights: IntArray) -> None:
        self.motor_ago[:, flights] = math.inf
        for output in range(2):
            self.motors.empty(flights + output * self.flights)

    def _restart_motors(self, flights: IntArray, row: FloatArray, known: BoolArray) -> None:
        """The nominal motors begin where the encoders are; where these are unknown, where the commands are."""
        commanded_m = np.where(known[OUTPUTS][:, flights], self._pull_m(row[OUTPUTS][:, flights]), 0.0)
        self.motor_m[:, flights] = np.where(known[ENCODERS][:, flights], row[ENCODERS][:, flights], commanded_m)

    def _pull_m(self, output_us: FloatArray) -> FloatArray:
        outputs = self.config.outputs
        pull_m = (output_us - outputs.zero_us) * outputs.pull_m_per_us
        return np.minimum(np.maximum(pull_m, 0.0), self.config.motor.travel_m)

    def _navigate(self, row: FloatArray, age: FloatArray, known: BoolArray, fresh: BoolArray) -> None:
        """Wind and heading filter: each new fix (velocity and altitude) once, with the time since the one before."""
        self.fix_ago_s += self.config.period_s
        elapsed_s = self.fix_ago_s - age[NORTH]
        new = fresh[NORTH] & fresh[EAST] & known[ALTITUDE] & self.running & (elapsed_s > STAMP_TOLERANCE_S)
        if not new.any():
            return
        first = new & (elapsed_s > self.config.gap_s + STAMP_TOLERANCE_S)
        if first.any():
            self._start_navigation(np.flatnonzero(first), row)
            new &= ~first
            self.fix_ago_s[first] = age[NORTH][first]
        if new.all():
            self.config.navigation.predict(self.air, self.covariance, elapsed_s, row[ALTITUDE])
            self.config.navigation.update(self.air, self.covariance, row[NORTH : EAST + 1])
            self.fix_ago_s[...] = age[NORTH]
        elif new.any():
            flights = np.flatnonzero(new)
            air, covariance = self.air[:, flights], self.covariance[..., flights]
            self.config.navigation.predict(air, covariance, elapsed_s[flights], row[ALTITUDE][flights])
            self.config.navigation.update(air, covariance, row[NORTH : EAST + 1][:, flights])
            self.air[:, flights], self.covariance[..., flights] = air, covariance
            self.fix_ago_s[flights] = age[NORTH][flights]
        if self.unsettled.any():
            limit = self.config.settled_wind_variance_m2_s2
            settled = (self.covariance[WIND_NORTH, WIND_NORTH] < limit) & (self.covariance[WIND_EAST, WIND_EAST] < limit)
            self.unsettled &= ~settled

    def _start_navigation(self, flights: IntArray, row: FloatArray) -> None:
        """First fix after release, after a start in mid-flight, or after a gap; then the wind found before it is kept."""
        navigation = self.config.navigation
        again = np.isfinite(self.fix_ago_s[flights])
        forecast_m_s = self.forecast_m_s[:, flights]
        calm = np.where(again, self.unsettled[flights], np.isnan(forecast_m_s[0]))
        wind_m_s = np.where(again, self.air[WIND_NORTH : WIND_EAST + 1, flights], np.where(calm, 0.0, forecast_m_s))
        variance = np.where(calm, navigation.start_calm_variance_m2_s2, navigation.start_wind_variance_m2_s2)
        velocity_m_s = row[NORTH : EAST + 1][:, flights]
        air, covariance = navigation.start(wind_m_s, variance, velocity_m_s, row[ALTITUDE][flights])
        self.air[:, flights], self.covariance[..., flights] = air, covariance
        self.unsettled[flights] = calm
        # At release the vehicle glides straight and the observers are right at rest; in mid-flight they have to settle.
        at_rest = self.seen_unarmed[flights] & ~again & ~calm
        self.warm_up[flights] = np.where(at_rest, 0, self._rows(self.config.warm_up_s))
        self._restart_turns(flights)

    def _move_motors(self, row: FloatArray, age: FloatArray, known: BoolArray) -> BoolArray:
        """Nominal motors follow this sample's commands; -> (flight,), where both commands are known."""
        usable = known[OUTPUTS] & (age[OUTPUTS] <= self.config.gap_s + STAMP_TOLERANCE_S)
        both: BoolArray = usable[0] & usable[1]
        back = both & (self.command_gap > self._gap_rows)
        if back.any():
            flights = np.flatnonzero(back)
            self._restart_motors(flights, row, known)
            self._restart_turns(flights)
            self.warm_up[flights] = self._rows(self.config.warm_up_s)
        self.command_gap = np.where(both, 0.0, self.command_gap + 1.0)
        step_m = (self._pull_m(row[OUTPUTS]) - self.motor_m) * self._motor_share
        step_m = np.minimum(np.maximum(step_m, -self._motor_step_m), self._motor_step_m)
        self.motor_m += np.where(usable & self.running, step_m, 0.0)
        return both

    def _observe(self, inputs_known: BoolArray) -> BoolArray:
        """Observers of all hypotheses and their squared residuals (Eqs. 8-13, 18-26); -> (flight,), where one was taken."""
        left_m = np.where(self._swapped, self.motor_m[1], self.motor_m[0])
        right_m = np.where(self._swapped, self.motor_m[0], self.motor_m[1])
        healthy_m = right_m - left_m
        inputs_m = np.stack((healthy_m, right_m, -left_m, -healthy_m))
        turn_rate_rad_s = self.air[HEADING_RATE]  # held between fixes, 0 before the first
        self.observers = observer_step(
            self.observers, self._transition, self._input, self._feedback, inputs_m, turn_rate_rad_s
        )
        error_rad_s = observer_output(self.observers, self._output) - turn_rate_rad_s
        seen = inputs_known & self.running & (self.fix_ago_s <= self.config.gap_s + STAMP_TOLERANCE_S)
        taken: BoolArray = seen & (self.warm_up == 0.0) & ~self.unsettled & self._assigned
        self.warm_up -= seen & (self.warm_up > 0.0)
        self.turn_ago = np.where(taken, 0.0, self.turn_ago + 1.0)
        if taken.any():
            residual = np.where(taken, error_rad_s * error_rad_s, math.nan)
            self.heading_rate.push(residual[0])
            self.fault_specific.push(residual[1:].reshape(-1))
        return taken

    def _compare_motors(self, row: FloatArray, fresh: BoolArray) -> None:
        """Motor residuals (Eqs. 16-17), where command and encoder are this sample's."""
        taken = fresh[OUTPUTS] & fresh[ENCODERS] & self.running
        self.motor_ago = np.where(taken, 0.0, self.motor_ago + 1.0)
        if taken.any():
            self.motors.push(np.where(taken, np.abs(self.motor_m - row[ENCODERS]), math.nan).reshape(-1))

    def _assign(self) -> None:
        """Which function stands on which output, from what was told."""
        outputs = self.config.outputs
        first, second = self.functions
        self._swapped = (first == outputs.function_right) & (second == outputs.function_left)
        self._assigned = self._swapped | ((first == outputs.function_left) & (second == outputs.function_right))

    def _verdict(
        self, row: FloatArray, known: BoolArray, turn_mean: FloatArray, motor_mean: FloatArray, line_mean: FloatArray
    ) -> Verdict:
        turn_held = (self.turn_ago <= self._gap_rows) & (self.fix_ago_s <= self.config.gap_s + STAMP_TOLERANCE_S)
        residuals = np.empty((self.flights, self._thresholds.size))
        residuals[:, 0] = np.where(turn_held, turn_mean, math.nan)
        residuals[:, 1:3] = np.where(self.motor_ago <= self._gap_rows, motor_mean, math.nan).T
        residuals[:, 3:] = np.where(turn_held, line_mean, math.nan).T
        decided = self.isolation
        return Verdict(
            phase=np.where(turn_held | (decided.phase != Phase.HEALTHY), decided.phase, Phase.WARMING),
            fault=decided.fault.copy(),
            confidence=decided.confidence.copy(),
            size=np.full(self.flights, math.nan),
            onset_s=decided.since * self.config.period_s + decided.delay_s,
            residuals=residuals,
            thresholds=self._thresholds.copy(),
            signals=self._signals(row, known),
        )

    def _signals(self, row: FloatArray, known: BoolArray) -> FloatArray:
        """Turn rate as commanded and as flown, rad/s, (flight, signal); NaN where unknown."""
        signals = np.empty((self.flights, 2))
        command = np.where(known[TURN_COMMAND], row[TURN_COMMAND], math.nan)
        if not known[TURN_COMMAND].all():
            pull_m = np.where(known[OUTPUTS], self._pull_m(row[OUTPUTS]), math.nan)
            right_less_left_m = np.where(self._swapped, pull_m[0] - pull_m[1], pull_m[1] - pull_m[0])
            toggled = np.where(self._assigned, self._gain * right_less_left_m, math.nan)
            command = np.where(known[TURN_COMMAND], command, toggled)
        signals[:, 0] = command
        yaw_rate_rad_s, pitch_rate_rad_s, roll_rad, pitch_rad = np.where(known[GYRO], row[GYRO], math.nan)
        sin, cos = np.sin(roll_rad), np.cos(roll_rad)
        turn_rate = (pitch_rate_rad_s * sin + yaw_rate_rad_s * cos) / np.cos(pitch_rad)
        estimated = np.where(self.fix_ago_s <= self.config.gap_s + STAMP_TOLERANCE_S, self.air[HEADING_RATE], math.nan)
        signals[:, 1] = np.where(np.isnan(turn_rate), estimated, turn_rate)
        return signals
