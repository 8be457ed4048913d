"""A picture of one run: residuals against thresholds, the turn asked for and the turn flown.  Needs the extra `plot`."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from companion.airframe import Detector
from companion.effects import Effect, Judged
from companion.errors import UserError
from companion.events import Json


@dataclass(slots=True)
class History:
    """What a run showed, row by row; hand its `note` every effect."""

    t_s: list[float] = field(default_factory=list)
    residuals: list[np.ndarray] = field(default_factory=list)  # (residual,)
    signals: list[np.ndarray] = field(default_factory=list)  # (signal,)
    thresholds: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def note(self, effect: Effect) -> None:
        if isinstance(effect, Judged):
            self.t_s.append(effect.row.t_us / 1e6)
            self.residuals.append(effect.verdict.residuals[0])
            self.signals.append(effect.verdict.signals[0])
            self.thresholds = effect.verdict.thresholds

    def tracking_rms(self, from_s: float, to_s: float) -> float:
        """Root mean square of the first signal less the second (asked for, flown); NaN where nothing is known."""
        t_s = np.array(self.t_s)
        inside = (t_s >= from_s) & (t_s < to_s)
        if not inside.any() or len(self.signals[0]) < 2:
            return float("nan")
        asked, flown = np.array(self.signals)[inside, :2].T
        known = np.isfinite(asked) & np.isfinite(flown)
        return float(np.sqrt(np.mean((asked[known] - flown[known]) ** 2))) if known.any() else float("nan")


MARKS = {  # events drawn as lines: (kind, name) -> colour
    ("fault", "detected"): "tab:orange",
    ("fault", "isolated"): "tab:red",
    ("recovery", "acknowledged"): "tab:blue",
    ("recovery", "verified"): "tab:green",
    ("recovery", "rolled_back"): "tab:purple",
}


def draw(
    path: Path, history: History, detector: Detector, lines: Sequence[dict[str, Json]], onsets: Sequence[tuple[str, float]]
) -> None:
    """Write a PNG.  onsets: injected faults and when (vehicle clock, s).  Raises UserError without matplotlib."""
    try:
        import matplotlib as mpl
    except ModuleNotFoundError:
        raise UserError("the picture needs matplotlib; install it with: pip install 'mavfdi[plot]'") from None
    mpl.use("Agg")
    from matplotlib import pyplot

    t_s = np.array(history.t_s)
    residuals, signals = np.array(history.residuals), np.array(history.signals)
    figure, (upper, lower) = pyplot.subplots(2, 1, figsize=(11, 7), sharex=True, layout="constrained")
    for place, name in enumerate(detector.residuals):
        upper.semilogy(t_s, np.maximum(residuals[:, place] / history.thresholds[place], 1e-3), label=name, linewidth=1.0)
    upper.axhline(1.0, color="black", linestyle="--", linewidth=1.0)
    upper.set_ylabel("residual / threshold")
    for place, name in enumerate(detector.signals):
        lower.plot(t_s, signals[:, place], label=name, linewidth=1.0)
    lower.set_ylabel("signals")
    lower.set_xlabel("vehicle clock, s")
    for axis in (upper, lower):
        for fault, onset_s in onsets:
            axis.axvline(onset_s, color="black", linewidth=1.5, label=f"injected: {fault}")
        for line in lines:
            colour = MARKS.get((str(line["kind"]), str(line["name"])))
            if colour and isinstance(line["t"], float):
                axis.axvline(line["t"], color=colour, linestyle=":", linewidth=1.5, label=f"{line['kind']} {line['name']}")
        axis.grid(alpha=0.3)
        axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=8)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
