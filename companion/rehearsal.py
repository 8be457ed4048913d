"""A flight in one process: simulator and core in lockstep through real MAVLink bytes, without sockets or a clock.

For tests, threshold design and the replaying of one seed: it gives the same events as `mavfdi sitl` and `mavfdi run` in
lockstep over UDP.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

from companion.airframe import Airframe
from companion.clock import VehicleClock, follow
from companion.core import Core
from companion.decision import Policy
from companion.dialect import encode
from companion.effects import Effect, Save, Send
from companion.frames import Splitter
from companion.journal import Journal
from companion.tlog import OWN_LINK, record
from sitl.autopilot import Autopilot

EPOCH_US: Final = 1_767_225_600_000_000  # 2026-01-01: stamps of a flight that happened at no time
COMPANION: Final = "companion"  # the autopilot's name for its one client


@dataclass(slots=True)
class Rehearsal:
    """One flight under way.  log: the records that a live run would have written, if keep_log."""

    airframe: Airframe
    autopilot: Autopilot
    policy: Policy
    keep_log: bool = False
    observe: Callable[[Effect], None] | None = None
    core: Core = field(init=False)
    journal: Journal = field(init=False)
    log: bytearray = field(default_factory=bytearray)
    record: str = ""  # the recovery's record as it would lie on disk
    _clock: VehicleClock = field(default_factory=lambda: VehicleClock(EPOCH_US))
    _splitter: Splitter = field(default_factory=Splitter)
    _seq: int = 0
    _waiting: list[bytes] = field(default_factory=list)  # from the companion to the autopilot

    def __post_init__(self) -> None:
        self.core = Core(self.airframe, self.policy)
        self.journal = Journal(self.airframe)
        self.autopilot.everybody = False
        self._perform(self.core.tick(self._clock.now_us()))
        self._deliver()
        self.autopilot.send_heartbeat()
        self._listen()

    def step(self) -> None:
        """One step of the vehicle, and everything that the companion does about it."""
        self.autopilot.step()
        self._hear(self._drain())
        if not self.autopilot.silent:
            self._listen()

    def fly(self, duration_s: float) -> None:
        """So many seconds of the vehicle's time."""
        end_us = self.autopilot.elapsed_us + round(duration_s * 1e6)
        while self.autopilot.elapsed_us < end_us:
            self.step()

    def _listen(self) -> None:
        """The exchange of TIMESYNC that ends a step; what the companion has to say reaches the autopilot with it."""
        self.autopilot.ask_time((COMPANION,))
        self._hear(self._drain())
        self._deliver()

    def _drain(self) -> bytes:
        """What is for the companion; other clients that a test has put on the autopilot are served elsewhere."""
        return b"".join(frame for key, frame in self.autopilot.outgoing() if key == COMPANION)

    def _hear(self, data: bytes) -> None:
        for frame in self._splitter.feed(data):
            follow(self._clock, frame)
            stamp_us = self._clock.now_us()
            if self.keep_log:
                self.log += record(stamp_us, 0, frame.raw)
            self._perform(self.core.frame(frame, stamp_us))

    def _perform(self, effects: Sequence[Effect]) -> None:
        self.journal.take(effects, self.core.watch.sysid)
        for effect in effects:
            match effect:
                case Send(message, fields):
                    raw = encode(message, fields, sysid=self.core.sysid, compid=self.core.compid, seq=self._seq)
                    self._seq = (self._seq + 1) % 256
                    self._waiting.append(raw)
                    if self.keep_log:
                        self.log += record(self._clock.now_us(), OWN_LINK, raw)
                case Save(text):
                    self.record = text
            if self.observe is not None:
                self.observe(effect)

    def _deliver(self) -> None:
        waiting, self._waiting = self._waiting, []
        for raw in waiting:
            self.autopilot.receive(COMPANION, raw)
