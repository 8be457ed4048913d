"""Airspeed of a fixed wing in a circle with wind."""

import math

import pytest

from companion.checks import Status

NOT_AVAILABLE, OK, WARNING, FAULT = Status.NOT_AVAILABLE, Status.OK, Status.WARNING, Status.FAULT


def reading(t_s):
    return 20.0 + 0.1 * math.sin(t_s)


def test_wind_is_no_fault_of_the_airspeed(plane):
    found = plane(wind_north_m_s=7.0)
    assert found["airspeed_scale"].status is found["airspeed_zero"].status is found["airspeed_stuck"].status is OK


def test_a_blocked_pitot_is_a_fault(plane):
    found = plane(airspeed=lambda t_s: 0.5 if t_s > 130.0 else reading(t_s))["airspeed_zero"]
    assert found.status is FAULT
    assert found.t == pytest.approx(130.0, abs=0.5)


def test_an_airspeed_that_never_read_is_absent_and_no_fault(plane):
    found = plane(airspeed=lambda _: 0.0)
    assert found["airspeed_zero"].status is found["airspeed_stuck"].status is NOT_AVAILABLE
    assert found["airspeed_zero"].text == "not available: no airspeed sensor reads in flight"


def test_an_airspeed_that_repeats_itself_is_a_fault(plane):
    found = plane(airspeed=lambda t_s: 24.0 if t_s > 130.0 else reading(t_s))["airspeed_stuck"]
    assert found.status is FAULT
    assert "24.0 m/s" in found.text


@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_a_factor_that_changes_in_flight_is_a_warning(plane, factor):
    found = plane(seconds=360.0, airspeed=lambda t_s: reading(t_s) * (factor if t_s > 150.0 else 1.0))["airspeed_scale"]
    assert found.status is WARNING
    assert f"{100.0 * (factor - 1.0):+.0f} %" in found.text


def test_a_constant_factor_is_a_matter_of_calibration(plane):
    assert plane(airspeed=lambda t_s: 0.8 * reading(t_s))["airspeed_scale"].status is OK


def test_a_rover_has_no_airspeed(log):
    flight = log(type=10)
    flight.fly(10.0, 90.0, lambda _: [("VFR_HUD", {"airspeed": 0.0, "groundspeed": 15.0})])
    found = flight.findings()
    assert {found[name].status for name in ("airspeed_zero", "airspeed_stuck")} == {NOT_AVAILABLE}
