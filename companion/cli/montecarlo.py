"""`mavfdi montecarlo AIRFRAME`: thousands of simulated flights through the monitor, one row a flight."""

import argparse
import contextlib
import itertools
import os
import signal
import sys
import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

from companion import airframe as airframes
from companion.airframe import Airframe
from companion.cli import arguments
from companion.errors import UserError
from companion.events import Json, encode
from companion.picture import History, draw

if TYPE_CHECKING:
    from companion.campaign import Columns, Settings

DURATION_S: Final = 600.0
HEALTHY: Final = "none"
MOMENT_S: Final = 0.5  # of flight in which everything that is compiled has been called
COMPILE_S: Final = 5.0  # longer than that takes with everything compiled before
MOST_SEEDS: Final = 1 << 62
STOPPED: Final = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("airframe")
    parser.add_argument("--flights", metavar="N", type=int, help="so many, of consecutive seeds")
    parser.add_argument("--seed", metavar="N", type=int, help="of the first flight")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, required=True, help="for flights.parquet; begun there, it goes on"
    )
    parser.add_argument(
        "--faults",
        metavar="none,ID,...",
        help="each flight draws one of them with even chance, and what an ID leaves open; default: none, which is healthy",
    )
    parser.add_argument("--detector", metavar="NAME", help="another one of the airframe's own than its configuration names")
    parser.add_argument("--link", action="store_true", help="round, lose and delay the vehicle's messages as a radio does")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--jobs", metavar="N", type=int, help="processes; default: one for each core")
    where.add_argument("--cluster", metavar="ADDRESS", help="fly on the workers of this scheduler of dask.distributed")
    parser.add_argument(
        "--only", metavar="SEED", type=int, help="fly this seed alone through real MAVLink bytes, and show it"
    )
    arguments.add_duration(parser, f"of a flight, if it does not land before; default {DURATION_S:g}")
    arguments.add_config(parser)


def main(args: argparse.Namespace) -> int:
    _check(args)
    airframe = airframes.load(args.airframe, args.config)
    airframe.load_simulator()  # says what is missing where the simulator's extra is
    try:
        import pyarrow  # noqa: F401  # asked for here: without it nothing of what follows could be kept

        from companion import campaign
    except ModuleNotFoundError as error:
        extra = "sitl" if error.name == "numba" else "analysis"
        raise UserError(f"montecarlo needs {error.name}; install it with: pip install 'mavfdi[{extra}]'") from None
    if args.only is not None:
        return _only(airframe, args)
    if args.flights is None or args.seed is None:
        raise UserError("give --flights N and --seed N, or --only SEED")
    if args.detector is not None:
        airframe = campaign.with_detector(airframe, args.detector)
    faults = tuple((args.faults or HEALTHY).split(","))
    duration_s = args.duration or DURATION_S
    wanted = campaign.settings(airframe, args.seed, args.flights, faults, duration_s, link=args.link)
    check_faults(airframe, wanted)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with contextlib.closing(campaign.Store(args.out, wanted)) as store:
        progress = Progress(wanted.flights, wanted.flights - sum(len(run) for run in store.missing))
        try:
            with contextlib.closing(_flown(airframe, wanted, store.missing, args)) as flown:
                for columns in flown:
                    if columns is not None:
                        store.keep(columns)
                        progress.flown += len(columns["seed"])
                    progress.show()
            path = store.join()
        except KeyboardInterrupt:
            progress.clear()
            kept = wanted.flights - sum(
                len(run) for run in store.missing
            )  # asked of the disk: a signal may fall behind a part
            print(f"mavfdi montecarlo: stopped; {kept} of {wanted.flights} flights are kept in {args.out}", file=sys.stderr)
            print("mavfdi montecarlo: the same command goes on from there", file=sys.stderr)
            return STOPPED
        finally:
            progress.clear()
    print(f"{path}: {wanted.flights} flights, {progress.told()}")
    return 0


def _check(args: argparse.Namespace) -> None:
    """What argparse took for numbers must be usable ones.  Raises UserError."""
    arguments.check_numbers(duration_s=args.duration, seed=args.seed)
    for name in ("flights", "jobs"):
        number = getattr(args, name)
        if number is not None and number < 1:
            raise UserError(f"--{name} {number}: give at least 1")
    if args.only is not None and args.only < 0:
        raise UserError(f"--only {args.only} is no seed; give a whole number >= 0")
    if max(args.seed or 0, args.only or 0, args.flights or 0) >= MOST_SEEDS:
        raise UserError(f"seeds and flights are numbers below {MOST_SEEDS}")
    if args.faults is not None and "" in args.faults.split(","):
        raise UserError(f"--faults {args.faults}: an id is empty; give for example {HEALTHY},crossed_lines")


def check_faults(airframe: Airframe, wanted: "Settings") -> None:
    """Build a vehicle with each of the faults, and fly a moment: what it refuses is a mistake of the command.

    It also compiles what is to be compiled, before several processes would do so at once.  Raises UserError.
    """
    from companion import campaign

    began_s = time.monotonic()
    for fault in dict.fromkeys(wanted.faults):
        batch = campaign.Batch(airframe, wanted.first_seed, 1, (fault,), MOMENT_S, wanted.link)
        try:
            campaign.prepare(batch)
        except ValueError as error:
            raise UserError(f"{airframe.name}: {error}") from None
        campaign.fly(batch)
    if time.monotonic() - began_s > COMPILE_S and sys.stderr.isatty():
        print("compiled the plant and the monitor, once for this installation", file=sys.stderr)


