"""Simulated sled: it follows the commanded speed with a lag, until its thruster loses part of its thrust.

    d(speed)/dt = (thrust * command - speed) / time constant        thrust: 1 healthy, 1 - loss after thruster_loss

The rail runs north.  Output 1 carries the commanded speed, 1000 us at rest to 2000 us at 20 m/s.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sitl.vehicle import Field, Injected, Injection, Parameter, Stream, Vehicle, check_faults

SPEED_AT_FULL_PULSE_M_S = 20.0
EARTH_RADIUS_M = 6_371_000.0
THRUSTER = 70  # output function "throttle"

CHANNELS = (
    "latitude_rad", "longitude_rad", "altitude_m", "height_m",
    "velocity_north_m_s", "velocity_east_m_s", "velocity_down_m_s", "heading_rad",
    "wheel_distance_1_m", "output_1_us", "speed_command_m_s",
)  # fmt: skip
_GPS = slice(0, 7)
_DEG_E7 = math.degrees(1.0) * 1e7


@dataclass(frozen=True, slots=True)
class Config:
    """The [sitl] table."""

    rail_length_m: float
    time_constant_s: float
    speed_m_s: float
    speed_swing_m_s: float
    swing_period_s: float
    speed_noise_m_s: float
    loss: tuple[float, float]
    home_latitude_deg: float
    home_longitude_deg: float

    def __post_init__(self) -> None:
        for name in ("rail_length_m", "time_constant_s", "swing_period_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"sitl.{name} = {getattr(self, name)} must be greater than 0")
        if not 0.0 <= self.speed_swing_m_s <= self.speed_m_s <= SPEED_AT_FULL_PULSE_M_S:
            raise ValueError("sitl.speed_swing_m_s and sitl.speed_m_s must be 0 <= swing <= speed <= 20")


class Fleet:
    """Sleds, each with its own seed."""

    channels = CHANNELS

    def __init__(self, config: Config, seeds: Sequence[int], faults: Sequence[Injected | None] | None = None) -> None:
        flights = len(seeds)
        self._faults = list(faults) if faults is not None else [None] * flights
        check_faults(self._faults, VEHICLE.fault_ids)
        self._config = config
        self._random = [np.random.Generator(np.random.PCG64(seed)) for seed in seeds]
        for f, fault in enumerate(self._faults):
            drawn = float(self._random[f].uniform(*config.loss))  # drawn for all, so that a fault changes no noise
            if fault is not None and fault.value is None:
                self._faults[f] = replace(fault, value=drawn)
        self._time_s = 0.0
        self._steps = 0
        self._position_m = np.zeros(flights)
        self._speed_m_s = np.zeros(flights)
        self._mean_m_s = np.full(flights, config.speed_m_s)
        self._loss = np.zeros(flights)  # by parameter or injection
        self._function = np.full(flights, float(THRUSTER))
        self._gps_off = np.zeros(flights, dtype=bool)
        self._output_us = np.full(flights, 1000.0)
        self._command_m_s = np.zeros(flights)
        self._noise_m_s = np.zeros(flights)
        self._landed = np.zeros(flights, dtype=bool)

    @property
    def home(self) -> tuple[float, float, float]:
        latitude_rad, longitude_rad = (
            math.radians(self._config.home_latitude_deg),
            math.radians(self._config.home_longitude_deg),
        )
        return latitude_rad, longitude_rad, 400.0

    @property
    def landed(self) -> np.ndarray:
        return self._landed.copy()

    def step(self, dt_s: float) -> tuple[np.ndarray, np.ndarray]:
        self._steps += 1
        self._time_s = self._steps * dt_s
        upper_half = self._time_s % self._config.swing_period_s < self._config.swing_period_s / 2.0
        swing_m_s = self._config.speed_swing_m_s if upper_half else -self._config.speed_swing_m_s
        self._command_m_s = np.clip(self._mean_m_s + swing_m_s, 0.0, SPEED_AT_FULL_PULSE_M_S)
        powered = self._function == THRUSTER
        self._output_us = np.where(powered, 1000.0 + 1000.0 * self._command_m_s / SPEED_AT_FULL_PULSE_M_S, 1000.0)
        thrust = np.where(powered, (1.0 - self._loss) * (1.0 - self._injected_loss()), 0.0)
        share = 1.0 - math.exp(-dt_s / self._config.time_constant_s)
        moving = ~self._landed
        self._speed_m_s = np.where(moving, self._speed_m_s + share * (thrust * self._command_m_s - self._speed_m_s), 0.0)
        self._position_m = self._position_m + self._speed_m_s * dt_s
        self._landed = self._landed | (self._position_m >= self._config.rail_length_m)
        self._noise_m_s = self._config.speed_noise_m_s * np.array([random.standard_normal() for random in self._random])
        return self.observe()

    def observe(self) -> tuple[np.ndarray, np.ndarray]:
        flights = len(self._random)
        values = np.empty((flights, len(CHANNELS)))
        latitude_rad = math.radians(self._config.home_latitude_deg) + self._position_m / EARTH_RADIUS_M
        longitude_rad = math.radians(self._config.home_longitude_deg)
        columns = (
            latitude_rad, longitude_rad, 400.0, 0.0, self._speed_m_s + self._noise_m_s, 0.0, 0.0, 0.0,
            self._position_m, self._output_us, self._command_m_s,
        )  # fmt: skip
        for c, column in enumerate(columns):
            values[:, c] = column
        values[self._gps_off, _GPS] = np.nan
        return values, np.zeros_like(values)

    def command(self, flight: int, name: str, value: float) -> None:
        if name == "SERVO1_FUNCTION":
            self._function[flight] = value
        elif name == "SLED_SPEED":
            self._mean_m_s[flight] = value
        elif name in ("SIM_FLT_LOSS", "INJECT_MOTOR_OFF", "INJECT_MOTOR_OK"):
            self._loss[flight] = {"SIM_FLT_LOSS": value, "INJECT_MOTOR_OFF": 1.0, "INJECT_MOTOR_OK": 0.0}[name]
        elif name == "SIM_GPS_DISABLE":
            self._gps_off[flight] = value != 0.0
        else:
            raise KeyError(name)

    def _injected_loss(self) -> np.ndarray:
        return np.array(
            [
                fault.value
                if fault is not None
                and fault.onset_s <= self._time_s
                and (fault.clear_s is None or self._time_s < fault.clear_s)
                else 0.0
                for fault in self._faults
            ]
        )


VEHICLE = Vehicle(
    name="sled",
    mav_type=10,  # MAV_TYPE_GROUND_ROVER
    modes={"AUTO": 10, "HOLD": 4},
    streams=(
        Stream(
            "GLOBAL_POSITION_INT", 5.0, 10.0,
            (
                Field("lat", "latitude_rad", _DEG_E7), Field("lon", "longitude_rad", _DEG_E7),
                Field("alt", "altitude_m", 1000.0), Field("relative_alt", "height_m", 1000.0),
                Field("vx", "velocity_north_m_s", 100.0), Field("vy", "velocity_east_m_s", 100.0),
                Field("vz", "velocity_down_m_s", 100.0), Field("hdg", "heading_rad", math.degrees(100.0)),
            ),
        ),
        Stream(
            "GPS_RAW_INT", 5.0, 5.0,
            (
                Field("lat", "latitude_rad", _DEG_E7), Field("lon", "longitude_rad", _DEG_E7),
                Field("alt", "altitude_m", 1000.0), Field("vel", "velocity_north_m_s", 100.0),
            ),
            {"fix_type": 3, "satellites_visible": 12},
        ),
        Stream("SERVO_OUTPUT_RAW", 10.0, 50.0, (Field("servo1_raw", "output_1_us"),)),
        Stream("WHEEL_DISTANCE", 10.0, 50.0, (Field("distance[0]", "wheel_distance_1_m"),), {"count": 1}),
        Stream("VFR_HUD", 5.0, 5.0, (Field("groundspeed", "velocity_north_m_s"), Field("heading", "heading_rad"))),
        Stream("POSITION_TARGET_LOCAL_NED", 2.0, 10.0, (Field("vx", "speed_command_m_s"),), {"coordinate_frame": 1}),
    ),
    parameters=(
        Parameter("SERVO1_FUNCTION", THRUSTER, True, 0, 150),
        Parameter("SERVO1_MIN", 1000, True, 500, 2200, acts=False),
        Parameter("SLED_SPEED", 8.0, False, 0.0, SPEED_AT_FULL_PULSE_M_S),
        Parameter("SIM_FLT_LOSS", 0.0, False, 0.0, 1.0),
        Parameter("SIM_GPS_DISABLE", 0, True, 0, 1),
    ),
    injections=(
        Injection(101, 1, 1, "INJECT_MOTOR_OFF"),  # FAILURE_UNIT_SYSTEM_MOTOR, FAILURE_TYPE_OFF
        Injection(101, 0, 1, "INJECT_MOTOR_OK"),
    ),
    fault_ids=("thruster_loss",),
    steps_s=(0.1, 0.02),
)  # fmt: skip
