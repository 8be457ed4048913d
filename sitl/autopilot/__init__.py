"""The autopilot of a simulated vehicle: a MAVLink component as others know them, around any airframe's fleet."""

from sitl.autopilot.autopilot import Autopilot, Rates
from sitl.autopilot.commands import Result
from sitl.autopilot.housekeeping import Home, Severity
from sitl.autopilot.misbehaviour import CommandMode, Misbehaviour, ParameterMode
from sitl.autopilot.mission import MissionItem
from sitl.autopilot.routing import EVERYBODY

__all__ = [
    "EVERYBODY",
    "Autopilot",
    "CommandMode",
    "Home",
    "Misbehaviour",
    "MissionItem",
    "ParameterMode",
    "Rates",
    "Result",
    "Severity",
]
