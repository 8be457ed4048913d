"""Each line of the decode table against a table written by hand from MAVLink's own documentation."""

import math
import random
import struct

import pytest
from pymavlink.dialects.v20 import all as mavlink

from companion import decode
from companion.decode import TABLE, ClockKind, Decoder, Row, dimension_of
from companion.dialect import MAGIC_V1, by_name, encode
from companion.frames import Splitter

# channel: message, field, array index, factor to SI of the unit that MAVLink's common.xml or ardupilotmega.xml gives it,
# value for "unknown".  Written from those documents, not from the code.
BY_HAND = {
    "landed_state": ("EXTENDED_SYS_STATE", "landed_state", None, 1.0, 0),
    "latitude_rad": ("GLOBAL_POSITION_INT", "lat", None, 1e-7 * 0.017453292519943295, None),
    "longitude_rad": ("GLOBAL_POSITION_INT", "lon", None, 1e-7 * 0.017453292519943295, None),
    "altitude_m": ("GLOBAL_POSITION_INT", "alt", None, 0.001, None),
    "height_m": ("GLOBAL_POSITION_INT", "relative_alt", None, 0.001, None),
    "velocity_north_m_s": ("GLOBAL_POSITION_INT", "vx", None, 0.01, None),
    "velocity_east_m_s": ("GLOBAL_POSITION_INT", "vy", None, 0.01, None),
    "velocity_down_m_s": ("GLOBAL_POSITION_INT", "vz", None, 0.01, None),
    "gps_fix_type": ("GPS_RAW_INT", "fix_type", None, 1.0, None),
    "gps_satellites": ("GPS_RAW_INT", "satellites_visible", None, 1.0, 255),
    "ground_speed_m_s": ("GPS_RAW_INT", "vel", None, 0.01, 65535),
    "course_rad": ("GPS_RAW_INT", "cog", None, 0.01 * 0.017453292519943295, 65535),
    "roll_rad": ("ATTITUDE", "roll", None, 1.0, None),
    "pitch_rad": ("ATTITUDE", "pitch", None, 1.0, None),
    "yaw_rad": ("ATTITUDE", "yaw", None, 1.0, None),
    "roll_rate_rad_s": ("ATTITUDE", "rollspeed", None, 1.0, None),
    "pitch_rate_rad_s": ("ATTITUDE", "pitchspeed", None, 1.0, None),
    "yaw_rate_rad_s": ("ATTITUDE", "yawspeed", None, 1.0, None),
    "turn_rate_command_rad_s": ("ATTITUDE_TARGET", "body_yaw_rate", None, 1.0, None),
    "acceleration_x_m_s2": ("HIGHRES_IMU", "xacc", None, 1.0, None),
    "acceleration_y_m_s2": ("HIGHRES_IMU", "yacc", None, 1.0, None),
    "acceleration_z_m_s2": ("HIGHRES_IMU", "zacc", None, 1.0, None),
    "pressure_pa": ("SCALED_PRESSURE", "press_abs", None, 100.0, None),
    "pressure_altitude_m": ("VFR_HUD", "alt", None, 1.0, None),
    "climb_rate_m_s": ("VFR_HUD", "climb", None, 1.0, None),
    "airspeed_m_s": ("VFR_HUD", "airspeed", None, 1.0, None),
    "wind_speed_m_s": ("WIND", "speed", None, 1.0, None),
    "wind_direction_rad": ("WIND", "direction", None, 0.017453292519943295, None),
    "nav_bearing_rad": ("NAV_CONTROLLER_OUTPUT", "nav_bearing", None, 0.017453292519943295, None),
    "target_bearing_rad": ("NAV_CONTROLLER_OUTPUT", "target_bearing", None, 0.017453292519943295, None),
    "target_distance_m": ("NAV_CONTROLLER_OUTPUT", "wp_dist", None, 1.0, None),
    "altitude_error_m": ("NAV_CONTROLLER_OUTPUT", "alt_error", None, 1.0, None),
    "wheel_distance_1_m": ("WHEEL_DISTANCE", "distance", 0, 1.0, None),
    "wheel_distance_2_m": ("WHEEL_DISTANCE", "distance", 1, 1.0, None),
    **{f"output_{k}_us": ("SERVO_OUTPUT_RAW", f"servo{k}_raw", None, 1.0, 0) for k in range(1, 17)},
}
CHANNELS = tuple(dict.fromkeys(row.channel for row in TABLE))
CLOCKS = {
    "GLOBAL_POSITION_INT": (ClockKind.BOOT_MS, "time_boot_ms", 4_000_000_000),
    "ATTITUDE": (ClockKind.BOOT_MS, "time_boot_ms", 4_000_000_000),
    "ATTITUDE_TARGET": (ClockKind.BOOT_MS, "time_boot_ms", 4_000_000_000),
    "SCALED_PRESSURE": (ClockKind.BOOT_MS, "time_boot_ms", 4_000_000_000),
    "GPS_RAW_INT": (ClockKind.USEC64, "time_usec", 1_700_000_000_000_000),
    "HIGHRES_IMU": (ClockKind.USEC64, "time_usec", 1_700_000_000_000_000),
    "WHEEL_DISTANCE": (ClockKind.USEC64, "time_usec", 1_700_000_000_000_000),
    "SERVO_OUTPUT_RAW": (ClockKind.USEC32, "time_usec", 4_000_000_000),
    "HEARTBEAT": (ClockKind.NONE, None, 0),
    "EXTENDED_SYS_STATE": (ClockKind.NONE, None, 0),
    "VFR_HUD": (ClockKind.NONE, None, 0),
    "WIND": (ClockKind.NONE, None, 0),
    "NAV_CONTROLLER_OUTPUT": (ClockKind.NONE, None, 0),
}


