"""What the live monitor loads: a small board has neither the memory nor the time for the laboratory's libraries."""

import json
import subprocess
import sys

from tests.sitl.test_server import free_port
from tests.system import flights
from tests.system.flights import CROSSED, LIMIT_S, flying, names

HEAVY = {"numba", "llvmlite", "scipy", "filterpy", "matplotlib", "rich", "mavsdk", "sitl", "pandas", "pyarrow", "hypothesis"}

WATCH = """
import json, sys
from companion.cli import main
code = main(sys.argv[1:])
print(json.dumps({"code": code, "modules": sorted({name.partition(".")[0] for name in sys.modules})}))
"""


def test_a_whole_live_run_with_alarm_and_recovery_loads_none_of_the_laboratory(tmp_path):
    port = free_port()
    words = [
        "run", "parafoil", "--connect", f"udpin:127.0.0.1:{port}", "--policy", "auto", "--speedup", "lockstep",
        "--out", str(tmp_path), "--duration", "80", "--quiet",
    ]  # fmt: skip
    run = subprocess.Popen([sys.executable, "-c", WATCH, *words], stdout=subprocess.PIPE, text=True)
    try:
        with flying(f"udpout:127.0.0.1:{port}", fault=CROSSED, duration_s=81.0) as simulator:
            printed, _ = run.communicate(timeout=LIMIT_S)
            assert simulator.process.poll() is None or simulator.text == ""
    finally:
        if run.poll() is None:
            run.kill()
            run.communicate()
    told = json.loads(printed.splitlines()[-1])
    assert told["code"] == 0
    assert names(flights.events(tmp_path / "events.jsonl"), "recovery")[-1] == "recovery/verified"
    assert {"numpy", "pymavlink", "companion", "fdi"} <= set(told["modules"])
    assert HEAVY.isdisjoint(told["modules"]), HEAVY.intersection(told["modules"])


def test_the_command_for_help_loads_nothing_at_all():
    script = "import sys\nfrom companion.cli import main\ntry:\n    main(['--help'])\nfinally:\n    print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=LIMIT_S, check=False)
    loaded = {name.partition(".")[0] for name in done.stdout.splitlines()[-1].split()}
    assert "argparse" in loaded
    assert (HEAVY | {"numpy", "pymavlink", "serial"}).isdisjoint(loaded)
