"""Compasses, heading and barometer of a fixed wing in a circle."""

import math

import pytest

from companion.checks import Status

NOT_AVAILABLE, OK, WARNING = Status.NOT_AVAILABLE, Status.OK, Status.WARNING


def later(size):
    return lambda t_s: size * (t_s > 150.0)


def test_an_offset_that_comes_up_in_flight_is_seen_by_each_check_that_can(plane):
    found = plane(seconds=360.0, magnet=later(200.0))
    assert found["compass_pair"].status is found["compass_offset"].status is found["compass_field"].status is WARNING
    assert "along x" in found["compass_offset"].text
    assert "1 and 2 by 200 mG along x" in found["compass_pair"].text


def test_an_offset_present_throughout_is_a_matter_of_calibration(plane):
    found = plane(magnet=lambda _: 60.0)
    assert found["compass_pair"].status is found["compass_offset"].status is OK


def test_a_compass_that_is_not_there_is_not_judged(log):
    flight = log()
    flight.fly(10.0, 90.0, lambda _: [("RAW_IMU", {"zacc": -1000}), ("SCALED_IMU2", {"zacc": -1000}), ("ATTITUDE", {})])
    found = flight.findings()
    assert {found[name].status for name in ("compass_field", "compass_pair", "compass_offset")} == {NOT_AVAILABLE}


def test_a_heading_far_from_the_course_is_a_warning(plane):
    found = plane(yaw_rad=later(math.radians(70.0)))["heading_course"]
    assert found.status is WARNING
    assert found.t == pytest.approx(150.0, abs=0.5)


def test_crabbing_in_the_wind_is_none(plane):
    assert plane(wind_north_m_s=8.0)["heading_course"].status is OK


def test_a_barometer_that_drifts_from_the_gps_is_a_warning(plane):
    found = plane(baro_m=lambda t_s: max(0.0, 0.3 * (t_s - 100.0)))["baro_height"]
    assert found.status is WARNING


def test_weather_of_some_metres_is_none(plane):
    assert plane(baro_m=lambda t_s: 0.04 * t_s)["baro_height"].status is OK


def test_water_is_no_air(log):
    def dive(t_s):
        gps = {"fix_type": 3, "alt": 0, "eph": 90}
        return [("GPS_RAW_INT", gps), ("SCALED_PRESSURE", {"press_abs": 1013.0 + 10.0 * t_s})]

    flight = log(type=12)
    flight.fly(10.0, 160.0, dive)
    assert flight.findings()["baro_height"].status is NOT_AVAILABLE
