"""Links that break and come back: serial, UDP, TCP, two at once; the real commands on both sides."""

import contextlib
import os
import select
import socket
import threading
import tty

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion.events import Kind, same_events
from tests.sitl.test_server import UdpPeer, free_port, kind
from tests.system import flights
from tests.system.flights import CROSSED, LIMIT_S, Flight, flying, names, watching

RATE = "10"  # times real time: five seconds of silence are half a second, and a busy machine may stall for less


SILENCE = ["link/up", "link/silent", "link/lost", "link/up"]


def crossing():
    """A ground station's words that cross the simulated vehicle's control lines now."""
    ground = dialect.MAVLink(None, 255, 190)
    settings = (("SIM_FLT_TIME", -1.0), ("SIM_FLT_TYPE", 4.0))
    return b"".join(
        dialect.MAVLink_param_set_message(1, 1, name.encode(), value, 9).pack(ground) for name, value in settings
    )  # fmt: skip


class Cable:
    """Two serial devices joined by a cable; the companion's end can be pulled out and put in again."""

    def __init__(self, folder):
        self.vehicle, self.companion = folder / "vehicle", folder / "companion"
        self._masters = {}
        self._slaves = {}
        for end in (self.vehicle, self.companion):
            self._plug(end)
        self._lock = threading.Lock()
        self._stop, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._pump, daemon=True)
        self._thread.start()

    def _plug(self, end):
        self._masters[end], slave = os.openpty()
        os.set_blocking(self._masters[end], False)
        tty.setraw(slave)
        self._slaves[end] = slave  # held open: a master without any slave reads as an error
        end.unlink(missing_ok=True)
        end.symlink_to(os.ttyname(slave))

    def pull(self):
        """The device goes away under the companion."""
        with self._lock:
            os.close(self._masters.pop(self.companion))
            os.close(self._slaves.pop(self.companion))
            self.companion.unlink()

    def put(self):
        with self._lock:
            self._plug(self.companion)

    def say(self, raw):
        """A ground station's frame to the vehicle."""
        with self._lock:
            os.write(self._masters[self.vehicle], raw)

    def _pump(self):
        while True:
            with self._lock:
                ends = dict(self._masters)
            if self._stop in select.select([self._stop, *ends.values()], (), (), 0.05)[0]:
                return
            with self._lock:
                for end, other in ((self.vehicle, self.companion), (self.companion, self.vehicle)):
                    self._move(self._masters.get(end), self._masters.get(other))

    @staticmethod
    def _move(source, target):
        """What has arrived goes on; what nobody takes is lost, as on a wire."""
        if source is None:
            return
        with contextlib.suppress(BlockingIOError, OSError):
            data = os.read(source, 4096)
            if target is not None:
                os.write(target, data)

    def close(self):
        os.write(self._wake, b"x")
        self._thread.join(LIMIT_S)
        for handle in (*self._masters.values(), *self._slaves.values(), self._stop, self._wake):
            os.close(handle)


@pytest.fixture
def cable(tmp_path):
    made = Cable(tmp_path)
    yield made
    made.close()


class Relay:
    """UDP datagrams handed on between vehicle and companion, unless told to lose them."""

    def __init__(self):
        self.towards_vehicle = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.towards_companion = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        for made in (self.towards_vehicle, self.towards_companion):
            made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            made.bind(("127.0.0.1", 0))
        self.port = self.towards_vehicle.getsockname()[1]
        self.companion_port = free_port()
        self.open = True
        self._vehicle = None
        self._stop, self._wake = socket.socketpair()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        while True:
            ready = select.select([self._stop, self.towards_vehicle, self.towards_companion], (), ())[0]
            if self._stop in ready:
                return
            if self.towards_vehicle in ready:
                data, self._vehicle = self.towards_vehicle.recvfrom(65536)
                if self.open:
                    self.towards_companion.sendto(data, ("127.0.0.1", self.companion_port))
            if self.towards_companion in ready:
                with contextlib.suppress(ConnectionRefusedError):
                    data = self.towards_companion.recv(65536)
                    if self.open and self._vehicle:
                        self.towards_vehicle.sendto(data, self._vehicle)

    def say(self, raw):
        """A ground station's datagram to the vehicle."""
        self.towards_vehicle.sendto(raw, self._vehicle)

    def close(self):
        self._wake.send(b"x")
        self._thread.join(LIMIT_S)
        for made in (self.towards_vehicle, self.towards_companion, self._stop, self._wake):
            made.close()


