"""The parafoil monitor's configuration: the `[monitor]` table of configs/parafoil.toml as frozen records."""

import math
from dataclasses import dataclass

from fdi.ekf import WindHeadingFilter

Row = tuple[float, float, float, float]
DETECTORS = ("paper", "gps", "gyro")


def _check_above_zero(table: str, values: dict[str, float]) -> None:
    for name, value in values.items():
        if not 0.0 < value < math.inf:
            raise ValueError(f"{table}.{name} = {value} must be a number above 0")


def _check_share(table: str, values: dict[str, float]) -> None:
    for name, value in values.items():
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"{table}.{name} = {value} is no share; give 0 to 1")


def _check_finite(table: str, name: str, values: tuple[float, ...]) -> None:
    if not all(math.isfinite(value) for value in values):
        raise ValueError(f"{table}.{name} holds a value that is no finite number")


@dataclass(frozen=True, slots=True)
class Outputs:
    """How commands and functions stand on the outputs."""

    function_left: int  # value of SERVOn_FUNCTION of the left toggle
    function_right: int
    zero_us: float  # pulse width of a released toggle
    pull_m_per_us: float

    def __post_init__(self) -> None:
        if self.function_left == self.function_right:
            raise ValueError(f"outputs.function_left and function_right are both {self.function_left}; they must differ")
        _check_above_zero("outputs", {"zero_us": self.zero_us, "pull_m_per_us": self.pull_m_per_us})


@dataclass(frozen=True, slots=True)
class Motor:
    """The nominal motor of a control line: first-order lag behind a rate limit."""

    travel_m: float
    rate_m_s: float
    lag_s: float

    def __post_init__(self) -> None:
        _check_above_zero("motor", {"travel_m": self.travel_m, "rate_m_s": self.rate_m_s, "lag_s": self.lag_s})


@dataclass(frozen=True, slots=True)
class LateralModel:
    """Linear lateral dynamics, states beta (rad), roll rate (rad/s), roll (rad), yaw rate (rad/s) (Eqs. 3-4)."""

    dynamics: tuple[Row, Row, Row, Row]  # A, 1/s
    input: Row  # b1, per metre pulled on the right
    output: Row  # C, to the heading rate of the air velocity

    def __post_init__(self) -> None:
        for row in self.dynamics:
            _check_finite("lateral_model", "dynamics", row)
        _check_finite("lateral_model", "input", self.input)
        _check_finite("lateral_model", "output", self.output)


@dataclass(frozen=True, slots=True)
class Observer:
    """The heading-rate observer: its gain, and A - L C with the inputs (b1, L) held over one period."""

    gain: Row  # L
    transition: tuple[Row, Row, Row, Row]
    input: Row  # per metre
    feedback: Row  # per rad/s of measured heading rate

    def __post_init__(self) -> None:
        for row in self.transition:
            _check_finite("observer", "transition", row)
        _check_finite("observer", "gain", self.gain)
        _check_finite("observer", "input", self.input)
        _check_finite("observer", "feedback", self.feedback)


@dataclass(frozen=True, slots=True)
class Windows:
    """Lengths of the moving averages."""

    heading_rate_s: float
    motor_s: float
    fault_specific_s: float

    def __post_init__(self) -> None:
        for name in self.__slots__:
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"paper.windows.{name} = {value} is no duration; give seconds > 0")


@dataclass(frozen=True, slots=True)
class Thresholds:
    """What the smoothed residuals are compared with."""

    heading_rate_rad2_s2: float
    motor_m: float
    broken_rad2_s2: float
    crossed_rad2_s2: float

    def __post_init__(self) -> None:
        _check_above_zero("paper.thresholds", {name: getattr(self, name) for name in self.__slots__})


