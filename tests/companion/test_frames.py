"""Bytes to frames and back, judged by pymavlink and by damage of every kind."""

import random
import struct
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import all as mavlink

from companion.dialect import (
    LONGEST_FRAME_BYTES,
    MAGIC_V1,
    MAGIC_V2,
    SIGNATURE_BYTES,
    by_name,
    decode_fields,
    definition,
    encode,
)
from companion.frames import Splitter

RANGES = {
    "uint8_t": (0, 2**8 - 1),
    "int8_t": (-(2**7), 2**7 - 1),
    "uint16_t": (0, 2**16 - 1),
    "int16_t": (-(2**15), 2**15 - 1),
    "uint32_t": (0, 2**32 - 1),
    "int32_t": (-(2**31), 2**31 - 1),
    "uint64_t": (0, 2**64 - 1),
    "int64_t": (-(2**63), 2**63 - 1),
}
EVERY_MESSAGE = sorted(mavlink.mavlink_map.values(), key=lambda message: message.id)
UNKNOWN_ID = 0x0DEAD0


def judge(sysid=1, compid=1):
    """pymavlink's own packer and parser, signing nothing."""
    return mavlink.MAVLink(None, srcSystem=sysid, srcComponent=compid)


def drawn(rng, message):
    """Field values that fill a message; one in four is left at zero, so that payloads end in zeros too."""
    values = {}
    for name, kind, count in zip(message.ordered_fieldnames, types_of(message), message.array_lengths, strict=True):
        if kind == "char":
            letters = rng.randrange(count + 1) if count else 1
            values[name] = "".join(rng.choice("abcXYZ 019_") for _ in range(letters))
        elif kind in RANGES:
            low, high = RANGES[kind]
            numbers = [rng.choice((0, low, high, rng.randint(low, high))) for _ in range(max(1, count))]
            values[name] = tuple(numbers) if count else numbers[0]
        else:
            numbers = [rng.choice((0.0, rng.uniform(-1e6, 1e6))) for _ in range(max(1, count))]
            if kind == "float":
                numbers = [struct.unpack("<f", struct.pack("<f", number))[0] for number in numbers]
            values[name] = tuple(numbers) if count else numbers[0]
    return values


def types_of(message):
    by_field = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
    return [by_field[name] for name in message.ordered_fieldnames]


def as_pymavlink(message, values):
    """The message object, built by keyword: pymavlink's order of arguments is not the wire's."""
    return message(**{name: value.encode() if isinstance(value, str) else value for name, value in values.items()})


def of_pymavlink(parsed):
    """What pymavlink says of a message's fields, arrays as tuples."""
    out = {}
    for name in parsed.fieldnames:
        value = getattr(parsed, name)
        out[name] = tuple(value) if isinstance(value, list) else value
    return out


def some_stream(seed, count=40, *, v1=False):
    """Frames as pymavlink packs them: [(raw, message, values)], of types drawn at random."""
    rng = random.Random(seed)
    mav = judge(sysid=rng.randrange(1, 256), compid=rng.randrange(1, 256))
    out = []
    for _ in range(count):
        message = rng.choice([each for each in EVERY_MESSAGE if not v1 or each.id < 256])
        values = drawn(rng, message)
        raw = bytes(as_pymavlink(message, values).pack(mav, force_mavlink1=v1))
        mav.seq = (mav.seq + 1) % 256
        out.append((raw, message, values))
    return out


def signed(raw, signature=bytes(range(1, SIGNATURE_BYTES + 1))):
    """The same frame with a signature behind it; its CRC covers the flag."""
    head = bytes((raw[1], 1, *raw[3:10]))
    payload = raw[10 : 10 + raw[1]]
    crc = mavlink.x25crc(head + payload)
    crc.accumulate(bytes((definition(raw[7] | raw[8] << 8 | raw[9] << 16).crc_extra,)))
    return bytes((MAGIC_V2,)) + head + payload + struct.pack("<H", crc.crc) + signature


