import hashlib
import math
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from sitl.parafoil import CHANNELS, VEHICLE, Config, Fleet
from sitl.vehicle import Injected
from sitl.wire import field_type

CROSSED = Injected("crossed_lines", 5.0)
WIND_FREE = {"speed_10m_m_s": (0.0, 0.0), "shear_m_s": (0.0, 0.0), "forecast_error_m_s": 0.0, "turbulence_m_s": (0.0, 0.0)}


def channel(values, name):
    return values[:, CHANNELS.index(name)]


def fly(fleet, seconds, dt_s=0.1):
    for _ in range(round(seconds / dt_s)):
        rows = fleet.step(dt_s)
    return rows


def quiet(config: Config) -> Config:
    """The same vehicle in still air with perfect sensors."""
    names = ("gps_position_m", "gps_velocity_m_s", "gyro_rad_s", "gyro_bias_rad_s", "tilt_offset_rad", "yaw_offset_rad")
    names += ("acceleration_m_s2", "pressure_height_m", "encoder_m", "encoder_resolution_m")
    return replace(
        config, wind=replace(config.wind, **WIND_FREE), sensors=replace(config.sensors, **dict.fromkeys(names, 0.0))
    )


def test_a_flight_alone_and_in_a_batch_are_the_same_to_the_bit(parafoil_config):
    seeds = list(range(40, 240))
    faults = [None if seed % 3 else CROSSED for seed in seeds]
    batch = Fleet(parafoil_config, seeds, faults)
    reversed_batch = Fleet(parafoil_config, seeds[::-1], faults[::-1])
    chosen = (0, 2, 77, 199)
    alone = [Fleet(parafoil_config, [seeds[f]], [faults[f]]) for f in chosen]
    for _ in range(250):
        values, _ = batch.step(0.1)
        assert np.array_equal(reversed_batch.step(0.1)[0][::-1], values)
        for f, single in zip(chosen, alone, strict=True):
            assert np.array_equal(single.step(0.1)[0][0], values[f])


def test_a_fault_changes_nothing_before_it_acts(parafoil_config):
    kinds = ["motor:left/stuck", "motor:right/saturation", "broken_line:left", "crossed_lines"]
    healthy = Fleet(parafoil_config, [9] * 4)
    faulty = Fleet(parafoil_config, [9] * 4, [Injected(kind, 30.0, 0.9 if "stuck" in kind else None) for kind in kinds])
    for _ in range(300):
        assert np.array_equal(healthy.step(0.1)[0], faulty.step(0.1)[0])
    assert not np.array_equal(fly(healthy, 30.0)[0], fly(faulty, 30.0)[0])


UNCOMPILED = """
import hashlib, tomllib, msgspec
from importlib.resources import files
from sitl.parafoil import Config, Fleet
from sitl.vehicle import Injected
table = tomllib.loads(files("configs").joinpath("parafoil.toml").read_text())
fleet = Fleet(msgspec.convert(table["sitl"], Config), [3, 4], [None, Injected("crossed_lines", 1.0)])
digest = hashlib.sha256()
for _ in range(40):
    digest.update(fleet.step(0.1)[0].tobytes())
print(digest.hexdigest())
"""


def test_plain_python_without_the_compiler_flies_the_same_bits_and_leaves_no_array(parafoil_config):
    """Compiled code checks no bounds; the same code as plain Python does."""
    plain = subprocess.run(
        [sys.executable, "-W", "error", "-c", UNCOMPILED],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        check=True,
    )
    fleet = Fleet(parafoil_config, [3, 4], [None, Injected("crossed_lines", 1.0)])
    digest = hashlib.sha256()
    for _ in range(40):
        digest.update(fleet.step(0.1)[0].tobytes())
    assert plain.stdout.strip() == digest.hexdigest()


