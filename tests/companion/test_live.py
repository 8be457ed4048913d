"""The live loop between scripted links, a clock of its own and a real recorder: what it says, keeps and survives."""

import errno
import json
import socket
from collections import Counter
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import all as mavlink

from companion.analysis import analyze
from companion.clock import VehicleClock
from companion.core import Core
from companion.decision import Policy
from companion.dialect import encode
from companion.events import Severity
from companion.frames import Splitter
from companion.journal import Journal
from companion.live import PEERS, RETELL_TRIES, Live
from companion.recorder import MEGABYTE, RECORD_NAME, News, Recorder, Rules, When
from companion.recovery import Stage
from companion.rehearsal import Rehearsal
from companion.tlog import OWN_LINK, Reader
from sitl.autopilot import Autopilot, Misbehaviour
from tests.sitl.network import message
from tests.system.flights import CROSSED, ORIGINAL, OUTPUTS, SWAPPED, Flight, autopilot, events, names, parafoil

KEY = "companion"
OURS = (1, 191)


class Ready:
    """Something that select always finds readable."""

    def __init__(self):
        self._pair = socket.socketpair()
        self._pair[1].send(b"x")
        self.counts = Counter()
        self.sent = []

    def filenos(self):
        return [self._pair[0].fileno()]

    def maintain(self, now_us):
        pass

    def close(self):
        for end in self._pair:
            end.close()


class VehicleLink(Ready):
    """A simulated vehicle, a step each time that the loop reads; it ends the run when it has flown its time."""

    name = "vehicle"

    def __init__(self, flown, duration_s, switches=None):
        super().__init__()
        self.autopilot = flown if flown is not None else autopilot(1, CROSSED, switches)
        self.autopilot.everybody = False
        self.end_us = round(duration_s * 1e6)
        self.live = None

    def receive(self):
        if self.autopilot.elapsed_us >= self.end_us:
            self.live.stop = "flown"
            return []
        if KEY not in self.autopilot.clients:
            return []  # nobody has spoken to it yet
        self.autopilot.step()
        if not self.autopilot.silent:
            self.autopilot.ask_time((KEY,))
        return [(KEY, b"".join(frame for key, frame in self.autopilot.outgoing() if key == KEY))]

    def send(self, data, peer=None):
        self.sent.append(data)
        self.autopilot.receive(KEY, data)


class Script(Ready):
    """Hands out what it was given, a piece each time that the loop reads, then ends the run."""

    name = "script"

    def __init__(self, pieces):
        super().__init__()
        self.pieces = list(pieces)
        self.live = None

    def receive(self):
        if not self.pieces:
            self.live.stop = "script is over"
            return []
        return [self.pieces.pop(0)]

    def send(self, data, peer=None):
        self.sent.append(data)


@pytest.fixture
def loop(tmp_path):
    """Runs a loop over links to its end: -> the loop and its summary."""
    opened = []

    def run(*links, recorder=None, duration_s=None, **options):
        opened.extend(links)
        core = Core(parafoil(), Policy.AUTO, **options)
        live = Live(core, links, VehicleClock(), recorder or Recorder(tmp_path), Journal(parafoil()))
        for link in links:
            link.live = live
        return live, live.run(duration_s)

    yield run
    for link in opened:
        link.close()


def beat(source, *, armed=False, kind=mavlink.MAV_TYPE_PARAFOIL, autopilot=mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA):
    fields = {"type": kind, "autopilot": autopilot, "base_mode": 128 if armed else 0}
    return encode("HEARTBEAT", fields, sysid=source[0], compid=source[1], seq=0)


def clock(seconds, source=(1, 1)):
    """The vehicle's exchange that moves the lockstep clock."""
    return encode("TIMESYNC", {"tc1": 0, "ts1": round(seconds * 1e9)}, sysid=source[0], compid=source[1], seq=0)


def sent(link, name):
    """Frames of one kind that went out on a link."""
    splitter = Splitter()
    return [frame for raw in link.sent for frame in splitter.feed(raw) if frame.name == name]


# -- the loop ---------------------------------------------------------------------------------------------------------


