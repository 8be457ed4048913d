"""The configuration as packaged, a small vehicle that obeys the monitor's own linear model, and the simulated one."""

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import settings
from scipy.linalg import expm

import fdi.parafoil as parafoil
from companion import airframe as airframes
from companion.campaign import flight
from companion.compiler import compiler
from fdi.verdict import NO_FAULT, Phase
from sitl.ensemble import Ensemble

PERIOD_S = 0.1

# Property tests draw the same examples in every run, on a machine of any speed.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def config():
    text = (Path(__file__).parents[2] / "configs" / "parafoil.toml").read_text()
    return msgspec.convert(tomllib.loads(text)["monitor"], parafoil.Config)


@dataclass(frozen=True)
class Scenario:
    """One scripted flight; fault is an id with its kind, None for a healthy one."""

    fault: str | None = None
    onset_s: float = 30.0
    stuck_m: float = 0.9
    swapped_s: float = np.inf  # from then on the functions of the outputs are exchanged
    mirrored: bool = False
    seed: int = 1
    turn_m: float = 0.55  # toggle of the S-turns
    first_turn: float = 1.0


class LinearVehicle:
    """Motors, lines and the linear lateral model under S-turns; wind 3 m/s; GPS every second row."""

    def __init__(self, config, scenario):
        self.config, self.scenario = config, scenario
        model = config.lateral_model
        augmented = np.zeros((5, 5))
        augmented[:4, :4], augmented[:4, 4] = np.array(model.dynamics), np.array(model.input)
        held = expm(augmented * PERIOD_S)
        self.transition, self.input, self.output = held[:4, :4], held[:4, 4], np.array(model.output)
        self.state, self.motor_m, self.heading_rad, self.altitude_m = np.zeros(4), np.zeros(2), 0.4, 3000.0
        self.rng = np.random.default_rng(scenario.seed)
        self.fix = np.zeros(2)
        self.k = 0

    def row(self):
        """(values, age_s), each (channel,), before release for the first row and in flight from then on."""
        scenario, at = self.scenario, {name: index for index, name in enumerate(parafoil.CHANNELS)}
        time_s = self.k * PERIOD_S
        side = -1.0 if scenario.mirrored else 1.0
        toggle_m = 0.0
        if self.k:
            turn = scenario.first_turn if time_s % 24.0 < 12.0 else -scenario.first_turn
            toggle_m = turn * side * scenario.turn_m
        command_m = np.array([max(-toggle_m, 0.0), max(toggle_m, 0.0)])  # left, right by function
        if time_s >= scenario.swapped_s:
            command_m = command_m[::-1].copy()
        active = scenario.fault if time_s >= scenario.onset_s else None
        if active is not None and scenario.mirrored:
            active = {"left": active.replace("left", "right"), "right": active.replace("right", "left")}.get(
                active.partition(":")[2], active
            )
        share = 1.0 - np.exp(-PERIOD_S / self.config.motor.lag_s)
        step_m = np.clip((command_m - self.motor_m) * share, -0.07, 0.07)
        if active is not None and active.startswith("motor"):
            stuck = 0 if active.endswith("left") else 1
            step_m[stuck] = np.clip(scenario.stuck_m - self.motor_m[stuck], -0.07, 0.07)
        self.motor_m += step_m
        edges_m = self.motor_m.copy()
        if active == "crossed_lines":
            edges_m = edges_m[::-1]
        elif active is not None and active.startswith("broken_line"):
            edges_m[0 if active.endswith("left") else 1] = 0.0
        if self.k:
            self.state = self.transition @ self.state + self.input * (edges_m[1] - edges_m[0])
            self.heading_rad += PERIOD_S * float(self.output @ self.state)
            self.altitude_m -= 0.55
        noise = self.rng.normal(0.0, 1.0, 4) * np.array([0.05, 0.05 * side, 0.002, 0.002])
        new_fix = self.k % 2 == 0
        if new_fix:
            speed_m_s = 18.99 * np.sqrt(1.00649 / (1.225 * (1.0 - 2.25577e-5 * self.altitude_m) ** 4.2559))
            air = np.array([np.cos(self.heading_rad), np.sin(self.heading_rad)])
            self.fix = np.array([-3.0, 0.0]) + speed_m_s * air + noise[:2]
        values, age_s = np.zeros(len(parafoil.CHANNELS)), np.zeros(len(parafoil.CHANNELS))
        encoder_noise = noise[2:] if not scenario.mirrored else noise[3:1:-1]
        values[at["armed"]] = 1.0 if self.k else 0.0
        values[at["velocity_north_m_s"]], values[at["velocity_east_m_s"]] = self.fix
        values[at["altitude_m"]] = self.altitude_m
        values[[at["output_1_us"], at["output_2_us"]]] = 1000.0 + command_m / 0.0015
        values[[at["wheel_distance_1_m"], at["wheel_distance_2_m"]]] = self.motor_m + encoder_noise
        values[at["yaw_rate_rad_s"]] = self.state[3]
        values[at["turn_rate_command_rad_s"]] = 0.364795 * toggle_m
        values[at["wind_speed_m_s"]] = 3.0  # from the north
        age_s[at["velocity_north_m_s"] : at["altitude_m"] + 1] = 0.0 if new_fix else PERIOD_S
        self.k += 1
        return values, age_s