def test_guidance_brings_healthy_flights_to_the_target(parafoil_config):
    fleet = Fleet(parafoil_config, range(1000, 1040))
    for _ in range(11_000):
        fleet.step(0.1)
        if fleet.landed.all():
            break
    assert fleet.landed.all()
    miss = fleet.truth("miss_m")
    assert 10.0 < np.median(miss) < 60.0
    assert np.percentile(miss, 90) < 400.0
    assert 500.0 < np.median(fleet.truth("flight_s")) < 900.0

    before = [fleet.truth(name) for name in ("north_m", "east_m", "height_m", "flight_s")]
    values, _ = fly(fleet, 5.0)
    assert np.array_equal(before, [fleet.truth(name) for name in ("north_m", "east_m", "height_m", "flight_s")])
    assert (channel(values, "landed") == 1.0).all()
    assert channel(values, "ground_speed_m_s") == pytest.approx(0.0, abs=0.6)
    assert channel(values, "acceleration_z_m_s2") == pytest.approx(-9.80665, abs=0.3)


def tracking_rms(fleet, seconds):
    errors = []
    for _ in range(round(seconds / 0.1)):
        fleet.step(0.1)
        errors.append(fleet.truth("turn_rate_command_rad_s") - fleet.truth("yaw_rate_rad_s"))
    return np.sqrt(np.mean(np.square(errors), axis=0))


def swap(fleet, flights):
    for f in range(flights):
        fleet.command(f, "SERVO1_FUNCTION", 78)
        fleet.command(f, "SERVO2_FUNCTION", 77)


def test_swapping_the_outputs_mends_crossed_lines_and_harms_sound_ones(parafoil_config):
    seeds = range(500, 530)
    fleet = Fleet(parafoil_config, seeds, [Injected("crossed_lines", 60.0)] * 30)
    sound = Fleet(parafoil_config, seeds)
    fly(fleet, 10.0)
    fly(sound, 10.0)
    before = np.median(tracking_rms(fleet, 50.0))
    tracking_rms(sound, 50.0)
    during = np.median(tracking_rms(fleet, 10.0))
    tracking_rms(sound, 10.0)
    swap(fleet, 30)
    swap(sound, 30)
    fly(fleet, 5.0)
    fly(sound, 5.0)
    after = np.median(tracking_rms(fleet, 60.0))
    harmed = np.median(tracking_rms(sound, 60.0))
    assert before < 0.11
    assert during > 0.25
    assert after < 0.11
    assert harmed > 0.25


def test_a_needless_swap_undone_leaves_a_sound_vehicle(parafoil_config):
    fleet = Fleet(parafoil_config, range(500, 520))
    fly(fleet, 30.0)
    swap(fleet, 20)
    fly(fleet, 3.0)
    for f in range(20):
        fleet.command(f, "SERVO1_FUNCTION", 77)
        fleet.command(f, "SERVO2_FUNCTION", 78)
    fly(fleet, 5.0)
    assert np.median(tracking_rms(fleet, 60.0)) < 0.11


def test_outputs_follow_their_function(parafoil_config):
    fleet = Fleet(parafoil_config, range(20))
    values, _ = fly(fleet, 20.0)
    straight = [channel(values, "output_1_us"), channel(values, "output_2_us")]
    assert max(straight[0].max(), straight[1].max()) > 1300.0
    other = Fleet(parafoil_config, range(20))
    fly(other, 19.9)
    swap(other, 20)  # the same commands, followed by the other output at the next step
    values, _ = other.step(0.1)
    assert np.array_equal(channel(values, "output_2_us"), straight[0])
    assert np.array_equal(channel(values, "output_1_us"), straight[1])
    for f in range(20):
        other.command(f, "SERVO1_FUNCTION", 0)
        other.command(f, "SERVO2_FUNCTION", 78)
    values, _ = other.step(0.1)
    assert (channel(values, "output_1_us") == 1000.0).all()
    for f in range(20):
        other.command(f, "SERVO1_FUNCTION", 78)
    values, _ = other.step(0.1)
    assert np.array_equal(channel(values, "output_1_us"), channel(values, "output_2_us"))


