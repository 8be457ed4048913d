"""The compiled reading of a log, judged by the plain one, by pymavlink and by an independent walk's counts."""

import gzip
import json
import math
import random
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from companion import columns, walk
from companion.dialect import encode
from companion.errors import UserError
from companion.tlog import Reader, record

DATA = Path(__file__).parents[3] / "shared" / "data" / "tlogs"
EPOCH_US = 1_767_225_600_000_000
LARGEST_BYTES = 2_000_000  # of the real logs looked at here; `tools/check_logs.py` looks at all of them


def frames(count: int, seed: int = 1) -> list[bytes]:
    """Frames of MAVLink 1 and 2, signed and unsigned, of known and unknown ids."""
    rng = random.Random(seed)
    version_1 = mavlink.MAVLink(None, 7, 1)
    out = []
    for number in range(count):
        kind = rng.randrange(4)
        roll = rng.uniform(-3.0, 3.0)
        if kind == 0:
            message = mavlink.MAVLink_attitude_message(number, roll, 0.1, 0.2, 0.3, 0.4, 0.5)
            out.append(message.pack(version_1, force_mavlink1=True))
        elif kind == 1:
            out.append(encode("ATTITUDE", {"time_boot_ms": number, "roll": roll}, sysid=1, compid=1, seq=number))
        elif kind == 2:
            fields = {"time_boot_ms": number, "lat": 47_123_4567, "vx": -123, "hdg": 9000}
            out.append(encode("GLOBAL_POSITION_INT", fields, sysid=1, compid=1, seq=number))
        else:
            plain = bytearray(
                encode("STATUSTEXT", {"severity": 6, "text": f"text {number}"}, sysid=1, compid=191, seq=number)
            )
            out.append(bytes(plain))
    return out


def as_log(raws: list[bytes]) -> bytes:
    return b"".join(record(EPOCH_US + 4 * 250 * number, number % 4, raw) for number, raw in enumerate(raws))


