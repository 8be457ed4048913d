"""The analyst's commands on many logs: order, progress, tables, exit codes; facts without judgement; messages as tables."""

import csv
import gzip
import io
import json
import os
import pty
import subprocess
import sys

import numpy as np
import pytest

from companion import columns
from companion.analysis import COMPILED_FROM_BYTES, PACKED, is_large
from companion.cli import analyze, compiling, main
from companion.tlog import Reader, record
from tests.system.flights import CROSSED, Flight

pyarrow = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """A healthy and two crossed flights, one of them compressed, and beside them a file that is none."""
    folder = tmp_path_factory.mktemp("logs")
    (folder / "b_healthy.tlog").write_bytes(Flight(3, None, keep_log=True).fly(40.0).rehearsal.log)
    crossed = Flight(5, CROSSED, keep_log=True).fly(45.0).rehearsal.log
    (folder / "a_crossed.tlog").write_bytes(crossed)
    (folder / "c_crossed.tlog.gz").write_bytes(gzip.compress(crossed))
    (folder / "notes.txt").write_text("not a log", encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def junk(tmp_path_factory):
    path = tmp_path_factory.mktemp("junk") / "junk.tlog"
    path.write_bytes(b"nothing to see" * 100)
    return path


def said(capsys, *words):
    code = main([str(word) for word in words])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


# -- analyze ----------------------------------------------------------------------------------------------------------


def test_two_jobs_print_what_one_prints_in_the_order_in_which_the_logs_were_named(logs):
    """In processes of their own, as users run it: the pool's workers must find everything again by themselves."""
    named = [logs / name for name in ("b_healthy.tlog", "a_crossed.tlog", "c_crossed.tlog.gz")]
    outputs = []
    for jobs in ("1", "2"):
        command = [sys.executable, "-m", "companion.cli", "analyze", "--json", "--jobs", jobs, *map(str, named)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        assert (done.returncode, done.stderr) == (1, "")
        outputs.append(done.stdout)
    assert outputs[0] == outputs[1]
    assert [json.loads(line)["log"]["path"] for line in outputs[0].splitlines()] == list(map(str, named))


def test_a_folder_stands_for_its_logs_by_name_and_for_nothing_else_in_it(logs, capsys):
    code, out, err = said(capsys, "analyze", "--json", logs)
    assert (code, err) == (1, "")
    names = [json.loads(line)["log"]["path"].rpartition("/")[2] for line in out.splitlines()]
    assert names == ["a_crossed.tlog", "b_healthy.tlog", "c_crossed.tlog.gz"]


def test_the_table_of_several_logs_has_verdict_duration_and_findings_in_columns(logs, junk, capsys):
    code, out, err = said(capsys, "analyze", logs, junk)
    assert code == 2
    assert err.startswith("mavfdi analyze: ")
    assert "no MAVLink frame" in err
    lines = out.splitlines()[-5:]
    starts = [lines[0].index(word) for word in ("log", "verdict", "duration", "found")]
    assert lines[0].split() == ["log", "verdict", "duration", "found"]
    cells = [[line[:17].strip(), *line[starts[1] :].split(None, 1)] for line in lines[1:]]
    assert [cell[:2] for cell in cells] == [
        ["a_crossed.tlog", "fault"],
        ["b_healthy.tlog", "healthy"],
        ["c_crossed.tlog.gz", "fault"],
        ["junk.tlog", "unreadable"],
    ]
    assert all(line[: starts[3]].rstrip().endswith(" s") for line in lines[1:4])
    assert [line[starts[3] :] for line in lines[1:4]] == ["crossed_lines", "", "crossed_lines"]
    assert lines[4][starts[3] :].startswith("no MAVLink frame")


def test_one_log_has_no_table_and_json_never_has_one(logs, capsys):
    assert "verdict     duration" not in said(capsys, "analyze", logs / "b_healthy.tlog")[1]
    out = said(capsys, "analyze", "--json", logs)[1]
    assert all(line.startswith("{") for line in out.splitlines())


def test_the_exit_code_is_that_of_the_worst(logs, junk, capsys):
    healthy, crossed = logs / "b_healthy.tlog", logs / "a_crossed.tlog"
    for named, expected in (
        ((healthy,), 0),
        ((healthy, healthy), 0),
        ((healthy, crossed), 1),
        ((crossed, junk), 2),
        ((junk, healthy), 2),
    ):
        assert said(capsys, "analyze", "--json", *named)[0] == expected


def test_a_report_of_several_logs_and_no_jobs_at_all_are_refused(logs, tmp_path, capsys):
    code, out, err = said(capsys, "analyze", logs, "--report", tmp_path / "page.html")
    assert (code, out) == (2, "")
    assert "--report is for one log, not 3" in err
    assert "--jobs 0: give 1 or more" in said(capsys, "analyze", logs, "--jobs", "0")[2]
    assert list(tmp_path.iterdir()) == []


def test_a_part_of_a_log_is_judged_alone_and_named(logs, capsys):
    words = ("--from", "5", "--to", "15", "--systems", "1,9", logs / "a_crossed.tlog")
    code, out, _ = said(capsys, "analyze", *words)
    assert code == 0  # the lines cross later
    assert "part      5 s to 15 s, of systems 1, 9" in out
    assert "duration  9." in out or "duration  10.0 s" in out
    _, out, _ = said(capsys, "analyze", "--json", *words)
    content = json.loads(out)
    assert content["part"] == {"from_s": 5.0, "to_s": 15.0, "systems": [1, 9]}
    assert content["faults"] == []
    assert content["log"]["bytes"] == (logs / "a_crossed.tlog").stat().st_size
    assert said(capsys, "analyze", "--from", "5", logs / "a_crossed.tlog")[0] == 1
    assert "part" not in json.loads(said(capsys, "analyze", "--json", logs / "a_crossed.tlog")[1])


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--from", "-1"), "seconds from the log's start"),
        (("--from", "20", "--to", "10"), "seconds from the log's start"),
        (("--to", "nan"), "seconds from the log's start"),
        (("--systems", "one"), "--systems one: give numbers"),
        (("--report", "page.html", "--to", "10"), "--report shows a whole log"),
        (("--from", "1000"), "it holds 45.0 s, systems 1"),
    ],
)
def test_a_part_that_cannot_be_is_refused_in_one_line(words, text, logs, capsys):
    code, out, error = said(capsys, "analyze", *words, logs / "a_crossed.tlog")
    assert (code, out) == (2, "")
    assert text in error
    assert error.count("\n") == 1


