"""Which frames go to whom, in which version of MAVLink, with which numbers."""

from itertools import pairwise

import pytest

from sitl.autopilot.routing import MOST_CLIENTS
from tests.sitl.network import Network


def passed_on(peer, raw):
    return peer.raw().count(raw)


def test_a_broadcast_reaches_every_other_client_unchanged_and_never_its_sender():
    network = Network()
    companion, gcs, other = network.peer("companion", 1, 191), network.peer("gcs"), network.peer("other", 42)
    raw = companion.say("STATUSTEXT", severity=2, text="control lines crossed")
    assert [passed_on(peer, raw) for peer in (companion, gcs, other)] == [0, 1, 1]


def test_a_broadcast_also_reaches_who_only_listens():
    network = Network()
    companion = network.peer("companion", 1, 191)
    raw = companion.say("STATUSTEXT", severity=2, text="control lines crossed")
    assert passed_on(network.everybody, raw) == 1


def test_an_addressed_frame_goes_only_where_the_component_was_heard():
    network = Network()
    gcs, companion, camera = network.peer("gcs"), network.peer("companion", 1, 191), network.peer("camera", 1, 100)
    raw = gcs.say("COMMAND_LONG", target_system=1, target_component=191, command=31010)
    assert [passed_on(peer, raw) for peer in (gcs, companion, camera, network.everybody)] == [0, 1, 0, 0]
    assert gcs.heard("COMMAND_ACK") == []


def test_a_frame_for_all_components_of_a_system_goes_to_each_of_its_clients():
    network = Network()
    gcs = network.peer("gcs")
    one, two, other = network.peer("one", 42, 191), network.peer("two", 42, 100), network.peer("other", 43, 1)
    raw = gcs.say("COMMAND_LONG", target_system=42, target_component=0, command=31010)
    assert [passed_on(peer, raw) for peer in (one, two, other)] == [1, 1, 0]


def test_a_frame_for_the_autopilot_is_not_passed_on():
    network = Network()
    gcs, companion = network.peer("gcs"), network.peer("companion", 1, 191)
    raw = gcs.say("COMMAND_LONG", target_system=1, target_component=1, command=31010)
    assert passed_on(companion, raw) == 0


def test_a_frame_for_all_components_of_our_system_is_both_obeyed_and_passed_on():
    network = Network()
    gcs, companion = network.peer("gcs"), network.peer("companion", 1, 191)
    raw = gcs.say("COMMAND_LONG", target_system=1, target_component=0, command=176, param1=1.0, param2=4.0)
    assert passed_on(companion, raw) == 1
    assert [m.result for m in gcs.heard("COMMAND_ACK")] == [0]


def test_what_is_meant_for_a_component_of_ours_that_nobody_has_heard_is_handled_by_the_autopilot():
    network = Network()
    gcs = network.peer("gcs")
    gcs.say("COMMAND_LONG", target_system=1, target_component=191, command=176, param1=1.0, param2=4.0)
    assert [m.result for m in gcs.heard("COMMAND_ACK")] == [0]


def test_what_is_meant_for_another_system_is_neither_handled_nor_passed_on_before_it_is_heard():
    network = Network()
    gcs, other = network.peer("gcs"), network.peer("other", 42)
    raw = gcs.say("COMMAND_LONG", target_system=9, target_component=1, command=176, param1=1.0, param2=4.0)
    assert passed_on(other, raw) == 0
    assert gcs.heard("COMMAND_ACK") == []


def test_a_component_heard_on_two_links_gets_its_frames_on_both():
    network = Network()
    gcs, wire, radio = network.peer("gcs"), network.peer("wire", 1, 191), network.peer("radio", 1, 191)
    raw = gcs.say("COMMAND_LONG", target_system=1, target_component=191, command=31010)
    assert [passed_on(peer, raw) for peer in (wire, radio)] == [1, 1]


def test_our_own_frames_coming_back_are_neither_believed_nor_passed_on():
    network = Network()
    mirror, gcs = network.peer("mirror", 1, 1, quiet=True), network.peer("gcs")
    raw = mirror.say("STATUSTEXT", severity=2, text="echo")
    mirror.say("COMMAND_LONG", command=176, param1=1.0, param2=4.0)
    assert passed_on(gcs, raw) == 0
    assert network.autopilot.custom_mode == 10


def test_time_exchanges_and_radio_reports_stay_on_their_link():
    network = Network()
    companion, gcs = network.peer("companion", 1, 191), network.peer("gcs")
    kept = [companion.say("TIMESYNC", tc1=5, ts1=6), companion.say("RADIO_STATUS", rssi=100)]
    arrived = gcs.raw()
    assert not any(raw in arrived for raw in kept)


def test_a_signed_frame_is_passed_on_with_its_signature():
    network = Network()
    companion, gcs = network.peer("companion", 1, 191), network.peer("gcs")
    companion.mav.signing.secret_key = bytes(32)
    companion.mav.signing.sign_outgoing = True
    raw = companion.say("STATUSTEXT", severity=2, text="signed")
    assert len(raw) == 12 + 13 + len(b"\x02signed")
    assert passed_on(gcs, raw) == 1