def test_a_stuck_motor_runs_to_its_value_and_stays_while_the_command_goes_on(parafoil_config):
    fleet = Fleet(parafoil_config, [21], [Injected("motor:left/stuck", 20.0, 0.9)])
    fly(fleet, 20.0)
    position = fleet.truth("motor_1_m")[0]
    steps = []
    for _ in range(30):
        fleet.step(0.1)
        steps.append(fleet.truth("motor_1_m")[0] - position)
        position = fleet.truth("motor_1_m")[0]
    full = [step for step in steps if step > 0.0][:-1]
    assert np.ptp(full) < 1e-12  # at its rate, no lag
    assert 0.07 * 0.65 <= full[0] <= 0.07 * 1.35
    assert position == pytest.approx(0.9)
    commands, encoders = [], []
    for _ in range(400):
        values, _ = fleet.step(0.1)
        commands.append(channel(values, "output_1_us")[0])
        encoders.append(channel(values, "wheel_distance_1_m")[0])
    assert np.ptp(commands) > 300.0
    assert np.ptp(encoders) < 0.02


def test_a_motor_may_stick_where_it_is(parafoil_config):
    fleet = Fleet(parafoil_config, range(10))
    fly(fleet, 30.0)
    for f in range(10):
        fleet.command(f, "INJECT_SERVO_STUCK", 1)
        fleet.command(f, "INJECT_SERVO_STUCK", 2)
    held = fleet.truth("motor_1_m"), fleet.truth("motor_2_m")
    fly(fleet, 20.0)
    assert np.array_equal(held, (fleet.truth("motor_1_m"), fleet.truth("motor_2_m")))
    for f in range(10):
        fleet.command(f, "INJECT_SERVO_OK", 0)
        assert fleet.injected(f) == ()
    fly(fleet, 5.0)
    assert not np.array_equal(held, (fleet.truth("motor_1_m"), fleet.truth("motor_2_m")))


def test_a_saturated_motor_stops_at_its_limit(parafoil_config):
    fleet = Fleet(parafoil_config, range(20), [Injected("motor:right/saturation", 0.0, 0.4)] * 20)
    free = Fleet(parafoil_config, range(20))
    highest, free_highest = np.zeros(20), np.zeros(20)
    for _ in range(600):
        fleet.step(0.1)
        free.step(0.1)
        highest = np.maximum(highest, fleet.truth("motor_2_m"))
        free_highest = np.maximum(free_highest, free.truth("motor_2_m"))
    assert highest.max() <= 0.4
    assert np.median(free_highest) > 0.5


def test_a_broken_line_leaves_motor_and_encoder_going(parafoil_config):
    fleet = Fleet(parafoil_config, range(20), [Injected("broken_line:left", 0.0)] * 20)
    pulled, reeled, right = np.zeros(20), np.zeros(20), np.zeros(20)
    for _ in range(600):
        values, _ = fleet.step(0.1)
        pulled = np.maximum(pulled, fleet.truth("line_left_m"))
        right = np.maximum(right, fleet.truth("line_right_m"))
        reeled = np.maximum(reeled, channel(values, "wheel_distance_1_m"))
    assert pulled.max() == 0.0
    assert np.median(reeled) > 0.3
    assert np.median(right) > 0.3


def test_crossed_lines_pull_the_other_edge(parafoil_config):
    fleet = Fleet(parafoil_config, range(20), [Injected("crossed_lines", 0.0)] * 20)
    before = fleet.truth("motor_1_m"), fleet.truth("motor_2_m")
    for _ in range(200):
        fleet.step(0.1)
        motors = fleet.truth("motor_1_m"), fleet.truth("motor_2_m")
        assert fleet.truth("line_left_m") == pytest.approx(0.5 * (before[1] + motors[1]))
        assert fleet.truth("line_right_m") == pytest.approx(0.5 * (before[0] + motors[0]))
        before = motors


def test_slack_is_taken_up_before_the_edge_moves(parafoil_config):
    fleet = Fleet(parafoil_config, [1])
    fleet.command(0, "SIM_FLT_SLACK", 0.2)
    before = 0.0
    for _ in range(300):
        fleet.step(0.1)
        motor = fleet.truth("motor_1_m")[0]
        assert fleet.truth("line_left_m")[0] == pytest.approx(max(0.5 * (before + motor) - 0.2, 0.0))
        before = motor


