"""What the command says to a user: one clear line for a mistake, exit codes, and output that programs can read."""

import contextlib
import gzip
import json
import os
import random
import signal
import socket
import threading
from importlib.resources import files

import pytest

import sitl.server
from companion.cli import main
from companion.dialect import encode
from companion.tlog import record
from tests.sitl.test_server import UdpPeer, free_port
from tests.system.flights import CROSSED, Flight, command

MISTAKES = {
    "unknown airframe": (["config", "zeppelin"], "unknown airframe 'zeppelin'; known: parafoil"),
    "no connection string": (["run", "parafoil", "--connect", "over there"], "'over there' is no connection string"),
    "a port that is none": (["run", "parafoil", "--connect", "udpin:127.0.0.1:99999"], "no port between 1 and 65535"),
    "nowhere to send to": (["sitl", "parafoil", "--connect", "udpout::14550"], "names no host"),
    "a UART without its speed": (["run", "parafoil", "--connect", "/dev/ttyAMA0"], "does not say its speed"),
    "a missing device": (["run", "parafoil", "--connect", "/dev/ttyACM77"], "there is no such device; is it plugged in?"),
    "an unknown host": (["sitl", "parafoil", "--connect", "udpout:no.such.host.invalid:14550"], "is not known"),
    "the same link twice": (
        ["run", "parafoil", "--connect", "udpin:127.0.0.1:{port}", "--connect", "udpin:127.0.0.1:{port}"], "named twice"
    ),
    "a fault without a time": (["sitl", "parafoil", "--fault", "crossed_lines"], "is not ID[=VALUE]@SECONDS"),
    "an unknown fault": (["sitl", "parafoil", "--fault", "gremlins@10"], "unknown fault 'gremlins'"),
    "a fault of an impossible size": (["sitl", "parafoil", "--fault", "motor:left/stuck=7@10"], "--fault: "),
    "two faults": (["sitl", "parafoil", "--fault", "crossed_lines@1", "--fault", "crossed_lines@2"], "one fault a flight"),
    "a speed-up of nought": (["run", "parafoil", "--speedup", "0"], "--speedup 0 is no factor"),
    "a speed-up in words": (["run", "parafoil", "--speedup", "fast"], "--speedup fast is no factor"),
    "a speed-up of the simulator in words": (["sitl", "parafoil", "--speedup", "fast"], "fast"),
    "a component that is none": (["run", "parafoil", "--compid", "1"], "--compid 1 is none for an onboard computer"),
    "a duration of nought": (["run", "parafoil", "--duration", "0"], "--duration 0 is no duration"),
    "a duration that is no number": (["sitl", "parafoil", "--duration", "nan"], "--duration nan is no duration"),
    "a system that is none": (["sitl", "parafoil", "--sysid", "256"], "--sysid 256 is no system id"),
    "a system that is none, to listen to": (["run", "parafoil", "--sysid", "0"], "--sysid 0 is no system id"),
    "a negative seed": (["sitl", "parafoil", "--seed", "-1"], "--seed -1 is no seed"),
    "a demo of a negative seed": (["demo", "--no-view", "--seed", "-1", "--out", "{tmp}"], "--seed -1 is no seed"),
    "a demo of no size": (["demo", "--no-view", "--fault", "motor:left/stuck=much", "--out", "{tmp}"], "--fault: "),
    "a demo of an unknown fault": (["demo", "--fault", "gremlins", "--out", "{tmp}"], "unknown fault 'gremlins'"),
    "a demo of a fault at no time": (["demo", "--fault", "crossed_lines@noon", "--out", "{tmp}"], "no time in seconds"),
    "a demo at no speed": (["demo", "--no-view", "--speedup", "-3", "--out", "{tmp}"], "--speedup -3 is no factor"),
    "a log that is not there": (["analyze", "{tmp}/none.tlog"], "cannot read the log"),
    "a folder without a log": (["analyze", "{tmp}"], "no .tlog or .tlog.gz in this folder"),
    "a log of an unknown airframe": (["analyze", "{tmp}/none.tlog", "--airframe", "zeppelin"], "unknown airframe"),
}  # fmt: skip


