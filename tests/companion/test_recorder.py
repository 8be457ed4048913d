"""The files of a run: complete, numbered, never in the way of the loop, and honest about what was lost."""

import errno
import json
import math
import os
import subprocess
import sys
import threading

import pytest

from companion.dialect import encode
from companion.errors import UserError
from companion.recorder import RECORD_NAME, Recorder, load_record, save_record
from companion.tlog import OWN_LINK, Reader

START_US = 1_700_000_000_000_000
LIMIT_S = 30.0


def frame(number):
    return encode("ATTITUDE", {"time_boot_ms": 100 * number, "roll": 0.1}, sysid=1, compid=1, seq=number % 256)


def recorded(folder, count=100):
    """A run of so many frames and as many events."""
    recorder = Recorder(folder)
    for number in range(count):
        recorder.frame(START_US + 100_000 * number, OWN_LINK if number % 10 == 0 else 0, frame(number))
        recorder.event({"seq": number})
    recorder.close()
    recorder.summary({"frames": count})
    return recorder


def test_everything_handed_over_is_on_disk_in_order_when_it_is_closed(tmp_path):
    recorder = recorded(tmp_path / "deep" / "folder", 500)
    records = list(Reader(recorder.tlog_path))
    assert [one.frame.raw for one in records] == [frame(number) for number in range(500)]
    assert [one.link == OWN_LINK for one in records] == [number % 10 == 0 for number in range(500)]
    lines = recorder.events_path.read_text(encoding="utf-8").splitlines()
    assert [json.loads(line)["seq"] for line in lines] == list(range(500))
    assert (recorder.dropped, recorder.failed) == (0, "")


def test_a_folder_that_holds_earlier_runs_keeps_them_and_the_new_one_is_numbered(tmp_path):
    for _ in range(3):
        recorded(tmp_path)
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == sorted(
        f"{stem}{number}.{ending}"
        for stem, ending in (("flight", "tlog"), ("events", "jsonl"), ("summary", "json"))
        for number in ("", "-2", "-3")
    )


@pytest.mark.parametrize("left", ["events.jsonl", "summary.json", "flight.tlog"])
def test_one_file_left_of_an_earlier_run_is_enough_to_keep_its_number(left, tmp_path):
    (tmp_path / left).write_text("of an earlier run", encoding="utf-8")
    recorder = recorded(tmp_path)
    assert recorder.tlog_path.name == "flight-2.tlog"
    assert recorder.events_path.name == "events-2.jsonl"
    assert (tmp_path / "summary-2.json").exists()
    assert (tmp_path / left).read_text(encoding="utf-8") == "of an earlier run"


def test_a_folder_that_cannot_be_is_a_users_mistake(tmp_path):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(UserError, match="cannot record here"):
            Recorder(folder)
        assert load_record(folder) == ""


class Disk:
    """Stands in for the log's file: takes so many bytes, then as it is told."""

    def __init__(self, file, room, then):
        self.file, self.room, self.then = file, room, then
        self.asked = threading.Event()

    def write(self, data):
        if len(data) > self.room:
            self.asked.set()
            return self.then(self, data)
        self.room -= len(data)
        return self.file.write(data)

    def close(self):
        self.file.close()


def full(_disk, _data):
    raise OSError(errno.ENOSPC, "No space left on device")


def takes_what_fits(disk, data):
    disk.file.write(data[: disk.room])
    return disk.room


@pytest.mark.parametrize("then", [full, takes_what_fits])
def test_a_full_disk_ends_the_recording_says_why_and_counts_what_is_lost(then, tmp_path):
    recorder = Recorder(tmp_path)
    recorder._tlog = Disk(recorder._tlog, 1000, then)
    for number in range(200):
        recorder.frame(START_US + number * 100, 0, frame(number))
    recorder.close()
    kept = list(Reader(recorder.tlog_path))
    assert recorder.failed == "No space left on device"
    assert [one.frame.raw for one in kept] == [frame(number) for number in range(len(kept))]
    assert len(kept) > 10
    assert recorder.dropped == 200 - len(kept)


