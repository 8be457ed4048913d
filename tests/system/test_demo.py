"""`mavfdi demo`: one command flies, breaks, watches, mends, shows and keeps everything."""

import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time

import pytest

from companion.analysis import analyze
from companion.events import same_events
from tests.system import flights
from tests.system.flights import CROSSED, LIMIT_S, Flight, command, names, parafoil

SEED = 7
LOCKSTEP = ("--speedup", "lockstep", "--seed", SEED)


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A demo with crossed lines: folder and what it printed."""
    out = tmp_path_factory.mktemp("demo")
    with command("demo", *LOCKSTEP, "--fault", CROSSED, "--no-view", "--out", out) as demo:
        assert demo.ended() == 0, demo.text
    return out, demo.text


def summary(out):
    return json.loads((out / "summary.json").read_text(encoding="utf-8"))


def test_the_demo_keeps_log_events_summary_and_picture_and_nothing_else(shown):
    out, _ = shown
    assert sorted(file.name for file in out.iterdir()) == ["events.jsonl", "flight.png", "flight.tlog", "summary.json"]
    assert (out / "flight.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert (out / "flight.png").stat().st_size > 20_000


def test_its_files_agree_with_each_other_and_with_the_same_flight_in_one_process(shown):
    out, _ = shown
    lines, content = flights.events(out / "events.jsonl"), summary(out)
    flight = Flight(SEED, CROSSED).fly(135.0)
    assert same_events(lines, flight.lines) is None
    found = analyze(out / "flight.tlog", lambda _: parafoil())
    assert same_events(lines, found.replay.journal.lines) is None
    assert found.content["replay"]["same_sends"]
    assert content["verdict"] == found.content["verdict"] == "fault"
    assert content["faults"] == found.content["faults"]
    assert content["recovery"]["state"] == "done"
    assert (content["seed"], content["airframe"]) == (SEED, "parafoil")
    assert content["injected"] == [{"id": "crossed_lines", "value": None, "onset_t": 25.0}]
    assert content["counters"] == lines[-1]["counters"]
    (fault,) = content["faults"]
    assert abs(fault["onset_t"] - content["injected"][0]["onset_t"]) < 5.0


def test_what_it_prints_is_what_its_files_say(shown):
    out, text = shown
    assert f"mavfdi demo: parafoil, seed {SEED}" in text
    for line in flights.events(out / "events.jsonl")[1:-1]:
        assert f"{line['kind']}/{line['name']}: {line['text']}" in text
    (fault,) = summary(out)["faults"]
    assert re.search(rf"isolated +{fault['isolated_t'] - 25.0:.1f} s after the fault", text)
    before, during, after = (
        float(re.search(rf"tracking rms {when} +([\d.]+)", text)[1]) for when in ("before", "during", "after")
    )
    assert during > 3.0 * before
    assert after < during / 2.0


def test_a_second_demo_in_the_same_folder_keeps_the_first(shown, tmp_path):
    out, _ = shown
    first = (out / "flight.tlog").read_bytes()
    with command("demo", *LOCKSTEP, "--fault", "none", "--duration", "30", "--no-view", "--out", out) as demo:
        assert demo.ended() == 0, demo.text
    assert (out / "flight.tlog").read_bytes() == first
    for name in ("flight-2.tlog", "events-2.jsonl", "summary-2.json", "flight-2.png"):
        (out / name).rename(tmp_path / name)
    assert names(flights.events(tmp_path / "events-2.jsonl"), "fault") == []


def test_a_demo_without_a_fault_is_healthy(tmp_path):
    with command("demo", *LOCKSTEP, "--fault", "none", "--duration", "60", "--no-view", "--out", tmp_path) as demo:
        assert demo.ended() == 0, demo.text
    content = summary(tmp_path)
    assert (content["verdict"], content["injected"], content["faults"], content["recovery"]) == ("healthy", [], [], None)


def test_a_demo_stopped_by_ctrl_c_ends_in_order(tmp_path):
    with command("demo", "--seed", SEED, "--speedup", "10", "--no-view", "--out", tmp_path) as demo:
        demo.wait_for("vehicle/armed")
        demo.process.send_signal(signal.SIGINT)
        assert demo.ended() == 0, demo.text
    assert flights.events(tmp_path / "events.jsonl")[-1]["text"] == "run ends: SIGINT"
    assert (tmp_path / "flight.png").exists()


def on_a_terminal(*arguments):
    """Run a command whose output is a terminal; -> exit code and everything it wrote there."""
    ours, theirs = pty.openpty()
    environment = os.environ | {"TERM": "xterm", "COLUMNS": "120", "LINES": "50"}
    process = subprocess.Popen(
        [sys.executable, "-m", "companion.cli", *map(str, arguments)], stdin=theirs, stdout=theirs, stderr=theirs,
        env=environment,
    )  # fmt: skip
    os.close(theirs)
    written, end_s = b"", time.monotonic() + LIMIT_S
    try:
        while time.monotonic() < end_s:
            if not select.select([ours], (), (), 1.0)[0]:
                continue
            try:
                data = os.read(ours, 65536)
            except OSError:  # the other end is closed: it has ended
                break
            if not data:
                break
            written += data
        return process.wait(LIMIT_S), written.decode("utf-8", "replace")
    finally:
        if process.poll() is None:
            process.kill()
            process.wait(LIMIT_S)
        os.close(ours)


def test_on_a_terminal_the_view_shows_clock_residuals_alarms_and_recovery(tmp_path):
    code, written = on_a_terminal("demo", *LOCKSTEP, "--fault", CROSSED, "--out", tmp_path)
    assert code == 0, written
    screen = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written)
    for words in (
        f"mavfdi demo: parafoil, seed {SEED}", "armed", "heading_rate", "of 15", "turn_rate_command_rad_s", "│", "█",
        "control lines crossed (99.9 %)", "recovery: changed and verified", "repair verified", "healthy",
    ):  # fmt: skip
        assert words in screen, words
    assert "\x1b[?25l" in written  # the cursor was hidden
    assert written.rstrip().rfind("\x1b[?25h") > written.rfind("\x1b[?25l")  # and is back
    assert "Traceback" not in screen


def test_into_a_pipe_there_is_no_view(shown):
    _, text = shown
    assert "\x1b" not in text
