"""The parameter protocol, honest and otherwise."""

import math

import pytest

from sitl.autopilot import Misbehaviour, ParameterMode
from sitl.autopilot.parameters import held
from sitl.vehicle import Parameter
from tests.sitl.network import Network, sled_autopilot

INT32, REAL32 = 6, 9


def told(messages):
    return [(m.param_id, m.param_value) for m in messages]


def test_the_list_has_every_parameter_once_with_its_index_and_type():
    network = Network()
    gcs = network.peer()
    gcs.say("PARAM_REQUEST_LIST", target_system=1, target_component=1)
    network.run(3)
    heard = gcs.heard("PARAM_VALUE")
    parameters = network.autopilot.parameters
    assert [m.param_id for m in heard] == list(parameters.names)
    assert [m.param_index for m in heard] == list(range(len(heard)))
    assert {m.param_count for m in heard} == {len(heard)}
    kinds = {m.param_id: m.param_type for m in heard}
    assert (kinds["SERVO1_FUNCTION"], kinds["SLED_SPEED"], kinds["SYS_FAILURE_EN"]) == (INT32, REAL32, INT32)


def test_the_list_goes_to_who_asked_for_it_alone():
    network = Network()
    gcs, other = network.peer("gcs"), network.peer("other", 254)
    gcs.say("PARAM_REQUEST_LIST", target_system=1, target_component=1)
    network.run(1)
    assert gcs.heard("PARAM_VALUE")
    assert not other.heard("PARAM_VALUE")


def test_a_parameter_is_read_by_name_and_by_index():
    network = Network()
    gcs = network.peer()
    (by_name,) = gcs.read("SLED_SPEED")
    gcs.say("PARAM_REQUEST_READ", target_system=1, target_component=1, param_index=by_name.param_index)
    (by_index,) = gcs.heard("PARAM_VALUE")
    assert told([by_name]) == told([by_index]) == [("SLED_SPEED", 8.0)]


def test_a_setting_is_echoed_to_every_client_and_acts():
    network = Network()
    gcs, other = network.peer("gcs"), network.peer("other", 254)
    network.run(40)
    network.forget()
    assert told(gcs.set("SLED_SPEED", 15.0)) == [("SLED_SPEED", 15.0)]
    assert told(other.heard("PARAM_VALUE")) == [("SLED_SPEED", 15.0)]
    assert told(other.read("SLED_SPEED")) == [("SLED_SPEED", 15.0)]
    network.run(5)
    assert gcs.heard("POSITION_TARGET_LOCAL_NED")[-1].vx == 18.0


def test_the_echo_has_the_type_of_the_parameter_and_not_that_of_the_request():
    network = Network()
    gcs = network.peer()
    (echo,) = gcs.set("SERVO1_FUNCTION", 0.0, REAL32)
    assert (echo.param_type, echo.param_value) == (INT32, 0.0)
    (echo,) = gcs.set("SLED_SPEED", 7.25, INT32)
    assert (echo.param_type, echo.param_value) == (REAL32, 7.25)


@pytest.mark.parametrize(("value", "kept"), [(73.0, 73.0), (72.995, 73.0), (72.5, 72.0), (-0.005, 0.0), (-1.5, -1.0)])
def test_integers_are_cut_off_as_ardupilot_cuts_them(value, kept):
    assert held(Parameter("X", 0.0, True), value) == kept


def test_floats_are_kept_in_32_bits():
    assert held(Parameter("X", 0.0, False), 0.1) == pytest.approx(0.10000000149011612, abs=0.0)


@pytest.mark.parametrize("value", [151.0, -1.0])
def test_a_value_out_of_range_is_refused_with_the_old_value_and_a_text(value):
    network = Network()
    gcs = network.peer()
    gcs.say("PARAM_SET", target_system=1, target_component=1, param_id="SERVO1_FUNCTION", param_value=value, param_type=6)
    heard = gcs.heard()
    assert told([m for m in heard if m.get_type() == "PARAM_VALUE"]) == [("SERVO1_FUNCTION", 70.0)]
    assert [m.text for m in heard if m.get_type() == "STATUSTEXT"] == ["Param write denied (SERVO1_FUNCTION)"]


def test_a_parameter_that_is_read_only_keeps_its_value():
    network = Network()
    assert told(network.peer().set("STAT_BOOTCNT", 9.0)) == [("STAT_BOOTCNT", 1.0)]


@pytest.mark.parametrize(("name", "value"), [("NO_SUCH_NAME", 1.0), ("SLED_SPEED", math.nan), ("SLED_SPEED", math.inf)])
def test_an_unknown_name_and_no_number_are_met_with_silence_as_on_ardupilot(name, value):
    network = Network()
    gcs = network.peer()
    gcs.say("PARAM_SET", target_system=1, target_component=1, param_id=name, param_value=value, param_type=REAL32)
    assert gcs.heard() == []
    assert network.autopilot.parameters.value("SLED_SPEED") == 8.0