def test_events_of_all_logs_are_one_table_of_parquet(logs, tmp_path, capsys):
    path = tmp_path / "events.parquet"
    code, out, err = said(capsys, "analyze", "--json", logs / "a_crossed.tlog", logs / "b_healthy.tlog", "--events", path)
    assert (code, err) == (1, "")
    contents = [json.loads(line) for line in out.splitlines()]
    table = parquet.read_table(path)
    assert [(field.name, str(field.type)) for field in table.schema] == [
        ("log", "string"),
        ("t", "double"),
        ("kind", "string"),
        ("name", "string"),
        ("severity", "string"),
        ("text", "string"),
    ]
    rows = table.to_pylist()
    assert len(rows) == sum(len(content["events"]) + len(content["checks"]) for content in contents)
    (isolated,) = [row for row in rows if (row["kind"], row["name"]) == ("fault", "isolated")]
    assert isolated["log"] == str(logs / "a_crossed.tlog")
    assert isolated["t"] == contents[0]["faults"][0]["isolated_t"]
    checks = [row for row in rows if row["log"] == str(logs / "b_healthy.tlog") and "no reboot" in row["text"]]
    assert [(row["name"], row["severity"]) for row in checks] == [("reboot", "ok")]


def test_events_that_cannot_be_written_are_one_line(logs, tmp_path, capsys):
    code, _, err = said(capsys, "analyze", "--json", logs / "b_healthy.tlog", "--events", tmp_path)
    assert code == 2
    assert err.splitlines() == [f"mavfdi analyze: {tmp_path}: cannot write here: Is a directory"]


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """The time that the progress line sees."""
    now = [100.0]
    monkeypatch.setattr(analyze.time, "monotonic", lambda: now[0])
    return now