@dataclass(frozen=True, slots=True)
class Isolation:
    """When a detected fault is named, and when a verdict is taken back."""

    motor_phase_s: float  # after detection, in which a motor is named
    fallback_s: float  # after detection, at which the smallest residual names the line fault
    clear_s: float  # for which the residual must have stayed below its threshold

    def __post_init__(self) -> None:
        if not 0.0 < self.motor_phase_s < self.fallback_s < math.inf:
            raise ValueError(
                f"paper.isolation.fallback_s = {self.fallback_s} must be longer than motor_phase_s = {self.motor_phase_s}, "
                "and both above 0"
            )
        _check_above_zero("paper.isolation", {"clear_s": self.clear_s})


@dataclass(frozen=True, slots=True)
class Confidence:
    """Share of the design flights that were named rightly, by the way of naming and the class named."""

    motor: float
    broken_line_by_elimination: float
    crossed_lines_by_elimination: float
    broken_line_by_size: float
    crossed_lines_by_size: float

    def __post_init__(self) -> None:
        _check_share("paper.confidence", {name: getattr(self, name) for name in self.__slots__})


@dataclass(frozen=True, slots=True)
class Delays:
    """Median time from the onset of a fault to its detection in the design flights, s."""

    any_s: float  # while the fault is not named
    motor_s: float
    broken_line_s: float
    crossed_lines_s: float

    def __post_init__(self) -> None:
        _check_above_zero("paper.delays", {name: getattr(self, name) for name in self.__slots__})


@dataclass(frozen=True, slots=True)
class Design:
    """Where thresholds, confidence and delays come from."""

    date: str
    command: str
    first_seed: int
    healthy_flights: int
    fault_flights: int
    false_alarms_per_flight: float  # of 600 s
    missed_share: float  # of faults, in 60 s

    def __post_init__(self) -> None:
        _check_share(
            "paper.design",
            {"false_alarms_per_flight": self.false_alarms_per_flight, "missed_share": self.missed_share},
        )


@dataclass(frozen=True, slots=True)
class Paper:
    """The method of the parafoil paper."""

    windows: Windows
    thresholds: Thresholds
    isolation: Isolation
    confidence: Confidence
    delays: Delays
    design: Design

    def __post_init__(self) -> None:
        if self.isolation.clear_s < self.windows.heading_rate_s:
            raise ValueError(
                f"paper.isolation.clear_s = {self.isolation.clear_s} must not be shorter than "
                f"paper.windows.heading_rate_s = {self.windows.heading_rate_s}: the evidence would still be in the window"
            )


@dataclass(frozen=True, slots=True)
class Response:
    """The lateral model held over one period, without feedback: how a hypothesis expects the vehicle to turn."""

    transition: tuple[Row, Row, Row, Row]
    input: Row  # per metre

    def __post_init__(self) -> None:
        for row in self.transition:
            _check_finite("response", "transition", row)
        _check_finite("response", "input", self.input)


@dataclass(frozen=True, slots=True)
class Envelope:
    """What a sound motor may do, and when an encoder accuses it."""

    slowest_rate_factor: float  # of the nominal motor
    slowest_lag_factor: float
    fastest_rate_factor: float
    fastest_lag_factor: float
    tolerance_m: float  # of the encoder beyond the envelope
    samples_outside: int  # in a row, that accuse
    settle_s: float  # after an accusation, until its kind is looked for
    moved_m: float  # that an encoder must move to have moved
    commanded_m: float  # below the encoder, that ask a motor to move
    commanded_s: float  # for so long
    clear_s: float  # beyond the value of the fault, that take the accusation back
    confidence: float  # that an accusation is right

    def __post_init__(self) -> None:
        names = [name for name in self.__slots__ if name != "confidence"]
        _check_above_zero("envelope", {name: getattr(self, name) for name in names})
        _check_share("envelope", {"confidence": self.confidence})


@dataclass(frozen=True, slots=True)
class ThresholdDesign:
    """Where a threshold of the turn monitor comes from."""

    date: str
    command: str
    first_seed: int
    healthy_flights: int
    false_alarms_per_flight: float  # of 600 s, that the rule asks for

    def __post_init__(self) -> None:
        _check_share("turns.design", {"false_alarms_per_flight": self.false_alarms_per_flight})


