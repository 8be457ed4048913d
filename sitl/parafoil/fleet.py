"""The fleet: many flights of the parafoil at once, as `sitl/vehicle.py` wants it."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from sitl.noise import StandardNormals, generators
from sitl.parafoil import dynamics, guidance
from sitl.parafoil.config import Config
from sitl.parafoil.faults import WHERE_IT_IS_M, check, install, installed, no_faults, resolve
from sitl.parafoil.flights import (
    FOLLOWED_TURN_RAD_S,
    FUNCTION_1,
    FUNCTION_2,
    GPS_DISABLED,
    GPS_NOISE,
    SLACK_M,
    Flights,
    draw,
    empty,
)
from sitl.parafoil.step import FIX_PERIOD_MS, NORMALS, SLOW_CHANNELS, WORK, begin, step
from sitl.parafoil.vehicle import CHANNELS, VEHICLE
from sitl.vehicle import Injected

# commands that change one number of a flight: array of `Flights` by name, column
_ORDERS = {
    "PF_TURN_DIR": guidance.TURN_DIRECTION,
    "PF_STUCK_SIDE": guidance.STUCK_SIDE,
    "PF_STUCK_VALUE": guidance.STUCK_VALUE_M,
    "PF_LIMIT_L": guidance.LIMIT_LEFT_M,
    "PF_LIMIT_R": guidance.LIMIT_RIGHT_M,
    "PF_PROBE": guidance.PROBE,
}
_CIRCUMSTANCES = {"SIM_FLT_SLACK": SLACK_M, "SIM_GPS_NOISE": GPS_NOISE, "SIM_GPS_DISABLE": GPS_DISABLED}
_FUNCTIONS = {"SERVO1_FUNCTION": FUNCTION_1, "SERVO2_FUNCTION": FUNCTION_2}
# what the next SIM_FLT_TYPE will arm, (4,)
_REQUESTS = {"SIM_FLT_SIDE": 0, "SIM_FLT_VALUE": 1, "SIM_FLT_TIME": 2, "SIM_FLT_CLEAR": 3}
_DEFAULTS = {parameter.name: parameter.default for parameter in VEHICLE.parameters}
_TYPES = ("", "motor:{}/stuck", "motor:{}/saturation", "broken_line:{}", "crossed_lines")


def _yaw_rate_rad_s(flights: Flights, _t_ms: int) -> NDArray[np.float64]:
    phi, theta = flights.state[:, dynamics.PHI], flights.state[:, dynamics.THETA]
    return np.asarray(
        (flights.state[:, dynamics.Q] * np.sin(phi) + flights.state[:, dynamics.R] * np.cos(phi)) / np.cos(theta)
    )


_TRUTHS: Mapping[str, Callable[[Flights, int], NDArray[np.float64]]] = {
    "yaw_rate_rad_s": _yaw_rate_rad_s,  # of the yaw angle
    "turn_rate_command_rad_s": lambda flights, _: flights.followed[:, FOLLOWED_TURN_RAD_S],  # behind what motors follow now
    "north_m": lambda flights, _: flights.state[:, dynamics.NORTH],  # from the target
    "east_m": lambda flights, _: flights.state[:, dynamics.EAST],
    "height_m": lambda flights, _: -flights.state[:, dynamics.DOWN],
    "roll_rad": lambda flights, _: flights.state[:, dynamics.PHI],
    "line_left_m": lambda flights, _: flights.line_m[:, 0],  # deflection of the edge of the canopy, mean of the step
    "line_right_m": lambda flights, _: flights.line_m[:, 1],
    "motor_1_m": lambda flights, _: flights.motor_m[:, 0],
    "motor_2_m": lambda flights, _: flights.motor_m[:, 1],
    "miss_m": lambda flights, _: np.hypot(flights.state[:, dynamics.NORTH], flights.state[:, dynamics.EAST]),  # over ground
    "flight_s": lambda flights, t_ms: np.where(flights.landed_ms >= 0, flights.landed_ms, t_ms) / 1000.0,  # touchdown or now
}


class Fleet:
    """Flights of the parafoil, one for each seed, released together.

    faults: one for each seed, or None for none at all; what a fault leaves open is drawn with the flight's own seed.
    Raises ValueError for a negative seed, a fault that this vehicle cannot have, or faults and seeds of different number.
    """

    channels: tuple[str, ...] = CHANNELS

    def __init__(self, config: Config, seeds: Sequence[int], faults: Sequence[Injected | None] | None = None) -> None:
        wanted: Sequence[Injected | None] = [None] * len(seeds) if faults is None else faults
        if len(wanted) != len(seeds):
            raise ValueError(f"{len(wanted)} faults were given for {len(seeds)} flights; give one for each, or None")
        check(wanted)
        sources = generators(seeds)
        self._flights = empty(len(seeds))
        for f, (source, fault) in enumerate(zip(sources, wanted, strict=True)):
            chance = draw(self._flights, f, config, source)
            if fault is not None:
                install(self._flights.faults[f], resolve(fault, config.faults, chance))
        self._requests = np.tile([_DEFAULTS[name] for name in _REQUESTS], (len(seeds), 1))
        self._normals = StandardNormals(sources, NORMALS)
        home, sensors = config.home, config.sensors
        self._home = np.array([math.radians(home.latitude_deg), math.radians(home.longitude_deg), home.altitude_m])
        self._sensors = np.array(
            [
                sensors.gps_position_m,
                sensors.gps_position_time_s,
                sensors.gps_velocity_m_s,
                sensors.gyro_rad_s,
                sensors.acceleration_m_s2,
                sensors.pressure_height_m,
                sensors.encoder_m,
                sensors.encoder_resolution_m,
            ]
        )
        self._work = np.zeros(WORK)
        self._slow = np.array([float(channel in SLOW_CHANNELS) for channel in CHANNELS])
        self._t_ms = 0
        self._dt_ms = 0  # not yet known
        begin(self._flights, self._normals.values, self._normals.next_row(), self._home, self._sensors, self._work)

    @property
    def time_s(self) -> float:
        """Time since release, s."""
        return self._t_ms / 1000.0

    @property
    def home(self) -> tuple[float, float, float]:
        """The target on the ground: latitude, longitude (rad), altitude above sea level (m)."""
        latitude_rad, longitude_rad, altitude_m = (float(value) for value in self._home)
        return latitude_rad, longitude_rad, altitude_m

    @property
    def landed(self) -> NDArray[np.bool_]:
        """(flight,), True from touchdown on."""
        return np.asarray(self._flights.landed_ms >= 0)

    def step(self, dt_s: float = VEHICLE.steps_s[0]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Advance every flight by dt_s, one of VEHICLE.steps_s; -> (values, age_s), (flight, channel), as `observe`.

        Raises ValueError for another step, or one that differs from the steps before.
        """
        dt_ms = round(dt_s * 1000.0)
        if dt_ms != self._dt_ms:
            if dt_s not in VEHICLE.steps_s or self._dt_ms != 0:
                raise ValueError(f"dt_s = {dt_s:g} is no step of this flight; give {self._dt_ms / 1000 or VEHICLE.steps_s}")
            self._dt_ms = dt_ms
        normals, row = self._normals.values, self._normals.next_row()
        step(self._flights, normals, row, self._t_ms, dt_ms, self._home, self._sensors, self._work)
        self._t_ms += dt_ms
        return self.observe()

    def observe(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """What the sensors say now: (values, age_s), (flight, channel), SI, new arrays.

        age_s: 0 for what sampled with the newest step, else since the newest fix, which comes every 0.2 s.  GPS channels
        are NaN from the first fix that fails on.
        """
        values = self._flights.readings.copy()
        age_s = np.empty_like(values)
        age_s[:] = self._slow * (self._t_ms % FIX_PERIOD_MS / 1000.0)
        return values, age_s

    def truth(self, name: str) -> NDArray[np.float64]:
        """What no sensor says, for tables and tests, by a name of `_TRUTHS`: (flight,), SI, NED.  Raises KeyError."""
        return np.array(_TRUTHS[name](self._flights, self._t_ms), dtype=np.float64)

    def injected(self, flight: int) -> tuple[Injected, ...]:
        """The faults of a flight, past and to come, with nothing left open: side, kind, value as drawn or commanded."""
        return installed(self._flights.faults[flight])

    def command(self, flight: int, name: str, value: float) -> None:
        """What a parameter or a command does to one flight.  Raises KeyError for a name this vehicle does not know.

        SIM_FLT_TYPE arms the fault that the other SIM_FLT_* describe at that moment, beside those already there; 0
        takes all of them away.  A motor has one fault at a time, the newer one.  An unknown type, side or instance
        raises ValueError.
        """
        flights = self._flights
        if name in _ORDERS:
            flights.orders[flight, _ORDERS[name]] = value
        elif name in _CIRCUMSTANCES:
            flights.circumstances[flight, _CIRCUMSTANCES[name]] = value
        elif name in _FUNCTIONS:
            flights.circumstances[flight, _FUNCTIONS[name]] = value
            flights.guidance[flight, guidance.INTEGRAL_M] = 0.0  # learnt with other lines in hand
        elif name in _REQUESTS:
            self._requests[flight, _REQUESTS[name]] = value
        elif name == "SIM_FLT_TYPE":
            self._arm_requested(flight, round(value))
        elif name in ("INJECT_SERVO_STUCK", "INJECT_SERVO_OK"):
            self._inject(flight, round(value), stuck=name == "INJECT_SERVO_STUCK")
        else:
            raise KeyError(name)

    def _arm_requested(self, flight: int, kind: int) -> None:
        if not 0 <= kind < len(_TYPES):
            raise ValueError(f"SIM_FLT_TYPE = {kind} is no fault; give 0 to {len(_TYPES) - 1}")
        if kind == 0:
            self._flights.faults[flight] = no_faults()
            return
        side, size_m, onset_s, clear_s = (float(request) for request in self._requests[flight])
        fault = Injected(
            _TYPES[kind].format("right" if side != 0.0 else "left"),
            self.time_s if onset_s < 0.0 else onset_s,
            size_m if kind in (1, 2) else None,
            None if clear_s <= 0.0 else clear_s,
        )
        install(self._flights.faults[flight], fault)

    def _inject(self, flight: int, instance: int, stuck: bool) -> None:
        if instance not in (0, 1, 2):
            raise ValueError(f"there is no servo {instance}; give 1 or 2, or 0 for both")
        for number, side in ((1, "left"), (2, "right")):
            if instance not in (0, number):
                continue
            if stuck:
                fault = Injected(f"motor:{side}/stuck", self.time_s, WHERE_IT_IS_M)
                install(self._flights.faults[flight], fault)
            else:
                self._flights.faults[flight, number - 1] = no_faults()[0]