def frame(message, **fields):
    (made,) = Splitter().feed(encode(message, fields, sysid=1, compid=1, seq=0))
    return made


def sampled(decoder, message, **fields):
    """{channel: value} of one message; empty if it delivers nothing."""
    out = decoder.decode(frame(message, **fields))
    return {decoder.channels[place]: value for place, value in out.values} if out else {}


def arrayed(place, value):
    return value if place is None else (0,) * place + (value,)


def kind_of(message, field):
    made = by_name(message)
    return made.types[made.fields.index(field)]


def test_the_hand_written_table_and_the_codes_speak_of_the_same_channels():
    assert set(CHANNELS) == {*BY_HAND, "armed"}
    assert {row.message for row in TABLE} == set(CLOCKS)


@pytest.mark.parametrize("channel", BY_HAND)
def test_each_channel_comes_from_its_field_by_its_factor(channel):
    message, field, place, factor, unknown = BY_HAND[channel]
    decoder = Decoder(CHANNELS)
    kind = kind_of(message, field)
    wires = (1.5, -0.25, 3.0) if kind == "double" or kind == "float" else (1, 3, 100)
    if kind.startswith("int"):
        wires = (*wires, -1, -100)
    for wire in wires:
        found = sampled(decoder, message, **{field: arrayed(place, wire)})
        assert found[channel] == pytest.approx(wire * factor, rel=1e-15)
    if unknown is not None:
        assert channel not in sampled(decoder, message, **{field: arrayed(place, unknown)})
    assert decoder.counts == {}


@pytest.mark.parametrize("channel", BY_HAND)
def test_no_other_field_moves_a_channel(channel):
    message, field, place, _, _ = BY_HAND[channel]
    decoder = Decoder((channel,))
    made = by_name(message)
    base = {field: arrayed(place, 1)}
    still = sampled(decoder, message, **base)
    for name, kind, count in zip(made.fields, made.types, made.counts, strict=True):
        if name == field or name in ("port",) or kind == "char":
            continue
        assert sampled(decoder, message, **base, **{name: (7,) * count if count else 7}) == still


@pytest.mark.parametrize("message", CLOCKS)
def test_each_message_tells_its_own_time(message):
    kind, field, stamp = CLOCKS[message]
    out = Decoder(CHANNELS).decode(frame(message, **({field: stamp} if field else {})))
    assert (out.clock, out.stamp) == (kind, stamp)


