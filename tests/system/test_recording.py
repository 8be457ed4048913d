"""What `mavfdi run` and `mavfdi sitl` record over real links, and what of it others can read."""

import errno
from itertools import pairwise

import pytest
from pymavlink import mavutil

from companion.analysis import analyze
from companion.cli.sitl import PEERS, RecordedLink, TrafficLog
from companion.dialect import encode
from companion.recorder import RecordFile
from companion.tlog import OWN_LINK, Reader
from tests.sitl.test_server import free_port
from tests.system import flights
from tests.system.flights import CROSSED, command, names, parafoil, watching
from tests.system.test_command_line import one_line, signals_as_before

__all__ = ["signals_as_before"]

START_US = 1_700_000_000_000_000


def by_pymavlink(path):
    """(type, system, component) of all messages that pymavlink's own reader finds."""
    connection = mavutil.mavlink_connection(str(path), dialect="all")
    try:
        messages = iter(connection.recv_match, None)
        return [(one.get_type(), one.get_srcSystem(), one.get_srcComponent()) for one in messages]
    finally:
        connection.close()


def by_us(path):
    return [(one.frame.name, one.frame.sysid, one.frame.compid) for one in Reader(path)]


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """A crossed flight recorded on both sides: folder of the run, its logs 0.1 MB each; log of the simulator."""
    folder, port = tmp_path_factory.mktemp("flown"), free_port()
    words = ("--seed", 3, "--fault", CROSSED, "--speedup", "lockstep", "--duration", 60, "--tlog", folder / "vehicle.tlog")
    with (
        watching(folder / "run", f"udpin:127.0.0.1:{port}", policy="advise", more=("--log-size", 0.1, "--free", 0)) as run,
        command("sitl", "parafoil", "--connect", f"udpout:127.0.0.1:{port}", *words) as simulator,
    ):
        assert simulator.ended() == 0, simulator.text
        assert run.stop() == 0, run.text
    return folder / "run", folder / "vehicle.tlog"


def test_a_run_splits_its_log_by_size_tells_so_and_everything_is_read_by_pymavlink_too(flown):
    out, _ = flown
    logs = [line for line in flights.events(out / "events.jsonl") if line["kind"] == "log"]
    files = [logs[0]["file"], *(line["next"] for line in logs[1:])]
    assert files[:3] == ["flight.tlog", "flight-2.tlog", "flight-3.tlog"]
    assert [(line["name"], line["file"]) for line in logs[1:]] == [("rotated", name) for name in files[:-1]]
    assert sorted(path.name for path in out.iterdir()) == sorted([*files, "events.jsonl", "summary.json"])
    for line in logs[1:]:
        assert line["bytes"] == (out / line["file"]).stat().st_size <= 100_000
    stamps = []
    for name in files:
        assert by_pymavlink(out / name) == by_us(out / name)
        stamps += [one.stamp_us & ~3 for one in Reader(out / name)]
    assert all(before <= after for before, after in pairwise(stamps))


def test_the_simulator_records_both_directions_readable_by_pymavlink_and_by_ourselves(flown):
    out, path = flown
    reader = Reader(path)
    records = list(reader)
    assert by_pymavlink(path) == by_us(path)
    assert (reader.report.resyncs, reader.report.crc_failures, reader.report.tail_bytes) == (0, 0, 0)
    stamps = [one.stamp_us & ~3 for one in records]
    assert all(before <= after for before, after in pairwise(stamps))
    assert {(one.link, one.frame.compid) for one in records} == {(OWN_LINK, 1), (0, 191)}
    assert all(source.seq_lost == 0 for source in reader.report.sources.values())
    assert reader.report.last_us - reader.report.first_us == pytest.approx(60_000_000, abs=100_000)
    # What the one sent is what the other got.
    heard = {one.frame.raw for log in out.glob("*.tlog") for one in Reader(log) if one.link != OWN_LINK}
    said = {one.frame.raw for one in records if one.link == OWN_LINK}
    assert heard <= said
    assert len(said - heard) < 20  # sent before anybody listened


def test_the_simulators_log_is_judged_as_the_run_judged(flown):
    out, path = flown
    told = flights.events(out / "events.jsonl")
    found = analyze(path, lambda _: parafoil()).content
    assert [fault["id"] for fault in found["faults"]] == ["crossed_lines"]
    isolated = [line["t"] for line in told if line["name"] == "isolated"]
    assert found["faults"][0]["isolated_t"] == pytest.approx(isolated[0], abs=0.2)
    assert names(told, "fault")[:2] == names(found["events"], "fault")[:2]


