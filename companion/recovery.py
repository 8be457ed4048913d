"""Mending by parameters: a state machine that never touches a socket or a clock.

    READING -> SETTING -> CHECKING -> VERIFYING -> DONE
       |          |           |           |
       v          +-----------+-----------+--> UNDOING -> UNDO_CHECKING -> ROLLED_BACK | REFUSED
    REFUSED                                       ^              |
                                                  +--------------+-----> UNCERTAIN (again on reconnect)

Rules, each with its reason:
- A PARAM_VALUE counts by name and value.  A different value may be an older echo still on its way: the deadline decides.
- Silence is not "unchanged" (ArduPilot applies first and answers from a queue): what was sent is put back all the same.
- Before a PARAM_SET leaves, the record that names its parameter is saved.  After a restart of the companion whatever was
  under way is put back, never continued.
- Nothing is called rolled back before both parameters have been read back.
- A reading back begins only when late answers to earlier requests have run out: an echo still on its way, of an older
  value or of one that was never stored, would pass for what was read.
- MAVLink has no atomic pair: between the two PARAM_SETs both outputs carry one function for a round trip.

The vehicle's own system and component are checked by whoever feeds this machine.
"""

import math
import struct
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final, Literal

import msgspec

from companion.dialect import Fields
from companion.effects import Save, Send

MAV_PARAM_TYPE_REAL32: Final = 9


@dataclass(frozen=True, slots=True)
class Plan:
    """`[recovery.FAULT]`: what mends a fault and how it is verified."""

    action: Literal["swap_parameters"]  # the two parameters exchange their values
    parameters: tuple[str, str]
    must_agree: tuple[tuple[str, str], ...]  # pairs that would have to be swapped too if they differed: then refused
    text: str  # what the operator is told is being done; fits STATUSTEXT
    answer_s: float  # an answer to a request is waited for so long
    tries: int  # before a parameter counts as not answering
    undo_tries: int  # the same while putting back: long enough for a reboot of the autopilot
    verify_residual: str  # must stay below its threshold
    verify_s: float  # for so long
    settle_s: float  # after the vehicle was given this long to recover from what the fault did to it
    excitation_signal: str  # while the vehicle was asked to do something: |signal|
    excitation_least: float  # at least this
    excitation_s: float  # for so long in all

    def __post_init__(self) -> None:
        if self.parameters[0] == self.parameters[1]:
            raise ValueError(f"parameters = {self.parameters[0]} twice; a swap needs two")
        for name in (*self.parameters, *(name for pair in self.must_agree for name in pair)):
            if not 0 < len(name.encode()) <= 16:
                raise ValueError(f"{name!r} is no parameter name; MAVLink has 1 to 16 bytes for it")
        if len(self.text.encode()) > 40:
            raise ValueError(f"text = {self.text!r} does not fit STATUSTEXT; at most 40 bytes")
        if min(self.answer_s, self.verify_s, self.excitation_least, self.excitation_s) <= 0.0 or self.settle_s < 0.0:
            raise ValueError("answer_s, verify_s, excitation_least and excitation_s must be > 0, settle_s >= 0")
        if min(self.tries, self.undo_tries) < 1:
            raise ValueError(f"tries = {self.tries}, undo_tries = {self.undo_tries}: at least 1")

    @property
    def read_first(self) -> tuple[str, ...]:
        """Everything that is read before anything is changed; the parameters to change come first."""
        return tuple(dict.fromkeys((*self.parameters, *(name for pair in self.must_agree for name in pair))))


class Stage(StrEnum):
    """Where the recovery stands; see the picture at the top."""

    READING = "reading"
    SETTING = "setting"
    CHECKING = "checking"
    VERIFYING = "verifying"
    UNDOING = "undoing"
    UNDO_CHECKING = "undo_checking"
    DONE = "done"
    REFUSED = "refused"  # the vehicle carries what it carried, and was never seen to carry anything else
    ROLLED_BACK = "rolled_back"
    UNCERTAIN = "uncertain"  # the parameters may be half changed: the operator must look