def test_a_fault_may_go_away_again(parafoil_config):
    fleet = Fleet(parafoil_config, [2], [Injected("motor:left/stuck", 10.0, 1.4, clear_s=20.0)])
    fly(fleet, 19.9)
    assert fleet.truth("motor_1_m")[0] == pytest.approx(1.4)
    fly(fleet, 5.0)
    assert fleet.truth("motor_1_m")[0] < 1.4


def test_what_a_fault_leaves_open_is_drawn_with_the_flights_own_seed(parafoil_config):
    seeds = range(400)
    fleet = Fleet(parafoil_config, seeds, [Injected("motor", 7.0)] * 400)
    drawn = [fleet.injected(f)[0] for f in range(400)]
    assert 160 < sum("left" in fault.id for fault in drawn) < 240
    stuck = [fault.value for fault in drawn if fault.id.endswith("/stuck")]
    limits = [fault.value for fault in drawn if fault.id.endswith("/saturation")]
    assert 160 < len(stuck) < 240
    assert len(stuck) + len(limits) == 400
    assert 0.0 <= min(stuck) < 0.1 < 1.3 < max(stuck) <= 1.4
    assert 0.30 <= min(limits) < 0.33 < 0.62 < max(limits) <= 0.65
    again = Fleet(parafoil_config, [seeds[123]], [Injected("motor", 7.0)])
    assert again.injected(0) == (drawn[123],)
    half_open = Fleet(parafoil_config, [5], [Injected("motor/saturation", 7.0)]).injected(0)[0]
    assert half_open.id.startswith("motor:")
    assert half_open.id.endswith("/saturation")
    assert Fleet(parafoil_config, [5], [CROSSED]).injected(0) == (CROSSED,)
    assert Fleet(parafoil_config, [5], [Injected("broken_line:right", 1.0, clear_s=9.0)]).injected(0) == (
        Injected("broken_line:right", 1.0, None, 9.0),
    )


@pytest.mark.parametrize(
    ("kind", "side", "expected"),
    [
        (1, 0, Injected("motor:left/stuck", 30.0, 0.7, 60.0)),
        (2, 1, Injected("motor:right/saturation", 30.0, 0.7, 60.0)),
        (3, 1, Injected("broken_line:right", 30.0, None, 60.0)),
        (4, 0, Injected("crossed_lines", 30.0, None, 60.0)),
    ],
)
def test_parameters_arm_a_fault_when_its_type_is_set(parafoil_config, kind, side, expected):
    fleet = Fleet(parafoil_config, [1, 2])
    for name, value in [("SIDE", side), ("VALUE", 0.7), ("TIME", 30.0), ("CLEAR", 60.0)]:
        fleet.command(1, f"SIM_FLT_{name}", value)
    assert fleet.injected(1) == ()
    fleet.command(1, "SIM_FLT_TYPE", kind)
    assert fleet.injected(1) == (expected,)
    assert fleet.injected(0) == ()
    fleet.command(1, "SIM_FLT_TYPE", 0)
    assert fleet.injected(1) == ()


def test_a_negative_fault_time_is_now_and_two_motors_may_fail(parafoil_config):
    fleet = Fleet(parafoil_config, [1], [Injected("motor:left/stuck", 5.0, 0.3)])
    fly(fleet, 12.3)
    fleet.command(0, "SIM_FLT_SIDE", 1)
    fleet.command(0, "SIM_FLT_TYPE", 2)
    assert fleet.injected(0) == (Injected("motor:left/stuck", 5.0, 0.3), Injected("motor:right/saturation", 12.3, 0.5))
    fly(fleet, 10.0)
    assert fleet.truth("motor_1_m")[0] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        (Injected("wing", 1.0), "unknown fault"),
        (Injected("motor:left/melted", 1.0), "unknown fault"),
        (Injected("crossed_lines/stuck", 1.0), "unknown fault"),
        (Injected("motor:left/stuck", 1.0, 2.0), "up to 1.4 m"),
        (Injected("broken_line:left", 1.0, 0.5), "cannot have the value"),
        (Injected("crossed_lines", -1.0), "begins at"),
        (Injected("crossed_lines", 5.0, None, 4.0), "before it begins"),
    ],
)
def test_faults_that_cannot_be_are_refused(parafoil_config, fault, sentence):
    with pytest.raises(ValueError, match=sentence):
        Fleet(parafoil_config, [1], [fault])


