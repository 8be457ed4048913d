"""The files of a run: complete, numbered, never in the way of the loop, and honest about what was lost."""

import errno
import fcntl
import itertools
import json
import math
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from pymavlink import mavutil

from companion.dialect import encode
from companion.errors import UserError
from companion.recorder import (
    BEFORE_US,
    MEGABYTE,
    RECORD_NAME,
    FlightLog,
    Recorder,
    RecordFile,
    Rules,
    When,
    load_record,
    save_record,
)
from companion.tlog import OWN_LINK, Reader, record

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

    def __init__(self, recorder, room, then):
        tlog = recorder._flights._file
        self.file, self.room, self.then = tlog._file, room, then
        self.asked = threading.Event()
        tlog._file = self

    def write(self, data):
        if len(data) > self.room:
            self.asked.set()
            return self.then(self, data)
        self.room -= len(data)
        return self.file.write(data)

    def truncate(self, size):
        return self.file.truncate(size)

    def fileno(self):
        return self.file.fileno()

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
    Disk(recorder, 1000, then)
    for number in range(200):
        recorder.frame(START_US + number * 100, 0, frame(number))
    recorder.close()
    reader = Reader(recorder.tlog_path)
    kept = list(reader)
    assert recorder.failed == "No space left on device"
    assert reader.report.tail_bytes == 0  # cut back to its last whole record
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
    disk = Disk(recorder, 0, stalls)
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
    assert 20_000 - 300 < reader.report.bytes <= 20_000
    assert (reader.report.tail_bytes, reader.report.resyncs) == (0, 0)


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


# -- one flight, one file ---------------------------------------------------------------------------------------------

STEP_US = 100_000


class Vehicle:
    """Frames every 0.1 s into the logs of one run, and what was told of them."""

    def __init__(self, folder, number=1, **rules):
        self.folder, self.told, self.count = folder, [], 0
        self.log = FlightLog(folder, number, Rules(**rules), self.told.append)

    def fly(self, frames):
        for _ in range(frames):
            stamp_us = START_US + STEP_US * self.count
            self.log.frame(stamp_us, record(stamp_us, 0, frame(self.count)))
            self.count += 1
        return self

    def armed_for(self, frames):
        """The frame that says so stands before each change."""
        self.log.arm()
        self.fly(frames)
        self.log.disarm()
        return self

    @property
    def names(self):
        return [(news.name, news.details.get("file"), news.details.get("next")) for news in self.told]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.log.close()