STAGE_WORDS: Final = {  # for people
    Stage.READING: "reading the parameters",
    Stage.SETTING: "changing the parameters",
    Stage.CHECKING: "reading the parameters back",
    Stage.VERIFYING: "watching whether it helps",
    Stage.UNDOING: "putting the parameters back",
    Stage.UNDO_CHECKING: "checking that they are back",
    Stage.DONE: "changed and verified",
    Stage.REFUSED: "refused, as before",
    Stage.ROLLED_BACK: "put back as before",
    Stage.UNCERTAIN: "parameters uncertain",
}

ENDED: Final = frozenset({Stage.DONE, Stage.REFUSED, Stage.ROLLED_BACK, Stage.UNCERTAIN})
UNDO_ROUNDS: Final = 3  # putting back and reading back again, before it is called uncertain
LATE_ANSWERS: Final = 2  # times answer_s: whatever has not arrived by then never will


@dataclass(frozen=True, slots=True)
class Recovery:
    """The whole state: save it, restore it, compare it."""

    fault_id: str
    stage: Stage
    original: tuple[float, ...] = ()  # of plan.parameters, as read before
    kinds: tuple[int, ...] = ()  # their MAV_PARAM_TYPE
    touched: int = 0  # of so many parameters a PARAM_SET has been (or is about to be) sent
    changed: bool = False  # the vehicle was seen to carry a new value
    place: int = 0  # the parameter in hand while SETTING or UNDOING
    answers: tuple[float | None, ...] = ()  # what has been read in READING, CHECKING, UNDO_CHECKING
    tries: int = 0
    rounds: int = 0
    due_us: int = 0  # when the deadline in force passes
    good_us: int = 0  # VERIFYING: the residual was below its threshold for so long
    excited_us: int = 0  # VERIFYING: the vehicle was asked for something for so long
    reason: str = ""

    @property
    def ended(self) -> bool:
        return self.stage in ENDED

    @property
    def wanted(self) -> tuple[float, ...]:
        return self.original[::-1]


@dataclass(frozen=True, slots=True)
class Said:
    """A PARAM_VALUE of the vehicle's autopilot."""

    name: str
    value: float
    kind: int


@dataclass(frozen=True, slots=True)
class Evidence:
    """One row while the repair is being verified."""

    judging: bool  # the monitor has an opinion (not warming)
    alarm: bool  # it finds a fault
    clear: bool  # the residual is known and below its threshold
    excitation: float  # of plan.excitation_signal; NaN where unknown
    period_us: int


Output = tuple[Recovery, list[Send | Save]]


def as_record(recovery: Recovery) -> str:
    """The text that survives a kill."""
    return msgspec.json.encode({"schema": 1, "recovery": recovery}).decode()


def from_record(text: str) -> Recovery:
    """Raises ValueError for a record that cannot be read."""
    try:
        return msgspec.json.decode(text, type=_Record).recovery
    except msgspec.DecodeError as error:
        raise ValueError(f"not a recovery record: {error}") from None


@dataclass(frozen=True, slots=True)
class _Record:
    schema: Literal[1]
    recovery: Recovery


def same_value(one: float, other: float) -> bool:
    """Equal as the float32 in which MAVLink carries parameters."""
    return math.isfinite(one) and math.isfinite(other) and struct.pack("<f", one) == struct.pack("<f", other)


def begin(plan: Plan, fault_id: str, now_us: int) -> Output:
    """Read everything first; nothing is changed yet."""
    return _read(Recovery(fault_id, Stage.READING), plan, plan.read_first, now_us)


def resume(record: Recovery, plan: Plan, now_us: int, reason: str) -> Output:
    """After a restart of the companion, or a reconnection in an uncertain state: put back what was under way."""
    return _undo(replace(record, rounds=0, reason=reason), plan, now_us)


