"""The rules of a recovery, each by example; then every order in which a vehicle, a link and an operator can spoil it.

The enumeration walks breadth first through all reachable states of the machine beside a model of the autopilot, and asks
at every end whether what the machine says is true of the vehicle.
"""

import math
from collections import Counter, deque
from dataclasses import replace
from enum import Enum
from typing import NamedTuple

import pytest

from companion import recovery as recoveries
from companion.effects import Save, Send
from companion.recovery import ENDED, UNDO_ROUNDS, Evidence, Plan, Recovery, Said, Stage

LEFT, RIGHT = "SERVO1_FUNCTION", "SERVO2_FUNCTION"
MIN_LEFT, MIN_RIGHT = "SERVO1_MIN", "SERVO2_MIN"
INT16, REAL32 = 4, 9
S = 1_000_000


def plan(**changes):
    values = {
        "action": "swap_parameters",
        "parameters": (LEFT, RIGHT),
        "must_agree": (),
        "text": "swapping control lines",
        "answer_s": 1.0,
        "tries": 2,
        "undo_tries": 2,
        "verify_residual": "heading_rate",
        "verify_s": 20.0,
        "settle_s": 3.0,
        "excitation_signal": "turn_rate_command_rad_s",
        "excitation_least": 0.15,
        "excitation_s": 3.0,
    }
    return Plan(**{**values, **changes})


PLAN = plan()
CAREFUL = plan(must_agree=((MIN_LEFT, MIN_RIGHT),))


class Run:
    """One recovery by hand: `at` moves the clock, what it sends and saves is kept in order."""

    def __init__(self, chosen=PLAN, at_s=0.0):
        self.plan, self.now_us, self.done = chosen, round(at_s * S), []
        self.state, effects = recoveries.begin(chosen, "crossed_lines", self.now_us)
        self._do(effects)

    def _do(self, effects):
        self.last = effects
        self.done += effects
        return self

    def _take(self, output):
        self.state, effects = output
        return self._do(effects)

    def hears(self, name, value, kind=INT16):
        return self._take(recoveries.hear(self.state, self.plan, Said(name, value, kind), self.now_us))

    def waits(self, seconds):
        self.now_us += round(seconds * S)
        return self._take(recoveries.tick(self.state, self.plan, self.now_us))

    def refused(self, name, code=2):
        return self._take(recoveries.refused_by_vehicle(self.state, self.plan, name, code, self.now_us))

    def sees(self, *, judging=True, alarm=False, clear=True, excitation=0.2, period_s=0.1):
        self.now_us += round(period_s * S)
        row = Evidence(judging, alarm, clear, excitation, round(period_s * S))
        return self._take(recoveries.judge(self.state, self.plan, row, self.now_us))

    def told(self, what):
        return self._take(what(self.state, self.plan, self.now_us))

    def read(self, left=77.0, right=78.0):
        return self.hears(LEFT, left).hears(RIGHT, right)

    def swapped(self):
        """Both set and echoed; being read back."""
        return self.read().hears(LEFT, 78.0).hears(RIGHT, 77.0).waits(2.0)

    def verifying(self):
        return self.swapped().hears(LEFT, 78.0).hears(RIGHT, 77.0)

    def done_well(self):
        """Swapped and verified."""
        self.verifying().waits(3.0)
        for _ in range(200):
            self.sees()
        assert self.stage is Stage.DONE
        return self

    def undo_read(self):
        """Let the late answers run out, so that the reading back begins."""
        assert self.stage is Stage.UNDO_CHECKING
        assert self.waits(1.999_999).last == []
        return self.waits(0.000_001)

    @property
    def stage(self):
        return self.state.stage

    @property
    def sets(self):
        """(name, value) of every PARAM_SET so far."""
        return [
            (effect.fields["param_id"], effect.fields["param_value"])
            for effect in self.done
            if isinstance(effect, Send) and effect.message == "PARAM_SET"
        ]

    @property
    def asked(self):
        """Names asked for by the last step."""
        return [
            effect.fields["param_id"]
            for effect in self.last
            if isinstance(effect, Send) and effect.message == "PARAM_REQUEST_READ"
        ]

    @property
    def kept(self):
        """The record that a kill would leave now; empty if there is none."""
        return next((effect.record for effect in reversed(self.done) if isinstance(effect, Save)), "")


