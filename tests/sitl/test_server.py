"""The autopilot on real links: UDP both ways, TCP, pacing, lockstep."""

import contextlib
import math
import socket
import threading
import time

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion import address
from companion.link import open_link
from sitl.autopilot import Misbehaviour
from sitl.clock import Clock
from sitl.server import DATAGRAM_BYTES, LockstepError, serve
from tests.sitl.network import message, sled_autopilot

LIMIT_S = 20.0  # for anything in this file to happen


def free_port(kind=socket.SOCK_DGRAM):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def links(*texts):
    opened = [open_link(address.parse(text)) for text in texts]
    try:
        yield opened
    finally:
        for link in opened:
            link.close()


class Server:
    """`serve` in a thread; its exception comes out of `join`."""

    def __init__(self, autopilot, opened, clock, duration_s=None):
        self.autopilot = autopilot
        self.error = None
        self.stop = threading.Event()
        self.thread = threading.Thread(target=self._run, args=(opened, clock, duration_s), daemon=True)
        self.thread.start()

    def _run(self, opened, clock, duration_s):
        try:
            serve(self.autopilot, opened, clock, duration_s, lambda _: not self.stop.is_set())
        except Exception as error:  # noqa: BLE001  # carried to the test
            self.error = error

    def join(self):
        self.thread.join(LIMIT_S)
        assert not self.thread.is_alive()
        if self.error is not None:
            raise self.error


class UdpPeer:
    """A peer over UDP: bound to `port` to listen (the vehicle speaks first), or speaking to `target` first."""

    def __init__(self, port=0, target=None, system=255, component=190):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        self.socket.bind(("127.0.0.1", port))
        self.socket.settimeout(LIMIT_S)
        self.target = target
        self.mav = dialect.MAVLink(None, system, component)
        self.parser = dialect.MAVLink(None)
        self.datagrams = []

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def say(self, name, **fields):
        self.socket.sendto(message(name, **fields).pack(self.mav), self.target)
        self.mav.seq = (self.mav.seq + 1) % 256

    def beat(self):
        self.say("HEARTBEAT", type=6, autopilot=8)

    def messages(self):
        """The next datagram, decoded; raises TimeoutError when none comes."""
        data, self.target = self.socket.recvfrom(65536)
        self.datagrams.append(data)
        return self.parser.parse_buffer(data) or []

    def wait_for(self, wanted):
        """Messages until one is as wanted; the last is that one."""
        end_s = time.monotonic() + LIMIT_S
        heard = []
        while time.monotonic() < end_s:
            for m in self.messages():
                heard.append(m)
                if wanted(m):
                    return heard
        raise AssertionError(f"did not come; heard {sorted({m.get_type() for m in heard})}")

    def waiting(self):
        """Datagrams that are there already."""
        self.socket.setblocking(False)
        found = []
        with contextlib.suppress(BlockingIOError):
            while True:
                found.append(self.socket.recv(65536))
        self.socket.settimeout(LIMIT_S)
        return found


def kind(name):
    return lambda m: m.get_type() == name


def test_who_listens_is_spoken_to_before_it_has_said_a_word():
    port = free_port()
    with UdpPeer(port) as peer, links(f"udpout:127.0.0.1:{port}") as opened:
        serve(sled_autopilot(), opened, Clock(math.inf), 2.0)
        kinds = {m.get_type() for data in peer.waiting() for m in peer.parser.parse_buffer(data) or []}
    assert {"HEARTBEAT", "GLOBAL_POSITION_INT", "WHEEL_DISTANCE", "SYS_STATUS"} <= kinds


def test_datagrams_hold_whole_frames_and_as_many_as_fit():
    port = free_port()
    autopilot = sled_autopilot(misbehaviour=Misbehaviour(flood_hz=1000.0))
    with UdpPeer(port) as peer, links(f"udpout:127.0.0.1:{port}") as opened:
        serve(autopilot, opened, Clock(math.inf), 1.0)
        datagrams = peer.waiting()
    assert all(len(data) <= DATAGRAM_BYTES for data in datagrams)
    assert max(len(data) for data in datagrams) > DATAGRAM_BYTES - 100
    for data in datagrams:
        parser = dialect.MAVLink(None)  # raises at anything that is no whole frame
        assert sum(len(m.get_msgbuf()) for m in parser.parse_buffer(data)) == len(data)