def test_armed_is_one_bit_of_the_base_mode():
    decoder = Decoder(("armed",))
    for mode in range(256):
        assert sampled(decoder, "HEARTBEAT", base_mode=mode) == {"armed": 1.0 if mode >= 128 else 0.0}


def test_latitude_is_exact_to_the_last_bit_of_the_wire():
    found = sampled(Decoder(("latitude_rad", "longitude_rad")), "GLOBAL_POSITION_INT", lat=473_977_419, lon=-1_799_999_999)
    assert round(math.degrees(found["latitude_rad"]) * 1e7) == 473_977_419
    assert round(math.degrees(found["longitude_rad"]) * 1e7) == -1_799_999_999


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_none_is_counted_and_absent(value):
    decoder = Decoder(CHANNELS)
    found = sampled(decoder, "ATTITUDE", roll=value, pitch=0.25)
    assert "roll_rad" not in found
    assert found["pitch_rad"] == 0.25
    assert decoder.counts == {"not_finite": 1}


ABSURD = [
    ("ATTITUDE", "roll", 13.0, 12.5),
    ("ATTITUDE", "yawspeed", -101.0, -99.0),
    ("VFR_HUD", "airspeed", 1.1e4, 9.9e3),
    ("VFR_HUD", "alt", -1.1e6, -9.9e5),
    ("HIGHRES_IMU", "zacc", 1.1e4, 9.9e3),
    ("SCALED_PRESSURE", "press_abs", 2001.0, 1999.0),
    ("WHEEL_DISTANCE", "distance", (1.1e6,), (9.9e5,)),
]


@pytest.mark.parametrize(("message", "field", "absurd", "possible"), ABSURD)
def test_what_no_vehicle_can_measure_is_counted_and_absent(message, field, absurd, possible):
    decoder = Decoder(CHANNELS)
    whole = sampled(decoder, message, **{field: possible})
    assert decoder.counts == {}
    assert len(sampled(decoder, message, **{field: absurd})) == len(whole) - 1
    assert decoder.counts == {"absurd": 1}


def test_outputs_of_the_second_port_are_other_outputs():
    decoder = Decoder(("output_1_us", "output_2_us"))
    assert sampled(decoder, "SERVO_OUTPUT_RAW", servo1_raw=1500, servo2_raw=1600) == {
        "output_1_us": 1500.0,
        "output_2_us": 1600.0,
    }
    assert decoder.decode(frame("SERVO_OUTPUT_RAW", port=1, servo1_raw=1100)) is None


def test_an_output_that_is_not_used_is_unknown_and_its_neighbour_is_not():
    assert sampled(Decoder(CHANNELS), "SERVO_OUTPUT_RAW", servo3_raw=1500) == {"output_3_us": 1500.0}


def test_trailing_zeros_that_the_wire_left_out_are_zeros():
    made = frame("GLOBAL_POSITION_INT", time_boot_ms=5, lat=10)
    assert len(made.payload) < by_name("GLOBAL_POSITION_INT").layout.size
    found = sampled(Decoder(CHANNELS), "GLOBAL_POSITION_INT", time_boot_ms=5, lat=10)
    assert found["velocity_down_m_s"] == 0.0
    assert found["altitude_m"] == 0.0


def test_outputs_of_a_vehicle_that_speaks_mavlink_1_end_with_the_eighth():
    body = bytes((21, 0, 1, 1, 36)) + struct.pack("<I8HB", 1_000_000, *range(1001, 1009), 0)
    crc = mavlink.x25crc(body)
    crc.accumulate(bytes((by_name("SERVO_OUTPUT_RAW").crc_extra,)))
    (made,) = Splitter().feed(bytes((MAGIC_V1,)) + body + struct.pack("<H", crc.crc))
    decoder = Decoder(CHANNELS)
    out = {decoder.channels[place]: value for place, value in decoder.decode(made).values}
    assert out == {f"output_{k}_us": 1000.0 + k for k in range(1, 9)}


