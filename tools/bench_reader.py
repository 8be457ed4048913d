"""Reading a large log into SI columns: CPU time beside fasttlogparser and a bare compiled walk, in one run.

The log is made by repeating undamaged logs with shifted stamps up to the size asked for (from the folder given, or, without
one, a recording of our own simulator).  Each reader runs in a process of its own, once to warm up where it compiles, then
seven times; the median counts.  CPU is user plus system time; peak memory is the process's largest resident set less
what it had before.

    python tools/bench_reader.py --megabytes 200 --logs ../shared/data/tlogs

fasttlogparser (optional) builds from source: pip install scikit-build-core pybind11 ninja cmake, then
pip install --no-build-isolation --no-deps fasttlogparser, here or in the environment whose Python --yardstick names.
"""

import argparse
import gzip
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

BARE = '''
import mmap, sys, time, resource, statistics
import numpy as np
from numba import njit
from companion import walk

@njit(cache=False)
def bare(data, seeds, table):
    """Frames and CRC only, one look-up a byte; no damage, no stamps, nothing kept."""
    n, position, count = data.shape[0], 0, 0
    while position + 8 < n:
        q = position + 8
        length = np.int64(data[q + 1])
        if data[q] == 0xFD:
            body = q + 10
            message_id = np.int64(data[q + 7]) | np.int64(data[q + 8]) << 8 | np.int64(data[q + 9]) << 16
            more = 13 if data[q + 2] & 1 else 0
        elif data[q] == 0xFE:
            body, message_id, more = q + 6, np.int64(data[q + 5]), 0
        else:
            position += 1
            continue
        end = body + length + 2
        if end > n or message_id >= seeds.shape[0]:
            position += 1
            continue
        crc = np.int64(0xFFFF)
        for k in range(q + 1, body + length):
            crc = (crc >> 8) ^ np.int64(table[(crc ^ np.int64(data[k])) & 0xFF])
        crc = (crc >> 8) ^ np.int64(table[(crc ^ np.int64(seeds[message_id])) & 0xFF])
        if crc != np.int64(data[end - 2]) | np.int64(data[end - 1]) << 8:
            position += 1
            continue
        count += 1
        position = end + more
    return count

def once(path):
    with open(path, "rb") as file:
        data = np.frombuffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), dtype=np.uint8)
        return bare(data, walk.seeds(), walk.crc_tables()[:256].astype(np.int32)), 0
'''
OURS = """
from pathlib import Path
import sys, time, resource, statistics
from companion import columns

def once(path):
    index = columns.read(Path(path))
    found = index.columns()
    kept = sum(field.nbytes for part in found.values() for field in part.fields.values())
    for part in found.values():
        kept += part.frames.nbytes + part.stamp_us.nbytes + part.sysid.nbytes + part.compid.nbytes
    return sum(len(part.frames) for part in found.values()), kept
"""
PARSER = """
import sys, time, resource, statistics
import fasttlogparser

def once(path):
    found, _ = fasttlogparser.parseTLog(path)
    kept = sum(field.nbytes for fields in found.values() for field in fields.values())
    return sum(len(next(iter(fields.values()))) for fields in found.values()), kept
"""
MEASURE = """
import json
small, large = sys.argv[1:3]
once(small)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
spent = []
for _ in range(7):
    began = time.process_time()
    frames, kept = once(large)
    spent.append(time.process_time() - began)
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
print(json.dumps({"frames": frames, "cpu_s": statistics.median(spent), "peak_mb": peak / 1024, "kept_mb": kept / 1e6}))
"""


def plain_logs(folder: Path | None) -> Iterator[bytes]:
    """Undamaged logs of ArduPilot vehicles, or one of our own simulator."""
    if folder is not None:
        for entry in json.loads((folder / "INDEX.json").read_text())["logs"]:
            whole = not any(entry[key] for key in ("crc_failures", "resyncs", "tail_bytes", "unknown_frames", "unstamped"))
            if whole and "ARDUPILOTMEGA" in str(entry["vehicle"]) and not entry["stamps_implausible"]:
                yield gzip.decompress((folder / entry["file"]).read_bytes())
        return
    from companion.airframe import load
    from companion.decision import Policy
    from companion.rehearsal import Rehearsal
    from sitl.autopilot import Autopilot

    airframe = load("parafoil")
    simulator = airframe.load_simulator()
    fleet = simulator.Fleet(airframe.simulator_config(simulator), [1], None)
    flight = Rehearsal(airframe, Autopilot(simulator.VEHICLE, fleet), Policy.OFF, keep_log=True)
    flight.fly(600.0)
    yield bytes(flight.log)


def measure(python: str, code: str, small: Path, large: Path) -> dict[str, float]:
    done = subprocess.run(
        [python, "-c", code + MEASURE, str(small), str(large)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(done.stderr.strip().splitlines()[-1])
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--megabytes", type=float, default=200.0)
    parser.add_argument("--logs", type=Path, help="folder with INDEX.json and its logs; default: our own simulator's")
    parser.add_argument("--yardstick", help="Python that has fasttlogparser; default: this one, if it has it")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        small, large = Path(scratch) / "small.tlog", Path(scratch) / "large.tlog"
        parts = list(plain_logs(args.logs))
        small.write_bytes(parts[0][:100_000])
        whole = b"".join(parts)
        with large.open("wb") as file:
            for _ in range(max(1, round(args.megabytes * 1e6 / len(whole)))):
                file.write(whole)
        size_mb = large.stat().st_size / 1e6
        print(f"{size_mb:.0f} MB from {len(parts)} logs")
        bare = measure(sys.executable, BARE, small, large)
        ours = measure(sys.executable, OURS, small, large)
        rows = [("bare walk, byte-wise CRC", bare), ("mavfdi, all types into SI columns", ours)]
        try:
            rows.append(("fasttlogparser, all types", measure(args.yardstick or sys.executable, PARSER, small, large)))
        except SystemExit as error:
            print(f"fasttlogparser: not measured ({error})")
        for name, row in rows:
            print(
                f"{name:35} {row['cpu_s']:6.3f} s CPU  {size_mb / row['cpu_s']:6.0f} MB/s  {row['frames']:.0f} frames"
                f"  peak {row['peak_mb']:.0f} MB, kept {row['kept_mb']:.0f} MB"
            )
        print(f"share of the bare walk's speed: {bare['cpu_s'] / ours['cpu_s']:.2f} (bar 0.50)")
        if len(rows) > 2:
            print(f"times fasttlogparser's speed: {rows[2][1]['cpu_s'] / ours['cpu_s']:.1f} (bar 8)")
        print(f"peak memory over what is kept: {ours['peak_mb'] / ours['kept_mb']:.2f} (bar 2.5)")


if __name__ == "__main__":
    main()
