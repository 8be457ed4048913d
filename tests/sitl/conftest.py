"""The packaged configuration of the simulated parafoil, as its tests fly it."""

import tomllib
from importlib.resources import files

import msgspec
import pytest

from sitl.parafoil import Config


@pytest.fixture(scope="session")
def parafoil_config() -> Config:
    table = tomllib.loads(files("configs").joinpath("parafoil.toml").read_text())
    return msgspec.convert(table["sitl"], Config)
