"""`mavfdi sitl AIRFRAME`: a simulated vehicle on real links."""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Hashable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from companion import airframe as airframes
from companion.airframe import Airframe
from companion.cli import arguments
from companion.clock import STAMP_US
from companion.errors import UserError
from companion.frames import Splitter
from companion.link import Link
from companion.recorder import RecordFile
from companion.tlog import OWN_LINK, record

if TYPE_CHECKING:
    from sitl.autopilot import Autopilot

DEFAULT_LINK = "udpout:127.0.0.1:14550"
COMPILE_S = 1.0  # of flight in which everything that is compiled has been called
SETTLED_S = 10.0  # after touchdown, before the simulator ends by itself
PEERS = 64  # byte streams kept apart in the log at the most


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("airframe")
    arguments.add_connect(parser, DEFAULT_LINK)
    parser.add_argument("--seed", type=int, default=1, help="of everything random in the flight")
    arguments.add_speedup(parser)
    parser.add_argument(
        "--fault",
        metavar="ID[=VALUE]@T",
        action="append",
        default=[],
        help="inject a fault T seconds after release, for example crossed_lines@120 or motor:left/stuck=0.9@60",
    )
    arguments.add_duration(parser, "stop after so many simulated seconds")
    parser.add_argument("--rates", choices=["stock", "fast"], default="stock", help="stream rates; fast: 50 Hz")
    parser.add_argument("--arm", choices=["auto", "manual"], default="auto", help="release by itself, or when armed")
    parser.add_argument("--sysid", type=int, default=1)
    parser.add_argument(
        "--tlog", metavar="FILE", type=Path, help="record what the vehicle sends and receives, in a new file"
    )
    arguments.add_config(parser)


def main(args: argparse.Namespace) -> int:
    arguments.check_numbers(duration_s=args.duration, sysid=args.sysid, seed=args.seed)
    airframe = airframes.load(args.airframe, args.config)
    autopilot = build(airframe, args)
    from sitl.clock import Clock
    from sitl.server import LockstepError, serve

    try:
        clock = Clock.parse(args.speedup)
    except ValueError as error:
        raise UserError(str(error)) from None
    links = arguments.open_links(args.connect, DEFAULT_LINK, lambda text: print(text, file=sys.stderr))
    recorded, log = links, None
    if args.tlog is not None:
        log = open_log(args.tlog, links, autopilot)
        recorded = [RecordedLink(link, min(number, OWN_LINK - 1), log) for number, link in enumerate(links)]
    stopped: list[str] = []
    arguments.on_stop_signal(stopped.append)
    landed_us: list[int] = []

    def on_step(flying: "Autopilot") -> bool:
        if flying.landed and not landed_us:
            landed_us.append(flying.elapsed_us)
        over = bool(landed_us) and flying.elapsed_us - landed_us[0] > SETTLED_S * 1e6
        return not stopped and not over

    names = ", ".join(link.name for link in links)
    print(f"mavfdi sitl: {airframe.name}, seed {args.seed}, on {names}, speed-up {args.speedup}", flush=True)
    try:
        serve(autopilot, recorded, clock, args.duration, on_step)
    except LockstepError as error:
        raise UserError(str(error)) from None
    finally:
        for link in links:
            link.close()
        if log is not None:
            log.close()
    return 0


def open_log(path: Path, links: list[Link], autopilot: "Autopilot") -> "TrafficLog":
    """The log of --tlog, stamped at the pace of the flight.  Raises UserError, the links closed, if it cannot be opened."""
    began_us = time.time_ns() // 1000 - autopilot.elapsed_us
    try:
        file = RecordFile(path)
    except OSError as error:
        for link in links:
            link.close()
        why = (
            "it is there already; give another name" if isinstance(error, FileExistsError) else error.strerror or str(error)
        )
        raise UserError(f"--tlog {path}: {why}") from None
    return TrafficLog(file, lambda: began_us + autopilot.elapsed_us)


