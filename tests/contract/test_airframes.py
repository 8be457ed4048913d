"""Every airframe that can be found, and a toy from outside the package, is asked the same questions."""

import dataclasses
import math
import os
import random
import re
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from companion import airframe as airframes
from companion.align import Aligner
from companion.decode import TABLE, Decoder
from companion.dialect import encode
from companion.errors import UserError
from companion.frames import Splitter
from companion.streams import Streams
from fdi.verdict import NO_FAULT, Phase, Verdict
from sitl.autopilot import Autopilot
from sitl.vehicle import Injected
from sitl.wire import quantiser

TOY_PATH = Path(__file__).parents[1] / "toy_airframe"
NAMES = (*airframes.places(), "sled")
STATUSTEXT_BYTES = 50
TOYS = ("sled",)  # whose thresholds nobody flies on
AUTOPILOTS_OWN = ("armed",)  # channels of the vehicle's own messages, which no fleet has
LOUD = (Phase.DETECTED, Phase.ISOLATED, Phase.INCONCLUSIVE)
SEEDS = (11, 12, 13)
ONSET_S = 10.0
ARRAYS = tuple(field.name for field in dataclasses.fields(Verdict) if field.name != "thresholds")


@dataclasses.dataclass(frozen=True)
class Mirror:
    """What becomes of an airframe's rows and verdicts when left and right are exchanged."""

    exchanged: tuple[tuple[str, str], ...]  # channels
    negated: tuple[str, ...]  # channels
    residuals: tuple[tuple[str, str], ...]
    signals_negated: tuple[str, ...]


MIRRORS = {
    "parafoil": Mirror(
        exchanged=(("output_1_us", "output_2_us"), ("wheel_distance_1_m", "wheel_distance_2_m")),
        negated=(
            *("velocity_east_m_s", "yaw_rate_rad_s", "roll_rad", "turn_rate_command_rad_s"),
            "wind_direction_rad",  # from the west instead of from the east
        ),
        residuals=(("motor_1", "motor_2"), ("broken_left", "broken_right")),
        signals_negated=("turn_rate_command_rad_s", "turn_rate_rad_s"),
    )
}


@dataclasses.dataclass(frozen=True)
class Subject:
    """One airframe with its simulator."""

    airframe: airframes.Airframe
    simulator: object
    config: object  # of the simulator

    @property
    def detector(self):
        return self.airframe.detector

    @property
    def period_s(self):
        return self.airframe.configuration.grid.period_us * 1e-6

    def fleet(self, seeds, faults=None):
        return self.simulator.Fleet(self.config, seeds, faults)

    def fly(self, seeds, faults, seconds):
        """-> (values, age_s), (row, flight, channel), as MAVLink carries them; the first row stands before arming."""
        fleet = self.fleet(seeds, faults)
        at = {name: column for column, name in enumerate(fleet.channels)}
        as_on_the_wire = quantiser(self.simulator.VEHICLE.streams, fleet.channels)
        step_s = self.simulator.VEHICLE.steps_s[0]
        steps = round(self.period_s / step_s)
        assert steps * step_s == pytest.approx(self.period_s)
        shape = (round(seconds / self.period_s) + 1, len(seeds), len(self.detector.channels))
        values, age_s = np.zeros(shape), np.zeros(shape)
        for k in range(shape[0]):
            for _ in range(steps if k else 0):
                fleet.step(step_s)
            sensed, sensed_age_s = fleet.observe()
            sensed = as_on_the_wire(sensed)
            for c, name in enumerate(self.detector.channels):
                if name in AUTOPILOTS_OWN:
                    values[k, :, c] = ~fleet.landed if k else 0.0
                else:
                    values[k, :, c], age_s[k, :, c] = sensed[:, at[name]], sensed_age_s[:, at[name]]
        return values, age_s

    def judge(self, values, age_s):
        """-> one array of (row, flight, ...) for each array of the verdict, by name."""
        monitor = self.airframe.monitor(values.shape[1])
        verdicts = [monitor.step(values[k], age_s[k]) for k in range(values.shape[0])]
        return {name: np.stack([getattr(verdict, name) for verdict in verdicts]) for name in ARRAYS}


@pytest.fixture(scope="module", params=NAMES)
def subject(request):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(TOY_PATH)
        airframe = airframes.load(request.param)
        simulator = airframe.load_simulator()
        yield Subject(airframe, simulator, airframe.simulator_config(simulator))


