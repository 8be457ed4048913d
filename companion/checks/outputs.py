"""What the autopilot commands its actuators: outputs that stand at their limit, motors that work unequally."""

from dataclasses import dataclass, field
from typing import Final

from companion.checks.finding import Check, Held, Means, Result, Span, absent, change, fine, found, median, number, total_s
from companion.checks.flight import MOTORS, Flight
from companion.dialect import Fields
from companion.frames import Frame

OUTPUTS: Final = tuple((n, f"servo{n}_raw", f"SERVO{n}_MIN", f"SERVO{n}_MAX") for n in range(1, 9))
LOW_US, HIGH_US = 1100.0, 1900.0  # defaults of ArduPilot's SERVOn_MIN and SERVOn_MAX
MOVED_US: Final = 100.0  # an output that moved by less carries no control
ALIVE_US: Final = range(700, 2301)  # pulses that a servo could mean; 0 is off
SPINNING_US: Final = 1150.0
WINDOW_S: Final = 30.0
UNEQUAL_US: Final = 150.0  # as they stand
# Values of SERVOn_FUNCTION whose lower end is idleness: throttle, left and right throttle, motors 1 to 8 and 9 to 12.
IDLES: Final = frozenset({70, 73, 74, *range(33, 41), *range(82, 86)})
PLANE_THROTTLE: Final = 3  # ArduPlane's default output of the throttle, where no parameter tells


@dataclass(slots=True)
class _Output:
    low: Held
    high: Held
    least_us: float = 1e9
    most_us: float = -1e9


@dataclass(slots=True)
class Saturation:
    """Check `output_saturation`: an output that moves otherwise stands at its limit for long while under way.

    Limits and functions are the vehicle's parameters where the log has them, else 1100 and 1900 us.  A throttle or motor at
    its lower end is idle, not saturated.
    """

    check: Check
    flight: Flight
    _outputs: dict[int, _Output] = field(default_factory=dict)
    _parameters: dict[str, float] = field(default_factory=dict)

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if name == "PARAM_VALUE":
            parameter = str(fields["param_id"])
            if parameter.startswith("SERVO"):
                self._parameters[parameter] = number(fields, "param_value")
            return
        if number(fields, "port") != 0.0:
            return
        under_way = self.flight.under_way
        for place, field_name, lowest, highest in OUTPUTS:
            pulse_us = number(fields, field_name)
            output = self._outputs.get(place)
            if output is None:
                if pulse_us == 0.0:
                    continue
                output = self._outputs[place] = _Output(Held(self.check.limit), Held(self.check.limit))
            if not under_way or int(pulse_us) not in ALIVE_US:
                output.low.stop()
                output.high.stop()
                continue
            output.least_us = min(output.least_us, pulse_us)
            output.most_us = max(output.most_us, pulse_us)
            output.low.take(t_s, pulse_us <= self._parameters.get(lowest, LOW_US))
            output.high.take(t_s, pulse_us >= self._parameters.get(highest, HIGH_US))

    def _idles(self, place: int) -> bool:
        function = self._parameters.get(f"SERVO{place}_FUNCTION")
        if function is not None:
            return int(function) in IDLES
        return self.flight.rotors or (self.flight.fixed_wing and place == PLANE_THROTTLE)

    def finish(self) -> Result:
        if not any(output.low.samples for output in self._outputs.values()):
            return absent("no SERVO_OUTPUT_RAW message while under way")
        told: list[str] = []
        all_spans: list[Span] = []
        for place, output in sorted(self._outputs.items()):
            if output.most_us - output.least_us < MOVED_US:
                continue
            ends = [("upper", output.high)] if self._idles(place) else [("upper", output.high), ("lower", output.low)]
            for end, held in ends:
                spans = held.spans()
                if spans:
                    told.append(f"output {place} at its {end} end for {total_s(spans):.0f} s")
                    all_spans += spans
        if told:
            return found(self.check, ", ".join(told), tuple(sorted(all_spans)))
        return fine("none for long")


@dataclass(slots=True)
class MotorBalance:
    """Check `motor_balance`: the mean outputs of a multirotor's motors drift apart, or are far apart throughout."""

    check: Check
    flight: Flight
    _means: Means = field(default_factory=lambda: Means(WINDOW_S))

    def take(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        motors = MOTORS.get(self.flight.type, 0)
        if not motors or number(fields, "port") != 0.0 or not self.flight.airborne:
            return
        pulses_us = tuple(number(fields, field_name) for _, field_name, _, _ in OUTPUTS[:motors])
        if min(pulses_us) > SPINNING_US:
            mean_us = sum(pulses_us) / motors
            self._means.take(t_s, tuple(pulse_us - mean_us for pulse_us in pulses_us))

    def finish(self) -> Result:
        windows = self._means.windows
        if self.flight.type not in MOTORS:
            return absent("no multirotor of 4, 6 or 8 motors")
        if not windows:
            return absent(f"no {WINDOW_S:.0f} s in the air with all motors turning")
        columns = range(len(windows[0].mean))
        usual_us = [median([window.mean[c] for window in windows]) for c in columns]
        apart_us = max(usual_us) - min(usual_us)
        moved = change(windows, self.check.limit, references=2, run=1)
        if moved is not None and moved.spans:
            return found(self.check, f"motor {moved.column + 1} by {moved.size:.0f} us", moved.spans)
        if apart_us > UNEQUAL_US:
            return found(self.check, f"throughout, by {apart_us:.0f} us", ())
        return fine(f"{apart_us:.0f} us apart in the mean")
