"""The design tool gives what is packaged; flights are counted as the paper counts; the tables come by one command."""

import contextlib
import importlib.util
import math
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

import fdi.parafoil as parafoil
import parafoil_design
import parafoil_figures
import parafoil_flights
import parafoil_tables
from companion import airframe as airframes
from companion import campaign
from companion.errors import UserError
from fdi.verdict import Phase
from intervals import wilson
from parafoil_design import (
    Entry,
    Sample,
    design_of_paper,
    edited,
    entries_of_ours,
    entries_of_paper,
    line_maxima,
    measures,
    tail_of,
)
from parafoil_flights import KINDS, Flights, Named, Watch, fly, namings, outcome, together

TOOLS = Path(__file__).parents[2] / "tools"
PACKAGED = parafoil_tables.CONFIG.read_text()


def tool(name):
    spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_packaged_observer_is_that_of_the_plants_linear_model(config):
    design = tool("design_parafoil").design()
    assert design.dynamics == pytest.approx(np.array(config.lateral_model.dynamics), abs=2e-8)
    assert design.input == pytest.approx(np.array(config.lateral_model.input), abs=2e-8)
    assert design.output == pytest.approx(np.array(config.lateral_model.output), abs=2e-8)
    assert design.gain == pytest.approx(np.array(config.observer.gain), abs=2e-7)
    assert design.transition == pytest.approx(np.array(config.observer.transition), abs=2e-8)
    assert design.held_input == pytest.approx(np.array(config.observer.input), abs=2e-8)
    assert design.held_feedback == pytest.approx(np.array(config.observer.feedback), abs=2e-8)


def test_wilson_intervals_have_their_published_values():
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)  # Newcombe (1998), table I, method 3


# -- flights ------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def papers_airframe():
    return campaign.with_detector(airframes.load("parafoil"), "paper")


def kept(columns):
    """As they come back from the file."""
    return Flights(
        {name: np.asarray(column, dtype=object if isinstance(column, list) else None) for name, column in columns.items()}
    )


def test_crossed_lines_of_the_simulated_vehicle_are_detected_and_named(papers_airframe, config):
    flights = kept(fly(campaign.Batch(papers_airframe, 40_000_000, 12, ("crossed_lines",), 600.0, True)))
    seen = outcome(flights, by_papers_rule=True)
    assert seen.detected.sum() >= 11
    assert seen.right.sum() >= 10
    assert np.nanmedian(seen.detected_s) < 10.0
    assert np.all(seen.isolated_s[seen.right] >= seen.detected_s[seen.right])
    above = flights.numbers("peak_60_heading_rate") > config.paper.thresholds.heading_rate_rad2_s2
    assert np.array_equal(seen.detected, above)  # the paper's rule: any sample of the 60 s


def test_a_watched_flight_has_the_rows_of_the_campaign_until_its_onset_and_more(papers_airframe):
    batch = campaign.Batch(papers_airframe, 41_000_000, 4, ("broken_line",), 150.0, False)
    watched, plain = fly(batch), campaign.fly(batch)
    for name in (
        "seed",
        "flight_s",
        "fault_id",
        "onset_s",
        "first_alarm_s",
        "false_alarm",
        "peak_heading_rate",
        "peak_60_heading_rate",
    ):
        assert np.array_equal(
            np.asarray(watched[name]), np.asarray(plain[name]), equal_nan=not isinstance(plain[name], list)
        )
    assert set(watched) - set(plain) >= {"limit_id", "inconclusive_s", "peak_named_motor_1", "peak_90_crossed"}


