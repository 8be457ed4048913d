"""The owner's file over the packaged one, and every mistake in it told in one line that names file and key."""

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from companion import configuration
from companion.configuration import Configuration, Grid
from companion.errors import UserError

PACKAGED = (Path(__file__).parents[2] / "configs" / "parafoil.toml").read_text(encoding="utf-8")
AS_PACKAGED = tomllib.loads(PACKAGED)


@dataclass(frozen=True)
class Inner:
    length_m: float
    mode: Literal["plain", "fancy"] = "plain"


@dataclass(frozen=True)
class Outer:
    inner: Inner
    many: dict[str, Inner] = field(default_factory=dict)
    name: str = ""

    def __post_init__(self):
        if self.name == "bad":
            raise ValueError("name = 'bad' is bad")


@pytest.fixture
def read(tmp_path):
    """Parse the packaged text with an owner's text over it."""

    def read_one(owners=None):
        if owners is None:
            return configuration.read(PACKAGED, "configs/parafoil.toml", None)
        path = tmp_path / "mine.toml"
        path.write_text(owners)
        return configuration.read(PACKAGED, "configs/parafoil.toml", path)

    return read_one


def sitl(source):
    """What a small record of our own takes of the table."""
    return {key: value for key, value in source.table["sitl"].items() if key in ("inner", "many", "name")}


def complaint(source, table=None, record=Configuration, path=""):
    """The one line in which a configuration is refused."""
    with pytest.raises(UserError) as told:
        configuration.convert(source, source.table if table is None else table, record, path)
    line = str(told.value)
    assert len(line.splitlines()) == 1
    return line


def test_the_packaged_file_alone_makes_a_configuration(read):
    parsed = configuration.convert(read(), read().table, Configuration)
    assert parsed.grid.period_us == 100_000
    assert parsed.streams == AS_PACKAGED["streams"]
    assert parsed.recovery["crossed_lines"].must_agree[0] == ("SERVO1_MIN", "SERVO2_MIN")
    assert parsed.monitor == AS_PACKAGED["monitor"]


def test_the_owners_file_changes_what_it_names_and_nothing_else(read):
    source = read("[grid]\nrate_hz = 20.0\n[streams]\nVFR_HUD = 5.0\n[grid.maximal_ages_s]\nyaw_rad = 0.5\n")
    parsed = configuration.convert(source, source.table, Configuration)
    packaged = AS_PACKAGED["grid"]
    assert parsed.grid == Grid(20.0, packaged["maximal_age_s"], {**packaged["maximal_ages_s"], "yaw_rad": 0.5})
    assert parsed.streams == {**AS_PACKAGED["streams"], "VFR_HUD": 5.0}
    assert parsed.decision == configuration.convert(read(), read().table, Configuration).decision


def test_a_list_of_the_owner_replaces_the_packaged_one(read):
    source = read("[recovery.crossed_lines]\nmust_agree = []\n")
    assert configuration.convert(source, source.table, Configuration).recovery["crossed_lines"].must_agree == ()


def test_every_value_knows_the_file_it_comes_from(read):
    source = read("[grid]\nrate_hz = 20.0\n")
    origins = {name: file.rpartition("/")[2] for name, file in source.origins.items()}
    assert origins["grid.rate_hz"] == "mine.toml"
    assert origins["grid.maximal_age_s"] == "parafoil.toml"
    assert set(origins) == {path for path, _ in configuration.leaves(source.table)}


def test_equal_configurations_have_equal_digests_and_others_have_not(read):
    assert read("# nothing\n").digest == read().digest == read("[grid]\nrate_hz = 10.0\n").digest
    assert read("[grid]\nrate_hz = 10.5\n").digest != read().digest


@pytest.mark.parametrize(
    ("owners", "key"),
    [
        ("colour = 1", "colour"),
        ("[grid]\nrate = 10.0", "grid.rate"),
        ("[decision]\nholds = 3.0", "decision.holds"),
        ("[recovery.crossed_lines]\nretries = 3", "recovery.crossed_lines.retries"),
        ("[wings]\nspan_m = 3.0", "wings"),
    ],
)
def test_an_unknown_key_is_refused_with_what_is_known_there(read, owners, key):
    line = complaint(read(owners))
    assert "mine.toml: " in line
    assert "parafoil.toml" not in line
    assert f"unknown key {key}; known here: " in line


@pytest.mark.parametrize(
    ("owners", "key", "what"),
    [
        ('[grid]\nrate_hz = "fast"', "grid.rate_hz", "Expected `float`, got `str`"),
        ("[grid]\nrate_hz = true", "grid.rate_hz", "Expected `float`, got `bool`"),
        ('[grid.maximal_ages_s]\narmed = "long"', "grid.maximal_ages_s.armed", "Expected `float`, got `str`"),
        ('[streams]\nWIND = "often"', "streams.WIND", "Expected `float`, got `str`"),
        ("[recovery.crossed_lines]\ntries = 3.5", "recovery.crossed_lines.tries", "Expected `int`, got `float`"),
        ('[recovery.crossed_lines]\naction = "pray"', "recovery.crossed_lines.action", "Invalid enum value 'pray'"),
        ('[recovery.crossed_lines]\nparameters = ["A"]', "recovery.crossed_lines.parameters", "length 2, got 1"),
    ],
)
def test_a_wrong_type_is_refused_with_file_and_key(read, owners, key, what):
    line = complaint(read(owners))
    assert line.rpartition("/")[2].startswith(f"mine.toml: {key}: ")
    assert what in line


