"""Who is believed to be the vehicle, and when it counts as silent or lost."""

import pytest
from pymavlink.dialects.v20 import all as mavlink

from companion.dialect import encode
from companion.frames import Splitter
from companion.vehicle import (
    CHOICE_US,
    LOST_AFTER_US,
    NO_VEHICLE,
    SILENT_AFTER_US,
    Heartbeat,
    LinkState,
    Watch,
    heartbeat,
)

S = 1_000_000
START_US = 1_700_000_000 * S


def beat(sysid=1, compid=1, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, kind=mavlink.MAV_TYPE_PARAFOIL):
    return Heartbeat(sysid, compid, autopilot, kind, armed=False, mode=0)


def taken(pinned=None, sysid=1):
    watch = Watch(pinned)
    watch.offer(beat(sysid), START_US)
    watch.choose(START_US + CHOICE_US)
    assert watch.known
    return watch


def frame(sysid, compid):
    (made,) = Splitter().feed(encode("HEARTBEAT", {}, sysid=sysid, compid=compid, seq=0))
    return made


@pytest.mark.parametrize("mode", [0, 0x7F, 0x80, 0x81, 0xFF])
def test_a_heartbeat_is_read_from_its_frame(mode):
    fields = {"type": 28, "autopilot": 3, "base_mode": mode, "custom_mode": 2**31 + 5, "mavlink_version": 3}
    (made,) = Splitter().feed(encode("HEARTBEAT", fields, sysid=42, compid=7, seq=0))
    assert heartbeat(made) == Heartbeat(42, 7, 3, 28, armed=mode >= 0x80, mode=2**31 + 5)


def test_the_only_autopilot_is_taken_after_a_moment_and_once():
    watch = Watch()
    watch.offer(beat(7), START_US)
    assert watch.choose(START_US + CHOICE_US - 1) is None
    assert not watch.known
    assert watch.choose(START_US + CHOICE_US) == START_US + CHOICE_US
    assert (watch.sysid, watch.compid, watch.autopilot, watch.type, watch.link) == (7, 1, 3, 28, LinkState.UP)
    assert watch.choose(START_US + 2 * CHOICE_US) is None


def test_it_is_taken_at_the_stamp_at_which_it_was_ripe_whenever_somebody_looks():
    early, late = Watch(), Watch()
    for watch in (early, late):
        watch.offer(beat(), START_US)
    assert early.choose(START_US + CHOICE_US) == late.choose(START_US + 60 * S) == START_US + CHOICE_US
    assert early == late


def test_nobody_is_taken_before_anybody_was_heard():
    watch = Watch()
    assert watch.choose(START_US) is None
    assert watch.link is LinkState.NONE
    assert watch.silence(START_US + 3600 * S) is None


@pytest.mark.parametrize("kind", sorted(NO_VEHICLE))
def test_what_is_no_vehicle_is_not_taken_even_if_it_names_an_autopilot(kind):
    watch = Watch()
    watch.offer(beat(kind=kind), START_US)
    assert watch.choose(START_US + 60 * S) is None


def test_a_component_without_an_autopilot_is_not_taken():
    watch = Watch()
    watch.offer(beat(autopilot=mavlink.MAV_AUTOPILOT_INVALID), START_US)
    assert watch.choose(START_US + 60 * S) is None


def test_of_two_vehicles_none_is_taken_and_both_are_named():
    watch = Watch()
    watch.offer(beat(9), START_US)
    watch.offer(beat(3), START_US + S)
    assert watch.choose(START_US + 60 * S) is None
    assert watch.rivals == (3, 9)
    assert not watch.known


def test_a_second_heartbeat_of_the_same_vehicle_makes_no_rival():
    watch = Watch()
    watch.offer(beat(3), START_US)
    watch.offer(beat(3), START_US + S)
    assert watch.choose(START_US + CHOICE_US) is not None
    assert watch.rivals == ()


def test_a_vehicle_asked_for_by_its_number_is_taken_at_once_and_no_other():
    watch = Watch(9)
    watch.offer(beat(3), START_US)
    assert watch.choose(START_US + 60 * S) is None
    watch.offer(beat(9), START_US + 61 * S)
    assert watch.choose(START_US + 61 * S) == START_US + 61 * S
    assert watch.sysid == 9


def test_only_the_vehicles_own_autopilot_is_believed():
    watch = taken(sysid=5)
    assert watch.is_autopilot(frame(5, 1))
    assert not watch.is_autopilot(frame(5, 191))
    assert not watch.is_autopilot(frame(6, 1))
    assert not Watch().is_autopilot(frame(1, 1))


def test_silence_of_five_seconds_is_silent_and_of_thirty_is_lost_each_told_once():
    watch = taken()
    heard_us = watch.heard_us
    assert watch.silence(heard_us + SILENT_AFTER_US) is None
    assert watch.silence(heard_us + SILENT_AFTER_US + 1) == (LinkState.SILENT, heard_us + SILENT_AFTER_US)
    assert watch.silence(heard_us + LOST_AFTER_US) is None
    assert watch.silence(heard_us + LOST_AFTER_US + 1) == (LinkState.LOST, heard_us + LOST_AFTER_US)
    assert watch.silence(heard_us + 3600 * S) is None
    assert (SILENT_AFTER_US, LOST_AFTER_US) == (5 * S, 30 * S)


def test_looking_late_tells_both_changes_with_the_stamps_at_which_they_fell_due():
    watch = taken()
    told = [watch.silence(watch.heard_us + 3600 * S) for _ in range(3)]
    assert told == [
        (LinkState.SILENT, watch.heard_us + SILENT_AFTER_US),
        (LinkState.LOST, watch.heard_us + LOST_AFTER_US),
        None,
    ]


def test_four_lost_heartbeats_are_no_silence():
    watch = taken()
    for second in range(0, 60, 5):
        assert watch.silence(START_US + CHOICE_US + second * S) is None
        watch.heard_us = START_US + CHOICE_US + second * S