@pytest.fixture(autouse=True)
def signals_as_before():
    """A command run inside this process takes the stop signals for itself."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def said(capsys, words):
    """Exit code and the lines on standard error; nothing else may have been printed."""
    code = main([str(word) for word in words])
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "Traceback" not in printed.err
    return code, printed.err.splitlines()


def one_line(capsys, words, text):
    code, lines = said(capsys, words)
    assert code == 2
    assert len(lines) == 1, lines
    assert lines[0].startswith(f"mavfdi {words[0]}: ")
    assert text in lines[0]


@pytest.mark.parametrize(("words", "text"), MISTAKES.values(), ids=MISTAKES.keys())
def test_a_users_mistake_is_one_line_that_says_what_and_exit_code_2(words, text, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    port = free_port()
    one_line(capsys, [word.format(tmp=tmp_path, port=port) for word in words], text)
    assert list(tmp_path.iterdir()) == []  # nothing has been begun


def crossed_lines_table():
    """The packaged table of the recovery."""
    packaged = files("configs").joinpath("parafoil.toml").read_text(encoding="utf-8")
    return packaged[packaged.index("[recovery.crossed_lines]") : packaged.index("\n[monitor]")]


CONFIGURATIONS = {
    "not TOML": ("[grid\nrate_hz = 10", "not valid TOML"),
    "an unknown key": ("[grid]\nrate = 10.0", "unknown key grid.rate"),
    "an unknown key of the monitor": ("[monitor]\ncolour = 3", "unknown key monitor.colour"),
    "an unknown table": ("[zeppelin]\nx = 1", "unknown key zeppelin"),
    "a wrong type": ('[grid]\nrate_hz = "ten"', "grid.rate_hz: Expected `float`"),
    "a rate that is none": ("[grid]\nrate_hz = 0.0", "rate_hz = 0.0 is no rate of a grid"),
    "a negative duration": ("[decision]\nhold_s = -3.0", "hold_s = -3.0"),
    "a probability that is none": ("[decision]\nleast_confidence = 1.5", "least_confidence = 1.5 is no probability"),
    "a stream of no use": ("[streams]\nVIBRATION = 1.0", "streams.VIBRATION delivers no channel"),
    "a recovery of no fault": (crossed_lines_table().replace("crossed_lines", "gremlins"), "recovery.gremlins is no fault"),
    "a recovery that says too little": ("[recovery.gremlins]\nanswer_s = 1.0", "recovery"),
    "a residual that does not exist": ('[recovery.crossed_lines]\nverify_residual = "mood"', "verify_residual = 'mood'"),
    "a parameter's name that is too long": (
        '[recovery.crossed_lines]\nparameters = ["SERVO1_FUNCTION_XX", "SERVO2_FUNCTION"]', "is no parameter name"
    ),
    "an observer that is not square": ("[monitor.observer]\ntransition = [[1.0]]", "monitor."),
}  # fmt: skip


@pytest.mark.parametrize(("content", "text"), CONFIGURATIONS.values(), ids=CONFIGURATIONS.keys())
def test_a_mistake_in_the_owners_configuration_names_file_and_key(content, text, capsys, tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text(content, encoding="utf-8")
    words = ["config", "parafoil", "--config", mine]
    code, (line,) = said(capsys, words)
    assert code == 2
    assert text in line
    assert str(mine) in line


def test_a_nonsense_value_of_the_simulator_is_refused_before_it_flies(capsys, tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text("[sitl.wind]\nspeed_10m_m_s = [5.0, -1.0]", encoding="utf-8")
    one_line(capsys, ["sitl", "parafoil", "--config", mine], "sitl.wind: speed_10m_m_s = [5.0, -1.0] is no range")


def test_a_configuration_that_is_not_there_or_no_text_is_one_line(capsys, tmp_path):
    one_line(capsys, ["config", "parafoil", "--config", tmp_path / "none.toml"], "cannot read the configuration")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    one_line(capsys, ["config", "parafoil", "--config", tmp_path / "binary.toml"], "cannot read the configuration")


def test_a_port_in_use_is_one_line(capsys, tmp_path):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        link = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        one_line(capsys, ["run", "parafoil", "--connect", link, "--out", tmp_path], "the port is in use by another program")
        one_line(capsys, ["sitl", "parafoil", "--connect", link], "the port is in use by another program")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        link = f"tcpin:127.0.0.1:{taken.getsockname()[1]}"
        one_line(capsys, ["run", "parafoil", "--connect", link, "--out", tmp_path], "the port is in use by another program")


def test_a_folder_that_cannot_be_written_is_one_line_and_the_links_are_free_again(capsys, tmp_path):
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    link = f"udpin:127.0.0.1:{free_port()}"
    for _ in range(2):
        one_line(capsys, ["run", "parafoil", "--connect", link, "--out", tmp_path / "file"], "cannot record here")
    one_line(capsys, ["demo", "--no-view", "--out", tmp_path / "file"], "cannot record here")


def test_without_debug_no_mistake_shows_a_traceback_and_with_it_every_one_does(tmp_path):
    words = ("analyze", tmp_path / "none.tlog", "--airframe", "zeppelin")
    with command(*words) as plain, command("--debug", *words) as debugged:
        assert (plain.ended(), debugged.ended()) == (2, 1)
    assert plain.text.count("\n") == 1
    assert "Traceback" in debugged.text


def test_a_lockstep_listener_that_goes_away_is_one_line(capsys, monkeypatch):
    monkeypatch.setattr(sitl.server, "LOCKSTEP_LIMIT_S", 0.3)
    port = free_port()
    stop = threading.Event()

    def listen(peer):
        """Answer the first hundred questions for the time, then fall silent."""
        answered = 0
        with contextlib.suppress(TimeoutError):
            while answered < 100 and not stop.is_set():
                for asked in peer.messages():
                    if asked.get_type() == "TIMESYNC" and asked.tc1 == 0:
                        answered += 1
                        peer.say("TIMESYNC", tc1=1, ts1=asked.ts1)

    with UdpPeer(port=port, system=1, component=191) as peer:
        listener = threading.Thread(target=listen, args=(peer,), daemon=True)
        listener.start()
        try:
            code = main(["sitl", "parafoil", "--connect", f"udpout:127.0.0.1:{port}", "--speedup", "lockstep"])
        finally:
            stop.set()
            listener.join(20.0)
    printed = capsys.readouterr()
    assert code == 2
    assert len(printed.err.splitlines()) == 1
    assert "has not answered TIMESYNC" in printed.err
    assert "is it still running?" in printed.err


@pytest.mark.parametrize(
    "words",
    [[], ["fly"], ["run"], ["run", "parafoil", "--policy", "wild"], ["analyze"], ["sitl", "parafoil", "--seed", "x"]],
)
def test_wrong_words_are_answered_by_the_usage_and_exit_code_2(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert "usage: mavfdi" in capsys.readouterr().err


def test_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["--version"])
    assert ended.value.code == 0
    assert capsys.readouterr().out == "mavfdi 0.1.0\n"


def test_config_prints_every_value_with_the_file_that_it_comes_from(capsys, tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text("[decision]\nhold_s = 4.5\n", encoding="utf-8")
    assert main(["config", "parafoil", "--config", str(mine)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert f"decision.hold_s = 4.5  # {mine}" in lines
    assert "decision.repeat_s = 30.0  # configs/parafoil.toml" in lines
    assert 'recovery.crossed_lines.parameters = ["SERVO1_FUNCTION", "SERVO2_FUNCTION"]  # configs/parafoil.toml' in lines
    assert len(lines) > 100
    assert all(" = " in line and "  # " in line for line in lines)


# -- analyze ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Logs of a healthy and a crossed flight, and files that are none."""
    folder = tmp_path_factory.mktemp("logs")
    for name, fault in (("healthy", None), ("crossed", CROSSED)):
        flight = Flight(5, fault, keep_log=True).fly(60.0)
        (folder / f"{name}.tlog").write_bytes(flight.rehearsal.log)
    (folder / "crossed.tlog.gz").write_bytes(gzip.compress((folder / "crossed.tlog").read_bytes()))
    (folder / "empty.tlog").touch()
    (folder / "noise.tlog").write_bytes(random.Random(1).randbytes(5000))
    (folder / "half.tlog.gz").write_bytes((folder / "crossed.tlog.gz").read_bytes()[:1000])
    (folder / "text.tlog.gz").write_text("no gzip at all", encoding="utf-8")
    return folder