@pytest.mark.parametrize(
    ("owners", "key", "what"),
    [
        ("[grid]\nrate_hz = 0.5", "grid", "rate_hz = 0.5 is no rate of a grid; give 1 to 100"),
        ("[grid]\nmaximal_age_s = 0.0", "grid", "maximal_age_s = 0.0 is no age"),
        ("[grid.maximal_ages_s]\narmed = 61.0", "grid", "armed = 61.0 is no age"),
        ("[streams]\nWIND = 0.0", "configuration", "streams.WIND = 0.0 is no rate"),
        ("[streams]\nWIND = 201.0", "configuration", "streams.WIND = 201.0 is no rate"),
        ("[decision]\nleast_confidence = 90.0", "decision", "least_confidence = 90.0 is no probability"),
        ("[recovery.crossed_lines]\ntries = 0", "recovery.crossed_lines", "tries = 0"),
        ("[grid]\nrate_hz = nan", "grid", "rate_hz = nan is no rate"),
    ],
)
def test_a_value_out_of_range_is_refused_with_file_key_and_range(read, owners, key, what):
    line = complaint(read(owners))
    assert "mine.toml" in line
    assert f": {key}: {what}" in line


def test_a_table_where_a_value_belongs_and_the_other_way_round(read):
    line = complaint(read("grid = 5"))
    assert "mine.toml" in line
    assert "grid: Expected `object`, got `int`" in line
    line = complaint(read("[streams.WIND]\nrate_hz = 1.0"))
    assert "mine.toml" in line
    assert "streams.WIND: Expected `float`, got `object`" in line


def test_a_missing_key_is_named(read):
    source = read('[recovery.stall]\naction = "swap_parameters"')
    line = complaint(source)
    assert "mine.toml: recovery.stall: " in line
    assert "missing required field `parameters`" in line


def test_of_two_mistakes_one_is_told_with_its_own_key(read):
    line = complaint(read('[streams]\nWIND = "often"\n[decision]\nhold_s = "long"'))
    assert line.rpartition("/")[2] in (
        "mine.toml: streams.WIND: Expected `float`, got `str`",
        "mine.toml: decision.hold_s: Expected `float`, got `str`",
    )


@pytest.mark.parametrize(
    "text", ["[grid", "rate_hz = ", "a = 1\na = 2", "[grid]\n[grid]\n", "x = 01", 'name = "open', "\x00", "= 1"]
)
def test_what_is_not_toml_is_told_with_file_and_line(read, text):
    with pytest.raises(UserError, match=r"mine\.toml: not valid TOML: ") as told:
        read(text)
    assert len(str(told.value).splitlines()) == 1


def test_a_file_that_is_not_there_or_not_text_is_told_in_one_line(tmp_path):
    (tmp_path / "noise.toml").write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "nowhere.toml", tmp_path, tmp_path / "noise.toml"):
        with pytest.raises(UserError, match="cannot read the configuration") as told:
            configuration.read(PACKAGED, "configs/parafoil.toml", path)
        assert str(told.value).startswith(f"{path}: ")
        assert len(str(told.value).splitlines()) == 1


def test_a_table_of_its_own_is_named_by_its_whole_path(read):
    source = read('[monitor]\ninner = { length_m = "long" }')
    line = complaint(source, {"inner": {}}, Inner, "monitor.")
    assert "mine.toml: unknown key monitor.inner; known here: length_m, mode" in line
    source = read("[sitl]\ninner = { length_m = 1.0 }\nmany = { one = { length_m = 1.0 }, two = { length_m = [] } }")
    line = complaint(source, sitl(source), Outer, "sitl.")
    assert "mine.toml: sitl.many.two.length_m: Expected `float`, got `array`" in line
    source = read('[sitl]\ninner = { length_m = 1.0, mode = "odd" }')
    assert "sitl.inner.mode: Invalid enum value 'odd'" in complaint(source, sitl(source), Outer, "sitl.")
    source = read('[sitl]\ninner = { length_m = 1.0 }\nname = "bad"')
    assert "sitl: name = 'bad' is bad" in complaint(source, sitl(source), Outer, "sitl.")


def test_ages_are_those_of_the_channel_or_of_all():
    grid = Grid(12.5, 1.0, {"armed": 5.0})
    assert grid.maximal_age_us(("yaw_rad", "armed")) == (1_000_000, 5_000_000)
    assert grid.period_us == 80_000
