"""The parafoil paper's figures from flights of ours: distributions of maxima, the trade-off, and four example flights."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import fdi.parafoil as detector
from companion.airframe import Airframe
from companion.campaign import grid
from companion.compiler import compiler
from fdi.thresholds import Rates, TradeOff, cumulative
from fdi.verdict import Phase
from sitl.ensemble import Ensemble
from sitl.vehicle import Injected

FloatArray = NDArray[np.float64]

EXAMPLES = (  # as in the paper's figures 8, 15, and 16 to 18
    Injected("motor:right/stuck", 126.0, 0.863),
    Injected("motor:left/stuck", 160.0, 1.295),
    Injected("broken_line:left", 193.0),
)
SEEDS_AN_EXAMPLE = 6  # the first of them that is detected and named rightly is shown
SHOWN_S = 90.0  # of flight after the onset
OUTPUTS = [detector.CHANNELS.index(f"output_{n}_us") for n in (1, 2)]
ENCODERS = [detector.CHANNELS.index(f"wheel_distance_{n}_m") for n in (1, 2)]
RESIDUAL_UNIT = "(rad/s)²"


@dataclass(frozen=True, slots=True)
class Example:
    """One flight; all times in s since release."""

    seed: int
    fault: Injected
    t_s: FloatArray  # (row,)
    commanded_m: FloatArray  # (row, output)
    measured_m: FloatArray  # (row, output)
    residuals: FloatArray  # (row, residual)
    thresholds: FloatArray  # (residual,)
    detected_s: float
    isolated_s: float


def fly_examples(airframe: Airframe, first_seed: int) -> list[Example]:
    """The flights of EXAMPLES, each with the first of some seeds that ends well, as the paper shows successes.

    Raises ValueError if none of the seeds does.
    """
    simulator = airframe.load_simulator()
    faults = [fault for fault in EXAMPLES for _ in range(SEEDS_AN_EXAMPLE)]
    seeds = list(range(first_seed, first_seed + len(faults)))
    fleet = simulator.Fleet(airframe.simulator_config(simulator), seeds, faults)
    monitor = airframe.monitor(flights=len(seeds), compiler=compiler())
    assert isinstance(monitor, detector.Parafoil)  # these are figures of the paper's method
    outputs = monitor.config.outputs
    duration_s = max(fault.onset_s for fault in faults) + SHOWN_S
    rows, verdicts = [], []
    for row in Ensemble(simulator.VEHICLE, fleet, seeds, grid(airframe)).rows(duration_s):
        verdict = monitor.step(row.values, row.age_s)
        if row.t_us >= 0:
            rows.append(row)
            verdicts.append(verdict)
    t_s = np.array([row.t_us for row in rows]) / 1e6
    phase = np.array([verdict.phase for verdict in verdicts])  # (row, flight)
    named = np.array([verdict.fault for verdict in verdicts])
    found: list[Example] = []
    for e, fault in enumerate(EXAMPLES):
        truth = [each.id for each in detector.FAULTS].index(fault.id.partition("/")[0])
        for f in range(e * SEEDS_AN_EXAMPLE, (e + 1) * SEEDS_AN_EXAMPLE):
            alarm, name = phase[:, f] >= Phase.DETECTED, phase[:, f] == Phase.ISOLATED
            if not name.any() or t_s[alarm.argmax()] <= fault.onset_s or named[name.argmax(), f] != truth:
                continue
            values = np.array([row.values[f] for row in rows])
            found.append(
                Example(
                    seeds[f],
                    fault,
                    t_s,
                    (values[:, OUTPUTS] - outputs.zero_us) * outputs.pull_m_per_us,
                    values[:, ENCODERS],
                    np.array([verdict.residuals[f] for verdict in verdicts]),
                    verdicts[0].thresholds,
                    float(t_s[alarm.argmax()]),
                    float(t_s[name.argmax()]),
                )
            )
            break
        else:
            raise ValueError(f"{fault.id} was not named rightly with any of the seeds from {seeds[0]} on; take others")
    return found


def draw_distributions(
    path: Path, curves: Sequence[tuple[str, FloatArray]], threshold: float, quantity: str, marks: Rates | None = None
) -> None:
    """Empirical distribution functions of maxima, and a threshold; marks: what it costs, first curve healthy, second not."""
    figure = Figure(figsize=(7.0, 4.2), layout="constrained")
    axis = figure.add_subplot()
    for label, maxima in curves:
        values, shares = cumulative(maxima)
        seen = np.isfinite(values)
        axis.step(values[seen], shares[seen], where="post", label=f"{label} ({maxima.size})", linewidth=1.2)
    axis.axvline(threshold, color="black", linestyle=":", label=f"threshold {threshold:.4f}")
    if marks is not None:
        axis.plot([threshold] * 2, [1.0 - marks.false_alarms, marks.missed], "o", color="tab:green", fillstyle="none")
    axis.set(xlabel=f"largest smoothed residual, {quantity}", ylabel="share of flights", xscale="log", ylim=(0.0, 1.01))
    _finish(figure, [axis], path)


def draw_trade_off(
    path: Path,
    trade: TradeOff,
    predicted: Sequence[Rates],
    simulated: Sequence[Rates],
    papers: Sequence[tuple[float, float]],
) -> None:
    """Missed faults against false alarms: the whole curve, chosen thresholds as predicted and as judged, the paper's."""
    figure = Figure(figsize=(6.0, 5.0), layout="constrained")
    axis = figure.add_subplot()
    axis.step(trade.false_alarms, trade.missed, where="post", color="tab:blue", linewidth=1.0, label="design flights")
    for label, points, mark in (("predicted", predicted, "s"), ("judged", simulated, "o")):
        if points:
            alarms, missed = [rates.false_alarms for rates in points], [rates.missed for rates in points]
            axis.plot(alarms, missed, mark, fillstyle="none", label=label)
    axis.plot(*zip(*papers, strict=True), "x", color="grey", label="paper, simulated")
    axis.set(xlabel="P(FA)", ylabel="P(MD)", xlim=(-0.02, 1.02), ylim=(-0.02, 0.8))
    _finish(figure, [axis], path)


