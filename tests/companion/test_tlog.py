"""Reading telemetry logs: counts that an independent walk found in real logs, and no good frame lost to damage."""

import gzip
import hashlib
import json
import mmap
import random
from collections import Counter
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import all as mavlink

from companion.dialect import encode
from companion.errors import UserError
from companion.tlog import LINK_MASK, OWN_LINK, Reader, content, record

LOGS = Path(__file__).parents[3] / "shared" / "data" / "tlogs"
LARGEST_BYTES = 1_000_000
START_US = 1_700_000_000_000_000
REAL = (
    [log for log in json.loads((LOGS / "INDEX.json").read_text())["logs"] if log["size"] < LARGEST_BYTES]
    if LOGS.exists()
    else []
)
DAMAGED = sorted(LOGS.glob("damaged/*.truth.json"))

needs_logs = pytest.mark.skipif(not LOGS.exists(), reason=f"the collection of real logs is not at {LOGS}")


def read(path):
    reader = Reader(path)
    return list(reader), reader.report


# -- real logs --------------------------------------------------------------------------------------------------------


@needs_logs
@pytest.mark.parametrize("told", REAL, ids=[log["file"].partition(".")[0] for log in REAL])
def test_a_real_log_is_counted_as_an_independent_walk_counted_it(told):
    reader = Reader(LOGS / told["file"])
    if told["frames"] == 0:
        with pytest.raises(UserError, match="no MAVLink frame"):
            list(reader)
    else:
        assert sum(1 for _ in reader) == told["frames"]
    report = reader.report
    assert (report.bytes, report.sha256) == (told["size"], told["sha256"])
    for name in (
        "frames_v1", "frames_v2", "signed", "unstamped", "crc_failures", "resyncs", "resync_bytes", "tail_bytes",
        "unknown_frames", "first_us", "last_us", "stamps_backward", "stamps_implausible", "max_gap_us", "frames_sha256",
    ):  # fmt: skip
        assert getattr(report, name) == told[name], name
    as_json = report.as_json()
    assert as_json["messages"] == dict(sorted(told["messages"].items()))
    assert as_json["crc_failure_ids"] == told["crc_failure_ids"]
    names = ("sysid", "compid", "frames", "seq_lost")
    assert as_json["sources"] == [{name: source[name] for name in names} for source in told["sources"]]


@needs_logs
@pytest.mark.parametrize("truth_path", DAMAGED, ids=[path.name.partition(".")[0] for path in DAMAGED])
def test_no_good_frame_of_a_damaged_log_is_lost_and_no_false_one_accepted(truth_path):
    truth = json.loads(truth_path.read_text(encoding="utf-8"))
    damaged = truth_path.with_name(truth_path.name.replace(".truth.json", ".tlog.gz"))
    records, report = read(damaged)
    good = [found for found in records if found.frame.definition is not None]
    assert len(good) == truth["good_frames"]
    assert hashlib.sha256(b"".join(found.frame.raw for found in good)).hexdigest() == truth["good_frames_sha256"]
    assert len(records) - len(good) == report.unknown_frames
    intact = [
        us if whole else None for us, whole in zip(truth["good"]["stamp_us"], truth["good"]["stamp_intact"], strict=True)
    ]
    assert [found.stamp_us if us is not None else None for found, us in zip(good, intact, strict=True)] == intact


# -- logs of our own making -------------------------------------------------------------------------------------------


def frame(number, *, sysid=1, compid=1):
    return encode(
        "ATTITUDE", {"time_boot_ms": 100 * number, "roll": 0.1 * number}, sysid=sysid, compid=compid, seq=number % 256
    )


def records(count, *, link=0):
    return [record(START_US + 100_000 * number, link, frame(number)) for number in range(count)]


def written(tmp_path, data, name="flight.tlog"):
    path = tmp_path / name
    path.write_bytes(data)
    return path


def test_what_is_recorded_is_read_back_stamp_link_and_bytes(tmp_path):
    kept = [(START_US + 4 * number, number % 4, frame(number)) for number in range(50)]
    found, report = read(written(tmp_path, b"".join(record(*one) for one in kept)))
    assert [(one.stamp_us & ~LINK_MASK, one.link, one.frame.raw) for one in found] == kept
    assert (report.frames_v2, report.crc_failures, report.resyncs, report.tail_bytes) == (50, 0, 0, 0)
    assert (report.first_us, report.last_us & ~LINK_MASK) == (START_US, START_US + 4 * 49)
    assert OWN_LINK in {one.link for one in found}


