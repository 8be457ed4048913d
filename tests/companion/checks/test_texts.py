"""What the autopilot says itself."""

import pytest

from companion.checks import Status

NOT_AVAILABLE, OK, WARNING, FAULT = Status.NOT_AVAILABLE, Status.OK, Status.WARNING, Status.FAULT


def said(log, severity, text, armed=True, autopilot=3):
    flight = log(autopilot=autopilot)
    flight.fly(10.0, 20.0, lambda _: [])
    flight.fly(
        20.0, 60.0, lambda t_s: [("STATUSTEXT", {"severity": severity, "text": text})] if t_s == 40.0 else [], armed=armed
    )
    return flight.findings()


def test_a_failsafe_while_armed_is_a_warning_with_its_time(log):
    found = said(log, 4, "Throttle failsafe on")["failsafe"]
    assert found.status is WARNING
    assert found.t == pytest.approx(40.0, abs=0.1)


@pytest.mark.parametrize("text", ["EKF failsafe cleared", "Throttle failsafe off", "PreArm: Radio failsafe on"])
def test_the_end_of_a_failsafe_or_one_before_arming_is_none(log, text):
    assert said(log, 4, text)["failsafe"].status is OK


def test_texts_on_the_ground_are_not_judged(log):
    found = said(log, 2, "EKF variance", armed=False)
    assert found["texts_known"].status is found["texts_severe"].status is OK


@pytest.mark.parametrize(
    ("text", "meaning", "status"),
    [
        ("EKF3 lane switch 1", "another IMU", WARNING),
        ("EKF variance", "distrusts", WARNING),
        ("Airspeed sensor 1 failure. Disabling", "airspeed", FAULT),
        ("Potential Thrust Loss (3)", "too little thrust", FAULT),
        ("Yaw Imbalance 30%", "yaw", WARNING),
        ("GPS Glitch or Compass error", "GPS", WARNING),
        ("Vibration compensation ON", "vibration", WARNING),
        ("Crash: Disarming", "crash", WARNING),
    ],
)
def test_known_texts_are_told_by_their_meaning(log, text, meaning, status):
    found = said(log, 4, text)["texts_known"]
    assert found.status is status
    assert meaning in found.text
    assert text in found.text


def test_critical_texts_are_a_warning_and_others_are_counted(log):
    assert said(log, 2, "Something new")["texts_severe"].status is WARNING
    fine = said(log, 6, "Mission: 1 Takeoff")["texts_severe"]
    assert fine.status is OK
    assert "1 of severity 6" in fine.text


def test_the_lowest_severity_of_old_ardupilot_is_not_an_alert(log):
    assert said(log, 1, "Reached Command #4")["texts_severe"].status is OK
    assert said(log, 1, "Something burns", autopilot=12)["texts_severe"].status is WARNING


def test_a_log_that_was_never_armed_is_not_judged_by_its_texts(log):
    flight = log()
    flight.fly(10.0, 60.0, lambda _: [("STATUSTEXT", {"severity": 6, "text": "hello"})], armed=False)
    found = flight.findings()
    assert {found[name].status for name in ("failsafe", "texts_known", "texts_severe")} == {NOT_AVAILABLE}
