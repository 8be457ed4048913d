"""What a log says: the live core fed from a file, and the one JSON object that comes out.

A log that our own run recorded also holds what that run sent; the replay decides again and compares instead of sending.
"""

import gc
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
from companion.core import FIRST_COMPONENT, LAST_COMPONENT, POLICIES, Core
from companion.decision import Policy
from companion.dialect import encode
from companion.effects import Effect, Send
from companion.events import SCHEMA, Json
from companion.frames import Frame, Splitter
from companion.journal import Journal
from companion.tlog import LINK_MASK, OWN_LINK, PLAUSIBLE_US, Reader, Record, Report
from companion.vehicle import NO_VEHICLE, Heartbeat, heartbeat

HEARTBEAT_ID: Final = 0
PARAM_SET_ID: Final = mavlink.MAVLINK_MSG_ID_PARAM_SET.to_bytes(3, "little")  # as `_content` begins
COMPILED_FROM_BYTES: Final = 8_000_000  # below, loading numba takes longer than reading in plain Python
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
    _stamp_us: int = 0

    def __post_init__(self) -> None:
        self.core = Core(self.airframe, self.policy or Policy.ADVISE)
        self.journal = Journal(self.airframe)

    def take(self, record: Record) -> None:
        """One record; arrival stamps never run backwards here, whatever the file says."""
        if record.stamp_us is not None and record.stamp_us in PLAUSIBLE_US:
            self._stamp_us = max(self._stamp_us, record.stamp_us & ~LINK_MASK)
        if self._is_own(record):
            self._own(record.frame)
        else:
            self._perform(self.core.frame(record.frame, self._stamp_us))

    def _is_own(self, record: Record) -> bool:
        return record.link == OWN_LINK and FIRST_COMPONENT <= record.frame.compid <= LAST_COMPONENT

    def _own(self, frame: Frame) -> None:
        self._perform(self.core.tick(self._stamp_us))
        if frame.name == "HEARTBEAT" and self.policy is None:
            mode = heartbeat(frame).mode
            if mode < len(POLICIES):
                self.core.policy = POLICIES[mode]
        if frame.name not in UNCOMPARED:
            self.recorded.append(_content(frame))

    def _perform(self, effects: list[Effect]) -> None:
        if not effects:
            return
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
class Analysis:
    """The outcome of one log."""

    content: dict[str, Json]  # the JSON object of ARCHITECTURE.md, "Analysis"
    replay: Replay | None  # None where no airframe is configured for the vehicle: then the checks alone judge
    findings: tuple[Finding, ...]
    path: Path
    flight: Flight  # what the checks know of it: armed and mode by time

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
) -> Analysis:
    """Read a log and say what happened.

    choose: from the heartbeats of the vehicles in the log to the airframe, None for none; progress: told the number of
    frames read; observe: shown every effect of the replay.  Raises UserError for a log that cannot be read.
    """
    with _collector_paused():
        return _analyze(path, choose, policy, progress, observe)


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
) -> Analysis:
    records, report = _open(path, progress)
    vehicles = _vehicles(records)
    airframe = choose(vehicles)
    replay = Replay(airframe, policy, observe=observe) if airframe is not None else None
    bench = Bench()
    for record in records:
        plausible = record.stamp_us is not None and record.stamp_us in PLAUSIBLE_US
        bench.take(record.frame, record.stamp_us if plausible else None)
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
    if replay is not None and replay.recorded:
        content["replay"] = {
            "sends": len(replay.sent),
            "sends_recorded": len(replay.recorded),
            "same_sends": replay.sent == replay.recorded,
            "same_settings": _settings(replay.sent) == _settings(replay.recorded),
        }
    return Analysis(content, replay, findings, path, bench.flight)


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


def _counted(records: Iterable[Record], progress: Callable[[int], None] | None) -> Iterator[Record]:
    for number, record in enumerate(records):
        if progress is not None and number % 10_000 == 0:
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