def test_what_takes_long_shows_its_progress_on_a_terminal_and_takes_it_away_again(clock, monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    progress = analyze._Progress(10)
    clock[0] += analyze.PATIENCE_S - 0.1
    progress.show(1)
    progress.clear()
    assert screen.getvalue() == ""  # not yet
    clock[0] = 104.0
    progress.show(4)
    assert screen.getvalue().strip() == "4/10 logs, 1.0 a second, 6 s left"
    progress.clear()
    assert screen.getvalue().endswith("\r" + 60 * " " + "\r")
    shown = screen.getvalue()
    clock[0] = 110.0
    progress.show(10)
    progress.clear()
    assert screen.getvalue() == shown  # done: nothing is left to wait for


def test_in_a_pipe_no_progress_is_shown(clock, monkeypatch):
    pipe = io.StringIO()
    monkeypatch.setattr(sys, "stderr", pipe)
    progress = analyze._Progress(10)
    clock[0] += 60.0
    progress.show(5)
    progress.clear()
    assert pipe.getvalue() == ""


# -- the compiled reader -----------------------------------------------------------------------------------------------


def compiled_anew(tmp_path, stderr):
    """`mavfdi info` of a large log where nothing has been compiled yet; asked, not run: compiling takes seconds."""
    log = tmp_path / "large.tlog"
    with log.open("wb") as file:
        file.truncate(COMPILED_FROM_BYTES)
    script = f"from pathlib import Path; from companion.cli import compiling; compiling.announce([Path({str(log)!r})])"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    return subprocess.run([sys.executable, "-c", script], stderr=stderr, env=environment, timeout=60, check=True)


def test_the_first_use_of_the_compiled_reader_says_so_on_a_terminal(tmp_path):
    ours, theirs = pty.openpty()
    try:
        compiled_anew(tmp_path, theirs)
        assert os.read(ours, 1000).decode().startswith("compiling the log reader and the monitor, once")
    finally:
        os.close(theirs)
        os.close(ours)


def test_the_first_use_of_the_compiled_reader_is_quiet_in_a_pipe(tmp_path):
    assert compiled_anew(tmp_path, subprocess.PIPE).stderr == b""


def test_a_reader_that_is_compiled_already_and_small_logs_are_not_announced(logs, monkeypatch):
    columns.read(logs / "a_crossed.tlog")  # compiles, if nobody has
    assert columns.is_compiled()
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    compiling.announce([logs / "a_crossed.tlog"], always=True)
    monkeypatch.setattr(columns, "is_compiled", lambda: False)
    compiling.announce([logs / "a_crossed.tlog"])
    assert screen.getvalue() == ""
    compiling.announce([logs / "a_crossed.tlog"], always=True)
    assert screen.getvalue().startswith("compiling the log reader")


def test_a_log_is_large_by_its_bytes_a_compressed_one_by_what_is_in_it(tmp_path):
    for name, size, large in (
        ("a.tlog", COMPILED_FROM_BYTES, True),
        ("b.tlog", COMPILED_FROM_BYTES - 1, False),
        ("c.tlog.gz", COMPILED_FROM_BYTES // PACKED, True),
        ("d.tlog.gz", COMPILED_FROM_BYTES // PACKED - 1, False),
    ):
        with (tmp_path / name).open("wb") as file:
            file.truncate(size)
        assert is_large(tmp_path / name) is large
    assert is_large(tmp_path / "none.tlog") is False


# -- info -------------------------------------------------------------------------------------------------------------


def test_info_as_json_is_an_analysis_without_what_judges(logs, capsys):
    whole = json.loads(said(capsys, "analyze", "--json", logs / "a_crossed.tlog")[1])
    code, out, err = said(capsys, "info", "--json", logs / "a_crossed.tlog", logs / "c_crossed.tlog.gz")
    assert (code, err) == (0, "")
    plain, packed = map(json.loads, out.splitlines())
    assert list(plain) == ["schema", "log", "reader", "vehicles", "duration_s"]
    for name in ("schema", "log", "reader", "duration_s"):
        assert plain[name] == whole[name]
    assert plain["vehicles"] == [{**whole["vehicles"][0], "airframe": None}]
    assert packed["reader"] == plain["reader"]


def test_info_tells_people_frames_damage_vehicles_and_messages(logs, junk, capsys):
    code, out, err = said(capsys, "info", logs / "a_crossed.tlog", junk)
    assert code == 2
    assert err.splitlines() == [f"mavfdi info: {junk}: no MAVLink frame in 1400 bytes; is it a telemetry log?"]
    size = (logs / "a_crossed.tlog").stat().st_size
    lines = out.splitlines()
    assert lines[0] == f"{logs / 'a_crossed.tlog'}: {size} bytes"
    assert [line.split()[0] for line in lines[1:]] == ["frames", "damage", "duration", "vehicle", "messages"]
    assert "0 CRC failures, 0 resyncs" in lines[2]
    assert "system 1 component 1, MAV_AUTOPILOT 3, MAV_TYPE 28" in lines[4]
    counts = [int(part.rpartition(" ")[2]) for part in lines[5].split(", ")]
    assert counts == sorted(counts, reverse=True)


# -- export -----------------------------------------------------------------------------------------------------------

FACTORS = {
    "deg": np.pi / 180.0,
    "cdeg": np.pi / 18_000.0,
    "degE7": np.pi / 180e7,
    "cm": 1e-2,
    "mm": 1e-3,
    "cm/s": 1e-2,
    "mm/s": 1e-3,
}
PLAIN = {"", "degE5", "rad", "rad/s", "us", "ms", "m", "m/s", "%"}


def expected(log, name):
    """The same messages by pymavlink's own decoder: field -> list of values, in SI by the units that pymavlink states."""
    from pymavlink import mavutil

    reader = mavutil.mavlink_connection(str(log), dialect="all")
    try:
        found = {"stamp_us": [], "sysid": [], "compid": []}
        while (message := reader.recv_match(type=name)) is not None:
            found["stamp_us"].append(round(message._timestamp * 1e6) // 4 * 4)
            found["sysid"].append(message.get_srcSystem())
            found["compid"].append(message.get_srcComponent())
            for field in message.get_fieldnames():
                unit = message.fieldunits_by_name.get(field, "")
                assert unit in FACTORS or unit in PLAIN, unit
                value = getattr(message, field)
                found.setdefault(field, []).append(value * FACTORS[unit] if unit in FACTORS else value)
        return found
    finally:
        reader.close()


def label(table, field):
    """The column of a field: its name, with the SI unit behind where it has one."""
    return next(
        name for name in table if name == field or (name.startswith(f"{field}_") and name.count("_") > field.count("_"))
    )


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.parametrize("name", ["ATTITUDE", "GPS_RAW_INT", "GLOBAL_POSITION_INT", "SERVO_OUTPUT_RAW", "STATUSTEXT"])
def test_exported_messages_are_those_that_pymavlink_reads(name, logs, tmp_path, capsys):
    log = logs / "a_crossed.tlog"
    code, out, err = said(capsys, "export", log, "--types", name, "--out", tmp_path)
    assert (code, err) == (0, "")
    table = parquet.read_table(tmp_path / f"{name}.parquet").to_pydict()
    said(capsys, "export", log, "--types", name, "--out", tmp_path, "--format", "csv")
    with (tmp_path / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        header, *lines = list(csv.reader(file))
    assert header == list(table)
    theirs = expected(log, name)
    assert out == f"{tmp_path / (name + '.parquet')}: {len(theirs['sysid'])} rows\n"
    assert len(lines) == len(theirs["sysid"]) > 0
    for field, values in theirs.items():
        column = label(table, field)
        written = [line[header.index(column)] for line in lines]
        if isinstance(values[0], str):
            assert table[column] == values == written
        else:
            tolerance = 4.0 if field == "stamp_us" else 0.0  # pymavlink's stamps are floats of seconds
            np.testing.assert_allclose(np.array(table[column], dtype=float), values, rtol=1e-15, atol=tolerance)
            np.testing.assert_array_equal(np.array(written, dtype=float), np.array(table[column], dtype=float))


def test_a_type_that_does_not_exist_is_a_mistake_and_one_that_does_not_occur_is_told(logs, tmp_path, capsys):
    log = logs / "b_healthy.tlog"
    code, out, err = said(capsys, "export", log, "--types", "ATTITUDE,ALTITUDES", "--out", tmp_path / "out")
    assert (code, out) == (2, "")
    assert err == "mavfdi export: 'ALTITUDES' is no MAVLink message; names are written as in ATTITUDE\n"
    assert not (tmp_path / "out").exists()
    code, out, err = said(capsys, "export", log, "--types", "ATTITUDE,ODOMETRY", "--out", tmp_path / "out")
    assert (code, err) == (0, "")
    assert out.splitlines()[1] == "ODOMETRY: none in this log"
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["ATTITUDE.parquet"]


def test_all_types_are_exported_where_none_is_named(logs, tmp_path, capsys):
    log = logs / "b_healthy.tlog"
    content = json.loads(said(capsys, "info", "--json", log)[1])
    assert said(capsys, "export", log, "--out", tmp_path)[0] == 0
    rows = {path.stem: parquet.read_metadata(path).num_rows for path in tmp_path.iterdir()}
    assert rows == content["reader"]["messages"]


def test_only_the_systems_that_are_named_are_exported(logs, tmp_path, capsys):
    records = list(Reader(logs / "b_healthy.tlog"))
    beat = next(one.frame for one in records if one.frame.name == "HEARTBEAT" and one.frame.compid == 1)
    from companion.dialect import encode

    other = encode("HEARTBEAT", {**beat.fields(), "custom_mode": 77}, sysid=9, compid=1, seq=0)
    log = tmp_path / "two.tlog"
    stamp_us = records[0].stamp_us & ~3
    log.write_bytes((logs / "b_healthy.tlog").read_bytes() + record(stamp_us, 0, other) * 3)
    for systems, ids, modes in (("9", [9, 9, 9], {77}), ("9,1", None, {10, 77}), ("5", [], set())):
        out = tmp_path / systems
        assert said(capsys, "export", log, "--types", "HEARTBEAT", "--systems", systems, "--out", out)[0] == 0
        if ids == []:
            assert list(out.iterdir()) == []
            continue
        table = parquet.read_table(out / "HEARTBEAT.parquet").to_pydict()
        assert modes <= set(table["custom_mode"])
        if ids is not None:
            assert table["sysid"] == ids
        else:
            assert set(table["sysid"]) == {1, 9}
    code, out, err = said(capsys, "export", log, "--systems", "one", "--out", tmp_path / "none")
    assert (code, out) == (2, "")
    assert err == "mavfdi export: --systems one: give numbers, for example 1,2\n"


def test_a_folder_that_cannot_be_made_is_one_line(logs, tmp_path, capsys):
    (tmp_path / "file").touch()
    code, out, err = said(capsys, "export", logs / "b_healthy.tlog", "--types", "ATTITUDE", "--out", tmp_path / "file")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert "cannot write here" in err