def _flown(
    airframe: Airframe, wanted: "Settings", missing: Sequence[range], args: argparse.Namespace
) -> "Generator[Columns | None]":
    from companion import campaign

    if not missing:
        return
    if args.cluster is None:
        jobs = args.jobs or os.cpu_count() or 1
        yield from campaign.flown_here(campaign.batches(airframe, wanted, missing, jobs), jobs)
        return
    with contextlib.closing(campaign.Cluster(args.cluster)) as cluster:
        yield from cluster.flown(campaign.batches(airframe, wanted, missing, cluster.workers))


@dataclass(slots=True)
class Progress:
    """How far it is: one line that is written over, on a terminal only."""

    flights: int
    before: int  # flown by earlier runs
    flown: int = 0
    _began_s: float = field(default_factory=lambda: time.monotonic())

    def show(self) -> None:
        if not sys.stderr.isatty():
            return
        passed_s = time.monotonic() - self._began_s
        left = self.flights - self.before - self.flown
        pace = f"{self.flown / passed_s:.0f}/s, {passed_s / self.flown * left:.0f} s left" if self.flown else "first batches"
        text = f"{self.before + self.flown}/{self.flights} flights, {passed_s:.0f} s, {pace}"
        print(f"\r{text:60}", end="", file=sys.stderr, flush=True)

    def clear(self) -> None:
        if sys.stderr.isatty():
            print(f"\r{'':60}\r", end="", file=sys.stderr, flush=True)

    def told(self) -> str:
        """For the last line."""
        passed_s = time.monotonic() - self._began_s
        if not self.flown:
            return "all of them flown before"
        earlier = f" ({self.before} of them flown before)" if self.before else ""
        return f"in {passed_s:.0f} s, {self.flown / passed_s:.0f}/s{earlier}"


# -- one seed -----------------------------------------------------------------------------------------------------------


def _only(airframe: Airframe, args: argparse.Namespace) -> int:
    """Fly one seed in a batch of one and through real MAVLink bytes, print both, keep log, events and picture."""
    from companion import campaign

    path = args.out / campaign.FILE_NAME
    kept = campaign.kept_settings(path) if path.exists() else None
    detector = args.detector or (kept.detector if kept is not None else "")
    if detector:
        airframe = campaign.with_detector(airframe, detector)
    faults = tuple(args.faults.split(",")) if args.faults else kept.faults if kept is not None else (HEALTHY,)
    duration_s = args.duration or (kept.duration_s if kept is not None else DURATION_S)
    link = args.link or (kept is not None and kept.link)
    wanted = campaign.settings(airframe, args.only, 1, faults, duration_s, link=link)
    if kept is not None:
        campaign.check_same(path, replace(kept, first_seed=args.only, flights=1), wanted)
    check_faults(airframe, wanted)
    batch = campaign.Batch(airframe, args.only, 1, faults, duration_s, link)
    row = campaign.fly(batch)
    history = History()
    replayed = campaign.rehearse(batch, history.note)
    folder = args.out / f"seed-{args.only}"
    picture = folder / "flight.png"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "flight.tlog").write_bytes(replayed.log)
        (folder / "events.jsonl").write_text("".join(f"{encode(line)}\n" for line in replayed.lines), encoding="utf-8")
        draw(picture, history, airframe.detector, replayed.lines, replayed.onsets)
    except OSError as error:
        raise UserError(f"{folder}: cannot write here: {error.strerror or error}") from None
    line = "the batch's line, draw for draw" if link else "no line: what the batch has unrounded is rounded here"
    print(f"{airframe.name}, seed {args.only}.  Left: batch, MAVLink bytes.  Right: events of the bytes, s since release")
    print(f"({line})")
    _print_beside(_compared(row, replayed.columns), _events(replayed.lines, replayed.release_s))
    if kept is not None:
        print(_said_of_table(path, args.only, row))
    print(f"{folder}: flight.tlog, events.jsonl, {picture.name}")
    return 0


def _compared(row: "Columns", replayed: "Columns") -> list[str]:
    lines = [(name, _shown(row[name][0]), _shown(replayed[name][0])) for name in row]
    widths = [max(map(len, column)) + 2 for column in zip(*lines, strict=True)]
    return ["".join(f"{text:{width}}" for text, width in zip(line, widths, strict=True)) for line in lines]


def _shown(value: object) -> str:
    if value is None or value != value:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _events(lines: Sequence[dict[str, Json]], release_s: float) -> list[str]:
    return [
        f"{line['t'] - release_s:8.1f}  {line['kind']}/{line['name']}: {line['text']}"
        for line in lines
        if isinstance(line["t"], float)
    ]


def _print_beside(left: Sequence[str], right: Sequence[str]) -> None:
    width = max(map(len, left))
    for one, other in itertools.zip_longest(left, right, fillvalue=""):
        print(f"{one:{width}}  {other}".rstrip())


def _said_of_table(path: Path, seed: int, row: "Columns") -> str:
    """Whether the table has this very row."""
    from pyarrow import compute, parquet

    from companion import campaign

    found = parquet.read_table(path)
    found = found.filter(compute.equal(found["seed"], seed))
    if not found.num_rows:
        return f"{path}: has no such seed"
    same = found.to_pylist() == campaign.table(row).to_pylist()
    return f"{path}: has {'the same row' if same else 'ANOTHER ROW of this seed; please report it'}"
