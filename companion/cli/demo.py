"""`mavfdi demo [AIRFRAME]`: simulator and monitor side by side, a fault on the way, everything shown and kept."""

import argparse
import contextlib
import json
import math
import random
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from companion import address
from companion import airframe as airframes
from companion.airframe import Airframe
from companion.cli import arguments
from companion.cli.run import read_record, show
from companion.core import Core
from companion.decision import Policy
from companion.effects import Effect
from companion.errors import UserError
from companion.events import Json
from companion.journal import Journal
from companion.link import Link, UdpListener
from companion.live import Live
from companion.picture import History, draw
from companion.recorder import Recorder

RELEASE_S = 5.0  # the simulator's vehicle arms itself so long after its boot
ONSET_S = (60.0, 150.0)  # a fault without a time of its own begins somewhere here, after release
AFTER_S = 110.0  # what is flown after the onset: alarm, isolation, repair and its verification fit in
HEALTHY_S = 240.0  # a flight without a fault


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("airframe", nargs="?", default="parafoil")
    parser.add_argument("--seed", type=int, help="of the flight and of the onset; default: a new one each time, printed")
    parser.add_argument("--speedup", metavar="X", default="10", help="simulated seconds per second, or lockstep; default 10")
    parser.add_argument("--fault", metavar="ID[=VALUE][@T]", default="crossed_lines", help="none flies a healthy flight")
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("mavfdi-demo"))
    parser.add_argument("--policy", choices=[policy.value for policy in Policy], default=Policy.AUTO.value)
    arguments.add_duration(parser, "of the flight; default: as long as the fault needs")
    parser.add_argument("--no-view", action="store_true", help="print events instead of the live view")
    arguments.add_config(parser)


def main(args: argparse.Namespace) -> int:
    arguments.check_numbers(duration_s=args.duration, seed=args.seed)
    airframe = airframes.load(args.airframe, args.config)
    simulator = airframe.load_simulator()
    seed = args.seed if args.seed is not None else random.SystemRandom().randrange(1_000_000)
    fault, onset_s = _fault(args.fault, seed, simulator.VEHICLE.fault_ids)
    duration_s = args.duration or (HEALTHY_S if fault is None else onset_s + AFTER_S) + RELEASE_S
    clock = arguments.companion_clock(args.speedup)
    link = UdpListener(address.Address(address.Medium.UDP_LISTEN, "127.0.0.1", 0))
    core = Core(airframe, Policy(args.policy), record=read_record(args.out))
    history = History()
    injected: list[Json] = []
    if fault is not None:
        fault_id, _, value = fault.partition("=")
        injected.append({"id": fault_id, "value": float(value) if value else None, "onset_t": RELEASE_S + onset_s})
    with contextlib.closing(link):
        recorder = Recorder(args.out)
        with _show(core, args, f"{airframe.name}, seed {seed}") as shown:

            def observe(effect: Effect) -> None:
                history.note(effect)
                shown(effect)

            live = Live(core, [link], clock, recorder, Journal(airframe), observe)
            arguments.on_stop_signal(lambda why: setattr(live, "stop", why))
            with _simulator(args, link, seed, fault, onset_s, duration_s) as child:
                content = _watch(live, child, {"seed": seed, "injected": injected})
    picture = live.recorder.tlog_path.with_suffix(".png")
    onsets = [(str(args.fault).partition("@")[0], RELEASE_S + onset_s)] if fault is not None else []
    draw(picture, history, airframe.detector, live.journal.lines, onsets)
    _print_summary(content, airframe, history, onset_s if fault is not None else None, live, picture)
    return 0


def _fault(text: str, seed: int, known: tuple[str, ...]) -> tuple[str | None, float]:
    """The fault's id with its value, and its onset after release, drawn with the seed where none is given.

    Raises UserError for what the simulator would refuse: nothing has been started or written by then.
    """
    if text == "none":
        return None, 0.0
    from sitl.vehicle import check_faults, parse_fault

    body, at, onset = text.partition("@")
    try:
        onset_s = float(onset) if at else float(random.Random(seed).randint(round(ONSET_S[0]), round(ONSET_S[1])))
    except ValueError:
        raise UserError(f"--fault {text}: {onset!r} is no time in seconds") from None
    try:
        check_faults([parse_fault(f"{body}@{onset_s:g}")], known)
    except ValueError as error:
        raise UserError(f"--fault: {error}") from None
    return body, onset_s