class TestWatch:
    """A monitor whose isolation is set by hand, one flight with its onset at 100 s."""

    @pytest.fixture
    def watched(self, config):
        monitor = parafoil.Parafoil(replace(config, detector="paper"), 1)
        return monitor, Watch(monitor, np.array([100.0]))

    def row(self, watched, t_s, phase, fault=-1, maxima=(0.0, 0.0, 0.0), residuals=(0.0,) * 6, flying=True):
        monitor, watch = watched
        watch.begin(t_s, np.array([flying]))
        monitor.isolation.phase[0], monitor.isolation.fault[0] = phase, fault
        monitor.isolation.maxima[:, 0] = maxima
        watch.note(t_s, np.array([residuals]))
        return {
            name: column[0] if isinstance(column, list) else column[0].item() for name, column in watch.columns().items()
        }

    def test_a_verdict_that_stands_at_the_onset_is_taken_back(self, watched):
        monitor, watch = watched
        before = self.row(watched, 99.9, Phase.ISOLATED, fault=2, maxima=(0.0, 1.0, 1.0))
        assert (before["before_id"], before["before_way"], before["since_id"]) == ("broken_line:left", "elimination", None)
        watch.begin(100.0, np.array([True]))
        assert monitor.isolation.phase[0] == Phase.HEALTHY
        after = self.row(watched, 130.0, Phase.ISOLATED, fault=1)
        assert (after["since_id"], after["since_way"], after["before_id"]) == ("motor:right", "motor", "broken_line:left")

    def test_what_is_only_detected_after_ninety_seconds_is_named_by_size(self, watched):
        self.row(watched, 100.0, Phase.HEALTHY)
        assert self.row(watched, 189.9, Phase.DETECTED, maxima=(0.2, 0.10, 0.05))["limit_id"] is None
        end = self.row(watched, 190.0, Phase.DETECTED, maxima=(0.2, 0.10, 0.05))  # over its threshold; 0.67 and 0.19 of it
        assert (end["limit_id"], end["limit_s"]) == ("crossed_lines", 190.0)

    def test_touchdown_ends_the_isolation_before_the_monitor_forgets(self, watched):
        self.row(watched, 100.0, Phase.HEALTHY)
        self.row(watched, 120.0, Phase.DETECTED, maxima=(0.01, 0.1, 0.2))
        end = self.row(watched, 120.1, Phase.HEALTHY, flying=False)
        assert (end["limit_id"], end["limit_s"]) == ("broken_line:left", 120.1)

    def test_nothing_is_named_by_size_that_was_ruled_out_or_named(self, watched):
        self.row(watched, 110.0, Phase.DETECTED)
        self.row(watched, 120.0, Phase.INCONCLUSIVE, maxima=(1.0, 1.0, 1.0))
        end = self.row(watched, 190.0, Phase.INCONCLUSIVE, maxima=(1.0, 1.0, 1.0))
        assert (end["inconclusive_s"], end["limit_id"]) == (120.0, None)

    def test_motors_are_looked_at_for_five_seconds_from_detection_lines_for_ninety_from_the_onset(self, watched):
        self.row(watched, 99.9, Phase.HEALTHY, residuals=(0.0, 9.0, 9.0, 9.0, 9.0, 9.0))
        self.row(watched, 100.0, Phase.HEALTHY, residuals=(0.0, 8.0, 8.0, 0.1, 0.2, 0.3))
        self.row(watched, 110.0, Phase.DETECTED, residuals=(0.0, 0.5, 0.6, 0.2, math.nan, 0.1))
        self.row(watched, 115.0, Phase.DETECTED, residuals=(0.0, 0.4, 0.7, 0.1, 0.1, 0.1))
        self.row(watched, 115.1, Phase.DETECTED, residuals=(0.0, 7.0, 7.0, 0.1, 0.1, 0.1))
        end = self.row(watched, 190.1, Phase.DETECTED, residuals=(0.0, 7.0, 7.0, 7.0, 7.0, 7.0))
        assert (end["peak_named_motor_1"], end["peak_named_motor_2"]) == (0.5, 0.7)
        assert (end["peak_90_broken_left"], end["peak_90_broken_right"], end["peak_90_crossed"]) == (0.2, 0.2, 0.3)


def flight(**columns):
    """One flight with a broken left line at 100 s, nothing detected but for what is given."""
    row = {
        "seed": 1, "flight_s": 600.0, "fault_id": "broken_line:left", "onset_s": 100.0, "detected_s": math.nan,
        "isolated_s": math.nan, "named_id": None, "false_alarm": False, "inconclusive_s": math.nan, "limit_s": math.nan,
        "limit_id": None, "before_id": None, "before_way": None, "since_id": None, "since_way": None,
    }  # fmt: skip
    assert columns.keys() <= row.keys()
    return kept(
        {
            name: [value] if value is None or isinstance(value, str) else np.array([value])
            for name, value in (row | columns).items()
        }
    )


