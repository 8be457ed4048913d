"""Health checks that fit any vehicle: what `mavfdi analyze` says of a log, airframe configured or not.

`Bench` runs them all over one log; `CHECKS` is their table.  docs/checks.md lists limits and their sources.
"""

from companion.checks.bench import Bench, worst
from companion.checks.finding import Check, Finding, Severity, Span, Status
from companion.checks.table import CHECKS

__all__ = ["CHECKS", "Bench", "Check", "Finding", "Severity", "Span", "Status", "worst"]