def test_a_disk_that_stalls_makes_nobody_wait_and_what_does_not_fit_is_counted(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.recorder.QUEUE", 50)
    goes_on = threading.Event()

    def stalls(disk, data):
        assert goes_on.wait(LIMIT_S)
        disk.room = 1 << 30
        return disk.file.write(data)

    recorder = Recorder(tmp_path)
    disk = recorder._tlog = Disk(recorder._tlog, 0, stalls)
    for number in range(3):
        recorder.frame(START_US, 0, frame(number))
    assert disk.asked.wait(LIMIT_S)
    for number in range(3, 500):
        recorder.frame(START_US, 0, frame(number))  # returns at once: nobody empties the queue
    assert 0 < recorder.dropped < 500
    goes_on.set()
    recorder.close()
    kept = [one.frame.raw for one in Reader(recorder.tlog_path)]
    assert len(kept) == 500 - recorder.dropped
    assert kept == [frame(number) for number in range(len(kept))]
    assert recorder.failed == ""


FILLED = """
import resource, sys
from pathlib import Path
from companion.recorder import Recorder
from companion.dialect import encode
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
recorder = Recorder(Path(sys.argv[1]))
for number in range(2000):
    raw = encode("ATTITUDE", {"roll": 0.1}, sysid=1, compid=1, seq=number % 256)
    recorder.frame(1_700_000_000_000_000 + 4 * number, 0, raw)
recorder.close()
print(recorder.dropped, recorder.failed)
"""


def test_a_file_that_may_grow_no_further_leaves_a_readable_log(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", FILLED, str(tmp_path)], capture_output=True, text=True, timeout=LIMIT_S, check=True
    )  # fmt: skip
    dropped, _, why = done.stdout.strip().partition(" ")
    reader = Reader(tmp_path / "flight.tlog")
    kept = list(reader)
    assert why
    assert len(kept) == 2000 - int(dropped)
    assert (reader.report.bytes, reader.report.resyncs) == (20_000, 0)


KILLED = """
import os, signal, sys, threading
from pathlib import Path
from companion.recorder import Recorder
from companion.dialect import encode
recorder = Recorder(Path(sys.argv[1]))
threading.Thread(target=lambda: (sys.stdin.read(1), os.kill(os.getpid(), signal.SIGKILL)), daemon=True).start()
number = 0
while True:
    raw = encode("ATTITUDE", {"time_boot_ms": number, "roll": 0.1}, sysid=1, compid=1, seq=number % 256)
    recorder.frame(1_700_000_000_000_000 + 4 * number, 0, raw)
    recorder.event({"seq": number})
    number += 1
    if number == 1000:
        print("going", flush=True)
"""


def test_a_kill_leaves_at_most_one_record_and_one_line_cut(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )  # fmt: skip
    try:
        assert process.stdout.readline() == "going\n"
        process.communicate("x", timeout=LIMIT_S)
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
    reader = Reader(tmp_path / "flight.tlog")
    assert all(one.frame.name == "ATTITUDE" for one in reader)
    assert (reader.report.crc_failures, reader.report.resyncs) == (0, 0)
    assert reader.report.tail_bytes < 300
    assert reader.report.sources[1, 1].seq_lost == 0
    *whole, cut = (tmp_path / "events.jsonl").read_text(encoding="utf-8").split("\n")
    assert [json.loads(line)["seq"] for line in whole] == list(range(len(whole)))
    assert len(cut) < 20


def test_the_summary_is_written_whole_and_no_number_is_written_as_null(tmp_path):
    recorder = Recorder(tmp_path)
    path = recorder.summary({"a": math.nan, "b": [math.inf, 1.5], "text": "größer"})
    recorder.close()
    assert json.loads(path.read_text(encoding="utf-8")) == {"a": None, "b": [None, 1.5], "text": "größer"}
    assert not list(tmp_path.glob("*.new"))


def test_a_recoverys_record_is_kept_replaced_and_forgotten(tmp_path):
    assert load_record(tmp_path) == ""
    for text in ("first", "second, longer", "third"):
        save_record(tmp_path, text)
        assert load_record(tmp_path) == text
    assert [path.name for path in tmp_path.iterdir()] == [RECORD_NAME]
    save_record(tmp_path, "")
    save_record(tmp_path, "")
    assert load_record(tmp_path) == ""
    assert list(tmp_path.iterdir()) == []


def test_a_record_is_synced_with_its_folder_before_it_counts_as_saved(tmp_path, monkeypatch):
    done = []
    real_fsync, real_replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (done.append("sync"), real_fsync(handle))[1])
    monkeypatch.setattr(os, "replace", lambda *places: (done.append("replace"), real_replace(*places))[1])
    monkeypatch.setattr("pathlib.Path.replace", lambda path, target: os.replace(path, target))
    save_record(tmp_path, "text")
    assert done == ["sync", "replace", "sync"]
    done.clear()
    save_record(tmp_path, "")
    assert done == ["sync"]


def test_a_record_that_is_no_text_is_a_users_mistake_that_asks_to_look_at_the_vehicle(tmp_path):
    (tmp_path / RECORD_NAME).write_bytes(b"\xff\xfe\xfd")
    with pytest.raises(UserError, match="check the vehicle's outputs"):
        load_record(tmp_path)
    (tmp_path / RECORD_NAME).unlink()
    (tmp_path / RECORD_NAME).mkdir()
    with pytest.raises(UserError, match="check the vehicle's outputs"):
        load_record(tmp_path)