# -- the rules, one by one --------------------------------------------------------------------------------------------


def test_everything_is_read_before_anything_is_changed():
    run = Run(CAREFUL)
    assert run.asked == [LEFT, RIGHT, MIN_LEFT, MIN_RIGHT]
    run.read().hears(MIN_LEFT, 1000.0)
    assert run.sets == []
    assert run.kept == ""
    run.hears(MIN_RIGHT, 1000.0)
    assert run.sets == [(LEFT, 78.0)]


def test_the_record_naming_the_parameter_is_saved_before_each_parameter_is_sent():
    run = Run().read()
    for touched in (1, 2):
        save, send = run.last
        assert isinstance(save, Save)
        assert isinstance(send, Send)
        record = recoveries.from_record(save.record)
        assert record.touched == touched
        assert record.original == (77.0, 78.0)
        run.hears(LEFT, 78.0)


def test_parameters_keep_the_type_that_the_vehicle_told():
    run = Run().hears(LEFT, 77.0, INT16).hears(RIGHT, 78.0, REAL32)
    assert run.last[1].fields["param_type"] == INT16
    run.hears(LEFT, 78.0)
    assert run.last[1].fields["param_type"] == REAL32


def test_the_second_request_leaves_as_soon_as_the_first_is_echoed():
    run = Run().read()
    at_us = run.now_us
    run.hears(LEFT, 78.0)
    assert run.sets == [(LEFT, 78.0), (RIGHT, 77.0)]
    assert run.now_us == at_us


def test_a_swap_that_is_taken_read_back_and_verified_is_done_and_clears_its_record():
    run = Run().verifying()
    assert run.stage is Stage.VERIFYING
    run.waits(3.0)
    for _ in range(200):
        assert run.stage is Stage.VERIFYING
        run.sees()
    assert run.stage is Stage.DONE
    assert run.kept == ""
    assert run.sets == [(LEFT, 78.0), (RIGHT, 77.0)]


def test_an_echo_counts_by_name_and_value():
    run = Run().read()
    run.hears(RIGHT, 78.0).hears("SERVO3_FUNCTION", 78.0).hears(LEFT, 77.0).hears(LEFT, math.nan)
    assert run.stage is Stage.SETTING
    assert run.state.place == 0
    assert run.sets == [(LEFT, 78.0)]


def test_a_different_value_may_be_an_older_echo_and_the_deadline_decides():
    run = Run().read().hears(LEFT, 77.0)
    assert run.last == []
    run.waits(0.5)
    assert run.last == []
    run.hears(LEFT, 78.0)
    assert run.sets[-1] == (RIGHT, 77.0)


def test_a_parameter_that_is_not_echoed_is_sent_again_and_then_put_back_because_silence_is_not_unchanged():
    run = Run().read().waits(1.0)
    assert run.sets == [(LEFT, 78.0)] * 2
    run.waits(0.999_999)
    assert run.stage is Stage.SETTING
    run.waits(0.000_001)
    assert run.stage is Stage.UNDOING
    assert run.sets == [(LEFT, 78.0), (LEFT, 78.0), (LEFT, 77.0)]
    assert "not taken" in run.state.reason


def test_values_are_compared_as_the_float32_that_the_wire_carries():
    run = Run().read(left=0.1, right=0.2)
    run.hears(LEFT, 0.20000000298023224).hears(RIGHT, 0.10000000149011612)
    assert run.stage is Stage.CHECKING


def test_what_is_put_back_counts_by_name_and_value_too():
    run = Run().verifying().told(recoveries.veto)
    for name, value in ((RIGHT, 77.0), (LEFT, 77.0), (LEFT, 78.0), (RIGHT, math.nan)):
        assert run.hears(name, value).last == []
    assert (run.stage, run.state.place) == (Stage.UNDOING, 1)


def test_both_are_put_back_the_last_touched_first():
    run = Run().verifying().told(recoveries.veto).hears(RIGHT, 78.0)
    assert run.sets[2:] == [(RIGHT, 78.0), (LEFT, 77.0)]


def test_one_that_does_not_answer_keeps_the_other_from_nothing():
    run = Run().verifying().told(recoveries.veto).waits(1.0).waits(1.0)
    assert run.sets[2:] == [(RIGHT, 78.0), (RIGHT, 78.0), (LEFT, 77.0)]