def test_wrong_numbers_and_names_are_refused(parafoil_config):
    with pytest.raises(ValueError, match="one for each"):
        Fleet(parafoil_config, [1, 2], [None])
    fleet = Fleet(parafoil_config, [1])
    with pytest.raises(KeyError):
        fleet.command(0, "SIM_WIND_SPD", 1.0)
    with pytest.raises(KeyError):
        fleet.truth("mood")
    with pytest.raises(ValueError, match="SIM_FLT_TYPE"):
        fleet.command(0, "SIM_FLT_TYPE", 5)
    with pytest.raises(ValueError, match="servo 3"):
        fleet.command(0, "INJECT_SERVO_STUCK", 3)
    with pytest.raises(ValueError, match="no step"):
        fleet.step(0.05)
    fleet.step(0.02)
    with pytest.raises(ValueError, match=r"0\.02"):
        fleet.step(0.1)


def test_sensors_sample_when_they_should(parafoil_config):
    fleet = Fleet(parafoil_config, [1])
    fast, slow = CHANNELS.index("yaw_rate_rad_s"), CHANNELS.index("velocity_north_m_s")
    values, age_s = fleet.observe()
    assert age_s[0, slow] == 0.0
    assert np.isfinite(values).all()
    for k in range(1, 21):
        before = values
        values, age_s = fleet.step(0.1)
        assert values[0, fast] != before[0, fast]
        assert age_s[0, fast] == 0.0
        fresh = k % 2 == 0
        assert (values[0, slow] != before[0, slow]) == fresh
        assert age_s[0, slow] == pytest.approx(0.0 if fresh else 0.1)
    assert np.array_equal(fleet.observe()[0], values)


def test_small_steps_sample_gyro_and_encoders_each_and_gps_as_ever(parafoil_config):
    fleet = Fleet(parafoil_config, [1])
    values = [fleet.step(0.02)[0][0] for _ in range(100)]
    changes = np.count_nonzero(np.diff(values, axis=0), axis=0)
    assert changes[CHANNELS.index("yaw_rate_rad_s")] == 99
    assert changes[CHANNELS.index("velocity_north_m_s")] == 10
    _, age_s = fleet.step(0.02)
    assert age_s[0, CHANNELS.index("velocity_north_m_s")] == pytest.approx(0.02)


def test_small_and_stock_steps_fly_the_same_way_in_still_air(parafoil_config):
    config = quiet(parafoil_config)
    coarse, fine = Fleet(config, [1, 2, 3]), Fleet(config, [1, 2, 3])
    fly(coarse, 60.0)
    fly(fine, 60.0, dt_s=0.02)
    for name, tolerance in [("north_m", 3.0), ("east_m", 3.0), ("height_m", 1.0), ("yaw_rate_rad_s", 0.02)]:
        assert fine.truth(name) == pytest.approx(coarse.truth(name), abs=tolerance)


def test_perfect_sensors_tell_the_truth(parafoil_config):
    fleet = Fleet(quiet(parafoil_config), range(5))
    before = None
    for k in range(300):
        values, _ = fleet.step(0.1)
        assert channel(values, "wheel_distance_1_m") == pytest.approx(fleet.truth("motor_1_m"))
        turning = channel(values, "pitch_rate_rad_s") * np.sin(channel(values, "roll_rad"))
        turning += channel(values, "yaw_rate_rad_s") * np.cos(channel(values, "roll_rad"))
        assert turning / np.cos(channel(values, "pitch_rad")) == pytest.approx(fleet.truth("yaw_rate_rad_s"))
        if k % 2 == 0:
            continue
        north, east, height = (fleet.truth(name) for name in ("north_m", "east_m", "height_m"))
        home = parafoil_config.home
        latitude = np.degrees(channel(values, "latitude_rad")) - home.latitude_deg
        longitude = np.degrees(channel(values, "longitude_rad")) - home.longitude_deg
        assert latitude == pytest.approx(np.degrees(north / 6378137.0), abs=1e-9)
        scale = 6378137.0 * math.cos(math.radians(home.latitude_deg))
        assert longitude == pytest.approx(np.degrees(east / scale), abs=1e-9)
        assert channel(values, "height_m") == pytest.approx(height)
        assert channel(values, "altitude_m") == pytest.approx(height + home.altitude_m)
        assert channel(values, "pressure_altitude_m") == pytest.approx(height + home.altitude_m)
        velocity = np.array([channel(values, f"velocity_{axis}_m_s") for axis in ("north", "east", "down")])
        if before is not None:
            moved = np.array([north, east, -height]) - before[0]
            assert moved == pytest.approx(0.1 * (velocity + before[1]), abs=0.02)  # trapezoid over 0.2 s
        before = np.array([north, east, -height]), velocity
        assert channel(values, "ground_speed_m_s") == pytest.approx(np.hypot(velocity[0], velocity[1]))
        assert ((channel(values, "course_rad") >= 0.0) & (channel(values, "course_rad") < 2 * math.pi)).all()


