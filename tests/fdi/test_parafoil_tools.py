"""The design tool gives what is packaged; a small campaign comes out within the method's known figures."""

import importlib.util
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from intervals import wilson

TOOLS = Path(__file__).parents[2] / "tools"


def tool(name):
    spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def campaign():
    return tool("montecarlo_parafoil")


def test_packaged_observer_is_that_of_the_plants_linear_model(config):
    design = tool("design_parafoil").design()
    assert design.dynamics == pytest.approx(np.array(config.lateral_model.dynamics), abs=2e-8)
    assert design.input == pytest.approx(np.array(config.lateral_model.input), abs=2e-8)
    assert design.output == pytest.approx(np.array(config.lateral_model.output), abs=2e-8)
    assert design.gain == pytest.approx(np.array(config.observer.gain), abs=2e-7)
    assert design.transition == pytest.approx(np.array(config.observer.transition), abs=2e-8)
    assert design.held_input == pytest.approx(np.array(config.observer.input), abs=2e-8)
    assert design.held_feedback == pytest.approx(np.array(config.observer.feedback), abs=2e-8)


def test_wilson_intervals_have_their_published_values():
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)  # Newcombe (1998), table I, method 3


def test_best_threshold_maximises_the_figure_of_merit(campaign):
    rng = np.random.default_rng(1)
    healthy, faulty = rng.exponential(1.0, 300), rng.exponential(4.0, 200)
    threshold, false_alarms, missed, merit = campaign.best_threshold(healthy, faulty)
    assert false_alarms == pytest.approx(np.mean(healthy > threshold))
    assert missed == pytest.approx(np.mean(faulty <= threshold))
    assert all(1.0 - 0.5 * (np.mean(healthy > t) + np.mean(faulty <= t)) <= merit + 1e-12 for t in (*healthy, *faulty))


def test_crossed_lines_of_the_simulated_vehicle_are_detected_and_named(campaign):
    crossed = next(kind for kind in campaign.KINDS if kind.name == "crossed")
    outcomes = campaign.fly(crossed, np.arange(40_000_000, 40_000_012), tomllib.loads(campaign.CONFIG.read_text()), True)
    assert np.isfinite(outcomes.detected_s).sum() >= 11
    assert outcomes.right.sum() >= 10
    assert np.nanmedian(outcomes.detected_s) < 10.0
    assert np.all(outcomes.isolated_s[outcomes.right] >= outcomes.detected_s[outcomes.right])
