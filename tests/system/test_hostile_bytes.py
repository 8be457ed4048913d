"""What does not come from the vehicle, or not whole, changes nothing of what is found and done; it is counted.

A recorded flight is fed to the core with hostile bytes between its frames, at the same stamps.
"""

import random
import struct

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.core import Core
from companion.decision import Policy
from companion.dialect import by_name, encode
from companion.effects import Send
from companion.events import same_events
from companion.frames import Splitter
from companion.journal import Journal
from companion.tlog import OWN_LINK, Reader
from tests.system.flights import CROSSED, Flight, names, parafoil

VEHICLE, OURS = (1, 1), (1, 191)
SEED = 4
MAGICS = {0xFD, 0xFE}


@pytest.fixture(scope="module", params=[None, CROSSED], ids=["healthy", "crossed"])
def recorded(request, tmp_path_factory):
    """(stamp, frame bytes) of everything that the vehicle said in one flight; what came of it."""
    flight = Flight(SEED, request.param, keep_log=True).fly()
    log = tmp_path_factory.mktemp("log") / "flight.tlog"
    log.write_bytes(flight.rehearsal.log)
    stream = [(record.stamp_us & ~3, record.frame.raw) for record in Reader(log) if record.link != OWN_LINK]
    return stream, flight


class Outcome:
    """One stream through splitter and core."""

    def __init__(self, stream, **options):
        self.core = Core(parafoil(), Policy.AUTO, **options)
        self.journal = Journal(parafoil())
        self.splitter = Splitter()
        self.sends = []
        for stamp_us, data in stream:
            for frame in self.splitter.feed(data):
                self._take(self.core.frame(frame, stamp_us))

    def _take(self, effects):
        self.journal.take(effects, self.core.watch.sysid)
        self.sends += [effect for effect in effects if isinstance(effect, Send)]

    @property
    def to_vehicle(self):
        return [send for send in self.sends if send.message in ("PARAM_SET", "PARAM_REQUEST_READ", "COMMAND_LONG")]


def same_as(flight, outcome):
    """The same events, and the same said to the vehicle."""
    assert same_events(flight.lines, outcome.journal.lines) is None
    wanted = [s for s in flight.sends if s.message in ("PARAM_SET", "PARAM_REQUEST_READ", "COMMAND_LONG")]
    assert outcome.to_vehicle == wanted


def mixed(stream, hostile, *, share=0.2, first=0):
    """Before a share of the frames, from `first` on, what `hostile(chances, frame)` makes."""
    chances = random.Random(SEED)
    out = []
    for number, (stamp_us, raw) in enumerate(stream):
        if number >= first and chances.random() < share:
            out.append((stamp_us, hostile(chances, raw)))
        out.append((stamp_us, raw))
    return out


def known(stream):
    """Number of the frame from which on the vehicle has been chosen."""
    return next(number for number, (stamp_us, _) in enumerate(stream) if stamp_us > stream[0][0] + 4_000_000)


def said(name, source, **fields):
    return encode(name, fields, sysid=source[0], compid=source[1], seq=7)


def test_the_recorded_stream_alone_gives_the_flights_own_events(recorded):
    stream, flight = recorded
    same_as(flight, Outcome(stream))


FOREIGN = [(2, 1), (255, 190), (51, 68), (1, 2), (1, 100), (1, 190)]


def foreign(chances, _raw):
    source = chances.choice(FOREIGN)
    wild = chances.choice((0.0, 1e30, float("nan"), -3.0, float("inf")))
    boot_ms = chances.randrange(1 << 32)
    return chances.choice((
        lambda: said("HEARTBEAT", source, type=2, autopilot=3, base_mode=chances.choice((0, 128))),
        lambda: said("ATTITUDE", source, time_boot_ms=boot_ms, roll=wild, pitch=wild, yawspeed=wild),
        lambda: said("ATTITUDE_TARGET", source, time_boot_ms=boot_ms, body_yaw_rate=wild),
        lambda: said("SERVO_OUTPUT_RAW", source, servo1_raw=2000, servo2_raw=1000),
        lambda: said("GLOBAL_POSITION_INT", source, time_boot_ms=boot_ms, vx=12345, vy=-12345),
        lambda: said("PARAM_VALUE", source, param_id="SERVO1_FUNCTION", param_value=78.0, param_type=6),
        lambda: said("PARAM_VALUE", source, param_id="SERVO2_FUNCTION", param_value=77.0, param_type=6),
        lambda: said("PARAM_ERROR", source, target_system=1, target_component=191, param_id="SERVO1_FUNCTION", error=5),
        lambda: said("COMMAND_ACK", source, command=dialect.MAV_CMD_SET_MESSAGE_INTERVAL, result=2),
        lambda: said("STATUSTEXT", source, severity=0, text="all is lost"),
    ))()  # fmt: skip


def test_other_systems_and_other_components_are_not_believed(recorded):
    stream, flight = recorded
    outcome = Outcome(mixed(stream, foreign, first=known(stream)))
    same_as(flight, outcome)
    assert outcome.core.counts["foreign"] > 500
    assert outcome.core.counts["messages"] == flight.core.counts["messages"]


def test_a_second_vehicle_from_the_start_is_no_doubt_where_the_system_is_named(recorded):
    stream, flight = recorded
    outcome = Outcome(mixed(stream, foreign), pinned_sysid=1)
    kinds = ("vehicle", "fault", "recovery")
    assert names(outcome.journal.lines, *kinds) == names(flight.lines, *kinds)


