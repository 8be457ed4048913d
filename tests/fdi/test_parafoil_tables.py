import dataclasses
import math

import pytest

import fdi.parafoil as parafoil

STATUSTEXT_BYTES = 50


def test_every_fault_text_fits_one_statustext_with_its_confidence():
    for fault in parafoil.FAULTS:
        assert len(f"mavfdi: {fault.text} (99.9 %)".encode()) <= STATUSTEXT_BYTES


def test_fault_ids_are_class_and_place_and_unique():
    assert len({fault.id for fault in parafoil.FAULTS}) == len(parafoil.FAULTS)
    for fault in parafoil.FAULTS:
        assert fault.id == ":".join(filter(None, (fault.fault_class, fault.where)))


def test_every_fault_has_a_signature_of_its_own_over_all_residuals():
    assert [signature.fault_id for signature in parafoil.SIGNATURES] == [fault.id for fault in parafoil.FAULTS]
    assert len({tuple(signature.marks.values()) for signature in parafoil.SIGNATURES}) == len(parafoil.FAULTS)
    for signature in parafoil.SIGNATURES:
        assert tuple(signature.marks) == parafoil.RESIDUALS
        assert set(signature.marks.values()) <= {"+", "0", "."}


def test_no_two_signatures_agree_where_both_say_something():
    for first in parafoil.SIGNATURES:
        for second in parafoil.SIGNATURES:
            if first is not second:
                marks = zip(first.marks.values(), second.marks.values(), strict=True)
                assert any({a, b} == {"+", "0"} for a, b in marks)


def test_every_channel_has_limits_and_no_other_name_has():
    assert set(parafoil.LIMITS) == set(parafoil.CHANNELS)
    assert all(low < high for low, high in parafoil.LIMITS.values())


@pytest.mark.parametrize(
    ("table", "key", "value", "sentence"),
    [
        ("paper.windows", "motor_s", -3.0, r"paper.windows.motor_s = -3.0 is no duration; give seconds > 0"),
        ("paper.thresholds", "motor_m", 0.0, r"paper.thresholds.motor_m = 0.0 must be a number above 0"),
        ("paper.isolation", "fallback_s", 2.0, r"fallback_s = 2.0 must be longer than motor_phase_s"),
        ("paper.isolation", "clear_s", 10.0, None),
        ("paper.confidence", "motor", 1.5, r"paper.confidence.motor = 1.5 is no share"),
        ("paper.delays", "any_s", math.inf, r"paper.delays.any_s"),
        ("paper.design", "missed_share", -0.1, r"paper.design.missed_share"),
        ("outputs", "function_right", 77, r"function_left and function_right are both 77"),
        ("motor", "lag_s", math.nan, r"motor.lag_s"),
        ("lateral_model", "input", (0.0, math.nan, 0.0, 1.0), r"lateral_model.input"),
        ("observer", "gain", (0.0, math.inf, 0.0, 1.0), r"observer.gain"),
        ("navigation", "airspeed_m_s", 0.0, r"navigation.airspeed_m_s"),
    ],
)
def test_a_value_that_makes_no_sense_is_refused_in_one_sentence(config, table, key, value, sentence):
    record = config
    for name in table.split("."):
        record = getattr(record, name)
    if sentence is None:  # right in itself, wrong beside the window
        record = dataclasses.replace(record, **{key: value})
        with pytest.raises(ValueError, match="evidence would still be in the window"):
            dataclasses.replace(config.paper, isolation=record)
    else:
        with pytest.raises(ValueError, match=sentence):
            dataclasses.replace(record, **{key: value})


def test_an_unknown_detector_and_a_period_of_nothing_are_refused(config):
    with pytest.raises(ValueError, match="give one of paper"):
        dataclasses.replace(config, detector="crystal ball")
    with pytest.raises(ValueError, match="period_s"):
        dataclasses.replace(config, period_s=0.0)
