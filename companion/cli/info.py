"""`mavfdi info LOG`: what is in a log, without judging it."""

import argparse
import sys
from pathlib import Path

from companion.analysis import facts
from companion.cli import FAILED, compiling
from companion.errors import UserError
from companion.events import Json, encode

MOST_MESSAGES = 12  # named in the summary for people


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("logs", metavar="LOG", nargs="+", type=Path, help=".tlog or .tlog.gz")
    parser.add_argument("--json", action="store_true", help="one JSON object a line, one line a log")


def main(args: argparse.Namespace) -> int:
    compiling.announce(args.logs)
    code = 0
    for path in args.logs:
        try:
            content = facts(path)
        except UserError as error:
            print(f"mavfdi info: {error}", file=sys.stderr)
            code = FAILED
            continue
        print(encode(content) if args.json else text(content), flush=True)
    return code


def text(content: dict[str, Json]) -> str:
    """The facts for people."""
    log, reader, vehicles = content["log"], content["reader"], content["vehicles"]
    assert isinstance(log, dict)
    assert isinstance(reader, dict)
    assert isinstance(vehicles, list)
    messages = reader["messages"]
    assert isinstance(messages, dict)
    counted = sorted(messages.items(), key=lambda item: -int(str(item[1])))
    most = ", ".join(f"{name} {count}" for name, count in counted[:MOST_MESSAGES])
    lines = [
        f"{log['path']}: {log['bytes']} bytes",
        f"  frames    {reader['frames_v1']} MAVLink 1, {reader['frames_v2']} MAVLink 2, {reader['signed']} signed",
        f"  damage    {reader['crc_failures']} CRC failures, {reader['resyncs']} resyncs ({reader['resync_bytes']} bytes),"
        f" tail {reader['tail_bytes']}, {reader['unknown_frames']} of unknown ids",
        f"  duration  {content['duration_s']} s",
    ]
    for vehicle in vehicles:
        assert isinstance(vehicle, dict)
        lines.append(
            f"  vehicle   system {vehicle['sysid']} component {vehicle['compid']},"
            f" MAV_AUTOPILOT {vehicle['autopilot']}, MAV_TYPE {vehicle['type']}"
        )
    lines.append(f"  messages  {most}")
    return "\n".join(lines)
