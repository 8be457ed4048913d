"""The link's checks: losses, silence, floods, two under one id; and the vehicle's clock."""

import pytest

from companion.checks import Status

NOT_AVAILABLE, OK, WARNING = Status.NOT_AVAILABLE, Status.OK, Status.WARNING
CALM = [("VIBRATION", {"vibration_x": 1.0})]


def calm(t_s):
    return CALM


def test_lost_frames_are_counted_by_their_sequence_numbers(log):
    flight = log()
    flight.fly(10.0, 70.0, calm)
    flight.records = [record for place, record in enumerate(flight.records) if place % 10]
    loss = flight.findings()["link_loss"]
    assert loss.status is WARNING
    assert "9.7 % of 359 lost" in loss.text  # of 360 the last one is not missed


def test_a_link_that_loses_one_in_a_hundred_is_fine(log):
    flight = log()
    flight.fly(10.0, 110.0, calm)
    flight.records = [record for place, record in enumerate(flight.records) if place % 100]
    assert flight.findings()["link_loss"].status is OK


def test_a_frame_heard_twice_is_no_loss(log):
    flight = log()
    flight.fly(10.0, 70.0, calm)
    flight.records = [record for one in flight.records for record in (one, one)]
    loss = flight.findings()["link_loss"]
    assert loss.status is OK
    assert "late or twice" in loss.text


def test_silence_beyond_five_beats_is_told_with_its_place(log):
    flight = log()
    flight.fly(10.0, 40.0, calm)
    flight.fly(52.0, 80.0, calm)
    silence = flight.findings()["link_silence"]
    assert silence.status is WARNING
    assert silence.spans[0] == pytest.approx((39.75, 52.0))


def test_silence_of_three_seconds_is_none(log):
    flight = log()
    flight.fly(10.0, 40.0, calm)
    flight.fly(43.0, 80.0, calm)
    assert flight.findings()["link_silence"].status is OK


def test_a_flood_of_heartbeats_by_a_stranger_is_seen(log):
    flight = log()
    flight.fly(10.0, 60.0, calm)
    for k in range(4000):
        flight.beat(30.0 + k / 400.0, sysid=2, compid=2, type=0, autopilot=8)
    flight.records.sort(key=lambda record: record[1])
    flood = flight.findings()["link_flood"]
    assert flood.status is WARNING
    assert flood.text.startswith("somebody floods the link: 2/2 up to 40")
    assert flood.t == pytest.approx(30.0, abs=1.5)


def test_a_short_burst_is_no_flood(log):
    flight = log()
    flight.fly(10.0, 60.0, calm)
    for k in range(900):
        flight.send(30.0 + k / 900.0, "PARAM_REQUEST_READ", {}, sysid=255, compid=190)
    flight.records.sort(key=lambda record: record[1])
    assert flight.findings()["link_flood"].status is OK


def test_two_kinds_under_one_id_are_told_and_do_not_disarm_the_vehicle(log):
    flight = log()
    flight.fly(10.0, 60.0, calm)
    for k in range(100):
        flight.beat(30.0 + k / 10.0, armed=False, type=0, autopilot=8)
    flight.records.sort(key=lambda record: record[1])
    found = flight.findings()
    assert found["link_identity"].status is WARNING
    assert "quadrotor of ardupilotmega" in found["link_identity"].text
    assert len(found["arming"].spans) == 1


def test_a_reboot_in_the_log_is_told(log):
    flight = log()
    flight.fly(300.0, 340.0, calm)
    before = len(flight.records)
    flight.fly(5.0, 30.0, calm)
    flight.records[before:] = [(frame, stamp_us + 350_000_000) for frame, stamp_us in flight.records[before:]]
    found = flight.findings()
    assert found["reboot"].status is WARNING
    assert "1 time(s), 1 while armed (after 33" in found["reboot"].text
    assert found["clock"].status is OK


def test_a_single_stray_stamp_is_no_reboot(log):
    flight = log()
    flight.fly(300.0, 340.0, calm)
    stray = log()
    stray.send(7.0, "SYSTEM_TIME", {})
    flight.records.insert(81, (stray.records[0][0], flight.records[80][1]))
    found = flight.findings()
    assert found["reboot"].status is found["clock"].status is OK


def test_a_clock_that_leaps_ahead_of_the_arrivals_is_told(log):
    flight = log()
    flight.fly(10.0, 40.0, calm)
    before = len(flight.records)
    flight.fly(400.0, 440.0, calm)
    flight.records[before:] = [(frame, stamp_us - 359_000_000) for frame, stamp_us in flight.records[before:]]
    found = flight.findings()
    assert found["clock"].status is WARNING
    assert "jumped 1 time(s)" in found["clock"].text
    assert found["reboot"].status is OK


def test_stamps_of_the_time_of_writing_are_told(log):
    flight = log()
    flight.fly(10.0, 310.0, calm, hz=1.0)
    first_us = flight.records[0][1]
    flight.records = [(frame, first_us + (stamp_us - first_us) // 25) for frame, stamp_us in flight.records]
    clock = flight.findings()["clock"]
    assert clock.status is WARNING
    assert "of the vehicle came in" in clock.text


def test_arrival_stamps_that_run_back_are_told(log):
    flight = log()
    flight.fly(10.0, 60.0, calm)
    flight.records[50] = (flight.records[50][0], flight.records[50][1] - 3_000_000)
    assert "ran backwards 1 time(s)" in flight.findings()["clock"].text