def test_the_accelerometer_turned_to_ned_and_freed_of_gravity_sums_up_to_the_velocity(parafoil_config):
    fleet = Fleet(quiet(parafoil_config), range(5))
    fly(fleet, 9.9)
    axes = ("north", "east", "down")
    before = None
    for k in range(300):
        values, _ = fleet.step(0.1)
        phi, theta, psi = (channel(values, f"{angle}_rad") for angle in ("roll", "pitch", "yaw"))
        x, y, z = (channel(values, f"acceleration_{axis}_m_s2") for axis in "xyz")
        across = y * np.cos(phi) - z * np.sin(phi)
        lower = y * np.sin(phi) + z * np.cos(phi)
        level, down = x * np.cos(theta) + lower * np.sin(theta), -x * np.sin(theta) + lower * np.cos(theta)
        north, east = level * np.cos(psi) - across * np.sin(psi), level * np.sin(psi) + across * np.cos(psi)
        acceleration = np.array([north, east, down + 9.80665])
        if before is None:  # at a fix
            velocity, before = np.array([channel(values, f"velocity_{axis}_m_s") for axis in axes]), acceleration
            continue
        velocity += 0.05 * (before + acceleration)
        before = acceleration
        if k % 2 == 0:
            assert velocity == pytest.approx(np.array([channel(values, f"velocity_{axis}_m_s") for axis in axes]), abs=0.2)


def test_errors_of_sensors_have_their_size(parafoil_config):
    fleet = Fleet(parafoil_config, range(300))
    fly(fleet, 10.0)
    values, _ = fly(fleet, 0.2)
    sensors = parafoil_config.sensors
    encoder = channel(values, "wheel_distance_1_m") - fleet.truth("motor_1_m")
    assert encoder.std() == pytest.approx(math.hypot(sensors.encoder_m, 0.001 / math.sqrt(12)), rel=0.15)
    assert (channel(values, "wheel_distance_1_m") * 1000).round(6) == pytest.approx(
        np.rint(channel(values, "wheel_distance_1_m") * 1000), abs=1e-6
    )
    height = channel(values, "pressure_altitude_m") - fleet.truth("height_m")
    assert height.std() == pytest.approx(1.0, rel=0.15)
    north = (channel(values, "latitude_rad") - math.radians(parafoil_config.home.latitude_deg)) * 6378137.0
    assert (north - fleet.truth("north_m")).std() == pytest.approx(sensors.gps_position_m, rel=0.15)
    roll = channel(values, "roll_rad") - fleet.truth("roll_rad")
    assert roll.std() == pytest.approx(sensors.tilt_offset_rad, rel=0.15)


def test_gps_noise_grows_by_its_factor(parafoil_config):
    plain, noisy = Fleet(parafoil_config, range(200)), Fleet(parafoil_config, range(200))
    for f in range(200):
        noisy.command(f, "SIM_GPS_NOISE", 3.0)
    speed, noisy_speed = (channel(fly(fleet, 0.2)[0], "velocity_down_m_s") for fleet in (plain, noisy))
    assert np.std(noisy_speed - speed) == pytest.approx(2 * parafoil_config.sensors.gps_velocity_m_s, rel=0.15)


