"""What the rows of a campaign depend on, and the airframe with another detector of its own."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import Final

from companion import configuration
from companion.airframe import Airframe

DETECTOR_KEY: Final = "detector"  # of the monitor table


@dataclass(frozen=True, slots=True)
class Settings:
    """What the rows of a campaign depend on; two campaigns with equal settings have equal rows."""

    airframe: str
    version: str
    config_sha256: str
    first_seed: int
    flights: int
    faults: tuple[str, ...]
    detector: str
    link: bool
    duration_s: float

    def as_metadata(self) -> dict[str, str]:
        """By name, as text: the metadata of the Parquet files."""
        texts = {name: str(getattr(self, name)) for name in self.__slots__}
        return texts | {"faults": ",".join(self.faults), "link": json.dumps(self.link)}


def settings_of(metadata: Mapping[str, str]) -> Settings:
    """Read what `Settings.as_metadata` has written.  Raises KeyError or ValueError for what it has not."""
    return Settings(
        metadata["airframe"],
        metadata["version"],
        metadata["config_sha256"],
        int(metadata["first_seed"]),
        int(metadata["flights"]),
        tuple(metadata["faults"].split(",")),
        metadata["detector"],
        bool(json.loads(metadata["link"])),
        float(metadata["duration_s"]),
    )


def settings(
    airframe: Airframe, first_seed: int, flights: int, faults: Sequence[str], duration_s: float, *, link: bool
) -> Settings:
    """The settings of a campaign with this airframe as it is configured."""
    detector = str(airframe.configuration.monitor.get(DETECTOR_KEY, ""))
    return Settings(
        airframe.name,
        version("mavfdi"),
        airframe.source.digest,
        first_seed,
        flights,
        tuple(faults),
        detector,
        link,
        float(duration_s),
    )


def with_detector(airframe: Airframe, name: str) -> Airframe:
    """The airframe with another detector of its own.  Raises UserError for a name that its configuration refuses."""
    table = airframe.source.table
    monitor = {**airframe.configuration.monitor, DETECTOR_KEY: name}
    origins = {**airframe.source.origins, f"monitor.{DETECTOR_KEY}": f"--{DETECTOR_KEY} {name}"}
    source = replace(airframe.source, table={**table, "monitor": monitor}, origins=origins)
    record = configuration.convert(source, monitor, airframe.detector.config, "monitor.")
    parsed = replace(airframe.configuration, monitor=monitor)
    return replace(airframe, configuration=parsed, monitor_config=record, source=source)
