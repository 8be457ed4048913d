"""A handful of logs of the real ArduPilot in its simulator, and of attacks; all of them: tools/checks_table.py."""

from pathlib import Path

import pytest

from companion.checks import CHECKS, Bench, Status
from companion.tlog import PLAUSIBLE_US, Reader

ROOT = Path(__file__).parents[3]
DATA = ROOT.parent / "shared" / "data"


def findings(name):
    path = DATA / f"{name}.tlog.gz"
    if not path.exists():
        pytest.skip(f"{path} is not here: samples too large for the repository")
    bench = Bench()
    for record in Reader(path):
        plausible = record.stamp_us is not None and record.stamp_us in PLAUSIBLE_US
        bench.take(record.frame, record.stamp_us if plausible else None)
    return {finding.id: finding.status for finding in bench.finish()}


@pytest.mark.parametrize("name", ["planea-01", "planea-22", "planeb-18", "boata-09", "roverb-06", "coptera-03"])
def test_healthy_flights_have_no_fault_and_no_warning_but_an_empty_battery(name):
    found = findings(f"ardupilot/{name}")
    assert Status.FAULT not in found.values()
    assert {check for check, status in found.items() if status is Status.WARNING} <= {"battery_low"}


@pytest.mark.parametrize(
    ("name", "check", "status"),
    [
        ("ardupilot/boata-01", "gps_jump", Status.FAULT),
        ("ardupilot/boata-04", "accelerometer_pair", Status.FAULT),
        ("ardupilot/boata-05", "gyro_pair", Status.FAULT),
        ("ardupilot/boata-08", "compass_offset", Status.WARNING),
        ("ardupilot/planea-02", "airspeed_stuck", Status.FAULT),
        ("ardupilot/planea-04", "airspeed_scale", Status.WARNING),
        ("ardupilot/planea-08", "gyro_bias", Status.WARNING),
        ("ardupilot/planea-10", "compass_pair", Status.WARNING),
        ("ardupilot/planea-16", "gps_drift", Status.FAULT),
        ("ardupilot/planea-25", "baro_height", Status.WARNING),
        ("ardupilot/planea-28", "gps_drift", Status.FAULT),
        ("ardupilot/planeb-05", "battery_drop", Status.FAULT),
        ("ardupilot/planeb-12", "imu_frozen", Status.FAULT),
        ("ardupilot/planeb-17", "airspeed_zero", Status.FAULT),
        ("ardupilot/planeb-20", "accelerometer_motion", Status.WARNING),
        ("ardupilot/roverb-08", "gps_fix", Status.WARNING),
        ("tlogs/attack_flood_2026", "link_flood", Status.WARNING),
        ("tlogs/attack_heartbeat_2026", "link_identity", Status.WARNING),
        ("tlogs/copter_noisylink_2024", "link_loss", Status.WARNING),
        ("tlogs/rospx4_2017", "reboot", Status.WARNING),
    ],
)
def test_what_is_wrong_with_a_log_is_found(name, check, status):
    assert findings(name)[check] is status


def test_the_page_of_the_checks_has_a_row_for_each_with_its_limit_and_source():
    page = (ROOT / "docs" / "checks.md").read_text()
    for check in CHECKS:
        row = next(line for line in page.splitlines() if line.startswith(f"| {check.id} |"))
        assert f"| {check.limit:g} {check.unit}".strip() in row or not check.limit
        assert check.source in row
        assert check.text in row