class TrafficLog:
    """What the vehicle sends and receives on all its links, frame by frame, in one tlog.

    now_us: stamps, microseconds since 1970.  What is sent to several clients stands there once, as its first client got it:
    the vehicle counts its sequence numbers for each of them.  A disk that is full ends the log, with a line on stderr.
    """

    def __init__(self, file: RecordFile, now_us: Callable[[], int]) -> None:
        self._file: RecordFile | None = file
        self._now_us = now_us
        self._splitters: dict[Hashable, Splitter] = {}
        self._sent_us = 0
        self._sent: dict[tuple[int, int, int, bytes], Hashable] = {}  # what was sent at this stamp, and to whom first

    def received(self, link: int, peer: Hashable, data: bytes) -> None:
        """Bytes as they came; a frame is recorded when it is whole."""
        for frame in self._splitter(("received", peer)).feed(data):
            self._write(link, frame.raw)

    def sent(self, peer: Hashable, data: bytes) -> None:
        """Whole frames."""
        now_us = self._now_us()
        if now_us != self._sent_us:
            self._sent_us = now_us
            self._sent.clear()
        for frame in self._splitter(("sent", peer)).feed(data):
            said = (frame.message_id, frame.sysid, frame.compid, frame.payload.rstrip(b"\0"))
            if self._sent.setdefault(said, peer) == peer:
                self._write(OWN_LINK, frame.raw)

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        self._file = None

    def _splitter(self, stream: Hashable) -> Splitter:
        if stream not in self._splitters and len(self._splitters) >= PEERS:
            del self._splitters[next(iter(self._splitters))]
        return self._splitters.setdefault(stream, Splitter())

    def _write(self, link: int, raw: bytes) -> None:
        if self._file is None:
            return
        try:
            self._file.write(record(self._now_us() // STAMP_US * STAMP_US, link, raw))
        except OSError as error:
            print(f"mavfdi sitl: {self._file.path} ends here: {error.strerror or error}", file=sys.stderr, flush=True)
            self.close()


class RecordedLink:
    """A link whose traffic is recorded as it passes."""

    def __init__(self, link: Link, number: int, log: TrafficLog) -> None:
        self.name = link.name
        self._link = link
        self._number = number
        self._log = log
        self.counts: Counter[str] = link.counts

    def filenos(self) -> list[int]:
        return self._link.filenos()

    def receive(self) -> list[tuple[Hashable, bytes]]:
        found = self._link.receive()
        for peer, data in found:
            self._log.received(self._number, (self.name, peer), data)
        return found

    def send(self, data: bytes, peer: Hashable | None = None) -> None:
        self._log.sent((self.name, peer), data)
        self._link.send(data, peer)

    def maintain(self, now_us: int) -> None:
        self._link.maintain(now_us)

    def close(self) -> None:
        self._link.close()


def build(airframe: Airframe, args: argparse.Namespace) -> "Autopilot":
    """The autopilot with its vehicle, from the command's arguments.  Raises UserError for a fault that it does not know."""
    simulator = airframe.load_simulator()
    config = airframe.simulator_config(simulator)
    from sitl.autopilot import Autopilot
    from sitl.vehicle import check_faults, parse_fault

    try:
        faults = [parse_fault(text) for text in args.fault]
        check_faults(faults, simulator.VEHICLE.fault_ids)
        if len(faults) > 1:
            raise UserError("one fault a flight; a second one can be set in flight by the SIM_FLT_ parameters")
        compile_kernels(simulator, config, args.seed)
        fleet = simulator.Fleet(config, [args.seed], faults or None)
    except ValueError as error:
        raise UserError(f"--fault: {error}") from None
    release_s = 5.0 if args.arm == "auto" else None
    return Autopilot(simulator.VEHICLE, fleet, sysid=args.sysid, rates=args.rates, release_s=release_s, seed=args.seed)


def compile_kernels(simulator: ModuleType, config: object, seed: int) -> None:
    """Fly a moment of a throw-away flight: compiling takes seconds on the first run, in which no vehicle may stand still."""
    began_s = time.monotonic()
    for step_s in simulator.VEHICLE.steps_s:
        fleet = simulator.Fleet(config, [seed], None)
        for _ in range(round(COMPILE_S / step_s)):
            fleet.step(step_s)
    if time.monotonic() - began_s > COMPILE_S:
        print("mavfdi sitl: compiled the plant, once for this installation", flush=True)
