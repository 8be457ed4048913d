"""Fault detection and isolation for a guided parafoil with two motors, line encoders and GPS.

Source: Stoeckle, Fejzic, Breger, How, "Fault Detection and Isolation for Autonomous Parafoils", and ours beside it;
docs/parafoil_method.md says how the paper's open choices are settled, and how ours works.
"""

from fdi.kernel import Compiler
from fdi.parafoil.config import DETECTORS, Config
from fdi.parafoil.isolation import smallest_left
from fdi.parafoil.monitor import Parafoil
from fdi.parafoil.multimodel import MultipleModel
from fdi.parafoil.tables import CHANNELS, FAULTS, LIMITS, PARAMETERS, RESIDUALS, SIGNALS, SIGNATURES

__all__ = [
    "CHANNELS",
    "DETECTORS",
    "FAULTS",
    "LIMITS",
    "PARAMETERS",
    "RESIDUALS",
    "SIGNALS",
    "SIGNATURES",
    "Config",
    "Monitor",
    "MultipleModel",
    "Parafoil",
    "smallest_left",
]


def Monitor(config: Config, flights: int, compiler: Compiler | None = None) -> Parafoil | MultipleModel:  # noqa: N802
    """The monitor of the detector that the configuration names; the paper's has nothing to compile."""
    if config.detector == "paper":
        return Parafoil(config, flights)
    return MultipleModel(config, flights, compiler)
