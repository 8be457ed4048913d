"""What a log says: the live core fed from a file, and the one JSON object that comes out.

A log that our own run recorded also holds what that run sent; the replay decides again and compares instead of sending.
"""

import gc
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion import airframe as airframes
from companion.airframe import Airframe
from companion.checks import Bench, Finding, Status, worst
from companion.checks.flight import Flight
from companion.compiler import compiler
from companion.core import FIRST_COMPONENT, LAST_COMPONENT, POLICIES, Core
from companion.decision import Policy
from companion.dialect import encode
from companion.effects import Effect, Send
from companion.errors import UserError
from companion.events import SCHEMA, Json
from companion.frames import Frame, Splitter
from companion.journal import Journal
from companion.tlog import END_US, FIRST_US, LINK_MASK, OWN_LINK, Reader, Record, Report, Tally
from companion.vehicle import NO_VEHICLE, Heartbeat, heartbeat
from fdi.kernel import Compiler

HEARTBEAT_ID: Final = 0
PARAM_SET_ID: Final = mavlink.MAVLINK_MSG_ID_PARAM_SET.to_bytes(3, "little")  # as `_content` begins
COMPILED_FROM_BYTES: Final = 8_000_000  # below, loading numba takes longer than reading in plain Python
COMPILED_FROM_FRAMES: Final = 40_000  # below, a monitor in plain Python is done before numba is loaded
PACKED: Final = 4  # a compressed log is about so many times larger than its file
UNCOMPARED: Final = frozenset({"HEARTBEAT", "TIMESYNC"})  # they go out by the clock of the loop, and decide nothing


@dataclass(slots=True)
class Replay:
    """One log through the core.  policy None: the one under which it was recorded, else advise."""

    airframe: Airframe
    policy: Policy | None = None
    core: Core = field(init=False)
    journal: Journal = field(init=False)
    sent: list[bytes] = field(default_factory=list)  # what the replay would send: message ids and payloads
    recorded: list[bytes] = field(default_factory=list)  # what the recorded run did send
    observe: Callable[[Effect], None] | None = None
    compiler: Compiler | None = None
    _stamp_us: int = 0

    def __post_init__(self) -> None:
        self.core = Core(self.airframe, self.policy or Policy.ADVISE, compiler=self.compiler)
        self.journal = Journal(self.airframe)

    def take(self, record: Record) -> None:
        """One record; arrival stamps never run backwards here, whatever the file says."""
        stamp_us, frame = record
        own = False
        if stamp_us is not None:
            if self._stamp_us < stamp_us & ~LINK_MASK and FIRST_US <= stamp_us < END_US:
                self._stamp_us = stamp_us & ~LINK_MASK
            own = stamp_us & LINK_MASK == OWN_LINK and FIRST_COMPONENT <= frame.compid <= LAST_COMPONENT
        effects = self.core.tick(self._stamp_us) if own else self.core.frame(frame, self._stamp_us)
        if effects:
            self._perform(effects)
        if own:
            self._own(frame)

    def _own(self, frame: Frame) -> None:
        name = frame.name
        if name == "HEARTBEAT" and self.policy is None:
            mode = heartbeat(frame).mode
            if mode < len(POLICIES):
                self.core.policy = POLICIES[mode]
        if name not in UNCOMPARED:
            self.recorded.append(_content(frame))

    def _perform(self, effects: list[Effect]) -> None:
        self.journal.take(effects, self.core.watch.sysid)
        for effect in effects:
            if isinstance(effect, Send) and effect.message not in UNCOMPARED:
                raw = encode(effect.message, effect.fields, sysid=1, compid=1, seq=0)
                self.sent.append(_content(Splitter().feed(raw)[0]))
            if self.observe is not None:
                self.observe(effect)


def _content(frame: Frame) -> bytes:
    return frame.message_id.to_bytes(3, "little") + frame.payload


@dataclass(frozen=True, slots=True)
class Part:
    """The part of a log that is looked at, as if there were no more of it.

    from_s, to_s: arrival stamps in [from_s, to_s), from the log's first one; a frame without a stamp of its own, or with one
    that cannot be, came when the one before it did.  systems: frames of these alone; empty: of all.
    """

    from_s: float = 0.0
    to_s: float = math.inf
    systems: frozenset[int] = frozenset()

    @property
    def timed(self) -> bool:
        return self.from_s > 0.0 or self.to_s < math.inf

    def as_json(self) -> dict[str, Json]:
        systems: list[Json] = [*sorted(self.systems)]
        return {"from_s": self.from_s, "to_s": self.to_s if self.to_s < math.inf else None, "systems": systems}

    def __str__(self) -> str:
        times = f"{self.from_s:g} s to {f'{self.to_s:g} s' if self.to_s < math.inf else 'the end'}"
        return times + (f", of systems {', '.join(map(str, sorted(self.systems)))}" if self.systems else "")


