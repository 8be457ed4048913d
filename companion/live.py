"""The live loop: links on one side, the pure core on the other, one thread that owns all state.

It moves bytes, stamps, records and lines; what they mean is decided in `companion/core.py`, which reading a log calls too.
"""

import select
import time
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20.all import MAV_COMP_ID_AUTOPILOT1

from companion.clock import Clock
from companion.core import Core
from companion.dialect import Fields, encode
from companion.effects import Effect, Save, Send, Tell
from companion.events import SEVERITY_MAVLINK, Event, Json, Kind, Severity
from companion.frames import Frame, Splitter
from companion.journal import Journal, counters, summary
from companion.link import Link
from companion.recorder import Recorder
from companion.recovery import Stage
from companion.tlog import OWN_LINK

PAUSE_S: Final = 0.02  # between two looks while nothing arrives
MAINTENANCE_US: Final = 200_000
PEERS: Final = 64  # byte streams kept apart at the most


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
    _seq: int = 0
    _maintained_us: int = 0
    _full_told: bool = False

    def run(
        self,
        duration_s: float | None = None,
        details: dict[str, Json] | None = None,
        ended: Callable[[], str] | None = None,
    ) -> dict[str, Json]:
        """Until told to stop, for duration_s of the clock, or until `ended` says why; -> the summary, also written."""
        began_us = self.clock.now_us()
        extra: dict[str, Json] = {"policy": self.core.policy.value, "links": [link.name for link in self.links]}
        self.recorder.event(self.journal.begin(began_us, extra | (details or {})))
        while not self.stop:
            if duration_s is not None and self.clock.now_us() - began_us >= round(duration_s * 1e6):
                self.stop = "duration reached"
            if self._maintain() and ended is not None and (why := ended()):
                self.stop = why
            self._read()
            self._perform(self.core.tick(self.clock.now_us()))
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
        waiting = [fileno for link in self.links for fileno in link.filenos()]
        ready = set(select.select(waiting, (), (), self.clock.wait_s(PAUSE_S))[0])
        for number, link in enumerate(self.links):
            if not ready.intersection(link.filenos()):
                continue
            for peer, data in link.receive():
                for frame in self._splitter(link.name, peer).feed(data):
                    self._take(frame, min(number, OWN_LINK - 1))

    def _splitter(self, link: str, peer: Hashable) -> Splitter:
        found = self._splitters.get((link, peer))
        if found is None:
            if len(self._splitters) >= PEERS:
                oldest = next(iter(self._splitters))
                self._gone.update(self._splitters.pop(oldest).counts)
            found = self._splitters[link, peer] = Splitter()
        return found

    def _take(self, frame: Frame, link: int) -> None:
        if frame.name == "TIMESYNC" and frame.compid == MAV_COMP_ID_AUTOPILOT1:
            fields = frame.fields()
            asked_ns = fields["ts1"]
            if fields["tc1"] == 0 and isinstance(asked_ns, int):
                self.clock.advance_to(asked_ns // 1000)
        stamp_us = self.clock.now_us()
        self.recorder.frame(stamp_us, link, frame.raw)
        self._perform(self.core.frame(frame, stamp_us))

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
                    self.recorder.frame(self.clock.now_us(), OWN_LINK, raw)
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
        if self.recorder.failed:
            self._disk_full(f"recording stopped: {self.recorder.failed}; monitoring goes on")

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
        every: dict[str, Json] = {**counters(self.core), **self.counters()}
        self.recorder.event(self.journal.end(self.clock.now_us(), self.stop, every))
        content = summary(self.journal, self.core, {"counters": every, **details})
        self.recorder.close()
        self.recorder.summary(content)
        return content