def test_a_flight_through_the_loop_is_mended_recorded_and_summed_up(loop, tmp_path):
    link = VehicleLink(None, 100.0)
    live, content = loop(link)
    assert (content["verdict"], content["recovery"]["state"]) == ("fault", "done")
    assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8")) == content
    lines = events(tmp_path / "events.jsonl")
    assert lines == live.journal.lines
    assert (lines[0]["kind"], lines[-1]["text"]) == ("run", "run ends: flown")
    assert lines[-1]["counters"] == content["counters"]
    records = list(Reader(tmp_path / "flight.tlog"))
    own = [one.frame.raw for one in records if one.link == OWN_LINK]
    assert own == link.sent
    assert [raw[4] for raw in own] == [number % 256 for number in range(len(own))]
    assert {(one.frame.sysid, one.frame.compid) for one in records if one.link == OWN_LINK} == {OURS}
    stamps = [one.stamp_us // 4 for one in records]
    assert stamps == sorted(stamps)


def test_a_run_ends_after_its_duration_of_the_vehicles_time(loop):
    link = VehicleLink(None, 100.0)
    live, _ = loop(link, duration_s=12.0)
    assert live.journal.lines[-1]["text"] == "run ends: duration reached"
    assert link.autopilot.elapsed_us == pytest.approx(12_000_000, abs=200_000)


def test_what_is_said_goes_out_on_every_link(loop):
    vehicle, other = VehicleLink(None, 45.0), Script([("nobody", b"")] * 10_000)
    loop(vehicle, other)
    assert vehicle.sent == other.sent
    assert len(sent(other, "STATUSTEXT")) >= 3


def test_peers_beyond_the_limit_make_room_and_what_they_sent_stays_counted(loop):
    link = Script([(number, beat((255, 190), kind=6, autopilot=8)) for number in range(3 * PEERS)])
    live, content = loop(link)
    assert content["counters"]["wire.frames"] == 3 * PEERS
    assert len(live._splitters) == PEERS


def test_a_frame_cut_between_two_reads_belongs_to_its_own_peer(loop):
    raw = beat((255, 190), kind=6, autopilot=8)
    link = Script([("a", raw[:9]), ("b", raw[:14]), ("a", raw[9:]), ("b", raw[14:])])
    _, content = loop(link)
    assert content["counters"]["wire.frames"] == 2
    assert "wire.skipped_bytes" not in content["counters"]


def test_only_the_autopilots_own_time_moves_the_lockstep_clock(loop):
    link = Script([("a", beat((1, 1))), ("a", clock(50.0, (255, 190))), ("a", clock(50.0, (1, 191))), ("a", clock(2.0))])
    live, _ = loop(link)
    assert live.clock.now_us() - live.clock._epoch_us // 4 * 4 == pytest.approx(2_000_000, abs=4)


# -- the disk ---------------------------------------------------------------------------------------------------------


class Watchful(VehicleLink):
    """Notes, at each PARAM_SET that arrives, what the record on disk says by then."""

    def __init__(self, folder, duration_s, switches=None):
        super().__init__(None, duration_s, switches)
        self.record = folder / RECORD_NAME
        self.found = []

    def send(self, data, peer=None):
        (frame,) = Splitter().feed(data)
        if frame.name == "PARAM_SET":
            self.found.append(json.loads(self.record.read_text(encoding="utf-8"))["recovery"])
        super().send(data, peer)


def test_the_record_that_names_a_parameter_is_on_disk_before_its_setting_leaves(loop, tmp_path):
    link = Watchful(tmp_path, 90.0)
    loop(link)
    assert [(record["stage"], record["touched"], record["place"]) for record in link.found] == [
        ("setting", 1, 0), ("setting", 2, 1),
    ]  # fmt: skip
    assert all(record["original"] == list(ORIGINAL) for record in link.found)
    assert not (tmp_path / RECORD_NAME).exists()  # verified: there is nothing to put back any more


class Unwilling(Recorder):
    """A disk that keeps no record: always, or from the second one on."""

    kept = 0

    def save_record(self, text):
        if self.kept <= 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        self.kept -= 1
        super().save_record(text)


@pytest.mark.parametrize("kept", [0, 1])
def test_what_could_not_be_put_back_after_a_kill_is_not_begun(kept, loop, tmp_path):
    recorder = Unwilling(tmp_path)
    recorder.kept = kept
    link = VehicleLink(None, 90.0)
    live, _ = loop(link, recorder=recorder)
    values = [frame.fields()["param_value"] for frame in sent(link, "PARAM_SET")]
    assert (SWAPPED[0] in values) == bool(kept)
    assert tuple(link.autopilot.parameters.value(name) for name in OUTPUTS) == ORIGINAL
    assert live.core.recovery.stage in (Stage.REFUSED, Stage.ROLLED_BACK)
    texts = [frame.fields()["text"] for frame in sent(link, "STATUSTEXT")]
    assert texts.count("mavfdi: disk trouble, monitoring goes on") == 1
    assert "log/full" in names(live.journal.lines)


class FullFile:
    """Takes the place of a recorder's log."""

    def __init__(self, recorder, room):
        tlog = recorder._flights._file
        self.file, self.room = tlog._file, room
        tlog._file = self

    def write(self, data):
        self.room -= len(data)
        if self.room < 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.file.write(data)

    def truncate(self, size):
        return self.file.truncate(size)

    def fileno(self):
        return self.file.fileno()

    def close(self):
        self.file.close()


def test_a_full_disk_is_told_once_and_the_vehicle_is_mended_all_the_same(loop, tmp_path):
    recorder = Recorder(tmp_path)
    FullFile(recorder, 50_000)
    link = VehicleLink(None, 100.0)
    live, content = loop(link, recorder=recorder)
    assert names(live.journal.lines).count("log/full") == 1
    texts = [frame.fields()["text"] for frame in sent(link, "STATUSTEXT")]
    assert texts.count("mavfdi: disk trouble, monitoring goes on") == 1
    assert (live.core.recovery.stage, content["verdict"]) == (Stage.DONE, "fault")
    assert content["counters"]["recorder.dropped"] > 1000
    assert tuple(link.autopilot.parameters.value(name) for name in OUTPUTS) == SWAPPED


# -- logs -------------------------------------------------------------------------------------------------------------


def told_of_logs(lines):
    """(name, file, next) of the events of the kind `log`."""
    return [(line["name"], line.get("file"), line.get("next")) for line in lines if line["kind"] == "log"]


class Rearmed(VehicleLink):
    """Told by its ground station to disarm in mid-flight at 10 s, and to arm again at 13 s; the fault comes at 20 s."""

    orders = ((10.0, 0.0), (13.0, 1.0))
    station = mavlink.MAVLink(None, 255, 190)

    def receive(self):
        while self.orders and self.autopilot.elapsed_us >= self.orders[0][0] * 1e6:
            (_, arm), *self.orders = self.orders
            order = message(
                "COMMAND_LONG", target_system=1, target_component=1, command=400, param1=arm, param2=21196.0
            )  # fmt: skip
            self.autopilot.receive("ground", order.pack(self.station))
        return super().receive()


FAULTS = ("fault/detected", "fault/isolated", "recovery/considered", "recovery/requested")


def times(lines):
    """When the alarm and the repair happened, s on the vehicle's clock."""
    return {name: line["t"] for line in lines if (name := f"{line['kind']}/{line['name']}") in FAULTS}


@pytest.mark.parametrize("when", [When.ALWAYS, When.WHILE_ARMED])
def test_each_flight_has_a_log_which_by_itself_tells_what_the_run_told(when, loop, tmp_path):
    link = Rearmed(None, 100.0)
    live, _ = loop(link, recorder=Recorder(tmp_path, Rules(when)))
    told = told_of_logs(live.journal.lines)
    if when is When.ALWAYS:
        assert told == [("opened", "flight.tlog", None), ("rotated", "flight.tlog", "flight-2.tlog")]
    else:
        assert told == [("opened", "flight.tlog", None), ("closed", "flight.tlog", None), ("opened", "flight-2.tlog", None)]
    first, second = (analyze(tmp_path / name, lambda _: parafoil()) for name in ("flight.tlog", "flight-2.tlog"))
    assert first.content["faults"] == []
    live_times = times(live.journal.lines)
    assert list(live_times) == list(FAULTS)
    assert times(second.content["events"]) == live_times
    armed = [line["t"] for line in live.journal.lines if line["name"] == "armed"]
    assert [line["t"] for line in second.content["events"] if line["name"] == "armed"][-1] == armed[-1]
    assert second.content["duration_s"] == pytest.approx(100.0 - armed[-1] + 10.0, abs=0.5)


def test_a_log_that_begins_in_mid_run_makes_the_parameters_asked_for_until_it_holds_them(loop, tmp_path):
    link = Rearmed(None, 30.0)
    link.orders = ((15.0, 0.0), (18.0, 1.0))
    loop(link)
    asked = [frame.fields()["param_id"] for frame in sent(link, "PARAM_REQUEST_READ")]
    assert sorted(asked) == sorted(2 * OUTPUTS)  # once for the run, once for its second log
    held = [one.frame.fields()["param_id"] for one in Reader(tmp_path / "flight-2.tlog") if one.frame.name == "PARAM_VALUE"]
    assert sorted(held) == sorted(OUTPUTS)


def test_a_log_that_begins_in_mid_flight_makes_the_parameters_asked_for_too(loop, tmp_path):
    link = VehicleLink(None, 20.0)
    news = News("rotated", Severity.INFO, "flight.tlog is complete", "256 MB is the most for a file")

    class Outgrown(Recorder):
        """Tells of a rotation in the tenth second."""

        def news(self):
            due = link.autopilot.elapsed_us == 10_000_000 and news not in given
            given.extend([news] * due)
            return super().news() + [news] * due

    given = []
    loop(link, recorder=Outgrown(tmp_path))
    asked = [frame.fields()["param_id"] for frame in sent(link, "PARAM_REQUEST_READ")]
    assert sorted(asked) == sorted(2 * OUTPUTS)


def test_the_first_log_of_a_run_holds_no_request_that_its_replay_does_not_make(loop, tmp_path):
    loop(VehicleLink(None, 60.0))
    found = analyze(tmp_path / "flight.tlog", lambda _: parafoil())
    assert found.content["replay"]["same_sends"]


def test_parameters_that_no_longer_answer_are_asked_for_a_bounded_number_of_times_for_a_log(loop):
    link = Rearmed(None, 30.0)

    def deaf(key, data):
        (frame,) = Splitter().feed(data)
        if frame.name != "PARAM_REQUEST_READ" or link.autopilot.elapsed_us < 12_000_000:
            heard(key, data)

    heard, link.autopilot.receive = link.autopilot.receive, deaf
    loop(link)
    asked = [frame.fields()["param_id"] for frame in sent(link, "PARAM_REQUEST_READ")]
    assert sorted(asked) == sorted((1 + RETELL_TRIES) * OUTPUTS)


def test_with_no_log_events_and_summary_are_kept_all_the_same(loop, tmp_path):
    live, content = loop(VehicleLink(None, 12.0), recorder=Recorder(tmp_path, Rules(When.OFF)))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["events.jsonl", "summary.json"]
    assert told_of_logs(live.journal.lines) == []
    assert content["counters"]["recorder.dropped"] == 0


def test_removed_logs_are_told_with_name_and_size(loop, tmp_path, monkeypatch):
    (tmp_path / "flight.tlog").write_bytes(bytes(MEGABYTE))
    free = iter([0, MEGABYTE])
    monkeypatch.setattr("companion.recorder.free_bytes", lambda _: next(free, MEGABYTE))
    live, _ = loop(VehicleLink(None, 3.0), recorder=Recorder(tmp_path, Rules(free_bytes=MEGABYTE // 2)))
    removed, opened = [line for line in live.journal.lines if line["kind"] == "log"]
    assert (removed["name"], removed["file"], removed["bytes"]) == ("removed", "flight.tlog", MEGABYTE)
    assert (opened["name"], opened["file"]) == ("opened", "flight-2.tlog")
    assert events(tmp_path / "events-2.jsonl") == live.journal.lines


def test_without_room_from_the_start_the_vehicle_is_watched_and_the_ground_told(loop, tmp_path, monkeypatch):
    monkeypatch.setattr("companion.recorder.free_bytes", lambda _: 0)
    link = VehicleLink(None, 45.0)
    live, _ = loop(link)
    full = [line for line in events(tmp_path / "events.jsonl") if line["kind"] == "log"]
    assert [line["text"] for line in full] == ["recording stopped: less than 200 MB free on the disk; monitoring goes on"]
    assert [frame.fields()["text"] for frame in sent(link, "STATUSTEXT")].count(
        "mavfdi: disk trouble, monitoring goes on"
    ) == 1  # though the arming has tried again
    assert "fault/detected" in names(live.journal.lines)
    assert not (tmp_path / "flight.tlog").exists()


# -- a good component -------------------------------------------------------------------------------------------------


def beats(flight):
    return [send for send in flight.sends if send.message == "HEARTBEAT"]


def doubles(steps, taken):
    """Somebody who beats under component `taken(step)` of the vehicle once a second; a step is 0.1 s."""
    return [
        ("somebody", beat((1, taken(step)), kind=18, autopilot=8) if step % 10 == 0 else b"") for step in range(steps)
    ]  # fmt: skip


def test_somebody_elses_heartbeats_under_our_ids_make_us_move_on_with_an_event(loop):
    vehicle = VehicleLink(None, 100.0)
    rival = Script(doubles(400, lambda step: 191 + min(3, step // 80)))  # whoever it is follows us
    live, _ = loop(vehicle, rival)
    assert list(dict.fromkeys(frame.compid for frame in sent(vehicle, "HEARTBEAT"))) == [191, 192, 193, 194]
    moved = [line["text"] for line in live.journal.lines if line["name"] == "config"]
    assert moved == [f"component {taken} is somebody else's, continuing as {taken + 1}" for taken in (191, 192, 193)]
    assert names(live.journal.lines, "fault")[:1] == ["fault/detected"]  # the work goes on


def test_two_stray_heartbeats_under_our_ids_are_no_reason_to_move(loop):
    vehicle, rival = VehicleLink(None, 100.0), Script(doubles(20, lambda _: 191) + [("somebody", b"")] * 100)
    loop(vehicle, rival)
    assert {frame.compid for frame in sent(vehicle, "HEARTBEAT")} == {191}


def test_a_component_id_that_was_asked_for_is_kept_whoever_else_has_it(loop):
    vehicle, rival = VehicleLink(None, 100.0), Script(doubles(200, lambda _: 192))
    loop(vehicle, rival, compid=192, pinned_compid=True)
    assert {frame.compid for frame in sent(vehicle, "HEARTBEAT")} == {192}


def test_our_heartbeat_stops_when_no_rows_are_judged_any_more_and_comes_back_with_them():
    flight = Flight(2).fly(20.0)
    assert 19 <= len(beats(flight)) <= 22
    flight.hear_nothing(10.0)
    flight.sends.clear()
    flight.hear_nothing(20.0)
    # Rows go on, empty, for ten seconds of silence; three later the heartbeat ends and a knock takes its place.
    assert len(beats(flight)) <= 4
    assert len([send for send in flight.sends if send.message == "TIMESYNC" and send.fields["tc1"] == 0]) >= 15
    flight.sends.clear()
    flight.fly(10.0)
    assert len(beats(flight)) >= 9


def intervals(flight):
    command = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    asked = [send.fields for send in flight.sends if send.message == "COMMAND_LONG" and send.fields["command"] == command]
    return sorted(round(fields["param1"]) for fields in asked)


def test_the_streams_that_the_airframe_needs_are_asked_for_once_and_again_after_a_reboot():
    needed = sorted(
        getattr(mavlink, f"MAVLINK_MSG_ID_{name}") for name in parafoil().configuration.streams
    )  # fmt: skip
    flight = Flight(2).fly(20.0)
    assert intervals(flight) == needed
    assert [flight.autopilot._clients[KEY].intervals_us[number] > 0 for number in needed] == [True] * len(needed)
    flight.sends.clear()
    flight.autopilot.reboot()
    flight.fly(20.0)
    assert "vehicle/reboot" in flight.names()
    assert intervals(flight) == needed
    asked = [send.fields["param_id"] for send in flight.sends if send.message == "PARAM_REQUEST_READ"]
    assert sorted(asked) == sorted(OUTPUTS)
    assert flight.names("fault") == []


def without(stream):
    """The parafoil with an autopilot that never sends this message."""
    simulator = parafoil().load_simulator()
    fleet = simulator.Fleet(parafoil().simulator_config(simulator), [2], None)
    vehicle = replace(
        simulator.VEHICLE, streams=tuple(one for one in simulator.VEHICLE.streams if one.message != stream)
    )  # fmt: skip
    return Autopilot(vehicle, fleet, seed=2)


def test_a_stream_that_does_not_come_is_asked_for_in_both_ways_and_then_told():
    sends = []
    rehearsal = Rehearsal(parafoil(), without("WHEEL_DISTANCE"), Policy.AUTO, observe=sends.append)
    rehearsal.fly(40.0)
    lines = [line for line in rehearsal.journal.lines if line["kind"] == "check"]
    assert [(line["name"], line["message"], line["severity"]) for line in lines] == [
        ("stream_missing", "WHEEL_DISTANCE", "warning")
    ]
    messages = [getattr(effect, "message", "") for effect in sends]
    assert messages.count("REQUEST_DATA_STREAM") == 1
    assert messages.index("COMMAND_LONG") < messages.index("REQUEST_DATA_STREAM")
    texts = [effect.fields["text"] for effect in sends if getattr(effect, "message", "") == "STATUSTEXT"]
    assert texts.count("mavfdi: no WHEEL_DISTANCE stream") == 1
    assert names(rehearsal.journal.lines, "fault") == []


def test_an_autopilot_that_denies_intervals_but_sends_its_stock_rates_is_no_complaint():
    flight = Flight(2, misbehaviour=Misbehaviour(command_mode=1)).fly(40.0)
    assert flight.names("check") == []
    assert flight.names("fault") == []


def test_parameters_that_never_answer_are_asked_for_a_bounded_number_of_times():
    flight = Flight(2).fly(2.0)
    flight.autopilot.misbehaviour.link_loss = 1.0  # only the exchange of times still gets through
    flight.fly(60.0)
    asked = [send for send in flight.sends if send.message == "PARAM_REQUEST_READ"]
    assert len(asked) == 2 * 10
