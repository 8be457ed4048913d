"""Flights for the system tests: in one process, or as the real commands in processes of their own.

Nothing here sleeps; everything that is waited for has a deadline.
"""

import contextlib
import functools
import json
import os
import queue
import subprocess
import sys
import threading
import time
from pathlib import Path

from pymavlink.dialects.v20 import all as dialect

from companion import airframe as airframes
from companion import recovery as recoveries
from companion.decision import Policy
from companion.effects import Send, Tell
from companion.rehearsal import Rehearsal
from sitl.autopilot import Autopilot, Misbehaviour
from sitl.vehicle import parse_fault
from tests.sitl.network import message

LIMIT_S = 60.0  # for anything that a process is waited for
TOY = Path(__file__).parents[1] / "toy_airframe"
CROSSED = "crossed_lines@20"  # seeds 1 to 12: named within 21 s, swapped 6 s later, verified 26 s after that
FLIGHT_S = 100.0  # all of that fits in
OUTPUTS = ("SERVO1_FUNCTION", "SERVO2_FUNCTION")
ORIGINAL, SWAPPED = (77.0, 78.0), (78.0, 77.0)


@functools.cache
def parafoil():
    return airframes.load("parafoil")


def autopilot(seed=1, fault=None, misbehaviour=None, **options):
    """The vehicle of `mavfdi sitl parafoil --seed SEED --fault FAULT`."""
    simulator = parafoil().load_simulator()
    config = parafoil().simulator_config(simulator)
    fleet = simulator.Fleet(config, [seed], [parse_fault(fault)] if fault else None)
    switches = misbehaviour if misbehaviour is not None else Misbehaviour()
    return Autopilot(simulator.VEHICLE, fleet, seed=seed, misbehaviour=switches, **options)


class Flight:
    """A flight in one process, and what it sent and told."""

    def __init__(self, seed=1, fault=None, policy=Policy.AUTO, *, keep_log=False, **options):
        self.autopilot = autopilot(seed, fault, **options)
        self.sends = []
        self.told = []
        self.rehearsal = Rehearsal(parafoil(), self.autopilot, policy, keep_log=keep_log, observe=self._note)
        self.core = self.rehearsal.core
        self._ground = dialect.MAVLink(None, 255, 190)

    def _note(self, effect):
        if isinstance(effect, Send):
            self.sends.append(effect)
        elif isinstance(effect, Tell):
            self.told.append(effect.event)

    def fly(self, duration_s=FLIGHT_S):
        self.rehearsal.fly(duration_s)
        return self

    def fly_until(self, come, limit_s=FLIGHT_S):
        """Step by step until `come()`; fails if it does not within so many seconds of flight."""
        end_us = self.autopilot.elapsed_us + round(limit_s * 1e6)
        while not come():
            assert self.autopilot.elapsed_us < end_us, self.names()
            self.rehearsal.step()
        return self

    def hear_nothing(self, duration_s):
        """So many seconds in which nothing of the vehicle arrives; the companion's clock goes on."""
        rehearsal, end_us = self.rehearsal, self.autopilot.elapsed_us + round(duration_s * 1e6)
        while self.autopilot.elapsed_us < end_us:
            self.autopilot.step()
            self.autopilot.outgoing()
            rehearsal._clock.advance_to(self.autopilot.time_us)
            rehearsal._perform(self.core.tick(rehearsal._clock.now_us()))

    def begin_recovery(self, fault_id="crossed_lines"):
        """Put the recovery of a fault in hand, whatever the monitor thinks of it."""
        core, effects = self.core, []
        core.plan = core.airframe.configuration.recovery[fault_id]
        core.recovery, wanted = recoveries.begin(core.plan, fault_id, core._session_us)
        core._carry_out(wanted, effects)
        self.rehearsal._perform(effects)

    def ground(self, name, /, **fields):
        """One message of a ground station, which reaches the companion through the autopilot's routing."""
        raw = message(name, **fields).pack(self._ground)
        self._ground.seq = (self._ground.seq + 1) % 256
        self.autopilot.receive("ground", raw)

    @property
    def lines(self):
        return self.rehearsal.journal.lines

    @property
    def outputs(self):
        """What the vehicle really has."""
        return tuple(self.autopilot.parameters.value(name) for name in OUTPUTS)

    @property
    def sets(self):
        """(name, value) of every PARAM_SET sent to the vehicle."""
        return [(s.fields["param_id"], s.fields["param_value"]) for s in self.sends if s.message == "PARAM_SET"]

    @property
    def spoken(self):
        """Texts said on STATUSTEXT, without who speaks."""
        return [s.fields["text"].removeprefix("mavfdi: ") for s in self.sends if s.message == "STATUSTEXT"]

    def names(self, *kinds):
        return names(self.lines, *kinds)

    def time(self, name):
        """When the first event KIND/NAME happened, s on the vehicle's clock."""
        return next(line["t"] for line in self.lines if f"{line['kind']}/{line['name']}" == name)


