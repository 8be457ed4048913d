"""Recoveries against a simulated autopilot that does not always do as it is told: MAVLink in between, one process.

Asked at every end: what stage it ended in, what the vehicle really has, what the operator heard.
"""

from dataclasses import dataclass

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.decision import Policy
from companion.dialect import encode
from companion.frames import Splitter
from companion.recovery import Stage
from sitl.autopilot import Misbehaviour, ParameterMode
from tests.system.flights import CROSSED, ORIGINAL, OUTPUTS, SWAPPED, Flight

LEFT, RIGHT = OUTPUTS
HALF = (78.0, 78.0)
SAID = {  # last of the texts about the repair
    Stage.DONE: "repair verified",
    Stage.REFUSED: "repair refused, parameters as before",
    Stage.ROLLED_BACK: "repair undone, parameters as before",
    Stage.UNCERTAIN: "PARAMETERS UNCERTAIN: CHECK OUTPUTS",
}
ENDS = {Stage.DONE: SWAPPED, Stage.REFUSED: ORIGINAL, Stage.ROLLED_BACK: ORIGINAL}


@dataclass(frozen=True)
class Case:
    """One kind of misbehaviour and how it must end."""

    switches: dict
    stage: Stage
    reason: str
    sets: int | None = None  # PARAM_SETs it may take; None: not asked


WAYS = ParameterMode
CASES = {
    "honest": Case({}, Stage.DONE, "stayed clear", 2),
    "refuses the first": Case({"parameter_mode": WAYS.REFUSE}, Stage.REFUSED, f"{LEFT} was not taken", 4),
    "takes nothing and says nothing": Case({"parameter_mode": WAYS.IGNORE}, Stage.REFUSED, f"{LEFT} was not taken"),
    "echoes what it does not apply": Case({"parameter_mode": WAYS.LIE}, Stage.ROLLED_BACK, "did not read back", 4),
    "echoes what it does not apply, of one": Case(
        {"parameter_mode": WAYS.LIE, "parameter_name": LEFT}, Stage.ROLLED_BACK, "did not read back", 4
    ),
    "applies the first and says nothing": Case({"parameter_mode": WAYS.SILENT}, Stage.REFUSED, f"{LEFT} was not taken"),
    "applies the second and says nothing": Case(
        {"parameter_mode": WAYS.SILENT, "parameter_after": 1}, Stage.ROLLED_BACK, f"{RIGHT} was not taken"
    ),
    "echoes another value than it applies, of the first": Case(
        {"parameter_mode": WAYS.WRONG}, Stage.REFUSED, f"{LEFT} was not taken"
    ),
    "echoes another value than it applies, of the second": Case(
        {"parameter_mode": WAYS.WRONG, "parameter_after": 1}, Stage.ROLLED_BACK, f"{RIGHT} was not taken"
    ),
    "answers in time": Case({"parameter_mode": WAYS.LATE, "parameter_delay_s": 0.5}, Stage.DONE, "stayed clear", 2),
    "answers when asked three times": Case(
        {"parameter_mode": WAYS.LATE, "parameter_delay_s": 2.0}, Stage.DONE, "stayed clear"
    ),
    "answers too late": Case(
        {"parameter_mode": WAYS.LATE, "parameter_delay_s": 5.0}, Stage.REFUSED, f"{LEFT} was not taken"
    ),
    "reboots at the first": Case({"reboot_at_set": 1}, Stage.REFUSED, "rebooted", 2),
    "reboots at the second": Case({"reboot_at_set": 2}, Stage.ROLLED_BACK, "rebooted", 4),
    "loses a frame in twenty": Case({"link_loss": 0.05}, Stage.DONE, "stayed clear"),
    "sends half the frames twice": Case({"link_duplication": 0.5}, Stage.DONE, "stayed clear", 2),
    "swaps half the frames": Case({"link_swap": 0.5}, Stage.DONE, "stayed clear"),
    "loses, doubles and swaps": Case(
        {"link_loss": 0.1, "link_duplication": 0.3, "link_swap": 0.3}, Stage.DONE, "stayed clear"
    ),
    "floods": Case({"flood_hz": 500.0}, Stage.DONE, "stayed clear", 2),
}


def repair_texts(flight):
    return [text for text in flight.spoken if text in SAID.values()]


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_a_repair_ends_with_both_outputs_as_before_or_both_swapped_and_the_operator_is_told_which(case):
    flight = Flight(1, CROSSED, misbehaviour=Misbehaviour(**case.switches)).fly(120.0)
    recovery = flight.core.recovery
    assert (recovery.stage, flight.outputs) == (case.stage, ENDS[case.stage])
    assert case.reason in recovery.reason
    assert repair_texts(flight) == [SAID[case.stage]]
    assert flight.names("recovery").count("recovery/considered") == 1
    assert case.sets in (None, len(flight.sets)), flight.sets
    assert flight.rehearsal.record == ""