def test_nothing_is_called_rolled_back_before_both_have_been_read_back():
    run = Run().verifying().told(recoveries.veto).hears(RIGHT, 78.0).hears(LEFT, 77.0)
    run.undo_read()
    assert run.asked == [LEFT, RIGHT]
    run.hears(LEFT, 77.0)
    assert run.stage is Stage.UNDO_CHECKING
    run.hears(RIGHT, 78.0)
    assert run.stage is Stage.ROLLED_BACK
    assert run.kept == ""


def test_what_is_still_under_way_from_before_is_no_reading_back():
    run = Run().read().told(recoveries.veto).hears(LEFT, 77.0)
    run.hears(LEFT, 77.0).hears(RIGHT, 78.0)  # late answers to the first reading; the vehicle may carry anything by now
    assert run.stage is Stage.UNDO_CHECKING


def test_reading_back_another_value_puts_back_again_and_is_uncertain_in_the_end():
    run = Run().verifying().told(recoveries.veto)
    rounds = 0
    for _ in range(50):
        before = run.stage
        run.waits(1.0).hears(LEFT, 78.0)
        rounds += before is not Stage.UNDOING and run.stage is Stage.UNDOING
    assert run.stage is Stage.UNCERTAIN
    assert rounds == UNDO_ROUNDS - 1
    assert recoveries.from_record(run.kept).stage is Stage.UNCERTAIN


def test_an_uncertain_recovery_is_taken_up_again_when_the_vehicle_is_back():
    run = Run().verifying().told(recoveries.veto)
    for _ in range(50):
        run.waits(1.0)
    run.state, effects = recoveries.resume(recoveries.from_record(run.kept), PLAN, run.now_us, "heard again")
    run._do(effects).hears(RIGHT, 78.0).hears(LEFT, 77.0).undo_read().read()
    assert run.stage is Stage.ROLLED_BACK
    assert run.state.reason == "heard again"


def test_after_a_restart_what_was_under_way_is_put_back_and_never_continued():
    for killed in (Run().read(), Run().read().hears(LEFT, 78.0), Run().swapped(), Run().verifying()):
        record = recoveries.from_record(killed.kept)
        state, effects = recoveries.resume(record, PLAN, 5 * S, "restarted")
        assert state.stage is Stage.UNDOING
        last = PLAN.parameters[record.touched - 1]
        original = dict(zip(PLAN.parameters, (77.0, 78.0), strict=True))
        assert (effects[1].fields["param_id"], effects[1].fields["param_value"]) == (last, original[last])


def test_a_change_that_does_not_read_back_is_put_back():
    run = Run().swapped().hears(LEFT, 78.0).hears(RIGHT, 78.0)
    assert run.stage is Stage.CHECKING
    run.waits(1.0)
    assert run.asked == [LEFT, RIGHT]
    run.waits(1.0)
    assert run.stage is Stage.UNDOING
    assert "did not read back" in run.state.reason


@pytest.mark.parametrize("right", [77.0, math.nan, math.inf])
def test_nothing_to_swap_is_refused_without_a_change(right):
    run = Run().read(77.0, right)
    assert run.stage is Stage.REFUSED
    assert run.sets == []
    assert "nothing to swap" in run.state.reason


def test_pairs_that_differ_or_answer_by_half_refuse_the_swap():
    differ = Run(CAREFUL).read().hears(MIN_LEFT, 1000.0).hears(MIN_RIGHT, 1100.0)
    by_half = Run(CAREFUL).read().hears(MIN_LEFT, 1000.0).waits(1.0).waits(1.0)
    for run, reason in ((differ, f"{MIN_LEFT} and {MIN_RIGHT} differ"), (by_half, f"{MIN_RIGHT} does not answer")):
        assert run.stage is Stage.REFUSED
        assert run.sets == []
        assert reason == run.state.reason


def test_pairs_that_the_autopilot_does_not_have_are_no_obstacle():
    run = Run(CAREFUL).read().waits(1.0)
    assert run.asked == [MIN_LEFT, MIN_RIGHT]
    run.waits(1.0)
    assert run.stage is Stage.SETTING


