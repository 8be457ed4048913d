"""Detection and two-phase isolation of the parafoil paper, on smoothed residuals; when a verdict is taken back.

Arrays are (..., flight), worked flight by flight.  What a residual means is not known here: see monitor.py.
"""

import math

import numpy as np
from numpy.typing import NDArray

from fdi.parafoil.config import Paper
from fdi.parafoil.tables import FAULTS
from fdi.verdict import NO_FAULT, Phase

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

FIRST_LINE_FAULT = next(index for index, fault in enumerate(FAULTS) if fault.fault_class != "motor")

# Everything a step depends on; each array ends in the axis of flights.
STATE = (
    "phase", "fault", "confidence", "delay_s", "since", "motor_phase", "line_phase", "maxima", "quiet",
)  # fmt: skip


def smallest_left(maxima: FloatArray, thresholds: FloatArray) -> IntArray:
    """The line fault whose residual, over its threshold, stayed smallest among those not eliminated; -> (flight,).

    maxima: (hypothesis, flight) of the smoothed fault-specific residuals since detection, thresholds: (hypothesis,);
    0 broken left, 1 broken right, 2 crossed.  Where all are eliminated the answer means nothing (0).
    Source: parafoil paper, section 5.2; Eq. 27.
    """
    limits = thresholds[:, None]
    smallest: IntArray = np.argmin(np.where(maxima > limits, math.inf, maxima / limits), axis=0)
    return smallest