def test_wind_told_is_the_forecast_until_the_filter_runs_and_comes_from_where_it_blows(parafoil_config):
    windy = replace(
        parafoil_config, wind=replace(parafoil_config.wind, speed_10m_m_s=(6.0, 6.0), veer_rad_km=0.0, shear_m_s=(0.0, 0.0))
    )
    fleet = Fleet(windy, range(60))
    first, _ = fleet.step(0.1)
    assert np.array_equal(channel(first, "wind_speed_m_s"), channel(fleet.observe()[0], "wind_speed_m_s"))
    fix, _ = fleet.step(0.1)
    assert channel(fix, "wind_speed_m_s") == pytest.approx(channel(first, "wind_speed_m_s"), abs=0.05)
    values, _ = fly(fleet, 100.0)
    speed, direction = channel(values, "wind_speed_m_s"), channel(values, "wind_direction_rad")
    assert np.median(speed) == pytest.approx(6.0 * (3900.0 / 10.0) ** 0.15, rel=0.2)
    assert ((direction >= 0.0) & (direction < 2 * math.pi)).all()
    # a vehicle drifts away from where the wind comes from, compared with its heading
    drift = np.array([channel(values, "velocity_north_m_s"), channel(values, "velocity_east_m_s")])
    drift -= channel(values, "airspeed_m_s") * np.array(
        [np.cos(channel(values, "yaw_rad")), np.sin(channel(values, "yaw_rad"))]
    )
    from_wind = np.array([np.cos(direction), np.sin(direction)])
    assert np.median(np.sum(drift * from_wind, axis=0)) < -8.0


def test_without_gps_its_channels_are_unknown_and_the_flight_goes_on(parafoil_config):
    fleet = Fleet(parafoil_config, range(20))
    fly(fleet, 100.0)
    for f in range(20):
        fleet.command(f, "SIM_GPS_DISABLE", 1)
    values, _ = fly(fleet, 30.0)
    unknown = {name for name in CHANNELS if np.isnan(channel(values, name)).all()}
    assert unknown == {
        *("velocity_north_m_s", "velocity_east_m_s", "velocity_down_m_s", "latitude_rad", "longitude_rad"),
        *("altitude_m", "height_m", "course_rad", "ground_speed_m_s", "climb_rate_m_s"),
    }
    assert np.isfinite(values[:, [name not in unknown for name in CHANNELS]]).all()
    assert (channel(values, "output_1_us") == 1000.0).all()  # toggles up, straight on
    for f in range(20):
        fleet.command(f, "SIM_GPS_DISABLE", 0)
    values, _ = fly(fleet, 0.2)
    assert np.isfinite(values).all()
    while not fleet.landed.all():
        fleet.step(0.1)
    assert np.median(fleet.truth("miss_m")) < 150.0


def test_commands_stay_for_a_second_without_gps(parafoil_config):
    fleet = Fleet(parafoil_config, range(20))
    fly(fleet, 20.0)
    for f in range(20):
        fleet.command(f, "SIM_GPS_DISABLE", 1)
    held, _ = fleet.step(0.1)
    assert np.array_equal(channel(fly(fleet, 0.9)[0], "output_2_us"), channel(held, "output_2_us"))
    assert (channel(fly(fleet, 0.5)[0], "output_2_us") == 1000.0).all()


def test_swapping_functions_clears_what_the_guidance_had_learnt(parafoil_config):
    fleet, other = Fleet(parafoil_config, [8]), Fleet(parafoil_config, [8])
    fly(fleet, 60.2)
    fly(other, 60.2)
    fleet.command(0, "SERVO1_FUNCTION", 77)  # no change, but a fresh start
    outputs = [channel(fly(each, 0.3)[0], f"output_{n}_us")[0] for each in (fleet, other) for n in (1, 2)]
    assert outputs[:2] != outputs[2:]


def test_recovery_orders_help_a_broken_line(parafoil_config):
    faults = [Injected("broken_line:left", 30.0)] * 30
    alone, helped = Fleet(parafoil_config, range(30), faults), Fleet(parafoil_config, range(30), faults)
    fly(alone, 45.0)
    fly(helped, 45.0)
    for f in range(30):
        helped.command(f, "PF_TURN_DIR", 1)
    for fleet in (alone, helped):
        while not fleet.landed.all():
            fleet.step(0.1)
    assert np.median(helped.truth("miss_m")) < 0.6 * np.median(alone.truth("miss_m"))


