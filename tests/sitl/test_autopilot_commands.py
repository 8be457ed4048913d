"""Commands and their acknowledgements, arming, modes, landing, reboot, mission, time exchange."""

import math

import pytest

from sitl.autopilot import CommandMode, Misbehaviour, MissionItem
from sitl.vehicle import Injected
from tests.sitl.network import Network, sled_config

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = range(6)
SET_MODE, CALIBRATION, REBOOT, ARM, INJECT, REQUEST_MESSAGE = 176, 241, 246, 400, 420, 512
MOTOR, OFF, OK, STUCK = 101, 1, 0, 2
ARMED = 128


def armed(peer):
    return bool(peer.heard("HEARTBEAT")[-1].base_mode & ARMED)


def result(acks):
    (ack,) = acks
    return ack.result


def last_speed(peer):
    return peer.heard("GLOBAL_POSITION_INT")[-1].vx / 100.0


def test_it_arms_and_releases_itself_at_the_time_given_and_not_before():
    network = Network(release_s=2.0)
    gcs = network.peer()
    network.run(1.9)
    assert not armed(gcs)
    network.run(0.1)
    heard = gcs.heard()
    assert [m.base_mode & ARMED for m in heard if m.get_type() == "HEARTBEAT"] == [ARMED, ARMED]
    assert "Armed, released" in [m.text for m in heard if m.get_type() == "STATUSTEXT"]
    assert heard[-1].get_srcSystem() == 1
    network.run(8)
    assert last_speed(gcs) > 5.0


def test_before_release_the_fleet_stands_still():
    network = Network(release_s=None)
    network.run(30)
    assert network.autopilot.fleet.observe()[0][0, 8] == 0.0


def test_without_a_release_time_it_waits_for_the_command():
    network = Network(release_s=None)
    gcs = network.peer()
    network.run(30)
    assert not armed(gcs)
    assert result(gcs.command(ARM, 1)) == ACCEPTED
    network.run(8)
    assert last_speed(gcs) > 5.0


def test_arming_waits_for_a_position_unless_it_is_forced():
    network = Network(release_s=None)
    gcs = network.peer()
    gcs.set("SIM_GPS_DISABLE", 1)
    network.run(0.1)
    network.forget()
    assert result(gcs.command(ARM, 1)) == TEMPORARILY_REJECTED
    assert result(gcs.command(ARM, 1, 21196)) == ACCEPTED


def test_disarming_in_the_air_takes_force_and_does_not_stop_the_vehicle():
    network = Network(release_s=1.0)
    gcs = network.peer()
    network.run(10)
    assert result(gcs.command(ARM, 0)) == DENIED
    assert result(gcs.command(ARM, 0, 21196)) == ACCEPTED
    assert result(gcs.command(ARM, 2)) == DENIED
    network.run(5)
    heard = gcs.heard()
    assert [m.base_mode & ARMED for m in heard if m.get_type() == "HEARTBEAT"][-1] == 0
    assert [m.vx for m in heard if m.get_type() == "GLOBAL_POSITION_INT"][-1] > 300


def test_touchdown_disarms_and_says_so():
    network = Network(config=sled_config(rail_length_m=100.0), release_s=2.5)
    gcs = network.peer()
    network.run(40)
    heard = gcs.heard()
    assert [m.text for m in heard if m.get_type() == "STATUSTEXT"][-1] == "Landed, disarmed"
    assert [m.base_mode & ARMED for m in heard if m.get_type() == "HEARTBEAT"][-1] == 0
    landed_states = [m.landed_state for m in heard if m.get_type() == "EXTENDED_SYS_STATE"]
    assert (landed_states[0], landed_states[3], landed_states[-1]) == (1, 2, 1)
    assert result(gcs.command(ARM, 1)) == DENIED


def test_a_mode_of_the_airframe_is_taken_by_command_and_by_message_and_beaten_at_once():
    network = Network()
    gcs = network.peer()
    assert result(gcs.command(SET_MODE, 1, 4)) == ACCEPTED
    gcs.say("SET_MODE", target_system=1, base_mode=1, custom_mode=10)
    heard = gcs.heard()
    assert [m.custom_mode for m in heard if m.get_type() == "HEARTBEAT"] == [10]
    assert [(m.command, m.result) for m in heard if m.get_type() == "COMMAND_ACK"] == [(11, ACCEPTED)]


