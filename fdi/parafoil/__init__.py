"""Fault detection and isolation for a guided parafoil with two motors, line encoders and GPS.

Source: Stoeckle, Fejzic, Breger, How, "Fault Detection and Isolation for Autonomous Parafoils";
docs/parafoil_method.md says how its open choices are settled.
"""

from fdi.parafoil.config import Config
from fdi.parafoil.isolation import smallest_left
from fdi.parafoil.monitor import Parafoil
from fdi.parafoil.tables import CHANNELS, FAULTS, LIMITS, PARAMETERS, RESIDUALS, SIGNALS, SIGNATURES

Monitor = Parafoil

__all__ = [
    "CHANNELS",
    "FAULTS",
    "LIMITS",
    "PARAMETERS",
    "RESIDUALS",
    "SIGNALS",
    "SIGNATURES",
    "Config",
    "Monitor",
    "Parafoil",
    "smallest_left",
]
