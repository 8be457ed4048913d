"""The simulated parafoil: an autonomous airdrop system of 848 kg under a canopy of 84 m2, steered by two control lines.

Plant, wind, motors, sensors, faults, navigation and guidance, batched over flights; docs/parafoil.md tells what is
modelled and what is not.  One subject a file: dynamics, navigation, guidance, faults; `step` is the order in which they
act, `flights` how a flight begins, `vehicle` what of it travels over MAVLink.
"""

from functools import cache
from typing import TYPE_CHECKING

from sitl.parafoil.config import Config
from sitl.parafoil.fleet import Fleet
from sitl.parafoil.vehicle import CHANNELS, VEHICLE

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

__all__ = ["CHANNELS", "VEHICLE", "Config", "Fleet", "quantise"]


@cache
def _quantiser() -> "Callable[[NDArray[np.float64]], NDArray[np.float64]]":
    from sitl.wire import quantiser  # pymavlink's dialect takes a third of a second to import

    return quantiser(VEHICLE.streams, CHANNELS)


def quantise(values: "NDArray[np.float64]") -> "NDArray[np.float64]":
    """The fleet's values, (..., channel), as MAVLink's fields would carry them; see `sitl.wire.quantiser`."""
    return _quantiser()(values)
