"""GPS checks."""

import pytest

from companion.checks import Status

NOT_AVAILABLE, OK, WARNING, FAULT = Status.NOT_AVAILABLE, Status.OK, Status.WARNING, Status.FAULT


def gps(t_s, **fields):
    base = {"time_usec": round(t_s * 1e6), "fix_type": 3, "eph": 90, "vel": 0, "cog": 65535, "satellites_visible": 12}
    return [("GPS_RAW_INT", {**base, **fields})]


def test_a_fix_lost_while_armed_is_a_warning(log):
    flight = log()
    flight.fly(10.0, 90.0, lambda t_s: gps(t_s, fix_type=1 if 50.0 <= t_s < 70.0 else 3))
    fix = flight.findings()["gps_fix"]
    assert fix.status is WARNING
    assert fix.spans[0] == pytest.approx((50.0, 70.0))


def test_a_receiver_that_is_gone_is_a_fault(log):
    flight = log()
    flight.fly(10.0, 90.0, lambda t_s: gps(t_s, fix_type=0 if t_s >= 50.0 else 3))
    fix = flight.findings()["gps_fix"]
    assert fix.status is FAULT
    assert "silent" in fix.text


def test_a_fix_lost_for_a_second_or_while_disarmed_is_nothing(log):
    flight = log()
    flight.fly(10.0, 50.0, lambda t_s: gps(t_s, fix_type=1 if t_s == 30.0 else 3))
    flight.fly(50.0, 90.0, lambda t_s: gps(t_s, fix_type=1), armed=False)
    assert flight.findings()["gps_fix"].status is OK


def test_a_gps_that_never_had_a_fix_is_not_judged(log):
    flight = log()
    flight.fly(10.0, 90.0, lambda t_s: gps(t_s, fix_type=1, satellites_visible=3))
    found = flight.findings()
    assert {found[name].status for name in ("gps_fix", "gps_satellites", "gps_hdop", "gps_jump")} == {NOT_AVAILABLE}


def test_few_satellites_and_a_bad_geometry_are_warnings(log):
    flight = log()
    flight.fly(10.0, 90.0, lambda t_s: gps(t_s, satellites_visible=5 if t_s > 50.0 else 9, eph=420 if t_s > 60.0 else 90))
    found = flight.findings()
    assert found["gps_satellites"].status is found["gps_hdop"].status is WARNING
    assert "down to 5" in found["gps_satellites"].text
    assert "up to 4.2" in found["gps_hdop"].text


def test_unknown_counts_and_geometry_are_not_available(log):
    flight = log()
    flight.fly(10.0, 90.0, lambda t_s: gps(t_s, satellites_visible=255, eph=65535, vel=65535))
    found = flight.findings()
    for name in ("gps_satellites", "gps_hdop", "gps_accuracy", "gps_jump", "gps_drift"):
        assert found[name].status is NOT_AVAILABLE, name


def test_a_large_error_stated_by_the_receiver_is_a_warning(log):
    flight = log()
    flight.fly(10.0, 90.0, lambda t_s: gps(t_s, h_acc=8000 if t_s > 50.0 else 900, vel_acc=300))
    accuracy = flight.findings()["gps_accuracy"]
    assert accuracy.status is WARNING
    assert "position to 8.0 m" in accuracy.text


def test_a_jump_of_thirty_metres_is_a_fault_and_one_of_twenty_is_none(plane):
    jumped = plane(gps_north_m=lambda t_s: 30.0 * (t_s > 150.0))["gps_jump"]
    assert jumped.status is FAULT
    assert jumped.t == pytest.approx(150.0, abs=0.5)
    assert plane(gps_north_m=lambda t_s: 20.0 * (t_s > 150.0))["gps_jump"].status is OK


def test_a_position_that_drifts_from_its_velocity_is_a_fault(plane):
    drift = plane(gps_north_m=lambda t_s: max(0.0, t_s - 120.0))["gps_drift"]
    assert drift.status is FAULT
    assert "1.0" in drift.text


def test_a_velocity_read_wrongly_is_a_fault_of_the_same_check(plane):
    assert plane(gps_velocity_north_m_s=lambda t_s: 3.0 * (t_s > 120.0))["gps_drift"].status is FAULT


def test_a_jump_is_no_drift(plane):
    assert plane(gps_north_m=lambda t_s: 30.0 * (t_s > 150.0))["gps_drift"].status is OK
