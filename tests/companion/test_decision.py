"""Everything that can be decided, enumerated: less evidence or less freedom never gives a stronger action."""

import itertools
import math
from dataclasses import replace

import pytest

from companion.decision import Action, Facts, Finding, Memory, Policy, Rules, decide
from fdi.verdict import Phase

RULES = Rules(least_confidence=0.9, hold_s=3.0, repeat_s=30.0)
S = 1_000_000
NOW_US = 100 * S
FAULT = "crossed_lines"

WEAK_TO_STRONG = (
    Finding(Phase.WARMING),
    Finding(Phase.HEALTHY),
    Finding(Phase.INCONCLUSIVE),
    Finding(Phase.DETECTED),
    Finding(Phase.ISOLATED),  # and no name
    Finding(Phase.ISOLATED, FAULT, math.nan),
    Finding(Phase.ISOLATED, FAULT, 0.0),
    Finding(Phase.ISOLATED, FAULT, 0.899_999),
    Finding(Phase.ISOLATED, FAULT, 0.9),
    Finding(Phase.ISOLATED, FAULT, 1.0),
)
MEMORIES = (
    Memory(),
    Memory(FAULT, NOW_US),
    Memory(FAULT, NOW_US - 3 * S + 1),
    Memory(FAULT, NOW_US - 3 * S),
    Memory(FAULT, NOW_US - 60 * S),
    Memory("motor:left", NOW_US - 60 * S),
    Memory(FAULT, NOW_US - 60 * S, frozenset({FAULT})),
    Memory(FAULT, NOW_US - 60 * S, frozenset({"motor:left"})),
)
POLICIES = (Policy.OFF, Policy.ADVISE, Policy.AUTO)
FLAGS = ("armed", "link_up", "mendable", "busy", "confirmed")


def every_facts():
    for policy in POLICIES:
        for flags in itertools.product((False, True), repeat=len(FLAGS)):
            yield Facts(now_us=NOW_US, policy=policy, **dict(zip(FLAGS, flags, strict=True)))


EVERY_FACTS = tuple(every_facts())


def action(memory, finding, facts):
    return decide(memory, finding, facts, RULES)[1].action


def test_less_evidence_never_gives_a_stronger_action():
    for memory, facts in itertools.product(MEMORIES, EVERY_FACTS):
        actions = [action(memory, finding, facts) for finding in WEAK_TO_STRONG]
        assert actions == sorted(actions), (memory, facts)


def test_less_freedom_never_gives_a_stronger_action():
    for memory, finding, facts in itertools.product(MEMORIES, WEAK_TO_STRONG, EVERY_FACTS):
        actions = [action(memory, finding, replace(facts, policy=policy)) for policy in POLICIES]
        assert actions == sorted(actions), (memory, finding, facts)


@pytest.mark.parametrize(("flag", "hinders"), [("armed", False), ("link_up", False), ("mendable", False), ("busy", True)])
def test_a_worse_situation_never_gives_a_stronger_action(flag, hinders):
    for memory, finding, facts in itertools.product(MEMORIES, WEAK_TO_STRONG, EVERY_FACTS):
        worse = action(memory, finding, replace(facts, **{flag: hinders}))
        better = action(memory, finding, replace(facts, **{flag: not hinders}))
        assert worse <= better, (memory, finding, facts)


def test_a_shorter_isolation_never_gives_a_stronger_action():
    by_age = sorted(
        (memory for memory in MEMORIES if memory.fault_id == FAULT and not memory.tried), key=lambda m: -m.since_us
    )
    for finding, facts in itertools.product(WEAK_TO_STRONG, EVERY_FACTS):
        actions = [action(memory, finding, facts) for memory in by_age]
        assert actions == sorted(actions), (finding, facts)


def test_it_recovers_if_and_only_if_everything_speaks_for_it():
    recovered = 0
    for memory, finding, facts in itertools.product(MEMORIES, WEAK_TO_STRONG, EVERY_FACTS):
        free = facts.policy is Policy.AUTO or (facts.policy is Policy.ADVISE and facts.confirmed)
        sure = finding.phase is Phase.ISOLATED and finding.fault_id == FAULT and finding.confidence >= 0.9
        held = memory.fault_id == FAULT and NOW_US - memory.since_us >= 3 * S
        may = facts.armed and facts.link_up and facts.mendable and not facts.busy and FAULT not in memory.tried
        expected = free and sure and held and may
        assert (action(memory, finding, facts) is Action.RECOVER) == expected, (memory, finding, facts)
        recovered += expected
    assert recovered == 3 * 2 * 3  # memories held long enough, findings sure enough, facts free enough


