"""The autopilot on a serial line: a pseudo terminal, the SITL's port on one end, a ground station on the other."""

import contextlib
import math
import os
import time
import tty

import pytest
from pymavlink.dialects.v20 import all as dialect

from companion import address
from companion.errors import UserError
from companion.frames import Splitter
from companion.link import BUFFER_BYTES, REOPEN_US, open_link
from sitl.clock import Clock
from sitl.server import serve
from tests.sitl.network import message, sled_autopilot

LIMIT_S = 20.0  # of wall time, for anything in this file to happen


class Line:
    """One end of a pseudo terminal, with pymavlink on it; the other end is a device for `open_link`."""

    def __init__(self, path):
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        path.unlink(missing_ok=True)
        path.symlink_to(os.ttyname(self.slave))
        self.mav = dialect.MAVLink(None, 255, 190)
        self.splitter = Splitter()
        self.frames = []

    def close(self):
        for end in (self.master, self.slave):
            with contextlib.suppress(OSError):
                os.close(end)

    def say(self, name, **fields):
        os.write(self.master, message(name, **fields).pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256

    def read(self):
        """Frames that have come since the last look."""
        data = b""
        with contextlib.suppress(BlockingIOError):
            while chunk := os.read(self.master, 65536):
                data += chunk
        frames = self.splitter.feed(data)
        self.frames += frames
        return frames


@pytest.fixture
def device(tmp_path):
    return tmp_path / "ttyUSB0"


@pytest.fixture
def line(device):
    opened = Line(device)
    yield opened
    opened.close()


@pytest.fixture
def port(line, device):
    link = open_link(address.parse(f"serial://{device}:57600"))
    yield link
    link.close()


def serve_until(autopilot, port, done, clock=None):
    """Fly at full speed until `done()` is true after some step."""
    end_s = time.monotonic() + LIMIT_S
    came = []

    def on_step(_):
        if done():
            came.append(True)
        return not came and time.monotonic() < end_s

    serve(autopilot, [port], clock if clock is not None else Clock(math.inf), on_step=on_step)
    assert came, "did not happen"


def names(line):
    return {frame.name for frame in line.frames}


def test_who_listens_on_the_line_hears_heartbeat_and_streams_unasked(line, port):
    autopilot = sled_autopilot()

    def heard_all():
        line.read()
        return names(line) >= {"HEARTBEAT", "GLOBAL_POSITION_INT", "SERVO_OUTPUT_RAW", "WHEEL_DISTANCE"}

    serve_until(autopilot, port, heard_all)
    assert line.splitter.counts["bad_crc"] == line.splitter.counts["skipped_bytes"] == 0
    sequence = [frame.seq for frame in line.frames]
    assert sequence == [(sequence[0] + k) % 256 for k in range(len(sequence))]


def test_a_parameter_is_read_and_set_over_the_line_in_any_slices(line, port):
    autopilot = sled_autopilot()
    line.say("HEARTBEAT", type=6, autopilot=8)
    request = message("PARAM_SET", target_system=1, target_component=1, param_id="SLED_SPEED", param_value=5.5, param_type=9)
    raw = list(request.pack(line.mav))

    def answered():
        if raw:
            os.write(line.master, bytes([raw.pop(0)]))  # a byte a step
        return [f for f in line.read() if f.name == "PARAM_VALUE" and f.fields()["param_id"] == "SLED_SPEED"]

    serve_until(autopilot, port, answered)
    echo = next(frame for frame in line.frames if frame.name == "PARAM_VALUE")
    assert echo.fields()["param_value"] == 5.5
    assert autopilot.parameters.value("SLED_SPEED") == 5.5
    assert port.name in {key[0] for key in autopilot.clients}


def test_noise_on_the_line_stops_nothing(line, port):
    autopilot = sled_autopilot()
    os.write(line.master, bytes(range(256)) * 3)  # in it are beginnings of frames that swallow what comes behind

    def heard():
        line.read()
        line.say("HEARTBEAT", type=6, autopilot=8)
        return autopilot.clients

    serve_until(autopilot, port, heard)
    assert autopilot.counters.bad_bytes > 0


def test_a_reader_that_stops_loses_whole_frames_and_never_a_part_of_one(line, port):
    autopilot = sled_autopilot()
    serve_until(autopilot, port, lambda: port.counts["send_errors"] > 10)
    assert autopilot.counters.frames_out > BUFFER_BYTES // 280
    lost_us = autopilot.time_us

    def caught_up():
        line.read()
        times = [frame.fields()["time_boot_ms"] * 1000 for frame in line.frames[-20:] if "time_boot_ms" in frame.fields()]
        return times and max(times) > lost_us

    serve_until(autopilot, port, caught_up)
    assert line.splitter.counts["bad_crc"] == line.splitter.counts["skipped_bytes"] == 0
    assert any((b.seq - a.seq) % 256 != 1 for a, b in zip(line.frames, line.frames[1:], strict=False))


def test_a_device_that_is_unplugged_is_opened_again_when_it_is_back(line, device, port):
    wall_s = [0.0]
    clock = Clock(math.inf, monotonic_s=lambda: wall_s[0])
    autopilot = sled_autopilot()
    serve_until(autopilot, port, lambda: line.read(), clock)
    line.close()
    device.unlink()
    serve_until(autopilot, port, lambda: port.counts["lost"] == 1, clock)
    assert port.filenos() == []
    flown_us = autopilot.time_us
    wall_s[0] += 2e-6 * REOPEN_US
    serve_until(autopilot, port, lambda: autopilot.time_us > flown_us + 1_000_000, clock)  # it flies on meanwhile
    assert port.counts["reopened"] == 0
    again = Line(device)
    try:
        wall_s[0] += 2e-6 * REOPEN_US
        serve_until(autopilot, port, lambda: again.read(), clock)
        assert port.counts["reopened"] == 1
        assert again.splitter.counts["bad_crc"] == 0
    finally:
        again.close()


def test_a_device_that_is_not_there_is_a_users_mistake(device):
    with pytest.raises(UserError, match="there is no such device; is it plugged in"):
        open_link(address.parse(f"serial://{device}:57600"))
