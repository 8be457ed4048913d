"""The live terminal view of a run: clock, residuals against thresholds, asked and flown, alarms, recovery.

Needs the extra `tui`.  It redraws a few times a second of real time, from what the effects told; it never blocks the loop.
"""

import time
from collections import deque
from typing import Final

import numpy as np
from rich.console import Console, Group
from rich.live import Live as Screen
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from companion.core import Core
from companion.effects import Effect, Judged, Tell
from companion.recovery import STAGE_WORDS
from fdi.verdict import Phase

REDRAW_S: Final = 0.1
EVENTS: Final = 8
BAR: Final = 40  # characters; the threshold stands at half of it
COLOURS: Final = {"critical": "bold red", "emergency": "bold white on red", "error": "red", "warning": "yellow"}


class View:
    """Shown while its context lasts; hand `note` every effect."""

    def __init__(self, core: Core, title: str) -> None:
        self._core = core
        self._title = title
        self._judged: Judged | None = None
        self._told: deque[Tell] = deque(maxlen=EVENTS)
        self._drawn_s = 0.0
        self._screen = Screen(console=Console(), auto_refresh=False, transient=False)

    def __enter__(self) -> "View":
        self._screen.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._screen.update(self._draw(), refresh=True)
        self._screen.stop()

    def note(self, effect: Effect) -> None:
        match effect:
            case Judged():
                self._judged = effect
            case Tell():
                self._told.append(effect)
        now_s = time.monotonic()
        if now_s - self._drawn_s >= REDRAW_S:
            self._drawn_s = now_s
            self._screen.update(self._draw(), refresh=True)

    def _draw(self) -> Panel:
        return Panel(Group(self._head(), self._residuals(), self._signals(), self._events()), title=self._title)

    def _head(self) -> Text:
        if self._judged is None:
            return Text("waiting for the vehicle")
        phase = Phase(int(self._judged.verdict.phase[0]))
        recovery = self._core.recovery
        words = STAGE_WORDS[recovery.stage] if recovery is not None else "none"
        colour = "green" if phase is Phase.HEALTHY else "cyan" if phase is Phase.WARMING else "red"
        return Text.assemble(
            f"t {self._judged.row.t_us / 1e6:7.1f} s   ",
            "armed   " if self._core.watch.armed else "disarmed   ",
            (phase.name.lower(), colour),
            f"   recovery: {words}",
        )

    def _residuals(self) -> Table:
        table = Table(box=None, show_header=False, pad_edge=False)
        if self._judged is not None:
            verdict = self._judged.verdict
            for place, name in enumerate(self._core.airframe.detector.residuals):
                value, threshold = float(verdict.residuals[0, place]), float(verdict.thresholds[place])
                table.add_row(name, _bar(value / threshold), _number(value), f"of {threshold:.4g}")
        return table

    def _signals(self) -> Text:
        if self._judged is None:
            return Text("")
        values = self._judged.verdict.signals[0]
        names = self._core.airframe.detector.signals
        return Text("   ".join(f"{name} {_number(float(value))}" for name, value in zip(names, values, strict=True)))

    def _events(self) -> Text:
        text = Text()
        for told in self._told:
            event = told.event
            t = f"{event.t:8.1f} s" if event.t is not None else "       - s"
            text.append(f"\n{t}  {event.kind.value}/{event.name}: {event.text}", COLOURS.get(event.severity.value, ""))
        return text


def _number(value: float) -> str:
    return f"{value:+.4f}" if np.isfinite(value) else "unknown"


def _bar(share: float) -> Text:
    """Filled up to the value; red beyond the threshold, which stands in the middle."""
    filled = min(BAR, round(share * BAR / 2)) if np.isfinite(share) else 0
    bar = Text()
    bar.append("█" * min(filled, BAR // 2), "green")
    bar.append(" " * max(0, BAR // 2 - filled))
    bar.append("│")
    bar.append("█" * max(0, filled - BAR // 2), "red")
    bar.append(" " * (BAR // 2 - max(0, filled - BAR // 2)))
    return bar
