"""From verdicts to actions: a pure function over a small state, so that it can be enumerated.

Nothing is read behind the reader's back: what the decision depends on is in its arguments.  Actions are ordered, the
later outranks the earlier, and less evidence never yields a stronger one.
"""

from dataclasses import dataclass, replace
from enum import IntEnum, StrEnum

from fdi.verdict import Phase


class Policy(StrEnum):
    """How far the companion may go by itself."""

    OFF = "off"  # alarms only
    ADVISE = "advise"  # says what it would do and waits for the operator's confirmation
    AUTO = "auto"


class Action(IntEnum):
    """What is to be done; later outranks earlier."""

    NONE = 0
    WARN = 1
    ADVISE = 2
    RECOVER = 3


@dataclass(frozen=True, slots=True)
class Rules:
    """`[decision]`: when an isolated fault is acted upon."""

    least_confidence: float  # of the isolation, for advice and for recovery
    hold_s: float  # how long a fault must have stayed isolated without a break
    repeat_s: float  # a standing fault is said again after this long

    def __post_init__(self) -> None:
        if not 0.0 <= self.least_confidence <= 1.0:
            raise ValueError(f"least_confidence = {self.least_confidence} is no probability; give 0 to 1")
        if self.hold_s < 0.0 or self.repeat_s <= 0.0:
            raise ValueError(f"hold_s = {self.hold_s}, repeat_s = {self.repeat_s}: give seconds >= 0 and > 0")


@dataclass(frozen=True, slots=True)
class Finding:
    """One row's verdict on the one vehicle, by name."""

    phase: Phase
    fault_id: str | None = None
    confidence: float = 0.0


@dataclass(frozen=True, slots=True)
class Facts:
    """What else the decision depends on, at the time of the row."""

    now_us: int
    armed: bool
    link_up: bool
    policy: Policy
    mendable: bool  # the configuration has a recovery for the fault found
    busy: bool  # a recovery is under way
    confirmed: bool = False  # the operator asked for the advised recovery


@dataclass(frozen=True, slots=True)
class Memory:
    """What is remembered from row to row."""

    fault_id: str | None = None  # isolated without a break
    since_us: int = 0
    tried: frozenset[str] = frozenset()  # one attempt per fault, for as long as the vehicle stays armed


@dataclass(frozen=True, slots=True)
class Decision:
    """What to do about it, and why not more."""

    action: Action
    because: str


def decide(memory: Memory, finding: Finding, facts: Facts, rules: Rules) -> tuple[Memory, Decision]:
    """One row.  A RECOVER is given once: the fault is then marked as tried."""
    if not facts.armed:
        return Memory(), Decision(Action.NONE, "not armed")
    if finding.phase in (Phase.WARMING, Phase.HEALTHY):
        return replace(memory, fault_id=None), Decision(Action.NONE, "nothing found")
    if finding.phase is not Phase.ISOLATED or finding.fault_id is None:
        return replace(memory, fault_id=None), Decision(Action.WARN, "not isolated")
    if memory.fault_id != finding.fault_id:
        memory = replace(memory, fault_id=finding.fault_id, since_us=facts.now_us)
    if not facts.mendable:
        return memory, Decision(Action.WARN, "no recovery is configured for it")
    if facts.policy is Policy.OFF:
        return memory, Decision(Action.WARN, "policy is off")
    if not finding.confidence >= rules.least_confidence:  # a confidence of NaN is none
        return memory, Decision(Action.WARN, f"confidence below {rules.least_confidence:.0%}")
    if finding.fault_id in memory.tried:
        return memory, Decision(Action.WARN, "already tried once")
    if facts.policy is Policy.ADVISE and not facts.confirmed:
        return memory, Decision(Action.ADVISE, "policy is advise")
    for ready, because in (
        (not facts.busy, "another recovery is under way"),
        (facts.link_up, "the link is silent"),
        (facts.now_us - memory.since_us >= round(1e6 * rules.hold_s), f"isolated for less than {rules.hold_s:g} s"),
    ):
        if not ready:
            return memory, Decision(Action.ADVISE, because)
    memory = replace(memory, tried=memory.tried | {finding.fault_id})
    return memory, Decision(Action.RECOVER, f"isolated with {finding.confidence:.1%}")