def test_a_parameter_that_is_never_told_refuses_the_swap():
    run = Run().hears(LEFT, 77.0).waits(1.0)
    assert run.asked == [RIGHT]
    run.waits(1.0)
    assert run.stage is Stage.REFUSED
    assert run.state.reason == f"{RIGHT} does not answer"
    assert run.kept == ""


def test_a_definite_no_ends_the_asking_at_once():
    assert Run().refused(RIGHT).stage is Stage.REFUSED
    run = Run().read().refused(LEFT, 5)
    assert run.stage is Stage.UNDOING
    assert "error 5" in run.state.reason
    assert run.sets == [(LEFT, 78.0), (LEFT, 77.0)]


def test_a_no_about_something_else_means_nothing():
    assert Run(CAREFUL).refused(MIN_LEFT).stage is Stage.READING
    run = Run().read()
    assert run.refused(RIGHT).last == []
    assert run.verifying().refused(LEFT).stage is Stage.VERIFYING


def test_deadlines_count_from_the_last_request_and_an_early_tick_changes_nothing():
    run = Run(at_s=100.0)
    before = run.state
    run.waits(0.999_999)
    assert run.state == before
    assert run.last == []
    run.waits(0.000_001)
    assert run.asked == [LEFT, RIGHT]


def test_the_repair_is_judged_only_after_the_vehicle_had_time_to_settle():
    run = Run().verifying()
    for _ in range(29):
        run.sees(alarm=True, clear=False)
    assert run.stage is Stage.VERIFYING
    run.sees(alarm=True, clear=False)
    assert run.stage is Stage.UNDOING
    assert "rose again" in run.state.reason


def test_rows_without_an_opinion_are_no_evidence_for_the_repair():
    run = Run().verifying().waits(3.0)
    for _ in range(500):
        run.sees(judging=False).sees(clear=False)
    assert run.stage is Stage.VERIFYING
    assert run.state.good_us == 0
    assert run.state.excited_us == 0


@pytest.mark.parametrize("excitation", [0.0, 0.149, -0.149, math.nan])
def test_a_repair_that_was_never_put_to_the_test_is_not_verified(excitation):
    run = Run().verifying().waits(3.0)
    for _ in range(1000):
        run.sees(excitation=excitation)
    assert run.stage is Stage.VERIFYING
    for _ in range(30):
        run.sees(excitation=-0.15)
    assert run.stage is Stage.DONE


def test_a_reboot_during_the_change_puts_everything_back():
    for run in (Run().read(), Run().swapped()):
        run.told(recoveries.rebooted)
        assert run.stage is Stage.UNDOING
        assert "rebooted" in run.state.reason


def test_a_reboot_while_verifying_is_read_back_and_verified_from_the_beginning():
    run = Run().verifying().waits(3.0)
    for _ in range(150):
        run.sees()
    run.told(recoveries.rebooted)
    assert run.stage is Stage.CHECKING
    run.waits(2.0)
    assert run.asked == [LEFT, RIGHT]
    run.hears(LEFT, 78.0).hears(RIGHT, 77.0)
    assert (run.stage, run.state.good_us) == (Stage.VERIFYING, 0)


def test_a_reboot_while_putting_back_gives_all_tries_again():
    run = Run().verifying().told(recoveries.veto).waits(1.0)
    assert run.state.tries == 2
    run.told(recoveries.rebooted)
    assert (run.stage, run.state.place, run.state.tries) == (Stage.UNDOING, 1, 1)


def test_a_reboot_while_reading_asks_again():
    run = Run().hears(LEFT, 77.0).told(recoveries.rebooted)
    assert run.asked == [LEFT, RIGHT]
    assert run.state.answers == (None, None)


def test_the_operator_can_have_it_undone_at_any_time_and_after_it_is_done():
    assert Run().told(recoveries.veto).stage is Stage.REFUSED
    done = Run().done_well()
    for run in (Run().read(), Run().swapped(), Run().verifying(), done):
        run.told(recoveries.veto)
        assert run.stage is Stage.UNDOING
        assert run.state.reason == "vetoed by the operator"
        assert recoveries.from_record(run.kept).stage is Stage.UNDOING


def test_a_veto_changes_nothing_while_it_is_being_undone_or_nothing_was_done():
    undoing = Run().read().told(recoveries.veto)
    refused = Run().refused(LEFT)
    for run in (undoing, refused):
        before = run.state
        run.told(recoveries.veto)
        assert run.state is before