WHOLE: Final = Part()


@dataclass(frozen=True, slots=True)
class Analysis:
    """The outcome of one log."""

    content: dict[str, Json]  # the JSON object of ARCHITECTURE.md, "Analysis"
    replay: Replay | None  # None where no airframe is configured for the vehicle: then the checks alone judge
    findings: tuple[Finding, ...]
    path: Path
    flight: Flight  # what the checks know of it: armed and mode by time
    part: Part  # of the log, that this is of

    @property
    def verdict(self) -> str:
        return str(self.content["verdict"])

    @property
    def faulty(self) -> bool:
        """Was a fault found, by the airframe's monitor or by a check?"""
        return self.verdict == "fault"


def analyze(
    path: Path,
    choose: Callable[[list[Heartbeat]], Airframe | None],
    policy: Policy | None = None,
    progress: Callable[[int], None] | None = None,
    observe: Callable[[Effect], None] | None = None,
    part: Part = WHOLE,
) -> Analysis:
    """Read a log and say what happened.

    choose: from the heartbeats of the vehicles in the log to the airframe, None for none; progress: told the number of
    frames read; observe: shown every effect of the replay.  Raises UserError for a log that cannot be read, and for a part
    that holds nothing.
    """
    with _collector_paused():
        return _analyze(path, choose, policy, progress, observe, part)


