"""`mavfdi analyze LOG…`: what happened in telemetry logs."""

import argparse
import math
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from companion import airframe as airframes
from companion.airframe import Airframe
from companion.analysis import WHOLE, Analysis, Part, analyze, by_type
from companion.checks import Status
from companion.cli import FAILED, arguments, compiling
from companion.decision import Policy
from companion.errors import UserError
from companion.events import Json, encode
from companion.picture import History
from companion.vehicle import Heartbeat

PATIENCE_S = 2.0  # what takes longer shows progress on a terminal


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", metavar="LOG", nargs="+", type=Path, help=".tlog, .tlog.gz, or a folder of them")
    parser.add_argument("--airframe", metavar="NAME", default="auto", help="default auto: by the vehicle's MAV_TYPE")
    parser.add_argument("--json", action="store_true", help="one JSON object a line, one line a log, as each is done")
    parser.add_argument("--report", metavar="FILE", type=Path, help="write a page of one log, to be opened in a browser")
    parser.add_argument("--events", metavar="FILE", type=Path, help="write all events of all logs as Parquet")
    parser.add_argument("--jobs", metavar="N", type=int, default=1, help="logs read at the same time")
    parser.add_argument(
        "--policy",
        choices=[policy.value for policy in Policy],
        help="decide under this policy; default: the one that the log was recorded under, else advise",
    )
    parser.add_argument("--from", dest="from_s", metavar="S", type=float, help="from so many seconds after the log's start")
    parser.add_argument("--to", dest="to_s", metavar="S", type=float, help="up to so many seconds after it")
    parser.add_argument("--systems", metavar="1,2", help="of these systems only")
    arguments.add_config(parser)


@dataclass(frozen=True, slots=True)
class Task:
    """One log for a worker; plain values, so that it travels to another process."""

    path: Path
    airframe: str
    config: Path | None
    policy: str | None
    report: Path | None
    part: Part


@dataclass(frozen=True, slots=True)
class Done:
    """What came of it: content, or why not."""

    path: Path
    content: dict[str, Json] | None
    summary: str
    error: str = ""


def main(args: argparse.Namespace) -> int:
    """0: nothing found, 1: faults found, 2: a log could not be read (the others are done all the same)."""
    if args.jobs < 1:
        raise UserError(f"--jobs {args.jobs}: give 1 or more")
    if args.airframe != "auto":
        airframes.load(args.airframe, args.config)  # a wrong name is told once, not once a log
    part = _part(args.from_s, args.to_s, args.systems)
    if args.report is not None and part != WHOLE:
        raise UserError("--report shows a whole log; leave out --from, --to and --systems")
    paths = list(_files(args.logs))
    if args.report is not None and len(paths) != 1:
        raise UserError(f"--report is for one log, not {len(paths)}")
    tasks = [Task(path, args.airframe, args.config, args.policy, args.report, part) for path in paths]
    compiling.announce(paths, always=args.report is not None)
    done: list[Done] = []
    progress = _Progress(len(tasks))
    for outcome in _outcomes(tasks, args.jobs):
        progress.clear()
        done.append(outcome)
        if outcome.content is None:
            print(f"mavfdi analyze: {outcome.error}", file=sys.stderr)
        else:
            print(encode(outcome.content) if args.json else outcome.summary, flush=True)
        progress.show(len(done))
    progress.clear()
    if len(tasks) > 1 and not args.json:
        print(fleet_table(done))
    if args.events is not None:
        _write_events(args.events, done)
    if any(outcome.content is None for outcome in done):
        return FAILED
    return 1 if any(outcome.content is not None and outcome.content["verdict"] == "fault" for outcome in done) else 0


def _part(from_s: float | None, to_s: float | None, systems: str | None) -> Part:
    """What --from, --to and --systems say together.  Raises UserError."""
    begin_s, end_s = from_s if from_s is not None else 0.0, to_s if to_s is not None else math.inf
    if not (0.0 <= begin_s < end_s and begin_s < math.inf):  # so for NaN
        raise UserError(f"--from {begin_s:g} --to {end_s:g}: give seconds from the log's start, the later one behind --to")
    try:
        numbers = frozenset(int(text) for text in systems.split(",")) if systems else frozenset()
    except ValueError:
        raise UserError(f"--systems {systems}: give numbers, for example 1,2") from None
    return Part(begin_s, end_s, numbers)


def _files(paths: list[Path]) -> Iterator[Path]:
    """The logs named, and those in the folders named.  Raises UserError for a folder without any."""
    for path in paths:
        if path.is_dir():
            found = sorted(file for file in path.iterdir() if file.name.endswith((".tlog", ".tlog.gz")))
            if not found:
                raise UserError(f"{path}: no .tlog or .tlog.gz in this folder")
            yield from found
        else:
            yield path


def _outcomes(tasks: list[Task], jobs: int) -> Iterator[Done]:
    """In the order in which the logs were named, each as soon as it is done."""
    if jobs == 1 or len(tasks) == 1:
        yield from map(work, tasks)
        return
    from concurrent.futures import ProcessPoolExecutor  # with its queues and pipes, a tenth of the start

    with ProcessPoolExecutor(min(jobs, len(tasks))) as pool:
        yield from pool.map(work, tasks)


def work(task: Task) -> Done:
    """Analyse one log, in whatever process."""
    named = airframes.load(task.airframe, task.config) if task.airframe != "auto" else None

    def choose(beats: list[Heartbeat]) -> Airframe | None:
        return named or by_type(beats, task.config)

    history = History() if task.report is not None else None
    try:
        found = analyze(
            task.path,
            choose,
            Policy(task.policy) if task.policy else None,
            observe=history.note if history else None,
            part=task.part,
        )
        if task.report is not None and history is not None:
            from companion import report

            report.write(task.report, found, history)
    except UserError as error:
        return Done(task.path, None, "", str(error))
    return Done(task.path, found.content, text(found))