@pytest.fixture(scope="session")
def fly(config):
    """fly(scenarios, seconds) -> (values, age_s), each (row, flight, channel), the first row before release."""

    def fly_all(scenarios, seconds):
        rows = round(seconds / PERIOD_S) + 1
        shape = (rows, len(scenarios), len(parafoil.CHANNELS))
        values, age_s = np.zeros(shape), np.zeros(shape)
        for f, scenario in enumerate(scenarios):
            vehicle = LinearVehicle(config, scenario)
            if scenario.mirrored:
                vehicle.heading_rad = -vehicle.heading_rad
            for k in range(rows):
                values[k, f], age_s[k, f] = vehicle.row()
        return values, age_s

    return fly_all


@pytest.fixture(scope="session")
def scenario():
    return Scenario


@pytest.fixture(params=["gyro", "gps"])
def our_config(request, config):
    """The packaged configuration with each of our detectors in turn."""
    return replace(config, detector=request.param)


@pytest.fixture(scope="session")
def machine():
    """A compiler that makes each kernel once, however many monitors are built with it."""
    make, made = compiler(), {}

    def once(function):
        name = function.__module__, function.__qualname__
        if name not in made:
            made[name] = make(function)
        return made[name]

    return once


@pytest.fixture(scope="session")
def simulate():
    """simulate(faults, seconds, first_seed, orders, link) -> (values, age_s), each (row, flight, channel).

    Flights of the simulated parafoil, one for each fault (`Injected`, or None), with consecutive seeds; the first row is
    that of release.  orders: (seconds, flight, command, value); link: through a line that rounds, loses and delays.
    """
    parafoil_airframe = airframes.load("parafoil")
    simulator = parafoil_airframe.load_simulator()

    def simulate_all(faults, seconds, first_seed, orders=(), link=False):
        seeds = range(first_seed, first_seed + len(faults))
        fleet = simulator.Fleet(parafoil_airframe.simulator_config(simulator), seeds, faults)
        listener = flight.listener(parafoil_airframe, simulator.VEHICLE) if link else None
        flown = Ensemble(simulator.VEHICLE, fleet, seeds, flight.grid(parafoil_airframe), listener)
        rows = []
        for row in flown.rows(seconds):
            for _, f, command, value in (order for order in orders if round(order[0] * 1e6) == row.t_us):
                fleet.command(f, command, value)
            if row.t_us >= 0:
                rows.append((row.values.copy(), row.age_s.copy()))
        return np.array([values for values, _ in rows]), np.array([age_s for _, age_s in rows])

    return simulate_all


class Judgement:
    """All verdicts of a monitor over the rows, by name: (row, flight) or (row, flight, ...)."""

    def __init__(self, verdicts):
        for name in ("phase", "fault", "confidence", "size", "onset_s", "residuals", "signals"):
            setattr(self, name, np.array([getattr(verdict, name) for verdict in verdicts]))

    def ids(self, flight=0):
        """What is named in each row, None where nothing is."""
        return [None if fault == NO_FAULT else parafoil.FAULTS[fault].id for fault in self.fault[:, flight]]

    def named_s(self, fault_id, flight=0):
        """When it is named first, s; infinity if it never is."""
        ids = self.ids(flight)
        return ids.index(fault_id) * PERIOD_S if fault_id in ids else np.inf

    def phases(self, flight=0):
        return [Phase(phase) for phase in self.phase[:, flight]]


@pytest.fixture(scope="session")
def judge(machine):
    """judge(config or monitor, values, age_s) -> (Judgement, monitor); compiled, where it is built here."""

    def judge_all(monitor, values, age_s):
        if isinstance(monitor, parafoil.Config):
            monitor = parafoil.Monitor(monitor, values.shape[1], machine)
        rows = zip(np.ascontiguousarray(values), np.ascontiguousarray(age_s), strict=True)
        return Judgement([monitor.step(row, age) for row, age in rows]), monitor

    return judge_all
