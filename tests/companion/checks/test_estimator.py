"""Estimator, vibration, and the sensors' health bits."""

import pytest

from companion.checks import Status

NOT_AVAILABLE, OK, WARNING, FAULT = Status.NOT_AVAILABLE, Status.OK, Status.WARNING, Status.FAULT
GOOD_FLAGS = 0x33F


def test_a_variance_beyond_the_failsafe_limit_is_a_warning_by_name(log):
    flight = log()
    flight.fly(
        10.0, 90.0, lambda t_s: [("EKF_STATUS_REPORT", {"flags": 831, "compass_variance": 1.4 if t_s > 60.0 else 0.1})]
    )
    variance = flight.findings()["ekf_variance"]
    assert variance.status is WARNING
    assert "compass 1.4" in variance.text


def test_a_ratio_of_px4_is_judged_by_its_own_limit(log):
    def ratio(value):
        flight = log(autopilot=12)
        flight.fly(
            10.0, 60.0, lambda _: [("ESTIMATOR_STATUS", {"flags": 831, "vel_ratio": value, "mag_ratio": float("nan")})]
        )
        return flight.findings()["ekf_variance"].status

    assert ratio(0.9) is OK
    assert ratio(1.2) is WARNING


def test_one_high_sample_is_nothing(log):
    flight = log()
    flight.fly(
        10.0, 60.0, lambda t_s: [("EKF_STATUS_REPORT", {"flags": 831, "velocity_variance": 5.0 if t_s == 30.0 else 0.0})]
    )
    assert flight.findings()["ekf_variance"].status is OK


def test_a_claim_withdrawn_while_armed_is_a_warning(log):
    flight = log()
    flight.fly(10.0, 90.0, lambda t_s: [("EKF_STATUS_REPORT", {"flags": GOOD_FLAGS & ~16 if t_s > 60.0 else GOOD_FLAGS})])
    flags = flight.findings()["ekf_flags"]
    assert flags.status is WARNING
    assert "horizontal position lost" in flags.text


def test_a_vehicle_that_never_claimed_a_position_may_be_in_constant_position_mode(log):
    flight = log(type=12)
    flight.fly(10.0, 90.0, lambda _: [("EKF_STATUS_REPORT", {"flags": 1 | 4 | 32 | 128})])
    assert flight.findings()["ekf_flags"].status is OK


def test_vibration_above_thirty_for_seconds_is_a_warning(log):
    flight = log()
    flight.fly(10.0, 90.0, lambda t_s: [("VIBRATION", {"vibration_y": 45.0 if 40.0 < t_s < 60.0 else 12.0})])
    vibration = flight.findings()["vibration"]
    assert vibration.status is WARNING
    assert "up to 45 m/s2" in vibration.text


def test_clips_are_counted_from_their_first_reading_and_while_armed(log):
    def clips(start, armed):
        flight = log()
        flight.fly(10.0, 60.0, lambda t_s: [("VIBRATION", {"clipping_0": start + round(4.0 * (t_s - 10.0))})], armed=armed)
        return flight.findings()["clipping"]

    assert clips(0, True).status is WARNING
    assert clips(50_000, True).text == clips(0, True).text
    assert clips(0, False).status is NOT_AVAILABLE


def bits(log, healthy, present=0x2F, enabled=0x2F, armed=True):
    flight = log()

    def status(t_s):
        fields = {
            "onboard_control_sensors_present": present,
            "onboard_control_sensors_enabled": enabled,
            "onboard_control_sensors_health": healthy(t_s),
        }
        return [("SYS_STATUS", fields)]

    flight.fly(10.0, 90.0, status, armed=armed)
    return flight.findings()["sensor_health"]


def test_a_sensor_that_turns_unhealthy_while_armed_is_a_fault(log):
    health = bits(log, lambda t_s: 0x2E if t_s > 50.0 else 0x2F)
    assert health.status is FAULT
    assert "gyro for 4" in health.text
    assert health.t == pytest.approx(50.25, abs=0.3)


def test_a_sensor_that_never_was_healthy_is_a_warning_only(log):
    health = bits(log, lambda _: 0x2B)
    assert health.status is WARNING
    assert "compass throughout" in health.text


def test_moments_and_sensors_that_are_not_used_and_disarmed_times_are_nothing(log):
    assert bits(log, lambda t_s: 0x2E if t_s == 50.0 else 0x2F).status is OK
    assert bits(log, lambda _: 0x2E, enabled=0x2E).status is OK
    assert bits(log, lambda _: 0x00, armed=False).status is NOT_AVAILABLE


def test_terrain_data_that_nobody_served_is_no_sensor(log):
    assert bits(log, lambda _: 0x2F, present=0x40002F, enabled=0x40002F).status is OK
