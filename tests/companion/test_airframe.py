"""An airframe is found by its name, configured, and refused in one line where its tables do not fit each other."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from companion import airframe
from companion.errors import UserError
from fdi.verdict import Fault

TOYS = Path(__file__).parents[1] / "toy_airframe"


@pytest.fixture
def mine(tmp_path):
    """Load the parafoil with an owner's text over its configuration."""

    def load(text, name="parafoil"):
        path = tmp_path / "mine.toml"
        path.write_text(text)
        return airframe.load(name, path)

    return load


def complaint(load, text):
    with pytest.raises(UserError) as told:
        load(text)
    line = str(told.value)
    assert len(line.splitlines()) == 1
    return line


def test_every_airframe_that_is_found_loads_and_judges():
    names = tuple(airframe.places())
    assert "parafoil" in names
    for name in names:
        loaded = airframe.load(name)
        assert loaded.name == name
        assert loaded.monitor(3).step is not None
        assert set(loaded.configuration.streams)


def test_an_unknown_airframe_is_refused_with_those_that_are_known():
    with pytest.raises(UserError, match=r"^unknown airframe 'zeppelin'; known: .*parafoil"):
        airframe.load("zeppelin")


def test_a_name_is_no_path():
    for name in ("../parafoil", "parafoil.toml", "", "__init__"):
        with pytest.raises(UserError, match="unknown airframe"):
            airframe.load(name)


def test_the_owners_file_is_laid_over_the_packaged_one(mine):
    loaded = mine("[decision]\nhold_s = 7.5\n")
    assert loaded.configuration.decision.hold_s == 7.5
    assert loaded.source.origins["decision.hold_s"].endswith("/mine.toml")
    assert loaded.source.origins["grid.rate_hz"] == "configs/parafoil.toml"
    assert loaded.configuration.grid == airframe.load("parafoil").configuration.grid


def test_the_monitors_own_table_is_checked_too(mine):
    line = complaint(mine, '[monitor.motor]\ntravel_m = "far"')
    assert line.endswith("/mine.toml: monitor.motor.travel_m: Expected `float`, got `str`")
    assert "unknown key monitor.motor.colour" in complaint(mine, "[monitor.motor]\ncolour = 1")
    with pytest.raises(UserError, match="monitor"):
        mine("[monitor.motor]\ntravel_m = -1.0")


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[streams]\nVFR_HUD = 5.0", "streams.VFR_HUD delivers no channel of parafoil"),
        ("[streams]\nNO_SUCH_MESSAGE = 5.0", "streams.NO_SUCH_MESSAGE delivers no channel of parafoil"),
        ("[grid.maximal_ages_s]\nwarp_factor = 1.0", "grid.maximal_ages_s.warp_factor is no channel of parafoil"),
        ('[recovery.crossed_lines]\nverify_residual = "luck"', "recovery.crossed_lines.verify_residual = 'luck'"),
        ('[recovery.crossed_lines]\nexcitation_signal = "wind"', "recovery.crossed_lines.excitation_signal = 'wind'"),
    ],
)
def test_names_that_the_airframe_does_not_have_are_refused_with_file_and_key(mine, text, key):
    line = complaint(mine, text)
    assert "mine.toml" in line
    assert key in line


def test_a_recovery_for_a_fault_that_does_not_exist_is_refused_with_those_that_do(mine):
    packaged = airframe.load("parafoil").source.table["recovery"]["crossed_lines"]
    lines = "\n".join(f"{key} = {value!r}".replace("'", '"') for key, value in packaged.items())
    line = complaint(mine, f"[recovery.bad_luck]\n{lines}")
    assert "recovery.bad_luck is no fault of parafoil; known: " in line
    assert "crossed_lines" in line.partition("known: ")[2]


def test_a_mistake_of_form_is_told_before_anything_is_built(mine):
    assert "mine.toml: not valid TOML" in complaint(mine, "[grid\n")
    assert "unknown key wings" in complaint(mine, "[wings]\nspan_m = 3.0")
    with pytest.raises(UserError, match="cannot read the configuration"):
        airframe.load("parafoil", Path("/no/such/file.toml"))


def test_a_fault_is_mended_by_its_id_or_else_by_its_class():
    loaded = airframe.load("parafoil")
    plan = loaded.configuration.recovery["crossed_lines"]
    assert loaded.plan(Fault("crossed_lines", "crossed_lines", None, "")) is plan
    assert loaded.plan(Fault("crossed_lines:left", "crossed_lines", "left", "")) is plan
    assert loaded.plan(Fault("motor:left", "motor", "left", "")) is None


def test_the_simulator_is_loaded_only_when_it_is_asked_for():
    code = """
import sys
from companion import airframe
assert airframe.load("parafoil").simulator == "sitl.parafoil"
print({name.partition(".")[0] for name in sys.modules} & {"sitl", "numba", "scipy", "filterpy", "matplotlib"})
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout == "set()\n"


def test_the_simulators_table_is_checked_by_its_own_record(mine):
    loaded = mine("[sitl.guidance]\nflare_m = 0.5\n")
    module = loaded.load_simulator()
    assert isinstance(loaded.simulator_config(module), module.Config)
    bad = mine('[sitl.guidance]\nflare_m = "hard"\n')
    with pytest.raises(UserError, match=r"mine\.toml: sitl\.guidance\.flare_m: Expected `float`, got `str`"):
        bad.simulator_config(module)


def test_an_airframe_from_outside_is_found_by_its_entry_point(monkeypatch):
    monkeypatch.syspath_prepend(str(TOYS))
    place = airframe.places()["sled"]
    assert (place.fdi, place.sitl, place.toml_package, place.toml_name) == ("sled.fdi", "sled.sitl", "sled", "airframe.toml")
    loaded = airframe.load("sled")
    assert loaded.source.origins["grid.rate_hz"] == "sled/airframe.toml"
    assert next(iter(airframe.places())) == "parafoil"


def test_an_airframe_without_a_simulator_says_so():
    alone = replace(airframe.load("parafoil"), simulator=None)
    with pytest.raises(UserError, match="airframe parafoil has no simulator"):
        alone.load_simulator()


@pytest.mark.parametrize(
    ("missing", "error", "text"),
    [("numba.core", UserError, "pip install 'mavfdi[sitl]'"), ("sitl.parafoil", ModuleNotFoundError, "sitl.parafoil")],
)
def test_a_simulator_whose_extra_is_missing_says_what_to_install_and_our_own_gap_is_a_bug(monkeypatch, missing, error, text):
    loaded = airframe.load("parafoil")

    def import_module(_):
        raise ModuleNotFoundError(f"No module named {missing!r}", name=missing)

    monkeypatch.setattr(airframe.importlib, "import_module", import_module)
    with pytest.raises(error, match=re.escape(text)):
        loaded.load_simulator()
