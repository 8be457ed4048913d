"""Streams are asked for the new way, then the old way, and what does not come is said."""

import pytest
from pymavlink.dialects.v20 import all as mavlink

from companion.streams import CHECK_US, GROUPS, Streams

S = 1_000_000
START_US = 1_700_000_000 * S
WANTED_HZ = {"ATTITUDE": 10.0, "WHEEL_DISTANCE": 10.0, "WIND": 1.0, "EXTENDED_SYS_STATE": 0.5}


def flown(streams, rates_hz, start_us, seconds):
    """Messages at these rates, `tick` ten times a second; -> the requests by the second in which they came."""
    out = []
    for tenth in range(round(10 * seconds)):
        now_us = start_us + tenth * S // 10
        sends = streams.tick(now_us)
        if sends:
            out.append((tenth / 10, sends))
        for name, rate_hz in rates_hz.items():
            count = int((tenth + 1) * rate_hz / 10) - int(tenth * rate_hz / 10)
            for _ in range(count):
                streams.heard(name)
    return out


def intervals(sends):
    """{message: interval in us} of SET_MESSAGE_INTERVAL requests."""
    assert all(send.message == "COMMAND_LONG" for send in sends)
    assert all(send.fields["command"] == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL for send in sends)
    return {mavlink.mavlink_map[int(send.fields["param1"])].msgname: send.fields["param2"] for send in sends}


def groups(sends):
    """{group: Hz} of REQUEST_DATA_STREAM requests."""
    assert all(send.message == "REQUEST_DATA_STREAM" and send.fields["start_stop"] == 1 for send in sends)
    return {send.fields["req_stream_id"]: send.fields["req_message_rate"] for send in sends}


def test_each_message_is_asked_for_by_its_interval():
    sends = Streams(WANTED_HZ).ask(START_US)
    assert intervals(sends) == {"ATTITUDE": 1e5, "WHEEL_DISTANCE": 1e5, "WIND": 1e6, "EXTENDED_SYS_STATE": 2e6}


def test_nothing_is_asked_for_before_the_vehicle_is_known():
    streams = Streams(WANTED_HZ)
    assert flown(streams, {}, START_US, 60) == []
    assert streams.missing == ()


def test_streams_that_come_are_not_asked_for_again():
    streams = Streams(WANTED_HZ)
    streams.ask(START_US)
    assert flown(streams, WANTED_HZ, START_US, 120) == []
    assert streams.missing == ()


def test_radios_that_thin_out_by_half_are_enough_and_by_more_are_not():
    for share, lacking in ((0.5, set()), (0.4, {"ATTITUDE", "WHEEL_DISTANCE"})):
        streams = Streams({"ATTITUDE": 10.0, "WHEEL_DISTANCE": 10.0})
        streams.ask(START_US)
        asked = flown(streams, dict.fromkeys(streams.wanted_hz, 10.0 * share), START_US, 5)
        assert set(intervals(asked[0][1])) == lacking if lacking else asked == []


def test_what_lacks_is_asked_for_again_then_by_its_group_then_said():
    streams = Streams(WANTED_HZ)
    streams.ask(START_US)
    asked = flown(streams, {"ATTITUDE": 10.0}, START_US, 60)
    assert [second for second, _ in asked] == [4.0, 8.0]
    assert set(intervals(asked[0][1])) == {"WHEEL_DISTANCE", "WIND", "EXTENDED_SYS_STATE"}
    assert groups(asked[1][1]) == {mavlink.MAV_DATA_STREAM_EXTRA3: 10}
    assert streams.missing == ("WHEEL_DISTANCE", "WIND", "EXTENDED_SYS_STATE")


@pytest.mark.parametrize("order", [("WHEEL_DISTANCE", "WIND"), ("WIND", "WHEEL_DISTANCE")])
def test_a_group_is_asked_for_at_the_rate_of_its_fastest_message(order):
    streams = Streams({name: WANTED_HZ[name] for name in order})
    streams.ask(START_US)
    asked = flown(streams, {}, START_US, 9)
    assert groups(asked[-1][1]) == {mavlink.MAV_DATA_STREAM_EXTRA3: 10}


def test_a_group_is_never_asked_for_at_zero_hertz():
    streams = Streams({"WIND": 0.2})
    streams.ask(START_US)
    assert groups(flown(streams, {}, START_US, 9)[-1][1]) == {mavlink.MAV_DATA_STREAM_EXTRA3: 1}


def test_what_came_before_counts_for_nothing_when_it_has_stopped():
    streams = Streams({"ATTITUDE": 10.0, "WIND": 1.0})
    streams.ask(START_US)
    (first,) = flown(streams, {"ATTITUDE": 10.0}, START_US, 4.1)
    assert set(intervals(first[1])) == {"WIND"}
    (second,) = flown(streams, {}, START_US + 4_100_000, 4.1)
    assert set(groups(second[1])) == {mavlink.MAV_DATA_STREAM_EXTRA1, mavlink.MAV_DATA_STREAM_EXTRA3}


def test_what_helped_is_not_missing():
    streams = Streams({"WHEEL_DISTANCE": 10.0})
    streams.ask(START_US)
    flown(streams, {}, START_US, 8.1)
    flown(streams, {"WHEEL_DISTANCE": 10.0}, START_US + 8_100_000, 20)
    assert streams.missing == ()


def test_only_what_lacks_in_the_end_is_missing():
    streams = Streams({"WHEEL_DISTANCE": 10.0, "WIND": 1.0})
    streams.ask(START_US)
    flown(streams, {"WIND": 1.0}, START_US, 20)
    assert streams.missing == ("WHEEL_DISTANCE",)


def test_after_a_reboot_everything_is_asked_for_anew_and_nothing_is_missing_yet():
    streams = Streams(WANTED_HZ)
    streams.ask(START_US)
    flown(streams, {}, START_US, 20)
    assert streams.missing == tuple(WANTED_HZ)
    assert set(intervals(streams.ask(START_US + 60 * S))) == set(WANTED_HZ)
    assert streams.missing == ()
    assert flown(streams, WANTED_HZ, START_US + 60 * S, 20) == []


def test_counts_begin_where_the_last_ended_and_not_when_somebody_looks():
    prompt, late = Streams(WANTED_HZ), Streams(WANTED_HZ)
    for streams, delay_us in ((prompt, 0), (late, 300_000)):
        streams.ask(START_US)
        assert streams.tick(START_US + CHECK_US + delay_us)
        assert streams.until_us == START_US + 2 * CHECK_US
    assert prompt == late


def test_groups_are_those_in_which_ardupilot_sends_the_message():
    assert set(GROUPS.values()) <= {
        value for name, value in vars(mavlink).items() if name.startswith("MAV_DATA_STREAM_") and isinstance(value, int)
    }
    assert GROUPS["ATTITUDE"] == mavlink.MAV_DATA_STREAM_EXTRA1
    assert GROUPS["SERVO_OUTPUT_RAW"] == mavlink.MAV_DATA_STREAM_RC_CHANNELS
    assert GROUPS["GLOBAL_POSITION_INT"] == mavlink.MAV_DATA_STREAM_POSITION