class _Progress:
    """Logs done, rate and remaining time, on a terminal, once it takes long."""

    def __init__(self, logs: int) -> None:
        self._logs = logs
        self._began_s = time.monotonic()
        self._shown = False

    def show(self, done: int) -> None:
        passed_s = time.monotonic() - self._began_s
        if sys.stderr.isatty() and passed_s > PATIENCE_S and done < self._logs:
            left_s = passed_s / done * (self._logs - done)
            line = f"{done}/{self._logs} logs, {done / passed_s:.1f} a second, {left_s:.0f} s left"
            print(f"\r{line:60}", end="", file=sys.stderr, flush=True)
            self._shown = True

    def clear(self) -> None:
        if self._shown:
            print(f"\r{'':60}\r", end="", file=sys.stderr, flush=True)
            self._shown = False


def text(found: Analysis) -> str:
    """The summary for people, to be read in ten seconds."""
    content, replay = found.content, found.replay
    log, duration = content["log"], content["duration_s"]
    assert isinstance(log, dict)
    lines = [
        str(log["path"]),
        f"  verdict   {found.verdict.replace('_', ' ')}",
        f"  duration  {duration:.1f} s" if isinstance(duration, float) else "  duration  unknown",
    ]
    if found.part != WHOLE:
        lines.append(f"  part      {found.part}")
    if replay is None:
        lines.append("  airframe  none configured for this vehicle: general checks only")
    else:
        lines.append(f"  airframe  {replay.airframe.name}, system {replay.core.watch.sysid or 'none heard'}")
        for fault in replay.journal.faults:
            confidence = fault["confidence"]
            assert isinstance(confidence, float)
            lines.append(f"  fault     {fault['id']} ({confidence:.1%}) isolated at {fault['isolated_t']} s")
    order = (Status.FAULT, Status.WARNING)
    for status in order:
        for finding in found.findings:
            if finding.status is status:
                at = f" at {finding.t:.1f} s" if finding.t is not None else ""
                lines.append(f"  {status.value:9} {finding.id}{at}: {finding.text}")
    fine = sum(finding.status is Status.OK for finding in found.findings)
    silent = sum(finding.status is Status.NOT_AVAILABLE for finding in found.findings)
    lines.append(f"  checks    {fine} ok, {silent} without the messages they need")
    if replay is not None:
        lines += [f"  {_clock(line['t'])}  {line['kind']}/{line['name']}: {line['text']}" for line in replay.journal.lines]
    if "replay" in content:
        same = isinstance(content["replay"], dict) and content["replay"]["same_settings"]
        lines.append(f"  replay    decided {'the same' if same else 'DIFFERENTLY'} as the recorded run")
    return "\n".join(lines)


def _clock(t: Json) -> str:
    return f"{t:9.1f} s" if isinstance(t, float) else f"{'-':>9} s"


def fleet_table(done: list[Done]) -> str:
    """One line a log: verdict, duration, what was found."""
    width = max(len(outcome.path.name) for outcome in done)
    lines = [f"{'log':{width}}  {'verdict':10}  {'duration':>10}  found"]
    for outcome in done:
        if outcome.content is None:
            lines.append(f"{outcome.path.name:{width}}  {'unreadable':10}  {'':>10}  {outcome.error.rpartition(': ')[2]}")
            continue
        content = outcome.content
        duration = f"{content['duration_s']:.0f} s" if isinstance(content["duration_s"], float) else "unknown"
        lines.append(f"{outcome.path.name:{width}}  {content['verdict']!s:10}  {duration:>10}  {_found(content)}")
    return "\n".join(lines)


def _found(content: dict[str, Json]) -> str:
    faults, checks = content["faults"], content["checks"]
    assert isinstance(faults, list)
    assert isinstance(checks, list)
    names = [str(fault["id"]) for fault in faults if isinstance(fault, dict)]
    for status, mark in ((Status.FAULT, "!"), (Status.WARNING, "")):
        names += [f"{check['id']}{mark}" for check in checks if isinstance(check, dict) and check["status"] == status.value]
    return ", ".join(names)


def _write_events(path: Path, done: list[Done]) -> None:
    """All events and the findings of all logs in one table.  Raises UserError without pyarrow, or where it cannot write."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ModuleNotFoundError:
        raise UserError("Parquet needs pyarrow; install it with: pip install 'mavfdi[analysis]'") from None
    rows: list[dict[str, Json]] = []
    for outcome in done:
        events, checks = (outcome.content or {}).get("events"), (outcome.content or {}).get("checks")
        for line in events if isinstance(events, list) else []:
            assert isinstance(line, dict)
            rows.append({"log": str(outcome.path), **{key: line[key] for key in ("t", "kind", "name", "severity", "text")}})
        for check in checks if isinstance(checks, list) else []:
            assert isinstance(check, dict)
            row = {"kind": "check", "name": check["id"], "severity": check["status"]}
            rows.append({"log": str(outcome.path), "t": check["t"], "text": check["text"], **row})
    kinds = [("log", "string"), ("t", "float64"), ("kind", "string"), ("name", "string"), ("severity", "string")]
    schema = pyarrow.schema([*((name, getattr(pyarrow, kind)()) for name, kind in kinds), ("text", pyarrow.string())])
    try:
        parquet.write_table(pyarrow.Table.from_pylist(rows, schema=schema), path)
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else str(error)  # pyarrow's own words name the path once more
        raise UserError(f"{path}: cannot write here: {why}") from None
