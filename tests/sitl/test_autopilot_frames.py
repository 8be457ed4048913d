"""Frames packed by the tables are the frames that pymavlink packs."""

import numpy as np
import pytest
from pymavlink.dialects.v10 import all as dialect_v1
from pymavlink.dialects.v20 import all as dialect

from sitl.autopilot.frames import UNSENDABLE, frame_v1, frame_v2, layout, length_v1, pack
from tests.sitl.network import CLASSES, message


def random_fields(name, random):
    """Field values within their types, arrays in full, as pymavlink takes them and as `pack` does."""
    where = layout(name)
    theirs, ours = {}, {}
    for field, code in where.code.items():
        count = where.slot_count[field]
        if code == "c":
            theirs[field] = ours[field] = bytes(random.integers(65, 91, 5, dtype=np.uint8))
        elif code in "fd":
            theirs[field] = [float(np.float32(x)) for x in random.normal(0.0, 100.0, count)]
        else:
            bits = 8 * np.dtype(code).itemsize
            low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1)) if code.islower() else (0, 2**bits)
            theirs[field] = [
                int(x) for x in random.integers(low, high, count, dtype=np.int64 if code.islower() else np.uint64)
            ]
        if code != "c":
            ours[field] = tuple(theirs[field])
            if count == 1:
                theirs[field] = theirs[field][0]
                ours[field] = theirs[field]
    return theirs, ours


def test_every_message_of_the_dialect_is_packed_as_pymavlink_packs_it():
    random = np.random.default_rng(1)
    mav = dialect.MAVLink(None, 7, 42)
    mav.seq = 201
    for name in sorted(name for name in CLASSES if "TEST" not in name):
        theirs, ours = random_fields(name, random)
        assert frame_v2(pack(name, **ours), 201, 7, 42) == message(name, **theirs).pack(mav), name
    assert len(CLASSES) > 300


def test_a_message_of_zeros_keeps_one_byte_of_payload():
    mav = dialect.MAVLink(None, 1, 1)
    assert frame_v2(pack("EXTENDED_SYS_STATE"), 0, 1, 1) == message("EXTENDED_SYS_STATE").pack(mav)


@pytest.mark.parametrize("name", ["HEARTBEAT", "SYS_STATUS", "GPS_RAW_INT", "COMMAND_ACK", "STATUSTEXT", "PARAM_VALUE"])
def test_mavlink_1_frames_have_no_extension_fields(name):
    parser = dialect_v1.MAVLink(None)
    parser.robust_parsing = True
    _, ours = random_fields(name, np.random.default_rng(5))
    (heard,) = parser.parse_buffer(frame_v1(pack(name, **ours), 3, 1, 1))
    assert heard.get_type() == name
    assert len(heard.get_msgbuf()) == 8 + dialect_v1.mavlink_map[CLASSES[name].id].unpacker.size


def test_mavlink_1_has_no_place_for_message_numbers_beyond_255():
    assert length_v1(layout("WHEEL_DISTANCE").id) == UNSENDABLE
    assert frame_v1(pack("WHEEL_DISTANCE"), 0, 1, 1) == b""


def test_a_field_that_the_message_does_not_have_is_refused():
    with pytest.raises(KeyError):
        pack("HEARTBEAT", armed=1)
    with pytest.raises(KeyError):
        layout("WHEEL_DISTANCE").slot("distance[16]")