@contextmanager
def _collector_paused() -> Iterator[None]:
    """All frames of a log stay alive: Python's collector of cycles would go through them again and again, for a tenth of
    the time, and find nothing."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _analyze(
    path: Path,
    choose: Callable[[list[Heartbeat]], Airframe | None],
    policy: Policy | None,
    progress: Callable[[int], None] | None,
    observe: Callable[[Effect], None] | None,
    part: Part,
) -> Analysis:
    records, report = _open(path, progress)
    if part != WHOLE:
        records, report = _cut(path, records, report, part)
    vehicles = _vehicles(records)
    airframe = choose(vehicles)
    machine_code = compiler() if len(records) >= COMPILED_FROM_FRAMES else None
    replay = Replay(airframe, policy, observe=observe, compiler=machine_code) if airframe is not None else None
    bench = Bench()
    for stamp_us, frame in records:
        bench.take(frame, stamp_us if stamp_us is not None and FIRST_US <= stamp_us < END_US else None)
    if replay is not None:
        for record in records:  # a pass of its own: both in one take a sixth longer, out of the processor's caches
            replay.take(record)
    skipped = airframe.configuration.checks.skip if airframe is not None else ()
    findings = tuple(finding for finding in bench.finish() if finding.id not in skipped)
    name, sysid = (replay.airframe.name, replay.core.watch.sysid) if replay is not None else (None, None)
    journal = replay.journal if replay is not None else None
    content: dict[str, Json] = {
        **_facts(path, report, vehicles, name, sysid),
        "verdict": _verdict(journal.verdict if journal is not None else None, worst(list(findings))),
        "faults": list(journal.faults) if journal is not None else [],
        "checks": [finding.as_json() for finding in findings],
        "events": list(journal.lines) if journal is not None else [],
    }
    if part != WHOLE:
        content["part"] = part.as_json()
    if replay is not None and replay.recorded and not part.timed:  # what was sent in a part follows from what was before
        content["replay"] = {
            "sends": len(replay.sent),
            "sends_recorded": len(replay.recorded),
            "same_sends": replay.sent == replay.recorded,
            "same_settings": _settings(replay.sent) == _settings(replay.recorded),
        }
    return Analysis(content, replay, findings, path, bench.flight, part)


def _settings(contents: list[bytes]) -> list[bytes]:
    """The PARAM_SETs among them: what a run did to its vehicle.  A log that begins in mid-run lacks other things it sent."""
    return [content for content in contents if content[:3] == PARAM_SET_ID]


def _verdict(monitor: str | None, checks: Status) -> str:
    """The graver of what the airframe's monitor (None: there is none) and the checks say.

    Where there is a monitor that judged nothing, checks that found nothing do not make the vehicle healthy.
    """
    if monitor == "fault" or checks is Status.FAULT:
        return "fault"
    if monitor == "degraded" or checks is Status.WARNING:
        return "degraded"
    if monitor is not None:
        return monitor
    return "healthy" if checks is Status.OK else "not_judged"


def facts(path: Path) -> dict[str, Json]:
    """What is in a log: an analysis without verdict, faults, checks and events.  Raises UserError as `analyze`."""
    with _collector_paused():
        records, report = _open(path, None)
        return _facts(path, report, _vehicles(records), None, None)


def _vehicles(records: Iterable[Record]) -> list[Heartbeat]:
    """The first heartbeat of each component that flies."""
    found: dict[tuple[int, int], Heartbeat] = {}
    for record in records:
        if record.frame.message_id == HEARTBEAT_ID:
            beat = heartbeat(record.frame)
            if beat.autopilot != mavlink.MAV_AUTOPILOT_INVALID and beat.type not in NO_VEHICLE:
                found.setdefault((beat.sysid, beat.compid), beat)
    return list(found.values())


def _facts(
    path: Path, report: Report, vehicles: list[Heartbeat], airframe: str | None, sysid: int | None
) -> dict[str, Json]:
    first_us, last_us = report.first_us, report.last_us
    return {
        "schema": SCHEMA,
        "log": {"path": str(path), "bytes": report.bytes, "sha256": report.sha256},
        "reader": report.as_json(),
        "vehicles": [
            {
                "sysid": beat.sysid,
                "compid": beat.compid,
                "autopilot": beat.autopilot,
                "type": beat.type,
                "airframe": airframe if beat.sysid == sysid else None,
            }
            for beat in vehicles
        ],
        "duration_s": (last_us - first_us) / 1e6 if first_us is not None and last_us is not None else None,
    }


def _open(path: Path, progress: Callable[[int], None] | None) -> tuple[list[Record], Report]:
    """All frames of a log: large ones compiled where numba is installed, else one by one; the outcome is the same."""
    columns = compiled_reader() if is_large(path) else None
    if columns is None:
        reader = Reader(path)
        return list(_counted(reader, progress)), reader.report
    index = columns.read(path)
    index.hash()
    return list(_counted(index.records(), progress)), index.report


def _cut(path: Path, records: list[Record], report: Report, part: Part) -> tuple[list[Record], Report]:
    """The records of a part, and the report on them; damage is counted for the whole file.  Raises UserError."""
    begin_us = end_us = now_us = 0
    if part.timed:
        if report.first_us is None:
            raise UserError(f"{path}: no frame in it has a stamp; leave out --from and --to")
        now_us = report.first_us & ~LINK_MASK
        begin_us = now_us + round(part.from_s * 1e6)
        end_us = now_us + round(part.to_s * 1e6) if part.to_s < math.inf else END_US
    kept: list[Record] = []
    for record in records:
        stamp_us, frame = record
        if stamp_us is not None and now_us < stamp_us < END_US:
            now_us = stamp_us & ~LINK_MASK
        timely = not part.timed or begin_us <= now_us < end_us
        if timely and (not part.systems or frame.sysid in part.systems):
            kept.append(record)
    if not kept:
        raise UserError(f"{path}: no frame in this part of it; it holds {_extent(report)}")
    damage = ("bytes", "sha256", "crc_failures", "crc_failure_ids", "resyncs", "resync_bytes", "tail_bytes")
    of_part = Report(**{name: getattr(report, name) for name in damage})
    Tally(of_part).take(kept)
    return kept, of_part


def _extent(report: Report) -> str:
    systems = ", ".join(map(str, sorted({sysid for sysid, _ in report.sources})))
    if report.first_us is None or report.last_us is None:
        return f"systems {systems}"
    return f"{(report.last_us - report.first_us) / 1e6:.1f} s, systems {systems}"


def is_large(path: Path) -> bool:
    """Is this log read by the compiled reader?"""
    try:
        return path.stat().st_size * (PACKED if path.suffix == ".gz" else 1) >= COMPILED_FROM_BYTES
    except OSError:
        return False  # the reader says what is wrong with it


def compiled_reader() -> ModuleType | None:
    """`companion.columns`, None where numba is not installed."""
    try:
        from companion import columns
    except ModuleNotFoundError as error:
        if error.name != "numba":
            raise
        return None
    return columns


def _counted(records: Iterable[Record], progress: Callable[[int], None] | None) -> Iterable[Record]:
    return records if progress is None else _told(records, progress)


def _told(records: Iterable[Record], progress: Callable[[int], None]) -> Iterator[Record]:
    for number, record in enumerate(records):
        if number % 10_000 == 0:
            progress(number)
        yield record


def by_type(beats: list[Heartbeat], owners: Path | None = None) -> Airframe | None:
    """The configured airframe that names the type of one of these vehicles; None if none does."""
    found = {name: airframes.load(name, owners) for name in airframes.places()}
    for beat in beats:
        for airframe in found.values():
            if beat.type in airframe.configuration.vehicle.mav_types:
                return airframe
    return None
