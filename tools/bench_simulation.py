"""Measure how fast the parafoil is simulated: over MAVLink to one client, and in process by the thousand.

Over MAVLink: the autopilot with all its streams at full speed over UDP loopback, at stock and at fast rates, to one client
in a process of its own that throws away what it reads; only the simulator's CPU time counts.  Beside it the bare plant at
the same step.  In process: --flights flights of 600 s each through plant and monitor.  All figures are CPU seconds of one
core (user and system) and ratios; the bars are those of the project, and a figure that misses one ends with exit code 1.

    python tools/bench_simulation.py
"""

import argparse
import contextlib
import multiprocessing
import socket
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import msgspec
import numpy as np

import fdi.parafoil as detector
import sitl.parafoil as simulator
from companion import address
from companion.dialect import encode
from companion.frames import Splitter
from companion.link import open_link
from sitl.autopilot import Autopilot, Rates
from sitl.clock import Clock
from sitl.server import serve

CONFIG = Path(__file__).parent.parent / "configs" / "parafoil.toml"
PERIOD_S = 0.1
FLIGHT_S = 600.0
BATCH = 500
PROGRESS_S = 10.0
LEAST_REAL_TIME = 50.0  # bar: simulated seconds a CPU second, over MAVLink
ENSEMBLE = 1000  # flights of the other bar
MOST_CPU_S = 60.0  # and the CPU time that they may take
DATAGRAM_BYTES = 65536
BEAT_S = 0.5


@dataclass(frozen=True, slots=True)
class Drained:
    """What the client has read."""

    datagrams: int
    bytes: int
    frames: int
    damaged: int  # frames with a wrong checksum