@pytest.fixture(scope="module")
def healthy(subject):
    """(values, age_s) of two minutes without a fault."""
    return subject.fly(SEEDS, None, 120.0)


@pytest.fixture(scope="module")
def faulty(subject):
    """(faults, values, age_s): each fault with each seed, up to two minutes after its onset."""
    faults = [Injected(name, ONSET_S) for name in subject.simulator.VEHICLE.fault_ids for _ in SEEDS]
    seeds = SEEDS * len(subject.simulator.VEHICLE.fault_ids)
    return faults, *subject.fly(seeds, faults, ONSET_S + 120.0)


@pytest.fixture(scope="module")
def verdicts(subject, faulty):
    """The verdicts on the faulty flights, one array of (row, flight, ...) by name."""
    _, values, age_s = faulty
    return subject.judge(values, age_s)


def same(one, other):
    return all(np.array_equal(one[name], other[name], equal_nan=True) for name in ARRAYS)


# Tables


def test_an_airframe_from_outside_is_found_by_its_entry_point():
    code = (
        "from companion import airframe; a = airframe.load('sled'); print(a.name, a.simulator, a.load_simulator().__name__)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": str(TOY_PATH)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.stdout.split() == ["sled", "sled.sitl", "sled.sitl"], done.stderr


def test_an_airframe_that_nobody_installed_is_unknown_and_the_known_are_named():
    with pytest.raises(UserError, match=r"unknown airframe 'hovercraft'; known: .*parafoil"):
        airframes.load("hovercraft")


def test_detector_and_simulator_name_the_same_faults_by_class_and_place(subject):
    ids = [fault.id for fault in subject.detector.faults]
    assert sorted(ids) == sorted(subject.simulator.VEHICLE.fault_ids)
    assert len(set(ids)) == len(ids)
    for fault in subject.detector.faults:
        assert re.fullmatch(r"[a-z][a-z0-9_]*(:[a-z][a-z0-9_]*)?", fault.id)
        assert fault.id == ":".join(filter(None, (fault.fault_class, fault.where)))


def test_every_fault_text_fits_one_statustext_with_its_confidence(subject):
    for fault in subject.detector.faults:
        assert len(("mavfdi: " + fault.text + " (99.9 %)").encode()) <= STATUSTEXT_BYTES
    assert len({fault.text for fault in subject.detector.faults}) == len(subject.detector.faults)


def test_every_fault_has_one_signature_over_the_residuals_unlike_all_others(subject):
    signatures = subject.detector.signatures
    assert sorted(each.fault_id for each in signatures) == sorted(fault.id for fault in subject.detector.faults)
    for signature in signatures:
        assert tuple(signature.marks) == subject.detector.residuals
        assert set(signature.marks.values()) <= set("+0.")
        assert "+" in signature.marks.values()
    for one, other in combinations(signatures, 2):
        pairs = zip(one.marks.values(), other.marks.values(), strict=True)
        assert any({a, b} == {"+", "0"} for a, b in pairs), f"{one.fault_id} and {other.fault_id} look alike"


def test_every_channel_is_delivered_by_a_stream_that_is_asked_for_and_carried_by_the_simulator(subject):
    own = {"HEARTBEAT"}  # sent unasked
    asked = subject.airframe.configuration.streams
    carried = {stream.message for stream in subject.simulator.VEHICLE.streams}
    assert set(asked) <= carried
    for channel in subject.detector.channels:
        messages = {row.message for row in TABLE if row.channel == channel}
        assert messages & (own | set(asked)), f"no stream asked for delivers {channel}"
    assert set(asked) <= set(Decoder(subject.detector.channels).messages)


def test_the_vehicle_has_the_parameters_that_the_judgement_and_the_recoveries_use(subject):
    known = {parameter.name for parameter in subject.simulator.VEHICLE.parameters}
    assert set(subject.detector.parameters) <= known
    for plan in subject.airframe.configuration.recovery.values():
        assert set(plan.read_first) <= known


def test_recoveries_mend_known_faults_and_are_verified_by_what_the_monitor_says(subject):
    faults = {name for fault in subject.detector.faults for name in (fault.id, fault.fault_class)}
    for name, plan in subject.airframe.configuration.recovery.items():
        assert name in faults
        assert plan.verify_residual in subject.detector.residuals
        assert plan.excitation_signal in subject.detector.signals


@pytest.mark.parametrize("key", ["verify_residual", "excitation_signal"])
def test_a_recovery_verified_by_what_does_not_exist_is_refused(subject, tmp_path, key):
    if not subject.airframe.configuration.recovery:
        pytest.skip(f"{subject.airframe.name} has no recovery")
    for name in subject.airframe.configuration.recovery:
        owners = tmp_path / f"{name.replace(':', '_')}.toml"
        owners.write_text(f'[recovery."{name}"]\n{key} = "moon_phase"\n')
        with pytest.raises(UserError, match=f"{key} = 'moon_phase'; known: "):
            airframes.load(subject.airframe.name, owners)


def tables_named(table, wanted):
    for name, value in table.items():
        if isinstance(value, dict):
            yield from [value] if name == wanted else tables_named(value, wanted)


def test_a_design_record_says_when_how_and_on_what_the_thresholds_were_found(subject):
    records = list(tables_named(subject.airframe.configuration.monitor, "design"))
    if not records:
        assert subject.airframe.name in TOYS, "thresholds without a design record"
    for record in records:
        assert re.fullmatch(r"20\d\d-[01]\d-[0-3]\d", record["date"])
        assert (Path(__file__).parents[2] / record["command"].split()[0]).is_file()
        assert str(record["first_seed"]) in record["command"].split()
        assert record["healthy_flights"] >= 100
        assert 0.0 <= record["false_alarms_per_flight"] < 0.1
        if "missed_share" in record:
            assert record["fault_flights"] >= 100
            assert 0.0 <= record["missed_share"] < 0.5


# The way of the data


class Heard:
    """Twenty seconds of an autopilot, as a companion that asked for its streams hears them, and as the fleet has it."""

    def __init__(self, subject, slices=None):
        detector, grid = subject.detector, subject.airframe.configuration.grid
        self.autopilot = Autopilot(subject.simulator.VEHICLE, subject.fleet(SEEDS[:1]), release_s=1.0)
        self.decoder = Decoder(detector.channels)
        self.splitter = Splitter()
        self.aligner = Aligner(grid.period_us, grid.maximal_age_us(detector.channels))
        self.slices = slices
        self.rows = []
        self.state = {0: (*self.autopilot.fleet.observe(), self.autopilot.armed)}  # by boot time, us
        self.sent_us = {}  # by message: when it left
        for send in Streams(subject.airframe.configuration.streams).ask(0):
            self._say(send.message, {**send.fields, "target_system": 1, "target_component": 1})
        self.autopilot.outgoing()
        while self.autopilot.time_us < 20_000_000:
            self.autopilot.step()
            self.state[self.autopilot.time_us] = (*self.autopilot.fleet.observe(), self.autopilot.armed)
            self._hear(b"".join(frame for key, frame in self.autopilot.outgoing() if key == "companion"))

    def _say(self, name, fields):
        self.autopilot.receive("companion", encode(name, fields, sysid=1, compid=191, seq=0))

    def _hear(self, data):
        arrival_us = self.autopilot.time_us
        start = 0
        while start < len(data):
            end = start + (self.slices.randint(1, 40) if self.slices else len(data))
            for frame in self.splitter.feed(data[start:end]):
                self.sent_us.setdefault(frame.name, []).append(arrival_us)
                self.rows += self.aligner.due(arrival_us)
                sampled = self.decoder.decode(frame)
                if sampled is not None:
                    self.rows += self.aligner.push(sampled, arrival_us)
            start = end


@pytest.fixture(scope="module")
def heard(subject):
    return Heard(subject)


# MAVLink's units in SI, written down a second time so that a wrong one in the decode table does not judge itself
UNITS = {
    "degE7": math.radians(1e-7), "deg": math.radians(1.0), "cdeg": math.radians(0.01), "rad": 1.0, "rad/s": 1.0,
    "mm": 1e-3, "cm": 1e-2, "m": 1.0, "cm/s": 1e-2, "m/s": 1.0, "us": 1.0, "hPa": 100.0, "m/s/s": 1.0,
}  # fmt: skip


def definition(message):
    return next(kind for kind in dialect.mavlink_map.values() if kind.msgname == message)


def is_stamped(message):
    return bool({"time_boot_ms", "time_usec"} & set(definition(message).fieldnames))


def half_a_step(row, value):
    """How far a decoded value may be from the state, SI: from the type and unit in MAVLink's own definition."""
    message = definition(row.message)
    name = row.field.partition("[")[0]
    kind = dict(zip(message.fieldnames, message.fieldtypes, strict=True))[name]
    rounding = 4e-15 * abs(value)  # of the conversions in float64
    if kind == "double":
        return rounding
    if kind == "float":
        return 2.0**-24 * abs(value) + rounding
    return 0.5 * UNITS[message.fieldunits_by_name[name]] * (1.0 + 1e-9) + rounding


def test_every_decoded_channel_equals_the_state_of_the_fleet_and_has_its_age(subject, heard):
    assert len(heard.rows) >= 190
    assert not heard.decoder.counts
    assert not heard.aligner.counts["off_clock"]
    at = {name: column for column, name in enumerate(heard.autopilot.fleet.channels)}
    period_us = heard.aligner.period_us
    moved = dict.fromkeys(subject.detector.channels, 0.0)
    for c, channel in enumerate(subject.detector.channels):
        table_row = next(row for row in TABLE if row.channel == channel)
        stamped = is_stamped(table_row.message)
        departures_us = heard.sent_us[table_row.message]
        first = None
        for row in heard.rows[15:]:  # every stream has come once
            value, age_s = row.values[0, c], row.age_s[0, c]
            if channel in AUTOPILOTS_OWN:
                # A message without a stamp belongs to the newest stamp before it, which may be that of the row before.
                assert value in (float(heard.state[row.t_us][2]), float(heard.state[row.t_us + period_us][2]))
                assert -1e-9 <= age_s <= 1.0 + 1e-9
            else:
                sent_us = max(t_us for t_us in departures_us if t_us <= row.t_us)
                values, ages_s, _ = heard.state[sent_us]
                truth, waited_s = values[0, at[channel]], (row.t_us - sent_us) * 1e-6
                assert abs(value - truth) <= half_a_step(table_row, truth), f"{channel} at {row.t_us} us"
                if stamped:
                    assert age_s == pytest.approx(waited_s + ages_s[0, at[channel]], abs=1e-9), f"{channel} at {row.t_us} us"
                else:
                    assert waited_s - 1e-9 <= age_s <= waited_s + period_us * 1e-6 + 1e-9
            first = value if first is None else first
            moved[channel] = max(moved[channel], abs(value - first))
    assert all(moved[channel] > 0.0 for channel in subject.detector.channels if channel not in AUTOPILOTS_OWN)


def test_a_stream_as_fast_as_its_sensor_loses_nothing_against_rows_taken_from_the_fleet(subject, heard):
    at = {name: column for column, name in enumerate(heard.autopilot.fleet.channels)}
    stamped = [
        c
        for c, channel in enumerate(subject.detector.channels)
        for row in TABLE
        if row.channel == channel and is_stamped(row.message)
    ]
    columns = [at[subject.detector.channels[c]] for c in stamped]
    for row in heard.rows[15:]:
        _, ages_s, _ = heard.state[row.t_us]
        assert row.age_s[0, stamped] == pytest.approx(ages_s[0, columns], abs=1e-9)


def test_any_slicing_of_the_bytes_gives_the_same_rows(subject, heard):
    sliced = Heard(subject, random.Random(5))
    assert len(sliced.rows) == len(heard.rows)
    for one, other in zip(sliced.rows, heard.rows, strict=True):
        assert (one.t_us, one.restart) == (other.t_us, other.restart)
        assert np.array_equal(one.values, other.values, equal_nan=True)
        assert np.array_equal(one.age_s, other.age_s, equal_nan=True)


# Judgement


def test_a_healthy_minute_stays_healthy(subject, healthy):
    values, age_s = healthy
    minute = round(60.0 / subject.period_s) + 1
    seen = subject.judge(values[:minute], age_s[:minute])
    assert not np.isin(seen["phase"], LOUD).any()
    assert (seen["fault"] == NO_FAULT).all()
    assert (seen["phase"][0] == Phase.WARMING).all()
    assert (seen["phase"][-1] == Phase.HEALTHY).all()


def test_every_fault_raises_something_and_none_before_its_onset(subject, faulty, verdicts):
    loud = np.isin(verdicts["phase"], LOUD)
    assert not loud[: round(ONSET_S / subject.period_s) + 1].any()
    raised = loud.any(axis=0)
    for name in subject.simulator.VEHICLE.fault_ids:
        assert any(raised[f] for f, fault in enumerate(faulty[0]) if fault.id == name), f"{name} raises nothing"


def test_every_fault_is_named_rightly_in_some_flight_with_a_confidence_and_an_age(subject, faulty, verdicts):
    for name in subject.simulator.VEHICLE.fault_ids:
        index = [fault.id for fault in subject.detector.faults].index(name)
        flights = [f for f, fault in enumerate(faulty[0]) if fault.id == name]
        named = verdicts["fault"][:, flights] == index
        assert named.any(), f"{name} is never named"
        assert (verdicts["phase"][:, flights][named] == Phase.ISOLATED).all()
        assert ((verdicts["confidence"][:, flights][named] > 0.0) & (verdicts["confidence"][:, flights][named] <= 1.0)).all()
        assert (verdicts["onset_s"][:, flights][named] > 0.0).all()


def test_nothing_is_named_while_no_fault_is_isolated(verdicts):
    isolated = verdicts["phase"] == Phase.ISOLATED
    assert np.array_equal(verdicts["fault"] != NO_FAULT, isolated)
    assert (verdicts["confidence"][~isolated] == 0.0).all()
    assert np.isnan(verdicts["size"][~isolated]).all()


def test_a_flight_alone_has_the_bits_of_the_flight_in_a_batch(subject):
    ids = subject.simulator.VEHICLE.fault_ids
    faults = [None, *(Injected(ids[f % len(ids)], 5.0 + f) for f in range(4))]
    seeds = range(21, 26)
    values, age_s = subject.fly(seeds, faults, 60.0)
    together = subject.judge(values, age_s)
    for f, (seed, fault) in enumerate(zip(seeds, faults, strict=True)):
        alone_values, alone_age_s = subject.fly([seed], [fault], 60.0)
        assert np.array_equal(alone_values[:, 0], values[:, f], equal_nan=True)
        assert np.array_equal(alone_age_s[:, 0], age_s[:, f], equal_nan=True)
        alone = subject.judge(alone_values, alone_age_s)
        assert same(alone, {name: array[:, f : f + 1] for name, array in together.items()})


def test_the_fleet_itself_has_the_same_bits_alone_and_in_a_batch(subject):
    batch, seeds = subject.fleet(SEEDS), SEEDS
    alone = [subject.fleet([seed]) for seed in seeds]
    step_s = subject.simulator.VEHICLE.steps_s[-1]
    for _ in range(300):
        values, age_s = batch.step(step_s)
        for f, fleet in enumerate(alone):
            own_values, own_age_s = fleet.step(step_s)
            assert np.array_equal(own_values[0], values[f], equal_nan=True)
            assert np.array_equal(own_age_s[0], age_s[f], equal_nan=True)


def test_a_flight_is_the_same_up_to_the_onset_of_its_fault(subject, healthy, faulty):
    faults, values, age_s = faulty
    until = round(ONSET_S / subject.period_s)  # the step that ends at the onset may have it already
    for f in range(len(faults)):
        seed = f % len(SEEDS)
        assert np.array_equal(values[:until, f], healthy[0][:until, seed], equal_nan=True)
        assert np.array_equal(age_s[:until, f], healthy[1][:until, seed], equal_nan=True)


def test_a_monitor_goes_on_from_a_saved_state_to_the_bit(subject, faulty):
    _, values, age_s = faulty
    middle = values.shape[0] // 4
    whole = subject.airframe.monitor(values.shape[1])
    for k in range(middle):
        whole.step(values[k], age_s[k])
    resumed = subject.airframe.monitor(values.shape[1])
    resumed.state = whole.state
    for k in range(middle, 2 * middle):
        one, other = whole.step(values[k], age_s[k]), resumed.step(values[k], age_s[k])
        assert same({name: getattr(one, name) for name in ARRAYS}, {name: getattr(other, name) for name in ARRAYS})
    assert all(np.array_equal(array, resumed.state[name], equal_nan=True) for name, array in whole.state.items())


def test_a_channel_lost_in_flight_or_all_of_them_is_no_evidence_of_a_fault(subject, healthy):
    channels = len(subject.detector.channels)
    values, age_s = (np.repeat(each, channels + 1, axis=1) for each in healthy)
    lost_from = round(30.0 / subject.period_s)
    for f in range(values.shape[1]):
        lost = slice(None) if f % (channels + 1) == channels else f % (channels + 1)
        values[lost_from:, f, lost] = math.nan
        age_s[lost_from:, f, lost] = math.nan
    seen = subject.judge(values, age_s)
    assert (seen["fault"] == NO_FAULT).all()
    for f in range(values.shape[1]):
        lost = "all" if f % (channels + 1) == channels else subject.detector.channels[f % (channels + 1)]
        assert not np.isin(seen["phase"][:, f], LOUD).any(), f"without {lost}"
        tail = seen["residuals"][-lost_from:, f]  # what is still said is still measured, not held for ever
        assert (np.isnan(tail[-1]) | (tail.max(axis=0) > tail.min(axis=0))).all(), f"without {lost}"
        if lost == "all":
            assert seen["phase"][-1, f] == Phase.WARMING
            assert np.isnan(seen["residuals"][-1, f]).all()
            assert np.isnan(seen["signals"][-1, f]).all()


def test_a_vehicle_that_stays_on_the_ground_is_never_judged(subject, faulty):
    _, values, age_s = faulty
    on_ground = values.copy()
    on_ground[..., subject.detector.channels.index("armed")] = 0.0
    seen = subject.judge(on_ground, age_s)
    assert (seen["phase"] == Phase.WARMING).all()
    assert (seen["fault"] == NO_FAULT).all()


def mirrored_name(name):
    sides = {"left": "right", "right": "left"}
    fault_class, colon, place = name.partition(":")
    return fault_class + colon + sides.get(place, place)


def test_exchanging_left_and_right_exchanges_them_in_the_verdict(subject, faulty, verdicts):
    detector = subject.detector
    if not {fault.where for fault in detector.faults} & {"left", "right"}:
        pytest.skip(f"{subject.airframe.name} has no sides")
    mirror = MIRRORS[subject.airframe.name]
    _, values, age_s = faulty
    at = {name: column for column, name in enumerate(detector.channels)}
    order = list(range(len(at)))
    for one, other in mirror.exchanged:
        order[at[one]], order[at[other]] = at[other], at[one]
    reflected, reflected_age_s = values[..., order].copy(), age_s[..., order].copy()
    reflected[..., [at[name] for name in mirror.negated]] *= -1.0
    seen, expected = subject.judge(reflected, reflected_age_s), verdicts
    ids = [fault.id for fault in detector.faults]
    faults = np.array([*(ids.index(mirrored_name(name)) for name in ids), NO_FAULT])  # the last for NO_FAULT = -1
    columns = list(range(len(detector.residuals)))
    for one, other in mirror.residuals:
        i, j = detector.residuals.index(one), detector.residuals.index(other)
        columns[i], columns[j] = j, i
    signs = np.array([-1.0 if name in mirror.signals_negated else 1.0 for name in detector.signals])
    assert np.array_equal(seen["phase"], expected["phase"])
    assert np.array_equal(seen["fault"], faults[expected["fault"]])
    assert np.array_equal(seen["confidence"], expected["confidence"])
    assert np.isin([ids.index(name) for name in ids if mirrored_name(name) != name], seen["fault"]).any()
    np.testing.assert_allclose(seen["residuals"], expected["residuals"][..., columns], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(seen["signals"], expected["signals"] * signs, rtol=1e-9, atol=1e-12)


def test_wrong_shapes_are_refused(subject):
    channels = len(subject.detector.channels)
    monitor = subject.airframe.monitor(2)
    good = np.zeros((2, channels))
    bad = (
        np.zeros((1, channels)),
        np.zeros((3, channels)),
        np.zeros((2, channels - 1)),
        np.zeros(channels),
        good[..., None],
    )
    for wrong in bad:
        with pytest.raises(ValueError, match="shape"):
            monitor.step(wrong, good)
        with pytest.raises(ValueError, match="shape"):
            monitor.step(good, wrong)
    with pytest.raises(ValueError, match="at least one flight"):
        subject.airframe.monitor(0)


def test_a_verdict_has_one_column_for_each_name(subject):
    verdict = subject.airframe.monitor(3).step(*(np.zeros((3, len(subject.detector.channels))),) * 2)
    assert verdict.residuals.shape == (3, len(subject.detector.residuals))
    assert verdict.thresholds.shape == (len(subject.detector.residuals),)
    assert verdict.signals.shape == (3, len(subject.detector.signals))
    assert ((verdict.thresholds > 0.0) & np.isfinite(verdict.thresholds)).all()
    for name in ("phase", "fault", "confidence", "size", "onset_s"):
        assert getattr(verdict, name).shape == (3,)


def test_a_state_of_another_monitor_is_refused(subject):
    monitor, state = subject.airframe.monitor(2), subject.airframe.monitor(3).state
    with pytest.raises(ValueError, match="names or shapes differ"):
        monitor.state = state
    with pytest.raises(ValueError, match="names or shapes differ"):
        monitor.state = {}