def analyzed(capsys, *words):
    code = main(["analyze", *map(str, words)])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_analyze_answers_0_for_a_healthy_flight_and_1_for_a_fault(logs, capsys):
    code, out, err = analyzed(capsys, logs / "healthy.tlog")
    assert (code, err) == (0, "")
    assert "verdict   healthy" in out
    code, out, err = analyzed(capsys, logs / "crossed.tlog")
    assert (code, err) == (1, "")
    assert "verdict   fault" in out
    assert "crossed_lines (99.9%)" in out
    assert "decided the same as the recorded run" in out


def test_a_compressed_log_says_the_same_as_the_log(logs, capsys):
    contents = []
    for name in ("crossed.tlog", "crossed.tlog.gz"):
        code, out, _ = analyzed(capsys, "--json", logs / name)
        assert code == 1
        contents.append(json.loads(out))
        contents[-1]["log"].pop("path")
    assert contents[0] == contents[1]


@pytest.mark.parametrize("name", ["empty.tlog", "noise.tlog", "half.tlog.gz", "text.tlog.gz"])
def test_analyze_answers_2_and_one_line_for_what_is_no_log(name, logs, capsys):
    code, out, err = analyzed(capsys, logs / name)
    assert (code, out, len(err.splitlines())) == (2, "", 1)
    assert name in err


