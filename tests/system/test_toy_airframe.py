"""An airframe from outside the package, found by its entry point: every command takes it, and none knew of it."""

import json
from pathlib import Path

import pytest

import companion
from companion.events import same_events
from tests.sitl.test_server import free_port
from tests.system import flights
from tests.system.flights import TOY, command, flying, names, watching

FAULT = "thruster_loss=0.6@20"
FOUND = ["fault/detected", "fault/isolated"]


@pytest.fixture(scope="module")
def watched(tmp_path_factory):
    """Folder of a live run beside the simulated sled, in lockstep."""
    out = tmp_path_factory.mktemp("sled")
    port = free_port()
    with (
        watching(out, f"udpin:127.0.0.1:{port}", airframe="sled", path=TOY) as run,
        flying(
            f"udpout:127.0.0.1:{port}", airframe="sled", seed=501, fault=FAULT, duration_s=60.0, path=TOY
        ) as simulator,
    ):  # fmt: skip
        assert simulator.ended() == 0, simulator.text
        assert run.stop() == 0, run.text
    return out


def test_run_and_sitl_fly_and_watch_it_and_its_fault_is_found(watched):
    lines = flights.events(watched / "events.jsonl")
    assert names(lines, "fault", "recovery") == FOUND
    (found,) = [line["fault"] for line in lines if line["name"] == "isolated"]
    assert found["id"] == "thruster_loss"
    assert found["size"] == pytest.approx(0.6, abs=0.15)
    assert lines[0]["vehicle"]["airframe"] == "sled"
    summary = json.loads((watched / "summary.json").read_text(encoding="utf-8"))
    assert (summary["airframe"], summary["verdict"], summary["recovery"]) == ("sled", "fault", None)


def test_analyze_finds_the_same_in_the_log_if_it_is_named(watched):
    with command("analyze", "--json", "--airframe", "sled", watched / "flight.tlog", path=TOY) as analysis:
        assert analysis.ended() == 1
    content = json.loads(analysis.text)
    assert same_events(flights.events(watched / "events.jsonl"), content["events"]) is None
    assert content["replay"]["same_sends"]
    assert content["vehicles"] == [{"sysid": 1, "compid": 1, "autopilot": 3, "type": 10, "airframe": "sled"}]


def test_analyze_does_not_guess_it_by_the_type_that_it_shares_with_others(watched):
    with command("analyze", "--json", watched / "flight.tlog", path=TOY) as analysis:
        analysis.ended()
    content = json.loads(analysis.text)
    assert [vehicle["airframe"] for vehicle in content["vehicles"]] == [None]
    assert content["events"] == []


def test_a_healthy_sled_stays_healthy(tmp_path):
    port = free_port()
    with (
        watching(tmp_path, f"udpin:127.0.0.1:{port}", airframe="sled", path=TOY) as run,
        flying(f"udpout:127.0.0.1:{port}", airframe="sled", seed=502, duration_s=60.0, path=TOY) as simulator,
    ):
        assert simulator.ended() == 0, simulator.text
        assert run.stop() == 0, run.text
    assert names(flights.events(tmp_path / "events.jsonl"), "fault") == []
    assert json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))["verdict"] == "healthy"


def test_demo_flies_breaks_and_watches_it(tmp_path):
    words = ("--fault", "thruster_loss@20", "--duration", "60", "--seed", "503", "--speedup", "lockstep", "--no-view")
    with command("demo", "sled", *words, "--out", tmp_path, path=TOY) as demo:
        assert demo.ended() == 0, demo.text
    assert names(flights.events(tmp_path / "events.jsonl"), "fault") == FOUND
    assert "thruster has lost thrust" in demo.text
    assert (tmp_path / "flight.png").read_bytes().startswith(b"\x89PNG")


def test_config_prints_its_values_and_where_they_come_from(tmp_path):
    mine = tmp_path / "mine.toml"
    mine.write_text("[monitor]\nconfirm_s = 5.0\n", encoding="utf-8")
    with command("config", "sled", "--config", mine, path=TOY) as config:
        assert config.ended() == 0
    lines = config.text.splitlines()
    assert f"monitor.confirm_s = 5.0  # {mine}" in lines
    assert "grid.rate_hz = 10.0  # sled/airframe.toml" in lines


def test_without_its_package_it_is_an_unknown_airframe():
    with command("config", "sled") as config:
        assert config.ended() == 2
    assert config.text == "mavfdi config: unknown airframe 'sled'; known: parafoil\n"


def test_nothing_in_the_companion_spells_its_name_and_the_parafoils_only_as_a_default():
    for file in Path(companion.__file__).parent.rglob("*.py"):
        source = file.read_text(encoding="utf-8")
        assert "sled" not in source.lower(), file
        spelt = [line for line in source.splitlines() if '"parafoil"' in line]
        assert spelt in ([], ['    parser.add_argument("airframe", nargs="?", default="parafoil")']), file
