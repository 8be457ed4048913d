import math

import numpy as np
import pytest

from sitl import wind
from sitl.parafoil import guidance as g

LIMITS = np.array([0.29, 1.40, 1.0, 50.0, 15.0, 1.0, 0.35])


def calm(error_north=0.0, error_east=0.0, **columns):
    profile = np.zeros(wind.PROFILE)
    profile[wind.SHEAR_LENGTH] = 1000.0
    for name, value in columns.items():
        profile[getattr(wind, name)] = value
    forecast = np.zeros((g.FORECAST_ROWS, 4))
    g.fill_forecast(forecast, profile, error_north, error_east, 0.0)
    return forecast


def free():
    orders = np.zeros(g.ORDERS)
    orders[[g.LIMIT_LEFT_M, g.LIMIT_RIGHT_M]] = 1.4
    return orders


class Steering:
    """Guidance of one flight, told where it is."""

    def __init__(self, orders=None, forecast=None):
        self.state = np.zeros(g.GUIDANCE)
        g.start_guidance(self.state)
        self.orders = free() if orders is None else orders
        self.forecast = calm() if forecast is None else forecast

    def at(self, north_m, east_m, height_m, heading_rad, heading_rate_rad_s=0.0, wind_m_s=(0.0, 0.0)):
        estimate = np.array([*wind_m_s, 18.99, heading_rad, heading_rate_rad_s])
        g.guide(
            self.state, self.orders, LIMITS, estimate, self.forecast, north_m, east_m, height_m, 0.0, self.state[g.SINK_M_S]
        )
        return self.state

    @property
    def toggles(self):
        return float(self.state[g.LEFT_M]), float(self.state[g.RIGHT_M])


def test_drift_is_the_way_the_wind_carries_on_the_way_down():
    forecast = calm(error_north=2.0, error_east=-1.0)
    heights = np.linspace(0.0, 4000.0, 4001)
    middle = 0.5 * (heights[1:] + heights[:-1])
    seconds = np.sum(1.0 / (5.0 * np.sqrt(1.0 / (1.0 - 2.25577e-5 * middle) ** 4.2559)))
    assert g.forecast_at(forecast, g.DRIFT_NORTH, 4000.0) == pytest.approx(2.0 * seconds, rel=1e-5)
    assert g.forecast_at(forecast, g.DRIFT_EAST, 4000.0) == pytest.approx(-1.0 * seconds, rel=1e-5)


def test_forecast_is_linear_between_its_rows_and_constant_beyond():
    forecast = calm(SPEED_10M=5.0)
    between = 0.5 * (forecast[20, g.FORECAST_NORTH] + forecast[21, g.FORECAST_NORTH])
    assert g.forecast_at(forecast, g.FORECAST_NORTH, 1025.0) == pytest.approx(between)
    assert g.forecast_at(forecast, g.FORECAST_NORTH, 9000.0) == forecast[-1, g.FORECAST_NORTH]


def test_far_out_it_steers_straight_at_the_target():
    steering = Steering()
    state = steering.at(-9000.0, 0.0, 2000.0, 0.0)  # out of reach, target ahead
    assert state[g.WANTED_RAD] == pytest.approx(0.0, abs=1e-12)
    assert steering.toggles == (0.0, 0.0)
    assert state[g.SPARE_HEIGHT_M] < 0.0


def test_a_target_to_the_right_pulls_the_right_toggle_only():
    steering = Steering()
    state = steering.at(0.0, -9000.0, 2000.0, math.pi / 2 - 0.5)
    assert state[g.TURN_COMMAND_RAD_S] == pytest.approx(0.40 * 0.5)
    assert steering.toggles == pytest.approx((0.0, (0.2 + 0.4 * 0.2) / 0.365))


def test_turn_rate_asked_for_is_limited():
    assert Steering().at(0.0, -9000.0, 2000.0, -1.0)[g.TURN_COMMAND_RAD_S] == 0.29


def test_height_to_spare_is_spent_by_legs_to_either_side():
    steering = Steering()
    wanted = [steering.at(-1000.0, 0.0, 2000.0, 0.0)[g.WANTED_RAD] for _ in range(400)]
    assert wanted[0] == pytest.approx(1.40)  # first leg to the right, as far off as it may
    signs = np.sign(wanted)
    legs_s = 0.2 * np.diff(np.flatnonzero(np.diff(signs)))
    assert set(signs) == {-1.0, 1.0}
    assert legs_s == pytest.approx(20.0)  # 0.16 of the time to go is more than 20 s


