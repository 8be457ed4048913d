"""Gyros and accelerometers of a fixed wing in a circle."""

import pytest

from companion.checks import Status
from companion.checks.reading import imu

NOT_AVAILABLE, OK, WARNING, FAULT = Status.NOT_AVAILABLE, Status.OK, Status.WARNING, Status.FAULT
ONSET_S = 130.0


def later(size):
    return lambda t_s: size * (t_s > ONSET_S)


@pytest.mark.parametrize("bias_rad_s", [0.02, -0.05])
def test_a_bias_of_one_gyro_is_a_fault(plane, bias_rad_s):
    found = plane(gyro_1=later(bias_rad_s))["gyro_pair"]
    assert found.status is FAULT
    assert f"by {abs(bias_rad_s):.3f} rad/s about z" in found.text
    assert found.t == pytest.approx(ONSET_S, abs=11.0)


def test_a_bias_of_both_gyros_shows_against_the_estimator(plane):
    found = plane(gyro_both=later(0.03))
    assert found["gyro_pair"].status is OK
    assert found["gyro_bias"].status is WARNING
    assert "about z" in found["gyro_bias"].text


def test_a_constant_bias_is_a_matter_of_calibration(plane):
    found = plane(gyro_1=lambda _: 0.03, accelerometer_1=lambda _: 0.5)
    assert found["gyro_pair"].status is found["gyro_bias"].status is found["accelerometer_pair"].status is OK


def test_sensors_further_apart_than_arming_allows_are_a_warning(plane):
    found = plane(gyro_1=lambda _: 0.12, accelerometer_1=lambda _: 0.9)
    assert found["gyro_pair"].status is found["accelerometer_pair"].status is WARNING
    assert "throughout" in found["gyro_pair"].text


def test_a_bias_of_one_accelerometer_is_a_fault(plane):
    found = plane(accelerometer_1=later(0.5))
    assert found["accelerometer_pair"].status is FAULT
    assert "m/s2 along y" in found["accelerometer_pair"].text


def test_a_bias_of_both_accelerometers_shows_against_the_motion(plane):
    found = plane(accelerometer_both=later(0.5))
    assert found["accelerometer_pair"].status is OK
    assert found["accelerometer_motion"].status is WARNING


def test_a_gyro_that_repeats_itself_in_a_turn_is_a_fault(plane):
    found = plane(frozen=lambda t_s: t_s > ONSET_S)["imu_frozen"]
    assert found.status is FAULT
    assert "gyro 1" in found.text


def test_raw_counts_of_other_autopilots_are_not_read_as_si(log):
    flight = log(autopilot=12)
    flight.fly(
        10.0,
        100.0,
        lambda t_s: [
            ("RAW_IMU", {"zacc": -4000, "xgyro": round(100.0 * t_s)}),
            ("ATTITUDE", {}),
            ("SCALED_IMU2", {"zacc": -1000}),
        ],
    )
    found = flight.findings()
    assert found["gyro_pair"].status is found["gyro_bias"].status is NOT_AVAILABLE


def test_a_message_that_carries_a_compass_alone_is_no_third_gyro(log):
    flight = log()
    flight.fly(10.0, 100.0, lambda _: [("RAW_IMU", {"zacc": -1000, "xgyro": 3}), ("SCALED_IMU3", {"xmag": 200})])
    assert flight.findings()["gyro_pair"].status is NOT_AVAILABLE


def test_highres_imu_is_read_with_its_own_units_and_instances(log):
    def imus(t_s):
        drift = 0.05 * (t_s > 70.0)
        return [
            ("HIGHRES_IMU", {"id": 0, "zacc": -9.81, "xgyro": 0.001 + drift}),
            ("HIGHRES_IMU", {"id": 1, "zacc": -9.80, "xgyro": 0.002}),
        ]

    flight = log(autopilot=12)
    flight.fly(10.0, 130.0, imus)
    found = flight.findings()["gyro_pair"]
    assert found.status is FAULT
    assert "by 0.050 rad/s about x" in found.text


def counts(**more):
    names = [axis + kind for kind in ("gyro", "acc", "mag") for axis in "xyz"]
    return dict.fromkeys(names, 0) | {"id": 0} | more


def test_an_inertial_message_is_read_in_si_by_the_sensor_that_it_names():
    found = imu("SCALED_IMU2", counts(zacc=-1000, xgyro=100, ymag=300), ardupilot=False)
    assert found.instance == 1
    assert found.gyro_rad_s == pytest.approx((0.1, 0.0, 0.0))
    assert found.acceleration_m_s2 == pytest.approx((0.0, 0.0, -9.80665))
    assert found.field_mg == (0.0, 300.0, 0.0)
    told = imu("HIGHRES_IMU", counts(id=2, zacc=-9.8, xmag=0.25), ardupilot=False)
    assert (told.instance, told.acceleration_m_s2, told.field_mg) == (2, (0.0, 0.0, -9.8), (250.0, 0.0, 0.0))


def test_a_message_without_an_accelerometer_holds_a_compass_alone_or_nothing():
    found = imu("SCALED_IMU3", counts(xmag=200, xgyro=5), ardupilot=True)
    assert (found.gyro_rad_s, found.acceleration_m_s2, found.field_mg) == (None, None, (200.0, 0.0, 0.0))
    assert imu("SCALED_IMU3", counts(), ardupilot=True).field_mg is None


def test_raw_counts_are_believed_of_ardupilot_alone():
    assert imu("RAW_IMU", counts(zacc=-1000), ardupilot=False) is None
    assert imu("RAW_IMU", counts(zacc=-1000), ardupilot=True).instance == 0