def test_disarming_undoes_what_is_not_verified_and_leaves_what_is_done():
    assert Run().told(recoveries.disarmed).stage is Stage.REFUSED
    for run in (Run().read(), Run().swapped(), Run().verifying()):
        assert run.told(recoveries.disarmed).stage is Stage.UNDOING
    done = Run().done_well()
    assert done.told(recoveries.disarmed).stage is Stage.DONE


def test_refused_means_that_the_vehicle_was_never_seen_to_carry_a_new_value():
    unseen = Run().read().waits(1.0).waits(1.0).hears(LEFT, 77.0).undo_read().read()
    assert unseen.stage is Stage.REFUSED
    seen = Run().read().hears(LEFT, 78.0).told(recoveries.veto).hears(RIGHT, 78.0).hears(LEFT, 77.0).undo_read().read()
    assert seen.stage is Stage.ROLLED_BACK


def test_a_record_reads_back_as_the_same_recovery():
    for run in (Run().read(), Run().swapped(), Run().verifying(), Run(CAREFUL).read().waits(1.0).waits(1.0)):
        state = run.state
        assert recoveries.from_record(recoveries.as_record(state)) == state


@pytest.mark.parametrize("text", ["", "{", "[]", '{"schema":2,"recovery":{}}', '{"schema":1,"recovery":{"fault_id":"x"}}'])
def test_a_record_that_cannot_be_read_says_so(text):
    with pytest.raises(ValueError, match="not a recovery record"):
        recoveries.from_record(text)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"parameters": (LEFT, LEFT)}, "twice"),
        ({"parameters": (LEFT, "")}, "1 to 16 bytes"),
        ({"must_agree": (("A", "SEVENTEEN_BYTES__"),)}, "1 to 16 bytes"),
        ({"text": "x" * 41}, "STATUSTEXT"),
        ({"answer_s": 0.0}, "answer_s"),
        ({"verify_s": 0.0}, "verify_s"),
        ({"excitation_least": 0.0}, "excitation_least"),
        ({"settle_s": -1.0}, "settle_s"),
        ({"tries": 0}, "tries"),
        ({"undo_tries": 0}, "undo_tries"),
    ],
)
def test_a_plan_that_cannot_work_is_refused(changes, complaint):
    with pytest.raises(ValueError, match=complaint):
        plan(**changes)


# -- the enumeration --------------------------------------------------------------------------------------------------
#
# The vehicle's store holds one of three values for each of the two outputs: as found, exchanged (which is the other's), or
# a third that nobody asked for.  A message to it is answered in every way an autopilot is known to answer.  Its answers
# travel in order; each may be late by one deadline or be lost.  Time exists only as deadlines: `normal` takes the present
# off them, so that states which differ in the hour are one.

A, B, THIRD = 77.0, 78.0, 0.0
ALIKE = 1000.0  # of the pair that must agree, where the plan has one
ORIGINALS = (A, B)
SWAPPED = (B, A)
QUEUE = 4  # answers under way at a time; more than one round of reading brings


class Answer(Enum):
    """What an autopilot makes of a PARAM_SET."""

    APPLIES_AND_ECHOES = 0
    APPLIES_SILENTLY = 1
    REFUSES = 2  # echoes what it still has
    IGNORES = 3
    LIES = 4  # echoes the new value and applies nothing
    STORES_ANOTHER = 5  # and echoes that
    SAYS_NO = 6  # PARAM_ERROR


class Happening(Enum):
    """What comes from outside; a walk has a budget of them."""

    KILL = 0  # of the companion, which then starts again with what lies on its disk
    REBOOT = 1  # of the autopilot, which has stored everything
    REBOOT_FORGETS = 2  # of the autopilot, which had not yet stored the last change
    VETO = 3
    DISARM = 4
    RECONNECT = 5  # an uncertain end is taken up again


class Reply(NamedTuple):
    """An answer under way.  `value` None: PARAM_ERROR.  `late`: a deadline has passed since it was sent."""

    place: int
    value: float | None
    late: bool


class Request(NamedTuple):
    """A PARAM_SET, or with `value` None a PARAM_REQUEST_READ."""

    place: int
    value: float | None


class Keep(NamedTuple):
    """A record to be kept on disk, as it reads back; None: there is nothing to keep any more."""

    record: Recovery | None