def test_a_client_that_speaks_to_the_vehicles_port_is_served_there():
    port = free_port()
    autopilot = sled_autopilot()
    with UdpPeer(target=("127.0.0.1", port)) as peer, links(f"udpin:127.0.0.1:{port}") as opened:
        server = Server(autopilot, opened, Clock(100.0))
        peer.beat()
        heard = peer.wait_for(kind("VFR_HUD"))
        peer.say("PARAM_REQUEST_READ", target_system=1, target_component=1, param_id="SLED_SPEED", param_index=-1)
        assert peer.wait_for(kind("PARAM_VALUE"))[-1].param_value == 8.0
        server.stop.set()
        server.join()
    assert {m.get_srcSystem() for m in heard} == {1}


def test_words_go_from_a_client_on_one_link_to_a_listener_on_another():
    out, port = free_port(), free_port()
    autopilot = sled_autopilot()
    with (
        UdpPeer(out) as listener,
        UdpPeer(target=("127.0.0.1", port), system=1, component=191) as companion,
        links(f"udpout:127.0.0.1:{out}", f"udpin:127.0.0.1:{port}") as opened,
    ):
        server = Server(autopilot, opened, Clock(10.0))
        companion.beat()
        companion.wait_for(kind("HEARTBEAT"))
        companion.say("STATUSTEXT", severity=2, text="mavfdi: control lines crossed")
        texts = listener.wait_for(lambda m: m.get_srcComponent() == 191 and m.get_type() == "STATUSTEXT")
        server.stop.set()
        server.join()
    assert texts[-1].text == "mavfdi: control lines crossed"


def test_a_tcp_client_is_served_from_the_moment_it_connects():
    port = free_port(socket.SOCK_STREAM)
    with links(f"tcpin:127.0.0.1:{port}") as opened:
        server = Server(sled_autopilot(), opened, Clock(20.0))
        parser = dialect.MAVLink(None)
        with socket.create_connection(("127.0.0.1", port), LIMIT_S) as client:
            kinds = set()
            while "GLOBAL_POSITION_INT" not in kinds:
                data = client.recv(4096)
                assert data
                kinds |= {m.get_type() for m in parser.parse_buffer(data) or []}
        server.stop.set()
        server.join()


def test_simulated_time_keeps_pace_with_the_wall():
    start_s = time.monotonic()
    autopilot = sled_autopilot()
    serve(autopilot, [], Clock(20.0), 4.0)
    assert time.monotonic() - start_s >= 0.2
    assert autopilot.elapsed_us == 4_000_000


def test_the_run_ends_when_the_one_who_watches_it_says_so():
    autopilot = sled_autopilot()
    serve(autopilot, [], Clock(math.inf), None, lambda a: a.elapsed_us < 3_000_000)
    assert autopilot.elapsed_us == 3_000_000


def test_two_links_of_one_name_are_refused():
    port = free_port()
    with (
        links(f"udpout:127.0.0.1:{port}", f"udpout:127.0.0.1:{port}") as opened,
        pytest.raises(ValueError, match="same name"),
    ):
        serve(sled_autopilot(), opened, Clock(math.inf), 1.0)


# Lockstep


def nothing(_time_ms):
    pass


def follow(peer, until_ms, at_step=nothing):
    """A listener in lockstep: works off its input in order, answers TIMESYNC; -> all frames since the first step."""
    frames, time_ms = [], 0
    while time_ms < until_ms:
        for m in peer.messages():
            if m.get_type() == "TIMESYNC" and m.tc1 == 0:
                time_ms = m.ts1 // 1_000_000
                at_step(time_ms)
                peer.say("TIMESYNC", tc1=1, ts1=m.ts1)
                if time_ms >= until_ms:
                    break
            if time_ms or m.get_type() not in ("HEARTBEAT", "TIMESYNC"):
                frames.append(bytes(m.get_msgbuf()))
    return frames