@pytest.mark.parametrize(
    ("columns", "by_papers_rule", "expected"),
    [
        # detected, right, wrong, inconclusive
        ({"detected_s": 160.0, "isolated_s": 190.0, "named_id": "broken_line:left"}, True, (1, 1, 0, 0)),
        ({"detected_s": 160.1, "isolated_s": 170.0, "named_id": "broken_line:left"}, True, (0, 0, 0, 0)),
        ({"detected_s": 110.0, "isolated_s": 120.0, "named_id": "broken_line:right"}, True, (1, 0, 1, 0)),
        (
            {"detected_s": 110.0, "isolated_s": 120.0, "named_id": "broken_line:left", "false_alarm": True},
            True,
            (1, 1, 0, 0),
        ),
        (
            {"detected_s": 110.0, "isolated_s": 120.0, "named_id": "broken_line:left", "false_alarm": True},
            False,
            (0, 0, 0, 0),
        ),
        ({"detected_s": 110.0, "limit_s": 190.0, "limit_id": "broken_line:left"}, True, (1, 1, 0, 0)),
        ({"detected_s": 110.0, "limit_s": 190.0, "limit_id": "crossed_lines"}, True, (1, 0, 1, 0)),
        ({"detected_s": 170.0, "limit_s": 190.0, "limit_id": "broken_line:left"}, True, (0, 0, 0, 0)),
        ({"detected_s": 110.0, "isolated_s": 190.1, "named_id": "broken_line:left"}, False, (1, 0, 0, 1)),
        (
            {"detected_s": 110.0, "inconclusive_s": 130.0, "isolated_s": 180.0, "named_id": "broken_line:left"},
            True,
            (1, 0, 0, 1),
        ),
        (
            {"detected_s": 110.0, "inconclusive_s": 189.0, "isolated_s": 130.0, "named_id": "broken_line:left"},
            True,
            (1, 1, 0, 0),
        ),
        ({}, True, (0, 0, 0, 0)),
    ],
)
def test_flights_are_counted_by_the_rules(columns, by_papers_rule, expected):
    seen = outcome(flight(**columns), by_papers_rule)
    assert (seen.detected.sum(), seen.right.sum(), seen.wrong.sum(), seen.inconclusive.sum()) == expected
    if seen.right.any() or seen.wrong.any():
        assert seen.isolated_s[0] == columns.get("isolated_s", columns.get("limit_s")) - 100.0
    else:
        assert np.isnan(seen.isolated_s[0])


def test_a_name_given_before_the_onset_or_in_a_healthy_flight_is_wrong():
    left = "broken_line:left"
    flights = together(
        [
            flight(since_id=left, since_way="elimination"),
            flight(since_id="broken_line:right", since_way="elimination"),
            flight(before_id=left, before_way="elimination", since_id=left, since_way="size"),
            flight(fault_id="none", onset_s=math.nan, before_id="motor:left", before_way="motor"),
        ]
    )
    assert [named for named in namings(flights) if named.count] == [
        Named("motor", "motor", 0, 1),
        Named("elimination", "broken_line", 1, 3),
        Named("size", "broken_line", 1, 1),
    ]


def test_a_fault_after_touchdown_is_none(tmp_path):
    from pyarrow import parquet

    rows = together(
        [flight(onset_s=580.0, flight_s=570.0), flight(seed=2), flight(seed=3, fault_id="none", onset_s=math.nan)]
    )
    columns = {name: list(column) if column.dtype == object else column for name, column in rows.columns.items()}
    parquet.write_table(campaign.table(columns), tmp_path / "flights.parquet")
    assert parafoil_flights.read(tmp_path / "flights.parquet").numbers("seed").tolist() == [2.0, 3.0]


# -- configuration ------------------------------------------------------------------------------------------------------


def test_an_edited_value_leaves_everything_else_in_its_place():
    text = '[a]\nx = 1.0 # m\n[a.b]           # why\nx = 2.0         # s\ny = "one # two" # text\nlist = [1, 2]\n'
    assert edited(text, [Entry("a.b", "x", "31.25")]) == text.replace("x = 2.0         # s", "x = 31.25       # s")
    assert edited(text, [Entry("a.b", "y", '"a much longer one"')]) == text.replace('"one # two"', '"a much longer one"')
    assert edited(text, [Entry("a", "x", "2", "km")]) == text.replace("x = 1.0 # m", "x = 2   # km")
    for entry in (Entry("a.b", "z", "1"), Entry("c", "x", "1"), Entry("a.b", "list", "[]")):
        with pytest.raises(KeyError):
            edited(text, [entry])