@pytest.mark.parametrize("way", [WAYS.REFUSE, WAYS.IGNORE, WAYS.LIE], ids=lambda way: way.name.lower())
def test_an_autopilot_that_takes_half_and_then_nothing_more_is_said_to_be_uncertain_as_loudly_as_can_be(way):
    flight = Flight(1, CROSSED, misbehaviour=Misbehaviour(parameter_mode=way, parameter_after=1))
    flight.fly_until(lambda: flight.core.recovery is not None and flight.core.recovery.ended, 160.0)
    assert (flight.core.recovery.stage, flight.outputs) == (Stage.UNCERTAIN, HALF)
    severity, text = [(s.fields["severity"], s.fields["text"]) for s in flight.sends if s.message == "STATUSTEXT"][-1]
    assert (severity, text) == (dialect.MAV_SEVERITY_EMERGENCY, f"mavfdi: {SAID[Stage.UNCERTAIN]}")
    assert flight.rehearsal.record  # for a restart of the companion


def test_an_uncertain_end_is_taken_up_again_and_put_right_when_the_vehicle_comes_back():
    switches = Misbehaviour(parameter_mode=WAYS.REFUSE, parameter_after=1)
    flight = Flight(1, CROSSED, misbehaviour=switches)
    flight.fly_until(lambda: flight.core.recovery is not None and flight.core.recovery.ended, 160.0)
    switches.parameter_mode = WAYS.HONEST
    flight.hear_nothing(35.0)
    flight.fly(20.0)
    assert (flight.core.recovery.stage, flight.outputs) == (Stage.ROLLED_BACK, ORIGINAL)
    assert repair_texts(flight) == [SAID[Stage.UNCERTAIN], SAID[Stage.ROLLED_BACK]]
    assert flight.rehearsal.record == ""


def test_a_definite_no_ends_the_change_without_asking_again():
    flight = Flight(1, CROSSED, misbehaviour=Misbehaviour(parameter_mode=WAYS.IGNORE, parameter_after=1))
    flight.fly_until(lambda: (RIGHT, 77.0) in flight.sets)
    flight.autopilot.misbehaviour.parameter_mode = WAYS.HONEST
    flight.sends.clear()
    fields = {"target_system": 1, "target_component": 191, "param_id": RIGHT, "param_index": -1, "error": 5}
    (frame,) = Splitter().feed(encode("PARAM_ERROR", fields, sysid=1, compid=1, seq=0))
    flight.rehearsal._perform(flight.core.frame(frame, flight.rehearsal._clock.now_us()))
    flight.fly(20.0)
    assert flight.sets == [(RIGHT, 78.0), (LEFT, 77.0)]
    assert (flight.core.recovery.stage, flight.outputs) == (Stage.ROLLED_BACK, ORIGINAL)
    assert f"{RIGHT}: the autopilot answers error 5" in flight.core.recovery.reason


def test_both_outputs_carry_one_function_for_one_round_trip():
    flight = Flight(1, CROSSED)
    flight.fly_until(lambda: flight.outputs == HALF)
    began_us = flight.autopilot.elapsed_us
    flight.fly_until(lambda: flight.outputs == SWAPPED)
    assert flight.autopilot.elapsed_us - began_us == 100_000  # a round trip of lockstep


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_a_needless_swap_is_rolled_back_by_its_verification_within_fifteen_seconds(seed):
    flight = Flight(seed).fly(40.0)
    assert flight.names("fault", "recovery") == []
    flight.begin_recovery()
    flight.fly(60.0)
    assert (flight.core.recovery.stage, flight.outputs) == (Stage.ROLLED_BACK, ORIGINAL)
    assert "heading_rate rose again" in flight.core.recovery.reason
    # Seeds 1 to 20: 7.0 to 11.9 s, median 8.3 s, from "acknowledged" to the first PARAM_SET that puts it back.
    assert flight.time("recovery/failed") - flight.time("recovery/acknowledged") < 15.0
    assert flight.names("recovery")[-2:] == ["recovery/failed", "recovery/rolled_back"]


def test_under_policy_off_nothing_is_sent_but_alarms():
    flight = Flight(1, CROSSED, Policy.OFF).fly(90.0)
    assert (flight.sets, flight.outputs, flight.names("recovery")) == ([], ORIGINAL, [])
    assert flight.spoken[-1] == "control lines crossed (99.9 %)"
    assert not any("swap" in text for text in flight.spoken)