def test_one_bad_log_among_several_does_not_keep_the_others_from_being_read(logs, capsys):
    code, out, err = analyzed(capsys, "--json", logs / "crossed.tlog", logs / "empty.tlog", logs / "healthy.tlog")
    assert code == 2
    assert [json.loads(line)["verdict"] for line in out.splitlines()] == ["fault", "healthy"]
    assert "empty.tlog" in err


def test_the_json_of_a_log_is_one_line_with_the_promised_keys(logs, capsys):
    code, out, _ = analyzed(capsys, "--json", logs / "crossed.tlog")
    assert (code, out.count("\n")) == (1, 1)
    content = json.loads(out)
    assert list(content) == [
        "schema", "log", "reader", "vehicles", "duration_s", "verdict", "faults", "checks", "events", "replay",
    ]  # fmt: skip
    assert list(content["log"]) == ["path", "bytes", "sha256"]
    promised = (
        "frames_v1 frames_v2 signed unstamped crc_failures resyncs resync_bytes tail_bytes unknown_frames messages sources"
        " stamps_backward stamps_implausible max_gap_us first_us last_us frames_sha256"
    )
    assert set(promised.split()) <= set(content["reader"])
    assert content["vehicles"] == [{"sysid": 1, "compid": 1, "autopilot": 3, "type": 28, "airframe": "parafoil"}]
    (fault,) = content["faults"]
    assert set(fault) >= {
        "id", "class", "where", "confidence", "size", "unit", "onset_t", "detected_t", "isolated_t", "detected_utc_us",
    }  # fmt: skip
    assert (fault["id"], fault["class"], fault["where"]) == ("crossed_lines", "crossed_lines", None)
    assert fault["onset_t"] < fault["detected_t"] < fault["isolated_t"]
    assert content["verdict"] == "fault"
    assert content["duration_s"] == pytest.approx(60.0, abs=0.2)
    assert content["replay"]["same_sends"]
    assert [event["seq"] for event in content["events"]] == list(range(len(content["events"])))


def test_a_log_of_an_unknown_kind_of_vehicle_has_no_airframe_unless_one_is_named(tmp_path, capsys):
    copter = encode("HEARTBEAT", {"type": 2, "autopilot": 3}, sysid=1, compid=1, seq=0)
    log = tmp_path / "copter.tlog"
    log.write_bytes(b"".join(record(1_700_000_000_000_000 + 1_000_000 * second, 0, copter) for second in range(6)))
    airframes = []
    for words in ([], ["--airframe", "parafoil"]):
        code, out, err = analyzed(capsys, "--json", *words, log)
        assert (code, err) == (0, "")
        airframes.append(json.loads(out)["vehicles"][0]["airframe"])
    assert airframes == [None, "parafoil"]


def test_a_log_under_another_policy_is_decided_under_that_one(logs, capsys):
    code, out, _ = analyzed(capsys, "--json", "--policy", "off", logs / "crossed.tlog")
    content = json.loads(out)
    assert code == 1
    assert [event for event in content["events"] if event["kind"] == "recovery"] == []
    assert content["replay"]["same_sends"] is False


def test_a_reader_that_stops_reading_ends_the_output_quietly(logs):
    reading, writing = os.pipe()
    os.close(reading)
    with command("analyze", "--json", *[logs / "crossed.tlog"] * 2, stdout=writing) as closed:
        os.close(writing)
        assert closed.ended() == 2
    assert closed.text == ""
