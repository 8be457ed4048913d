"""Derive the heading-rate observer of the parafoil monitor from the simulated parafoil.

Trims the nominal vehicle in a straight glide, linearises its lateral motion (parafoil paper, Eqs. 3-4), finds the output
row for the heading rate of the air velocity, the observer's gain (Eq. 8) and the exact zero-order hold at the rate of
the grid, and prints the tables `[monitor.lateral_model]` and `[monitor.observer]` of configs/parafoil.toml.

    python tools/design_parafoil.py            print the tables
    python tools/design_parafoil.py --check    compare with the packaged file; exit code 1 if it differs
    python tools/design_parafoil.py --write    put them into the packaged file
"""

import argparse
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_are
from scipy.optimize import fsolve

from sitl.parafoil import dynamics

CONFIG = Path(__file__).parent.parent / "configs" / "parafoil.toml"
ALTITUDE_M = 2000.0
STEP = 1e-4  # of the central differences, in units of the states
PERIOD_S = 0.1
# Noise densities by which the gain weighs the model against the measured heading rate: of beta and of the yaw rate,
# where a measurement has density 1.  Small: a strong gain pulls the observer onto the faulty vehicle.
PROCESS_NOISE = (1e-4, 0.0, 0.0, 0.06)
FIRST, LAST = "[monitor.lateral_model]", "[monitor.paper.windows]"  # what is replaced in the file

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Design:
    """dynamics A (4, 4), input b1, output C, gain L (4,); transition, held_input, held_feedback: the discrete observer."""

    dynamics: FloatArray
    input: FloatArray
    output: FloatArray
    gain: FloatArray
    transition: FloatArray
    held_input: FloatArray
    held_feedback: FloatArray


def rates(state: FloatArray, left_m: float, right_m: float) -> FloatArray:
    """Derivative (12,) of the nominal vehicle's state in still air of the density at ALTITUDE_M."""
    body = dynamics.nominal_body()
    held = np.zeros(dynamics.HELD)
    dynamics.hold(held, body, dynamics.density_kg_m3(ALTITUDE_M))
    rate = np.zeros(dynamics.STATES)
    dynamics.derivative(state, left_m, right_m, np.zeros(dynamics.AIR), body, held, rate)
    return rate


def trim() -> tuple[float, float, float]:
    """u, w (m/s) and theta (rad) of the straight glide with released lines."""

    def unbalanced(guess: FloatArray) -> FloatArray:
        state = np.zeros(dynamics.STATES)
        state[[dynamics.U, dynamics.W, dynamics.THETA]] = guess
        return rates(state, 0.0, 0.0)[[dynamics.U, dynamics.W, dynamics.Q]]

    u, w, theta = fsolve(unbalanced, np.array([19.0, 4.7, -0.04]), xtol=1e-13)
    return float(u), float(w), float(theta)


def lateral_rates(lateral: FloatArray, pull_m: float, glide: tuple[float, float, float]) -> FloatArray:
    """d/dt of beta, roll rate, roll, yaw rate (of psi); pull_m on the right line, below zero on the left."""
    u, w, theta = glide
    speed_m_s = float(np.hypot(u, w))
    beta, roll_rate, roll, yaw_rate = lateral
    state = np.zeros(dynamics.STATES)
    state[[dynamics.U, dynamics.V, dynamics.W]] = u, speed_m_s * beta, w
    state[dynamics.P] = roll_rate - yaw_rate * np.sin(theta)
    state[dynamics.Q] = yaw_rate * np.cos(theta) * np.sin(roll)  # so that the pitch angle stands still
    state[dynamics.R] = yaw_rate * np.cos(theta) * np.cos(roll)
    state[[dynamics.PHI, dynamics.THETA]] = roll, theta
    rate = rates(state, max(-pull_m, 0.0), max(pull_m, 0.0))
    yaw = (rate[dynamics.Q] * np.sin(roll) + rate[dynamics.R] * np.cos(roll)) / np.cos(theta)
    return np.array([rate[dynamics.V] / speed_m_s, rate[dynamics.P] + yaw * np.sin(theta), roll_rate, yaw])


def design() -> Design:
    """The whole design; A, b1, C are rounded to eight decimals, L to seven, before the hold is taken."""
    glide = trim()
    u, w, theta = glide
    speed_m_s = float(np.hypot(u, w))
    horizontal_m_s = u * np.cos(theta) + w * np.sin(theta)
    a = np.empty((4, 4))
    for j, unit in enumerate(np.eye(4)):
        ahead, behind = (lateral_rates(unit * step, 0.0, glide) for step in (STEP, -STEP))
        a[:, j] = (ahead - behind) / (2.0 * STEP)
    at_rest = np.zeros(4)
    b = (lateral_rates(at_rest, STEP, glide) - lateral_rates(at_rest, -STEP, glide)) / (2.0 * STEP)
    a, b = np.round(a, 8) + 0.0, np.round(b, 8) + 0.0
    # Heading of the air velocity: chi = psi + (V beta - w phi) / Vh, so its rate leads the yaw rate.
    c = (
        np.array([0.0, 0.0, 0.0, 1.0])
        + speed_m_s / horizontal_m_s * a[0]
        - w / horizontal_m_s * np.array([0.0, 1.0, 0.0, 0.0])
    )
    c = np.round(c, 8)
    covariance = solve_continuous_are(a.T, c[:, None], np.diag(PROCESS_NOISE), np.eye(1))
    gain = np.round(covariance @ c, 7)
    augmented = np.zeros((6, 6))
    augmented[:4, :4] = a - np.outer(gain, c)
    augmented[:4, 4], augmented[:4, 5] = b, gain
    held = expm(augmented * PERIOD_S)
    return Design(a, b, c, gain, held[:4, :4], held[:4, 4], held[:4, 5])


def tables(result: Design) -> str:
    """The two tables as TOML."""

    def row(values: FloatArray) -> str:
        return "[" + ", ".join(repr(float(value)) for value in values) + "]"

    def matrix(values: FloatArray) -> str:
        return "[\n" + "".join(f"    {row(line)},\n" for line in values) + "]"

    return (
        f"{FIRST}         # states: sideslip rad, roll rate rad/s, roll rad, yaw rate rad/s\n"
        f"dynamics = {matrix(result.dynamics)}\n"
        f"input = {row(result.input)} # per metre pulled, right less left\n"
        f"output = {row(result.output)} # heading rate of the air velocity, rad/s\n"
        "[monitor.observer]              # A - L C with the inputs (b1, L), held over one period\n"
        f"gain = {row(result.gain)} # L\n"
        f"transition = {matrix(result.transition)}\n"
        f"input = {row(result.held_input)}\n"
        f"feedback = {row(result.held_feedback)}\n"
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare with configs/parafoil.toml")
    parser.add_argument("--write", action="store_true", help="put the tables into configs/parafoil.toml")
    arguments = parser.parse_args()
    text = tables(design())
    if arguments.check:
        shipped = tomllib.loads(CONFIG.read_text())["monitor"]
        same = all(shipped[name] == table for name, table in tomllib.loads(text)["monitor"].items())
        print("the packaged tables are those of this design" if same else "the packaged tables differ from this design")
        return 0 if same else 1
    if arguments.write:
        packaged = CONFIG.read_text()
        before, after = packaged[: packaged.index(FIRST)], packaged[packaged.index(LAST) :]
        CONFIG.write_text(before + text + after)
        return 0
    print(text, end="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
