"""One run's events in order, numbered, and what is to be said of the run as a whole.

Pure.  The live run, the analysis of a log and the rehearsal in one process all keep one, so that they end up with the same
lines and the same summary.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.metadata import version

from companion.airframe import Airframe
from companion.core import Core
from companion.effects import Effect, Judged, Tell
from companion.events import SCHEMA, Event, Json, Kind, Severity, as_json
from companion.recovery import STAGE_WORDS
from fdi.verdict import Phase


@dataclass(slots=True)
class Journal:
    """Events become lines here, and nowhere else."""

    airframe: Airframe
    lines: list[dict[str, Json]] = field(default_factory=list)
    faults: list[dict[str, Json]] = field(default_factory=list)
    rows_judged: int = 0  # rows on which the monitor had an opinion
    alarms: int = 0
    _detected: Event | None = None

    def begin(self, utc_us: int, details: dict[str, Json]) -> dict[str, Json]:
        """The first line of a file."""
        head: dict[str, Json] = {
            "version": version("mavfdi"),
            "config_sha256": self.airframe.source.digest,
            "path": list(dict.fromkeys(self.airframe.source.origins.values())),
        }
        return self._line(Event(Kind.RUN, "run", Severity.INFO, "run begins", utc_us=utc_us, details=head | details), None)

    def end(self, utc_us: int, why: str, counters: dict[str, Json]) -> dict[str, Json]:
        """The last line of a file."""
        event = Event(Kind.END, "end", Severity.INFO, f"run ends: {why}", utc_us=utc_us, details={"counters": counters})
        return self._line(event, None)

    def take(self, effects: Iterable[Effect], sysid: int | None) -> list[dict[str, Json]]:
        """Note what these effects tell; -> the new lines."""
        new: list[dict[str, Json]] = []
        for effect in effects:
            if isinstance(effect, Judged):
                self.rows_judged += int(effect.verdict.phase[0]) != Phase.WARMING
            elif isinstance(effect, Tell):
                new.append(self._line(effect.event, sysid))
                self._note(effect.event)
        return new

    @property
    def verdict(self) -> str:
        """healthy, fault, degraded (something was wrong that could not be named) or not_judged."""
        if self.faults:
            return "fault"
        if self.alarms:
            return "degraded"
        return "healthy" if self.rows_judged else "not_judged"

    def _line(self, event: Event, sysid: int | None) -> dict[str, Json]:
        line = as_json(event, len(self.lines), sysid, self.airframe.name)
        self.lines.append(line)
        return line

    def _note(self, event: Event) -> None:
        if event.kind is not Kind.FAULT:
            return
        if event.name == "detected":
            self.alarms += 1
            self._detected = event
        if event.fault is not None:
            detected = self._detected or event
            times: dict[str, Json] = {
                "detected_t": detected.t,
                "isolated_t": event.t,
                "detected_utc_us": detected.utc_us,
            }
            self.faults.append(event.fault.as_json() | times)


def counters(core: Core) -> dict[str, Json]:
    """Everything that the pure half counted, for the last line and the summary."""
    groups = {"core": core.counts, "decode": core.decoder.counts, "align": core.aligner.counts}
    return {f"{group}.{name}": count for group, found in groups.items() for name, count in sorted(found.items())}


def summary(journal: Journal, core: Core, extra: dict[str, Json]) -> dict[str, Json]:
    """What stands in summary.json; extra: seed, injected faults and counters of whoever ran it."""
    recovery = core.recovery
    state: Json = None
    if recovery is not None:
        state = {"state": recovery.stage.value, "reason": recovery.reason or STAGE_WORDS[recovery.stage]}
    out: dict[str, Json] = {
        "schema": SCHEMA,
        "airframe": core.airframe.name,
        "seed": None,
        "injected": [],
        "verdict": journal.verdict,
        "alarms": journal.alarms,
        "faults": list(journal.faults),
        "recovery": state,
        "counters": counters(core),
    }
    return {**out, **extra}