def test_two_vehicles_from_the_start_are_neither_of_them_taken_and_the_operator_is_asked(recorded):
    stream, _ = recorded
    outcome = Outcome(mixed(stream, lambda *_: said("HEARTBEAT", (2, 1), type=2, autopilot=3), share=0.01))
    assert names(outcome.journal.lines) == ["self/config"]
    assert "systems 1, 2 all fly" in outcome.journal.lines[0]["text"]
    assert outcome.to_vehicle == []


def corrupt(chances, raw):
    """The frame that follows, with one bit wrong behind its header; nothing in it may look like another beginning."""
    broken = bytearray(raw)
    broken[chances.randrange(10, len(raw))] ^= 1 << chances.randrange(8)
    return b"" if set(broken[1:]) & MAGICS else bytes(broken)


def test_frames_with_a_wrong_bit_are_not_believed_and_counted(recorded):
    stream, flight = recorded
    outcome = Outcome(mixed(stream, corrupt))
    same_as(flight, outcome)
    assert outcome.splitter.counts["bad_crc"] > 1000


def rubbish(chances, _raw):
    data = chances.randbytes(chances.randrange(1, 60))
    return data.translate(None, bytes(MAGICS))


def test_random_bytes_between_frames_are_skipped_and_counted(recorded):
    stream, flight = recorded
    outcome = Outcome(mixed(stream, rubbish))
    same_as(flight, outcome)
    assert outcome.splitter.counts["skipped_bytes"] > 10_000


def test_rubbish_that_looks_like_the_beginning_of_frames_delays_but_loses_nothing(recorded):
    """Until it is clear that it is none, a frame that seems to have begun holds back those behind it."""
    stream, flight = recorded
    outcome = Outcome(mixed(stream, lambda chances, _: chances.randbytes(chances.randrange(1, 60)), share=0.05))
    assert outcome.core.counts["messages"] >= flight.core.counts["messages"] - 20
    kinds = ("vehicle", "fault", "recovery")
    assert names(outcome.journal.lines, *kinds) == names(flight.lines, *kinds)
    assert outcome.core.faults == flight.core.faults


def test_values_of_the_vehicles_own_that_cannot_be_meant_are_taken_for_absent_and_counted(recorded):
    """They come before the good ones of the same moment, as from a sensor that fails now and then."""
    stream, flight = recorded
    spoilt = {"ATTITUDE": ("roll", "yawspeed"), "ATTITUDE_TARGET": ("body_yaw_rate",)}
    ids = {by_name(name).id: name for name in spoilt}

    def wild(chances, raw):
        message_id = int.from_bytes(raw[7:10], "little")
        if message_id not in ids:
            return b""
        (boot_ms,) = struct.unpack_from("<I", raw, 10)
        value = chances.choice((float("nan"), float("inf"), -float("inf"), 1e30, -1e9, 1e3))
        name = ids[message_id]
        return said(name, VEHICLE, time_boot_ms=boot_ms, **dict.fromkeys(spoilt[name], value))

    outcome = Outcome(mixed(stream, wild, share=0.5))
    same_as(flight, outcome)
    counts = outcome.core.decoder.counts
    assert min(counts["not_finite"], counts["absurd"]) > 100


def test_single_stamps_of_the_vehicle_that_are_far_off_restart_nothing(recorded):
    stream, flight = recorded

    def off(chances, _raw):
        return said("ATTITUDE", VEHICLE, time_boot_ms=chances.choice((0, 1 << 31, (1 << 32) - 1, 10_000_000)), roll=1.0)

    outcome = Outcome(mixed(stream, off, share=0.01, first=known(stream)))
    same_as(flight, outcome)
    assert outcome.core.aligner.counts["off_clock"] > 50


def test_parameters_that_are_no_numbers_and_not_asked_for_change_nothing(recorded):
    stream, flight = recorded

    def wild(chances, _raw):
        name, value = chances.choice((("SERVO1_FUNCTION", float("nan")), ("SERVO9_FUNCTION", 78.0), ("", 0.0)))
        return said("PARAM_VALUE", VEHICLE, param_id=name, param_value=value, param_type=6)

    same_as(flight, Outcome(mixed(stream, wild)))


def test_a_flood_of_time_exchanges_and_heartbeats_changes_nothing(recorded):
    stream, flight = recorded

    def flood(chances, _raw):
        source = chances.choice((VEHICLE, (255, 190), (1, 100)))
        exchange = [said("TIMESYNC", source, tc1=chances.choice((0, 5)), ts1=chances.randrange(1 << 60)) for _ in range(5)]
        beats = [said("HEARTBEAT", (255, 190), type=dialect.MAV_TYPE_GCS, autopilot=8) for _ in range(5)]
        return b"".join(exchange + beats)

    same_as(flight, Outcome(mixed(stream, flood)))


def test_somebody_who_speaks_under_our_ids_makes_us_move_and_is_not_believed(recorded):
    stream, flight = recorded

    def double(chances, raw):
        return foreign(chances, raw) if chances.random() < 0.5 else said("HEARTBEAT", OURS, type=18, autopilot=8)

    outcome = Outcome(mixed(stream, double, first=known(stream), share=0.02))
    assert outcome.core.compid > 191
    same_as(flight, outcome)
