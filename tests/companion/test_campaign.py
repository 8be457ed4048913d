"""Campaigns: a row depends on its seed alone, is what real MAVLink bytes give, and is kept whole or not at all."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from companion import airframe as airframes
from companion import campaign
from companion.campaign import Batch, Score, Store, crew, rows
from companion.campaign.flight import Spoilt
from companion.cli.montecarlo import Progress
from companion.decision import Policy
from companion.effects import Judged
from companion.errors import UserError
from companion.rehearsal import Rehearsal
from fdi.verdict import NO_FAULT, Phase, Verdict
from sitl.autopilot import Autopilot
from sitl.ensemble import RELEASE_US, Ensemble
from sitl.link import Pipe
from sitl.vehicle import Injected

TOY_PATH = Path(__file__).parents[1] / "toy_airframe"
PARAFOIL_FAULTS = ("none", "motor", "crossed_lines", "broken_line")
LOUD_ROW = ["seed", "flight_s", "fault_id", "onset_s", "value", "first_alarm_s", "detected_s", "isolated_s", "named_id"]
LOUD_ROW += ["confidence", "size", "false_alarm", "phase_at_end", "recovery", "miss_m"]


@pytest.fixture(scope="module")
def toy():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(TOY_PATH)
        yield airframes.load("sled")


@pytest.fixture(scope="module")
def parafoil():
    return airframes.load("parafoil")


@pytest.fixture
def airframe(request, toy, parafoil):
    return {"sled": toy, "parafoil": parafoil}[request.param]


def toy_batch(airframe, first_seed=0, flights=20, duration_s=200.0, link=False):
    return Batch(airframe, first_seed, flights, ("none", "thruster_loss"), duration_s, link)


def settings(airframe, **changes):
    return replace(campaign.settings(airframe, 0, 20, ("none", "thruster_loss"), 200.0, link=False), **changes)


def cell(column, f):
    """One value in a form that compares: NaN as None."""
    value = column[f]
    return None if value is None or value != value else value


def same(columns, f, others, g):
    assert list(columns) == list(others)
    return {name: cell(columns[name], f) for name in columns} == {name: cell(others[name], g) for name in others}


# One row, one seed


@pytest.mark.parametrize("link", [False, True])
@pytest.mark.parametrize("airframe", ["sled", "parafoil"], indirect=True)
def test_a_flight_alone_has_the_row_of_the_same_flight_in_any_batch(airframe, link):
    faults = ("none", "thruster_loss") if airframe.name == "sled" else PARAFOIL_FAULTS
    together = campaign.fly(Batch(airframe, 50, 5, faults, 180.0, link))
    assert len({*together["fault_id"]}) > 1
    assert any(named is not None for named in together["named_id"])
    for f in range(5):
        assert same(campaign.fly(Batch(airframe, 50 + f, 1, faults, 180.0, link)), 0, together, f)
    shifted = campaign.fly(Batch(airframe, 53, 2, faults, 180.0, link))
    assert all(same(shifted, f, together, f + 3) for f in range(2))


@pytest.mark.parametrize(("lost", "late"), [(0.0, 0.0), (0.02, 0.10), (0.2, 0.3)])
@pytest.mark.parametrize("airframe", ["sled", "parafoil"], indirect=True)
def test_rows_behind_a_line_are_those_of_the_real_bytes_behind_it_to_the_bit(airframe, lost, late):
    simulator = airframe.load_simulator()
    vehicle, seeds = simulator.VEHICLE, [3, 4]
    listens = replace(campaign.listener(airframe, vehicle), lost=lost, late=late)

    def fleet(some):
        return simulator.Fleet(airframe.simulator_config(simulator), some, None)

    ensemble = Ensemble(vehicle, fleet(seeds), seeds, campaign.grid(airframe), listens)
    expected = {row.t_us: row for row in ensemble.rows(60.0)}
    for f, seed in enumerate(seeds):
        heard = {}

        def note(effect, heard=heard):
            if isinstance(effect, Judged):
                heard[effect.row.t_us - RELEASE_US] = effect.row

        autopilot = Autopilot(vehicle, fleet([seed]), seed=seed)
        if lost:
            autopilot = Spoilt(vehicle, fleet([seed]), seed=seed)
            autopilot.pipe = Pipe(vehicle, autopilot.fleet.channels, listens, seed)
        Rehearsal(airframe, autopilot, Policy.OFF, observe=note).fly(65.0)
        # From before release on, when its streams have been asked for; on a worse line something is held from before that.
        compared = [t_us for t_us in heard if t_us >= (5_000_000 if lost > 0.02 else -200_000)]
        assert len(compared) == (550 if lost > 0.02 else 602)
        for t_us in compared:
            row = expected[t_us]
            assert np.array_equal(heard[t_us].values[0], row.values[f], equal_nan=True), t_us
            assert np.array_equal(heard[t_us].age_s[0], row.age_s[f], equal_nan=True), t_us


@pytest.mark.parametrize("airframe", ["sled", "parafoil"], indirect=True)
def test_one_seed_through_real_bytes_ends_in_the_row_of_its_batch(airframe):
    faults = ("thruster_loss",) if airframe.name == "sled" else ("motor",)
    batch = Batch(airframe, 21, 1, faults, 160.0, True)
    judged = []
    rehearsed = campaign.rehearse(batch, judged.append)
    row = campaign.fly(batch)
    assert row["named_id"] != [None]
    assert same(rehearsed.columns, 0, row, 0)
    lines = rehearsed.lines
    assert [line["seq"] for line in lines] == list(range(len(lines)))
    assert (lines[0]["kind"], lines[-1]["kind"]) == ("run", "end")
    (detected,) = [line["t"] for line in lines if line["name"] == "detected"][:1]
    assert detected - rehearsed.release_s == pytest.approx(row["detected_s"][0])
    assert rehearsed.onsets == [(rehearsed.onsets[0][0], RELEASE_US / 1e6 + row["onset_s"][0])]


def test_a_vehicle_that_lands_ends_its_row_there_and_is_judged_no_longer(toy):
    table = toy.source.table
    short = table | {"sitl": table["sitl"] | {"rail_length_m": 400.0}}
    airframe = replace(toy, source=replace(toy.source, table=short))
    for link in (False, True):
        columns = campaign.fly(Batch(airframe, 0, 4, ("none",), 200.0, link))
        assert (columns["flight_s"] < 80.0).all()
        assert columns["phase_at_end"] == ["healthy"] * 4
        assert not columns["false_alarm"].any()
    rehearsed = campaign.rehearse(Batch(airframe, 0, 1, ("none",), 200.0, True), lambda _: None)
    assert same(rehearsed.columns, 0, columns, 0)


def test_a_channel_that_no_message_carries_is_refused(toy):
    detector = replace(toy.detector, channels=(*toy.detector.channels, "roll_rad"))
    for link, text in ((False, "does not give the channel roll_rad"), (True, "carries the channel roll_rad")):
        with pytest.raises(ValueError, match=text):
            campaign.prepare(Batch(replace(toy, detector=detector), 0, 1, ("none",), 10.0, link))


def test_the_columns_are_those_of_the_flight_row_then_peaks_then_truths(toy, parafoil):
    class Fleet:
        truths = ("miss_m", "height_m")

    assert [*campaign.fly(toy_batch(toy, flights=1, duration_s=5.0))] == [
        *LOUD_ROW,
        *("peak_speed", "peak_60_speed", "peak_surplus", "peak_60_surplus"),
    ]
    names = campaign.column_names(parafoil.detector, Fleet)
    assert list(names[:15]) == LOUD_ROW
    assert names[15:17] == ("peak_heading_rate", "peak_60_heading_rate")
    assert names[-1] == "end_height_m"


# What a row says


def verdict(detector, phases, faults=None, residuals=math.nan):
    n = len(phases)
    faults = np.array(faults if faults is not None else [NO_FAULT] * n)
    shape = (n, len(detector.residuals))
    return Verdict(
        phase=np.array(phases, dtype=np.int64),
        fault=faults,
        confidence=np.where(faults == NO_FAULT, 0.0, 0.9),
        size=np.where(faults == NO_FAULT, math.nan, 0.4),
        onset_s=np.full(n, math.nan),
        residuals=np.broadcast_to(np.asarray(residuals, dtype=np.float64).reshape(-1, 1), shape).copy(),
        thresholds=np.ones(shape[1]),
        signals=np.zeros((n, 2)),
    )


def scored(detector, onset_s, history):
    """Columns after verdicts on one flight: history is (time s, phase, fault, residual, flying) or the first two."""
    score = Score(detector, np.array([onset_s]))
    for time_s, phase, *rest in history:
        fault, residual, flying = [*rest, *(NO_FAULT, math.nan, True)[len(rest) :]]
        score.note(round(time_s * 1e6), np.array([flying]), verdict(detector, [phase], [fault], [residual]))
    return {name: cell(column, 0) for name, column in score.columns().items()}


def test_an_alarm_in_a_healthy_flight_is_false_and_its_naming_is_kept(parafoil):
    history = [(1.0, Phase.HEALTHY), (2.0, Phase.DETECTED), (3.0, Phase.ISOLATED, 4), (4.0, Phase.HEALTHY)]
    row = scored(parafoil.detector, math.inf, history)
    assert (row["first_alarm_s"], row["detected_s"], row["false_alarm"]) == (2.0, None, True)
    assert (row["isolated_s"], row["named_id"], row["confidence"], row["size"]) == (3.0, "crossed_lines", 0.9, 0.4)
    assert row["phase_at_end"] == "healthy"


def test_an_alarm_before_the_onset_is_false_and_the_next_one_is_the_detection(parafoil):
    history = [(1.0, Phase.DETECTED), (2.0, Phase.ISOLATED, 0), (3.0, Phase.HEALTHY), (10.0, Phase.HEALTHY)]
    history += [(12.0, Phase.INCONCLUSIVE), (13.0, Phase.DETECTED), (14.0, Phase.ISOLATED, 2), (15.0, Phase.ISOLATED, 3)]
    row = scored(parafoil.detector, 10.0, history)
    assert (row["first_alarm_s"], row["detected_s"], row["false_alarm"]) == (1.0, 12.0, True)
    assert (row["isolated_s"], row["named_id"], row["phase_at_end"]) == (14.0, "broken_line:left", "isolated")


def test_an_alarm_at_the_onset_counts_as_detected_and_one_that_stands_counts_from_there(parafoil):
    row = scored(parafoil.detector, 10.0, [(9.9, Phase.HEALTHY), (10.0, Phase.DETECTED)])
    assert (row["detected_s"], row["false_alarm"]) == (10.0, False)
    row = scored(parafoil.detector, 10.0, [(9.9, Phase.ISOLATED, 1), (10.0, Phase.ISOLATED, 1)])
    assert (row["detected_s"], row["isolated_s"], row["false_alarm"]) == (10.0, 10.0, True)


def test_nothing_happened_leaves_nothing(parafoil):
    row = scored(parafoil.detector, 10.0, [(1.0, Phase.WARMING), (2.0, Phase.HEALTHY), (20.0, Phase.HEALTHY)])
    assert {name for name, value in row.items() if value is not None} == {"false_alarm", "phase_at_end"}
    assert row["false_alarm"] is np.False_


def test_peaks_are_the_largest_before_the_onset_and_in_the_60_seconds_from_it_on(parafoil):
    history = [(t_s, Phase.HEALTHY, NO_FAULT, value) for t_s, value in (
        (1.0, math.nan), (2.0, 0.3), (3.0, 0.2), (9.9, math.nan),
        (10.0, 0.5), (70.0, 0.7), (70.1, 9.0),
    )]  # fmt: skip
    row = scored(parafoil.detector, 10.0, history)
    assert {row[f"peak_{name}"] for name in parafoil.detector.residuals} == {0.3}
    assert {row[f"peak_60_{name}"] for name in parafoil.detector.residuals} == {0.7}
    healthy = scored(parafoil.detector, math.inf, history)
    assert (healthy["peak_motor_1"], healthy["peak_60_motor_1"]) == (9.0, None)
    assert scored(parafoil.detector, 10.0, history[:1])["peak_motor_1"] is None


def test_what_is_said_of_a_flight_that_does_not_fly_is_passed_over(parafoil):
    history = [(1.0, Phase.HEALTHY, NO_FAULT, 0.1), (2.0, Phase.ISOLATED, 1, 5.0, False)]
    row = scored(parafoil.detector, math.inf, history)
    assert (row["first_alarm_s"], row["phase_at_end"], row["peak_motor_1"]) == (None, "healthy", 0.1)


class Told:
    """A fleet that tells what it drew, and truths."""

    truths = ("miss_m", "height_m")

    def injected(self, flight):
        return (Injected("motor:left/stuck", 7.0, 0.25),)

    def truth(self, name):
        return {"miss_m": np.array([5.0, 6.0]), "height_m": np.array([0.0, 80.0])}[name]


def test_the_fault_is_told_as_drawn_where_the_fleet_tells_and_else_as_it_was_asked_for():
    asked = [Injected("motor:left", 7.0), None]
    columns = rows.injected(Told(), asked)
    assert (columns["fault_id"], cell(columns["value"], 0)) == (["motor:left/stuck", "none"], 0.25)
    columns = rows.injected(object(), asked)
    assert columns["fault_id"] == ["motor:left", "none"]
    assert [cell(columns["onset_s"], f) for f in (0, 1)] == [7.0, None]
    assert cell(columns["value"], 0) is None


def test_the_miss_distance_is_known_of_flights_that_are_down_and_other_truths_of_all():
    columns = rows.truths(Told(), np.array([True, False]))
    assert [cell(columns["miss_m"], f) for f in (0, 1)] == [5.0, None]
    assert columns["end_height_m"].tolist() == [0.0, 80.0]
    assert [*rows.truths(object(), np.array([True]))] == ["miss_m"]


# What is kept


def test_batches_are_joined_by_seed_with_the_settings_and_the_parts_go(toy, tmp_path):
    wanted = settings(toy)
    with_all = campaign.fly(toy_batch(toy))
    store = Store(tmp_path, wanted)
    for first in (12, 0, 4):
        store.keep(campaign.fly(toy_batch(toy, first, 8 if first else 4)))
    assert store.missing == []
    path = store.join()
    store.close()
    assert [file.name for file in tmp_path.iterdir()] == ["flights.parquet"]
    kept = parquet.read_table(path)
    assert kept.equals(campaign.table(with_all))
    assert kept.schema.field("recovery").type == pyarrow.string()
    metadata = {name.decode(): value.decode() for name, value in parquet.read_schema(path).metadata.items()}
    expected = {"airframe": "sled", "first_seed": "0", "flights": "20", "faults": "none,thruster_loss", "link": "false"}
    assert expected.items() <= metadata.items()
    assert (metadata["config_sha256"], metadata["duration_s"]) == (toy.source.digest, "200.0")
    assert campaign.kept_settings(path) == wanted


def test_what_is_missing_is_what_no_part_holds(toy, tmp_path):
    store = Store(tmp_path, settings(toy, flights=30))
    assert store.missing == [range(30)]
    store.keep(campaign.fly(toy_batch(toy, 5, 5, duration_s=2.0)))
    store.keep(campaign.fly(toy_batch(toy, 20, 5, duration_s=2.0)))
    assert store.missing == [range(5), range(10, 20), range(25, 30)]
    store.close()


@pytest.mark.parametrize("where", ["parts", "joined"])
def test_another_campaign_in_the_same_folder_is_refused_with_what_differs(toy, tmp_path, where):
    store = Store(tmp_path, settings(toy))
    store.keep(campaign.fly(toy_batch(toy, duration_s=2.0)))
    if where == "joined":
        store.join()
    store.close()
    changes = {
        "first_seed": 1,
        "flights": 21,
        "faults": ("none",),
        "detector": "x",
        "link": True,
        "duration_s": 9.0,
        "version": "9",
    }
    for name, value in changes.items():
        with pytest.raises(UserError, match=f"flown with other settings: {name} .* \\(now .*give the same ones or another"):
            Store(tmp_path, settings(toy, **{name: value}))
    Store(tmp_path, settings(toy)).close()


def test_a_folder_in_use_is_refused(toy, tmp_path):
    store = Store(tmp_path, settings(toy))
    with pytest.raises(UserError, match="another campaign is writing here"):
        Store(tmp_path, settings(toy))
    store.close()
    Store(tmp_path, settings(toy)).close()


def test_a_table_that_is_none_of_ours_is_refused(toy, tmp_path):
    path = tmp_path / "flights.parquet"
    parquet.write_table(pyarrow.table({"seed": [1]}), path)
    with pytest.raises(UserError, match="not a table of flights"):
        Store(tmp_path, settings(toy))
    path.write_bytes(b"no Parquet at all")
    with pytest.raises(UserError, match="not a table of flights"):
        Store(tmp_path, settings(toy))
    path.unlink()
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(UserError, match="cannot write here"):
        Store(blocked, settings(toy))


def test_a_part_that_was_cut_short_is_no_part(toy, tmp_path, monkeypatch):
    store = Store(tmp_path, settings(toy))

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("companion.campaign.store.os.fsync", fail)
    with pytest.raises(UserError, match="cannot be written: No space left"):
        store.keep(campaign.fly(toy_batch(toy, duration_s=2.0)))
    assert store.missing == [range(20)]
    store.close()
    assert [*(tmp_path / "parts").iterdir()]  # what was cut short lies there,
    Store(tmp_path, settings(toy)).close()
    assert not [*(tmp_path / "parts").iterdir()]  # until the next run


# Who flies


@pytest.mark.parametrize(("flights", "workers"), [(1, 2), (7, 2), (600, 2), (1100, 2), (3000, 4), (500, 1), (501, 1)])
def test_batches_hold_every_missing_seed_once_and_keep_all_workers_busy(toy, flights, workers):
    missing = [range(10, 10 + flights), range(9000, 9003)]
    work = campaign.batches(toy, settings(toy), missing, workers)
    assert sorted(seed for batch in work for seed in batch.seeds) == sorted(seed for run in missing for seed in run)
    sizes = [batch.flights for batch in work]
    assert max(sizes) <= crew.BATCH
    rounds = math.ceil((flights + 3) / (crew.BATCH * workers))
    assert max(sizes) <= math.ceil((flights + 3) / (rounds * workers))


def test_a_detector_that_the_configuration_does_not_know_is_refused(parafoil, toy):
    again = campaign.with_detector(parafoil, parafoil.monitor_config.detector)
    assert again.monitor_config == parafoil.monitor_config
    assert campaign.with_detector(parafoil, "paper").monitor_config.detector == "paper"
    with pytest.raises(UserError, match=r"--detector moon.*detector = 'moon' is unknown; give one of paper"):
        campaign.with_detector(parafoil, "moon")
    with pytest.raises(UserError, match=r"--detector paper: unknown key monitor.detector"):
        campaign.with_detector(toy, "paper")


def test_workers_of_a_cluster_give_the_same_rows(toy):
    distributed = pytest.importorskip("distributed", reason="needs dask.distributed: pip install 'mavfdi[cluster]'")
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with distributed.LocalCluster(protocol="tcp", host="127.0.0.1", **options) as local:
        cluster = campaign.Cluster(local.scheduler_address)
        assert cluster.workers == 2
        work = campaign.batches(toy, settings(toy), [range(20)], cluster.workers)
        flown = [columns for columns in cluster.flown(work) if columns is not None]
        cluster.close()
    assert len(flown) == len(work) == 2
    tables = sorted((campaign.table(columns) for columns in flown), key=lambda table: table["seed"][0].as_py())
    assert pyarrow.concat_tables(tables).equals(campaign.table(campaign.fly(toy_batch(toy))))


def test_a_cluster_that_does_not_answer_is_one_line():
    pytest.importorskip("distributed", reason="needs dask.distributed: pip install 'mavfdi[cluster]'")
    with pytest.raises(UserError, match=r"--cluster nonsense://here: no scheduler answers"):
        campaign.Cluster("nonsense://here")


class Terminal:
    def __init__(self, is_terminal):
        self.is_terminal, self.text = is_terminal, ""

    def isatty(self):
        return self.is_terminal

    def write(self, text):
        self.text += text

    def flush(self):
        pass


def test_progress_tells_rate_and_remaining_time_on_a_terminal_and_nothing_elsewhere(monkeypatch):
    now_s = [100.0]
    monkeypatch.setattr("companion.cli.montecarlo.time.monotonic", lambda: now_s[0])
    screen, pipe = Terminal(True), Terminal(False)
    monkeypatch.setattr("sys.stderr", screen)
    progress = Progress(1000, 100)
    progress.show()
    assert "100/1000 flights, 0 s, first batches" in screen.text
    now_s[0], progress.flown = 110.0, 200
    progress.show()
    assert "300/1000 flights, 10 s, 20/s, 35 s left" in screen.text
    assert progress.told() == "in 10 s, 20/s (100 of them flown before)"
    monkeypatch.setattr("sys.stderr", pipe)
    progress.show()
    progress.clear()
    assert pipe.text == ""