def unknown(payload=b"abc", seq=3):
    """A well-formed MAVLink 2 frame of an id that nobody has defined."""
    head = struct.pack("<BBBBBBBHB", MAGIC_V2, len(payload), 0, 0, seq, 1, 1, UNKNOWN_ID & 0xFFFF, UNKNOWN_ID >> 16)
    return head + payload + b"\x12\x34"


def split(data, *, at=()):
    """-> (splitter, frames) of these bytes, handed over in pieces cut at these places."""
    splitter, frames = Splitter(), []
    cuts = [0, *sorted(set(at)), len(data)]
    for start, end in pairwise(cuts):
        frames += splitter.feed(data[start:end])
    return splitter, frames


ATTITUDE = encode("ATTITUDE", {"time_boot_ms": 1234, "roll": 0.5, "yawspeed": -0.25}, sysid=1, compid=1, seq=7)
HEARTBEAT = encode("HEARTBEAT", {"type": 1, "autopilot": 3, "mavlink_version": 3}, sysid=1, compid=1, seq=8)


# -- against pymavlink ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("message", EVERY_MESSAGE, ids=lambda message: message.msgname)
def test_every_message_is_packed_and_read_as_pymavlink_does(message):
    rng = random.Random(message.id)
    for _ in range(4):
        values = drawn(rng, message)
        mav = judge(sysid=7, compid=191)
        mav.seq = rng.randrange(256)
        theirs = bytes(as_pymavlink(message, values).pack(mav))
        assert encode(message.msgname, values, sysid=7, compid=191, seq=mav.seq) == theirs
        (frame,) = Splitter().feed(theirs)
        assert (frame.name, frame.message_id, frame.sysid, frame.compid, frame.seq) == (
            message.msgname,
            message.id,
            7,
            191,
            mav.seq,
        )
        assert frame.raw == theirs
        assert frame.fields() == values == of_pymavlink(mav.parse_char(theirs))


@pytest.mark.parametrize("message", [each for each in EVERY_MESSAGE if each.id < 256], ids=lambda message: message.msgname)
def test_every_mavlink_1_message_is_read_as_pymavlink_does(message):
    rng = random.Random(message.id)
    values = drawn(rng, message)
    raw = bytes(as_pymavlink(message, values).pack(judge(sysid=9, compid=1), force_mavlink1=True))
    (frame,) = Splitter().feed(raw)
    assert raw[0] == MAGIC_V1
    assert (frame.name, frame.sysid, frame.compid, frame.raw, frame.signed) == (message.msgname, 9, 1, raw, False)
    assert frame.fields() == of_pymavlink(judge().parse_char(raw))