def test_a_message_that_nobody_here_knows_is_passed_on_once_its_sender_is_known():
    network = Network()
    gcs = network.peer("gcs")
    stranger = network.peer("stranger", 42, 1, quiet=True)
    unknown = b"\xfd\x01\x00\x00\x07\x2a\x01\xf0\xff\x7f\x55\x12\x34"
    network.autopilot.receive("stranger", unknown)
    assert passed_on(gcs, unknown) == 0
    stranger.beat()
    network.autopilot.receive("stranger", unknown)
    assert passed_on(gcs, unknown) == 1


# Versions and sequence numbers


def test_a_client_is_spoken_to_in_mavlink_2_unless_it_speaks_1():
    network = Network()
    old, new = network.peer("old", 255, version=1), network.peer("new", 254)
    network.run(2)
    markers = [{raw[0] for raw in peer.raw()} for peer in (old, new, network.everybody)]
    assert markers == [{0xFE}, {0xFD}, {0xFD}]


def test_a_client_that_speaks_both_is_spoken_to_in_mavlink_2():
    network = Network()
    peer = network.peer("peer", 255, version=1)
    peer.version = 2
    peer.beat()
    network.forget()
    network.run(1)
    assert {raw[0] for raw in peer.raw()} == {0xFD}


def test_a_mavlink_1_client_gets_all_that_mavlink_1_can_carry():
    network = Network()
    old = network.peer("old", 255, version=1)
    network.run(2)
    kinds = {m.get_type() for m in old.heard()}
    assert {"HEARTBEAT", "SYS_STATUS", "GPS_RAW_INT", "SERVO_OUTPUT_RAW"} <= kinds
    assert "WHEEL_DISTANCE" not in kinds
    (ack,) = old.command(176, 1, 4)
    assert ack.result == 0


def sequences(frames):
    return [raw[4] if raw[0] == 0xFD else raw[2] for raw in frames]


@pytest.mark.parametrize("version", [1, 2])
def test_each_client_has_its_own_sequence_without_gaps(version):
    network = Network()
    one, other = network.peer("one", 255, version=version), network.peer("other", 254)
    other.command(511, 33, -1)
    network.forget()
    network.run(20)
    for peer in (one, other):
        numbers = sequences(peer.raw())
        assert len(numbers) > 256
        assert all((b - a) % 256 == 1 for a, b in pairwise(numbers))


def test_a_listener_that_begins_to_speak_sees_no_gap():
    network = Network()
    network.run(3)
    before = sequences(network.everybody.raw())[-1]
    peer = network.peer("late", 255, quiet=True)
    peer.beat()
    network.run(1)
    assert sequences(peer.raw())[0] == (before + 1) % 256


def test_nobody_is_served_as_everybody_when_all_links_have_been_heard_from():
    network = Network()
    network.peer()
    network.autopilot.everybody = False
    network.run(2)
    assert network.everybody.raw() == []


def test_garbage_does_not_make_a_client():
    network = Network()
    network.autopilot.receive("noise", bytes(range(256)))
    assert network.autopilot.clients == ()
    network.run(1)
    assert "noise" not in {key for key, _ in network.autopilot.outgoing()}


def test_clients_do_not_grow_without_bound_and_the_one_silent_longest_makes_room():
    network = Network()
    gcs = network.peer("gcs")
    for number in range(3 * MOST_CLIENTS):
        network.peer(number, 10 + number)
        gcs.beat()
    clients = network.autopilot.clients
    assert len(clients) == MOST_CLIENTS
    assert "gcs" in clients
    assert 0 not in clients
    assert network.autopilot.counters.clients_evicted == 3 * MOST_CLIENTS + 1 - MOST_CLIENTS


def test_a_frame_in_slices_is_one_frame():
    network = Network()
    gcs = network.peer()
    raw = gcs.frame("COMMAND_LONG", command=176, param1=1.0, param2=4.0, target_system=1, target_component=1)
    for byte in raw:
        network.autopilot.receive("gcs", bytes([byte]))
    assert network.autopilot.custom_mode == 4


def test_many_frames_in_one_datagram_are_all_taken():
    network = Network()
    gcs = network.peer()
    raw = b"".join(gcs.frame("PING", seq=number) for number in range(20))
    network.autopilot.receive("gcs", raw)
    assert [m.seq for m in gcs.heard("PING")] == list(range(20))


def test_the_parser_keeps_nothing_of_a_stream_that_never_ends_on_a_frame():
    network = Network()
    gcs = network.peer()
    beats = b"".join(gcs.frame("HEARTBEAT") for _ in range(10_000))
    network.autopilot.receive("gcs", beats[:5])
    for start in range(5, len(beats), 1000):
        network.autopilot.receive("gcs", beats[start : start + 1000])
    client = network.autopilot._clients["gcs"]
    assert len(client.parser.buf) < 100_000
    assert network.autopilot.counters.frames_in == 10_001  # the first made the peer known