@dataclass(frozen=True, slots=True)
class GpsBank:
    """Filters on GPS velocity."""

    wind_noise_m_s_sqrt_s: float
    velocity_noise_m_s: float
    bias_noise_rad_s_sqrt_s: float
    coloured_time_s: float
    coloured_rad_s: float
    coloured_per_change: float
    threshold: float  # of the clipped sum of log likelihood ratios
    margin: float  # of the whole sum of the one named over all others
    design: ThresholdDesign

    def __post_init__(self) -> None:
        _check_above_zero("turns.gps", {name: getattr(self, name) for name in self.__slots__ if name != "design"})


@dataclass(frozen=True, slots=True)
class GyroBank:
    """Filters on the turn rate from gyro and attitude."""

    rate_noise_rad_s: float
    bias_noise_rad_s_sqrt_s: float
    coloured_time_s: float
    coloured_rad_s: float
    coloured_per_change: float
    threshold: float
    margin: float
    agreement: float  # lead that the GPS bank must confirm
    design: ThresholdDesign

    def __post_init__(self) -> None:
        _check_above_zero("turns.gyro", {name: getattr(self, name) for name in self.__slots__ if name != "design"})


@dataclass(frozen=True, slots=True)
class TurnMonitor:
    """The multiple-model CUSUM of the turns."""

    slack_m: float  # of each line, if it is known
    curvature_per_m: float  # turning effect of a line: d - curvature d^2
    clip: float  # of a log likelihood ratio, in the sum that alarms
    drift: float  # taken off that sum with each measurement
    floor: float  # it never falls below
    whole_clip: float  # of a ratio, in the sum that names
    surest: float  # largest confidence: models are no better than that
    hold_s: float  # from the alarm to the first naming
    noted_s: float  # between two values of bias and effectiveness that are kept
    bias_prior_rad_s: float
    effectiveness_prior: float
    bias_limit_rad_s: float
    effectiveness_limit: float
    bias_floor_rad_s: float
    effectiveness_floor: float
    level_s: float  # time constant by which the level of the noise follows the innovations
    level_clip: float  # of a squared normalised innovation
    level_limit: float  # of that level, a variance over the configured one
    level_squared: float
    calm: float
    usual_factor: float
    usual_s: float
    gps: GpsBank
    gyro: GyroBank

    def __post_init__(self) -> None:
        if self.slack_m < 0.0 or self.floor > 0.0:
            raise ValueError(f"turns.slack_m = {self.slack_m} must be >= 0 and turns.floor = {self.floor} <= 0")
        names = [name for name in self.__slots__ if name not in ("slack_m", "floor", "gps", "gyro")]
        _check_above_zero("turns", {name: getattr(self, name) for name in names})


@dataclass(frozen=True, slots=True)
class Config:
    """The `[monitor]` table.  Every record raises ValueError, in one sentence, for a value that makes no sense."""

    detector: str
    period_s: float  # of the grid's rows
    gap_s: float  # without a sample for longer than this, a residual is unknown
    warm_up_s: float  # after a start in flight and after a gap, in which turns are not judged
    settled_wind_variance_m2_s2: float  # started without a forecast, turns are judged from here on
    outputs: Outputs
    motor: Motor
    navigation: WindHeadingFilter
    lateral_model: LateralModel
    observer: Observer
    response: Response
    envelope: Envelope
    turns: TurnMonitor
    paper: Paper

    def __post_init__(self) -> None:
        if self.detector not in DETECTORS:
            raise ValueError(f"detector = {self.detector!r} is unknown; give one of {', '.join(DETECTORS)}")
        for name in ("period_s", "gap_s", "warm_up_s", "settled_wind_variance_m2_s2"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} = {getattr(self, name)} must be a number above 0")