@pytest.mark.parametrize("params", [(1, 99), (0, 4), (math.nan, 4), (1, math.nan), (1, 4.5)])
def test_a_mode_that_there_is_not_is_denied(params):
    network = Network()
    assert result(network.peer().command(SET_MODE, *params)) == DENIED
    assert network.autopilot.custom_mode == 10


def test_an_acknowledgement_names_who_it_is_for_and_goes_to_no_other_client():
    network = Network()
    gcs, other = network.peer("gcs", 255, 190), network.peer("other", 42, 191)
    (ack,) = other.command(SET_MODE, 1, 4)
    assert (ack.command, ack.target_system, ack.target_component) == (SET_MODE, 42, 191)
    assert gcs.heard("COMMAND_ACK") == []


def test_command_int_is_understood_as_well():
    network = Network()
    gcs = network.peer()
    gcs.say("COMMAND_INT", target_system=1, target_component=1, command=SET_MODE, param1=1.0, param2=4.0)
    assert result(gcs.heard("COMMAND_ACK")) == ACCEPTED
    assert network.autopilot.custom_mode == 4


@pytest.mark.parametrize("command", [0, 16, 21, 183, 519, 521, 31010, 65535])
def test_what_it_cannot_do_is_unsupported(command):
    network = Network()
    assert result(network.peer().command(command, 1, 1)) == UNSUPPORTED


def test_capabilities_come_with_the_version():
    network = Network()
    gcs = network.peer()
    gcs.say("COMMAND_LONG", target_system=1, target_component=1, command=520, param1=1.0)
    heard = {m.get_type(): m for m in gcs.heard()}
    assert heard["COMMAND_ACK"].result == ACCEPTED
    assert heard["AUTOPILOT_VERSION"].capabilities & 0x2002 == 0x2002  # parameters as floats, MAVLink 2


def test_a_calibration_is_in_progress_before_it_is_done_however_often_it_is_asked_for():
    network = Network(release_s=None)
    gcs = network.peer()
    assert result(gcs.command(CALIBRATION, 1)) == IN_PROGRESS
    network.run(0.5)
    network.forget()
    assert result(gcs.command(CALIBRATION, 1, confirmation=1)) == IN_PROGRESS
    network.run(2)
    assert [m.result for m in gcs.heard("COMMAND_ACK")] == [ACCEPTED]


def test_a_calibration_in_flight_is_rejected_for_now():
    network = Network(release_s=0.1)
    gcs = network.peer()
    network.run(1)
    network.forget()
    assert result(gcs.command(CALIBRATION, 1)) == TEMPORARILY_REJECTED


def test_an_injected_failure_acts_and_can_be_taken_back():
    network = Network(release_s=0.1)
    gcs = network.peer()
    network.run(8)
    assert last_speed(gcs) > 9.0
    assert result(gcs.command(INJECT, MOTOR, OFF, 1)) == ACCEPTED
    network.run(8)
    assert last_speed(gcs) < 1.0
    assert result(gcs.command(INJECT, MOTOR, OK, 0)) == ACCEPTED
    network.run(8)
    assert last_speed(gcs) > 4.0


@pytest.mark.parametrize(
    ("params", "wanted"),
    [
        ((MOTOR, STUCK, 1), UNSUPPORTED),
        ((0, OFF, 1), UNSUPPORTED),
        ((MOTOR, OFF, 2), DENIED),
        ((MOTOR, OFF, -1), DENIED),
        ((MOTOR, OFF, 0.5), DENIED),
        ((MOTOR, OFF, math.nan, 1), ACCEPTED),
        ((MOTOR, OFF, math.nan, 2), DENIED),
        ((MOTOR, OFF, math.nan, 0), DENIED),
        ((math.nan, OFF, 1), UNSUPPORTED),
    ],
)
def test_no_failure_is_accepted_that_has_no_effect(params, wanted):
    network = Network(release_s=0.1)
    gcs = network.peer()
    network.run(5)
    network.forget()
    assert result(gcs.command(INJECT, *params)) == wanted
    network.run(10)
    assert (last_speed(gcs) < 1.0) == (wanted == ACCEPTED)


