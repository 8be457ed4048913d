"""The compiled reading of a log, judged by the plain one, by pymavlink and by an independent walk's counts."""

import gzip
import json
import math
import random
import struct
from pathlib import Path

import numpy as np
import pytest
from fastcrc.crc16 import mcrf4xx
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from pymavlink.dialects.v20 import all as mavlink

from companion import columns, decode, unpacking, walk
from companion.decode import PLAUSIBLE, TABLE, WIRE_UNITS, Decoder, Row, dimension_of
from companion.dialect import by_name, definition, encode, known_ids
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


def framed(message_id: int, payload: bytes, seed: int) -> bytes:
    """A frame of MAVLink 2 around any payload."""
    head = bytes((len(payload), 0, 0, 0, 1, 1)) + message_id.to_bytes(3, "little")
    return b"\xfd" + head + payload + mcrf4xx(head + payload + bytes((seed,))).to_bytes(2, "little")


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
    for length in range(40):
        data = rng.integers(0, 256, length, dtype=np.uint8)
        found = walk.crc16(data, 0, length, np.uint64(77), walk.crc_tables())
        assert int(found) == mcrf4xx(data.tobytes() + bytes((77,)))


def columns_by_numpy(message, payloads):
    """The judge: rows filled or cut to the definition's size, seen as records, multiplied field by field in double."""
    dtype = columns.row_dtype(message)
    rows = b"".join(payload[: dtype.itemsize].ljust(dtype.itemsize, b"\0") for payload in payloads)
    out = {}
    for name, column in ((name, np.frombuffer(rows, dtype)[name]) for name in message.fields):
        _, factor = WIRE_UNITS.get(message.units.get(name, ""), ("1", 1.0))
        out[name] = column if factor == 1.0 else column.astype(np.float64) * factor
    return out


def test_every_field_of_every_message_is_what_numpy_makes_of_its_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(columns, "CACHED", 500)  # so that a type comes from several pieces of the log
    rng = random.Random(5)
    payloads = {message_id: [] for message_id in known_ids()}
    log = []
    for message_id, seed in sorted(known_ids().items(), key=lambda _: rng.random()) * 4:
        payload = rng.randbytes(rng.choice((rng.randrange(1, 256), definition(message_id).layout.size)))
        payloads[message_id].append(payload)
        log.append(framed(message_id, payload, seed))
    path = tmp_path / "a.tlog"
    path.write_bytes(as_log(log))
    found = columns.read(path).columns()
    assert len(found) == len(payloads) > 300
    for message_id, own in payloads.items():
        message = definition(message_id)
        with np.errstate(invalid="ignore", over="ignore"):  # random bytes are NaN and far too large now and then
            judged = columns_by_numpy(message, own)
        for name, column in judged.items():
            got = found[message.name].fields[name]
            assert (got.dtype, got.shape) == (column.dtype, column.shape), (message.name, name)
            assert got.tobytes() == column.tobytes(), (message.name, name)


def samples_of_the_live_path(index, rows):
    """By channel: {number of the frame: bits of the sample}; and the decoder's counts of what it left out."""
    decoder = Decoder(tuple(dict.fromkeys(row.channel for row in rows)))
    found = {channel: {} for channel in decoder.channels}
    for number, one in enumerate(index.records()):
        sampled = decoder.decode(one.frame)
        for place, value in sampled.values if sampled else ():
            found[decoder.channels[place]][number] = struct.pack("<d", value)
    return found, dict(decoder.counts)


def samples_of_the_columns(index, rows):
    """The same from the columns as they stand, less what the table calls unknown or of another instance."""
    found, counts = {row.channel: {} for row in rows}, {"absurd": 0, "not_finite": 0}
    messages = index.columns({row.message for row in rows})
    for row in rows:
        if row.message not in messages:
            continue
        part = messages[row.message]
        name, _, element = row.field.partition("[")
        column = part.fields[name][:, int(element.rstrip("]"))] if element else part.fields[name]
        unknown = None if row.unknown is None else row.unknown * WIRE_UNITS[by_name(row.message).units.get(name, "")][1]
        own = part.fields[row.instance[0]] == row.instance[1] if row.instance else np.ones(len(column), np.bool_)
        for number, value in zip(part.frames[own].tolist(), column[own].tolist(), strict=True):
            if value == unknown:
                continue
            if row.mask:
                found[row.channel][number] = struct.pack("<d", bool(value & row.mask))
            elif abs(value) <= PLAUSIBLE[dimension_of(row.channel)]:
                found[row.channel][number] = struct.pack("<d", value)
            else:
                counts["absurd" if math.isfinite(value) else "not_finite"] += 1
    return found, {kind: count for kind, count in counts.items() if count}