def test_unarmed_nothing_is_done_and_everything_is_forgotten():
    for memory, finding, facts in itertools.product(MEMORIES, WEAK_TO_STRONG, EVERY_FACTS):
        if not facts.armed:
            after, decision = decide(memory, finding, facts, RULES)
            assert (after, decision.action) == (Memory(), Action.NONE)


def test_an_alarm_is_always_at_least_a_warning_while_armed():
    for memory, finding, facts in itertools.product(MEMORIES, WEAK_TO_STRONG, EVERY_FACTS):
        if facts.armed:
            quiet = finding.phase in (Phase.WARMING, Phase.HEALTHY)
            assert (action(memory, finding, facts) is Action.NONE) == quiet


def test_every_decision_has_its_reason():
    for memory, finding, facts in itertools.product(MEMORIES, WEAK_TO_STRONG, EVERY_FACTS):
        assert decide(memory, finding, facts, RULES)[1].because


def test_what_is_remembered_is_what_was_isolated_or_tried():
    for memory, finding, facts in itertools.product(MEMORIES, WEAK_TO_STRONG, EVERY_FACTS):
        after, decision = decide(memory, finding, facts, RULES)
        if not facts.armed:
            continue
        named = finding.phase is Phase.ISOLATED and finding.fault_id is not None
        assert after.fault_id == (finding.fault_id if named else None)
        assert after.tried - memory.tried == ({FAULT} if decision.action is Action.RECOVER else set())
        assert after.tried >= memory.tried


def fly(findings, **changes):
    """Rows of a tenth of a second; -> the actions."""
    facts = Facts(now_us=0, armed=True, link_up=True, policy=Policy.AUTO, mendable=True, busy=False)
    memory, actions = Memory(), []
    for k, finding in enumerate(findings):
        here = replace(facts, now_us=k * S // 10, **{name: value(k) for name, value in changes.items()})
        memory, decision = decide(memory, finding, here, RULES)
        actions.append(decision.action)
    return actions


SURE = Finding(Phase.ISOLATED, FAULT, 0.99)


def test_a_standing_fault_is_acted_upon_after_its_hold_and_once_per_flight():
    actions = fly([SURE] * 1000)
    assert actions.index(Action.RECOVER) == 30
    assert actions.count(Action.RECOVER) == 1
    assert set(actions[:30]) == {Action.ADVISE}
    assert set(actions[31:]) == {Action.WARN}


@pytest.mark.parametrize(
    "other", [Finding(Phase.HEALTHY), Finding(Phase.DETECTED), Finding(Phase.ISOLATED, "motor:left", 0.99)]
)
def test_a_break_of_one_row_begins_the_hold_anew(other):
    actions = fly([SURE] * 29 + [other] + [SURE] * 100)
    assert actions.index(Action.RECOVER) == 60


def test_a_dip_of_confidence_is_no_break_but_gives_no_action_either():
    actions = fly([SURE] * 29 + [replace(SURE, confidence=0.5)] * 10 + [SURE])
    assert actions[29:] == [Action.WARN] * 10 + [Action.RECOVER]


def test_after_disarming_the_same_fault_may_be_tried_again():
    actions = fly([SURE] * 200, armed=lambda k: k != 100)
    assert [k for k, done in enumerate(actions) if done is Action.RECOVER] == [30, 131]


def test_another_fault_of_the_same_flight_has_its_own_attempt():
    actions = fly([SURE] * 50 + [Finding(Phase.ISOLATED, "motor:left", 0.99)] * 50 + [SURE] * 50)
    assert [k for k, done in enumerate(actions) if done is Action.RECOVER] == [30, 80]


def test_the_attempt_waits_for_a_confirmation_under_advise():
    actions = fly([SURE] * 100, policy=lambda _: Policy.ADVISE, confirmed=lambda k: k == 70)
    assert set(actions[:70]) == {Action.ADVISE}
    assert actions[70] is Action.RECOVER
    assert set(actions[71:]) == {Action.WARN}


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"least_confidence": 1.1}, "no probability"),
        ({"least_confidence": -0.1}, "no probability"),
        ({"least_confidence": math.nan}, "no probability"),
        ({"hold_s": -1.0}, "hold_s"),
        ({"repeat_s": 0.0}, "repeat_s"),
    ],
)
def test_rules_that_make_no_sense_are_refused(changes, complaint):
    with pytest.raises(ValueError, match=complaint):
        replace(RULES, **changes)
