"""A real MAVSDK client on a running simulator: it finds the vehicle healthy, changes parameters, injects a failure."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from companion import address
from companion.link import open_link
from sitl.autopilot import Autopilot, MissionItem
from sitl.clock import Clock
from sitl.server import serve
from tests.sitl.network import parafoil_autopilot, sled_autopilot

mavsdk = pytest.importorskip("mavsdk", reason="MAVSDK is not installed")
from mavsdk.plugins.failure import Failure, FailureError, FailureResult, FailureType, FailureUnit  # noqa: E402
from mavsdk.plugins.info import Info  # noqa: E402
from mavsdk.plugins.mission_raw import MissionRaw  # noqa: E402
from mavsdk.plugins.param import Param, ParamError  # noqa: E402
from mavsdk.plugins.telemetry import Telemetry  # noqa: E402

LIMIT_S = 20.0


@dataclass(frozen=True)
class Subject:
    """One vehicle and what can be tried on it."""

    build: Callable[..., Autopilot]
    real: tuple[str, float]  # a REAL32 parameter and a value other than its default
    integer: tuple[str, int]
    failure: tuple[FailureUnit, FailureType]
    obeys: Callable[[Autopilot], bool]  # after the failure of instance 1


SUBJECTS = {
    "sled": Subject(
        sled_autopilot,
        ("SLED_SPEED", 11.5),
        ("SERVO1_FUNCTION", 73),
        (FailureUnit.SYSTEM_MOTOR, FailureType.OFF),
        lambda autopilot: autopilot.fleet._loss[0] == 1.0,
    ),
    "parafoil": Subject(
        parafoil_autopilot,
        ("PF_LIMIT_L", 0.75),
        ("SERVO1_FUNCTION", 73),
        (FailureUnit.SYSTEM_SERVO, FailureType.STUCK),
        lambda autopilot: [fault.id for fault in autopilot.fleet.injected(0)] == ["motor:left/stuck"],
    ),
}


@pytest.fixture(params=sorted(SUBJECTS))
def subject(request):
    return SUBJECTS[request.param]


@contextlib.contextmanager
def flying(autopilot):
    """The autopilot on a UDP port; -> a MAVSDK system connected to it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    link = open_link(address.parse(f"udpout:127.0.0.1:{port}"))
    stop = threading.Event()
    clock = Clock(10.0)
    thread = threading.Thread(
        target=serve, args=(autopilot, [link], clock, None, lambda _: not stop.is_set()), daemon=True
    )  # fmt: skip
    client = mavsdk.Mavsdk(mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION))
    try:
        assert client.add_any_connection(f"udpin://127.0.0.1:{port}") == mavsdk.ConnectionResult.SUCCESS
        thread.start()
        system = client.first_autopilot(LIMIT_S)
        assert system is not None
        yield system
    finally:
        client.destroy()
        stop.set()
        thread.join(LIMIT_S)
        link.close()


class Told:
    """What a MAVSDK subscription has told so far, to wait on."""

    def __init__(self):
        self._news = threading.Condition()
        self._values = []

    def __call__(self, value, _user_data=None):
        with self._news:
            self._values.append(value)
            self._news.notify_all()

    def wait_for(self, wanted):
        with self._news:
            assert self._news.wait_for(lambda: any(wanted(value) for value in self._values), LIMIT_S), self._values[-1:]


def test_mavsdk_finds_the_vehicle_connected_and_all_healthy(subject):
    with flying(subject.build()) as system:
        assert system.is_connected()
        assert system.has_autopilot()
        telemetry = Telemetry(system)
        all_ok, health, armed = Told(), Told(), Told()
        telemetry.subscribe_health_all_ok(all_ok)
        telemetry.subscribe_health(health)
        telemetry.subscribe_armed(armed)
        all_ok.wait_for(bool)
        health.wait_for(lambda h: h.is_armable and h.is_home_position_ok and h.is_global_position_ok)
        armed.wait_for(bool)
        assert Info(system).get_version().flight_sw_minor == 1


def test_mavsdk_reads_and_sets_parameters_of_both_types(subject):
    autopilot = subject.build()
    real, integer = subject.real, subject.integer
    with flying(autopilot) as system:
        param = Param(system)
        before = (autopilot.parameters.value(real[0]), autopilot.parameters.value(integer[0]))
        assert (param.get_param_float(real[0]), param.get_param_int(integer[0])) == before
        param.set_param_float(*real)
        param.set_param_int(*integer)
        assert (param.get_param_float(real[0]), param.get_param_int(integer[0])) == (real[1], integer[1])
        with pytest.raises(ParamError):
            param.set_param_int(integer[0], 9999)  # out of range: the echo has the old value
    assert autopilot.parameters.value(integer[0]) == integer[1]


def test_mavsdk_reads_the_whole_list(subject):
    autopilot = subject.build()
    with flying(autopilot) as system:
        everything = Param(system).get_all_params()
        heard = {p.name: p.value for p in everything.float_params} | {p.name: p.value for p in everything.int_params}
    assert heard == {name: pytest.approx(autopilot.parameters.value(name)) for name in autopilot.parameters.names}


def test_mavsdk_injects_a_failure_and_the_vehicle_obeys(subject):
    autopilot = subject.build()
    with flying(autopilot) as system:
        failure = Failure(system)
        failure.inject(*subject.failure, 1)
        end_s = time.monotonic() + LIMIT_S
        while not subject.obeys(autopilot):
            assert time.monotonic() < end_s
        with pytest.raises(FailureError) as error:
            failure.inject(FailureUnit.SENSOR_OPTICAL_FLOW, FailureType.GARBAGE, 1)
        assert error.value.result is FailureResult.UNSUPPORTED
        Param(system).set_param_int("SYS_FAILURE_EN", 0)
        with pytest.raises(FailureError) as error:
            failure.inject(*subject.failure, 1)
        assert error.value.result in (FailureResult.DENIED, FailureResult.DISABLED)


def test_mavsdk_downloads_the_mission_that_was_given():
    items = tuple(MissionItem(16, 6, (0.0, 0.0, 0.0, 0.0), 473977000 + n, 85456000, 10.0 * n) for n in range(3))
    with flying(sled_autopilot(mission=items)) as system:
        downloaded = MissionRaw(system).download_mission()
    assert [(item.seq, item.x, item.z) for item in downloaded] == [(n, 473977000 + n, 10.0 * n) for n in range(3)]