@pytest.mark.parametrize("v1", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_a_clean_stream_gives_the_messages_that_pymavlink_gives(seed, v1):
    stream = some_stream(seed, 300, v1=v1)
    data = b"".join(raw for raw, _, _ in stream)
    theirs = judge().parse_buffer(data)
    splitter, frames = split(data)
    assert [frame.raw for frame in frames] == [bytes(parsed.get_msgbuf()) for parsed in theirs]
    assert [frame.fields() for frame in frames] == [of_pymavlink(parsed) for parsed in theirs]
    assert splitter.counts == {"frames": len(stream)}


def test_a_field_that_does_not_exist_and_a_message_that_does_not_exist_are_refused():
    with pytest.raises(KeyError, match="rol"):
        encode("ATTITUDE", {"rol": 1.0}, sysid=1, compid=1, seq=0)
    with pytest.raises(KeyError, match="ATITUDE"):
        encode("ATITUDE", {}, sysid=1, compid=1, seq=0)


def test_the_payload_is_never_empty_and_sequence_numbers_wrap():
    raw = encode("ATTITUDE", {}, sysid=1, compid=1, seq=256)
    assert raw[1] == 1
    assert raw[4] == 0


def test_fields_left_out_are_zero_in_every_message():
    for message in EVERY_MESSAGE:
        (frame,) = Splitter().feed(encode(message.msgname, {}, sysid=1, compid=1, seq=0))
        assert not any(any(value) if isinstance(value, tuple) else value for value in frame.fields().values())


def test_text_that_is_no_utf_8_is_read_all_the_same():
    message = by_name("STATUSTEXT")
    assert decode_fields(message, b"\x04ab\xffcd\0ef")["text"] == "ab�cd"


def test_payloads_longer_than_the_definition_are_read_as_far_as_it_is_known():
    message = by_name("HEARTBEAT")
    short, long = bytes(range(1, 10)), bytes(range(1, 30))
    assert decode_fields(message, long) == decode_fields(message, short)


# -- slicing ----------------------------------------------------------------------------------------------------------


RUBBISH = st.one_of(
    st.binary(max_size=40),
    st.lists(st.sampled_from((MAGIC_V1, MAGIC_V2)), max_size=40).map(bytes),
    st.lists(st.sampled_from((MAGIC_V1, MAGIC_V2, 0, 1, 255)), max_size=60).map(bytes),
)
PIECES = st.one_of(
    st.integers(0, 30).map(lambda seed: some_stream(seed, 1)[0][0]),
    st.integers(0, 30).map(lambda seed: some_stream(seed, 1, v1=True)[0][0]),
    st.integers(0, 30).map(lambda seed: signed(some_stream(seed, 1)[0][0])),
    st.integers(0, 255).map(lambda seq: unknown(seq=seq)),
    RUBBISH,
)


@settings(max_examples=200)
@given(st.lists(PIECES, max_size=12).map(b"".join), st.lists(st.integers(0, 3000), max_size=30))
def test_any_slicing_of_the_bytes_gives_the_same_frames_and_the_same_counts(data, cuts):
    whole_splitter, whole = split(data)
    sliced_splitter, sliced = split(data, at=[cut for cut in cuts if cut < len(data)])
    assert whole == sliced
    assert whole_splitter.counts == sliced_splitter.counts


def test_byte_by_byte_is_a_slicing_too():
    data = b"".join(raw for raw, _, _ in some_stream(5, 60)) + unknown() + HEARTBEAT
    assert split(data)[1] == split(data, at=range(1, len(data)))[1]


@settings(max_examples=200)
@given(st.lists(PIECES, max_size=12).map(b"".join))
def test_every_byte_is_given_out_skipped_or_still_waited_for(data):
    splitter, frames = split(data)
    waiting = len(data) - sum(len(frame.raw) for frame in frames) - splitter.counts["skipped_bytes"]
    assert 0 <= waiting <= LONGEST_FRAME_BYTES


# -- damage -----------------------------------------------------------------------------------------------------------


def crc_is_right(raw, message_id):
    """The judge of a frame's CRC, by pymavlink's own arithmetic."""
    header = 10 if raw[0] == MAGIC_V2 else 6
    end = header + raw[1]
    crc = mavlink.x25crc(raw[1:end])
    crc.accumulate(bytes((mavlink.mavlink_map[message_id].crc_extra,)))
    return crc.crc == raw[end] | raw[end + 1] << 8


@settings(max_examples=300)
@given(st.integers(0, 10), st.lists(st.tuples(st.integers(0, 2000), st.integers(1, 255)), min_size=1, max_size=20))
def test_no_frame_with_a_wrong_crc_ever_comes_out(seed, hits):
    data = bytearray(b"".join(raw for raw, _, _ in some_stream(seed, 20)))
    for place, change in hits:
        data[place % len(data)] ^= change
    for frame in split(bytes(data))[1]:
        if frame.definition is not None:
            assert crc_is_right(frame.raw, frame.message_id)


@settings(max_examples=200)
@given(RUBBISH, st.integers(0, 20))
def test_rubbish_costs_no_more_than_one_longest_frame_behind_it(rubbish, seed):
    expected = [raw for raw, _, _ in some_stream(seed, 20)] + [HEARTBEAT] * 14
    _, frames = split(rubbish + b"".join(expected))
    found = [frame.raw for frame in frames if frame.definition is not None]
    # The rubbish may be the head of a frame of an unknown id, and its length may reach into the stream; never further.
    lost = next(k for k in range(len(expected)) if found[len(found) - len(expected) + k :] == expected[k:])
    assert sum(map(len, expected[:lost])) <= LONGEST_FRAME_BYTES


def test_rubbish_of_magic_bytes_loses_no_frame_behind_it():
    rng = random.Random(1)
    for _ in range(200):
        rubbish = bytes(rng.choice((MAGIC_V1, MAGIC_V2)) for _ in range(rng.randrange(1, 300)))
        found = [frame.raw for frame in split(rubbish + ATTITUDE + HEARTBEAT * 30)[1] if frame.definition is not None]
        assert found == [ATTITUDE] + [HEARTBEAT] * 30


def test_a_cut_frame_costs_itself_alone():
    for end in range(1, len(ATTITUDE)):
        splitter, frames = split(HEARTBEAT + ATTITUDE[:end] + HEARTBEAT * 12)
        assert [frame.raw for frame in frames] == [HEARTBEAT] * 13, end
        assert splitter.counts["skipped_bytes"] == end


def test_every_single_flipped_bit_costs_one_frame_at_most():
    stream = HEARTBEAT + ATTITUDE + HEARTBEAT * 14
    for bit in range(8 * len(ATTITUDE)):
        data = bytearray(stream)
        data[len(HEARTBEAT) + bit // 8] ^= 1 << bit % 8
        known = [frame.raw for frame in split(bytes(data))[1] if frame.definition is not None]
        assert known in ([HEARTBEAT] * 15, [HEARTBEAT] * 14), bit


def test_damage_is_counted():
    spoiled = bytearray(ATTITUDE)
    spoiled[12] ^= 1
    splitter, frames = split(bytes(spoiled) + HEARTBEAT)
    assert [frame.raw for frame in frames] == [HEARTBEAT]
    assert splitter.counts["bad_crc"] >= 1
    assert splitter.counts["skipped_bytes"] == len(ATTITUDE)
    assert splitter.counts["frames"] == 1


# -- signatures, unknown ids, flags -----------------------------------------------------------------------------------


def test_a_signed_frame_is_read_and_keeps_its_signature():
    raw = signed(ATTITUDE)
    assert len(raw) == len(ATTITUDE) + SIGNATURE_BYTES
    (first, second) = split(raw + ATTITUDE)[1]
    assert (first.raw, first.signed) == (raw, True)
    assert (second.raw, second.signed) == (ATTITUDE, False)
    assert first.fields() == second.fields()


def test_a_frame_signed_by_pymavlink_is_read():
    mav = judge()
    mav.signing.secret_key = bytes(range(32))
    mav.signing.sign_outgoing = True
    mav.signing.link_id = 3
    mav.signing.timestamp = 1_000_000
    raw = bytes(mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3).pack(mav))
    for end in range(len(raw)):
        assert Splitter().feed(raw[:end]) == []
    (frame,) = Splitter().feed(raw)
    assert frame.signed
    assert frame.name == "HEARTBEAT"


def test_a_frame_with_a_flag_that_nobody_knows_is_no_frame():
    for flags in range(2, 256):
        raw = bytearray(ATTITUDE)
        raw[2] = flags
        assert [frame.raw for frame in split(bytes(raw) + HEARTBEAT * 30)[1]] == [HEARTBEAT] * 30


def test_an_unknown_id_is_marked_and_never_decoded():
    splitter, frames = split(unknown() + HEARTBEAT)
    assert [frame.raw for frame in frames] == [unknown(), HEARTBEAT]
    assert frames[0].definition is None
    assert frames[0].name == f"UNKNOWN_{UNKNOWN_ID}"
    assert frames[0].fields() == {}
    assert splitter.counts == {"unknown_frames": 1, "frames": 1}


def test_an_unknown_id_is_a_frame_only_where_another_one_begins_right_behind_it():
    assert [frame.raw for frame in split(unknown() + b"\0" + HEARTBEAT)[1]] == [HEARTBEAT]
    splitter = Splitter()
    assert splitter.feed(unknown()) == []
    assert [frame.raw for frame in splitter.feed(HEARTBEAT)] == [unknown(), HEARTBEAT]


def test_ids_beyond_all_definitions_are_unknown():
    assert definition(UNKNOWN_ID) is None
    with pytest.raises(KeyError):
        by_name("UNKNOWN_1")
