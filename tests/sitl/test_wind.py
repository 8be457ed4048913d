import math

import numpy as np
import pytest

from sitl import wind


def profile(**columns):
    values = np.zeros(wind.PROFILE)
    values[wind.SHEAR_LENGTH] = 1000.0
    for name, value in columns.items():
        values[getattr(wind, name)] = value
    return values


@pytest.mark.parametrize(
    ("height_m", "length_m", "sigma_m_s"),
    [
        (100.0, 262.7941, 0.6899886),  # low-altitude law
        (450.0, 413.4787, 0.7377049),  # between
        (610.0, 533.4, 1.0),
        (3000.0, 533.4, 1.0),
    ],
)
def test_length_and_intensity_follow_mil_f_8785c(height_m, length_m, sigma_m_s):
    length, sigma, _ = wind.turbulence(height_m, 5.0, 1.0)
    assert length == pytest.approx(length_m, rel=1e-6)
    assert sigma == pytest.approx(sigma_m_s, rel=1e-6)


def test_below_ten_metres_turbulence_is_that_of_ten_metres():
    assert wind.turbulence(1.0, 5.0, 1.0) == wind.turbulence(10.0, 5.0, 1.0)


def test_vertical_intensity_near_the_ground_is_a_tenth_of_the_wind_but_no_more_than_aloft():
    assert wind.turbulence(50.0, 5.0, 1.0)[2] == 0.5
    assert wind.turbulence(50.0, 5.0, 0.3)[2] == 0.3


def test_wind_grows_with_height_and_veers():
    straight = profile(SPEED_10M=4.0, DIRECTION=0.0, VEER=0.1)
    assert wind.profile_wind(straight, 10.0) == pytest.approx((4.0 * math.cos(0.001), 4.0 * math.sin(0.001)))
    north, east = wind.profile_wind(straight, 1000.0)
    assert math.hypot(north, east) == pytest.approx(4.0 * 100.0**0.15)
    assert math.atan2(east, north) == pytest.approx(0.1)
    assert math.hypot(*wind.profile_wind(straight, 0.0)) == pytest.approx(4.0)


def test_shear_wave_lies_across_the_wind_clockwise_where_positive():
    wavy = profile(SPEED_10M=3.0, DIRECTION=0.5 * math.pi, SHEAR=2.0, SHEAR_PHASE=0.5 * math.pi)  # blows to the east
    north, east = wind.mean_wind(wavy, 10_000.0)
    plain_north, plain_east = wind.profile_wind(wavy, 10_000.0)
    assert north - plain_north == pytest.approx(-2.0)  # to the right of east is south
    assert east == pytest.approx(plain_east)


def transverse_step_by_numpy(first, second, normal, length_m, airspeed_m_s, dt_s):
    decay = np.exp(-dt_s * airspeed_m_s / length_m)
    return decay * first + np.sqrt(1.0 - decay**2) * normal, decay * second + (1.0 - decay) * first


def test_dryden_filters_agree_with_numpy():
    rng = np.random.default_rng(2)
    gust = rng.standard_normal(wind.GUSTS)
    for _ in range(50):
        normal = rng.standard_normal(3)
        first, second = transverse_step_by_numpy(gust[0:3], gust[3:6], normal, 400.0, 20.0, 0.1)
        wind.transverse_step(gust, normal, 400.0, 20.0, 0.1)
        assert gust[0:3] == pytest.approx(first, rel=1e-12)
        assert gust[3:6] == pytest.approx(second, rel=1e-12)


def test_gusts_have_their_intensity_and_the_spectrum_of_dryden_crosswind():
    rng = np.random.default_rng(3)
    gust = np.zeros(wind.GUSTS)
    length, airspeed, dt, steps = 100.0, 20.0, 0.1, 100_000
    gusts = np.empty((steps, 3))
    for k, normal in enumerate(rng.standard_normal((steps, 3))):
        wind.transverse_step(gust, normal, length, airspeed, dt)
        gusts[k] = [wind.transverse_gust(gust, axis, 1.5) for axis in range(3)]
    assert gusts.std(axis=0) == pytest.approx([1.5] * 3, rel=0.05)
    # autocorrelation of sigma^2 T/pi (1 + 3 (T w)^2)/(1 + (T w)^2)^2 is exp(-x)(1 - x/2), x = lag/T
    for seconds in (2.5, 5.0, 10.0):
        lag = round(seconds / dt)
        x = seconds * airspeed / length
        measured = np.mean(gusts[lag:] * gusts[:-lag]) / gusts.var()
        assert measured == pytest.approx(math.exp(-x) * (1.0 - x / 2.0), abs=0.06)


def test_roll_gust_has_the_variance_of_its_spectrum():
    sigma_w, length, span, airspeed = 1.3, 533.4, 15.24, 20.0
    omega = np.linspace(0.0, 400.0, 2_000_001)
    shape = 0.8 * (math.pi * length / (4 * span)) ** (1 / 3)
    spectrum = sigma_w**2 / (airspeed * length) * shape / (1.0 + (4 * span * omega / (math.pi * airspeed)) ** 2)
    variance = np.trapezoid(spectrum, omega)
    assert wind.roll_gust_sigma(sigma_w, length, span) ** 2 == pytest.approx(variance, rel=0.005)

    gust = np.zeros(wind.GUSTS)
    rolls = [
        wind.roll_gust_step(gust, 0.1, span, airspeed, 0.1, n) for n in np.random.default_rng(4).standard_normal(50_000)
    ]
    assert np.std(rolls) == pytest.approx(0.1, rel=0.05)


def test_turning_in_a_steady_crosswind_makes_no_yaw_gust():
    gust = np.zeros(wind.GUSTS)
    gust[wind.LOW_NORTH], gust[wind.LOW_EAST] = 3.0, -2.0
    for k in range(100):
        assert wind.yaw_gust_step(gust, 3.0, -2.0, 0.1 * k, 15.24, 20.0, 0.1) == 0.0


def test_a_crosswind_that_begins_yaws_the_vehicle_for_a_moment_to_the_side_it_goes():
    gust = np.zeros(wind.GUSTS)
    rates = [wind.yaw_gust_step(gust, 0.0, 1.0, 0.0, 15.24, 20.0, 0.01) for _ in range(500)]
    assert rates[0] == pytest.approx(math.pi / (3 * 15.24), rel=0.02)  # step response of (s/V)/(1 + 3 b s/(pi V)) at once
    assert rates[-1] < 0.01 * rates[0]
