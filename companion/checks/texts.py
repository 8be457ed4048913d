"""What the autopilot said itself: failsafes, texts whose meaning is known, and whatever it called critical."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from companion.checks.finding import Check, Result, Span, Status, absent, fine, found, number
from companion.checks.flight import Flight
from companion.dialect import Fields
from companion.frames import Frame

TOLD: Final = 4
OLD_LOWEST: Final = 1  # ArduPilot before 2016 had a scale of its own that began there; since then it has no alerts

# A piece of the text in lower case -> what it means, and whether it shows a sensor, actuator or power fault.  From
# ArduPilot's libraries and vehicles, and PX4's commander.
MEANINGS: Final[tuple[tuple[str, str, bool], ...]] = (
    ("ekf variance", "estimator distrusts its sensors", False),
    ("lane switch", "estimator changed to another IMU", False),
    ("ekf primary changed", "estimator changed to another IMU", False),
    ("emergency yaw reset", "compass contradicted by the motion", False),
    ("yaw inconsistent", "compass contradicted by the estimator", False),
    ("gps glitch", "GPS position jumped", False),
    ("compass error", "compass distrusted", False),
    ("stopped aiding", "estimator lost its position aiding", False),
    ("dead reckoning", "no position aiding left", False),
    ("no gps", "GPS lost", False),
    ("potential thrust loss", "a motor gives too little thrust", True),
    ("yaw imbalance", "motors work against each other about yaw", False),
    ("motor failure", "a motor failed", True),
    ("crash:", "crash detected", False),
    ("airspeed sensor", "airspeed sensor judged by the autopilot", False),
    ("vibration compensation on", "vibration spoils the height estimate", False),
    ("param write denied", "a parameter was refused", False),
    ("internal error", "autopilot's own internal error", False),
    ("watchdog", "autopilot was restarted by its watchdog", False),
)
AIRSPEED_FAILURE: Final = ("airspeed sensor", "failure")


@dataclass(slots=True)
class _Told:
    """Texts with how often and when first."""

    counts: Counter[str] = field(default_factory=Counter)
    spans: list[Span] = field(default_factory=list)

    def add(self, text: str, t_s: float) -> None:
        if not self.counts[text]:
            self.spans.append((t_s, t_s))
        self.counts[text] += 1

    def __str__(self) -> str:
        shown = [f'"{text}"' + (f" ({n}x)" if n > 1 else "") for text, n in self.counts.most_common(TOLD)]
        return ", ".join(shown) + (f" and {len(self.counts) - TOLD} more" if len(self.counts) > TOLD else "")


def text_of(fields: Fields) -> str:
    """The text of a STATUSTEXT in one line."""
    return " ".join(str(fields["text"]).split())


@dataclass(slots=True)
class Failsafes:
    """Check `failsafe`: a failsafe was triggered while armed."""

    check: Check
    flight: Flight
    _told: _Told = field(default_factory=_Told)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        text = text_of(fields)
        low = text.lower()
        if (
            self.flight.armed
            and "failsafe" in low
            and not any(word in low for word in ("cleared", "off", "ended", "prearm"))
        ):
            self._told.add(text, t_s)

    def finish(self) -> Result:
        if not self.flight.ever_armed:
            return absent("never armed")
        return found(self.check, str(self._told), tuple(self._told.spans)) if self._told.counts else fine("none told")


@dataclass(slots=True)
class KnownTexts:
    """Check `texts_known`: texts whose meaning is known, while armed."""

    check: Check
    flight: Flight
    _told: dict[str, _Told] = field(default_factory=dict)
    _shown: bool = False

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        text = text_of(fields)
        low = text.lower()
        if not self.flight.armed or low.startswith(("prearm", "arm:")):
            return
        for piece, meaning, shown in MEANINGS:
            if piece in low:
                self._told.setdefault(meaning, _Told()).add(text, t_s)
                self._shown |= shown or all(word in low for word in AIRSPEED_FAILURE)
                return

    def finish(self) -> Result:
        if not self.flight.ever_armed:
            return absent("never armed")
        if not self._told:
            return fine("none that says trouble")
        told = "; ".join(f"{meaning}: {texts}" for meaning, texts in self._told.items())
        spans = tuple(sorted(span for texts in self._told.values() for span in texts.spans))
        return found(self.check, told, spans, Status.FAULT if self._shown else Status.WARNING)


@dataclass(slots=True)
class SevereTexts:
    """Check `texts_severe`: whatever the autopilot called critical or worse while armed."""

    check: Check
    flight: Flight
    _told: _Told = field(default_factory=_Told)
    _by_severity: Counter[int] = field(default_factory=Counter)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        severity = int(number(fields, "severity"))
        self._by_severity[severity] += 1
        if self.flight.ardupilot and severity == OLD_LOWEST:
            return
        if self.flight.armed and severity <= self.check.limit:
            self._told.add(text_of(fields), t_s)

    def finish(self) -> Result:
        if not self.flight.ever_armed:
            return absent("never armed")
        if self._told.counts:
            return found(self.check, str(self._told), tuple(self._told.spans))
        counts = ", ".join(f"{n} of severity {severity}" for severity, n in sorted(self._by_severity.items()))
        return fine(f"none while armed ({counts})")
