"""One flight told four times: live over UDP, from its log, in one process, and from its bytes cut anywhere."""

import random

import pytest

from companion.analysis import analyze
from companion.clock import STAMP_US
from companion.core import Core
from companion.decision import Policy
from companion.dialect import encode
from companion.effects import Send
from companion.events import same_events
from companion.frames import Splitter
from companion.journal import Journal
from companion.tlog import OWN_LINK, Reader
from tests.sitl.test_server import free_port
from tests.system import flights
from tests.system.flights import CROSSED, Flight, flying, names, parafoil, watching

SEED = 3
STORY = ["fault/detected", "fault/isolated"] + [
    f"recovery/{name}" for name in ("considered", "requested", "acknowledged", "verified")
]


def fly_over_udp(out, speedup):
    port = free_port()
    with (
        watching(out, f"udpin:127.0.0.1:{port}", speedup=speedup) as run,
        flying(f"udpout:127.0.0.1:{port}", seed=SEED, fault=CROSSED, speedup=speedup) as simulator,
    ):
        assert simulator.ended() == 0, simulator.text
        assert run.stop() == 0, run.text
    return out


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    """Folder of a live run in lockstep."""
    return fly_over_udp(tmp_path_factory.mktemp("live"), "lockstep")


@pytest.fixture(scope="module")
def recorded(live):
    """The vehicle's frames with their stamps, as they arrived."""
    records = list(Reader(live / "flight.tlog"))
    return [(record.stamp_us & ~3, record.frame) for record in records if record.link != OWN_LINK]


def same_sends_and_events(out):
    """Replay the log of a run under the policy that the log itself tells."""
    found = analyze(out / "flight.tlog", lambda _: parafoil())
    assert found.replay.core.policy is Policy.AUTO
    assert found.content["replay"]["same_sends"], found.content["replay"]
    assert same_events(flights.events(out / "events.jsonl"), found.replay.journal.lines) is None
    return found


def test_a_live_run_over_udp_mends_the_crossed_lines(live):
    lines = flights.events(live / "events.jsonl")
    assert names(lines, "fault", "recovery") == STORY
    assert [line["seq"] for line in lines] == list(range(len(lines)))
    assert (lines[0]["kind"], lines[-1]["kind"]) == ("run", "end")


def test_the_log_of_a_live_run_tells_the_same_events_and_would_send_the_same(live):
    found = same_sends_and_events(live)
    assert found.content["verdict"] == "fault"
    assert [fault["id"] for fault in found.content["faults"]] == ["crossed_lines"]


def test_the_flight_in_one_process_tells_the_same_events_as_the_one_over_udp(live):
    flight = Flight(SEED, CROSSED).fly()
    assert same_events(flights.events(live / "events.jsonl"), flight.lines) is None


def test_the_log_kept_in_one_process_holds_the_same_frames_as_the_one_recorded_over_udp(live, tmp_path):
    flight = Flight(SEED, CROSSED, keep_log=True).fly()
    log = tmp_path / "flight.tlog"
    log.write_bytes(flight.rehearsal.log)
    kept, recorded = Reader(log), Reader(live / "flight.tlog")
    for _ in kept:
        pass
    for _ in recorded:
        pass
    for name in ("PARAM_SET", "PARAM_VALUE", "STATUSTEXT", "ATTITUDE", "GLOBAL_POSITION_INT", "WHEEL_DISTANCE"):
        assert kept.report.messages[name] == recorded.report.messages[name], name


def told(recorded, cuts, looks):
    """The recorded byte stream, cut at these places, through splitter and core; `looks`: chances of a look in between.

    A frame has the stamp under which it was recorded, whatever piece of the stream completes it.
    """
    core, journal, sends = Core(parafoil(), Policy.AUTO), Journal(parafoil()), []

    def take(effects):
        journal.take(effects, core.watch.sysid)
        sends.extend(
            encode(effect.message, effect.fields, sysid=1, compid=1, seq=0)
            for effect in effects
            if isinstance(effect, Send) and effect.message not in ("HEARTBEAT", "TIMESYNC")
        )

    stream = b"".join(frame.raw for _, frame in recorded)
    splitter, place, before_us = Splitter(), 0, recorded[0][0]
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        for frame in splitter.feed(stream[start:end]):
            stamp_us, expected = recorded[place]
            assert frame.raw == expected.raw
            place += 1
            while looks.random() < 0.1 and stamp_us > before_us:
                before_us = looks.randrange(before_us, stamp_us, STAMP_US)
                take(core.tick(before_us))
            take(core.frame(frame, stamp_us))
            before_us = stamp_us
    assert place == len(recorded)
    return journal.lines, sends


def test_any_slicing_of_the_bytes_and_any_looking_in_between_gives_the_same_events_and_sends(live, recorded):
    whole = sum(len(frame.raw) for _, frame in recorded)
    expected = flights.events(live / "events.jsonl")
    first = None
    for seed in range(10):
        chances = random.Random(seed)
        cuts = sorted(chances.sample(range(1, whole), chances.choice((10, 1000, 20_000))))
        lines, sends = told(recorded, cuts, chances)
        assert same_events(expected, lines) is None
        first = first if first is not None else sends
        assert sends == first


def test_at_twenty_times_real_time_with_real_arrival_stamps_the_log_tells_what_the_run_told(tmp_path):
    out = fly_over_udp(tmp_path / "run", "20")
    assert names(flights.events(out / "events.jsonl"), "fault", "recovery") == STORY
    same_sends_and_events(out)