def lockstep_flight(stall=nothing, reboot_ms=None):
    port = free_port()
    autopilot = sled_autopilot(seed=5, rates="fast")
    with UdpPeer(port, system=1, component=191) as peer, links(f"udpout:127.0.0.1:{port}") as opened:
        server = Server(autopilot, opened, Clock(lockstep=True), 8.0)

        def at_step(time_ms):
            stall(time_ms)
            if time_ms == 6000:
                peer.say("PARAM_SET", target_system=1, target_component=1, param_id="SLED_SPEED", param_value=12.0)
                peer.say("PARAM_REQUEST_READ", target_system=1, target_component=1, param_id="SLED_SPEED", param_index=-1)
            if time_ms == reboot_ms and autopilot.elapsed_us == time_ms * 1000:  # the first boot
                peer.say("COMMAND_LONG", target_system=1, target_component=1, command=246, param1=1.0)

        frames = follow(peer, 8000 if reboot_ms is None else 8000 - reboot_ms, at_step)
        server.join()
    return frames, autopilot


def test_a_run_in_lockstep_over_udp_is_the_same_to_the_bit_however_the_listener_dawdles():
    frames, _ = lockstep_flight()
    busy = 0

    def dawdle(time_ms):
        nonlocal busy
        for number in range(time_ms % 70 * 300):
            busy += number

    again, _ = lockstep_flight(dawdle)
    assert len(frames) > 1000
    assert frames == again


def test_in_lockstep_what_the_listener_says_acts_at_the_very_next_step():
    frames, autopilot = lockstep_flight()
    parser = dialect.MAVLink(None)
    heard = [m for raw in frames for m in parser.parse_buffer(raw)]
    asked = next(n for n, m in enumerate(heard) if m.get_type() == "TIMESYNC" and m.ts1 == 6_000_000_000)
    assert [m.get_type() for m in heard[asked + 1 : asked + 3]] == ["PARAM_VALUE", "PARAM_VALUE"]
    following = next(m for m in heard[asked:] if m.get_type() == "POSITION_TARGET_LOCAL_NED")
    assert (following.time_boot_ms, following.vx) == (6100, 15.0)
    assert autopilot.elapsed_us == 8_000_000


def test_in_lockstep_time_stands_still_until_somebody_answers():
    port = free_port()
    autopilot = sled_autopilot()
    with UdpPeer(port) as peer, links(f"udpout:127.0.0.1:{port}") as opened:
        server = Server(autopilot, opened, Clock(lockstep=True), 1.0)
        for _ in range(2):  # it goes on asking
            peer.wait_for(kind("TIMESYNC"))
        assert autopilot.elapsed_us == 0
        peer.say("PARAM_REQUEST_READ", target_system=1, target_component=1, param_id="SLED_SPEED", param_index=-1)
        peer.wait_for(kind("PARAM_VALUE"))  # and goes on answering
        assert autopilot.elapsed_us == 0
        follow(peer, 1000)
        server.join()
    assert autopilot.elapsed_us == 1_000_000


def test_in_lockstep_a_reboot_does_not_stop_the_run():
    _, autopilot = lockstep_flight(reboot_ms=3000)
    assert autopilot.elapsed_us == 8_000_000
    assert autopilot.time_us == 5_000_000


def test_a_listener_that_stops_answering_ends_a_lockstep_run_with_an_error_that_says_so():
    port = free_port()
    gone = threading.Event()
    jumps_s = 0.0

    def wall_s():
        nonlocal jumps_s
        jumps_s += 1.0 if gone.is_set() else 0.0
        return time.monotonic() + jumps_s

    with UdpPeer(port) as peer, links(f"udpout:127.0.0.1:{port}") as opened:
        server = Server(sled_autopilot(), opened, Clock(lockstep=True, monotonic_s=wall_s), 100.0)
        follow(peer, 2000)
        gone.set()
        with pytest.raises(LockstepError, match=r"has not answered TIMESYNC for 10 s at 2\.1 s after boot"):
            server.join()
