"""`mavfdi montecarlo` as its user has it: several processes, killed and gone on with, one seed through real bytes."""

import contextlib
import json
import signal
import subprocess
import sys
import time

import psutil
import pytest
from pyarrow import parquet

from companion import airframe as airframes
from companion import campaign
from companion.cli import main
from companion.events import same_events
from tests.system.flights import LIMIT_S, TOY, command, events

FAULTS = "none,motor,crossed_lines"
WORDS = ("--flights", 12, "--seed", 300, "--faults", FAULTS, "--duration", 130)
# The command with batches so small that several are flown, one after the other, in each process.
SMALL_BATCHES = (
    "import sys; from companion.campaign import crew; crew.BATCH = 3; from companion.cli import main; sys.exit(main())"
)


@pytest.fixture(autouse=True)
def signals_as_before():
    """A command run inside this process takes SIGTERM for itself."""
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """The folder of a campaign flown in one process."""
    out = tmp_path_factory.mktemp("flown")
    with command("montecarlo", "parafoil", *WORDS, "--jobs", 1, "--out", out) as run:
        assert run.ended() == 0, run.text
    # Neither progress nor anything else where nobody watches a terminal, but for the last line.
    (line,) = run.text.splitlines()
    assert line.startswith(f"{out / 'flights.parquet'}: 12 flights, in ")
    return out


def rows(out):
    return parquet.read_table(out / "flights.parquet")