def wire_value(rng, kind):
    """What a field may hold: what vehicles measure, the ends of its range, numbers that are none."""
    if kind in ("float", "double"):
        special = rng.choice((0.0, -0.0, math.nan, math.inf, -math.inf))
        return rng.choice((rng.uniform(-7.0, 7.0), rng.uniform(-7.0, 7.0), rng.gauss(0.0, 1e3), special))
    limits = np.iinfo(columns.DTYPES[kind])
    low, high = int(limits.min), int(limits.max)
    return rng.choice((rng.randint(low, high), rng.randint(max(low, -100), 100), low, high))


def payload_for(rng, message, rows):
    """Random bytes and random measurements, the table's special values now and then, sometimes cut."""
    flat = list(message.layout.unpack(rng.randbytes(message.layout.size)))
    place = {}
    for name, kind, count, start in zip(message.fields, message.types, message.counts, message.starts, strict=True):
        place |= {f"{name}[{k}]": start + k for k in range(count)} | {name: start}
        if kind != "char" and rng.random() < 0.8:
            flat[start : start + max(count, 1)] = [wire_value(rng, kind) for _ in range(max(count, 1))]
    for row in rows:
        if row.unknown is not None and rng.random() < 0.2:
            flat[place[row.field]] = row.unknown
    for name, value in {row.instance for row in rows if row.instance and rng.random() < 0.2}:
        flat[place[name]] = value
    payload = message.layout.pack(*flat)
    return payload[: rng.randrange(1, len(payload) + 1)] if rng.random() < 0.2 else payload


def random_log(rows, each, seed):
    """A log of so many frames of each message that the rows name."""
    rng = random.Random(seed)
    by_message = {}
    for row in rows:
        by_message.setdefault(row.message, []).append(row)
    raws = []
    for name, own in by_message.items():
        message = by_name(name)
        raws += [framed(message.id, payload_for(rng, message, own), message.crc_extra) for _ in range(each)]
    rng.shuffle(raws)
    return as_log(raws)


def every_number_of_the_dialect():
    """A decode table of all numbers of all messages whose unit has a factor, each with a channel of its own."""
    rows = []
    for message in map(definition, known_ids()):
        for name, kind, count in zip(message.fields, message.types, message.counts, strict=True):
            unit = message.units.get(name, "")
            if kind != "char" and unit in WIRE_UNITS:
                suffix = WIRE_UNITS[unit][0]
                elements = [f"{name}[{k}]" for k in range(count)] or [name]
                rows += [Row(message.name, element, f"{message.name} {element} _{suffix}") for element in elements]
    return tuple(rows)


def test_columns_and_live_path_give_the_same_bits_for_every_line_of_the_decode_table(tmp_path):
    path = tmp_path / "a.tlog"
    path.write_bytes(random_log(TABLE, 200, seed=6))
    index = columns.read(path)
    expected, counts = samples_of_the_live_path(index, TABLE)
    assert samples_of_the_columns(index, TABLE) == (expected, counts)
    assert min(map(len, expected.values())) >= 20
    assert counts.keys() == {"absurd", "not_finite"}


def test_columns_and_live_path_give_the_same_bits_for_every_number_that_has_a_factor(tmp_path, monkeypatch):
    rows = every_number_of_the_dialect()
    monkeypatch.setattr(decode, "TABLE", rows)
    path = tmp_path / "a.tlog"
    path.write_bytes(random_log(rows, 12, seed=7))
    index = columns.read(path)
    expected, counts = samples_of_the_live_path(index, rows)
    assert samples_of_the_columns(index, rows) == (expected, counts)
    assert sum(map(bool, expected.values())) > 0.95 * len(rows) > 2000


