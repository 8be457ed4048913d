"""Bad links, floods, garbage: what can be asked for happens as asked, what comes uninvited does no harm."""

import time
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl.autopilot import Misbehaviour
from tests.sitl.network import CLASSES, Network


def arrivals(seconds=60, seed=3, **switches):
    network = Network(misbehaviour=Misbehaviour(**switches), seed=seed)
    gcs = network.peer()
    network.run(seconds)
    return gcs.raw()


def numbers(frames):
    return [raw[4] for raw in frames]


def test_a_link_loses_the_share_that_was_asked_for():
    whole, rest = arrivals(), arrivals(link_loss=0.3)
    assert len(rest) == pytest.approx(0.7 * len(whole), rel=0.05)
    assert set(rest) <= set(whole)


def test_a_link_doubles_the_share_that_was_asked_for():
    whole, more = arrivals(), arrivals(link_duplication=0.2)
    assert len(more) == pytest.approx(1.2 * len(whole), rel=0.05)
    assert [raw for n, raw in enumerate(more) if n == 0 or raw != more[n - 1]] == whole


def test_a_link_swaps_frames_and_loses_none():
    whole, mixed = arrivals(), arrivals(link_swap=0.2)
    assert mixed != whole
    assert len(whole) - len(mixed) in (0, 1)  # one may still wait for its follower
    missing = Counter(whole) - Counter(mixed)
    assert missing.total() <= 1
    steps = Counter((b - a) % 256 for a, b in pairwise(numbers(mixed)))
    assert steps[2] > 0.1 * len(mixed)


def test_a_spoiled_link_is_the_same_for_the_same_seed_and_another_for_another():
    spoiled = {"link_loss": 0.1, "link_duplication": 0.1, "link_swap": 0.1}
    assert arrivals(**spoiled) == arrivals(**spoiled)
    assert arrivals(**spoiled) != arrivals(seed=4, **spoiled)


def test_what_a_link_loses_can_be_set_over_the_link():
    network = Network()
    gcs = network.peer()
    gcs.set("SIM_LINK_LOSS", 1.0)
    network.run(5)
    assert gcs.raw() == []
    gcs.say("PARAM_SET", target_system=1, target_component=1, param_id="SIM_LINK_LOSS", param_value=0.0, param_type=9)
    network.run(1)
    assert gcs.raw()


def test_the_time_exchange_of_a_lockstep_run_passes_the_worst_link():
    network = Network(misbehaviour=Misbehaviour(link_loss=1.0))
    gcs = network.peer()
    network.run(1)
    ts1_ns = network.autopilot.ask_time(["gcs"])
    (asked,) = gcs.heard()
    assert (asked.get_type(), asked.tc1, asked.ts1) == ("TIMESYNC", 0, ts1_ns)
    gcs.say("TIMESYNC", tc1=77, ts1=ts1_ns)
    assert network.autopilot.time_answers == {"gcs": ts1_ns}


def test_a_flood_comes_at_its_rate_besides_everything_else():
    network = Network()
    gcs = network.peer()
    gcs.set("SIM_FLOOD", 250.0)
    network.run(10)
    kinds = Counter(m.get_type() for m in gcs.heard())
    assert kinds["NAMED_VALUE_FLOAT"] == 2500
    assert kinds["SERVO_OUTPUT_RAW"] == 100


def test_frames_that_nobody_takes_away_are_dropped_and_counted():
    network = Network(misbehaviour=Misbehaviour(flood_hz=10_000.0))
    for _ in range(30):
        network.autopilot.step()
    assert network.autopilot.counters.dropped > 15_000
    assert len(network.autopilot.outgoing()) <= 10_000


def test_the_same_flight_and_the_same_requests_give_the_same_bytes():
    def flight():
        network = Network(rates="fast", seed=9)
        gcs = network.peer()
        network.run(7)
        gcs.set("SLED_SPEED", 12.0)
        network.run(3)
        return gcs.raw()

    assert flight() == flight()


@settings(max_examples=200, deadline=None)
@given(st.lists(st.binary(max_size=300), max_size=5))
def test_random_bytes_raise_nothing(chunks):
    network = Network()
    network.peer()
    for chunk in chunks:
        network.autopilot.receive("gcs", chunk)
    network.run(0.2)


def test_random_fields_of_every_message_raise_nothing():
    random = np.random.default_rng(11)
    network = Network()
    gcs, _ = network.peer("gcs"), network.peer("companion", 1, 191)
    for _ in range(10):
        for name in sorted(name for name in CLASSES if "TEST" not in name):
            size = CLASSES[name].unpacker.size
            payload = bytearray(random.integers(0, 256, size, dtype=np.uint8))
            network.autopilot.receive("gcs", _framed(name, payload, random))
        network.run(0.5)
    assert network.autopilot.counters.frames_in > 3000
    assert gcs.heard("HEARTBEAT") or network.autopilot.silent


def test_random_commands_for_us_raise_nothing_and_each_is_answered():
    random = np.random.default_rng(12)
    network = Network()
    gcs = network.peer()
    values = [0.0, 1.0, -1.0, 2.0, 0.5, 101.0, 244.0, 33.0, 1e30, -1e30, float("nan"), float("inf")]
    commands = [0, 16, 176, 241, 400, 401, 410, 420, 510, 511, 512, 519, 520, 521, 31010]
    for _ in range(1500):
        acks = gcs.command(int(random.choice(commands)), *random.choice(values, 7))
        assert len(acks) == 1
        network.run(0.1)
        network.forget()


def _framed(name, payload, random):
    """A good frame around any payload, addressed to the autopilot in half of the cases where it has an address."""
    cls = CLASSES[name]
    slots = list(cls.unpacker.unpack(bytes(payload)))
    position = 0
    for field, length in zip(cls.ordered_fieldnames, cls.lengths, strict=True):
        if field in ("target_system", "target_component") and random.random() < 0.5:
            slots[position] = 1
        position += max(1, length)
    body = cls.unpacker.pack(*slots).rstrip(b"\0") or b"\0"
    header = bytes([len(body), 0, 0, 0, 255, 190, cls.id & 0xFF, cls.id >> 8 & 0xFF, cls.id >> 16])
    crc = _crc(header + body + bytes([cls.crc_extra]))
    return b"\xfd" + header + body + crc.to_bytes(2, "little")


def _crc(data):
    crc = 0xFFFF  # MAVLink guide: CRC-16/MCRF4XX
    for byte in data:
        byte ^= crc & 0xFF
        byte ^= (byte << 4) & 0xFF
        crc = (crc >> 8) ^ (byte << 8) ^ (byte << 3) ^ (byte >> 4)
    return crc


@pytest.mark.parametrize(("rates", "least"), [("stock", 100), ("fast", 50)])
def test_a_core_flies_much_faster_than_real_time(rates, least):
    network = Network(rates=rates)
    network.peer()
    network.autopilot.everybody = False
    steps = round(60.0 / network.autopilot.dt_s)
    start_s = time.process_time()
    for _ in range(steps):
        network.autopilot.step()
        network.autopilot.outgoing()
    assert 60.0 / (time.process_time() - start_s) > least