class Wire:
    """A link that keeps what is sent on it and gives out what it is told."""

    name = "wire"

    def __init__(self):
        self.counts, self.coming, self.sent, self.calls = {}, [], [], []

    def filenos(self):
        return [7]

    def receive(self):
        return [self.coming.pop(0)] if self.coming else []

    def send(self, data, peer=None):
        self.sent.append((data, peer))

    def maintain(self, now_us):
        self.calls.append(now_us)

    def close(self):
        self.calls.append("close")


class Recorded:
    """One recorded link; time stands still until it is told."""

    def __init__(self, folder):
        self.path = folder / "vehicle.tlog"
        self.file = RecordFile(self.path)
        self.now_us = START_US + 3  # no multiple of 4: the link's number must not touch it
        self.log = TrafficLog(self.file, lambda: self.now_us)
        self.wire = Wire()
        self.link = RecordedLink(self.wire, 1, self.log)

    @property
    def kept(self):
        return [(one.stamp_us, one.frame.raw) for one in Reader(self.path)]


@pytest.fixture
def recorded(tmp_path):
    made = Recorded(tmp_path)
    yield made
    made.log.close()


def attitude(seq, roll=0.1):
    return encode("ATTITUDE", {"roll": roll}, sysid=1, compid=1, seq=seq)


def test_a_recorded_link_carries_what_the_link_carries(recorded):
    recorded.wire.coming = [("peer", b"abc")]
    assert recorded.link.receive() == [("peer", b"abc")]
    recorded.link.send(b"def", "peer")
    assert recorded.wire.sent == [(b"def", "peer")]
    recorded.link.maintain(5)
    recorded.link.close()
    assert recorded.wire.calls == [5, "close"]
    assert (recorded.link.name, recorded.link.filenos(), recorded.link.counts) == ("wire", [7], recorded.wire.counts)


def test_a_frame_that_arrives_in_pieces_is_one_record_of_its_own_peers(recorded):
    first, second = attitude(0), attitude(1, 0.2)
    recorded.wire.coming = [("a", first[:9]), ("b", second[:15]), ("a", first[9:]), ("b", second[15:])]
    for _ in range(4):
        recorded.link.receive()
    assert recorded.kept == [(START_US | 1, first), (START_US | 1, second)]


def test_what_goes_to_several_clients_at_once_is_recorded_once_and_what_is_said_twice_twice(recorded):
    recorded.link.send(attitude(0) + attitude(1, 0.2), "a")
    recorded.link.send(attitude(40) + attitude(41, 0.2) + attitude(42, 0.3), "b")  # its own sequence
    recorded.link.send(attitude(2), "a")
    recorded.now_us += 1000
    recorded.link.send(attitude(43), "b")
    own = START_US | OWN_LINK
    assert recorded.kept == [
        (own, attitude(0)), (own, attitude(1, 0.2)), (own, attitude(42, 0.3)), (own, attitude(2)),
        (START_US + 1000 | OWN_LINK, attitude(43)),
    ]  # fmt: skip


def test_the_streams_kept_apart_are_bounded(recorded):
    for peer in range(2 * PEERS):
        recorded.link.send(attitude(peer % 256, roll=0.1 + peer), peer)
    assert len(recorded.log._splitters) == PEERS
    assert len(recorded.kept) == 2 * PEERS


def test_a_full_disk_ends_the_simulators_log_with_one_line_and_the_flight_goes_on(recorded, capsys, monkeypatch):
    recorded.link.send(attitude(0), "a")

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(recorded.file, "write", full)
    for number in range(1, 10):
        recorded.link.send(attitude(number), "a")
    assert capsys.readouterr().err == f"mavfdi sitl: {recorded.path} ends here: No space left on device\n"
    assert len(recorded.wire.sent) == 10
    assert [raw for _, raw in recorded.kept] == [attitude(0)]


def test_a_log_that_is_there_already_is_not_overwritten(capsys, tmp_path):
    path = tmp_path / "vehicle.tlog"
    path.write_bytes(b"of an earlier flight")
    link = f"udpin:127.0.0.1:{free_port()}"
    for _ in range(2):  # the link is free again
        one_line(capsys, ["sitl", "parafoil", "--connect", link, "--tlog", path], "is there already; give another name")
    assert path.read_bytes() == b"of an earlier flight"
    one_line(capsys, ["sitl", "parafoil", "--connect", link, "--tlog", tmp_path / "no" / "folder"], "No such file")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--log-size", "0"), "--log-size 0 is no size of a log; give 0.1 MB or more"),
        (("--log-size", "nan"), "--log-size nan is no size"),
        (("--free", "-1"), "--free -1 is no room on a disk"),
        (("--free", "nan"), "--free nan is no room"),
    ],
)
def test_sizes_that_are_none_are_one_line_before_anything_is_begun(words, text, capsys, tmp_path):
    one_line(capsys, ["run", "parafoil", "--out", tmp_path / "out", *words], text)
    assert list(tmp_path.iterdir()) == []