class State(NamedTuple):
    """Everything that the future depends on."""

    recovery: Recovery
    to_do: tuple[Request | Keep, ...]  # effects not yet carried out: a kill may come between any two
    disk: Recovery | None
    live: tuple[float, float]  # what the outputs obey
    stored: tuple[float, float]  # what a reboot brings back at worst
    under_way: tuple[Reply, ...]
    budget: int


NOTHING_BEGUN = Recovery("", Stage.REFUSED)  # what a companion knows that found nothing on its disk
NOTHING_LEFT = Recovery("", Stage.DONE)  # the same where the run before it had come to its end


def still_done(state):
    """It was done, a veto has come since, and nothing has been done about that: a kill would lose the veto, no more."""
    return state.disk is None and state.live == SWAPPED and state.to_do != () and isinstance(state.to_do[0], Keep)


READS = (Stage.READING, Stage.CHECKING, Stage.UNDO_CHECKING)


def normal(recovery, now_us):
    """The same state at time zero, without what decides nothing any more: that there is a reason matters, not its words."""
    return replace(
        recovery,
        due_us=0 if recovery.ended else max(0, recovery.due_us - now_us),
        reason="some" if recovery.reason else "",
        answers=recovery.answers if recovery.stage in READS else (),
        good_us=recovery.good_us if recovery.stage is Stage.VERIFYING else 0,
        excited_us=recovery.excited_us if recovery.stage is Stage.VERIFYING else 0,
    )


def orders(effects):
    """Effects without what is no part of the future; a record goes through its text."""
    return tuple(
        (Keep(normal(recoveries.from_record(effect.record), 1 << 60)) if effect.record else Keep(None))
        if isinstance(effect, Save)
        else Request(CAREFUL.read_first.index(effect.fields["param_id"]), effect.fields.get("param_value"))
        for effect in effects
    )