def test_a_higher_home_is_thinner_air(parafoil_config):
    high = replace(parafoil_config, home=replace(parafoil_config.home, altitude_m=2000.0))
    low_fleet, high_fleet = Fleet(parafoil_config, range(10)), Fleet(high, range(10))
    fly(low_fleet, 60.0)
    values, _ = fly(high_fleet, 60.0)
    assert (high_fleet.truth("height_m") < low_fleet.truth("height_m")).mean() > 0.8  # sinks faster
    assert channel(values, "altitude_m") == pytest.approx(channel(values, "height_m") + 2000.0)


@pytest.mark.parametrize(
    ("table", "changes", "sentence"),
    [
        ("home", {"latitude_deg": 90.0}, "latitude_deg"),
        ("home", {"altitude_m": math.nan}, "altitude_m"),
        ("release", {"height_m": (4900.0, 4000.0)}, "height_m"),
        ("release", {"distance_fraction": (0.0, 1.5)}, "distance_fraction"),
        ("wind", {"turbulence_m_s": (-1.0, 1.0)}, "turbulence_m_s"),
        ("wind", {"shear_length_m": (0.0, 1.0)}, "shear_length_m"),
        ("vehicles", {"payload_factor": (0.0, 1.0)}, "payload_factor"),
        ("sensors", {"gyro_rad_s": -0.1}, "gyro_rad_s"),
        ("sensors", {"gps_position_time_s": 0.0}, "gps_position_time_s"),
        ("guidance", {"final_leg_s": 90.0}, "final_leg_s"),
        ("faults", {"stuck_m": (0.0, 2.0)}, "stuck_m"),
    ],
)
def test_nonsense_in_the_configuration_is_refused_by_name(parafoil_config, table, changes, sentence):
    with pytest.raises(ValueError, match=sentence):
        replace(getattr(parafoil_config, table), **changes)


def test_nonsense_spread_is_refused(parafoil_config):
    with pytest.raises(ValueError, match="sd"):
        replace(parafoil_config.vehicles.drag_factor, sd=-1.0)
    with pytest.raises(ValueError, match="lowest"):
        replace(parafoil_config.vehicles.drag_factor, lowest=2.0)
    with pytest.raises(ValueError, match="drag_factor"):
        replace(parafoil_config.vehicles, drag_factor=replace(parafoil_config.vehicles.drag_factor, lowest=0.0))


def test_tables_agree_with_the_fleet_and_with_mavlink(parafoil_config):
    fleet = Fleet(parafoil_config, [1])
    assert fleet.channels == CHANNELS
    assert len(set(CHANNELS)) == len(CHANNELS)
    for stream in VEHICLE.streams:
        assert 0.0 < stream.stock_hz <= stream.fast_hz
        for field in stream.fields:
            assert field.channel in CHANNELS
            field_type(stream.message, field.name)
        for name in stream.constants:
            field_type(stream.message, name)
    for parameter in VEHICLE.parameters:
        assert len(parameter.name) <= 16
        assert parameter.minimum <= parameter.default <= parameter.maximum
        if parameter.acts:
            fleet.command(0, parameter.name, parameter.default)
    assert fleet.injected(0) == ()
    for injection in VEHICLE.injections:
        for instance in range(injection.instances + 1):
            fleet.command(0, injection.command, instance)
    for fault_id in VEHICLE.fault_ids:
        assert Fleet(parafoil_config, [1], [Injected(fault_id, 0.0)]).injected(0)[0].id.startswith(fault_id)


def test_fleets_of_defaults_and_of_parameters_set_to_their_defaults_fly_the_same(parafoil_config):
    plain, told = Fleet(parafoil_config, [4]), Fleet(parafoil_config, [4])
    for parameter in VEHICLE.parameters:
        if parameter.acts:
            told.command(0, parameter.name, parameter.default)
    assert np.array_equal(fly(plain, 60.0)[0], fly(told, 60.0)[0])