def hear(recovery: Recovery, plan: Plan, said: Said, now_us: int) -> Output:
    """A parameter's value, as the vehicle's autopilot told it."""
    match recovery.stage:
        case Stage.READING:
            return _hear_reading(recovery, plan, said, now_us)
        case Stage.SETTING:
            place = recovery.place
            if said.name != plan.parameters[place] or not same_value(said.value, recovery.wanted[place]):
                return recovery, []
            recovery = replace(recovery, changed=True)
            if place + 1 < len(plan.parameters):
                return _set(recovery, plan, place + 1, now_us)
            return _read_back(recovery, Stage.CHECKING, plan, now_us)
        case Stage.UNDOING:
            place = recovery.place
            if said.name != plan.parameters[place] or not same_value(said.value, recovery.original[place]):
                return recovery, []
            return _undo_next(recovery, plan, now_us)
        case Stage.CHECKING | Stage.UNDO_CHECKING:
            if said.name not in plan.parameters or recovery.tries == 0:  # not asked yet: a late answer
                return recovery, []
            place = plan.parameters.index(said.name)
            answers = (*recovery.answers[:place], said.value, *recovery.answers[place + 1 :])
            recovery = replace(recovery, answers=answers)
            goal = recovery.wanted if recovery.stage is Stage.CHECKING else recovery.original
            if not all(value is not None and same_value(value, want) for value, want in zip(answers, goal, strict=True)):
                return recovery, []
            if recovery.stage is Stage.CHECKING:
                due_us = now_us + round(1e6 * plan.settle_s)
                return _kept(replace(recovery, stage=Stage.VERIFYING, good_us=0, excited_us=0, due_us=due_us))
            return _end(recovery, Stage.ROLLED_BACK if recovery.changed else Stage.REFUSED)
    return recovery, []


def refused_by_vehicle(recovery: Recovery, plan: Plan, name: str, code: int, now_us: int) -> Output:
    """A PARAM_ERROR: a definite no, nothing is gained by asking again."""
    if recovery.stage is Stage.READING and name in plan.parameters:
        return _end(replace(recovery, reason=f"{name}: the autopilot answers error {code}"), Stage.REFUSED)
    if recovery.stage is Stage.SETTING and name == plan.parameters[recovery.place]:
        return _undo(replace(recovery, reason=f"{name}: the autopilot answers error {code}"), plan, now_us)
    return recovery, []


def tick(recovery: Recovery, plan: Plan, now_us: int) -> Output:
    """Let time pass: a deadline in force may be over."""
    if recovery.ended or recovery.stage is Stage.VERIFYING or now_us < recovery.due_us:
        return recovery, []
    more = recovery.tries < (plan.undo_tries if recovery.stage in (Stage.UNDOING, Stage.UNDO_CHECKING) else plan.tries)
    match recovery.stage:
        case Stage.READING:
            return _again_reading(recovery, plan, now_us) if more else _reading_over(recovery, plan, now_us)
        case Stage.SETTING:
            if more:
                return _set(recovery, plan, recovery.place, now_us)
            return _undo(replace(recovery, reason=f"{plan.parameters[recovery.place]} was not taken"), plan, now_us)
        case Stage.CHECKING:
            if more:
                return _read(recovery, plan, plan.parameters, now_us)
            return _undo(replace(recovery, reason="the change did not read back"), plan, now_us)
        case Stage.UNDOING:
            # One that does not answer must not keep the other from being put back; the reading back decides.
            return _undo_set(recovery, plan, recovery.place, now_us) if more else _undo_next(recovery, plan, now_us)
        case _:
            if more:
                return _read(recovery, plan, plan.parameters, now_us)
            if recovery.rounds + 1 < UNDO_ROUNDS:
                return _undo(replace(recovery, rounds=recovery.rounds + 1), plan, now_us)
            return _end(recovery, Stage.UNCERTAIN)


