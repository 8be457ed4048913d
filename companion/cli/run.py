"""`mavfdi run AIRFRAME`: beside an autopilot, or beside a simulator."""

import argparse
import sys
from pathlib import Path

from companion import airframe as airframes
from companion.cli import arguments
from companion.core import FIRST_COMPONENT, LAST_COMPONENT, Core
from companion.decision import Policy
from companion.effects import Effect, Tell
from companion.errors import UserError
from companion.journal import Journal
from companion.live import Live
from companion.recorder import MEGABYTE, Recorder, Rules, When, load_record
from companion.recovery import from_record

DEFAULT_LINK = "udpin:127.0.0.1:14550"
LEAST_SIZE_MB = 0.1  # half a minute of a busy link; anything less is a mistake in the unit


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("airframe")
    arguments.add_connect(parser, DEFAULT_LINK)
    parser.add_argument("--policy", choices=[policy.value for policy in Policy], default=Policy.ADVISE.value)
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("mavfdi-out"), help="folder for log, events, summary"
    )
    parser.add_argument(
        "--log",
        choices=[when.value for when in When],
        default=When.ALWAYS.value,
        help="when frames are recorded; default always",
    )
    parser.add_argument(
        "--log-size",
        metavar="MB",
        type=float,
        default=256.0,
        help="largest size of a log, then the next one follows; default 256",
    )
    parser.add_argument(
        "--free", metavar="MB", type=float, default=200.0, help="keep so much free by removing the oldest logs; default 200"
    )
    arguments.add_config(parser)
    arguments.add_duration(parser, "stop after so many seconds")
    arguments.add_speedup(parser)
    parser.add_argument("--sysid", type=int, help="listen to this system only; default: the first autopilot heard")
    parser.add_argument("--compid", type=int, help=f"our component id; default {FIRST_COMPONENT}, moving on if it is taken")
    parser.add_argument("--quiet", action="store_true", help="do not print events")


def main(args: argparse.Namespace) -> int:
    if args.compid is not None and not FIRST_COMPONENT <= args.compid <= LAST_COMPONENT:
        raise UserError(
            f"--compid {args.compid} is none for an onboard computer; give {FIRST_COMPONENT} to {LAST_COMPONENT}"
        )
    arguments.check_numbers(duration_s=args.duration, sysid=args.sysid)
    rules = log_rules(args.log, args.log_size, args.free)
    airframe = airframes.load(args.airframe, args.config)
    clock = arguments.companion_clock(args.speedup)
    record = read_record(args.out)
    links = arguments.open_links(args.connect, DEFAULT_LINK, lambda text: print(text, file=sys.stderr))
    try:
        core = Core(
            airframe,
            Policy(args.policy),
            pinned_sysid=args.sysid,
            record=record,
            compid=args.compid or FIRST_COMPONENT,
            pinned_compid=args.compid is not None,
        )
        observe = None if args.quiet else show
        live = Live(core, links, clock, Recorder(args.out, rules), Journal(airframe), observe)

        def stop(why: str) -> None:
            live.stop = why

        arguments.on_stop_signal(stop)
        names = ", ".join(link.name for link in links)
        path = live.recorder.events_path if rules.when is When.OFF else live.recorder.tlog_path
        print(f"mavfdi: {airframe.name} on {names}, policy {args.policy}, recording to {path}", flush=True)
        content = live.run(args.duration)
    finally:
        for link in links:
            link.close()
    print(f"mavfdi: {live.stop}; verdict {content['verdict']}", flush=True)
    return 0


def log_rules(when: str, size_mb: float, free_mb: float) -> Rules:
    """What --log, --log-size and --free ask for.  Raises UserError."""
    if not LEAST_SIZE_MB <= size_mb < 1e6:  # False for NaN
        raise UserError(f"--log-size {size_mb:g} is no size of a log; give {LEAST_SIZE_MB:g} MB or more")
    if not 0.0 <= free_mb < 1e9:
        raise UserError(f"--free {free_mb:g} is no room on a disk; give MB >= 0, 0 to remove nothing")
    return Rules(When(when), round(size_mb * MEGABYTE), round(free_mb * MEGABYTE))


def read_record(folder: Path) -> str:
    """What a killed run left there.  Raises UserError for a record that is damaged: somebody must look at the vehicle."""
    record = load_record(folder)
    if record:
        try:
            from_record(record)
        except ValueError as error:
            raise UserError(f"{folder}/recovery.json: {error}; check the vehicle's outputs, then remove it") from None
    return record


def show(effect: Effect) -> None:
    """One event, one line."""
    if isinstance(effect, Tell):
        event = effect.event
        t = f"{event.t:8.1f}" if event.t is not None else "       -"
        reason = f" ({event.reason})" if event.reason else ""
        print(f"{t} s  {event.severity.value:9} {event.kind.value}/{event.name}: {event.text}{reason}", flush=True)
