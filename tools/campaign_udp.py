"""Crossed lines and healthy flights over real UDP: `mavfdi sitl` and `mavfdi run` as two processes at a speed-up.

For every crossed flight the onset is drawn with the seed; the recorded log gives detection, isolation and the tracking of
the commanded turn before the fault, until the outputs were exchanged, and after.  For healthy flights it counts alarms and
recoveries.  Prints a row a flight and the totals with Wilson 95 % intervals.

    python tools/campaign_udp.py --crossed 20 --healthy 20 --seed 910000000 --speedup 30
"""

import argparse
import json
import math
import random
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from companion import airframe as airframes
from companion.analysis import Replay
from companion.picture import History
from companion.tlog import Reader
from intervals import share
from loopback import free_port

RELEASE_S = 5.0
ONSET_S = (30, 300)
AFTER_S = 150.0
DETECTED_WITHIN_S, ISOLATED_WITHIN_S = 60.0, 90.0


@dataclass(frozen=True, slots=True)
class Flight:
    """What one flight's log shows; times since the onset, NaN where it did not happen."""

    seed: int
    onset_s: float
    detected_s: float
    isolated_s: float
    named: str
    recovery: str
    before_rad_s: float
    during_rad_s: float
    after_rad_s: float
    residual_after: float  # largest heading-rate residual from the verification to the end, as a share of its threshold
    alarms: int
    requests: int
    frames_lost: int

    @property
    def good(self) -> bool:
        in_time = self.detected_s <= DETECTED_WITHIN_S and self.isolated_s <= ISOLATED_WITHIN_S
        return in_time and self.named == "crossed_lines"


def fly(seed: int, fault: str | None, duration_s: float, speedup: str, folder: Path) -> Path:
    """Two processes, one flight; -> its log."""
    port = free_port()
    command = [sys.executable, "-m", "companion.cli"]
    watch = subprocess.Popen(
        [
            *(*command, "run", "parafoil", "--connect", f"udpin:127.0.0.1:{port}", "--policy", "auto"),
            *("--speedup", speedup, "--out", str(folder), "--quiet"),
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert watch.stdout is not None
    watch.stdout.readline()  # it says when it listens
    fault_words = ["--fault", fault] if fault else []
    subprocess.run(
        [
            *(*command, "sitl", "parafoil", "--connect", f"udpout:127.0.0.1:{port}", "--seed", str(seed)),
            *("--speedup", speedup, "--duration", str(duration_s), *fault_words),
        ],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    watch.terminate()
    watch.communicate()
    return folder / "flight.tlog"


def look(seed: int, onset_s: float, log: Path) -> Flight:
    """Read one flight's log."""
    history = History()
    replay = Replay(airframes.load("parafoil"), observe=history.note)
    reader = Reader(log)
    for record in reader:
        replay.take(record)
    times: dict[str, float] = {}
    for line in replay.journal.lines:
        if isinstance(line["t"], float):
            times.setdefault(f"{line['kind']}/{line['name']}", line["t"])
    onset_t, end_t = onset_s + RELEASE_S, history.t_s[-1]
    swapped_t = times.get("recovery/acknowledged", math.nan)
    place = replay.airframe.detector.residuals.index("heading_rate")
    verified_t = times.get("recovery/verified", math.inf)
    after = [
        float(residual[place] / history.thresholds[place])
        for t, residual in zip(history.t_s, history.residuals, strict=True)
        if t >= verified_t and math.isfinite(residual[place])
    ]
    return Flight(
        seed,
        onset_s,
        times.get("fault/detected", math.nan) - onset_t,
        times.get("fault/isolated", math.nan) - onset_t,
        replay.core.faults[0].id if replay.core.faults else "none",
        replay.core.recovery.stage.value if replay.core.recovery else "none",
        history.tracking_rms(RELEASE_S, onset_t),
        history.tracking_rms(onset_t, swapped_t),
        history.tracking_rms(swapped_t + 5.0, min(swapped_t + 65.0, end_t)),
        max(after, default=math.nan),
        replay.journal.alarms,
        sum(content[:3] == (23).to_bytes(3, "little") for content in replay.recorded),  # PARAM_SET
        sum(source.seq_lost for (_, compid), source in reader.report.sources.items() if compid == 1),
    )


def as_text(flight: Flight) -> str:
    return (
        f"{flight.seed} onset {flight.onset_s:5.0f} s  detected {flight.detected_s:5.1f}"
        f"  isolated {flight.isolated_s:5.1f}  {flight.named:18} {flight.recovery:12}"
        f" rms {flight.before_rad_s:.3f} {flight.during_rad_s:.3f} {flight.after_rad_s:.3f}"
        f"  residual after {flight.residual_after:.2f}"
        f"  alarms {flight.alarms} requests {flight.requests} lost {flight.frames_lost}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--crossed", type=int, default=20)
    parser.add_argument("--healthy", type=int, default=20)
    parser.add_argument("--healthy-s", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=10_000, help="of the first flight; judging seeds begin at 900000000")
    parser.add_argument("--speedup", default="30")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    began_s, flights = time.monotonic(), []
    total = args.crossed + args.healthy
    with tempfile.TemporaryDirectory() as scratch:
        for number in range(total):
            seed = args.seed + number
            crossed = number < args.crossed
            onset_s = float(random.Random(seed).randint(*ONSET_S)) if crossed else math.nan
            fault, duration_s = (f"crossed_lines@{onset_s:g}", onset_s + AFTER_S) if crossed else (None, args.healthy_s)
            log = fly(seed, fault, duration_s + RELEASE_S, args.speedup, Path(scratch) / str(seed))
            flight = look(seed, onset_s, log)
            flights.append(flight)
            if args.json:
                print(json.dumps({name: getattr(flight, name) for name in Flight.__slots__}), flush=True)
            else:
                print(as_text(flight), flush=True)
            passed_s = time.monotonic() - began_s
            left_s = passed_s / (number + 1) * (total - number - 1)
            print(f"{number + 1}/{total}, {left_s:.0f} s left", end="\r", file=sys.stderr, flush=True)
    broken, whole = flights[: args.crossed], flights[args.crossed :]
    if broken:
        good = sum(flight.good for flight in broken)
        print(f"crossed: {good}/{len(broken)} detected in 60 s and named in 90 s: {share(good, len(broken))}")
        mended = [flight for flight in broken if flight.recovery == "done"]
        print(f"crossed: {len(mended)}/{len(broken)} mended and verified")
        for name in ("detected_s", "isolated_s", "before_rad_s", "during_rad_s", "after_rad_s", "residual_after"):
            values = sorted(getattr(flight, name) for flight in broken if math.isfinite(getattr(flight, name)))
            if values:
                print(f"  {name:16} median {statistics.median(values):.3f}  largest {values[-1]:.3f}")
    if whole:
        alarmed = sum(flight.alarms > 0 for flight in whole)
        requests = sum(flight.requests for flight in whole)
        print(
            f"healthy: {alarmed}/{len(whole)} flights with an alarm: {share(alarmed, len(whole))};"
            f" {requests} PARAM_SETs sent"
        )


if __name__ == "__main__":
    main()