def draw_tracking(path: Path, example: Example, output: int) -> None:
    """Command and response of one motor above the heading-rate residual (figure 8)."""
    figure = Figure(figsize=(8.0, 5.4), layout="constrained")
    motor, turn = figure.subplots(2, 1, sharex=True)
    motor.plot(example.t_s, example.commanded_m[:, output], label="command", linewidth=1.0)
    motor.plot(example.t_s, example.measured_m[:, output], label="encoder", linewidth=1.0)
    motor.set_ylabel(f"{('left', 'right')[output]} motor, m")
    _residual(turn, example, 0, f"heading rate, {RESIDUAL_UNIT}")
    _flight(figure, [motor, turn], example, path)


def draw_motor_phase(path: Path, example: Example) -> None:
    """The heading-rate residual above those of both motors (figures 15 and 16)."""
    figure = Figure(figsize=(8.0, 5.4), layout="constrained")
    turn, motors = figure.subplots(2, 1, sharex=True)
    _residual(turn, example, 0, f"heading rate, {RESIDUAL_UNIT}")
    for output, side in enumerate(("left", "right")):
        motors.plot(example.t_s, example.residuals[:, 1 + output], label=side, linewidth=1.0)
    motors.axhline(example.thresholds[1], color="black", linestyle=":", label="threshold")
    motors.set_ylabel("motors, m")
    _flight(figure, [turn, motors], example, path)


def draw_line_residuals(path: Path, example: Example, names: Sequence[str]) -> None:
    """Fault-specific residuals, one above the other (figures 17 and 18)."""
    figure = Figure(figsize=(8.0, 2.4 * len(names) + 0.8), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(names), 1, sharex=True))
    for axis, name in zip(axes, names, strict=True):
        _residual(axis, example, detector.RESIDUALS.index(name), f"{name.replace('_', ' ')}, {RESIDUAL_UNIT}")
    _flight(figure, list(axes), example, path)


def _residual(axis: Any, example: Example, residual: int, label: str) -> None:
    axis.plot(example.t_s, example.residuals[:, residual], label="smoothed residual", linewidth=1.0)
    axis.axhline(example.thresholds[residual], color="black", linestyle=":", label="threshold")
    axis.set_ylabel(label)


def _flight(figure: Figure, axes: Sequence[Any], example: Example, path: Path) -> None:
    for axis in axes:
        for when_s, colour, label in (
            (example.fault.onset_s, "black", f"fault at {example.fault.onset_s:.0f} s"),
            (example.detected_s, "tab:orange", f"detected at {example.detected_s:.1f} s"),
            (example.isolated_s, "tab:red", f"named at {example.isolated_s:.1f} s"),
        ):
            axis.axvline(when_s, color=colour, linewidth=1.0, label=label)
        axis.set_xlim(math.floor(example.fault.onset_s) - 60.0, example.fault.onset_s + SHOWN_S)
    value = "" if example.fault.value is None else f" at {example.fault.value} m"
    figure.suptitle(f"{example.fault.id}{value}, seed {example.seed}", fontsize=10)
    axes[-1].set_xlabel("time since release, s")
    _finish(figure, axes, path, "upper left")


def _finish(figure: Figure, axes: Sequence[Any], path: Path, legend: str = "best") -> None:
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7, loc=legend)
    figure.savefig(path, dpi=110)
