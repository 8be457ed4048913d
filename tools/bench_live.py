"""What the live companion costs, in real time with every stream at 50 Hz: CPU, memory, and how soon an alarm leaves.

`mavfdi sitl parafoil --rates fast` flies with crossed lines; `mavfdi run parafoil` watches it on one link while a bare
loop of pymavlink's parser reads the same stream on another, as the yardstick.  CPU is process time over wall time, after
the start; the delay of the alarm is taken from the log: STATUSTEXT sent, less the arrival of the row's newest sample.

    python tools/bench_live.py --seconds 60
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil

from companion.tlog import OWN_LINK, Reader
from loopback import free_port

START_S = 8.0  # imports, the choice of the vehicle, release
STREAMS = ("GLOBAL_POSITION_INT", "SERVO_OUTPUT_RAW", "WHEEL_DISTANCE", "ATTITUDE", "ATTITUDE_TARGET")
YARDSTICK = """
import socket, sys
from pymavlink.dialects.v20 import all as mavlink
link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
link.bind(("127.0.0.1", int(sys.argv[1])))
parser = mavlink.MAVLink(None)
parser.robust_parsing = True
while True:
    parser.parse_buffer(link.recv(65536))
"""


def cpu_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def alarm_delay_s(folder: Path) -> tuple[float, float]:
    """(delay, grid period): from the newest sample of the row that raised the alarm to the STATUSTEXT of it."""
    lines = [json.loads(line) for line in (folder / "events.jsonl").read_text().splitlines()]
    alarm_ms = round(1000.0 * next(line["t"] for line in lines if line["name"] == "detected"))
    arrived_us = 0
    for record in Reader(folder / "flight.tlog"):
        if record.stamp_us is None:
            continue
        fields = record.frame.fields()
        if record.link != OWN_LINK and fields.get("time_boot_ms") == alarm_ms:
            arrived_us = record.stamp_us
        if record.link == OWN_LINK and "something is wrong" in str(fields.get("text", "")):
            return (record.stamp_us - arrived_us) * 1e-6, 0.1
    raise SystemExit("no alarm in the log: fly longer")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=7)
    args = parser.parse_args()
    watched, plain = free_port(), free_port()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        config = folder / "fast.toml"
        config.write_text("[streams]\n" + "\n".join(f"{name} = 50.0" for name in STREAMS) + "\n")
        command = [sys.executable, "-m", "companion.cli"]
        link = f"udpin:127.0.0.1:{watched}"
        run = subprocess.Popen(
            [
                *(*command, "run", "parafoil", "--connect", link, "--policy", "auto"),
                *("--config", str(config), "--out", str(folder / "out"), "--quiet"),
            ],
            stdout=subprocess.PIPE,
        )
        bare = subprocess.Popen([sys.executable, "-c", YARDSTICK, str(plain)])
        sitl = subprocess.Popen(
            [
                *(*command, "sitl", "parafoil", "--rates", "fast", "--seed", str(args.seed)),
                *("--connect", f"udpout:127.0.0.1:{watched}", "--connect", f"udpout:127.0.0.1:{plain}"),
                *("--fault", "crossed_lines@15"),
            ],
            stdout=subprocess.DEVNULL,
        )
        try:
            time.sleep(START_S)
            watching, reading = psutil.Process(run.pid), psutil.Process(bare.pid)
            began_s, cpu_watching_s, cpu_reading_s = time.monotonic(), cpu_s(watching), cpu_s(reading)
            time.sleep(args.seconds)
            wall_s = time.monotonic() - began_s
            share = (cpu_s(watching) - cpu_watching_s) / wall_s
            yardstick = (cpu_s(reading) - cpu_reading_s) / wall_s
            memory_mb = watching.memory_info().rss / 1e6
        finally:
            for child in (sitl, run, bare):
                child.terminate()
                child.wait()
            if run.stdout is not None:
                run.stdout.close()
        counters = json.loads((folder / "out" / "summary.json").read_text())["counters"]
        rate_hz = counters["core.messages"] / (wall_s + START_S)
        delay_s, period_s = alarm_delay_s(folder / "out")
        print(f"messages           {rate_hz:.0f} a second, over {wall_s:.0f} s")
        print(f"mavfdi run         {share:.2%} of a core, {memory_mb:.0f} MB resident (bars: 5 %, 110 MB)")
        print(f"pymavlink parser   {yardstick:.2%} of a core on the same stream: ratio {share / yardstick:.2f}")
        print(
            f"alarm leaves       {1000.0 * delay_s:.1f} ms after the row's last sample,"
            f" a sample period is {1000.0 * period_s:.0f} ms"
        )


if __name__ == "__main__":
    main()
