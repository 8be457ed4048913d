"""The live loop: links on one side, the pure core on the other, one thread that owns all state.

It moves bytes, stamps, records and lines; what they mean is decided in `companion/core.py`, which reading a log calls too.
"""

import select
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

from companion.clock import Clock, follow
from companion.core import Core
from companion.dialect import Fields, encode
from companion.effects import Effect, Save, Send, Tell
from companion.events import SEVERITY_MAVLINK, Event, Json, Kind, Severity
from companion.frames import Frame, Splitter
from companion.journal import Journal, counters, summary
from companion.link import Link
from companion.recorder import ARMED, News, Recorder, When
from companion.recovery import Stage
from companion.tlog import OWN_LINK

PAUSE_S: Final = 0.02  # between two looks while nothing arrives
ROUNDS: Final = 16
DRAIN_US: Final = 100_000  # of the clock, for which links that do not run empty are read before time goes on
MAINTENANCE_US: Final = 200_000
PEERS: Final = 64  # byte streams kept apart at the most
RETELL_US: Final = 2_000_000  # between two requests for what a new log does not hold yet
RETELL_TRIES: Final = 5


@dataclass(slots=True)
class Live:
    """One run.  observe: shown every effect, for views; it must not block."""

    core: Core
    links: Sequence[Link]
    clock: Clock
    recorder: Recorder
    journal: Journal
    observe: Callable[[Effect], None] | None = None
    stop: str = ""  # set from outside (a signal, a view): why the run shall end
    _splitters: dict[tuple[str, Hashable], Splitter] = field(default_factory=dict)
    _gone: Counter[str] = field(default_factory=Counter)  # counts of peers that made room
    _looked_us: int = 0  # when the links were last known to be empty
    _stamp_us: int = 0  # of what is in hand; what is sent meanwhile is recorded under it, so that the log runs forward
    _seq: int = 0
    _maintained_us: int = 0
    _full_told: bool = False
    _armed: bool = False  # as the recorder knows it
    _flights: int = 0
    _arming_asked: bool = False  # were the parameters asked for at the last arming?
    _untold: set[str] = field(default_factory=set)  # parameters that the judgement needs and the log in hand does not hold
    _retell_us: int = 0
    _retell_tries: int = 0

    def run(
        self,
        duration_s: float | None = None,
        details: dict[str, Json] | None = None,
        ended: Callable[[], str] | None = None,
    ) -> dict[str, Json]:
        """Until told to stop, for duration_s of the clock, or until `ended` says why; -> the summary, also written."""
        self._stamp_us = self._looked_us = began_us = self.clock.now_us()
        extra: dict[str, Json] = {"policy": self.core.policy.value, "links": [link.name for link in self.links]}
        self.recorder.event(self.journal.begin(began_us, extra | (details or {})))
        self._watch_disk()
        while not self.stop:
            if duration_s is not None and self.clock.now_us() - began_us >= round(duration_s * 1e6):
                self.stop = "duration reached"
            if self._maintain() and ended is not None and (why := ended()):
                self.stop = why
            self._read()
            self._stamp_us = self._looked_us = self.clock.now_us()
            self._perform(self.core.tick(self._stamp_us))
            self._watch_disk()
        return self._finish(details or {})

    def _maintain(self) -> bool:
        """Look after the links now and then: by real time, which runs in lockstep too."""
        now_us = time.monotonic_ns() // 1000
        if now_us - self._maintained_us < MAINTENANCE_US:
            return False
        self._maintained_us = now_us
        for link in self.links:
            link.maintain(now_us)
        return True

    def _read(self) -> None:
        """Everything that waits, before time goes on: what a stall has held up is not late."""
        wait_s, began_us = self.clock.wait_s(PAUSE_S), self.clock.now_us()
        for _ in range(ROUNDS):
            waiting = [fileno for link in self.links for fileno in link.filenos()]
            ready = set(select.select(waiting, (), (), wait_s)[0])
            if not ready:
                return
            wait_s = 0.0
            for number, link in enumerate(self.links):
                if not ready.intersection(link.filenos()):
                    continue
                for peer, data in link.receive():
                    for frame in self._splitter(link.name, peer).feed(data):
                        self._take(frame, min(number, OWN_LINK - 1))
            if self.clock.now_us() - began_us >= DRAIN_US:
                return

    def _splitter(self, link: str, peer: Hashable) -> Splitter:
        found = self._splitters.get((link, peer))
        if found is None:
            if len(self._splitters) >= PEERS:
                oldest = next(iter(self._splitters))
                self._gone.update(self._splitters.pop(oldest).counts)
            found = self._splitters[link, peer] = Splitter()
        return found

    def _take(self, frame: Frame, link: int) -> None:
        follow(self.clock, frame)
        self._stamp_us = max(self._stamp_us, self.clock.arrival_us(self._looked_us, PAUSE_S))
        self.recorder.frame(self._stamp_us, link, frame.raw)
        self._perform(self.core.frame(frame, self._stamp_us))
        if self.core.watch.armed != self._armed:
            self._arm(self.core.watch.armed)
        if self._untold and frame.name == "PARAM_VALUE" and self.core.watch.is_autopilot(frame):
            self._untold.discard(str(frame.fields()["param_id"]))

    def _arm(self, armed: bool) -> None:
        self._armed = armed
        self.recorder.armed(armed)
        if armed:
            self._flights += 1
            self._arming_asked = self._flights > 1 or self.recorder.rules.when is When.WHILE_ARMED  # a new log begins here
            if self._arming_asked:
                self._retell()

    def _perform(self, effects: Iterable[Effect]) -> None:
        effects, unsaved = list(effects), False
        for line in self.journal.take(effects, self.core.watch.sysid):
            self.recorder.event(line)
        for effect in effects:
            match effect:
                case Send("PARAM_SET", _) if unsaved and self.core.recovery and self.core.recovery.stage is Stage.SETTING:
                    continue  # what could not be put back after a kill is not begun; the machine runs into its deadline
                case Send(message, fields):
                    raw = encode(message, fields, sysid=self.core.sysid, compid=self.core.compid, seq=self._seq)
                    self._seq = (self._seq + 1) % 256
                    for link in self.links:
                        link.send(raw)
                    self.recorder.frame(self._stamp_us, OWN_LINK, raw)
                case Save(record):
                    unsaved = not self._save(record)
            if self.observe is not None:
                self.observe(effect)

    def _save(self, record: str) -> bool:
        try:
            self.recorder.save_record(record)
        except OSError as error:
            self._disk_full(f"the recovery's record cannot be saved: {error.strerror or error}")
            return False
        return True

    def _watch_disk(self) -> None:
        for news in self.recorder.news():
            if news.name == "full":
                self._disk_full(news.text)
                continue
            self._perform([Tell(self._log_event(news))])
            if news.name in ("opened", "rotated"):
                self._full_told = False
                if news.reason != ARMED or not self._arming_asked:
                    self._retell()
        self._ask_untold()

    def _log_event(self, news: News) -> Event:
        event = Event(Kind.LOG, news.name, news.severity, news.text, reason=news.reason, details=news.details)
        return replace(event, utc_us=self.clock.now_us())

    def _retell(self) -> None:
        """A log that begins in mid-run must hold the vehicle's parameters too, or a replay of it judges nothing.

        The first log of a run holds them anyway; asking once more would make it differ from its replay.
        """
        if self.core.watch.known:
            self._untold = set(self.core.airframe.detector.parameters)
            self._retell_tries, self._retell_us = 0, 0

    def _ask_untold(self) -> None:
        """A recovery under way asks for its parameters itself, and is not to be mixed up by answers to somebody else."""
        now_us, recovery = self.clock.now_us(), self.core.recovery
        if not self._untold or now_us < self._retell_us or (recovery is not None and not recovery.ended):
            return
        if self._retell_tries >= RETELL_TRIES:
            self._untold.clear()
            return
        self._retell_tries += 1
        self._retell_us = now_us + RETELL_US
        target: Fields = {"target_system": self.core.watch.sysid or 0, "target_component": self.core.watch.compid or 0}
        self._perform(
            Send("PARAM_REQUEST_READ", {"param_id": name, "param_index": -1, **target}) for name in sorted(self._untold)
        )

    def _disk_full(self, text: str) -> None:
        if self._full_told:
            return
        self._full_told = True
        event = Event(Kind.LOG, "full", Severity.ERROR, text, utc_us=self.clock.now_us())
        fields: Fields = {"severity": SEVERITY_MAVLINK[Severity.ERROR], "text": "mavfdi: disk trouble, monitoring goes on"}
        self._perform([Tell(event), Send("STATUSTEXT", fields)])

    def counters(self) -> dict[str, Json]:
        """Of the links and the disk, besides those of the core."""
        wire = Counter(self._gone)
        for splitter in self._splitters.values():
            wire.update(splitter.counts)
        out: dict[str, Json] = {f"wire.{name}": count for name, count in sorted(wire.items())}
        for link in self.links:
            out.update({f"{link.name}.{name}": count for name, count in sorted(link.counts.items())})
        out["recorder.dropped"] = self.recorder.dropped
        return out

    def _finish(self, details: dict[str, Json]) -> dict[str, Json]:
        self._perform(self.core.farewell(self.clock.now_us()))
        self.recorder.settle()
        self._watch_disk()
        every: dict[str, Json] = {**counters(self.core), **self.counters()}
        self.recorder.event(self.journal.end(self.clock.now_us(), self.stop, every))
        content = summary(self.journal, self.core, {"counters": every, **details})
        self.recorder.close()
        self.recorder.summary(content)
        return content