def test_the_last_leg_begins_into_the_wind():
    steering = Steering(forecast=calm(error_north=4.0))  # blows to the north: come in southward, from the north
    state = steering.at(-9000.0, -9000.0, 2000.0, 0.0, wind_m_s=(4.0, 0.0))
    seconds = 2000.0 / (5.5 * math.sqrt(1.00649 / 1.1117))
    downwind_of_aim = math.atan2(9000.0, 9000.0 - 4.0 * seconds)
    assert 0.0 < downwind_of_aim - state[g.WANTED_RAD] < 0.2  # aims to the north of the target


def test_the_final_once_begun_goes_on():
    steering = Steering()
    assert steering.at(-100.0, 0.0, 2000.0, 0.0)[g.FINAL] == 0.0
    assert steering.at(-300.0, 0.0, 100.0, 0.0)[g.FINAL] == 1.0
    assert steering.at(-10.0, 0.0, 390.0, 0.0)[g.FINAL] == 1.0


def test_near_the_ground_both_toggles_flare():
    steering = Steering()
    steering.at(-200.0, 0.0, 14.9, 0.0)
    assert min(steering.toggles) == 1.0
    steering.at(-200.0, 0.0, 15.1, 0.0)
    assert min(steering.toggles) == 0.0


def test_integral_grows_with_a_lasting_error_up_to_its_limit_and_stops_while_the_toggle_is_at_its_end():
    steering = Steering()
    for _ in range(20_000):
        steering.at(-9000.0, 0.0, 2000.0, 0.0, heading_rate_rad_s=-0.01)
    assert steering.state[g.INTEGRAL_M] == pytest.approx(0.35)
    steering = Steering()
    for _ in range(1000):
        steering.at(-9000.0, 0.0, 2000.0, 0.0, heading_rate_rad_s=-1.5)
    assert steering.toggles == (0.0, 1.4)
    assert steering.state[g.INTEGRAL_M] == 0.0


def mirrored(orders):
    other = orders.copy()
    other[g.TURN_DIRECTION] = -orders[g.TURN_DIRECTION]
    other[g.STUCK_SIDE] = (0.0, g.STUCK_RIGHT, g.STUCK_LEFT)[int(orders[g.STUCK_SIDE])]
    other[[g.LIMIT_LEFT_M, g.LIMIT_RIGHT_M]] = orders[[g.LIMIT_RIGHT_M, g.LIMIT_LEFT_M]]
    return other


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {g.TURN_DIRECTION: 1.0},
        {g.STUCK_SIDE: g.STUCK_LEFT, g.STUCK_VALUE_M: 0.05},
        {g.STUCK_SIDE: g.STUCK_LEFT, g.STUCK_VALUE_M: 0.6},
        {g.STUCK_SIDE: g.STUCK_LEFT, g.STUCK_VALUE_M: 1.2},
        {g.LIMIT_LEFT_M: 0.5},
        {g.PROBE: 1.0},
    ],
)
def test_mirrored_orders_in_a_mirrored_place_give_mirrored_toggles(changes):
    orders = free()
    for column, value in changes.items():
        orders[column] = value
    one, other = Steering(orders), Steering(mirrored(orders))
    other.state[g.LEG_SIGN] = -1.0
    rng = np.random.default_rng(11)
    north, east, height, heading = -2500.0, 800.0, 1500.0, 0.3
    for _ in range(1200):
        rate = rng.normal(0.0, 0.1)
        heading = math.remainder(heading + 0.2 * rate, 2 * math.pi)
        north, east, height = north + 3.0 * math.cos(heading), east + 3.0 * math.sin(heading), height - 1.1
        one.at(north, east, height, heading, rate, (1.0, 2.0))
        other.at(north, -east, height, -heading, -rate, (1.0, -2.0))
        assert other.toggles == pytest.approx(one.toggles[::-1], abs=1e-9)