def test_a_log_cut_at_any_byte_is_read_up_to_its_last_whole_record(tmp_path):
    whole = records(5)
    data = b"".join(whole)
    ends = [sum(map(len, whole[: number + 1])) for number in range(5)]
    for cut in range(ends[0], len(data)):
        found, report = read(written(tmp_path, data[:cut]))
        assert len(found) == sum(end <= cut for end in ends), cut
        assert report.tail_bytes == cut - max(end for end in ends if end <= cut)
        assert report.resyncs == 0


def test_rubbish_before_the_first_record_is_skipped_and_counted(tmp_path):
    found, report = read(written(tmp_path, bytes(range(100)) + b"".join(records(3))))
    assert [one.stamp_us for one in found] == [START_US, START_US + 100_000, START_US + 200_000]
    assert (report.resyncs, report.resync_bytes) == (1, 100)


def test_a_frame_with_a_wrong_bit_is_one_crc_failure_and_its_neighbours_are_kept(tmp_path):
    whole = records(9)
    broken = bytearray(whole[4])
    broken[20] ^= 4
    found, report = read(written(tmp_path, b"".join([*whole[:4], bytes(broken), *whole[5:]])))
    assert [one.frame.seq for one in found] == [0, 1, 2, 3, 5, 6, 7, 8]
    assert (report.crc_failures, report.crc_failure_ids) == (1, Counter({30: 1}))
    assert (report.resyncs, report.resync_bytes) == (1, len(broken))
    assert report.sources[1, 1].seq_lost == 1


def test_a_wrong_length_does_not_swallow_the_frames_behind_it(tmp_path):
    for length in (0, 1, 27, 29, 100, 255):
        whole = records(12)
        broken = bytearray(whole[4])
        broken[9] = length
        found, _ = read(written(tmp_path, b"".join([*whole[:4], bytes(broken), *whole[5:]])))
        assert [one.frame.seq for one in found] == [0, 1, 2, 3, 5, 6, 7, 8, 9, 10, 11], length


def test_frames_without_stamps_are_read_and_say_that_they_have_none(tmp_path):
    found, report = read(written(tmp_path, b"".join(frame(number) for number in range(20))))
    assert [one.stamp_us for one in found] == [None] * 20
    assert [one.link for one in found] == [None] * 20
    assert (report.unstamped, report.first_us, report.last_us) == (20, None, None)


def test_stamps_that_run_back_or_cannot_be_are_counted_and_the_frames_kept(tmp_path):
    stamps = [START_US, START_US + 5_000_000, START_US + 1_000_000, 40, 2**63, START_US + 9_000_000]
    found, report = read(written(tmp_path, b"".join(record(stamp, 0, frame(1)) for stamp in stamps)))
    assert [one.stamp_us for one in found] == stamps
    assert (report.stamps_backward, report.stamps_implausible) == (1, 2)
    assert report.max_gap_us == 8_000_000
    assert (report.first_us, report.last_us) == (START_US, START_US + 9_000_000)


def test_messages_of_both_versions_and_signed_ones_are_told_apart(tmp_path):
    version_1, signer = mavlink.MAVLink(None, 7, 1), mavlink.MAVLink(None, 1, 1)
    signer.signing.secret_key, signer.signing.sign_outgoing, signer.signing.timestamp = b"k" * 32, True, 1
    old = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3).pack(version_1, force_mavlink1=True)
    signed = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 0, 3).pack(signer)
    data = b"".join(record(START_US + 4 * number, 0, raw) for number, raw in enumerate((old, signed, frame(1), old, signed)))
    found, report = read(written(tmp_path, data))
    assert [one.frame.raw for one in found] == [old, signed, frame(1), old, signed]
    assert (report.frames_v1, report.frames_v2, report.signed) == (2, 3, 2)


def unknown(number):
    """A frame of an id that no dialect knows."""
    raw = bytearray(frame(number))
    raw[7:10] = (0xEE, 0xDD, 0xCC)
    return bytes(raw)


