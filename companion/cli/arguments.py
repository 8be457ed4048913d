"""What several commands ask for in the same words."""

import argparse
import signal
from collections.abc import Callable, Sequence
from pathlib import Path

from companion import address
from companion.clock import Clock, VehicleClock, WallClock
from companion.errors import UserError
from companion.link import Link, open_link


def add_connect(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument(
        "--connect",
        metavar="LINK",
        action="append",
        help=f"link to use, several times for several links; default {default}; for example {address.EXAMPLES}",
    )


def add_config(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", metavar="FILE", type=Path, help="TOML file laid over the packaged configuration")


def add_speedup(parser: argparse.ArgumentParser, default: str = "1") -> None:
    parser.add_argument(
        "--speedup",
        metavar="X",
        default=default,
        help="simulated seconds per second, or lockstep: step by step with the other side (sitl also: max)",
    )


def add_duration(parser: argparse.ArgumentParser, text: str) -> None:
    parser.add_argument("--duration", metavar="S", type=float, help=text)


def check_numbers(*, duration_s: float | None = None, sysid: int | None = None, seed: int | None = None) -> None:
    """What argparse took for numbers must be usable ones; None is not given.  Raises UserError."""
    if duration_s is not None and not 0.0 < duration_s < 1e9:  # False for NaN
        raise UserError(f"--duration {duration_s:g} is no duration; give seconds > 0")
    if sysid is not None and not 1 <= sysid <= 255:
        raise UserError(f"--sysid {sysid} is no system id; give 1 to 255")
    if seed is not None and seed < 0:
        raise UserError(f"--seed {seed} is no seed; give a whole number >= 0")


def open_links(texts: Sequence[str] | None, default: str, warn: Callable[[str], None]) -> list[Link]:
    """Open every link named, or the default.  Raises UserError; links opened before it are closed again."""
    links: list[Link] = []
    try:
        for text in texts or [default]:
            parsed = address.parse(text)
            if parsed.hint:
                warn(parsed.hint)
            if any(link.name == parsed.canonical for link in links):
                raise UserError(f"{parsed.canonical} is named twice")
            links.append(open_link(parsed))
    except UserError:
        for link in links:
            link.close()
        raise
    return links


def companion_clock(speedup: str) -> Clock:
    """The companion's clock for --speedup.  Raises UserError."""
    if speedup == "lockstep":
        return VehicleClock()
    try:
        factor = float(speedup)
    except ValueError:
        factor = 0.0
    if not 0.0 < factor < 1e6:
        raise UserError(f"--speedup {speedup} is no factor; give a number > 0, or lockstep")
    return WallClock(factor)


def on_stop_signal(stop: Callable[[str], None]) -> None:
    """SIGINT and SIGTERM end the run in order: files complete, summary written."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda caught, _frame: stop(signal.Signals(caught).name))