@pytest.fixture
def relay():
    made = Relay()
    yield made
    made.close()


def test_a_serial_line_carries_a_flight_to_the_same_events_as_any_other_link(cable, tmp_path):
    out = tmp_path / "out"
    with (
        watching(out, f"{cable.companion},57600") as run,
        flying(f"{cable.vehicle},57600", seed=2, fault=CROSSED) as simulator,
    ):
        assert simulator.ended() == 0, simulator.text
        assert run.stop() == 0, run.text
    assert same_events(flights.events(out / "events.jsonl"), Flight(2, CROSSED).fly().lines) is None


def test_a_serial_device_pulled_out_and_put_in_again_is_a_link_event_and_monitoring_goes_on(cable, tmp_path):
    out = tmp_path / "out"
    with (
        watching(out, f"{cable.companion},57600", speedup=RATE) as run,
        flying(f"{cable.vehicle},57600", seed=2, speedup=RATE, duration_s=3600.0),
    ):
        run.wait_for("vehicle/armed")
        cable.pull()
        run.wait_for("link/lost")
        cable.put()
        run.wait_for("link/up")
        cable.say(crossing())
        run.wait_for("fault/detected")
        assert run.stop() == 0, run.text
    lines = flights.events(out / "events.jsonl")
    assert names(lines, "link", "fault")[:5] == [*SILENCE, "fault/detected"]
    assert lines[-1]["counters"][f"serial:{cable.companion}:57600.lost"] == 1
    assert lines[-1]["counters"][f"serial:{cable.companion}:57600.reopened"] >= 1


def test_a_silence_of_half_a_minute_over_udp_is_told_as_silence_and_no_fault_and_faults_after_it_are_found(relay, tmp_path):
    with (
        watching(tmp_path, f"udpin:127.0.0.1:{relay.companion_port}", speedup=RATE) as run,
        flying(f"udpout:127.0.0.1:{relay.port}", seed=2, speedup=RATE, duration_s=3600.0),
    ):
        run.wait_for("vehicle/armed")
        relay.open = False
        run.wait_for("link/silent")
        run.wait_for("link/lost")
        relay.open = True
        run.wait_for("link/up")
        relay.say(crossing())
        run.wait_for("recovery/verified")
        assert run.stop() == 0, run.text
    lines = flights.events(tmp_path / "events.jsonl")
    assert names(lines, "link", "fault")[:5] == [*SILENCE, "fault/detected"]
    silent, lost, back = [line["t"] for line in lines if line["kind"] == "link"][1:]
    assert lost - silent == pytest.approx(25.0, abs=0.01)
    assert back > lost


def test_silence_is_told_at_its_very_moments_raises_no_alarm_and_rows_come_again_after_it():
    flight = Flight(2).fly(30.0)
    heard_us = flight.core.watch.heard_us
    flight.hear_nothing(40.0)
    assert flight.names("link") == SILENCE[:3]
    silences_us = [event.utc_us - heard_us for event in flight.told if event.kind is Kind.LINK][1:]
    assert silences_us == [5_000_000, 30_000_000]
    rows = flight.core.counts["rows"]
    flight.fly(60.0)
    assert flight.names("link") == SILENCE
    assert flight.core.counts["rows"] - rows >= 598
    assert flight.names("fault", "recovery") == []
    assert flight.core.parameters == dict(zip(flights.OUTPUTS, flights.ORIGINAL, strict=True))


