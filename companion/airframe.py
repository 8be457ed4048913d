"""Finding an airframe by its name: its detector, its configuration and, where there is one, its simulator.

Built in: `fdi/NAME.py`, `configs/NAME.toml`, `sitl/NAME.py`.  From outside: an entry point of the group
`mavfdi.airframes` that names a package holding the same three as `fdi`, `airframe.toml` and `sitl`.
"""

import importlib
import importlib.util
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import metadata, resources
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from companion import configuration
from companion.checks import CHECKS
from companion.configuration import Configuration, Source
from companion.decode import Decoder
from companion.errors import UserError
from companion.recovery import Plan
from fdi.kernel import Compiler
from fdi.verdict import Fault, Monitor, Signature

ENTRY_POINTS: Final = "mavfdi.airframes"


@dataclass(frozen=True, slots=True)
class Detector:
    """What `fdi/NAME.py` offers, by the names that it must have there."""

    channels: tuple[str, ...]  # CHANNELS: what a row holds, in this order
    parameters: tuple[str, ...]  # PARAMETERS: the vehicle's parameters that the judgement depends on
    faults: tuple[Fault, ...]  # FAULTS
    residuals: tuple[str, ...]  # RESIDUALS
    signals: tuple[str, ...]  # SIGNALS
    signatures: tuple[Signature, ...]  # SIGNATURES
    config: type[Any]  # Config: the record of the [monitor] table
    monitor: Callable[..., Monitor]  # Monitor(config, flights=n, compiler=None)


@dataclass(frozen=True, slots=True)
class Airframe:
    """One airframe, configured."""

    name: str
    detector: Detector
    configuration: Configuration
    monitor_config: object  # the record of [monitor]
    source: Source
    simulator: str | None  # module name, imported only by the commands that fly it

    def monitor(self, flights: int = 1, compiler: Compiler | None = None) -> Monitor:
        """compiler: for a monitor that has much to do and is made of kernels (companion/compiler.py)."""
        return self.detector.monitor(self.monitor_config, flights=flights, compiler=compiler)

    def plan(self, fault: Fault) -> Plan | None:
        """What mends this fault: by its id, else by its class."""
        return self.configuration.recovery.get(fault.id) or self.configuration.recovery.get(fault.fault_class)

    def load_simulator(self) -> ModuleType:
        """The airframe's simulator module.  Raises UserError if it has none or its extra is not installed."""
        if self.simulator is None:
            raise UserError(f"airframe {self.name} has no simulator; fly it in its own and use `mavfdi run {self.name}`")
        try:
            return importlib.import_module(self.simulator)
        except ModuleNotFoundError as error:
            if error.name and error.name.partition(".")[0] == "numba":
                raise UserError("the simulator needs numba; install it with: pip install 'mavfdi[sitl]'") from None
            raise

    def simulator_config(self, module: ModuleType) -> object:
        return configuration.convert(self.source, self.source.table.get("sitl", {}), module.Config, "sitl.")


@dataclass(frozen=True, slots=True)
class Place:
    """Where an airframe's three files are."""

    fdi: str
    sitl: str
    toml_package: str
    toml_name: str


def places() -> Mapping[str, Place]:
    """All airframes that can be found, by name; the built-in ones first."""
    found: dict[str, Place] = {}
    for entry in sorted(resources.files("configs").iterdir(), key=lambda file: file.name):
        name, dot, ending = entry.name.rpartition(".")
        if dot and ending == "toml":
            found[name] = Place(f"fdi.{name}", f"sitl.{name}", "configs", entry.name)
    for point in metadata.entry_points(group=ENTRY_POINTS):
        found.setdefault(point.name, Place(f"{point.value}.fdi", f"{point.value}.sitl", point.value, "airframe.toml"))
    return found


def load(name: str, owners: Path | None = None) -> Airframe:
    """Find and configure an airframe.  Raises UserError for an unknown name or a bad configuration."""
    known = places()
    if name not in known:
        raise UserError(f"unknown airframe {name!r}; known: {', '.join(known)}")
    place = known[name]
    module = importlib.import_module(place.fdi)
    detector = Detector(
        module.CHANNELS,
        module.PARAMETERS,
        module.FAULTS,
        module.RESIDUALS,
        module.SIGNALS,
        module.SIGNATURES,
        module.Config,
        module.Monitor,
    )
    packaged = resources.files(place.toml_package).joinpath(place.toml_name)
    source = configuration.read(packaged.read_text(encoding="utf-8"), f"{place.toml_package}/{place.toml_name}", owners)
    parsed = configuration.convert(source, source.table, Configuration)
    _check_names(name, source, detector, parsed)
    monitor_config = configuration.convert(source, parsed.monitor, detector.config, "monitor.")
    simulator = place.sitl if _exists(place.sitl) else None
    return Airframe(name, detector, parsed, monitor_config, source, simulator)


def _exists(module: str) -> bool:
    """Whether there is such a module, without importing the package around it: the live path loads no simulator."""
    package = importlib.util.find_spec(module.rpartition(".")[0])
    return package is not None and PathFinder.find_spec(module, package.submodule_search_locations) is not None


def _check_names(name: str, source: Source, detector: Detector, parsed: Configuration) -> None:
    """What one table says by name must exist in another."""
    files = " + ".join(sorted(set(source.origins.values())))
    deliverable = Decoder(detector.channels).messages
    if unused := set(parsed.streams) - set(deliverable):
        raise UserError(
            f"{files}: streams.{sorted(unused)[0]} delivers no channel of {name}; it uses {', '.join(deliverable)}"
        )
    if strange := set(parsed.grid.maximal_ages_s) - set(detector.channels):
        raise UserError(f"{files}: grid.maximal_ages_s.{sorted(strange)[0]} is no channel of {name}")
    if unknown := set(parsed.checks.skip) - {check.id for check in CHECKS}:
        raise UserError(f"{files}: checks.skip: there is no check {sorted(unknown)[0]!r}; docs/checks.md lists them")
    faults = {fault.id for fault in detector.faults} | {fault.fault_class for fault in detector.faults}
    for fault_id, plan in parsed.recovery.items():
        if fault_id not in faults:
            raise UserError(f"{files}: recovery.{fault_id} is no fault of {name}; known: {', '.join(sorted(faults))}")
        for key, value, allowed in (
            ("verify_residual", plan.verify_residual, detector.residuals),
            ("excitation_signal", plan.excitation_signal, detector.signals),
        ):
            if value not in allowed:
                raise UserError(f"{files}: recovery.{fault_id}.{key} = {value!r}; known: {', '.join(allowed)}")
