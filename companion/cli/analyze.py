"""`mavfdi analyze LOG…`: what happened in telemetry logs."""

import argparse
import sys
import time
from pathlib import Path

from companion import airframe as airframes
from companion.airframe import Airframe
from companion.analysis import Analysis, analyze, by_type
from companion.cli import FAILED, arguments
from companion.decision import Policy
from companion.errors import UserError
from companion.events import encode
from companion.vehicle import Heartbeat

PATIENCE_S = 2.0  # what takes longer shows progress on a terminal


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", metavar="LOG", nargs="+", type=Path, help=".tlog or .tlog.gz")
    parser.add_argument("--airframe", metavar="NAME", default="auto", help="default auto: by the vehicle's MAV_TYPE")
    parser.add_argument("--json", action="store_true", help="one JSON object a line, one line a log")
    parser.add_argument(
        "--policy",
        choices=[policy.value for policy in Policy],
        help="decide under this policy; default: the one that the log was recorded under, else advise",
    )
    arguments.add_config(parser)


def main(args: argparse.Namespace) -> int:
    """0: nothing found, 1: faults found, 2: a log could not be read (the others are done all the same)."""
    named = airframes.load(args.airframe, args.config) if args.airframe != "auto" else None

    def choose(beats: list[Heartbeat]) -> Airframe:
        return named or by_type(beats, args.config)

    code = 0
    for path in args.logs:
        try:
            found = analyze(path, choose, Policy(args.policy) if args.policy else None, _Progress(path))
        except UserError as error:
            print(f"mavfdi analyze: {error}", file=sys.stderr)
            code = FAILED
            continue
        print(encode(found.content) if args.json else text(found), flush=True)
        if found.content["verdict"] != "healthy" and found.faults and code != FAILED:
            code = 1
    return code


class _Progress:
    """Frames read so far, on a terminal, once it takes long."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._began_s = time.monotonic()

    def __call__(self, frames: int) -> None:
        passed_s = time.monotonic() - self._began_s
        if sys.stderr.isatty() and passed_s > PATIENCE_S:
            print(f"\r{self._path}: {frames} frames, {frames / passed_s:.0f} a second", end="", file=sys.stderr)


def text(found: Analysis) -> str:
    """The summary for people."""
    content, replay = found.content, found.replay
    duration = content["duration_s"]
    lines = [
        f"{content['log']['path'] if isinstance(content['log'], dict) else ''}",
        f"  airframe  {replay.airframe.name}, system {replay.core.watch.sysid or 'none heard'}",
        f"  duration  {duration:.1f} s" if isinstance(duration, float) else "  duration  unknown",
        f"  verdict   {content['verdict']}",
    ]
    for fault in replay.journal.faults:
        confidence = fault["confidence"]
        assert isinstance(confidence, float)
        lines.append(f"  fault     {fault['id']} ({confidence:.1%}) isolated at {fault['isolated_t']} s")
    lines += [f"  {line['t']!s:>9} s  {line['kind']}/{line['name']}: {line['text']}" for line in replay.journal.lines]
    if "replay" in content:
        same = isinstance(content["replay"], dict) and content["replay"]["same_sends"]
        lines.append(f"  replay    decided {'the same' if same else 'DIFFERENTLY'} as the recorded run")
    return "\n".join(lines)
