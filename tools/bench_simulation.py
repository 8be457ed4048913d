"""Measure how fast the parafoil is simulated: over MAVLink to one client, and in process by the thousand.

Over MAVLink: the autopilot with all its streams at full speed over UDP loopback, at stock and at fast rates, to one client
in a process of its own that throws away what it reads; only the simulator's CPU time counts.  Beside it the bare plant at
the same step.  In process: --flights healthy flights of 600 s each, --batch side by side, through the plant and both
detectors, the paper's and ours; between the batches, JSBSim flies its c172p for as long, in the Python that --jsbsim names
(`pip install jsbsim` in an environment of its own).  All figures are CPU seconds of one core (user and system) and ratios;
the bars are those of the project, and a figure that misses one ends with exit code 1.

    python tools/bench_simulation.py
"""

import argparse
import contextlib
import dataclasses
import json
import multiprocessing
import socket
import statistics
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import msgspec
import numpy as np

import fdi.parafoil as detector
import sitl.parafoil as simulator
from companion import address
from companion.compiler import compiler
from companion.dialect import encode
from companion.frames import Splitter
from companion.link import open_link
from sitl.autopilot import Autopilot, Rates
from sitl.clock import Clock
from sitl.server import serve

CONFIG = Path(__file__).parent.parent / "configs" / "parafoil.toml"
PERIOD_S = 0.1
FLIGHT_S = 600.0
BATCH = 200  # larger ones favour the paper's detector, which is numpy
DETECTORS = ("paper", "gyro")  # the paper's and ours
PROGRESS_S = 10.0
LEAST_REAL_TIME = 50.0  # bar: simulated seconds a CPU second, over MAVLink
ENSEMBLE = 1000  # flights of the other bar
MOST_CPU_S = 60.0  # and the CPU time that they may take
LEAST_RATIO = 20.0  # bar: flights a CPU second, over those of JSBSim
DATAGRAM_BYTES = 65536
BEAT_S = 0.5


# version, step (s), time flown (s) and CPU time (s) of an unsteered c172p, started in flight with a running engine
JSBSIM_FLIGHT = f"""
import json, time
import jsbsim
flight = jsbsim.FGFDMExec(None)
flight.set_debug_level(0)
flight.load_model("c172p")
flight["ic/h-sl-ft"], flight["ic/u-fps"] = 5000.0, 150.0
flight.run_ic()
flight["propulsion/set-running"] = -1
step_s = flight.get_delta_t()
steps = round({FLIGHT_S} / step_s)
cpu_s = time.process_time()
for _ in range(steps):
    flight.run()
cpu_s = time.process_time() - cpu_s
print(json.dumps([jsbsim.__version__, step_s, flight.get_sim_time(), cpu_s]))
"""


@dataclass(frozen=True, slots=True)
class JsbsimFlight:
    """What one flight of JSBSim took."""

    version: str
    step_s: float
    seconds: float
    cpu_s: float


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


def fly_with_jsbsim(python: str) -> JsbsimFlight | str:
    """One flight of JSBSim in that Python; or why there is none."""
    try:
        done = subprocess.run([python, "-c", JSBSIM_FLIGHT], capture_output=True, text=True, check=True)
    except OSError as error:
        return f"{python} does not start: {error.strerror}"
    except subprocess.CalledProcessError as error:
        return f"{python}: {(error.stderr.strip() or f'exit code {error.returncode}').splitlines()[-1]}"
    version, step_s, seconds, cpu_s = json.loads(done.stdout.splitlines()[-1])
    return JsbsimFlight(version, step_s, seconds, cpu_s)


@dataclass(slots=True)
class Spent:
    """CPU s of a batch or of all of them."""

    plant: float = 0.0  # plant, sensors, guidance; with the drawing of the flights
    feeding: float = 0.0  # from the simulator's channels to the monitors'
    judging: dict[str, float] = field(default_factory=lambda: dict.fromkeys(DETECTORS, 0.0))

    @property
    def total(self) -> float:
        return self.plant + self.feeding + sum(self.judging.values())