def test_columns_and_live_path_give_the_same_bits_on_real_frames():
    if not DATA.is_dir():
        pytest.skip("the real logs of ../shared/data are not here")
    seen = set()
    for entry in json.loads((DATA / "INDEX.json").read_text())["logs"]:
        if entry["size"] <= LARGEST_BYTES // 4 and entry["frames"]:
            index = columns.read(DATA / entry["file"])
            expected, counts = samples_of_the_live_path(index, TABLE)
            assert samples_of_the_columns(index, TABLE) == (expected, counts), entry["file"]
            seen |= {channel for channel, samples in expected.items() if samples}
    assert {"pressure_pa", "wind_direction_rad", "latitude_rad", "course_rad", "output_1_us", "armed"} <= seen


def test_scaled_fields_are_double_and_fields_in_si_keep_the_wires_kind(tmp_path):
    path = tmp_path / "a.tlog"
    raws = [
        encode("SCALED_PRESSURE", {"press_abs": 1013.3}, sysid=1, compid=1, seq=0),
        encode("WIND", {"direction": 77.7, "speed": 5.1}, sysid=1, compid=1, seq=1),
    ]
    path.write_bytes(as_log(raws))
    found = columns.read(path).columns()
    pressure, wind = found["SCALED_PRESSURE"].fields["press_abs"], found["WIND"].fields
    assert [column.dtype for column in (pressure, wind["direction"], wind["speed"])] == [np.float64, np.float64, np.float32]
    assert pressure.tolist() == [float(np.float32(1013.3)) * 100.0]
    assert wind["direction"].tolist() == [float(np.float32(77.7)) * (math.pi / 180.0)]


def test_the_kernels_look_at_no_byte_outside_the_log():
    checked = njit(boundscheck=True)(walk.good_frames.py_func)
    plain = [encode("ATTITUDE", {"time_boot_ms": 1, "roll": 0.1}, sysid=1, compid=1, seq=0)]
    log = as_log(frames(30) + plain)
    for data in (damaged(log, 3), log, log[:-1], log[:-9], log[8:]):
        data = np.frombuffer(data, dtype=np.uint8)
        for position in range(len(data) + 9):
            for cut in (0, 1, 7):
                room = walk.Frames.empty(40)
                part = data[: len(data) - cut]
                more = (walk.seeds(), walk.crc_tables())
                got = checked(part, position, 0, *more, room)
                assert got == walk.good_frames(part, position, 0, *more, walk.Frames.empty(40))
    index_of_last = walk.Frames.empty(1)
    last = np.frombuffer(as_log(plain), dtype=np.uint8)
    assert walk.good_frames(last, 0, 0, *more, index_of_last) == (1, len(last))
    sizes, order, payloads = np.array([28], np.uint64), np.empty(1, np.uint32), np.empty(4, np.uint64)
    spread = njit(boundscheck=True)(unpacking.spread.py_func)
    places = np.zeros(1, np.uint64), np.zeros(1, np.uint64)
    spread(last, index_of_last, np.ones(1, np.bool_), np.zeros(100, np.int16), sizes, *places, order, payloads)
    assert payloads.tobytes()[:28] == plain[0][10:-2].ljust(28, b"\0")


def test_what_is_no_log_is_told_in_one_line(tmp_path):
    (tmp_path / "empty.tlog").write_bytes(b"")
    (tmp_path / "text.tlog").write_bytes(b"hello " * 1000)
    (tmp_path / "cut.tlog.gz").write_bytes(gzip.compress(as_log(frames(9)))[:-9])
    for name in ("empty.tlog", "text.tlog", "cut.tlog.gz", "missing.tlog"):
        with pytest.raises(UserError, match=name) as told:
            columns.read(tmp_path / name)
        assert "\n" not in str(told.value)


def test_a_message_of_a_newer_definition_is_named_where_its_crc_fits_and_stays_unknown(tmp_path):
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