class Walk:
    """Breadth first through everything that can happen."""

    def __init__(self, chosen=PLAN, *, budget=2, answers=tuple(Answer), happenings=tuple(Happening), loss=True):
        self.plan, self.budget, self.answers, self.happenings, self.loss = chosen, budget, answers, happenings, loss
        self.transitions = 0
        self.ends = Counter()
        self.number = {}
        self.after = []  # per state, the numbers of its successors

    def run(self):
        recovery, effects = recoveries.begin(self.plan, "crossed_lines", 0)
        start = State(normal(recovery, 0), orders(effects), None, ORIGINALS, ORIGINALS, (), self.budget)
        self.number[start] = 0
        ahead = deque([start])
        while ahead:
            state = ahead.popleft()
            self.check(state)
            following = []
            for successor in map(self.plain, self.successors(state)):
                self.transitions += 1
                place = self.number.get(successor)
                if place is None:
                    place = self.number[successor] = len(self.number)
                    ahead.append(successor)
                following.append(place)
            self.after.append(following)
        self.check_that_every_path_ends()
        return self

    # what must be true

    def check(self, state):
        recovery = state.recovery
        ended = recovery.stage in ENDED and not state.to_do
        if state.live != ORIGINALS and not ended and not still_done(state):
            assert state.disk is not None, f"a kill would leave a changed vehicle and nobody would know: {state}"
        if not ended:
            return
        match recovery.stage:
            case Stage.DONE:
                assert state.live == SWAPPED, f"called done: {state}"
                assert state.disk is None, state
            case Stage.REFUSED | Stage.ROLLED_BACK:
                assert state.live == ORIGINALS, f"called {recovery.stage}: {state}"
                assert state.disk is None, state
            case Stage.UNCERTAIN:
                assert state.disk is not None, state
                assert state.disk.stage is Stage.UNCERTAIN, state
        self.ends[recovery.stage] += 1

    @staticmethod
    def check_heard(recovery, said, output):
        """Nothing moves on because of an echo that is not the parameter in hand with the value it was given."""
        if recovery.stage in (Stage.SETTING, Stage.UNDOING):
            goal = recovery.wanted if recovery.stage is Stage.SETTING else recovery.original
            if (said.place, said.value) != (recovery.place, goal[recovery.place]):
                assert output == (recovery, []), f"{said} counted as an echo: {recovery}"

    def check_that_every_path_ends(self):
        """Nothing goes round in circles: taking away states without a successor, again and again, leaves none."""
        before = [[] for _ in self.after]
        open_ends = [len(following) for following in self.after]
        for place, following in enumerate(self.after):
            for successor in following:
                before[successor].append(place)
        leaves = [place for place, count in enumerate(open_ends) if count == 0]
        gone = 0
        while leaves:
            gone += 1
            for place in before[leaves.pop()]:
                open_ends[place] -= 1
                if open_ends[place] == 0:
                    leaves.append(place)
        assert gone == len(self.after), f"{len(self.after) - gone} states lie on a circle"

    @staticmethod
    def plain(state):
        """Without what nothing can come of any more: with the budget gone, no kill reads the disk, no reboot the store."""
        if state.budget:
            return state
        disk = state.disk and Recovery("", state.disk.stage, state.disk.original, touched=state.disk.touched)
        return state._replace(disk=disk, stored=state.live)

    # what may happen

    def successors(self, state):
        if state.to_do:
            yield from self.carried_out(state)
        else:
            yield from self.heard(state)
            yield from self.waited(state)
            yield from self.judged(state)
        if state.budget:
            yield from self.happened(state)

    def becomes(self, state, output, now_us, **changes):
        recovery, effects = output
        if recovery.ended and recovery.stage is not state.recovery.stage:
            assert recovery.reason, f"an end without a reason: {state}"
        return state._replace(recovery=normal(recovery, now_us), to_do=state.to_do + orders(effects), **changes)

    def carried_out(self, state):
        order, rest = state.to_do[0], state.to_do[1:]
        state = state._replace(to_do=rest)
        if isinstance(order, Keep):
            yield state._replace(disk=order.record)
            return
        place, value = order
        if value is None:
            yield self.says(state, place, (*state.live, ALIKE, ALIKE)[place])
            if self.loss:
                yield state
            return
        assert state.disk is not None, f"sent before it was saved: {state}"
        assert state.disk.touched > place, f"sent before it was saved: {state}"
        assert state.disk.original == ORIGINALS, state
        for answer in self.answers:
            match answer:
                case Answer.APPLIES_AND_ECHOES:
                    yield self.says(self.applies(state, place, value), place, value)
                case Answer.APPLIES_SILENTLY:
                    yield self.applies(state, place, value)
                case Answer.REFUSES:
                    yield self.says(state, place, state.live[place])
                case Answer.IGNORES:
                    yield state
                case Answer.LIES:
                    yield self.says(state, place, value)
                case Answer.STORES_ANOTHER:
                    yield self.says(self.applies(state, place, THIRD), place, THIRD)
                case Answer.SAYS_NO:
                    yield self.says(state, place, None)

    @staticmethod
    def applies(state, place, value):
        """The outputs obey at once; what was changed before has been stored by now, this has perhaps not."""
        live = (value, state.live[1]) if place == 0 else (state.live[0], value)
        stored = (state.stored[0], state.live[1]) if place == 0 else (state.live[0], state.stored[1])
        return state._replace(live=live, stored=stored)

    @staticmethod
    def says(state, place, value):
        return state._replace(under_way=(*state.under_way, Reply(place, value, late=False))[-QUEUE:])

    def heard(self, state):
        if not state.under_way or state.recovery.ended:
            return
        said, rest = state.under_way[0], state.under_way[1:]
        name = self.plan.read_first[said.place]
        if said.value is None:
            output = recoveries.refused_by_vehicle(state.recovery, self.plan, name, 2, 0)
        else:
            output = recoveries.hear(state.recovery, self.plan, Said(name, said.value, INT16), 0)
            self.check_heard(state.recovery, said, output)
        yield self.becomes(state, output, 0, under_way=rest)

    def waited(self, state):
        """The deadline passes; what was late then is lost now, and at a long deadline everything is."""
        recovery = state.recovery
        if recovery.ended or recovery.stage is Stage.VERIFYING or (state.under_way and not self.loss):
            return
        waited_us = recovery.due_us
        late = () if waited_us >= 2e6 * self.plan.answer_s else state.under_way
        rest = tuple(reply._replace(late=True) for reply in late if not reply.late)
        yield self.becomes(state, recoveries.tick(recovery, self.plan, recovery.due_us), recovery.due_us, under_way=rest)

    def judged(self, state):
        """The repair helps, or it does not."""
        if state.recovery.stage is not Stage.VERIFYING:
            return
        for alarm in (False, True):
            row = Evidence(judging=True, alarm=alarm, clear=not alarm, excitation=1.0, period_us=100 * S)
            output = recoveries.judge(state.recovery, self.plan, row, state.recovery.due_us)
            yield self.becomes(state, output, state.recovery.due_us)

    def happened(self, state):
        recovery = state.recovery
        if recovery in (NOTHING_BEGUN, NOTHING_LEFT):
            return
        state = state._replace(budget=state.budget - 1)
        for happening in self.happenings:
            match happening:
                case Happening.KILL:
                    if recovery.ended and not state.to_do:
                        continue
                    state_after = state._replace(to_do=())
                    if state.disk is None:
                        yield state_after._replace(recovery=NOTHING_LEFT if still_done(state) else NOTHING_BEGUN)
                        continue
                    output = recoveries.resume(state.disk, self.plan, 0, "restarted")
                    assert output[0].stage is Stage.UNDOING, f"continued after a kill: {state}"
                    yield self.becomes(state_after, output, 0)
                case Happening.REBOOT | Happening.REBOOT_FORGETS:
                    if recovery.ended or state.to_do:
                        continue
                    live = state.live if happening is Happening.REBOOT else state.stored
                    state_after = state._replace(live=live, stored=live, under_way=())
                    yield self.becomes(state_after, recoveries.rebooted(recovery, self.plan, 0), 0)
                case Happening.VETO:
                    if state.to_do:
                        continue
                    yield self.becomes(state, recoveries.veto(recovery, self.plan, 0), 0)
                case Happening.DISARM:
                    if state.to_do:
                        continue
                    yield self.becomes(state, recoveries.disarmed(recovery, self.plan, 0), 0)
                case Happening.RECONNECT:
                    if recovery.stage is not Stage.UNCERTAIN or state.to_do:
                        continue
                    yield self.becomes(state, recoveries.resume(recovery, self.plan, 0, "heard again"), 0)


