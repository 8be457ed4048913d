"""Events as lines: one encoding for equal events, and one answer to whether two recordings tell the same."""

import json
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.events import (
    MAY_DIFFER,
    SEVERITY_MAVLINK,
    Event,
    FaultFacts,
    Kind,
    Severity,
    as_json,
    encode,
    same_events,
    utc_text,
)

CROSSED = FaultFacts("crossed_lines", "crossed_lines", None, 0.997, None, None, 240.0)
ISOLATED = Event(
    Kind.FAULT,
    "isolated",
    Severity.CRITICAL,
    "control lines crossed (99.7 %)",
    t=251.4,
    utc_us=1_767_607_872_400_000,
    reason="the others were ruled out",
    fault=CROSSED,
    evidence={"heading_rate": (0.31, 0.057)},
)
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats()
    | st.text(st.characters(exclude_categories=("Cs",))),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=20,
)


def test_an_event_is_written_as_documented():
    assert encode(as_json(ISOLATED, 17, 1, "parafoil")) == (
        '{"schema":1,"seq":17,"t":251.4,"utc":"2026-01-05T10:11:12.400Z","vehicle":{"sysid":1,"airframe":"parafoil"},'
        '"kind":"fault","name":"isolated","severity":"critical",'
        '"fault":{"id":"crossed_lines","class":"crossed_lines","where":null,"confidence":0.997,"size":null,"unit":null,'
        '"onset_t":240.0},"text":"control lines crossed (99.7 %)",'
        '"evidence":{"heading_rate":{"value":0.31,"threshold":0.057}},"reason":"the others were ruled out"}'
    )


def test_what_is_not_known_is_null_and_what_does_not_apply_is_left_out():
    bare = as_json(Event(Kind.SELF, "started", Severity.INFO, "hello"), 0, None, "parafoil")
    assert bare == {
        "schema": 1,
        "seq": 0,
        "t": None,
        "utc": None,
        "vehicle": {"sysid": None, "airframe": "parafoil"},
        "kind": "self",
        "name": "started",
        "severity": "info",
        "text": "hello",
    }


def test_details_stand_beside_the_rest():
    event = Event(Kind.VEHICLE, "mode", Severity.INFO, "mode 4", details={"mode": 4})
    assert as_json(event, 1, 1, "parafoil")["mode"] == 4


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_none_are_null_wherever_they_stand(value):
    assert encode({"a": value, "b": [value, {"c": value}], "d": 1.5}) == '{"a":null,"b":[null,{"c":null}],"d":1.5}'


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_floats_read_back_to_the_last_bit_and_no_shorter_text_does(value):
    text = encode(value)
    assert struct.pack("<d", json.loads(text)) == struct.pack("<d", value)
    digits = len(text.lstrip("-").replace(".", "").partition("e")[0].strip("0"))
    if digits > 1:
        assert float(f"{value:.{digits - 2}e}") != value


@given(VALUES)
def test_any_event_is_one_line_that_every_reader_of_json_reads_back(value):
    line = encode(value)
    assert "\n" not in line
    assert "\r" not in line
    assert encode(json.loads(line)) == line
    line.encode("utf-8")


def test_text_stays_readable():
    assert encode("Schräglage 30° – ✈ \n\"'\\") == '"Schräglage 30° – ✈ \\n\\"\'\\\\"'


@pytest.mark.parametrize(
    ("utc_us", "text"),
    [
        (0, "1970-01-01T00:00:00.000Z"),
        (1_767_607_872_400_000, "2026-01-05T10:11:12.400Z"),
        (1_767_607_872_999_999, "2026-01-05T10:11:12.999Z"),
        (951_782_400_000_004, "2000-02-29T00:00:00.000Z"),
    ],
)
def test_wall_clock_in_words(utc_us, text):
    assert utc_text(utc_us) == text


def test_severities_are_those_of_mavlink():
    from pymavlink.dialects.v20 import all as mavlink

    assert {severity: getattr(mavlink, f"MAV_SEVERITY_{severity.name}") for severity in Severity} == dict(SEVERITY_MAVLINK)


# -- the same or not --------------------------------------------------------------------------------------------------


def recording(*events, first_seq=0, utc_us=0):
    lines = [as_json(Event(Kind.RUN, "started", Severity.INFO, "", utc_us=utc_us), first_seq, None, "parafoil")]
    lines += [as_json(event, first_seq + 1 + k, 1, "parafoil") for k, event in enumerate(events)]
    lines.append(as_json(Event(Kind.END, "stopped", Severity.INFO, "", utc_us=utc_us), first_seq + 99, 1, "parafoil"))
    return [json.loads(encode(line)) for line in lines]


ARMED = Event(Kind.VEHICLE, "armed", Severity.NOTICE, "the vehicle is armed", t=10.0)


def test_the_same_happening_recorded_twice_is_the_same():
    live, replayed = recording(ARMED, ISOLATED), recording(ARMED, ISOLATED, first_seq=5, utc_us=123_000_000)
    assert same_events(live, replayed) is None


def test_what_may_differ_and_what_a_run_says_of_itself_is_passed_over():
    own = Event(Kind.SELF, "overload", Severity.WARNING, "busy")
    rotated = Event(Kind.LOG, "rotated", Severity.INFO, "new file")
    here, there = recording(ARMED, own, ISOLATED), recording(rotated, ARMED, ISOLATED)
    for name in MAY_DIFFER:
        here[1][name] = f"some {name}"
    assert same_events(here, there) is None


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("t", 251.5),
        ("name", "changed"),
        ("severity", "warning"),
        ("reason", ""),
        ("text", "x"),
        ("evidence", {}),
        ("extra", 1),
    ],
)
def test_the_first_difference_is_told_with_its_place_and_both_values(field, value):
    here, there = recording(ARMED, ISOLATED, ISOLATED), recording(ARMED, ISOLATED, ISOLATED)
    there[2][field] = value
    there[3]["text"] = "a later difference"
    told = same_events(here, there)
    assert told.startswith("event 1 (fault/isolated): " + field)
    assert repr(value) in told
    assert repr(here[2].get(field)) in told


def test_a_difference_inside_a_fault_counts():
    here, there = recording(ISOLATED), recording(ISOLATED)
    there[1]["fault"]["confidence"] = 0.996
    assert "fault is" in same_events(here, there)


def test_events_without_a_partner_are_told():
    here, there = recording(ARMED, ISOLATED), recording(ARMED)
    told = same_events(here, there)
    assert told == same_events(here, iter(there))
    assert "2 and 1 events" in told
    assert "fault/isolated" in told
    assert "1 and 2 events" in same_events(there, here)


def test_the_order_counts():
    assert same_events(recording(ARMED, ISOLATED), recording(ISOLATED, ARMED)) is not None


def test_nothing_is_the_same_as_nothing():
    assert same_events([], []) is None
    assert same_events(recording(), recording()) is None
