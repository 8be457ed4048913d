"""What the health checks find in the logs at hand: a table log x findings, and one row for each check.

Reads every log below DATA/{ardupilot,alfa,tlogs} (their INDEX.json says what is known of them).  Findings in capitals are
faults, the others warnings.  --texts prints the sentences too; --checks prints the table of the checks instead.

    python tools/checks_table.py ../shared/data
"""

import argparse
import json
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion.checks import CHECKS, Bench, Finding, Status
from companion.errors import UserError
from companion.tlog import PLAUSIBLE_US, Reader

FOLDERS = ("ardupilot", "alfa", "tlogs")
DATA = Path(__file__).parent.parent.parent / "shared" / "data"


@dataclass(slots=True)
class Spent:
    """CPU time of the checks alone."""

    frames: int = 0
    cpu_s: float = 0.0
    statuses: Counter[tuple[str, Status]] = field(default_factory=Counter)


def judged(path: Path, spent: Spent) -> list[Finding]:
    """All findings of one log.  Raises UserError for a log that cannot be read."""
    records = list(Reader(path))
    before_s = time.process_time()
    bench = Bench()
    for record in records:
        plausible = record.stamp_us is not None and record.stamp_us in PLAUSIBLE_US
        bench.take(record.frame, record.stamp_us if plausible else None)
    findings = bench.finish()
    spent.cpu_s += time.process_time() - before_s
    spent.frames += len(records)
    spent.statuses.update((finding.id, finding.status) for finding in findings)
    return findings


def known(folder: Path) -> dict[str, str]:
    """Name of the log -> what its index says of it."""
    index = folder / "INDEX.json"
    if not index.exists():
        return {}
    content: Any = json.loads(index.read_text())
    entries = content if isinstance(content, list) else next(v for v in content.values() if isinstance(v, list))
    out: dict[str, str] = {}
    for entry in entries:
        name = str(entry.get("file") or entry.get("flight") or entry.get("name")).removesuffix(".tlog.gz")
        fault = entry.get("fault")
        if fault:
            out[name] = f"{fault['class']}: {fault['size']}"
        else:
            out[name] = str(entry.get("label") or entry.get("class") or entry.get("vehicle") or "")
    return out


def cell(findings: list[Finding]) -> str:
    faults = [finding.id.upper() for finding in findings if finding.status is Status.FAULT]
    warnings = [finding.id for finding in findings if finding.status is Status.WARNING]
    return ", ".join(faults + warnings) or "-"


def table_of_checks() -> None:
    print("| id | needs | limit | source | at most | what it says |")
    print("| --- | --- | --- | --- | --- | --- |")
    for check in CHECKS:
        needs = "every frame" if check.needs == ("*",) else ", ".join(n.replace("|", " or ") for n in check.needs)
        limit = f"{check.limit:g} {check.unit}".strip() if check.limit else "-"
        print(f"| {check.id} | {needs} | {limit} | {check.source} | {check.severity.value} | {check.text} |")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("data", nargs="?", type=Path, default=DATA, help="folder with ardupilot/, alfa/, tlogs/")
    parser.add_argument("--texts", action="store_true", help="print the findings' sentences")
    parser.add_argument("--checks", action="store_true", help="print the table of the checks and stop")
    arguments = parser.parse_args()
    if arguments.checks:
        table_of_checks()
        return 0
    spent = Spent()
    for name in FOLDERS:
        folder = arguments.data / name
        logs = sorted(folder.glob("*.tlog.gz"))
        if not logs:
            print(f"{folder}: no logs", file=sys.stderr)
            continue
        truth = known(folder)
        print(f"\n| {name} | known of it | found |\n| --- | --- | --- |")
        for path in logs:
            short = path.name.removesuffix(".tlog.gz")
            what = next((text for key, text in truth.items() if short.endswith(key)), "")
            try:
                findings = judged(path, spent)
            except UserError:
                print(f"| {short} | {what} | no MAVLink frame |")
                continue
            print(f"| {short} | {what} | {cell(findings)} |")
            for finding in findings if arguments.texts else ():
                if finding.status in (Status.FAULT, Status.WARNING):
                    print(f"    {finding.status.value} {finding.id}: {finding.text}")
    if not spent.frames:
        return 2
    print("\n| check | ok | warning | fault | not available |\n| --- | ---: | ---: | ---: | ---: |")
    for check in CHECKS:
        print(f"| {check.id} | " + " | ".join(str(spent.statuses[check.id, status]) for status in Status) + " |")
    print(f"\n{spent.frames} frames, {spent.cpu_s:.1f} s of CPU: {spent.cpu_s / spent.frames * 1e5:.2f} s for 100000 frames")
    return 0


if __name__ == "__main__":
    sys.exit(main())