def test_param_error_names_the_reason_where_it_is_wanted():
    network = Network(param_errors=True)
    gcs = network.peer()
    errors = []
    for name, value in [("NO_SUCH_NAME", 1.0), ("SERVO1_FUNCTION", 999.0), ("STAT_BOOTCNT", 5.0)]:
        gcs.say("PARAM_SET", target_system=1, target_component=1, param_id=name, param_value=value, param_type=REAL32)
        errors += [(m.param_id, m.error, m.target_system) for m in gcs.heard("PARAM_ERROR")]
    gcs.say("PARAM_REQUEST_READ", target_system=1, target_component=1, param_index=9999)
    errors += [(m.param_index, m.error, m.target_system) for m in gcs.heard("PARAM_ERROR")]
    assert errors == [("NO_SUCH_NAME", 1, 255), ("SERVO1_FUNCTION", 2, 255), ("STAT_BOOTCNT", 5, 255), (9999, 1, 255)]


def test_a_name_of_all_sixteen_bytes_is_found_and_one_that_is_no_ascii_is_not():
    network = Network()
    gcs = network.peer()
    assert gcs.set("SIM_GPS_DISABLE", 1)
    gcs.say("PARAM_SET", target_system=1, target_component=1, param_id=b"\xff\xfe", param_value=1.0, param_type=REAL32)
    assert gcs.heard() == []


def test_a_name_in_two_tables_is_refused():
    autopilot = sled_autopilot()
    with pytest.raises(ValueError, match="SYSID_THISMAV"):
        type(autopilot.parameters)((Parameter("SYSID_THISMAV", 1.0, True),), 1, Misbehaviour())


def test_setting_from_outside_the_link_raises_for_what_is_refused():
    autopilot = sled_autopilot()
    autopilot.set_parameter("SLED_SPEED", 3.0)
    assert autopilot.parameters.value("SLED_SPEED") == 3.0
    for name, value in [("NO_SUCH_NAME", 1.0), ("SLED_SPEED", 1000.0), ("SLED_SPEED", math.nan)]:
        with pytest.raises(ValueError, match=name):
            autopilot.set_parameter(name, value)


# Misbehaviour: what is echoed at once, and what is stored


@pytest.mark.parametrize(
    ("mode", "echoed", "stored"),
    [
        (ParameterMode.REFUSE, [8.0], 8.0),
        (ParameterMode.LIE, [12.0], 8.0),
        (ParameterMode.SILENT, [], 12.0),
        (ParameterMode.IGNORE, [], 8.0),
        (ParameterMode.LATE, [], 12.0),
        (ParameterMode.WRONG, [13.0], 12.0),
    ],
)
def test_misbehaviour_over_the_link(mode, echoed, stored):
    network = Network()
    gcs = network.peer()
    assert told(gcs.set("SIM_PRM_MODE", mode)) == [("SIM_PRM_MODE", float(mode))]
    assert [m.param_value for m in gcs.set("SLED_SPEED", 12.0)] == echoed
    assert told(gcs.read("SLED_SPEED")) == [("SLED_SPEED", stored)]
    network.run(10)
    expected = {8.0: 11.0, 12.0: 15.0}[stored]  # the swing adds 3
    assert gcs.heard("POSITION_TARGET_LOCAL_NED")[-1].vx == expected
    assert told(gcs.set("SIM_PRM_MODE", 0)) == [("SIM_PRM_MODE", 0.0)]
    assert told(gcs.set("SLED_SPEED", 9.0)) == [("SLED_SPEED", 9.0)]


def test_a_late_answer_comes_after_the_delay_that_was_asked_for():
    network = Network(misbehaviour=Misbehaviour(parameter_mode=ParameterMode.LATE, parameter_delay_s=1.5))
    gcs = network.peer()
    assert gcs.set("SLED_SPEED", 12.0) == []
    network.run(1.4)
    assert gcs.heard("PARAM_VALUE") == []
    network.run(0.1)
    assert told(gcs.heard("PARAM_VALUE")) == [("SLED_SPEED", 12.0)]


def test_misbehaviour_concerns_the_one_parameter_named():
    network = Network(misbehaviour=Misbehaviour(parameter_mode=ParameterMode.IGNORE, parameter_name="SERVO1_FUNCTION"))
    gcs = network.peer()
    assert gcs.set("SERVO1_FUNCTION", 0.0) == []
    assert told(gcs.set("SLED_SPEED", 9.0)) == [("SLED_SPEED", 9.0)]


def test_misbehaviour_begins_after_as_many_settings_as_wanted():
    network = Network(misbehaviour=Misbehaviour(parameter_mode=ParameterMode.REFUSE, parameter_after=2))
    gcs = network.peer()
    assert [gcs.set("SLED_SPEED", value)[0].param_value for value in (1.0, 2.0, 3.0, 4.0)] == [1.0, 2.0, 2.0, 2.0]


def test_the_autopilot_reboots_at_the_setting_that_was_named_and_does_not_apply_it():
    network = Network(misbehaviour=Misbehaviour(reboot_at_set=2))
    gcs = network.peer()
    network.run(8)
    assert told(gcs.set("SLED_SPEED", 9.0)) == [("SLED_SPEED", 9.0)]
    assert gcs.set("SLED_SPEED", 10.0) == []
    network.run(1.4)
    assert gcs.heard() == []
    network.run(2)
    assert gcs.heard("SYSTEM_TIME")[-1].time_boot_ms <= 3400
    gcs.beat()
    assert told(gcs.read("SLED_SPEED")) == [("SLED_SPEED", 9.0)]
    assert told(gcs.set("SLED_SPEED", 11.0)) == [("SLED_SPEED", 11.0)]