@pytest.mark.parametrize(("companion", "vehicle"), [("tcpin", "tcp"), ("tcp", "tcpin")])
def test_tcp_carries_a_flight_whoever_of_the_two_is_the_server(companion, vehicle, tmp_path):
    port = free_port(socket.SOCK_STREAM)
    with (
        watching(tmp_path, f"{companion}:127.0.0.1:{port}") as run,
        flying(f"{vehicle}:127.0.0.1:{port}", seed=2, fault=CROSSED) as simulator,
    ):
        assert simulator.ended() == 0, simulator.text
        assert run.stop() == 0, run.text
    assert same_events(flights.events(tmp_path / "events.jsonl"), Flight(2, CROSSED).fly().lines) is None


def test_tcp_server_that_is_restarted_is_connected_to_again(tmp_path):
    port = free_port(socket.SOCK_STREAM)
    with watching(tmp_path, f"tcp:127.0.0.1:{port}", speedup=RATE) as run:
        # The first flight must be further on than the second one is when it is heard: so it ends by itself, not by a kill.
        with flying(f"tcpin:127.0.0.1:{port}", seed=2, speedup=RATE, duration_s=60.0) as simulator:
            run.wait_for("vehicle/armed")
            simulator.process.wait(30.0)
        run.wait_for("link/silent")
        with flying(f"tcpin:127.0.0.1:{port}", seed=3, speedup=RATE, duration_s=3600.0):
            run.wait_for("link/up")
            run.wait_for("vehicle/reboot")
            assert run.stop() == 0, run.text
    assert names(flights.events(tmp_path / "events.jsonl"), "fault", "recovery") == []


def test_a_vehicle_on_two_links_is_mended_once_and_losing_one_of_them_is_no_silence(relay, tmp_path):
    port = free_port(socket.SOCK_STREAM)
    links = f"udpin:127.0.0.1:{relay.companion_port}", f"tcpin:127.0.0.1:{port}"
    with (
        watching(tmp_path, *links, speedup=RATE) as run,
        flying(
            f"udpout:127.0.0.1:{relay.port}", f"tcp:127.0.0.1:{port}", seed=2, fault=CROSSED, speedup=RATE, duration_s=3600.0
        ) as simulator,
    ):  # fmt: skip
        run.wait_for("fault/isolated")
        relay.open = False
        run.wait_for("recovery/verified")
        assert simulator.process.poll() is None
        assert run.stop() == 0, run.text
    lines = flights.events(tmp_path / "events.jsonl")
    assert names(lines, "link", "fault", "recovery") == ["link/up", "fault/detected", "fault/isolated"] + [
        f"recovery/{name}" for name in ("considered", "requested", "acknowledged", "verified")
    ]


def test_a_ground_station_on_a_link_of_its_own_hears_the_companion_and_sets_its_policy(tmp_path):
    port, ground_port = free_port(), free_port()
    with (
        watching(
            tmp_path, f"udpin:127.0.0.1:{port}", f"udpin:127.0.0.1:{ground_port}", speedup=RATE, policy="off"
        ) as run,
        flying(f"udpout:127.0.0.1:{port}", seed=2, speedup=RATE, duration_s=3600.0),
        UdpPeer(target=("127.0.0.1", ground_port)) as ground,
    ):  # fmt: skip
        run.wait_for("vehicle/armed")
        ground.beat()
        ground.wait_for(lambda m: m.get_type() == "HEARTBEAT" and (m.get_srcSystem(), m.get_srcComponent()) == (1, 191))
        ground.say("PARAM_SET", target_system=1, target_component=191, param_id="MFDI_POLICY", param_value=2, param_type=6)
        answer = ground.wait_for(kind("PARAM_VALUE"))[-1]
        assert (answer.param_id, answer.param_value) == ("MFDI_POLICY", 2.0)
        run.wait_for("policy is now auto")
        assert run.stop() == 0, run.text
    assert names(flights.events(tmp_path / "events.jsonl"), "link") == ["link/up"]
