"""What is said of a run as a whole, from the effects of its core alone."""

import json

import numpy as np
import pytest

from companion import airframe as airframes
from companion.align import GridRow
from companion.core import Core
from companion.decision import Policy
from companion.effects import Judged, Save, Send, Tell
from companion.events import Event, FaultFacts, Kind, Severity, encode
from companion.journal import Journal, counters, summary
from companion.recovery import Recovery, Stage
from fdi.verdict import NO_FAULT, Phase, Verdict

UTC_US = 1_767_225_600_000_000


@pytest.fixture(scope="module")
def airframe():
    return airframes.load("parafoil")


def judged(phase):
    one, none = np.zeros(1), np.zeros((1, 0))
    verdict = Verdict(
        phase=np.array([int(phase)]), fault=np.array([NO_FAULT]), confidence=one, size=one, onset_s=one, residuals=none,
        thresholds=np.zeros(0), signals=none,
    )  # fmt: skip
    return Judged(GridRow(0, none, none, None), verdict)


def told(kind, name, t=1.0, fault=None):
    return Tell(Event(kind, name, Severity.WARNING, f"{name}.", t=t, utc_us=UTC_US + round(1e6 * t), fault=fault))


def facts(fault_id="motor:left"):
    return FaultFacts(fault_id, fault_id.partition(":")[0], "left", 0.99, None, None, 0.5)


def test_every_event_is_numbered_without_gaps_whatever_effects_lie_between(airframe):
    journal = Journal(airframe)
    journal.begin(UTC_US, {"seed": 3})
    lines = journal.take(
        [told(Kind.VEHICLE, "seen"), Send("HEARTBEAT", {}), judged(Phase.HEALTHY), Save("x"), told(Kind.LINK, "up")], 7
    )
    journal.take([], 7)
    journal.end(UTC_US, "SIGINT", {"core.rows": 1})
    assert [line["seq"] for line in journal.lines] == [0, 1, 2, 3]
    assert lines == journal.lines[1:3]
    assert [line["vehicle"]["sysid"] for line in journal.lines] == [None, 7, 7, None]
    assert {line["vehicle"]["airframe"] for line in journal.lines} == {"parafoil"}


def test_the_first_line_tells_version_configuration_and_what_the_run_adds_the_last_why_and_counters(airframe):
    journal = Journal(airframe)
    first = journal.begin(UTC_US, {"policy": "auto", "seed": 3})
    last = journal.end(UTC_US, "duration reached", {"core.rows": 5})
    assert (first["kind"], first["version"], first["policy"], first["seed"]) == ("run", "0.1.0", "auto", 3)
    assert first["config_sha256"] == airframe.source.digest
    assert first["path"] == ["configs/parafoil.toml"]
    assert (last["kind"], last["text"], last["counters"]) == ("end", "run ends: duration reached", {"core.rows": 5})
    assert last["t"] is None
    assert all(json.loads(encode(line)) == line for line in journal.lines)


def test_the_verdict_is_not_judged_until_a_row_was_judged_and_then_as_bad_as_the_worst_that_happened(airframe):
    journal = Journal(airframe)
    assert journal.verdict == "not_judged"
    journal.take([judged(Phase.WARMING)], 1)
    assert journal.verdict == "not_judged"
    journal.take([judged(Phase.HEALTHY)], 1)
    assert journal.verdict == "healthy"
    journal.take([told(Kind.FAULT, "detected"), judged(Phase.DETECTED)], 1)
    assert journal.verdict == "degraded"
    journal.take([told(Kind.FAULT, "cleared")], 1)
    assert journal.verdict == "degraded"
    journal.take([told(Kind.FAULT, "isolated", fault=facts())], 1)
    assert journal.verdict == "fault"
    assert (journal.rows_judged, journal.alarms) == (2, 1)


def test_a_link_or_a_check_is_no_alarm(airframe):
    journal = Journal(airframe)
    journal.take([told(Kind.LINK, "lost"), told(Kind.CHECK, "stream_missing"), judged(Phase.HEALTHY)], 1)
    assert (journal.verdict, journal.alarms, journal.faults) == ("healthy", 0, [])


def test_each_fault_has_the_time_of_its_own_detection_and_of_its_naming(airframe):
    journal = Journal(airframe)
    journal.take(
        [
            told(Kind.FAULT, "detected", 10.0), told(Kind.FAULT, "isolated", 15.0, facts("motor:left")),
            told(Kind.FAULT, "changed", 18.0, facts("motor:right")), told(Kind.FAULT, "cleared", 40.0),
            told(Kind.FAULT, "detected", 50.0), told(Kind.FAULT, "isolated", 51.0, facts("crossed_lines")),
        ],
        1,
    )  # fmt: skip
    assert [(fault["id"], fault["detected_t"], fault["isolated_t"]) for fault in journal.faults] == [
        ("motor:left", 10.0, 15.0), ("motor:right", 10.0, 18.0), ("crossed_lines", 50.0, 51.0),
    ]  # fmt: skip
    assert journal.faults[0]["detected_utc_us"] == UTC_US + 10_000_000
    assert journal.alarms == 2


def test_a_fault_named_in_the_row_that_detects_it_is_detected_then(airframe):
    journal = Journal(airframe)
    journal.take([told(Kind.FAULT, "isolated", 15.0, facts())], 1)
    assert (journal.faults[0]["detected_t"], journal.faults[0]["isolated_t"]) == (15.0, 15.0)


def test_the_summary_has_the_promised_keys_and_what_its_caller_adds(airframe):
    core, journal = Core(airframe, Policy.AUTO), Journal(airframe)
    content = summary(journal, core, {})
    assert list(content) == [
        "schema", "airframe", "seed", "injected", "verdict", "alarms", "faults", "recovery", "counters",
    ]  # fmt: skip
    assert (content["verdict"], content["recovery"], content["seed"]) == ("not_judged", None, None)
    assert summary(journal, core, {"seed": 4, "counters": {"a": 1}}) == content | {"seed": 4, "counters": {"a": 1}}


def test_the_summary_tells_how_a_recovery_ended_and_why(airframe):
    core, journal = Core(airframe, Policy.AUTO), Journal(airframe)
    core.recovery = Recovery("crossed_lines", Stage.REFUSED, reason="SERVO1_FUNCTION does not answer")
    assert summary(journal, core, {})["recovery"] == {"state": "refused", "reason": "SERVO1_FUNCTION does not answer"}
    core.recovery = Recovery("crossed_lines", Stage.VERIFYING)
    assert summary(journal, core, {})["recovery"] == {"state": "verifying", "reason": "watching whether it helps"}


def test_counters_name_the_part_that_counted(airframe):
    core = Core(airframe, Policy.OFF)
    core.counts["rows"] += 2
    core.decoder.counts["absurd"] += 1
    core.aligner.counts["off_clock"] += 3
    assert counters(core) == {"core.rows": 2, "decode.absurd": 1, "align.off_clock": 3}
