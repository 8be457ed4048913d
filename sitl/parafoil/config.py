"""What an owner may vary of the simulated parafoil: the `[sitl]` table of its configuration."""

import math
from dataclasses import dataclass

from sitl.parafoil.dynamics import TRAVEL_M

Range = tuple[float, float]  # lowest, highest; drawn evenly


def _check_range(name: str, values: Range, lowest: float = -math.inf, highest: float = math.inf) -> None:
    low, high = values
    if not (math.isfinite(low) and math.isfinite(high) and lowest <= low <= high <= highest):
        raise ValueError(f"{name} = {list(values)} is no range; give [low, high] within {lowest:g} to {highest:g}")


def _check(name: str, value: float, lowest: float, highest: float = math.inf) -> None:
    if not (math.isfinite(value) and lowest <= value <= highest):
        raise ValueError(f"{name} = {value:g} is out of range; give {lowest:g} to {highest:g}")


@dataclass(frozen=True, slots=True)
class Spread:
    """A factor or offset that differs from vehicle to vehicle: normal about its nominal value, cut off at both ends."""

    sd: float
    lowest: float
    highest: float

    def __post_init__(self) -> None:
        if not (self.sd >= 0.0 and math.isfinite(self.sd)):
            raise ValueError(f"sd = {self.sd:g} is no standard deviation; give a number >= 0")
        if not self.lowest <= self.highest:
            raise ValueError(f"lowest = {self.lowest:g} lies above highest = {self.highest:g}; exchange them")


@dataclass(frozen=True, slots=True)
class Home:
    """Where the target lies."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float  # above sea level

    def __post_init__(self) -> None:
        _check("latitude_deg", self.latitude_deg, -85.0, 85.0)
        _check("longitude_deg", self.longitude_deg, -180.0, 180.0)
        _check("altitude_m", self.altitude_m, -500.0, 4000.0)


@dataclass(frozen=True, slots=True)
class Release:
    """Where flights begin."""

    height_m: Range  # above the target
    distance_fraction: Range  # of 2.9 times the height, in the air mass

    def __post_init__(self) -> None:
        _check_range("height_m", self.height_m, 1.0, 5900.0)
        _check_range("distance_fraction", self.distance_fraction, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Wind:
    """Wind and turbulence of the flights."""

    speed_10m_m_s: Range
    veer_rad_km: float  # standard deviation
    shear_m_s: Range  # amplitude of the shear wave
    shear_length_m: Range
    forecast_error_m_s: float  # standard deviation, per axis
    turbulence_m_s: Range  # sigma above 610 m

    def __post_init__(self) -> None:
        _check_range("speed_10m_m_s", self.speed_10m_m_s, 0.0, 40.0)
        _check("veer_rad_km", self.veer_rad_km, 0.0)
        _check_range("shear_m_s", self.shear_m_s, 0.0, 40.0)
        _check_range("shear_length_m", self.shear_length_m, 50.0, 1e5)
        _check("forecast_error_m_s", self.forecast_error_m_s, 0.0, 40.0)
        _check_range("turbulence_m_s", self.turbulence_m_s, 0.0, 10.0)


@dataclass(frozen=True, slots=True)
class Vehicles:
    """How vehicles differ from the nominal one."""

    payload_factor: Range
    drag_factor: Spread
    turn_factor: Spread
    turn_bias_m: Spread
    line_factor: Spread
    motor_rate_factor: Spread
    motor_lag_factor: Spread

    def __post_init__(self) -> None:
        _check_range("payload_factor", self.payload_factor, 0.2, 5.0)
        for name in ("drag_factor", "turn_factor", "line_factor", "motor_rate_factor", "motor_lag_factor"):
            if not getattr(self, name).lowest > 0.0:
                raise ValueError(f"{name}.lowest = {getattr(self, name).lowest:g} must be positive")


@dataclass(frozen=True, slots=True)
class Sensors:
    """Errors of the sensors, standard deviations unless said otherwise."""

    gps_position_m: float
    gps_position_time_s: float  # time constant of the position's error
    gps_velocity_m_s: float
    gyro_rad_s: float
    gyro_bias_rad_s: float
    tilt_offset_rad: float  # roll and pitch, constant in a flight
    yaw_offset_rad: float
    acceleration_m_s2: float
    pressure_height_m: float
    encoder_m: float
    encoder_resolution_m: float

    def __post_init__(self) -> None:
        for name in self.__slots__:
            _check(name, getattr(self, name), 0.0)
        if self.gps_position_time_s == 0.0:
            raise ValueError("gps_position_time_s = 0 is no time constant; give seconds > 0")


@dataclass(frozen=True, slots=True)
class Guidance:
    """Limits of the autopilot's guidance."""

    turn_limit_rad_s: float
    s_turn_limit_rad: float
    final_limit_rad: float
    final_leg_s: float
    flare_height_m: float
    flare_m: float
    integral_limit_m: float

    def __post_init__(self) -> None:
        _check("turn_limit_rad_s", self.turn_limit_rad_s, 0.01, 1.0)
        _check("s_turn_limit_rad", self.s_turn_limit_rad, 0.0, math.pi / 2)
        _check("final_limit_rad", self.final_limit_rad, 0.0, math.pi / 2)
        _check("final_leg_s", self.final_leg_s, 0.0, 79.0)
        _check("flare_height_m", self.flare_height_m, 0.0)
        _check("flare_m", self.flare_m, 0.0, TRAVEL_M)
        _check("integral_limit_m", self.integral_limit_m, 0.0, TRAVEL_M)


@dataclass(frozen=True, slots=True)
class Faults:
    """Sizes drawn where a fault is injected without one, and what is wrong from the start."""

    stuck_m: Range
    saturation_m: Range
    slack_m: float  # of both lines

    def __post_init__(self) -> None:
        _check_range("stuck_m", self.stuck_m, 0.0, TRAVEL_M)
        _check_range("saturation_m", self.saturation_m, 0.0, TRAVEL_M)
        _check("slack_m", self.slack_m, 0.0, TRAVEL_M)


@dataclass(frozen=True, slots=True)
class Config:
    """The `[sitl]` table.  Every record raises ValueError, one sentence, for values that make no sense."""

    home: Home
    release: Release
    wind: Wind
    vehicles: Vehicles
    sensors: Sensors
    guidance: Guidance
    faults: Faults