@contextmanager
def _show(core: Core, args: argparse.Namespace, title: str) -> Iterator[Callable[[Effect], None]]:
    """The live view on a terminal, else one line an event."""
    if args.no_view or not sys.stdout.isatty():
        print(f"mavfdi demo: {title}", flush=True)
        yield show
        return
    try:
        from companion.view import View
    except ModuleNotFoundError:
        raise UserError("the view needs rich; install it with: pip install 'mavfdi[tui]', or give --no-view") from None
    with View(core, f"mavfdi demo: {title}") as view:
        yield view.note


@contextmanager
def _simulator(
    args: argparse.Namespace, link: Link, seed: int, fault: str | None, onset_s: float, duration_s: float
) -> Iterator["subprocess.Popen[str]"]:
    """The simulator as a process of its own; ended with us."""
    target = link.name.replace(address.Medium.UDP_LISTEN.value, address.Medium.UDP_SEND.value)
    command = [sys.executable, "-m", "companion.cli", "sitl", args.airframe, "--connect", target, "--seed", str(seed)]
    command += ["--speedup", args.speedup, "--duration", str(duration_s)]
    if fault is not None:
        command += ["--fault", f"{fault}@{onset_s:g}"]
    if args.config is not None:
        command += ["--config", str(args.config)]
    child = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        yield child
    finally:
        if child.poll() is None:
            child.terminate()
        child.wait()
        if child.stderr is not None:
            child.stderr.close()


def _watch(live: Live, child: "subprocess.Popen[str]", details: dict[str, Json]) -> dict[str, Json]:
    """Run until the simulator has flown its time.  Raises UserError with its words if it failed."""

    def ended() -> str:
        return "" if child.poll() is None else "the flight is over"

    content = live.run(details=details, ended=ended)
    if child.poll() not in (None, 0) and child.stderr is not None:
        raise UserError(f"the simulator ended: {child.stderr.read().strip() or child.returncode}")
    return content


def _print_summary(
    content: dict[str, Json], airframe: Airframe, history: History, onset_s: float | None, live: Live, picture: Path
) -> None:
    rows: list[tuple[str, str]] = [("airframe", airframe.name), ("seed", str(content["seed"]))]
    rows.append(("injected", json.dumps(content["injected"])))
    rows.append(("verdict", str(content["verdict"])))
    times = {f"{line['kind']}/{line['name']}": line["t"] for line in reversed(live.journal.lines)}
    onset_t = onset_s + RELEASE_S if onset_s is not None else math.nan
    for name, key in (("detected", "fault/detected"), ("isolated", "fault/isolated"), ("verified", "recovery/verified")):
        t = times.get(key)
        if isinstance(t, float):
            rows.append((name, f"{t - onset_t:.1f} s after the fault" if onset_s is not None else f"at {t:.1f} s"))
    rows += [("named", f"{fault.id} ({fault.confidence:.1%})") for fault in live.core.faults]
    rows.append(("recovery", json.dumps(content["recovery"])))
    mended_t = times.get("recovery/acknowledged")
    if onset_s is not None:
        end_t = history.t_s[-1] if history.t_s else math.nan
        during_t = mended_t if isinstance(mended_t, float) else end_t
        rows.append(("tracking rms before", f"{history.tracking_rms(RELEASE_S, onset_t):.3f}"))
        rows.append(("tracking rms during", f"{history.tracking_rms(onset_t, during_t):.3f}"))
        if isinstance(mended_t, float):
            rows.append(("tracking rms after", f"{history.tracking_rms(mended_t + 5.0, end_t):.3f}"))
    rows.append(("log", str(live.recorder.tlog_path)))
    rows.append(("events", str(live.recorder.events_path)))
    rows.append(("picture", str(picture)))
    width = max(len(name) for name, _ in rows)
    for name, value in rows:
        print(f"{name:{width}}  {value}")