def names(lines, *kinds):
    """KIND/NAME of these events, or of those of some kinds."""
    return [f"{line['kind']}/{line['name']}" for line in lines if not kinds or line["kind"] in kinds]


def events(path):
    """The lines of events.jsonl."""
    return [json.loads(line) for line in Path(path).read_text(encoding="utf-8").splitlines()]


class Process:
    """One `mavfdi` command; what it prints can be waited for (where stdout is given, what it prints on stderr)."""

    def __init__(self, *arguments, path=None, stdout=subprocess.PIPE):
        environment = os.environ | {"PYTHONUNBUFFERED": "1"} | ({"PYTHONPATH": str(path)} if path else {})
        self.process = subprocess.Popen(
            [sys.executable, "-m", "companion.cli", *map(str, arguments)], stdin=subprocess.DEVNULL,
            stdout=stdout, stderr=subprocess.PIPE if stdout != subprocess.PIPE else subprocess.STDOUT, env=environment,
            text=True, errors="replace",
        )  # fmt: skip
        self._output = self.process.stdout or self.process.stderr
        self.seen = []
        self._lines = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self._output:
            self._lines.put(line)
        self._lines.put(None)

    def wait_for(self, text, limit_s=LIMIT_S):
        """Until it has printed a line with this text, which is returned."""
        end_s = time.monotonic() + limit_s
        while (left_s := end_s - time.monotonic()) > 0.0:
            with contextlib.suppress(queue.Empty):
                line = self._lines.get(timeout=left_s)
                assert line is not None, f"ended without printing {text!r} but:\n{''.join(self.seen)}"
                self.seen.append(line)
                if text in line:
                    return line
        raise AssertionError(f"never printed {text!r} but:\n{''.join(self.seen)}")

    def ended(self, limit_s=LIMIT_S):
        """Wait for its end; -> exit code.  `text` is complete then."""
        code = self.process.wait(limit_s)
        self._reader.join(limit_s)
        while not self._lines.empty():
            line = self._lines.get()
            self.seen += [line] if line is not None else []
        return code

    @property
    def text(self):
        return "".join(self.seen)

    def stop(self):
        """As Ctrl-C does; -> exit code."""
        self.process.terminate()
        return self.ended()

    def kill(self):
        """As a power failure does."""
        self.process.kill()
        self.ended()

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(LIMIT_S)
        self._reader.join(LIMIT_S)
        self._output.close()


@contextlib.contextmanager
def command(*arguments, path=None, stdout=subprocess.PIPE):
    """One command, ended when the context is left."""
    started = Process(*arguments, path=path, stdout=stdout)
    try:
        yield started
    finally:
        started.close()


@contextlib.contextmanager
def watching(out, *links, airframe="parafoil", speedup="lockstep", policy="auto", path=None, more=()):
    """`mavfdi run`, once it listens."""
    connect = [word for link in links for word in ("--connect", link)]
    with command(
        "run", airframe, *connect, "--policy", policy, "--speedup", speedup, "--out", out, *more, path=path
    ) as run:  # fmt: skip
        run.wait_for("recording to")
        yield run


def flying(*links, airframe="parafoil", seed=1, fault=None, speedup="lockstep", duration_s=FLIGHT_S, path=None):
    """`mavfdi sitl` under way, as a context."""
    connect = [word for link in links for word in ("--connect", link)]
    words = ["--fault", fault] if fault else []
    return command(
        "sitl", airframe, *connect, "--seed", seed, "--speedup", speedup, "--duration", duration_s, *words, path=path
    )  # fmt: skip
