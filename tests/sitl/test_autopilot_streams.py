"""What the autopilot sends regularly: packing, rates, time stamps, and what it says of the unknown."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from sitl.autopilot.frames import frame_v2
from sitl.autopilot.streams import UNKNOWN, StreamTable
from sitl.vehicle import Field, Stream
from tests.sitl.network import Network, message, parafoil_autopilot, sled_autopilot

HEARTBEAT, ATTITUDE, GPS_RAW_INT = 0, 30, 24
SET_MESSAGE_INTERVAL, GET_MESSAGE_INTERVAL, REQUEST_MESSAGE = 511, 510, 512


def table(*streams, channels=("a_m", "b_m")):
    return StreamTable(streams, channels)


def row(*values):
    return np.array(values, dtype=float)


def wired(stream, values, channels, now_us):
    """pymavlink's message, the airframe's table read literally."""
    fields = {name: value for (message_name, name), value in UNKNOWN.items() if message_name == stream.message}
    fields |= stream.constants
    for field in stream.fields:
        fields[field.name] = values[channels.index(field.channel)] * field.scale + field.offset
    sample = message(stream.message)
    for name, value in fields.items():
        base, bracket, index = name.partition("[")
        kind = sample.fieldtypes[sample.fieldnames.index(base)]
        value = value if kind in ("float", "double") else round(value)
        if bracket:
            getattr(sample, base)[int(index.rstrip("]"))] = value
        else:
            setattr(sample, base, value)
    if "time_boot_ms" in sample.fieldnames:
        sample.time_boot_ms = now_us // 1000
    if "time_usec" in sample.fieldnames:
        sample.time_usec = now_us
    return sample


@pytest.mark.parametrize("build", [sled_autopilot, parafoil_autopilot], ids=["sled", "parafoil"])
def test_each_stream_is_the_frame_that_pymavlink_packs_from_the_airframes_table(build):
    autopilot = build()
    streams, channels = autopilot.vehicle.streams, autopilot.fleet.channels
    values = np.random.default_rng(1).uniform(0.0, 1.0, len(channels))
    packer = StreamTable(streams, channels)
    packer.take(values, np.zeros_like(values), 123_456_000)
    mav = dialect.MAVLink(None, 1, 1)
    for number, stream in enumerate(streams):
        packed = packer.pack(number)
        expected = wired(stream, values, channels, 123_456_000)
        assert frame_v2(packed, 0, 1, 1) == expected.pack(mav), stream.message


def _nested(packed):
    flat = packed.layout.format.unpack(packed.payload)
    for field, first in packed.layout.first_slot.items():
        count = packed.layout.slot_count[field]
        yield list(flat[first : first + count]) if count > 1 else flat[first]


def unpacked(packed):
    return dict(zip(packed.layout.first_slot, _nested(packed), strict=True))


def test_an_unknown_float_travels_as_nan():
    packer = table(Stream("ATTITUDE", 1.0, 1.0, (Field("roll", "a_m"), Field("pitch", "b_m"))))
    packer.take(row(math.nan, 0.5), row(0, 0), 0)
    heard = unpacked(packer.pack(0))
    assert math.isnan(heard["roll"])
    assert heard["pitch"] == 0.5


def test_an_unknown_integer_travels_as_the_definitions_unknown():
    packer = table(Stream("GLOBAL_POSITION_INT", 1.0, 1.0, (Field("lat", "a_m"), Field("hdg", "b_m"))))
    packer.take(row(7.0, math.nan), row(0, 0), 0)
    assert unpacked(packer.pack(0))["hdg"] == 65535


def test_a_message_whose_integer_has_no_unknown_stays_away():
    packer = table(Stream("GLOBAL_POSITION_INT", 1.0, 1.0, (Field("lat", "a_m"), Field("hdg", "b_m"))))
    packer.take(row(math.nan, 1.0), row(0, 0), 0)
    assert packer.pack(0) is None


def test_gps_raw_int_says_that_there_is_no_fix():
    packer = table(Stream("GPS_RAW_INT", 1.0, 1.0, (Field("lat", "a_m"), Field("vel", "b_m")), {"fix_type": 3, "eph": 80}))
    packer.take(row(math.nan, math.nan), row(0, 0), 5_000_000)
    heard = unpacked(packer.pack(0))
    assert (heard["fix_type"], heard["lat"], heard["vel"], heard["eph"]) == (1, 0, 65535, 65535)
    assert heard["satellites_visible"] == 255
    assert heard["time_usec"] == 5_000_000
    assert not packer.has_fix()
    packer.take(row(1.0, 2.0), row(0, 0), 5_100_000)
    assert unpacked(packer.pack(0))["fix_type"] == 3
    assert packer.has_fix()


def test_a_field_that_the_airframe_does_not_mention_is_unknown_rather_than_zero():
    packer = table(Stream("GLOBAL_POSITION_INT", 1.0, 1.0, (Field("lat", "a_m"),)))
    packer.take(row(1.0, 0.0), row(0, 0), 0)
    assert unpacked(packer.pack(0))["hdg"] == 65535


@pytest.mark.parametrize(
    ("value", "wanted"), [(1e9, 32767), (-1e9, -32768), (0.5, 0), (1.5, 2), (-3.2, -3), (math.inf, 32767)]
)
def test_integers_are_rounded_to_even_and_stop_at_the_ends_of_their_type(value, wanted):
    packer = table(Stream("GLOBAL_POSITION_INT", 1.0, 1.0, (Field("vx", "a_m"),)))
    packer.take(row(value, 0.0), row(0, 0), 0)
    assert unpacked(packer.pack(0))["vx"] == wanted


def test_a_known_value_at_the_end_of_its_type_does_not_turn_into_unknown():
    packer = table(Stream("GLOBAL_POSITION_INT", 1.0, 1.0, (Field("hdg", "a_m"),)))
    packer.take(row(1e6, 0.0), row(0, 0), 0)
    assert unpacked(packer.pack(0))["hdg"] == 65534


def test_a_number_too_large_for_float32_becomes_infinite_and_nothing_breaks():
    packer = table(Stream("ATTITUDE", 1.0, 1.0, (Field("roll", "a_m"), Field("pitch", "b_m"))))
    packer.take(row(1e300, -1e300), row(0, 0), 0)
    heard = unpacked(packer.pack(0))
    assert (heard["roll"], heard["pitch"]) == (math.inf, -math.inf)


def test_a_double_keeps_all_its_bits():
    packer = table(Stream("WHEEL_DISTANCE", 1.0, 1.0, (Field("distance[1]", "a_m"),), {"count": 2}))
    packer.take(row(math.pi, 0.0), row(0, 0), 0)
    assert unpacked(packer.pack(0))["distance"][1] == math.pi


def test_the_stamp_is_that_of_the_sample_and_not_of_the_sending():
    packer = table(Stream("ATTITUDE", 1.0, 1.0, (Field("roll", "a_m"), Field("pitch", "b_m"))))
    packer.take(row(1.0, 1.0), row(0.1, 0.0), 2_000_000)
    assert unpacked(packer.pack(0))["time_boot_ms"] == 1900


def test_a_slow_sensor_that_rides_along_does_not_hold_the_stamp_back():
    packer = table(Stream("ATTITUDE", 1.0, 1.0, (Field("roll", "a_m"), Field("pitch", "b_m"))))
    packer.take(row(1.0, 1.0), row(0.0, 0.5), 2_000_000)
    assert unpacked(packer.pack(0))["time_boot_ms"] == 2000


@pytest.mark.parametrize("age_s", [math.inf, 1e9, math.nan])
def test_an_endless_age_does_not_stop_the_clock(age_s):
    packer = table(Stream("ATTITUDE", 1.0, 1.0, (Field("roll", "a_m"),)))
    packer.take(row(1.0, 1.0), row(age_s, 0.0), 9_000_000)
    assert unpacked(packer.pack(0))["time_boot_ms"] >= 8000


def test_a_microsecond_clock_of_32_bits_wraps():
    packer = table(Stream("SERVO_OUTPUT_RAW", 1.0, 1.0, (Field("servo1_raw", "a_m"),)))
    packer.take(row(1500.0, 0.0), row(0, 0), 2**32 + 5)
    assert unpacked(packer.pack(0))["time_usec"] == 5


@pytest.mark.parametrize(
    "stream",
    [
        Stream("NO_SUCH_MESSAGE", 1.0, 1.0, ()),
        Stream("ATTITUDE", 1.0, 1.0, (Field("yawl", "a_m"),)),
        Stream("ATTITUDE", 1.0, 1.0, (Field("yaw", "c_m"),)),
    ],
)
def test_a_table_with_names_that_do_not_exist_is_refused(stream):
    with pytest.raises(KeyError):
        table(stream)


# Rates, per client


def rates(peer, network, seconds=10):
    network.run(0.1)
    network.forget()
    network.run(seconds)
    heard = [m.get_type() for m in peer.heard()]
    return {kind: heard.count(kind) / seconds for kind in set(heard)}


def test_stock_rates_are_those_of_the_table_and_housekeeping_comes_once_a_second():
    network = Network()
    gcs = network.peer()
    assert rates(gcs, network) == {
        "HEARTBEAT": pytest.approx(1.0, abs=0.2), "SYS_STATUS": 1.0, "EXTENDED_SYS_STATE": 1.0, "SYSTEM_TIME": 1.0,
        "GLOBAL_POSITION_INT": 5.0, "GPS_RAW_INT": 5.0, "SERVO_OUTPUT_RAW": 10.0, "WHEEL_DISTANCE": 10.0,
        "VFR_HUD": 5.0, "POSITION_TARGET_LOCAL_NED": 2.0, "STATUSTEXT": pytest.approx(0.1),
    }  # fmt: skip


def test_fast_rates_need_the_shorter_step():
    network = Network(rates="fast")
    gcs = network.peer()
    assert network.autopilot.dt_s == 0.02
    heard = rates(gcs, network)
    assert heard["SERVO_OUTPUT_RAW"] == 50.0
    assert heard["GLOBAL_POSITION_INT"] == 10.0


def test_an_interval_that_is_set_holds_for_the_client_that_set_it_alone():
    network = Network()
    one, other = network.peer("one", 255), network.peer("other", 254)
    (ack,) = one.command(SET_MESSAGE_INTERVAL, 33, 1_000_000)
    assert (ack.result, ack.target_system, ack.target_component) == (0, 255, 190)
    network.run(0.1)
    network.forget()
    network.run(10)
    assert len([m for m in one.heard() if m.get_type() == "GLOBAL_POSITION_INT"]) == 10
    assert len([m for m in other.heard() if m.get_type() == "GLOBAL_POSITION_INT"]) == 50


def test_an_interval_can_be_switched_off_and_put_back():
    network = Network()
    gcs = network.peer()
    gcs.command(SET_MESSAGE_INTERVAL, 33, -1)
    assert "GLOBAL_POSITION_INT" not in rates(gcs, network)
    gcs.command(SET_MESSAGE_INTERVAL, 33, 0)
    assert rates(gcs, network)["GLOBAL_POSITION_INT"] == 5.0


def test_the_interval_in_force_is_told_and_never_shorter_than_a_step():
    network = Network()
    gcs = network.peer()

    def told(message_id):
        network.forget()
        gcs.say("COMMAND_LONG", command=GET_MESSAGE_INTERVAL, param1=message_id, target_system=1, target_component=1)
        return [(m.message_id, m.interval_us) for m in gcs.heard("MESSAGE_INTERVAL")]

    assert told(33) == [(33, 200_000)]
    gcs.command(SET_MESSAGE_INTERVAL, 33, 10_000)
    assert told(33) == [(33, 100_000)]
    gcs.command(SET_MESSAGE_INTERVAL, 33, -1)
    assert told(33) == [(33, -1)]
    assert told(ATTITUDE) == [(ATTITUDE, 0)]


@pytest.mark.parametrize("params", [(ATTITUDE, 1e5), (33, -2), (33, math.nan), (HEARTBEAT, -1), (33.5, 1e5), (-1, 1e5)])
def test_an_interval_that_cannot_be_is_denied(params):
    network = Network()
    (ack,) = network.peer().command(SET_MESSAGE_INTERVAL, *params)
    assert ack.result == 2


def test_data_stream_groups_change_what_belongs_to_them():
    network = Network()
    gcs = network.peer()
    gcs.say("REQUEST_DATA_STREAM", target_system=1, target_component=1, req_stream_id=6, req_message_rate=2, start_stop=1)
    heard = rates(gcs, network)
    assert heard["GLOBAL_POSITION_INT"] == 2.0
    assert heard["GPS_RAW_INT"] == 5.0
    gcs.say("REQUEST_DATA_STREAM", target_system=1, target_component=1, req_stream_id=0, req_message_rate=4, start_stop=1)
    heard = rates(gcs, network)
    assert {heard["GLOBAL_POSITION_INT"], heard["GPS_RAW_INT"], heard["WHEEL_DISTANCE"], heard["SYS_STATUS"]} == {4.0}
    assert heard["HEARTBEAT"] == 1.0
    gcs.say("REQUEST_DATA_STREAM", target_system=1, target_component=1, req_stream_id=0, req_message_rate=4, start_stop=0)
    assert set(rates(gcs, network)) == {"HEARTBEAT"}


def test_a_message_is_sent_once_on_request_with_what_is_known_now():
    network = Network()
    gcs = network.peer()
    network.run(1)
    network.forget()
    gcs.say("COMMAND_LONG", command=REQUEST_MESSAGE, param1=33, target_system=1, target_component=1)
    kinds = [m.get_type() for m in gcs.heard()]
    assert kinds == ["GLOBAL_POSITION_INT", "COMMAND_ACK"]


@pytest.mark.parametrize(
    ("message_id", "result"), [(ATTITUDE, 3), (395, 3), (397, 3), (300, 3), (-5, 3), (148, 0), (242, 0)]
)
def test_a_message_that_cannot_be_sent_is_refused_and_not_ignored(message_id, result):
    network = Network()
    (ack,) = network.peer().command(REQUEST_MESSAGE, message_id)
    assert (ack.command, ack.result) == (REQUEST_MESSAGE, result)


def test_all_times_are_of_the_boot_clock_in_whole_milliseconds():
    network = Network()
    gcs = network.peer()
    network.run(2)
    stamped = [m for m in gcs.heard() if hasattr(m, "time_boot_ms")]
    assert {m.get_type() for m in stamped} >= {"GLOBAL_POSITION_INT", "SYSTEM_TIME"}
    assert all(m.time_boot_ms % 100 == 0 and m.time_boot_ms <= 2000 for m in stamped)


def test_a_position_that_is_lost_ends_global_position_and_lowers_health():
    network = Network()
    gcs = network.peer()
    gcs.set("SIM_GPS_DISABLE", 1)
    network.run(0.1)
    network.forget()
    network.run(2)
    heard = gcs.heard()
    kinds = {m.get_type() for m in heard}
    assert "GLOBAL_POSITION_INT" not in kinds
    assert [m.fix_type for m in heard if m.get_type() == "GPS_RAW_INT"] == [1] * 10
    health = [m.onboard_control_sensors_health for m in heard if m.get_type() == "SYS_STATUS"]
    assert all(not h & 0x20 and not h & 0x10000000 and h & 0x07 == 0x07 for h in health)
    gcs.set("SIM_GPS_DISABLE", 0)
    network.run(1)
    assert "GLOBAL_POSITION_INT" in {m.get_type() for m in gcs.heard()}


def test_home_is_below_the_first_position_and_at_its_ground():
    network = Network()
    gcs = network.peer()
    gcs.say("COMMAND_LONG", command=410, target_system=1, target_component=1)
    (home,) = gcs.heard("HOME_POSITION")
    assert (home.latitude, home.longitude, home.altitude) == (473977000, 85456000, 400_000)


def test_the_time_of_day_goes_on_over_a_reboot():
    network = Network(unix_us=1_700_000_000_000_000)
    gcs = network.peer()
    network.run(3)
    before = gcs.heard("SYSTEM_TIME")[-1]
    network.autopilot.reboot()
    network.run(3)
    after = gcs.heard("SYSTEM_TIME")[-1]
    assert after.time_unix_usec - before.time_unix_usec == 3_000_000
    assert after.time_boot_ms == before.time_boot_ms
