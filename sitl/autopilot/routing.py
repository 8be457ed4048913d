"""Who is on the other end of the links, and which frames go to whom.

A client is one peer on one link.  Frames are forwarded as they came, signed or unknown to us included.
Source: MAVLink guide, "Routing"; ArduPilot MAVLink_routing.cpp.
"""

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import all as dialect

from sitl.autopilot.frames import MARKER_V2, Packed, frame_v1, frame_v2
from sitl.autopilot.misbehaviour import BadLink

BROADCAST = 0
MOST_CLIENTS = 16  # a peer that changes its port each time must not grow the process

# Said for one link only: radios speak of their own link, and a time exchange that took a detour measures nothing.
NOT_FORWARDED = frozenset({"RADIO_STATUS", "RADIO", "TIMESYNC"})


class Everybody:
    """Key of whoever listens on links where nobody was heard yet."""

    def __repr__(self) -> str:
        return "EVERYBODY"


EVERYBODY = Everybody()


@dataclass(slots=True)
class Due:
    """A message that goes to a client regularly."""

    at_us: int  # boot clock
    interval_us: int
    source: int  # index into the autopilot's table of messages


@dataclass(slots=True)
class Client:
    """What the autopilot knows of one peer."""

    key: Hashable
    bad_link: BadLink
    parser: dialect.MAVLink
    valid: bool = False  # a whole, known frame came from it
    speaks_v2: bool = False
    sequence: int = 0
    schedule: list[Due] = field(default_factory=list)
    intervals_us: dict[int, int] = field(default_factory=dict)  # by message id: what it asked for; 0 = off
    parameters_left: deque[int] = field(default_factory=deque)  # of a PARAM_REQUEST_LIST under way
    outbox: list[bytes] = field(default_factory=list)
    undisturbed: list[bytes] = field(default_factory=list)  # frames of the simulation itself, which no link spoils
    heard_at: int = 0  # order of hearing

    def frame(self, message: Packed, sysid: int, compid: int) -> bytes:
        """The message in this client's version of MAVLink, numbered; empty if that version has no place for it.

        MAVLink 2 until a client has been heard that speaks MAVLink 1 and nothing else.
        """
        build = frame_v1 if self.valid and not self.speaks_v2 else frame_v2
        frame = build(message, self.sequence, sysid, compid)
        if frame:
            self.sequence = (self.sequence + 1) & 0xFF
        return frame

    def hear(self, raw: bytes) -> bool:
        """Note a good frame; whether it is the first."""
        first = not self.valid
        self.valid = True
        self.speaks_v2 = self.speaks_v2 or raw[0] == MARKER_V2
        return first


class Routes:
    """Where every system and component was heard."""

    def __init__(self) -> None:
        self._heard: dict[tuple[int, int], set[Hashable]] = {}

    def learn(self, system: int, component: int, client: Hashable) -> None:
        """A frame of this component came from this client.  Zero is an address, never a source."""
        if system != BROADCAST and component != BROADCAST:
            self._heard.setdefault((system, component), set()).add(client)

    def knows(self, system: int, component: int) -> bool:
        """Whether this component was heard anywhere."""
        return (system, component) in self._heard

    def forget(self, client: Hashable) -> None:
        """The client is gone."""
        for clients in self._heard.values():
            clients.discard(client)
        self._heard = {address: clients for address, clients in self._heard.items() if clients}

    def clear(self) -> None:
        """Forget everything, as a reboot does."""
        self._heard.clear()

    def leads(self, system: int, component: int, client: Hashable) -> bool:
        """Whether a frame for this address goes to this client; component 0 is every component of the system."""
        if system == BROADCAST:
            return True
        if component != BROADCAST:
            return client in self._heard.get((system, component), ())
        return any(client in clients for (heard, _), clients in self._heard.items() if heard == system)


def is_ours(sysid: int, compid: int, system: int, component: int, routes: Routes) -> bool:
    """Whether an autopilot with these ids processes a frame for this address itself.

    Also what is meant for a component of its own system that nobody has heard yet (guide, "Routing", last condition).
    """
    if system not in (BROADCAST, sysid):
        return False
    return system == BROADCAST or component in (BROADCAST, compid) or not routes.knows(system, component)