def test_failures_are_denied_while_the_guard_is_down():
    network = Network()
    gcs = network.peer()
    gcs.set("SYS_FAILURE_EN", 0)
    assert result(gcs.command(INJECT, MOTOR, OFF, 1)) == DENIED


def test_a_fault_given_at_the_start_happens_so_long_after_release():
    network = Network(release_s=3.0, fault=Injected("thruster_loss", 5.0, 1.0))
    gcs = network.peer()
    network.run(8)
    assert last_speed(gcs) > 9.0
    network.run(8)
    assert last_speed(gcs) < 1.0


@pytest.mark.parametrize(
    ("mode", "answers", "done"),
    [
        (CommandMode.DENY, [DENIED], False),
        (CommandMode.REJECT, [TEMPORARILY_REJECTED], False),
        (CommandMode.IGNORE, [], False),
        (CommandMode.LIE, [ACCEPTED], False),
        (CommandMode.LATE, [], True),
    ],
)
def test_commands_can_be_met_badly(mode, answers, done):
    network = Network(misbehaviour=Misbehaviour(command_mode=mode, command_delay_s=1.0))
    gcs = network.peer()
    assert [m.result for m in gcs.command(SET_MODE, 1, 4)] == answers
    assert (network.autopilot.custom_mode == 4) == done
    network.run(1.1)
    assert [m.result for m in gcs.heard("COMMAND_ACK")] == ([ACCEPTED] if mode is CommandMode.LATE else [])


# Reboot


def test_a_reboot_answers_then_is_silent_and_comes_back_with_its_clock_at_zero():
    network = Network(release_s=None)
    gcs = network.peer()
    network.run(20)
    network.forget()
    assert result(gcs.command(REBOOT, 1)) == ACCEPTED
    network.run(1.4)
    assert gcs.heard() == []
    network.run(0.2)
    heard = gcs.heard()
    assert heard
    assert max(m.time_boot_ms for m in heard if hasattr(m, "time_boot_ms")) == 1600
    assert "sled simulated, ready" in [m.text for m in heard if m.get_type() == "STATUSTEXT"]


def test_a_reboot_keeps_parameters_and_forgets_streams_and_routes():
    network = Network(release_s=None)
    gcs, camera = network.peer("gcs"), network.peer("camera", 1, 100)
    gcs.set("SLED_SPEED", 5.0)
    gcs.command(511, 33, -1)
    gcs.command(REBOOT, 1)
    network.run(2)
    network.forget()
    network.run(2)
    assert len(gcs.heard("GLOBAL_POSITION_INT")) == 10
    assert gcs.read("SLED_SPEED")[0].param_value == 5.0
    assert gcs.read("STAT_BOOTCNT")[0].param_value == 2.0
    camera.heard()
    gcs.command(REQUEST_MESSAGE, 1, target=(1, 100))
    assert camera.heard("COMMAND_LONG") == []


def test_what_is_said_to_a_rebooting_autopilot_is_lost():
    network = Network()
    gcs = network.peer()
    gcs.command(REBOOT, 1)
    network.run(0.5)
    assert gcs.set("SLED_SPEED", 5.0) == []
    network.run(2)
    assert gcs.read("SLED_SPEED")[0].param_value == 8.0


def test_a_reboot_in_the_air_comes_back_armed_and_the_vehicle_has_flown_on():
    network = Network(release_s=1.0)
    gcs = network.peer()
    network.run(10)
    position_m = gcs.heard("WHEEL_DISTANCE")[-1].distance[0]
    gcs.command(REBOOT, 1)
    network.run(3)
    heard = gcs.heard()
    assert next(m for m in heard if m.get_type() == "HEARTBEAT").base_mode & ARMED
    assert [m.distance[0] for m in heard if m.get_type() == "WHEEL_DISTANCE"][-1] > position_m + 20.0