def walk_told(record_property, title, walk):
    ends = ", ".join(f"{count} {stage.value}" for stage, count in sorted(walk.ends.items()))
    text = f"{title}: {len(walk.number)} states, {walk.transitions} transitions; ends: {ends}"
    record_property("enumeration", text)
    print(text)  # noqa: T201  # shown with -s
    return walk


def test_what_is_said_at_the_end_is_true_whatever_autopilot_and_link_do_and_one_thing_happens(record_property):
    walk = walk_told(record_property, "every answer, every happening once", Walk(budget=1).run())
    assert set(walk.ends) == ENDED
    assert len(walk.number) > 60_000
    assert walk.transitions > 250_000


def test_what_is_said_at_the_end_is_true_when_two_things_happen(record_property):
    walk = walk_told(record_property, "two happenings, one try to put back", Walk(plan(undo_tries=1)).run())
    assert set(walk.ends) == ENDED
    assert len(walk.number) > 120_000
    assert walk.transitions > 500_000


@pytest.mark.slow
def test_what_is_said_at_the_end_is_true_when_two_things_happen_and_all_tries_are_there(record_property):
    walk = walk_told(record_property, "two happenings, two tries", Walk().run())
    assert len(walk.number) > 300_000


def test_a_pair_that_must_agree_adds_no_way_to_a_false_end(record_property):
    walk = walk_told(record_property, "a pair that must agree", Walk(CAREFUL, budget=0).run())
    assert set(walk.ends) == ENDED
    assert len(walk.number) > 10_000


def test_an_autopilot_that_does_what_it_is_told_never_ends_uncertain(record_property):
    willing = Walk(budget=3, answers=(Answer.APPLIES_AND_ECHOES,), loss=False)
    walk = walk_told(record_property, "a willing autopilot, three happenings", willing.run())
    assert set(walk.ends) == {Stage.DONE, Stage.REFUSED, Stage.ROLLED_BACK}
    assert len(walk.number) > 600


def test_an_autopilot_that_ignores_everything_is_left_as_it_was(record_property):
    walk = walk_told(record_property, "a deaf autopilot", Walk(answers=(Answer.IGNORES,), loss=False).run())
    assert set(walk.ends) == {Stage.REFUSED}