def test_fields_that_a_newer_definition_appends_are_passed_over():
    made = frame("VFR_HUD", airspeed=20.0, groundspeed=1.0, heading=3, throttle=4, alt=5.0, climb=6.0)
    body = bytes((len(made.payload) + 4, 0, 0, 0, 1, 1, 74, 0, 0)) + made.payload + b"\x01\x02\x03\x04"
    crc = mavlink.x25crc(body)
    crc.accumulate(bytes((by_name("VFR_HUD").crc_extra,)))
    (longer,) = Splitter().feed(b"\xfd" + body + struct.pack("<H", crc.crc))
    decoder = Decoder(CHANNELS)
    assert decoder.decode(longer) == decoder.decode(made)


def test_a_message_that_delivers_nothing_wanted_is_none():
    decoder = Decoder(("airspeed_m_s",))
    assert decoder.decode(frame("ATTITUDE", roll=0.5)) is None
    assert decoder.decode(frame("STATUSTEXT", text="hello")) is None
    assert decoder.messages == ("VFR_HUD",)


def test_channels_keep_the_order_they_were_asked_for():
    decoder = Decoder(("yaw_rad", "roll_rad"))
    out = decoder.decode(frame("ATTITUDE", roll=0.5, yaw=1.5))
    assert sorted(out.values) == [(0, 1.5), (1, 0.5)]


def test_an_unknown_message_delivers_nothing():
    raw = struct.pack("<BBBBBBBHB", 0xFD, 3, 0, 0, 0, 1, 1, 0xFFFE, 9) + b"abc\0\0"
    (unknown, _) = Splitter().feed(raw + encode("HEARTBEAT", {}, sysid=1, compid=1, seq=0))
    assert Decoder(CHANNELS).decode(unknown) is None


def test_a_channel_that_nothing_delivers_is_refused():
    with pytest.raises(ValueError, match="warp_factor"):
        Decoder(("roll_rad", "warp_factor"))


@pytest.mark.parametrize(
    ("row", "complaint"),
    [
        (Row("ATTITUDE", "roll", "roll_m"), "rad"),
        (Row("GLOBAL_POSITION_INT", "vx", "velocity_north_m"), "cm/s"),
        (Row("GLOBAL_POSITION_INT", "alt", "altitude_m_s"), "mm"),
        (Row("VFR_HUD", "throttle", "throttle_m"), "%"),
        (Row("GPS_RAW_INT", "vel", "speed"), "cm/s"),
    ],
)
def test_a_line_whose_two_units_contradict_each_other_is_refused(monkeypatch, row, complaint):
    monkeypatch.setattr(decode, "TABLE", (row,))
    with pytest.raises(ValueError, match=complaint):
        Decoder((row.channel,))


def test_a_suffix_says_the_dimension_and_the_longest_one_counts():
    names = ("velocity_north_m_s", "acceleration_z_m_s2", "height_m", "yaw_rate_rad_s", "roll_rad", "output_1_us", "armed")
    assert [dimension_of(name) for name in names] == ["m_s", "m_s2", "m", "rad_s", "rad", "us", "1"]
    assert dimension_of("alarm") == "1"


def test_random_messages_decode_to_what_pymavlink_and_the_hand_written_factors_say():
    rng = random.Random(3)
    decoder = Decoder(CHANNELS)
    by_field = {}
    for channel, (message, field, place, factor, unknown) in BY_HAND.items():
        by_field.setdefault(message, []).append((channel, field, place, factor, unknown))
    for _ in range(300):
        message = rng.choice(list(by_field))
        fields = {}
        for _, field, place, _, _ in by_field[message]:
            kind = kind_of(message, field)
            value = rng.uniform(-6.0, 6.0) if kind in ("float", "double") else rng.randrange(0, 120)
            fields[field] = (*fields.get(field, ()), value) if place is not None else value
        parsed = mavlink.MAVLink(None).parse_char(encode(message, fields, sysid=1, compid=1, seq=0))
        expected = {}
        for channel, field, place, factor, unknown in by_field[message]:
            wire = getattr(parsed, field) if place is None else getattr(parsed, field)[place]
            if wire != unknown:
                expected[channel] = wire * factor
        assert sampled(decoder, message, **fields) == pytest.approx(expected, rel=1e-14)