def test_a_new_system_id_is_taken_at_the_next_boot():
    network = Network(release_s=None)
    gcs = network.peer()
    gcs.set("SYSID_THISMAV", 7)
    network.run(1)
    assert {m.get_srcSystem() for m in gcs.heard()} == {1}
    gcs.command(REBOOT, 1)
    network.run(3)
    assert {m.get_srcSystem() for m in gcs.heard()} == {7}


@pytest.mark.parametrize(("param", "wanted"), [(0, DENIED), (2, UNSUPPORTED), (3, UNSUPPORTED)])
def test_only_a_reboot_is_a_reboot(param, wanted):
    network = Network()
    gcs = network.peer()
    network.run(3)
    network.forget()
    assert result(gcs.command(REBOOT, param)) == wanted
    assert network.autopilot.time_us == 3_000_000


# The rest of the conversation


def test_an_empty_mission_is_downloaded_as_empty():
    network = Network()
    gcs = network.peer()
    gcs.say("MISSION_REQUEST_LIST", target_system=1, target_component=1)
    (count,) = gcs.heard("MISSION_COUNT")
    assert (count.count, count.target_system, count.mission_type) == (0, 255, 0)
    gcs.say("MISSION_REQUEST_INT", target_system=1, target_component=1, seq=0)
    assert [m.type for m in gcs.heard("MISSION_ACK")] == [13]


def test_a_given_mission_is_downloaded_item_by_item():
    items = (
        MissionItem(16, 6, (0.0, 1.0, 2.0, 3.0), 473977000, 85456000, 10.0),
        MissionItem(21, 6, (0.0,) * 4, 473978000, 85457000, 0.0),
    )  # fmt: skip
    network = Network(mission=items)
    gcs = network.peer()
    gcs.say("MISSION_REQUEST_LIST", target_system=1, target_component=1)
    assert [m.count for m in gcs.heard("MISSION_COUNT")] == [2]
    downloaded = []
    for seq in range(2):
        gcs.say("MISSION_REQUEST_INT", target_system=1, target_component=1, seq=seq)
        downloaded += [(m.seq, m.command, m.x, m.z, m.param3) for m in gcs.heard("MISSION_ITEM_INT")]
    assert downloaded == [(0, 16, 473977000, 10.0, 2.0), (1, 21, 473978000, 0.0, 0.0)]
    gcs.say("MISSION_REQUEST_LIST", target_system=1, target_component=1, mission_type=1)
    assert [m.count for m in gcs.heard("MISSION_COUNT")] == [0]


def test_a_mission_that_somebody_wants_to_upload_is_denied():
    network = Network()
    gcs = network.peer()
    gcs.say("MISSION_COUNT", target_system=1, target_component=1, count=3)
    assert [m.type for m in gcs.heard("MISSION_ACK")] == [14]


def test_a_question_for_the_time_is_answered_to_who_asked():
    network = Network()
    gcs, other = network.peer("gcs"), network.peer("other", 42)
    network.run(3)
    network.forget()
    gcs.say("TIMESYNC", tc1=0, ts1=123456789)
    assert [(m.tc1, m.ts1) for m in gcs.heard("TIMESYNC")] == [(3_000_000_000, 123456789)]
    assert other.heard("TIMESYNC") == []


def test_a_ping_comes_back_to_who_sent_it():
    network = Network()
    gcs = network.peer()
    gcs.say("PING", time_usec=5, seq=9)
    assert [(m.seq, m.time_usec, m.target_system, m.target_component) for m in gcs.heard("PING")] == [(9, 5, 255, 190)]


def test_a_low_battery_is_unhealthy_and_said_once():
    network = Network()
    gcs = network.peer()
    gcs.set("SIM_BATT_VOLTAGE", 9.5)
    network.run(5)
    heard = gcs.heard()
    assert [m.text for m in heard if m.get_type() == "STATUSTEXT"].count("Battery 1 is low 9.50V") == 1
    status = [m for m in heard if m.get_type() == "SYS_STATUS"][-1]
    assert (status.voltage_battery, status.onboard_control_sensors_health & 0x2000000) == (9500, 0)
