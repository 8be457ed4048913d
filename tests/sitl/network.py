"""A network without sockets: one simulated autopilot and peers that speak through pymavlink's own packing and parsing."""

import tomllib
from collections.abc import Hashable
from importlib import resources
from pathlib import Path

import msgspec
from pymavlink.dialects.v20 import all as dialect

from sitl.autopilot import EVERYBODY, Autopilot
from tests.toy_airframe.sled import sitl as sled

SLED_TOML = Path(__file__).parents[1] / "toy_airframe" / "sled" / "airframe.toml"
CLASSES = {message.msgname: message for message in dialect.mavlink_map.values()}


def sled_config(**changes):
    table = tomllib.loads(SLED_TOML.read_text(encoding="utf-8"))["sitl"]
    return msgspec.convert(table | changes, sled.Config)


def sled_autopilot(*, seed=1, fault=None, config=None, **options):
    fleet = sled.Fleet(config if config is not None else sled_config(), [seed], [fault])
    return Autopilot(sled.VEHICLE, fleet, **options)


def parafoil_autopilot(*, seed=1, fault=None, release_s=1.0, **options):
    from sitl import parafoil  # numba: only for the tests that fly it

    table = tomllib.loads(resources.files("configs").joinpath("parafoil.toml").read_text(encoding="utf-8"))
    fleet = parafoil.Fleet(msgspec.convert(table["sitl"], parafoil.Config), [seed], [fault])
    return Autopilot(parafoil.VEHICLE, fleet, release_s=release_s, **options)


def message(name, /, **fields):
    """A pymavlink message; fields not given are zero."""
    cls = CLASSES[name]
    values = {}
    for field, kind in zip(cls.fieldnames, cls.fieldtypes, strict=True):
        length = cls.lengths[cls.ordered_fieldnames.index(field)]
        values[field] = b"" if kind == "char" else [0] * length if length > 1 else 0
    return cls(**(values | {k: v.encode() if isinstance(v, str) else v for k, v in fields.items()}))


class Peer:
    def __init__(self, network, key, system, component, version):
        self.network, self.key, self.version = network, key, version
        self.mav = dialect.MAVLink(None, system, component)
        self.parser = dialect.MAVLink(None)
        self.frames = []

    def frame(self, name, /, **fields):
        raw = message(name, **fields).pack(self.mav, force_mavlink1=self.version == 1)
        self.mav.seq = (self.mav.seq + 1) % 256
        return raw

    def say(self, name, /, **fields):
        """Send one message; -> its bytes."""
        raw = self.frame(name, **fields)
        self.network.autopilot.receive(self.key, raw)
        return raw

    def beat(self):
        return self.say("HEARTBEAT", type=6, autopilot=8)

    def command(self, command, *params, confirmation=0, target=(1, 1)):
        named = {f"param{i + 1}": float(value) for i, value in enumerate(params)}
        self.say(
            "COMMAND_LONG", command=command, confirmation=confirmation, target_system=target[0],
            target_component=target[1], **named,
        )  # fmt: skip
        return self.heard("COMMAND_ACK")

    def set(self, name, value, kind=9):
        self.say("PARAM_SET", target_system=1, target_component=1, param_id=name, param_value=value, param_type=kind)
        return self.heard("PARAM_VALUE")

    def read(self, name):
        self.say("PARAM_REQUEST_READ", target_system=1, target_component=1, param_id=name, param_index=-1)
        return self.heard("PARAM_VALUE")

    def raw(self):
        """Frames that arrived since the last look."""
        self.network.deliver()
        frames, self.frames = self.frames, []
        return frames

    def heard(self, name=None):
        """Messages that arrived since the last look, of one kind or all; the others are gone, too."""
        messages = [m for frame in self.raw() for m in self.parser.parse_buffer(frame)]
        return [m for m in messages if name in (None, m.get_type())]


class Network:
    """Peers around one autopilot; `run` lets time pass."""

    def __init__(self, autopilot=None, **options):
        self.autopilot = autopilot if autopilot is not None else sled_autopilot(**options)
        self.peers: dict[Hashable, Peer] = {}
        self.everybody = self._add(EVERYBODY, 0, 0, 2)

    def _add(self, key, system, component, version):
        peer = self.peers[key] = Peer(self, key, system, component, version)
        return peer

    def peer(self, key="gcs", system=255, component=190, version=2, *, quiet=False):
        """A peer that has beaten once, and forgets what it has heard for that (quiet: not even that)."""
        peer = self._add(key, system, component, version)
        if not quiet:
            peer.beat()
            self.forget()
        return peer

    def deliver(self):
        for key, frame in self.autopilot.outgoing():
            self.peers[key].frames.append(frame)

    def forget(self):
        self.deliver()
        for peer in self.peers.values():
            peer.frames.clear()

    def run(self, seconds):
        for _ in range(round(seconds / self.autopilot.dt_s)):
            self.autopilot.step()
            self.deliver()