@pytest.mark.parametrize(
    "words",
    [
        ["--seed-design", "900000000"],  # a judging seed
        ["--seed-design", "95000000"],  # the last kind's would not be design seeds
        ["--seed-design", "-1"],
        ["--seed-design", "1", "--judge", "10"],  # judged by what?
        ["--seed-design", "1", "--judge", "10", "--seed-judge", "2000000"],  # a design seed
        ["--seed-design", "1", "--faults", "0"],
        ["--seed-design", "1", "--duration", "nan"],
    ],
)
def test_seeds_of_design_and_judgement_do_not_meet(words, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        parafoil_tables.parse([*words, "--out", str(tmp_path)])
    assert stopped.value.code == 2
    assert words[-2].lstrip("-") in capsys.readouterr().err


# -- all of it ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """All detectors designed and judged on a few short flights; (folder, page, packaged file as written)."""
    folder = tmp_path_factory.mktemp("tables")
    (folder / "parafoil.toml").write_text(PACKAGED)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(parafoil_tables, "JUDGING_SEEDS_BEGIN", 33_000_000)  # the judging seeds stay closed
        patch.setattr(parafoil_tables, "CONFIG", folder / "parafoil.toml")
        words = (
            "--design 20 --judge 20 --faults 6 --seed-design 32000000 --seed-judge 33000000 --detector all --duration 130"
        )
        with (folder / "printed").open("w") as printed, contextlib.redirect_stdout(printed):
            assert parafoil_tables.main([*words.split(), "--write", "record", "--out", str(folder)]) == 0
    return folder


def test_one_command_gives_tables_and_figures(small):
    page = (small / "tables.md").read_text()
    assert page == (small / "printed").read_text()
    for part in ("Table 1", "Table 2", "Table 3", "Table 4", "figures 12 and 13", "Ours, gps", "Ours, gyro", "(0.0574)"):
        assert part in page
    assert page.count("| measure | value | bar |") == 3  # of each detector
    figures = sorted(path.name for path in small.glob("figure_*.png"))
    assert figures == [f"figure_{n:02}.png" for n in (6, 7, 8, 10, 12, 13, 15, 16, 17, 18)]


def test_the_record_is_written_and_nothing_else_changes(small):
    before, after = tomllib.loads(PACKAGED), tomllib.loads((small / "parafoil.toml").read_text())
    msgspec.convert(after["monitor"], parafoil.Config)
    monitor = after["monitor"]
    for design in (monitor["paper"]["design"], monitor["turns"]["gps"]["design"], monitor["turns"]["gyro"]["design"]):
        assert (design["first_seed"], design["healthy_flights"]) == (32_000_000, 20)
        assert "--seed-design 32000000" in design["command"]
    assert monitor["paper"]["design"]["fault_flights"] == 24
    for table in (before, after):
        for of in (table["monitor"]["paper"], table["monitor"]["turns"]["gps"], table["monitor"]["turns"]["gyro"]):
            del of["design"]
        del table["monitor"]["paper"]["confidence"], table["monitor"]["paper"]["delays"]
    assert after == before


def test_nothing_is_flown_twice(small, monkeypatch, papers_airframe):
    def refuse(batch):
        raise AssertionError("flown again")

    monkeypatch.setattr(parafoil_flights, "fly", refuse)
    again = parafoil_flights.Campaign(small, 1, False, 130.0)
    assert again.gather(papers_airframe, KINDS[1], 32_000_000, 6).count == 6
    with pytest.raises(AssertionError, match="flown again"):
        again.gather(papers_airframe, KINDS[1], 32_000_000, 7)


def test_found_thresholds_are_written_with_what_they_cost(small, config, papers_airframe):
    again = parafoil_flights.Campaign(small, 1, False, 130.0)
    kinds = {kind: 20 if kind.name == "healthy" else 6 for kind in KINDS}
    sample = parafoil_tables.gather(airframes.load("parafoil"), "paper", again, 32_000_000, kinds, "few")
    found = design_of_paper(sample)
    entries = entries_of_paper(sample, found, config, "a command", 32_000_000, thresholds=True)
    limits = tomllib.loads(edited(PACKAGED, entries))["monitor"]["paper"]["thresholds"]
    best = found.heading_rate[parafoil_design.EQUAL]
    assert limits["heading_rate_rad2_s2"] == pytest.approx(best.threshold, abs=5e-5)
    written = tomllib.loads(edited(PACKAGED, entries))["monitor"]["paper"]
    assert written["design"]["false_alarms_per_flight"] == pytest.approx(best.false_alarms, abs=5e-5)
    assert written["confidence"] == tomllib.loads(PACKAGED)["monitor"]["paper"]["confidence"]  # not yet flown with these
    ours = parafoil_tables.gather(airframes.load("parafoil"), "gyro", again, 32_000_000, {KINDS[0]: 20}, "few")
    tail = tail_of(ours, config)
    turns = tomllib.loads(edited(PACKAGED, entries_of_ours(ours, tail, "it", 1, thresholds=True)))["monitor"]["turns"]
    assert turns["gyro"]["threshold"] == pytest.approx(tail.threshold, abs=5e-3)
    assert turns["gps"] == tomllib.loads(PACKAGED)["monitor"]["turns"]["gps"]


def test_the_mixture_weighs_every_kind_alike():
    detected = {"detected_s": 110.0, "isolated_s": 110.0, "named_id": "broken_line:left"}
    faulty = {
        name: flight(**(detected if name == "broken" else {})) for name in ("stuck", "saturation", "broken", "crossed")
    }
    values = measures(Sample("paper", "", flight(fault_id="none", onset_s=math.nan), faulty))
    assert values["mixture P(MD)"] == 0.75
    assert values["FOM"] == pytest.approx(1.0 - 0.5 * 0.75)
    assert values["P(DET) broken"] == values["P(ISO) broken"] == 1.0


def test_a_broken_lines_own_residual_is_that_of_its_side():
    def peaks(one, left, right, crossed):
        return Flights(
            one.columns
            | {
                "peak_90_broken_left": np.array([left]),
                "peak_90_broken_right": np.array([right]),
                "peak_90_crossed": np.array([crossed]),
            }
        )

    broken = together([peaks(flight(), 0.1, 0.5, 0.3), peaks(flight(fault_id="broken_line:right"), 0.6, 0.2, 0.4)])
    crossed = peaks(flight(fault_id="crossed_lines"), 0.7, 0.8, 0.05)
    of_broken, of_crossed = line_maxima(Sample("paper", "", flight(), {"broken": broken, "crossed": crossed}))
    assert [each.tolist() for each in of_broken] == [[0.1, 0.2], [0.5, 0.6], [0.7, 0.8]]
    assert [each.tolist() for each in of_crossed] == [[0.05], [0.3, 0.4]]


def test_confidence_is_of_as_many_flights_of_every_kind():
    healthy = together([flight(seed=seed, fault_id="none", onset_s=math.nan) for seed in range(3)])
    faulty = {name: together([flight(seed=10), flight(seed=11)]) for name in ("stuck", "saturation", "broken", "crossed")}
    assert Sample("paper", "", healthy, faulty).even.numbers("seed").tolist() == [0.0, 1.0, *[10.0, 11.0] * 4]


def test_examples_that_end_badly_are_not_shown(papers_airframe, monkeypatch):
    monkeypatch.setattr(parafoil_figures, "SEEDS_AN_EXAMPLE", 1)
    monkeypatch.setattr(parafoil_figures, "SHOWN_S", 1.0)  # nothing is detected so soon
    with pytest.raises(ValueError, match="named rightly"):
        parafoil_figures.fly_examples(papers_airframe, 44_000_000)


def test_a_folder_that_cannot_be_written_is_a_users_mistake(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    words = ["--design", "1", "--faults", "1", "--seed-design", "1", "--out", str(tmp_path / "file")]
    assert parafoil_tables.main(words) == 2
    assert "cannot write" in capsys.readouterr().err
    with pytest.raises(UserError):
        parafoil_tables.run(parafoil_tables.parse(words))
