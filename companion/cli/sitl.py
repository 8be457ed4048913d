"""`mavfdi sitl AIRFRAME`: a simulated vehicle on real links."""

import argparse
import sys
import time
from types import ModuleType
from typing import TYPE_CHECKING

from companion import airframe as airframes
from companion.airframe import Airframe
from companion.cli import arguments
from companion.errors import UserError

if TYPE_CHECKING:
    from sitl.autopilot import Autopilot

DEFAULT_LINK = "udpout:127.0.0.1:14550"
COMPILE_S = 1.0  # of flight in which everything that is compiled has been called
SETTLED_S = 10.0  # after touchdown, before the simulator ends by itself


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
        serve(autopilot, links, clock, args.duration, on_step)
    except LockstepError as error:
        raise UserError(str(error)) from None
    finally:
        for link in links:
            link.close()
    return 0


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
