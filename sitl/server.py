"""The loop that puts a simulated autopilot on links: read, step when due, write.  One thread, no buffer of its own.

Lockstep makes a run over real sockets reproducible to the bit.  After the frames of a step the server sends TIMESYNC with
tc1 = 0 and its own boot time in ts1, and steps again only when an answer with that ts1 has come back: a listener that works
off its input in order has then processed everything before.  What it sent meanwhile is processed before the next step, and
answered with the next step's frames.  The listener is the first client that answers.
"""

import select
from collections.abc import Callable, Hashable, Sequence
from typing import Protocol

from sitl.autopilot import EVERYBODY, Autopilot
from sitl.clock import Clock

DATAGRAM_BYTES = 1400  # fits one Ethernet frame through any tunnel
MAINTENANCE_US = 50_000  # between two looks after the links
LOCKSTEP_LIMIT_S = 10.0  # of wall time for an answer once a listener was there
LOCKSTEP_ASK_S = 0.25  # between two attempts to find the listener
LONGEST_WAIT_S = 0.1


class Link(Protocol):
    """What the server needs of a link; none of it blocks or raises for a peer's sake."""

    name: str

    def filenos(self) -> list[int]:
        """What to wait on for reading; empty while the link is down."""

    def receive(self) -> list[tuple[Hashable, bytes]]:
        """What has arrived, by peer, a bounded amount."""

    def send(self, data: bytes, peer: Hashable | None = None) -> None:
        """To one peer, or to all that the link knows."""

    def maintain(self, now_us: int) -> None:
        """Open again what went away."""

    def close(self) -> None:
        """For good."""


class LockstepError(RuntimeError):
    """The listener of a lockstep run no longer answers."""


def serve(
    autopilot: Autopilot,
    links: Sequence[Link],
    clock: Clock,
    duration_s: float | None = None,
    on_step: Callable[[Autopilot], bool | None] | None = None,
) -> None:
    """Fly until duration_s of simulated time (None: for ever) or until on_step returns False.

    on_step is called after each step, its frames sent.  The links stay open.  Raises LockstepError in lockstep when the
    listener was there and does not answer for 10 s; before the first answer it waits as long as it takes.
    """
    traffic = _Traffic(autopilot, links, clock)
    listener = _Listener(traffic, autopilot, clock) if clock.lockstep else None
    end_us = None if duration_s is None else autopilot.elapsed_us + round(duration_s * 1e6)
    traffic.maintain()
    if listener is not None:
        listener.find()
    clock.wait_s(autopilot.elapsed_us)  # from here on it counts
    while end_us is None or autopilot.elapsed_us < end_us:
        wait_s = clock.wait_s(autopilot.elapsed_us + autopilot.dt_us)
        traffic.read(min(wait_s, LONGEST_WAIT_S))
        if wait_s > 0.0 and clock.wait_s(autopilot.elapsed_us + autopilot.dt_us) > 0.0:
            traffic.write()
            continue
        autopilot.step()
        traffic.write()
        if listener is not None:
            listener.follow()
        if on_step is not None and on_step(autopilot) is False:
            break