def judge(recovery: Recovery, plan: Plan, evidence: Evidence, now_us: int) -> Output:
    """One row of the grid while the repair is being verified."""
    if recovery.stage is not Stage.VERIFYING or now_us < recovery.due_us:
        return recovery, []
    if evidence.alarm:
        return _undo(replace(recovery, reason=f"{plan.verify_residual} rose again after the change"), plan, now_us)
    if not (evidence.judging and evidence.clear):
        return recovery, []
    excited = abs(evidence.excitation) >= plan.excitation_least  # False for NaN
    recovery = replace(
        recovery,
        good_us=recovery.good_us + evidence.period_us,
        excited_us=recovery.excited_us + (evidence.period_us if excited else 0),
    )
    if recovery.good_us >= round(1e6 * plan.verify_s) and recovery.excited_us >= round(1e6 * plan.excitation_s):
        return _end(replace(recovery, reason=f"{plan.verify_residual} stayed clear while the vehicle turned"), Stage.DONE)
    return recovery, []


def rebooted(recovery: Recovery, plan: Plan, now_us: int) -> Output:
    """The autopilot started anew: what it had taken may be lost or kept."""
    match recovery.stage:
        case Stage.READING:
            return _read(replace(recovery, tries=0), plan, plan.read_first, now_us)
        case Stage.SETTING | Stage.CHECKING:
            return _undo(replace(recovery, reason="the autopilot rebooted during the change"), plan, now_us)
        case Stage.VERIFYING:
            return _read_back(recovery, Stage.CHECKING, plan, now_us)
        case Stage.UNDOING | Stage.UNDO_CHECKING:
            return _undo(recovery, plan, now_us)
    return recovery, []


def veto(recovery: Recovery, plan: Plan, now_us: int) -> Output:
    """The operator wants it undone, whether it is under way or done."""
    reason = "vetoed by the operator"
    if recovery.stage is Stage.READING:
        return _end(replace(recovery, reason=reason), Stage.REFUSED)
    if recovery.stage in (Stage.SETTING, Stage.CHECKING, Stage.VERIFYING, Stage.DONE):
        return _undo(replace(recovery, rounds=0, reason=reason), plan, now_us)
    return recovery, []


def disarmed(recovery: Recovery, plan: Plan, now_us: int) -> Output:
    """The flight is over: what has not been verified by now will not be, and the owner finds the vehicle as he left it."""
    if recovery.stage is Stage.READING:
        return _end(replace(recovery, reason="disarmed"), Stage.REFUSED)
    if recovery.stage in (Stage.SETTING, Stage.CHECKING, Stage.VERIFYING):
        return _undo(replace(recovery, reason="disarmed before the change was verified"), plan, now_us)
    return recovery, []


def _hear_reading(recovery: Recovery, plan: Plan, said: Said, now_us: int) -> Output:
    names = plan.read_first
    if said.name not in names:
        return recovery, []
    place = names.index(said.name)
    answers = (*recovery.answers[:place], said.value, *recovery.answers[place + 1 :])
    kinds = recovery.kinds or (MAV_PARAM_TYPE_REAL32,) * len(plan.parameters)
    if place < len(kinds):
        kinds = (*kinds[:place], said.kind, *kinds[place + 1 :])
    recovery = replace(recovery, answers=answers, kinds=kinds)
    if any(value is None for value in answers):
        return recovery, []
    return _reading_over(recovery, plan, now_us)