def own(**fields):
    return {"target_system": 1, "target_component": dialect.MAV_COMP_ID_ONBOARD_COMPUTER, **fields}


def confirm(flight):
    flight.ground("COMMAND_LONG", command=dialect.MAV_CMD_USER_2, **own())


def veto(flight):
    flight.ground("COMMAND_LONG", command=dialect.MAV_CMD_USER_1, **own())


def results(flight):
    acks = [send.fields for send in flight.sends if send.message == "COMMAND_ACK"]
    assert all((ack["target_system"], ack["target_component"]) == (255, 190) for ack in acks)
    return [ack["result"] for ack in acks]


def test_under_policy_advise_nothing_is_sent_but_the_advice_until_the_operator_confirms_it():
    flight = Flight(1, CROSSED, Policy.ADVISE).fly(80.0)
    assert (flight.sets, flight.outputs) == ([], ORIGINAL)
    assert flight.names("recovery") == ["recovery/advised"]
    assert flight.spoken.count("advise: swapping control lines") == 1
    confirm(flight)
    flight.fly(60.0)
    assert results(flight) == [dialect.MAV_RESULT_ACCEPTED]
    assert (flight.core.recovery.stage, flight.outputs) == (Stage.DONE, SWAPPED)


def test_a_confirmation_of_nothing_is_denied_and_changes_nothing_later():
    flight = Flight(1, CROSSED, Policy.ADVISE).fly(15.0)
    confirm(flight)
    flight.fly(75.0)
    assert results(flight) == [dialect.MAV_RESULT_DENIED]
    assert (flight.sets, flight.outputs) == ([], ORIGINAL)


@pytest.mark.parametrize("name", ["recovery/requested", "recovery/acknowledged", "recovery/verified"])
def test_a_veto_puts_back_what_was_changed_and_it_is_not_tried_again(name):
    flight = Flight(1, CROSSED)
    flight.fly_until(lambda: name in flight.names())
    veto(flight)
    flight.fly(100.0)
    assert results(flight) == [dialect.MAV_RESULT_ACCEPTED]
    assert flight.outputs == ORIGINAL
    assert flight.core.recovery.stage in (Stage.ROLLED_BACK, Stage.REFUSED)
    assert flight.core.recovery.reason == "vetoed by the operator"
    assert "recovery/vetoed" in flight.names("recovery")
    assert flight.names("recovery").count("recovery/considered") == 1


def test_a_veto_of_nothing_is_denied():
    flight = Flight(1).fly(20.0)
    veto(flight)
    flight.fly(1.0)
    assert results(flight) == [dialect.MAV_RESULT_DENIED]


def test_the_policy_is_a_parameter_that_a_ground_station_reads_and_sets_in_flight():
    flight = Flight(1, CROSSED, Policy.OFF).fly(60.0)
    flight.ground("PARAM_REQUEST_READ", param_id="MFDI_POLICY", param_index=-1, **own())
    flight.fly(1.0)
    flight.ground("PARAM_SET", param_id="MFDI_POLICY", param_value=7.0, param_type=6, **own())
    flight.fly(1.0)
    assert flight.core.policy is Policy.OFF
    flight.ground("PARAM_SET", param_id="MFDI_POLICY", param_value=2.0, param_type=6, **own())
    flight.fly(60.0)
    told = [send.fields["param_value"] for send in flight.sends if send.message == "PARAM_VALUE"]
    assert told == [0.0, 0.0, 2.0]
    assert (flight.core.recovery.stage, flight.outputs) == (Stage.DONE, SWAPPED)
    beats = [send.fields["custom_mode"] for send in flight.sends if send.message == "HEARTBEAT"]
    assert sorted(set(beats)) == [0, 2]


def test_what_is_asked_of_another_component_is_not_answered():
    flight = Flight(1, CROSSED, Policy.ADVISE).fly(60.0)
    for component in (dialect.MAV_COMP_ID_AUTOPILOT1, dialect.MAV_COMP_ID_ONBOARD_COMPUTER2, 0):
        flight.ground("COMMAND_LONG", command=dialect.MAV_CMD_USER_2, target_system=1, target_component=component)
    flight.ground("COMMAND_LONG", command=dialect.MAV_CMD_USER_2, target_system=2, target_component=191)
    flight.fly(30.0)
    assert results(flight) == []
    assert flight.sets == []
    flight.ground("COMMAND_LONG", command=dialect.MAV_CMD_DO_SET_HOME, **own())
    flight.fly(1.0)
    assert results(flight) == [dialect.MAV_RESULT_UNSUPPORTED]