def test_an_unknown_message_is_kept_where_the_records_around_it_fit_and_taken_for_rubbish_where_not(tmp_path):
    whole = records(4)
    strange = [record(START_US, 0, unknown(number)) for number in range(3)]
    found, report = read(written(tmp_path, b"".join([*whole[:2], *strange, *whole[2:]])))
    assert (len(found), report.unknown_frames, report.resyncs) == (7, 3, 0)
    assert report.messages["UNKNOWN_13426158"] == 3
    assert report.sources[1, 1].frames == 4  # nothing in an unknown frame is believed
    found, report = read(written(tmp_path, b"".join([*whole[:2], strange[0], b"\0", *whole[2:]])))
    assert (len(found), report.unknown_frames, report.resyncs) == (4, 0, 1)


def test_random_damage_never_invents_a_frame_and_never_stops_the_reading(tmp_path):
    chances = random.Random(11)
    whole = records(200)
    genuine = {frame(number) for number in range(200)}
    for _ in range(20):
        data = bytearray(b"".join(whole))
        for _ in range(30):
            at = chances.randrange(len(data))
            match chances.randrange(3):
                case 0:
                    data[at] = chances.randrange(256)
                case 1:
                    del data[at : at + chances.randrange(1, 40)]
                case _:
                    data[at:at] = chances.randbytes(chances.randrange(1, 40))
        found, report = read(written(tmp_path, bytes(data)))
        good = [one.frame.raw for one in found if one.frame.definition is not None]
        assert set(good) <= genuine
        assert len(good) >= 200 - 3 * 30
        used = sum(len(one.frame.raw) + 8 * (one.stamp_us is not None) for one in found)
        assert used + report.resync_bytes + report.tail_bytes == report.bytes


def test_a_compressed_log_is_read_as_the_log_itself(tmp_path):
    data = b"".join(records(30))
    plain = read(written(tmp_path, data))
    packed = read(written(tmp_path, gzip.compress(data), "flight.tlog.gz"))
    assert packed == plain


@pytest.mark.parametrize("pack", [bytes, gzip.compress], ids=["plain", "packed"])
def test_a_large_log_is_mapped_not_held_and_read_as_a_small_one(pack, tmp_path, monkeypatch):
    data = b"".join(records(300))
    path = written(tmp_path, pack(data), "flight.tlog" if pack is bytes else "flight.tlog.gz")
    whole = read(path)
    assert isinstance(content(path), bytes)
    monkeypatch.setattr("companion.tlog.WHOLE_BYTES", 1000)
    monkeypatch.setattr("companion.tlog.UNPACKED_BYTES", 777)
    with content(path) as mapped:
        assert isinstance(mapped, mmap.mmap)
        assert mapped[:] == data
    assert read(path) == whole
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_a_report_does_not_depend_on_how_many_records_are_counted_at_a_time(tmp_path, monkeypatch):
    strange = [record(stamp, 0, unknown(1)) for stamp in (START_US, 40)]
    path = written(tmp_path, b"".join([*records(50), *strange, frame(7), *records(30)]))
    at_once = read(path)
    monkeypatch.setattr("companion.tlog.BATCH", 3)
    assert read(path) == at_once


def broken_inside():
    """Compressed data in which one block's code table cannot be."""
    data = bytearray(gzip.compress(b"".join(records(50))))
    data[12:60] = b"\xff" * 48
    return bytes(data)


BAD = {
    "empty": (b"", "flight.tlog", "no MAVLink frame in 0 bytes"),
    "text": (b"no log at all\n" * 50, "flight.tlog", "is it a telemetry log?"),
    "not compressed": (b"plain", "flight.tlog.gz", "cannot read the log"),
    "cut while compressing": (gzip.compress(b"".join(records(50)))[:-40], "flight.tlog.gz", "cannot read the log"),
    "damaged inside the compression": (broken_inside(), "flight.tlog.gz", "cannot read the log"),
}


@pytest.mark.parametrize(("data", "name", "text"), BAD.values(), ids=BAD.keys())
def test_what_is_no_log_is_a_users_mistake_in_one_line_that_names_the_file(data, name, text, tmp_path):
    path = written(tmp_path, data, name)
    with pytest.raises(UserError, match=text) as told:
        list(Reader(path))
    assert str(path) in str(told.value)
    assert "\n" not in str(told.value)


def test_a_file_that_is_not_there_or_is_a_folder_is_one_too(tmp_path):
    for path in (tmp_path / "none.tlog", tmp_path):
        with pytest.raises(UserError, match="cannot read the log"):
            list(Reader(path))