def numbers(path):
    """Which of the frames this log holds, as we and as pymavlink read it."""
    ours = [one.frame.fields()["time_boot_ms"] // 100 for one in Reader(path)]
    assert by_pymavlink(path) == [100 * number for number in ours]
    return ours


def by_pymavlink(path):
    """The boot times of all messages that pymavlink's own reader finds, ms."""
    connection = mavutil.mavlink_connection(str(path), dialect="all")
    try:
        messages = iter(connection.recv_match, None)
        return [message.time_boot_ms for message in messages if message.get_type() != "BAD_DATA"]
    finally:
        connection.close()


def logs(folder):
    return sorted(path.name for path in folder.glob("*.tlog*"))


def test_the_first_flight_of_a_run_stays_in_the_runs_first_log_with_what_came_before_it(tmp_path):
    with Vehicle(tmp_path) as vehicle:
        vehicle.fly(300).armed_for(200).fly(100)
    assert numbers(tmp_path / "flight.tlog") == list(range(600))
    assert logs(tmp_path) == ["flight.tlog"]
    assert vehicle.names == [("opened", "flight.tlog", None)]


def test_each_further_flight_begins_a_log_ten_seconds_before_its_arming(tmp_path):
    with Vehicle(tmp_path) as vehicle:
        vehicle.fly(50).armed_for(300).fly(200).armed_for(300).fly(20).armed_for(300)
    before = BEFORE_US // STEP_US
    assert numbers(tmp_path / "flight.tlog") == list(range(550))
    assert numbers(tmp_path / "flight-2.tlog") == list(range(549 - before, 870))
    assert numbers(tmp_path / "flight-3.tlog") == list(range(869 - before, 1170))
    assert vehicle.names == [
        ("opened", "flight.tlog", None), ("rotated", "flight.tlog", "flight-2.tlog"),
        ("rotated", "flight-2.tlog", "flight-3.tlog"),
    ]  # fmt: skip
    assert {news.reason for news in vehicle.told[1:]} == {"the vehicle is armed"}
    assert [news.details["bytes"] for news in vehicle.told[1:]] == [
        (tmp_path / name).stat().st_size for name in ("flight.tlog", "flight-2.tlog")
    ]


def test_a_log_that_would_outgrow_its_size_is_followed_by_another_and_each_frame_stands_once(tmp_path):
    size = 10_000
    with Vehicle(tmp_path, file_bytes=size) as vehicle:
        vehicle.fly(1000)
    files = ["flight.tlog", *(f"flight-{number}.tlog" for number in range(2, len(logs(tmp_path)) + 1))]
    assert [number for name in files for number in numbers(tmp_path / name)] == list(range(1000))
    sizes = [(tmp_path / name).stat().st_size for name in files]
    assert all(size - 60 < found <= size for found in sizes[:-1])
    assert vehicle.names == [("opened", files[0], None)] + [
        ("rotated", one, other) for one, other in itertools.pairwise(files)
    ]  # fmt: skip


def test_a_long_wait_on_the_ground_does_not_split_the_flight_behind_it(tmp_path):
    with Vehicle(tmp_path, file_bytes=15_000) as vehicle:
        vehicle.fly(350).armed_for(100)  # more than half of the file was full
    assert vehicle.names[1:] == [("rotated", "flight.tlog", "flight-2.tlog")]
    assert numbers(tmp_path / "flight-2.tlog")[-100:] == list(range(350, 450))


def test_a_flight_that_outgrows_a_file_leaves_none_of_it_in_the_next_flights_log(tmp_path):
    with Vehicle(tmp_path, file_bytes=10_000) as vehicle:
        vehicle.armed_for(500).fly(150).armed_for(10)
    assert vehicle.told[-1].reason == "the vehicle is armed"
    assert numbers(tmp_path / "flight-3.tlog") == list(range(649 - BEFORE_US // STEP_US, 660))


def test_while_armed_a_log_goes_from_ten_seconds_before_the_arming_to_the_disarming(tmp_path):
    with Vehicle(tmp_path, when=When.WHILE_ARMED) as vehicle:
        vehicle.fly(300)
        assert logs(tmp_path) == []
        vehicle.armed_for(200).fly(300).armed_for(50).fly(100)
    before = BEFORE_US // STEP_US
    assert numbers(tmp_path / "flight.tlog") == list(range(299 - before, 500))
    assert numbers(tmp_path / "flight-2.tlog") == list(range(799 - before, 850))
    assert vehicle.names == [
        ("opened", "flight.tlog", None), ("closed", "flight.tlog", None),
        ("opened", "flight-2.tlog", None), ("closed", "flight-2.tlog", None),
    ]  # fmt: skip
    assert vehicle.log.dropped == 0  # what was not to be recorded is not lost


def test_armed_from_the_first_heartbeat_on_a_flight_is_recorded_from_its_first_frame(tmp_path):
    with Vehicle(tmp_path, when=When.WHILE_ARMED) as vehicle:
        vehicle.fly(30).armed_for(10)  # a companion that boots in mid-flight; the vehicle is chosen after 3 s
    assert numbers(tmp_path / "flight.tlog") == list(range(40))


def test_what_is_remembered_from_before_a_flight_is_bounded_in_bytes_too(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.recorder.BEFORE_BYTES", 1000)
    with Vehicle(tmp_path, when=When.WHILE_ARMED) as vehicle:
        vehicle.fly(90).armed_for(1)
    assert 1000 - 60 < (tmp_path / "flight.tlog").stat().st_size - len(record(START_US, 0, frame(90))) <= 1000


def test_off_keeps_no_frame_and_loses_none(tmp_path):
    recorder = Recorder(tmp_path, Rules(When.OFF))
    recorder.armed(True)
    for number in range(10):
        recorder.frame(START_US, 0, frame(number))
    recorder.event({"seq": 0})
    recorder.close()
    assert [path.name for path in tmp_path.iterdir()] == ["events.jsonl"]
    assert (recorder.dropped, recorder.failed, recorder.news()) == (0, "", [])


def test_events_and_summary_stay_one_a_run_and_the_next_run_is_numbered_above_all_files(tmp_path):
    for _ in range(2):
        recorder = Recorder(tmp_path)
        for number in range(3):
            recorder.frame(START_US + STEP_US * number, 0, frame(number))
            recorder.armed(True)
            recorder.event({"seq": number})
            recorder.armed(False)
        recorder.close()
        recorder.summary({})
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "events-4.jsonl", "events.jsonl", "flight-2.tlog", "flight-3.tlog", "flight-4.tlog", "flight-5.tlog",
        "flight-6.tlog", "flight.tlog", "summary-4.json", "summary.json",
    ]  # fmt: skip


@pytest.mark.parametrize("left", ["flight-7.tlog", "flight-7.tlog.gz", "events-7.jsonl", "summary-7.json"])
def test_a_number_freed_by_removing_old_logs_is_not_taken_again(left, tmp_path):
    (tmp_path / left).touch()
    (tmp_path / "flight-100 copy.tlog").touch()  # not ours
    recorder = Recorder(tmp_path)
    recorder.close()
    assert recorder.tlog_path.name == "flight-8.tlog"


def test_a_log_that_somebody_else_makes_meanwhile_is_left_alone(tmp_path):
    with Vehicle(tmp_path) as vehicle:
        vehicle.armed_for(10)
        (tmp_path / "flight-2.tlog").write_bytes(b"somebody else's")
        vehicle.armed_for(10)
    assert vehicle.names[-1] == ("rotated", "flight.tlog", "flight-3.tlog")
    assert (tmp_path / "flight-2.tlog").read_bytes() == b"somebody else's"


def test_an_arming_gets_through_a_queue_that_is_full(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.recorder.QUEUE", 20)
    goes_on = threading.Event()
    recorder = Recorder(tmp_path)
    recorder.armed(True)
    recorder._queue.put(lambda: goes_on.wait(LIMIT_S) and None)
    for number in range(100):
        recorder.frame(START_US, 0, frame(number))
    recorder.armed(False)
    recorder.armed(True)
    goes_on.set()
    recorder.settle()
    assert recorder.dropped >= 80
    assert [news.name for news in recorder.news()] == ["opened", "rotated"]
    recorder.close()


def test_cut_at_any_byte_a_log_is_read_up_to_its_last_whole_frame_by_us_and_by_pymavlink(tmp_path):
    with Vehicle(tmp_path) as vehicle:
        vehicle.fly(5)
    data, ends = (tmp_path / "flight.tlog").read_bytes(), [0]
    for one in Reader(tmp_path / "flight.tlog"):
        ends.append(ends[-1] + 8 + len(one.frame.raw))
    assert ends[-1] == len(data)
    cut = tmp_path / "cut.tlog"
    for size in range(ends[1], len(data) + 1):
        cut.write_bytes(data[:size])
        assert numbers(cut) == list(range(sum(end <= size for end in ends[1:])))


# -- room on the disk -------------------------------------------------------------------------------------------------


class Room:
    """A small disk: `bytes` are shared by the files of a folder."""

    def __init__(self, folder, monkeypatch, size):
        self.folder, self.bytes = folder, size
        monkeypatch.setattr("companion.recorder.free_bytes", self.free)
        monkeypatch.setattr("companion.recorder.CHECK_BYTES", 1000)

    def free(self, _):
        return self.bytes - sum(path.lstat().st_blocks * 512 for path in self.folder.iterdir())


@pytest.fixture
def room(tmp_path, monkeypatch):
    return Room(tmp_path, monkeypatch, 10 * MEGABYTE)


def old(folder, name, size=MEGABYTE):
    (folder / name).write_bytes(bytes(size))


def test_the_oldest_logs_by_number_make_room_and_nothing_else_does(room, tmp_path):
    kept = ["flight-old.tlog", "flight-01.tlog", "flight.png", "events.jsonl", "other.tlog", "flight-3.tlog.part"]
    for name in ("flight-10.tlog", "flight.tlog.gz", "flight-2.tlog", *kept):
        old(tmp_path, name, MEGABYTE // 2)
    (tmp_path / "flight-4.tlog").mkdir()
    (tmp_path / "flight-5.tlog").symlink_to(tmp_path / "flight-old.tlog")
    room.bytes = 5_600_000  # 4.5 MB of it taken
    with Vehicle(tmp_path, 11, free_bytes=2 * MEGABYTE) as vehicle:
        assert vehicle.names == [
            ("removed", "flight.tlog.gz", None), ("removed", "flight-2.tlog", None), ("opened", "flight-11.tlog", None)
        ]  # fmt: skip
        room.bytes -= MEGABYTE // 2
        vehicle.fly(100)
        assert vehicle.names[3:] == [("removed", "flight-10.tlog", None)]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        [*kept, "flight-11.tlog", "flight-4.tlog", "flight-5.tlog"]
    )
    assert numbers(tmp_path / "flight-11.tlog") == list(range(100))
    assert vehicle.told[0].text == "flight.tlog.gz (0.5 MB) is removed to keep 2 MB free"
    assert vehicle.told[0].details["bytes"] == MEGABYTE // 2


def test_where_removing_every_log_would_not_do_none_is_removed_and_recording_stops(room, tmp_path):
    old(tmp_path, "flight.tlog")
    old(tmp_path, "film.mp4", 8 * MEGABYTE)
    with Vehicle(tmp_path, 2, free_bytes=3 * MEGABYTE) as vehicle:
        vehicle.fly(10)
    assert logs(tmp_path) == ["flight.tlog"]
    assert vehicle.log.failed == "less than 3 MB free on the disk"
    assert [(news.name, news.text) for news in vehicle.told] == [
        ("full", "recording stopped: less than 3 MB free on the disk; monitoring goes on")
    ]
    assert vehicle.log.dropped == 10


def test_a_disk_that_fills_up_in_flight_ends_the_log_whole_and_the_next_arming_tries_again(room, tmp_path):
    with Vehicle(tmp_path, free_bytes=MEGABYTE) as vehicle:
        vehicle.fly(50)
        vehicle.log.arm()
        vehicle.fly(50)
        room.bytes = 0
        vehicle.fly(100)
        vehicle.log.disarm()
        assert vehicle.names == [("opened", "flight.tlog", None), ("full", None, None)]
        room.bytes = 10 * MEGABYTE
        vehicle.fly(100).armed_for(30)
        assert vehicle.names[2:] == [("opened", "flight-2.tlog", None)]
        assert vehicle.log.failed == ""
    kept = numbers(tmp_path / "flight.tlog")
    assert kept == list(range(len(kept)))
    assert 100 < len(kept) < 130
    assert numbers(tmp_path / "flight-2.tlog") == list(range(299 - BEFORE_US // STEP_US, 330))
    assert vehicle.log.dropped == 300 - len(kept)


@pytest.mark.parametrize("locks", [True, False])
def test_the_log_in_hand_is_never_removed_though_it_is_the_oldest(locks, room, tmp_path, monkeypatch):
    if not locks:  # as on a file system that has none
        monkeypatch.setattr(fcntl, "flock", no_locks)
    with Vehicle(tmp_path, free_bytes=2 * MEGABYTE) as vehicle:
        old(tmp_path, "flight-2.tlog")
        vehicle.fly(2000)
        room.bytes = 2 * MEGABYTE + 200_000
        vehicle.fly(100)
    assert vehicle.names == [("opened", "flight.tlog", None), ("removed", "flight-2.tlog", None)]
    assert numbers(tmp_path / "flight.tlog") == list(range(2100))


def no_locks(_handle, _operation):
    raise OSError(errno.ENOLCK, "No locks available")


def test_the_log_that_another_run_is_writing_is_never_removed(room, tmp_path):
    others = RecordFile(tmp_path / "flight.tlog")
    others.write(bytes(MEGABYTE))
    old(tmp_path, "flight-2.tlog")
    room.bytes = 4 * MEGABYTE - 100_000
    with Vehicle(tmp_path, 3, free_bytes=2 * MEGABYTE) as vehicle:
        assert vehicle.names == [("removed", "flight-2.tlog", None), ("opened", "flight-3.tlog", None)]
    others.close()


def test_a_log_that_cannot_be_removed_is_passed_over(room, tmp_path, monkeypatch):
    old(tmp_path, "flight.tlog")
    old(tmp_path, "flight-2.tlog")
    room.bytes = 4 * MEGABYTE - 100_000
    real = Path.unlink

    def unlink(path, **options):
        if path.name == "flight.tlog":
            raise PermissionError(errno.EPERM, "Operation not permitted")
        real(path, **options)

    monkeypatch.setattr(Path, "unlink", unlink)
    with Vehicle(tmp_path, 3, free_bytes=2 * MEGABYTE) as vehicle:
        assert vehicle.names == [("removed", "flight-2.tlog", None), ("opened", "flight-3.tlog", None)]


def test_events_go_on_below_the_floor_of_free_space(room, tmp_path):
    room.bytes = 0
    recorder = Recorder(tmp_path)
    recorder.frame(START_US, 0, frame(0))
    recorder.event({"seq": 0})
    recorder.close()
    assert recorder.failed == "less than 200 MB free on the disk"
    assert recorder.dropped == 1
    assert recorder.events_path.read_text(encoding="utf-8") == '{"seq":0}\n'
    assert not recorder.tlog_path.exists()


def test_an_event_that_does_not_fit_is_told_once_and_leaves_whole_lines(tmp_path):
    recorder = Recorder(tmp_path)
    recorder.news()
    disk = Disk(recorder, 0, full)
    recorder._flights._file._file = disk.file
    disk.file, disk.room, disk.then = recorder._events._file, 25, takes_what_fits
    recorder._events._file = disk
    for number in range(20):
        recorder.event({"seq": number})
    recorder.settle()
    (news,) = recorder.news()
    recorder.close()
    assert news.text == "events are not recorded: No space left on device; monitoring goes on"
    assert recorder.events_path.read_text(encoding="utf-8").count("\n") == 2
    assert recorder.events_path.read_text(encoding="utf-8").endswith("\n")
    assert recorder.dropped == 18