def fly_batch(seeds: range, spent: Spent) -> None:
    """Fly the seeds for FLIGHT_S on the 10 Hz grid, every row judged by each of DETECTORS; adds to `spent`."""
    plant_config, monitor_config = configuration()
    n = len(seeds)
    monitors = {
        name: detector.Monitor(dataclasses.replace(monitor_config, detector=name), n, compiler()) for name in DETECTORS
    }
    began_s = time.process_time()
    fleet = simulator.Fleet(plant_config, seeds)
    spent.plant += time.process_time() - began_s
    columns = [fleet.channels.index(name) for name in detector.CHANNELS if name != "armed"]
    values, age_s = np.zeros((n, len(detector.CHANNELS))), np.zeros((n, len(detector.CHANNELS)))
    for k in range(round(FLIGHT_S / PERIOD_S) + 1):
        began_s = time.process_time()
        sensed, sensed_age_s = fleet.step(PERIOD_S) if k else fleet.observe()
        flown_s = time.process_time()
        values[:, 0] = ~fleet.landed if k else 0.0
        values[:, 1:], age_s[:, 1:] = sensed[:, columns], sensed_age_s[:, columns]
        done_s = time.process_time()
        spent.plant += flown_s - began_s
        spent.feeding += done_s - flown_s
        for name, monitor in monitors.items():
            monitor.step(values, age_s)
            begun_s, done_s = done_s, time.process_time()
            spent.judging[name] += done_s - begun_s


def in_process(flights: int, first_seed: int, batch: int, python: str) -> bool:
    """Print the figures of plant and monitors over many flights, JSBSim between the batches; -> whether they reach the bars.

    The bar of CPU time is taken in proportion to the flights; where there is no JSBSim, only that one is judged.
    """
    fly_batch(range(first_seed, first_seed + 2), Spent())  # compile first
    spent = Spent()
    beside = [fly_with_jsbsim(python)]
    told_s = time.monotonic()
    for begin in range(first_seed, first_seed + flights, batch):
        end = min(begin + batch, first_seed + flights)
        fly_batch(range(begin, end), spent)
        beside.append(fly_with_jsbsim(python))
        if time.monotonic() - told_s > PROGRESS_S:
            told_s = time.monotonic()
            print(f"{end - first_seed} of {flights} flights, CPU {spent.total:.0f} s", file=sys.stderr)
    bar_s = MOST_CPU_S * flights / ENSEMBLE
    print(
        f"in process, plant and monitors: {flights} flights, {FLIGHT_S:.0f} s, from seed {first_seed}, {batch} side by side:"
    )
    judging = ", ".join(f"{name} detector {1e3 * cpu_s / flights:.2f} ms" for name, cpu_s in spent.judging.items())
    print(
        f"  CPU {spent.total:.1f} s (bar {bar_s:.0f} s), {flights * FLIGHT_S / spent.total:.0f} x real time on one core; "
        f"a flight: plant, sensors, guidance {1e3 * spent.plant / flights:.2f} ms, {judging}, "
        f"feeding them {1e3 * spent.feeding / flights:.2f} ms"
    )
    return beside_jsbsim(spent, flights, beside) and spent.total < bar_s


def beside_jsbsim(spent: Spent, flights: int, beside: list[JsbsimFlight | str]) -> bool:
    """Print how many flights go into the CPU time of one of JSBSim's; -> whether the bar is reached, or not judged."""
    flown = [flight for flight in beside if isinstance(flight, JsbsimFlight)]
    refused = [reason for reason in beside if isinstance(reason, str)]
    if refused:
        print(f"  beside JSBSim: skipped, {refused[0]}; see --jsbsim")
        return True
    costs_s = [flight.cpu_s for flight in flown]
    cost_s = statistics.median(costs_s)
    print(
        f"  beside JSBSim {flown[0].version}, c172p, {flown[0].seconds:.0f} s in steps of 1/{1.0 / flown[0].step_s:.0f} s: "
        f"CPU {cost_s:.3f} s, median of {len(costs_s)} ({min(costs_s):.3f} to {max(costs_s):.3f}), loading not counted"
    )
    ratio = cost_s * flights / spent.total
    print(
        f"  flights a CPU second over JSBSim's: plant, sensors, guidance {cost_s * flights / spent.plant:.0f} x, "
        f"with both detectors {ratio:.1f} x (bar {LEAST_RATIO:.0f} x)"
    )
    return ratio >= LEAST_RATIO


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=ENSEMBLE, help="in process; the bar shrinks with them")
    parser.add_argument("--batch", type=int, default=BATCH, help="flights side by side, in process")
    parser.add_argument("--seconds", type=float, default=FLIGHT_S, help="of the flight over MAVLink")
    parser.add_argument("--seed", type=int, default=1, help="of the first flight")
    parser.add_argument("--jsbsim", metavar="PYTHON", default=sys.executable, help="Python of an environment with jsbsim")
    arguments = parser.parse_args()
    for step_s in simulator.VEHICLE.steps_s:
        fly_bare(step_s, 10.0 * step_s, arguments.seed)  # compile first
    reached = [
        over_mavlink(arguments.seconds, arguments.seed),
        in_process(arguments.flights, arguments.seed, arguments.batch, arguments.jsbsim),
    ]
    return 0 if all(reached) else 1


if __name__ == "__main__":
    sys.exit(main())
