"""Outputs and attitude tracking."""

import math

import pytest

from companion.checks import Status

NOT_AVAILABLE, OK, WARNING = Status.NOT_AVAILABLE, Status.OK, Status.WARNING


def flying(t_s, **servos):
    base = {f"servo{place}_raw": 1500 + round(120.0 * math.sin(t_s + place)) for place in range(1, 5)}
    return [
        ("GLOBAL_POSITION_INT", {"relative_alt": 50_000}),
        ("VFR_HUD", {"groundspeed": 15.0}),
        ("SERVO_OUTPUT_RAW", {"time_usec": round(t_s * 1e6) & 0xFFFFFFFF, **base, **servos}),
    ]


def saturation(log, servos, kind=1, parameters=()):
    flight = log(type=kind)
    for name, value in parameters:
        flight.beat(9.0)
        flight.send(9.5, "PARAM_VALUE", {"param_id": name, "param_value": value})
    flight.fly(10.0, 110.0, lambda t_s: flying(t_s, **servos(t_s)))
    return flight.findings()["output_saturation"]


def test_an_output_that_stands_at_its_limit_for_long_is_a_warning(log):
    found = saturation(log, lambda t_s: {"servo2_raw": 1900} if t_s > 60.0 else {})
    assert found.status is WARNING
    assert "output 2 at its upper end" in found.text


def test_the_limits_are_the_parameters_of_the_vehicle_where_it_told_them(log):
    def servos(t_s):
        return {"servo2_raw": 1900} if t_s > 60.0 else {}

    assert saturation(log, servos, parameters=[("SERVO2_MAX", 2000.0)]).status is OK
    assert saturation(log, servos, parameters=[("SERVO2_MAX", 1850.0)]).status is WARNING


def test_an_idle_throttle_is_not_saturated(log):
    idle = saturation(log, lambda t_s: {"servo3_raw": 1000} if t_s > 60.0 else {})
    assert idle.status is OK
    told = [("SERVO3_FUNCTION", 4.0), ("SERVO1_FUNCTION", 70.0)]
    assert saturation(log, lambda t_s: {"servo1_raw": 1000} if t_s > 60.0 else {}, parameters=told).status is OK
    assert saturation(log, lambda t_s: {"servo3_raw": 1000} if t_s > 60.0 else {}, parameters=told).status is WARNING


def test_an_output_that_never_moves_or_is_off_carries_no_control(log):
    assert saturation(log, lambda _: {"servo2_raw": 1900}).status is OK
    assert saturation(log, lambda t_s: {"servo2_raw": 0 if t_s > 60.0 else 1500}).status is OK


def test_a_motor_that_works_harder_than_before_is_a_warning(log):
    flight = log(type=2)
    flight.fly(10.0, 260.0, lambda t_s: flying(t_s, **({"servo1_raw": 1700} if t_s > 130.0 else {})))
    balance = flight.findings()["motor_balance"]
    assert balance.status is WARNING
    assert "motor 1" in balance.text


def test_motors_unequal_throughout_are_a_warning(log):
    flight = log(type=2)
    flight.fly(10.0, 160.0, lambda t_s: flying(t_s, servo1_raw=1700, servo2_raw=1400))
    assert "throughout" in flight.findings()["motor_balance"].text


def test_motors_on_the_ground_are_not_judged(log):
    flight = log(type=2)
    flight.fly(10.0, 160.0, lambda t_s: [("GLOBAL_POSITION_INT", {}), *flying(t_s)[1:]])
    assert flight.findings()["motor_balance"].status is NOT_AVAILABLE


def test_a_roll_that_does_not_follow_is_a_warning(plane):
    turn_deg = 11.5
    found = plane(nav_roll_deg=lambda t_s: turn_deg + 25.0 * (120.0 < t_s < 130.0))["attitude_tracking"]
    assert found.status is WARNING
    assert found.t == pytest.approx(120.0, abs=0.5)
    assert "roll" in found.text


def test_a_moment_of_rolling_in_is_nothing(plane):
    assert plane(nav_roll_deg=lambda t_s: 11.5 + 25.0 * (120.0 < t_s < 122.0))["attitude_tracking"].status is OK


def test_a_target_quaternion_is_compared_and_an_ignored_one_is_not(log):
    def target(roll_rad, mask=0):
        flight = log(type=2, autopilot=12)
        q = (math.cos(roll_rad / 2.0), math.sin(roll_rad / 2.0), 0.0, 0.0)
        flight.fly(
            10.0,
            60.0,
            lambda t_s: [*flying(t_s), ("ATTITUDE", {"roll": 0.1}), ("ATTITUDE_TARGET", {"q": q, "type_mask": mask})],
        )
        return flight.findings()["attitude_tracking"].status

    assert target(0.1) is OK
    assert target(0.5) is WARNING
    assert target(0.5, mask=128) is NOT_AVAILABLE
