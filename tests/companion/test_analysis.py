"""A log decided again: what it says, under which policy, and whether the run that recorded it decided the same."""

import sys

import pytest

from companion.analysis import Part, analyze, by_type, facts
from companion.decision import Policy
from companion.dialect import encode
from companion.errors import UserError
from companion.events import same_events
from companion.tlog import LINK_MASK, OWN_LINK, Reader, record
from companion.vehicle import Heartbeat
from tests.system.flights import CROSSED, Flight, names, parafoil

SEED = 6


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A crossed flight under policy auto, and its log."""
    flight = Flight(SEED, CROSSED, keep_log=True).fly()
    path = tmp_path_factory.mktemp("log") / "flight.tlog"
    path.write_bytes(flight.rehearsal.log)
    return flight, path


def analyzed(path, **options):
    return analyze(path, lambda _: parafoil(), **options)


def rewritten(path, tmp_path, change):
    """The log with each record as `change(record)` makes it; b"" leaves it out."""
    out = tmp_path / "changed.tlog"
    out.write_bytes(b"".join(change(one) for one in Reader(path)))
    return out


def as_it_was(one):
    return record(one.stamp_us & ~LINK_MASK, one.link, one.frame.raw)


def test_the_log_of_a_run_tells_its_policy_its_events_and_its_sends(flown):
    flight, path = flown
    found = analyzed(path)
    assert found.replay.core.policy is Policy.AUTO
    assert same_events(flight.lines, found.replay.journal.lines) is None
    sent = [send for send in flight.sends if send.message not in ("HEARTBEAT", "TIMESYNC")]
    assert found.content["replay"] == {
        "sends": len(sent),
        "sends_recorded": len(sent),
        "same_sends": True,
        "same_settings": True,
    }


def test_a_log_without_what_a_companion_sent_is_decided_as_advice(flown, tmp_path):
    flight, path = flown
    alone = rewritten(path, tmp_path, lambda one: as_it_was(one) if one.link != OWN_LINK else b"")
    found = analyzed(alone)
    assert found.replay.core.policy is Policy.ADVISE
    assert "replay" not in found.content
    assert names(found.replay.journal.lines, "recovery") == ["recovery/advised"]
    # The vehicle's own words about its outputs are believed whoever changed them: no alarm stands after the swap.
    assert found.content["faults"][0]["detected_t"] == flight.time("fault/detected")
    assert len(found.content["faults"]) == 1


@pytest.mark.parametrize("missing", ["PARAM_SET", "STATUSTEXT", "COMMAND_LONG"])
def test_a_run_that_did_not_send_what_the_replay_would_is_found_out(missing, flown, tmp_path):
    _, path = flown
    changed = rewritten(
        path, tmp_path, lambda one: b"" if one.link == OWN_LINK and one.frame.name == missing else as_it_was(one)
    )  # fmt: skip
    assert analyzed(changed).content["replay"]["same_sends"] is False


def test_a_policy_that_is_given_outranks_the_recorded_one(flown):
    _, path = flown
    found = analyzed(path, policy=Policy.OFF)
    assert names(found.replay.journal.lines, "recovery") == []
    assert found.content["replay"]["same_sends"] is False


def test_own_frames_of_another_program_on_the_last_link_are_not_taken_for_the_companions(flown, tmp_path):
    """MAVProxy, too, marks what it sent itself by the last link number."""
    flight, path = flown
    beat = encode("HEARTBEAT", {"type": 6, "autopilot": 8, "custom_mode": 2}, sysid=255, compid=230, seq=0)

    def change(one):
        foreign = record(one.stamp_us & ~LINK_MASK, OWN_LINK, beat) if one.frame.name == "HEARTBEAT" else b""
        return foreign + (as_it_was(one) if one.link != OWN_LINK else b"")

    found = analyzed(rewritten(path, tmp_path, change))
    assert found.replay.core.policy is Policy.ADVISE
    assert found.replay.recorded == []
    assert found.content["faults"][0]["isolated_t"] == flight.time("fault/isolated")


def test_stamps_that_run_back_or_are_nonsense_now_and_then_change_no_fault(flown, tmp_path):
    flight, path = flown

    def change(one):
        stamp_us = one.stamp_us & ~LINK_MASK
        if one.frame.seq % 50 == 7:
            stamp_us = 400
        elif one.frame.seq % 50 == 8:
            stamp_us -= 3_000_000
        return record(stamp_us, one.link, one.frame.raw)

    found = analyzed(rewritten(path, tmp_path, change))
    assert found.content["reader"]["stamps_implausible"] > 100
    assert found.content["reader"]["stamps_backward"] > 100
    assert names(found.replay.journal.lines) == flight.names()
    assert [fault["id"] for fault in found.content["faults"]] == ["crossed_lines"]


def test_in_a_log_without_any_stamps_no_vehicle_is_chosen_and_no_event_made_up(flown, tmp_path):
    """Without arrival stamps no time passes."""
    _, path = flown
    bare = rewritten(path, tmp_path, lambda one: one.frame.raw if one.link != OWN_LINK else b"")
    found = analyzed(bare)
    assert (found.content["duration_s"], found.content["faults"], found.content["events"]) == (None, [], [])
    assert found.replay.core.watch.sysid is None
    assert found.content["reader"]["unstamped"] == sum(found.content["reader"]["messages"].values())


def test_the_same_comes_out_without_the_compiled_reader(flown, monkeypatch):
    _, path = flown
    monkeypatch.setattr("companion.analysis.COMPILED_FROM_BYTES", 0)
    expected = analyzed(path).content
    assert "companion.columns" in sys.modules
    for name in ("companion.columns", "companion.walk"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    progress = []
    assert analyzed(path, progress=progress.append).content == expected
    assert facts(path) == {name: expected[name] | {} for name in ("log", "reader")} | {
        "schema": 1, "duration_s": expected["duration_s"],
        "vehicles": [vehicle | {"airframe": None} for vehicle in expected["vehicles"]],
    }  # fmt: skip
    assert "companion.columns" not in sys.modules
    assert progress[0] == 0


def test_the_vehicles_of_a_log_are_those_that_fly_not_ground_stations_companions_or_gimbals(flown, tmp_path):
    _, path = flown
    others = [
        encode("HEARTBEAT", {"type": kind, "autopilot": autopilot}, sysid=sysid, compid=compid, seq=0)
        for kind, autopilot, sysid, compid in (
            (6, 8, 255, 190),
            (26, 3, 1, 154),
            (18, 3, 1, 191),
            (2, 12, 9, 1),
            (2, 8, 1, 99),
        )
    ]
    extra = b"".join(record(1_767_225_600_000_000, 0, raw) for raw in others)
    log = tmp_path / "several.tlog"
    log.write_bytes(path.read_bytes() + extra)
    found = analyzed(log)
    assert [(one["sysid"], one["compid"], one["type"], one["airframe"]) for one in found.content["vehicles"]] == [
        (1, 1, 28, "parafoil"), (9, 1, 2, None),
    ]  # fmt: skip


def beat(kind):
    return Heartbeat(sysid=1, compid=1, autopilot=3, type=kind, armed=False, mode=0)


def test_the_airframe_is_chosen_by_the_type_that_its_configuration_names(tmp_path):
    assert by_type([beat(2), beat(28)]).name == "parafoil"
    mine = tmp_path / "mine.toml"
    mine.write_text("[vehicle]\nmav_types = [2]\n", encoding="utf-8")
    assert by_type([beat(2)], mine).name == "parafoil"


def test_a_type_that_nobody_names_and_a_log_without_heartbeats_have_no_airframe():
    assert by_type([beat(2)]) is None
    assert by_type([]) is None


def test_a_vehicle_without_an_airframe_has_its_checks_and_no_events(flown):
    _, path = flown
    found = analyze(path, lambda _: None)
    assert found.replay is None
    assert (found.content["events"], found.content["faults"]) == ([], [])
    assert found.content["vehicles"][0]["airframe"] is None
    assert "replay" not in found.content
    assert len(found.content["checks"]) > 3


def cut(path, tmp_path, begin_s, end_s):
    """The log as it would be had it been recorded from begin_s to end_s alone."""
    first_us = next(iter(Reader(path))).stamp_us & ~LINK_MASK
    inside = range(first_us + round(begin_s * 1e6), first_us + round(end_s * 1e6))
    return rewritten(path, tmp_path, lambda one: as_it_was(one) if one.stamp_us & ~LINK_MASK in inside else b"")


def test_a_part_in_time_is_analysed_as_a_log_that_holds_no_more(flown, tmp_path):
    flight, path = flown
    end_s = flight.time("fault/detected") - 5.0
    part = analyzed(path, part=Part(5.0, end_s)).content
    alone = analyzed(cut(path, tmp_path, 5.0, end_s)).content
    assert part.pop("part") == {"from_s": 5.0, "to_s": end_s, "systems": []}
    alone.pop("replay", None)
    assert part.pop("log")["path"] == str(path)
    alone.pop("log")
    assert part == alone
    assert part["faults"] == []
    assert part["duration_s"] == pytest.approx(end_s - 5.0, abs=0.15)  # whole steps of the simulator


def test_a_part_by_systems_is_analysed_as_a_log_of_these_alone(flown, tmp_path):
    _, path = flown
    stranger = encode("HEARTBEAT", {"type": 2, "autopilot": 3}, sysid=9, compid=1, seq=0)
    log = tmp_path / "two.tlog"
    log.write_bytes(record(1_767_225_600_000_000, 0, stranger) + path.read_bytes())
    assert [one["sysid"] for one in analyzed(log).content["vehicles"]] == [9, 1]
    part = analyzed(log, part=Part(systems=frozenset({1}))).content
    whole = analyzed(path).content
    assert {name: part[name] for name in ("reader", "vehicles", "verdict", "faults", "checks", "events", "replay")} == {
        name: whole[name] for name in ("reader", "vehicles", "verdict", "faults", "checks", "events", "replay")
    }


def test_a_part_that_holds_nothing_is_a_users_mistake_that_says_what_there_is(flown, tmp_path):
    _, path = flown
    with pytest.raises(UserError, match=r"it holds \d+\.\d s, systems 1"):
        analyzed(path, part=Part(from_s=1e5))
    with pytest.raises(UserError, match="systems 1"):
        analyzed(path, part=Part(systems=frozenset({7})))
    bare = rewritten(path, tmp_path, lambda one: one.frame.raw)
    with pytest.raises(UserError, match="has a stamp"):
        analyzed(bare, part=Part(to_s=5.0))


def test_damage_is_counted_for_the_whole_file_whatever_part_is_looked_at(flown, tmp_path):
    _, path = flown
    log = tmp_path / "cut.tlog"
    log.write_bytes(path.read_bytes()[:-3])
    reader = analyzed(log, part=Part(0.0, 10.0)).content["reader"]
    assert reader["tail_bytes"] > 0
    assert sum(reader["messages"].values()) < 5000