class _Traffic:
    """Bytes between the autopilot and its links."""

    def __init__(self, autopilot: Autopilot, links: Sequence[Link], clock: Clock) -> None:
        names = [link.name for link in links]
        if len(set(names)) < len(names):
            raise ValueError(f"two links have the same name: {', '.join(names)}")
        self._autopilot = autopilot
        self._links = {link.name: link for link in links}
        self._clock = clock
        self._maintain_us = 0
        self._heard: tuple[Hashable, ...] = ()
        self._unheard = tuple(links)
        autopilot.everybody = bool(links)

    def maintain(self) -> None:
        now_us = self._clock.now_us()
        if now_us >= self._maintain_us:
            self._maintain_us = now_us + MAINTENANCE_US
            for link in self._links.values():
                link.maintain(now_us)

    def read(self, wait_s: float) -> bool:
        """Wait for bytes, at most this long, and hand them on; each link is read once.  False if nothing had come."""
        self.maintain()
        waiting = [fileno for link in self._links.values() for fileno in link.filenos()]
        ready = set(select.select(waiting, (), (), wait_s)[0])
        if not ready:
            return False
        for link in self._links.values():
            if ready.intersection(link.filenos()):
                for peer, data in link.receive():
                    self._autopilot.receive((link.name, peer), data)
        if self._autopilot.clients != self._heard:
            self._heard = self._autopilot.clients
            names = {key[0] for key in self._heard if isinstance(key, tuple)}
            self._unheard = tuple(link for link in self._links.values() if link.name not in names)
            self._autopilot.everybody = bool(self._unheard)
        return True

    def write(self) -> None:
        """Send what the autopilot has to say, as few datagrams as it fits in; a frame is never cut in two."""
        waiting: dict[Hashable, list[bytes]] = {}
        for key, frame in self._autopilot.outgoing():
            waiting.setdefault(key, []).append(frame)
        for key, frames in waiting.items():
            start, size = 0, 0
            for index, frame in enumerate(frames):
                if size + len(frame) > DATAGRAM_BYTES:
                    self._send(key, b"".join(frames[start:index]))
                    start, size = index, 0
                size += len(frame)
            self._send(key, b"".join(frames[start:]))

    def _send(self, key: Hashable, data: bytes) -> None:
        if isinstance(key, tuple):
            self._links[key[0]].send(data, key[1])
        else:
            for link in self._unheard:
                link.send(data, None)


class _Listener:
    """The one client that the simulation waits for."""

    def __init__(self, traffic: _Traffic, autopilot: Autopilot, clock: Clock) -> None:
        self._traffic = traffic
        self._autopilot = autopilot
        self._clock = clock
        self._key: Hashable = None

    def find(self) -> None:
        """Wait, as long as it takes, for the first client that answers; time stands still.

        A heartbeat goes along, since nobody answers a vehicle that it has not heard of.
        """
        while self._key is None:
            self._autopilot.send_heartbeat()
            everybody = (EVERYBODY,) if self._autopilot.everybody else ()
            ts1_ns = self._autopilot.ask_time((*everybody, *self._autopilot.clients))
            self._traffic.write()
            ask_us = self._clock.now_us() + round(LOCKSTEP_ASK_S * 1e6)
            while self._key is None and (left_us := ask_us - self._clock.now_us()) > 0:
                self._traffic.read(left_us * 1e-6)
                answers = self._autopilot.time_answers.items()
                self._key = next((key for key, answered_ns in answers if answered_ns == ts1_ns), None)
                if self._key is None:
                    self._traffic.write()  # while time stands still nothing else would answer those who ask

    def follow(self) -> None:
        """Wait until the listener has processed the step.  A vehicle that reboots sends nothing, and waits for nobody."""
        if self._autopilot.silent:
            return
        if self._key not in self._autopilot.clients:
            raise LockstepError(f"lockstep: {self._key} was crowded out by other clients")
        ts1_ns = self._autopilot.ask_time((self._key,))
        self._traffic.write()
        end_us = self._clock.now_us() + round(LOCKSTEP_LIMIT_S * 1e6)
        while self._autopilot.time_answers.get(self._key) != ts1_ns:
            left_us = end_us - self._clock.now_us()
            if left_us <= 0:
                raise LockstepError(
                    f"lockstep: {self._key} has not answered TIMESYNC for {LOCKSTEP_LIMIT_S:.0f} s "
                    f"at {self._autopilot.time_us * 1e-6:.1f} s after boot; is it still running?"
                )
            self._traffic.read(min(left_us * 1e-6, LONGEST_WAIT_S))
            if self._autopilot.silent:
                return  # told to reboot meanwhile