class TwoPhaseIsolation:
    """Phase, named fault and their clocks; `Phase.HEALTHY` until a detection (the monitor says when it is warming)."""

    def __init__(self, paper: Paper, period_s: float, flights: int) -> None:
        self._paper = paper
        self._motor_rows = round(paper.isolation.motor_phase_s / period_s)
        self._fallback_rows = round(paper.isolation.fallback_s / period_s)
        self._clear_rows = round(paper.isolation.clear_s / period_s)
        limits, share, delays = paper.thresholds, paper.confidence, paper.delays
        self._line_thresholds = np.array([limits.broken_rad2_s2, limits.broken_rad2_s2, limits.crossed_rad2_s2])
        broken, crossed = share.broken_line_by_elimination, share.crossed_lines_by_elimination
        self._by_elimination = np.array([broken, broken, crossed])
        self._by_size = np.array([share.broken_line_by_size, share.broken_line_by_size, share.crossed_lines_by_size])
        self._line_delays_s = np.array([delays.broken_line_s, delays.broken_line_s, delays.crossed_lines_s])
        n = flights
        self.phase = np.full(n, int(Phase.HEALTHY), dtype=np.int64)
        self.fault = np.full(n, NO_FAULT, dtype=np.int64)
        self.confidence = np.zeros(n)
        self.delay_s = np.full(n, math.nan)  # design delay of what is detected or named
        self.since = np.zeros(n)  # rows since detection
        self.motor_phase = np.zeros(n)  # of these, rows in which both motor residuals were known
        self.line_phase = np.zeros(n)  # of these, rows in which the heading-rate residuals were known
        self.maxima = np.zeros((3, n))  # smoothed fault-specific residuals since detection
        self.quiet = np.zeros(n)  # rows for which a verdict has not shown in its residual

    def clear(self, flights: IntArray) -> None:
        """Take back the verdict of these flights (indices)."""
        self.phase[flights] = Phase.HEALTHY
        self.fault[flights] = NO_FAULT
        self.confidence[flights] = 0.0
        self.delay_s[flights] = math.nan
        self.since[flights] = 0.0
        self.motor_phase[flights] = 0.0
        self.line_phase[flights] = 0.0
        self.maxima[:, flights] = 0.0
        self.quiet[flights] = 0.0

    def step(
        self,
        turn_known: BoolArray,
        motors_known: BoolArray,
        turn_mean: FloatArray,
        motor_mean: FloatArray,
        line_mean: FloatArray,
    ) -> None:
        """One row: the smoothed residuals of heading rate (flight,), motors (2, flight), line faults (3, flight).

        turn_known, motors_known: (flight,); where False the values are held ones, and nothing is concluded from them.
        Detection: Eqs. 6-7.  Isolation: sections 5.1 and 5.2 of the paper.
        """
        above = turn_mean > self._paper.thresholds.heading_rate_rad2_s2
        raised = self.phase != Phase.HEALTHY
        alarm = turn_known & above & ~raised
        if raised.any():
            self.since += raised
        if alarm.any():
            self.clear(np.flatnonzero(alarm))
            self.phase[alarm] = Phase.DETECTED
            self.delay_s[alarm] = self._paper.delays.any_s
        elif not raised.any():
            return
        named = np.flatnonzero(self.phase > Phase.DETECTED)
        open_ = np.flatnonzero(self.phase == Phase.DETECTED)
        if named.size:
            motors_above = np.maximum(motor_mean[0], motor_mean[1])[named] > self._paper.thresholds.motor_m
            self._take_back(named, turn_known[named], motors_known[named], above[named], motors_above)
        if open_.size:
            later = open_[~alarm[open_]]
            self.motor_phase[later] += motors_known[later]
            self.line_phase[later] += turn_known[later]
            seen = np.maximum(self.maxima[:, open_], line_mean[:, open_])
            self.maxima[:, open_] = np.where(turn_known[open_], seen, self.maxima[:, open_])
            self._isolate(open_, motors_known[open_], motor_mean[:, open_])

    def _take_back(
        self, named: IntArray, turn_known: BoolArray, motors_known: BoolArray, above: BoolArray, motors_above: BoolArray
    ) -> None:
        """Clear what has not shown for clear_s: a motor in the motor residuals, all else in the heading rate."""
        is_motor = (self.fault[named] >= 0) & (self.fault[named] < FIRST_LINE_FAULT)
        known = np.where(is_motor, motors_known, turn_known)
        shows = np.where(is_motor, motors_above, above)
        quiet = np.where(shows, 0.0, self.quiet[named] + 1.0)
        self.quiet[named] = np.where(known, quiet, self.quiet[named])
        cleared = named[self.quiet[named] >= self._clear_rows]
        if cleared.size:
            self.clear(cleared)

    def _isolate(self, flights: IntArray, motors_known: BoolArray, motor_mean: FloatArray) -> None:
        """Name a motor in the first phase; then a line by elimination, at last by size; or nothing, if all are eliminated.

        flights: indices of the detected; the rest is theirs alone.  While a motor residual is unknown no line is named:
        the motor might be it.
        """
        maxima, motor_rows = self.maxima[:, flights], self.motor_phase[flights]
        larger = np.where(motor_mean[1] > motor_mean[0], 1, 0)
        exceeds = np.maximum(motor_mean[0], motor_mean[1]) > self._paper.thresholds.motor_m
        motor: BoolArray = motors_known & exceeds & (motor_rows <= self._motor_rows)
        left = maxima <= self._line_thresholds[:, None]
        count = left[0].astype(np.int64) + left[1] + left[2]
        lines: BoolArray = ~motor & motors_known & (motor_rows >= self._motor_rows)
        by_elimination: BoolArray = lines & (count == 1)
        by_size: BoolArray = lines & (count > 1) & (self.line_phase[flights] >= self._fallback_rows)
        inconclusive: BoolArray = lines & (count == 0)
        self.phase[flights[inconclusive]] = Phase.INCONCLUSIVE
        line = smallest_left(maxima, self._line_thresholds)
        fault: IntArray = np.where(motor, larger, FIRST_LINE_FAULT + line)
        of_lines = np.where(by_elimination, self._by_elimination[line], self._by_size[line])
        confidence: FloatArray = np.where(motor, self._paper.confidence.motor, of_lines)
        delay_s: FloatArray = np.where(motor, self._paper.delays.motor_s, self._line_delays_s[line])
        named: BoolArray = motor | by_elimination | by_size
        at = np.flatnonzero(named)
        self.phase[flights[at]] = Phase.ISOLATED
        self.fault[flights[at]] = fault[at]
        self.confidence[flights[at]] = confidence[at]
        self.delay_s[flights[at]] = delay_s[at]
