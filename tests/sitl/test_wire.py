import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from sitl.parafoil import CHANNELS, VEHICLE, quantise
from sitl.vehicle import Field, Stream
from sitl.wire import field_type, quantiser


def readings():
    """One plausible row of every channel, none of them a round number."""
    rng = np.random.default_rng(5)
    row = rng.uniform(-3.0, 3.0, len(CHANNELS))
    plausible = {
        "altitude_m": 3456.78912,
        "height_m": 3456.78912,
        "course_rad": 4.123456789,
        "heading_rad": 6.2831,
        "ground_speed_m_s": 21.23456,
        "pressure_pa": 65432.109,
        "output_1_us": 1423.4567,
        "output_2_us": 1000.0,
        "target_distance_m": 4321.987,
        "wind_direction_rad": 5.4321,
        "wheel_distance_1_m": 0.7654321,
        "wheel_distance_2_m": 0.123,
    }
    for channel, value in plausible.items():
        row[CHANNELS.index(channel)] = value
    return row


def through_pymavlink(stream, row):
    """Pack a stream's message with pymavlink, unpack it, and return its channels, SI."""
    kind = next(kind for kind in dialect.mavlink_map.values() if kind.msgname == stream.message)
    sizes = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    values = {name: [0] * sizes[name] if sizes[name] else 0 for name in kind.fieldnames}
    entries = [(name, value, False) for name, value in stream.constants.items()] + [
        (field.name, row[CHANNELS.index(field.channel)] * field.scale + field.offset, True) for field in stream.fields
    ]
    for name, value, _ in entries:
        base, bracket, index = name.partition("[")
        number = float(value) if field_type(stream.message, name) in ("float", "double") else round(value)
        if bracket:
            values[base][int(index.rstrip("]"))] = number
        else:
            values[base] = number
    sender = dialect.MAVLink(None, 1, 1)
    frame = kind(**values).pack(sender)
    message = dialect.MAVLink(None).parse_buffer(frame)[0]
    decoded = {}
    for field in stream.fields:
        base, bracket, index = field.name.partition("[")
        wire = getattr(message, base)
        decoded[field.channel] = ((wire[int(index.rstrip("]"))] if bracket else wire) - field.offset) / field.scale
    return decoded


@pytest.mark.parametrize("stream", VEHICLE.streams, ids=lambda stream: stream.message)
def test_rounding_equals_packing_and_unpacking_by_pymavlink(stream):
    row = readings()
    rounded = quantiser([stream], CHANNELS)(row)
    for channel, value in through_pymavlink(stream, row).items():
        if [field.channel for field in stream.fields].count(channel) == 1 or stream.message == "GPS_RAW_INT":
            assert rounded[CHANNELS.index(channel)] == value


def test_the_first_stream_that_carries_a_channel_rounds_it():
    row = readings()
    rounded = quantise(row)
    assert rounded[CHANNELS.index("altitude_m")] == 3456.789  # millimetres of GLOBAL_POSITION_INT
    assert rounded[CHANNELS.index("roll_rad")] == np.float32(row[CHANNELS.index("roll_rad")])  # ATTITUDE, no whole degrees
    assert rounded[CHANNELS.index("output_1_us")] == 1423.0
    assert rounded[CHANNELS.index("wheel_distance_1_m")] == row[CHANNELS.index("wheel_distance_1_m")]  # a double
    assert rounded[CHANNELS.index("landed")] == row[CHANNELS.index("landed")]  # does not travel as a field


def test_rounding_keeps_unknown_unknown_and_leaves_its_input_alone():
    rows = np.tile(readings(), (3, 1))
    rows[1] = np.nan
    before = rows.copy()
    rounded = quantise(rows)
    assert np.array_equal(rows, before, equal_nan=True)
    assert np.isnan(rounded[1]).all()
    assert np.array_equal(rounded[0], quantise(rows[0]))


def test_what_an_integer_cannot_hold_stops_at_its_end():
    stream = Stream("GLOBAL_POSITION_INT", 1.0, 1.0, (Field("vx", "velocity_m_s", 100.0),))
    assert quantiser([stream], ("velocity_m_s",))(np.array([1000.0]))[0] == 327.67


def test_a_row_of_another_length_is_refused():
    with pytest.raises(ValueError, match="channels"):
        quantise(np.zeros(len(CHANNELS) + 1))
