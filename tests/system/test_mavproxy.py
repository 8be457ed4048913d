"""A real MAVProxy on the simulator's second port: it shows what another client says through the simulator's routing."""

import contextlib
import os
import queue
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from companion import address
from companion.link import open_link
from sitl.clock import Clock
from sitl.server import serve
from tests.sitl.network import parafoil_autopilot, sled_autopilot
from tests.sitl.test_server import UdpPeer, free_port, kind
from tests.system.flights import CROSSED, flying, watching

LIMIT_S = 40.0
MAVPROXY = Path(sys.executable).parent / "mavproxy.py"

pytestmark = pytest.mark.skipif(not MAVPROXY.exists(), reason=f"MAVProxy is not installed ({MAVPROXY})")


class MavProxy:
    """MAVProxy as a subprocess, listening on a UDP port; what it prints can be waited for.

    Left to choose its target itself, MAVProxy 1.8.75 takes the autopilot's component and shows no other component's
    STATUSTEXT; with the system named, it shows all of that system's.
    """

    def __init__(self, port, directory):
        arguments = [
            sys.executable, str(MAVPROXY), f"--master=udpin:127.0.0.1:{port}", "--daemon", "--non-interactive",
            "--default-modules=link,param,cmdlong", f"--state-basedir={directory}", "--mav20", "--source-system=254",
            "--target-system=1", "--target-component=0",
        ]  # fmt: skip
        environment = os.environ | {"PYTHONUNBUFFERED": "1", "HOME": str(directory), "PYTHONWARNINGS": "ignore"}
        self.process = subprocess.Popen(
            arguments, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=directory,
            env=environment, text=True, errors="replace",
        )  # fmt: skip
        self.lines = queue.Queue()
        self.seen = []
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.put(line)

    def wait_for(self, text):
        end_s = time.monotonic() + LIMIT_S
        while time.monotonic() < end_s:
            with contextlib.suppress(queue.Empty):
                self.seen.append(self.lines.get(timeout=0.5))
                if text in self.seen[-1]:
                    return
            assert self.process.poll() is None, "".join(self.seen)
        raise AssertionError(f"MAVProxy never showed {text!r} but:\n" + "".join(self.seen))

    def end(self):
        self.process.terminate()
        try:
            self.process.wait(10)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait(10)
        self.reader.join(10)
        self.process.stdout.close()


@pytest.fixture
def mavproxy(tmp_path):
    port = free_port(socket.SOCK_DGRAM)
    started = MavProxy(port, tmp_path)
    started.port = port
    yield started
    started.end()


@pytest.mark.parametrize("build", [sled_autopilot, parafoil_autopilot], ids=["sled", "parafoil"])
def test_mavproxy_shows_the_words_of_a_companion_and_reads_the_vehicles_parameters(build, mavproxy, tmp_path):
    port = free_port()
    autopilot = build()
    opened = [open_link(address.parse(text)) for text in (f"udpin:127.0.0.1:{port}", f"udpout:127.0.0.1:{mavproxy.port}")]
    stop = threading.Event()
    thread = threading.Thread(
        target=serve, args=(autopilot, opened, Clock(1.0), None, lambda _: not stop.is_set()), daemon=True
    )  # fmt: skip
    thread.start()
    try:
        with UdpPeer(target=("127.0.0.1", port), system=1, component=191) as companion:
            mavproxy.wait_for(f"Received {len(autopilot.parameters.names)} parameters")
            companion.beat()
            companion.wait_for(kind("HEARTBEAT"))
            companion.say("STATUSTEXT", severity=2, text="mavfdi: control lines crossed (99.7 %)")
            mavproxy.wait_for("mavfdi: control lines crossed (99.7 %)")
    finally:
        stop.set()
        thread.join(LIMIT_S)
        for link in opened:
            link.close()
    assert any(client[0].startswith("udpout") for client in autopilot.clients)
    assert "SERVO1_FUNCTION" in (tmp_path / "mav.parm").read_text(encoding="utf-8")


def test_mavproxy_shows_what_a_live_companion_finds_and_does(mavproxy, tmp_path):
    port = free_port()
    with (
        watching(tmp_path / "out", f"udpin:127.0.0.1:{port}", speedup="10") as run,
        flying(
            f"udpout:127.0.0.1:{port}", f"udpout:127.0.0.1:{mavproxy.port}", fault=CROSSED, speedup="10", duration_s=600.0
        ),
    ):  # fmt: skip
        mavproxy.wait_for("mavfdi: control lines crossed (99.9 %)")
        mavproxy.wait_for("mavfdi: swapping control lines")
        mavproxy.wait_for("mavfdi: repair verified")
        assert run.stop() == 0, run.text