def test_ordered_to_the_right_it_never_asks_for_a_left_turn():
    orders = free()
    orders[g.TURN_DIRECTION] = 1.0
    steering = Steering(orders)
    for heading in np.linspace(-3.0, 3.0, 61):
        for _ in range(5):
            steering.at(-2000.0, 500.0, 1500.0, heading, 0.1)
            assert steering.toggles[0] == 0.0
            assert 0.0 <= steering.state[g.TURN_COMMAND_RAD_S] <= 0.29


def test_one_sided_it_circles_height_away_and_leaves_the_circle_towards_the_target():
    orders = free()
    orders[g.TURN_DIRECTION] = 1.0
    steering = Steering(orders)
    assert steering.at(-500.0, 0.0, 2500.0, 0.0)[g.TURN_COMMAND_RAD_S] == 0.18  # twenty times too high
    assert steering.at(-3300.0, 0.0, 1000.0, -2.0)[g.TURN_COMMAND_RAD_S] == 0.26  # right height, target to the left behind
    assert steering.at(-3300.0, 0.0, 1000.0, -0.05)[g.TURN_COMMAND_RAD_S] < 0.1  # out of the circle, nearly straight on
    assert steering.state[g.CIRCLING] == 0.0


def test_a_stuck_side_keeps_its_value_and_the_other_works_about_it():
    orders = free()
    orders[g.STUCK_SIDE], orders[g.STUCK_VALUE_M] = g.STUCK_LEFT, 0.6
    steering = Steering(orders)
    steering.at(-9000.0, 0.0, 2000.0, 0.0)
    assert steering.toggles == pytest.approx((0.6, 0.6))
    steering.at(-9000.0, 0.0, 2000.0, 0.5)  # turn left: let the right side go
    assert steering.state[g.TURN_COMMAND_RAD_S] == pytest.approx(-0.40 * 0.5)
    assert steering.toggles[0] == 0.6
    assert steering.toggles[1] == pytest.approx(max(0.6 - 0.28 / 0.365, 0.0))
    steering.at(-9000.0, 0.0, 10.0, 0.0)
    assert steering.toggles[1] < 1.0  # no flare on one side alone


def test_a_side_stuck_at_an_end_leaves_turns_to_one_side_only():
    orders = free()
    for side, value, direction in [(1, 0.05, 1), (1, 1.2, -1), (2, 0.05, -1), (2, 1.2, 1), (1, 0.6, 0), (0, 0.05, 0)]:
        orders[g.STUCK_SIDE], orders[g.STUCK_VALUE_M] = side, value
        assert g.allowed_direction(orders) == direction


def test_a_limited_side_is_never_asked_for_more():
    orders = free()
    orders[g.LIMIT_RIGHT_M] = 0.4
    steering = Steering(orders)
    for _ in range(50):
        steering.at(0.0, -9000.0, 2000.0, -1.0)
    assert steering.toggles == (0.0, 0.4)
    assert steering.state[g.INTEGRAL_M] == 0.0


def test_probing_pulls_both_toggles_for_a_moment_when_a_side_was_long_unused():
    orders = free()
    orders[g.PROBE] = 1.0
    steering = Steering(orders)
    pulled = []
    for _ in range(400):
        steering.at(-9000.0, 0.0, 2000.0, 0.0)
        pulled.append(steering.toggles)
    pulses = np.flatnonzero(np.array(pulled)[:, 0] == 0.8)
    assert set(pulled) == {(0.0, 0.0), (0.8, 0.8)}
    assert 0.2 * pulses[0] == pytest.approx(30.2)
    assert np.diff(pulses).max() > 100  # comes again after another half minute
    assert np.sum(np.diff(pulses) == 1) / 2 + 1 == pytest.approx(13)  # 2.6 s each

    for _ in range(400):
        steering.at(-9000.0, 0.0, 250.0, 0.0)
        assert steering.toggles == (0.0, 0.0)  # too low


def test_blind_it_lets_both_toggles_up_and_still_flares():
    steering = Steering()
    steering.at(0.0, -9000.0, 2000.0, -1.0)
    assert max(steering.toggles) > 0.5
    g.glide_blind(steering.state, LIMITS, 500.0)
    assert steering.toggles == (0.0, 0.0)
    assert steering.state[g.TURN_COMMAND_RAD_S] == 0.0
    g.glide_blind(steering.state, LIMITS, 10.0)
    assert steering.toggles == (1.0, 1.0)
