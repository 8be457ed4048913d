"""A companion that is killed in the middle of a recovery and started again puts back what it had touched."""

import contextlib
import os
import time
from dataclasses import dataclass

import pytest

from companion import address
from companion.link import open_link
from companion.tlog import Reader
from sitl.autopilot import Misbehaviour, ParameterMode
from sitl.clock import Clock
from sitl.server import serve
from tests.sitl.test_server import free_port
from tests.system import flights
from tests.system.flights import CROSSED, LIMIT_S, ORIGINAL, OUTPUTS, SWAPPED, autopilot, names, watching

LEFT, RIGHT = OUTPUTS
HALF = (78.0, 78.0)


class Vehicle:
    """The simulated vehicle in this process, in lockstep with whatever companion listens on its port."""

    def __init__(self, port, **switches):
        self.autopilot = autopilot(1, CROSSED, Misbehaviour(**switches))
        self.link = open_link(address.parse(f"udpout:127.0.0.1:{port}"))

    @property
    def outputs(self):
        return tuple(self.autopilot.parameters.value(name) for name in OUTPUTS)

    def fly(self, duration_s, until=lambda _: False):
        """Fly until this is true of the autopilot after a step; fails if it has not come true by then."""
        come = []

        def on_step(flying):
            if until(flying):
                come.append(True)
                return False
            return True

        serve(self.autopilot, [self.link], Clock.parse("lockstep"), duration_s, on_step)
        return bool(come)


@contextlib.contextmanager
def vehicle(port, **switches):
    made = Vehicle(port, **switches)
    try:
        yield made
    finally:
        made.link.close()


def on_disk(path, wanted):
    """Wait until the recorder, which makes nobody wait for the disk, has written these bytes."""
    end_s = time.monotonic() + LIMIT_S
    while wanted not in path.read_bytes():
        assert time.monotonic() < end_s
        os.sched_yield()


@dataclass(frozen=True)
class Case:
    """Where the companion is killed, and what that leaves."""

    switches: dict
    sets: int  # at this PARAM_SET of the repair, or so many seconds after it
    after_s: float
    left: tuple  # what the vehicle has when the companion is dead
    end: str  # what the restarted companion says


SILENT_SECOND = {"parameter_mode": ParameterMode.IGNORE, "parameter_after": 1}
CASES = {
    "at the first, which is not taken": Case({"parameter_mode": ParameterMode.IGNORE}, 1, 0.0, ORIGINAL, "refused"),
    "between the two": Case(SILENT_SECOND, 2, 0.0, HALF, "rolled_back"),
    "at the second, which is taken but not answered": Case(
        SILENT_SECOND | {"parameter_mode": ParameterMode.SILENT}, 2, 0.0, SWAPPED, "rolled_back"
    ),
    "while it watches whether it helps": Case({}, 2, 10.0, SWAPPED, "rolled_back"),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_a_companion_killed_in_the_middle_of_a_repair_puts_everything_back_when_started_again(case, tmp_path):
    port = free_port()
    link, out = f"udpin:127.0.0.1:{port}", tmp_path / "out"
    with vehicle(port, **case.switches) as flown:
        reached_us = []

        def over(flying):
            if flying.misbehaviour.sets_met >= case.sets and not reached_us:
                reached_us.append(flying.elapsed_us)
            return bool(reached_us) and flying.elapsed_us - reached_us[0] >= round(case.after_s * 1e6)

        with watching(out, link) as killed:
            assert flown.fly(80.0, over)
            on_disk(out / "events.jsonl", b'"requested"')
            killed.kill()
        assert flown.outputs == case.left
        assert (out / "recovery.json").exists()
        first = (out / "flight.tlog").read_bytes(), (out / "events.jsonl").read_bytes()

        flown.autopilot.misbehaviour.parameter_mode = ParameterMode.HONEST
        with watching(out, link, policy="off") as restarted:  # whatever the policy: what was begun is put back
            flown.fly(30.0)
            assert restarted.stop() == 0, restarted.text
    assert flown.outputs == ORIGINAL
    assert not (out / "recovery.json").exists()
    assert ((out / "flight.tlog").read_bytes(), (out / "events.jsonl").read_bytes()) == first

    before = flights.events(out / "events.jsonl")
    assert before[-1]["kind"] != "end"
    assert names(before, "recovery")[:2] == ["recovery/considered", "recovery/requested"]
    after = flights.events(out / "events-2.jsonl")
    assert names(after, "recovery") == ["recovery/failed", f"recovery/{case.end}"]
    assert after[-1]["kind"] == "end"
    assert (out / "summary-2.json").exists()
    assert not (out / "summary.json").exists()


def test_the_log_of_a_killed_run_is_readable_up_to_its_last_whole_frame(tmp_path):
    port = free_port()
    with vehicle(port) as flown, watching(tmp_path, f"udpin:127.0.0.1:{port}") as killed:
        flown.fly(20.0)
        on_disk(tmp_path / "flight.tlog", b"mavfdi: watching parafoil")  # said 3 s after the first frame
        killed.kill()
    reader = Reader(tmp_path / "flight.tlog")
    frames = list(reader)
    assert reader.report.tail_bytes < 8 + 280  # at most one record cut
    assert (reader.report.crc_failures, reader.report.resyncs) == (0, 0)
    assert reader.report.messages["ATTITUDE"] == sum(record.frame.name == "ATTITUDE" for record in frames) > 10
    assert names(flights.events(tmp_path / "events.jsonl"))[0] == "run/run"


def test_a_damaged_record_is_refused_in_words_before_anything_is_done(tmp_path):
    (tmp_path / "recovery.json").write_text('{"schema": 1, "recov', encoding="utf-8")
    with flights.command("run", "parafoil", "--connect", "udpin:127.0.0.1:1", "--out", tmp_path) as run:
        assert run.ended() == 2
    assert len(run.text.splitlines()) == 1
    assert "recovery.json" in run.text
    assert "check the vehicle's outputs" in run.text


def test_a_companion_started_again_before_the_vehicle_is_there_keeps_the_record(tmp_path):
    port = free_port()
    with vehicle(port, **SILENT_SECOND) as flown:
        with watching(tmp_path, f"udpin:127.0.0.1:{port}") as killed:
            assert flown.fly(80.0, lambda flying: flying.misbehaviour.sets_met >= 2)
            killed.kill()
        record = (tmp_path / "recovery.json").read_bytes()
        with watching(tmp_path, f"udpin:127.0.0.1:{port}", speedup="20") as lonely:
            assert lonely.stop() == 0
        assert (tmp_path / "recovery.json").read_bytes() == record
