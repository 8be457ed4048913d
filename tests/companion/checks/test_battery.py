"""Power checks."""

import pytest

from companion.checks import Status

NOT_AVAILABLE, OK, WARNING, FAULT = Status.NOT_AVAILABLE, Status.OK, Status.WARNING, Status.FAULT


def power(log, volts, amperes=lambda _: 10.0, left=lambda _: 80, more=lambda _: []):
    flight = log()

    def status(t_s):
        fields = {
            "voltage_battery": min(65535, round(1e3 * volts(t_s))),
            "current_battery": round(100.0 * amperes(t_s)),
            "battery_remaining": left(t_s),
        }
        return [("SYS_STATUS", fields), *more(t_s)]

    flight.fly(10.0, 110.0, status)
    return flight.findings()


def test_little_charge_is_a_warning(log):
    low = power(log, lambda _: 12.0, left=lambda t_s: 12 if t_s > 60.0 else 30)["battery_low"]
    assert low.status is WARNING
    assert "12 %" in low.text


def test_a_battery_that_turns_unhealthy_is_a_fault_and_one_that_always_was_is_not(log):
    def state(value):
        return lambda t_s: [("BATTERY_STATUS", {"charge_state": value(t_s)})]

    assert power(log, lambda _: 12.0, more=state(lambda t_s: 6 if t_s > 60.0 else 1))["battery_low"].status is FAULT
    assert power(log, lambda _: 12.0, more=state(lambda _: 6))["battery_low"].status is WARNING


def test_a_battery_that_is_not_measured_is_not_judged(log):
    for volts in (0.0, 65.535):
        found = power(log, lambda _, volts=volts: volts, amperes=lambda _: -0.01, left=lambda _: -1)
        assert {found[name].status for name in ("battery_low", "battery_cell", "battery_drop")} == {NOT_AVAILABLE}


def test_cells_are_counted_from_the_full_voltage(log):
    low = power(log, lambda t_s: 12.4 if t_s < 60.0 else 10.2)["battery_cell"]
    assert low.status is WARNING
    assert "3.40 V a cell of 3" in low.text
    assert power(log, lambda _: 22.2)["battery_cell"].text.endswith("3.70 V a cell of 6 or more")


def test_another_chemistry_is_not_judged_by_lithium_cells(log):
    assert power(log, lambda _: 13.2)["battery_cell"].status is NOT_AVAILABLE  # four cells of lithium iron phosphate


def test_a_fall_at_equal_current_is_a_fault(log):
    drop = power(log, lambda t_s: 12.4 if t_s < 60.0 else 10.6)["battery_drop"]
    assert drop.status is FAULT
    assert drop.t == pytest.approx(62.0, abs=3.0)


def test_a_sag_that_the_current_explains_is_none(log):
    drop = power(log, lambda t_s: 12.4 if t_s < 60.0 else 10.9, amperes=lambda t_s: 5.0 if t_s < 60.0 else 40.0)
    assert drop["battery_drop"].status is OK


def test_a_slow_discharge_is_no_fall(log):
    assert power(log, lambda t_s: 12.6 - 0.02 * (t_s - 10.0))["battery_drop"].status is OK


def test_a_weak_supply_of_the_autopilot_is_a_warning(log):
    rail = power(log, lambda _: 12.0, more=lambda t_s: [("POWER_STATUS", {"Vcc": 4400 if t_s > 60.0 else 5050})])
    assert rail["power_rail"].status is WARNING
    none = power(log, lambda _: 12.0, more=lambda _: [("POWER_STATUS", {"Vcc": 0})])
    assert none["power_rail"].status is NOT_AVAILABLE