def small_batches(out, *words):
    arguments = [str(word) for word in ("montecarlo", "parafoil", *WORDS, "--jobs", 2, "--out", out, *words)]
    return subprocess.Popen(
        [sys.executable, "-c", SMALL_BATCHES, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def wait_for_part(out, process):
    end_s = time.monotonic() + LIMIT_S
    while not list(out.glob("parts/*.parquet")):
        assert time.monotonic() < end_s
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.02)
            raise AssertionError(process.stderr.read())


def test_any_number_of_processes_gives_the_same_rows(flown, tmp_path):
    process = small_batches(tmp_path)
    said, complained = process.communicate(timeout=LIMIT_S)
    assert process.returncode == 0, complained
    assert complained == ""
    assert "12 flights, in " in said
    assert rows(tmp_path).equals(rows(flown))
    assert rows(tmp_path)["seed"].to_pylist() == list(range(300, 312))
    assert rows(tmp_path).schema.metadata == rows(flown).schema.metadata


def test_a_campaign_killed_in_flight_leaves_whole_parts_and_goes_on_where_it_was(flown, tmp_path):
    process = small_batches(tmp_path)
    with process:
        wait_for_part(tmp_path, process)
        children = psutil.Process(process.pid).children(recursive=True)
        assert len(children) >= 2
        process.kill()
        process.communicate(timeout=LIMIT_S)
    gone, alive = psutil.wait_procs(children, timeout=LIMIT_S)
    assert not alive  # nobody goes on flying for a parent that is no more
    assert len(gone) == len(children)
    kept = sum(parquet.read_table(path).num_rows for path in tmp_path.glob("parts/*.parquet"))
    assert 0 < kept <= 12
    with command("montecarlo", "parafoil", *WORDS, "--jobs", 1, "--out", tmp_path) as run:
        assert run.ended() == 0, run.text
    assert (f"({kept} of them flown before)" if kept < 12 else "all of them flown before") in run.text
    assert rows(tmp_path).equals(rows(flown))
    assert [path.name for path in tmp_path.iterdir()] == ["flights.parquet"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_campaign_that_is_stopped_says_how_far_it_is_and_leaves_nobody_behind(tmp_path, number):
    process = small_batches(tmp_path)
    with process:
        wait_for_part(tmp_path, process)
        children = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(number)
        said, complained = process.communicate(timeout=LIMIT_S)
    assert not psutil.wait_procs(children, timeout=LIMIT_S)[1]
    if process.returncode == 0:  # it was faster than the signal
        assert "12 flights" in said
        return
    assert process.returncode == 2
    kept = sum(parquet.read_table(path).num_rows for path in tmp_path.glob("parts/*.parquet"))
    assert f"stopped; {kept} of 12 flights are kept in {tmp_path}" in complained
    assert "Traceback" not in complained


def test_a_process_that_is_killed_ends_the_campaign_with_one_line_and_what_was_flown_is_kept(tmp_path):
    process = small_batches(tmp_path, "--flights", 60)
    with process:
        wait_for_part(tmp_path, process)
        children = psutil.Process(process.pid).children()
        next(child for child in children if "spawn_main" in " ".join(child.cmdline())).kill()
        said, complained = process.communicate(timeout=LIMIT_S)
    assert (process.returncode, said) == (2, "")
    (line,) = complained.splitlines()
    assert line.startswith("mavfdi montecarlo: a process of the campaign was killed")
    assert not psutil.wait_procs(children, timeout=LIMIT_S)[1]
    assert list(tmp_path.glob("parts/*.parquet"))


def test_a_campaign_that_is_complete_is_not_flown_again(flown, capsys):
    before = (flown / "flights.parquet").stat().st_mtime_ns
    assert main(["montecarlo", "parafoil", *map(str, WORDS), "--jobs", "1", "--out", str(flown)]) == 0
    assert capsys.readouterr().out == f"{flown / 'flights.parquet'}: 12 flights, all of them flown before\n"
    assert (flown / "flights.parquet").stat().st_mtime_ns == before


MISTAKES = {
    "other settings in the same folder": (["--duration", "120"], "duration_s 130.0 (now 120.0)"),
    "a fault that nobody knows": (["--faults", "gremlins"], "parafoil: unknown fault 'gremlins'; this airframe knows"),
    "a kind that nobody knows": (["--faults", "motor:left/melted"], "parafoil: unknown fault 'motor:left/melted'"),
    "an empty fault": (["--faults", "none,"], "--faults none,: an id is empty"),
    "a detector that nobody knows": (["--detector", "crystal_ball"], "detector = 'crystal_ball' is unknown; give one of"),
    "no flights": (["--flights", "0"], "--flights 0: give at least 1"),
    "no jobs": (["--jobs", "0"], "--jobs 0: give at least 1"),
    "a negative seed": (["--seed", "-1"], "--seed -1 is no seed"),
    "a negative seed to look at": (["--only", "-1"], "--only -1 is no seed"),
    "a seed beyond all numbers": (["--seed", str(1 << 70)], "seeds and flights are numbers below"),
    "no time": (["--duration", "0"], "--duration 0 is no duration"),
    "another line for one seed": (["--only", "300", "--link"], "link False (now True)"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_and_flies_nothing(flown, capsys, mistake):
    words, text = MISTAKES[mistake]
    code = main(["montecarlo", "parafoil", *map(str, WORDS), "--out", str(flown), *words])
    printed = capsys.readouterr()
    assert (code, printed.out) == (2, "")
    (line,) = printed.err.splitlines()
    assert line.startswith("mavfdi montecarlo: ")
    assert text in line


def test_without_flights_and_seed_it_says_what_to_give(tmp_path, capsys):
    assert main(["montecarlo", "parafoil", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err == "mavfdi montecarlo: give --flights N and --seed N, or --only SEED\n"


def test_only_shows_the_row_of_the_table_beside_the_events_of_the_real_bytes(flown, capsys):
    table = rows(flown).to_pylist()
    row = next(row for row in table if row["named_id"] is not None)
    seed = row["seed"]
    assert main(["montecarlo", "parafoil", "--only", str(seed), "--out", str(flown)]) == 0
    said = capsys.readouterr().out
    assert f"{flown / 'flights.parquet'}: has the same row" in said
    lines = said.splitlines()
    (faults,) = [line.split() for line in lines if line.startswith("fault_id")]
    assert faults[:3] == ["fault_id", row["fault_id"], row["fault_id"]]
    assert any("fault/isolated: " in line for line in lines)
    folder = flown / f"seed-{seed}"
    assert (folder / "flight.png").read_bytes().startswith(b"\x89PNG")
    told = events(folder / "events.jsonl")
    assert (told[0]["kind"], told[0]["seed"], told[-1]["kind"]) == ("run", seed, "end")
    with command("analyze", "--json", folder / "flight.tlog") as analysis:
        analysis.ended()
    content = json.loads(analysis.text)
    assert same_events(told, content["events"]) is None


def test_only_takes_a_table_of_another_configuration_for_another_campaign(flown, tmp_path, capsys):
    mine = tmp_path / "mine.toml"
    mine.write_text("[decision]\nhold_s = 4.0\n", encoding="utf-8")
    assert main(["montecarlo", "parafoil", "--only", "300", "--out", str(flown), "--config", str(mine)]) == 2
    assert "flown with other settings: config_sha256" in capsys.readouterr().err


def test_an_airframe_from_outside_is_flown_by_several_processes_too(tmp_path):
    words = ("--flights", 10, "--seed", 501, "--faults", "none,thruster_loss", "--duration", 150, "--link", "--jobs", 2)
    with command("montecarlo", "sled", *words, "--out", tmp_path, path=TOY) as run:
        assert run.ended() == 0, run.text
    table = rows(tmp_path).to_pylist()
    assert {row["fault_id"] for row in table} == {"none", "thruster_loss"}
    assert all(row["named_id"] == "thruster_loss" for row in table if row["fault_id"] != "none" and row["onset_s"] < 40.0)
    assert not any(row["false_alarm"] for row in table)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(TOY)
        batch = campaign.Batch(airframes.load("sled"), 501, 10, ("none", "thruster_loss"), 150.0, True)
        assert rows(tmp_path).equals(campaign.table(campaign.fly(batch)))
