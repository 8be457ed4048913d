"""What `mavfdi analyze` of one flight costs, start of the interpreter to the JSON: CPU of the child process.

The log is one of our own simulator, made in one process: a ten-minute flight with every stream at its fast rate, both
directions, crossed lines included.  The first child warms numba's cache and the file's pages and does not count; then
the median of several.  `--parts` times reading, checks and replay one by one in this process, the best of three;
`--profile` runs once more under cProfile and prints where the time went, `--imports` prints the slowest imports.

    python tools/bench_analyze.py
"""

import argparse
import gc
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from companion import airframe as airframes
from companion.analysis import Replay
from companion.checks import Bench
from companion.decision import Policy
from companion.rehearsal import Rehearsal
from companion.tlog import Reader
from sitl.autopilot import Autopilot
from sitl.vehicle import parse_fault

BAR_S = 2.0
PROFILED = """
import cProfile, pstats, sys
from companion.cli import main
profile = cProfile.Profile()
code = profile.runcall(main)
pstats.Stats(profile).sort_stats("tottime").print_stats(45)
sys.exit(code)
"""
COMMAND = ("-m", "companion.cli", "analyze", "--json")


def fly(path: Path, seconds: float, seed: int) -> None:
    """Record one flight."""
    airframe = airframes.load("parafoil")
    simulator = airframe.load_simulator()
    fleet = simulator.Fleet(airframe.simulator_config(simulator), [seed], [parse_fault("crossed_lines@200")])
    flight = Rehearsal(airframe, Autopilot(simulator.VEHICLE, fleet, seed=seed, rates="fast"), Policy.AUTO, keep_log=True)
    flight.fly(seconds)
    path.write_bytes(flight.log)


def child(words: list[str]) -> tuple[float, bytes]:
    """Run it; -> CPU seconds (user and system, of this child alone) and what it printed.

    Raises RuntimeError where it found no fault or could not do it.
    """
    with tempfile.TemporaryFile() as out:
        process = subprocess.Popen([sys.executable, *words], stdout=out)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode != 1:
            raise RuntimeError(f"exit code {process.returncode}, not 1: the crossed lines were not found")
        out.seek(0)
        return usage.ru_utime + usage.ru_stime, out.read()


def parts_s(log: Path) -> dict[str, float]:
    """CPU seconds of the parts of one analysis of our own flight, the monitor's within the replay's; imports not counted."""
    airframe = airframes.load("parafoil")
    records = list(Reader(log))

    def check() -> None:
        bench = Bench()
        for stamp_us, frame in records:
            bench.take(frame, stamp_us)
        bench.finish()

    def replay() -> None:
        again = Replay(airframe)
        for record in records:
            again.take(record)

    return {"reading": best_s(lambda: list(Reader(log))), "checks": best_s(check), "replay": best_s(replay)}


def best_s(work: Callable[[], object]) -> float:
    spent_s = []
    gc.disable()  # as `analyze` does it
    for _ in range(3):
        before_s = time.process_time()
        work()
        spent_s.append(time.process_time() - before_s)
    gc.enable()
    return min(spent_s)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--log", type=Path, help="this log instead of a flight of our own; it must hold a fault")
    parser.add_argument("--parts", action="store_true", help="print what reading, checks and replay cost")
    parser.add_argument("--profile", action="store_true", help="print where the time goes, by cProfile")
    parser.add_argument("--imports", action="store_true", help="print the slowest imports")
    args = parser.parse_args()
    bar = f"(bar: {BAR_S} s)"
    with tempfile.TemporaryDirectory() as scratch:
        log = args.log or Path(scratch) / "flight.tlog"
        if args.log is None:
            fly(log, args.seconds, args.seed)
        child([*COMMAND, str(log)])
        spent_s, printed = zip(*(child([*COMMAND, str(log)]) for _ in range(args.runs)), strict=True)
        content = json.loads(printed[0])
        messages = sum(content["reader"]["messages"].values())
        median_s = statistics.median(spent_s)
        print(f"log        {messages} messages, {content['duration_s']:.0f} s, {content['log']['bytes'] / 1e6:.1f} MB")
        print(f"analyze    {median_s:.2f} s of CPU, {min(spent_s):.2f} to {max(spent_s):.2f} in {args.runs} runs {bar}")
        print(f"           {1e6 * median_s / messages:.1f} us a message, start included")
        if args.parts:
            for name, part_s in parts_s(log).items():
                print(f"{name:10} {part_s:.2f} s")
        if args.profile:
            _, said = child(["-c", PROFILED, *COMMAND[2:], str(log)])
            print("\n".join(said.decode().splitlines()[1:60]))
        if args.imports:
            subprocess.run([sys.executable, "-X", "importtime", *COMMAND, str(log)], stdout=subprocess.DEVNULL, check=False)


if __name__ == "__main__":
    main()