def damaged(log: bytes, seed: int) -> bytes:
    """Bytes flipped, cut out and put in here and there."""
    rng = random.Random(seed)
    data = bytearray(log)
    for _ in range(len(data) // 300):
        at = rng.randrange(len(data))
        match rng.randrange(4):
            case 0:
                data[at] = rng.randrange(256)
            case 1:
                del data[at : at + rng.randrange(1, 30)]
            case 2:
                data[at:at] = bytes(rng.choice((0xFD, 0xFE, rng.randrange(256))) for _ in range(rng.randrange(1, 60)))
            case _:
                data[at : at + 8] = struct.pack(">Q", rng.getrandbits(64))
    return bytes(data)


def both(path: Path) -> None:
    """The compiled and the plain reading say the same, in every record and every figure."""
    plain = Reader(path)
    records = list(plain)
    index = columns.read(path)
    index.hash()
    assert list(index.records()) == records
    assert index.report.as_json() == plain.report.as_json()
    assert index.report.sha256 == plain.report.sha256


@pytest.mark.parametrize("seed", range(6))
def test_damaged_logs_are_read_as_by_the_plain_reader(tmp_path, seed):
    path = tmp_path / "damaged.tlog"
    path.write_bytes(damaged(as_log(frames(400, seed)), seed))
    both(path)


@given(st.lists(st.one_of(st.binary(max_size=40), st.sampled_from(frames(8)), st.just(b"\xfd\xfe" * 9)), max_size=12))
@settings(max_examples=150, deadline=None)
def test_any_bytes_are_read_as_by_the_plain_reader(parts):
    data = np.frombuffer(as_log(frames(2)) + b"".join(parts), dtype=np.uint8)
    path = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path("/tmp")
    path = path / "mavfdi-any-bytes.tlog"
    path.write_bytes(data.tobytes())
    try:
        both(path)
    finally:
        path.unlink()


def test_real_logs_give_the_counts_of_an_independent_walk():
    if not DATA.is_dir():
        pytest.skip("the real logs of ../shared/data are not here")
    looked_at = 0
    for entry in json.loads((DATA / "INDEX.json").read_text())["logs"]:
        if entry["size"] > LARGEST_BYTES or not entry["frames"]:
            continue
        index = columns.read(DATA / entry["file"])
        index.hash()
        report = index.report.as_json()
        for name in report.keys() & entry.keys() - {"sources"}:
            assert report[name] == entry[name], (entry["file"], name)
        named = [[source[key] for key in ("sysid", "compid", "frames", "seq_lost")] for source in entry["sources"]]
        assert [list(source.values()) for source in report["sources"]] == named, entry["file"]
        looked_at += 1
    assert looked_at > 25


def test_compressed_and_plain_logs_are_the_same(tmp_path):
    log = as_log(frames(50))
    (tmp_path / "a.tlog").write_bytes(log)
    (tmp_path / "b.tlog.gz").write_bytes(gzip.compress(log))
    assert list(columns.read(tmp_path / "a.tlog").records()) == list(columns.read(tmp_path / "b.tlog.gz").records())


def test_columns_hold_what_pymavlink_decodes_in_si(tmp_path):
    path = tmp_path / "a.tlog"
    raws = frames(300)
    path.write_bytes(as_log(raws))
    found = columns.read(path).columns()
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    decoded = [message for raw in raws for message in parser.parse_buffer(raw)]
    positions = [message for message in decoded if message.get_type() == "GLOBAL_POSITION_INT"]
    got = found["GLOBAL_POSITION_INT"]
    assert got.fields["lat"] == pytest.approx([math.radians(message.lat * 1e-7) for message in positions], rel=1e-15)
    assert got.fields["vx"] == pytest.approx([message.vx * 0.01 for message in positions], rel=1e-15)
    assert got.fields["hdg"] == pytest.approx([math.radians(message.hdg * 0.01) for message in positions], rel=1e-15)
    assert got.units["lat"] == "rad"
    assert got.units["vx"] == "m_s"
    attitudes = [message for message in decoded if message.get_type() == "ATTITUDE"]
    assert found["ATTITUDE"].fields["roll"].tolist() == [message.roll for message in attitudes]
    texts = [message.text for message in decoded if message.get_type() == "STATUSTEXT"]
    assert [text.decode() for text in found["STATUSTEXT"].fields["text"].tolist()] == texts
    assert set(found["STATUSTEXT"].compid.tolist()) == {191}


def test_types_systems_and_times_can_be_chosen(tmp_path):
    path = tmp_path / "a.tlog"
    path.write_bytes(as_log(frames(200)))
    index = columns.read(path)
    assert set(index.columns(["ATTITUDE"])) == {"ATTITUDE"}
    assert set(index.columns(systems=[7])["ATTITUDE"].sysid.tolist()) == {7}
    middle_us = EPOCH_US + 4 * 250 * 100
    early, late = index.columns(to_us=middle_us), index.columns(from_us=middle_us)
    assert max(part.frames.max() for part in early.values()) < 100
    assert min(part.frames.min() for part in late.values()) >= 100
    with pytest.raises(UserError, match="NO_SUCH"):
        index.columns(["NO_SUCH"])


def test_short_and_long_payloads_are_filled_and_cut(tmp_path):
    path = tmp_path / "a.tlog"
    zeros = encode("ATTITUDE", {}, sysid=1, compid=1, seq=0)  # one byte of payload is left of it
    assert zeros[1] == 1
    path.write_bytes(as_log([zeros, encode("ATTITUDE", {"yawspeed": 2.5}, sysid=1, compid=1, seq=1)]))
    fields = columns.read(path).columns()["ATTITUDE"].fields
    assert fields["yawspeed"].tolist() == [0.0, 2.5]
    assert fields["roll"].tolist() == [0.0, 0.0]


def test_the_crc_of_eight_bytes_at_a_time_is_that_of_one_at_a_time():
    rng = np.random.default_rng(4)
    from fastcrc.crc16 import mcrf4xx

    for length in range(40):
        data = rng.integers(0, 256, length, dtype=np.uint8)
        found = walk.crc16(data, 0, length, np.uint64(77), walk.crc_tables())
        assert int(found) == mcrf4xx(data.tobytes() + bytes((77,)))


def test_what_is_no_log_is_told_in_one_line(tmp_path):
    (tmp_path / "empty.tlog").write_bytes(b"")
    (tmp_path / "text.tlog").write_bytes(b"hello " * 1000)
    (tmp_path / "cut.tlog.gz").write_bytes(gzip.compress(as_log(frames(9)))[:-9])
    for name in ("empty.tlog", "text.tlog", "cut.tlog.gz", "missing.tlog"):
        with pytest.raises(UserError, match=name) as told:
            columns.read(tmp_path / name)
        assert "\n" not in str(told.value)


def test_a_message_of_a_newer_definition_is_named_where_its_crc_fits_and_stays_unknown(tmp_path):
    from fastcrc.crc16 import mcrf4xx

    def esc_status(extra):
        head = bytes((57, 0, 0, 1, 1, 1)) + (291).to_bytes(3, "little")
        crc = mcrf4xx(head + bytes(57) + bytes((extra,)))
        return b"\xfd" + head + bytes(57) + crc.to_bytes(2, "little")

    known = encode("ATTITUDE", {}, sysid=1, compid=1, seq=0)
    path = tmp_path / "a.tlog"
    path.write_bytes(as_log([known, esc_status(10), known, esc_status(11), known]))
    both(path)
    report = columns.read(path).report
    assert report.unknown_frames == 2
    assert dict(report.recognised) == {"ESC_STATUS": 1}
    assert report.messages["UNKNOWN_291"] == 2