def _reading_over(recovery: Recovery, plan: Plan, now_us: int) -> Output:
    """Everything that will answer has answered: is there something to swap, and may it be swapped?"""
    answers = dict(zip(plan.read_first, recovery.answers, strict=True))
    original: list[float] = []
    for name in plan.parameters:
        value = answers[name]
        if value is None:
            return _end(replace(recovery, reason=f"{name} does not answer"), Stage.REFUSED)
        original.append(value)
    if same_value(original[0], original[1]) or not all(math.isfinite(value) for value in original):
        return _end(replace(recovery, reason=f"{' and '.join(plan.parameters)} hold nothing to swap"), Stage.REFUSED)
    for one, other in plan.must_agree:
        left, right = answers[one], answers[other]
        if left is None and right is None:
            continue  # this autopilot has no such parameters
        if left is None or right is None:
            return _end(replace(recovery, reason=f"{one if left is None else other} does not answer"), Stage.REFUSED)
        if not same_value(left, right):
            return _end(replace(recovery, reason=f"{one} and {other} differ"), Stage.REFUSED)
    return _set(replace(recovery, original=tuple(original), tries=0), plan, 0, now_us)


def _read(recovery: Recovery, plan: Plan, names: tuple[str, ...], now_us: int) -> Output:
    recovery = replace(
        recovery, answers=(None,) * len(names), tries=recovery.tries + 1, due_us=now_us + round(1e6 * plan.answer_s)
    )
    return recovery, [_request(name) for name in names]


def _read_back(recovery: Recovery, stage: Stage, plan: Plan, now_us: int) -> Output:
    """Wait for late answers to run out; the first deadline then asks."""
    due_us = now_us + round(1e6 * LATE_ANSWERS * plan.answer_s)
    return replace(recovery, stage=stage, tries=0, answers=(None,) * len(plan.parameters), due_us=due_us), []


def _again_reading(recovery: Recovery, plan: Plan, now_us: int) -> Output:
    """Ask again for what has not answered; what has is kept."""
    missing = [name for name, value in zip(plan.read_first, recovery.answers, strict=True) if value is None]
    recovery = replace(recovery, tries=recovery.tries + 1, due_us=now_us + round(1e6 * plan.answer_s))
    return recovery, [_request(name) for name in missing]


def _set(recovery: Recovery, plan: Plan, place: int, now_us: int) -> Output:
    again = recovery.stage is Stage.SETTING and recovery.place == place
    recovery = replace(
        recovery,
        stage=Stage.SETTING,
        place=place,
        touched=max(recovery.touched, place + 1),
        tries=recovery.tries + 1 if again else 1,
        due_us=now_us + round(1e6 * plan.answer_s),
    )
    send = Send("PARAM_SET", _param_set(plan.parameters[place], recovery.wanted[place], recovery.kinds[place]))
    return recovery, [Save(as_record(recovery)), send]


def _undo(recovery: Recovery, plan: Plan, now_us: int) -> Output:
    """Put everything touched back, the last first."""
    return _undo_set(replace(recovery, stage=Stage.UNDOING, tries=0), plan, recovery.touched - 1, now_us)


def _undo_set(recovery: Recovery, plan: Plan, place: int, now_us: int) -> Output:
    recovery = replace(recovery, place=place, tries=recovery.tries + 1, due_us=now_us + round(1e6 * plan.answer_s))
    send = Send("PARAM_SET", _param_set(plan.parameters[place], recovery.original[place], recovery.kinds[place]))
    return recovery, [Save(as_record(recovery)), send]


def _undo_next(recovery: Recovery, plan: Plan, now_us: int) -> Output:
    if recovery.place > 0:
        return _undo_set(replace(recovery, tries=0), plan, recovery.place - 1, now_us)
    return _read_back(recovery, Stage.UNDO_CHECKING, plan, now_us)


def _kept(recovery: Recovery) -> Output:
    return recovery, [Save(as_record(recovery))]


def _end(recovery: Recovery, stage: Stage) -> Output:
    """An uncertain end keeps its record: it is taken up again when the vehicle is heard again."""
    recovery = replace(recovery, stage=stage)
    return recovery, [Save(as_record(recovery) if stage is Stage.UNCERTAIN else "")]


def _request(name: str) -> Send:
    return Send("PARAM_REQUEST_READ", {"param_id": name, "param_index": -1})


def _param_set(name: str, value: float, kind: int) -> Fields:
    return {"param_id": name, "param_value": value, "param_type": kind}