def drain(pipe: Connection) -> None:
    """Listen on a port of its own, say the port, beat like a ground station, read until told to stop; say what came."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        client.bind(("127.0.0.1", 0))
        client.settimeout(0.05)
        pipe.send(client.getsockname()[1])
        pieces: list[bytes] = []
        vehicle, sequence, beat_s = None, 0, 0.0
        while not pipe.poll():
            with contextlib.suppress(TimeoutError):
                data, vehicle = client.recvfrom(DATAGRAM_BYTES)
                pieces.append(data)
            if vehicle is not None and time.monotonic() >= beat_s:
                beat_s = time.monotonic() + BEAT_S
                client.sendto(encode("HEARTBEAT", {"type": 6, "autopilot": 8}, sysid=255, compid=190, seq=sequence), vehicle)
                sequence += 1
        client.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                pieces.append(client.recv(DATAGRAM_BYTES))
    splitter = Splitter()
    frames = sum(len(splitter.feed(piece)) for piece in pieces)
    pipe.send(Drained(len(pieces), sum(map(len, pieces)), frames, splitter.counts["bad_crc"]))


@contextlib.contextmanager
def draining() -> Iterator[tuple[int, Connection]]:
    """A client in a process of its own; -> its port, and the pipe that stops it and then says what it read."""
    ours, theirs = multiprocessing.Pipe()
    client = multiprocessing.get_context("spawn").Process(target=drain, args=(theirs,), daemon=True)
    client.start()
    try:
        yield ours.recv(), ours
    finally:
        client.join(60.0)


def configuration() -> tuple[simulator.Config, detector.Config]:
    tables = tomllib.loads(CONFIG.read_text(encoding="utf-8"))
    return msgspec.convert(tables["sitl"], simulator.Config), msgspec.convert(tables["monitor"], detector.Config)


def fly_over_mavlink(rates: Rates, seconds: float, seed: int) -> tuple[float, float, int, Drained]:
    """-> CPU s, wall s, frames sent, and what the client read."""
    autopilot = Autopilot(simulator.VEHICLE, simulator.Fleet(configuration()[0], [seed]), rates=rates, release_s=1.0)
    with draining() as (port, client):
        link = open_link(address.parse(f"udpout:127.0.0.1:{port}"))
        cpu_s, wall_s = time.process_time(), time.monotonic()
        serve(autopilot, [link], Clock.parse("max"), seconds)
        cpu_s, wall_s = time.process_time() - cpu_s, time.monotonic() - wall_s
        client.send("stop")
        drained = client.recv()
        link.close()
    return cpu_s, wall_s, autopilot.counters.frames_out, drained


def fly_bare(step_s: float, seconds: float, seed: int) -> float:
    """-> CPU s of the plant alone, one flight."""
    fleet = simulator.Fleet(configuration()[0], [seed])
    cpu_s = time.process_time()
    for _ in range(round(seconds / step_s)):
        fleet.step(step_s)
    return time.process_time() - cpu_s


def over_mavlink(seconds: float, seed: int) -> bool:
    """Print the figures of both rates; -> whether both reach the bar."""
    reached = True
    print(f"over MAVLink, UDP loopback, one client, one flight of {seconds:.0f} s, seed {seed}:")
    rates: Rates
    for rates, step_s in (("stock", simulator.VEHICLE.steps_s[0]), ("fast", simulator.VEHICLE.steps_s[1])):
        cpu_s, wall_s, frames, drained = fly_over_mavlink(rates, seconds, seed)
        bare_s = fly_bare(step_s, seconds, seed)
        speed = seconds / cpu_s
        reached &= speed >= LEAST_REAL_TIME
        print(
            f"  {rates:5} {speed:7.0f} x real time on one core (bar {LEAST_REAL_TIME:.0f}): CPU {cpu_s:.2f} s, "
            f"wall {wall_s:.2f} s; {frames} frames, {1e6 * cpu_s / frames:.1f} us each; "
            f"{cpu_s / bare_s:.1f} x the bare plant ({seconds / bare_s:.0f} x real time)"
        )
        print(
            f"        client: {drained.frames} frames ({drained.frames / frames:.1%}) in {drained.datagrams} datagrams, "
            f"{drained.bytes / 1e6:.1f} MB, {drained.damaged} damaged"
        )
    return reached


def in_process(flights: int, first_seed: int) -> bool:
    """Print the figures of plant and monitor over a batch; -> whether they reach the bar, in proportion to the flights."""
    plant_config, monitor_config = configuration()
    plant_s = monitor_s = 0.0
    rows = round(FLIGHT_S / PERIOD_S)
    told_s = time.monotonic()
    for begin in range(0, flights, BATCH):
        n = min(BATCH, flights - begin)
        began_s = time.process_time()
        fleet = simulator.Fleet(plant_config, range(first_seed + begin, first_seed + begin + n))
        plant_s += time.process_time() - began_s
        monitor = detector.Parafoil(monitor_config, flights=n)
        columns = [fleet.channels.index(name) for name in detector.CHANNELS if name != "armed"]
        values, age_s = np.zeros((n, len(detector.CHANNELS))), np.zeros((n, len(detector.CHANNELS)))
        for k in range(rows + 1):
            began_s = time.process_time()
            sensed, sensed_age_s = fleet.step(PERIOD_S) if k else fleet.observe()
            flown_s = time.process_time()
            values[:, 0] = ~fleet.landed if k else 0.0
            values[:, 1:], age_s[:, 1:] = sensed[:, columns], sensed_age_s[:, columns]
            monitor.step(values, age_s)
            judged_s = time.process_time()
            plant_s += flown_s - began_s
            monitor_s += judged_s - flown_s
            if time.monotonic() - told_s > PROGRESS_S:
                told_s = time.monotonic()
                share = (begin + n * k / rows) / flights
                print(f"{share:.0%} of {flights} flights, CPU {plant_s + monitor_s:.0f} s", file=sys.stderr)
    total_s = plant_s + monitor_s
    bar_s = MOST_CPU_S * flights / ENSEMBLE
    print(f"in process, plant and monitor, {flights} flights of {FLIGHT_S:.0f} s, seeds from {first_seed}:")
    print(
        f"  CPU {total_s:.1f} s (bar {bar_s:.0f} s), {flights * FLIGHT_S / total_s:.0f} x real time on one core: "
        f"plant {plant_s:.1f} s, monitor {monitor_s:.1f} s, {monitor_s / plant_s:.2f} x the plant"
    )
    return total_s < bar_s


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=ENSEMBLE, help="in process; the bar shrinks with them")
    parser.add_argument("--seconds", type=float, default=FLIGHT_S, help="of the flight over MAVLink")
    parser.add_argument("--seed", type=int, default=1, help="of the first flight")
    arguments = parser.parse_args()
    for step_s in simulator.VEHICLE.steps_s:
        fly_bare(step_s, 10.0 * step_s, arguments.seed)  # compile first
    reached = [over_mavlink(arguments.seconds, arguments.seed), in_process(arguments.flights, arguments.seed)]
    return 0 if all(reached) else 1


if __name__ == "__main__":
    sys.exit(main())
