"""The configuration of one airframe: the packaged TOML, the owner's file laid over it, checked into frozen records.

Every key of a table belongs to one field of one record below (or of the airframe's own `Config` for `[monitor]` and
`[sitl]`); unknown keys are refused.  Units are in the key names.
"""

import dataclasses
import hashlib
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import msgspec

from companion.decision import Rules
from companion.errors import UserError
from companion.recovery import Plan

Table = dict[str, Any]  # TOML as tomllib gives it: checked by the records before anything uses it
Record = TypeVar("Record")


@dataclass(frozen=True, slots=True)
class Grid:
    """`[grid]`: the rows that the monitor judges."""

    rate_hz: float
    maximal_age_s: float  # of a held value, for channels without one of their own
    maximal_ages_s: dict[str, float]  # by channel

    def __post_init__(self) -> None:
        if not 1.0 <= self.rate_hz <= 100.0:
            raise ValueError(f"rate_hz = {self.rate_hz} is no rate of a grid; give 1 to 100")
        for name, age_s in {"maximal_age_s": self.maximal_age_s, **self.maximal_ages_s}.items():
            if not 0.0 < age_s <= 60.0:
                raise ValueError(f"{name} = {age_s} is no age; give seconds > 0, at most 60")

    @property
    def period_us(self) -> int:
        return round(1e6 / self.rate_hz)

    def maximal_age_us(self, channels: tuple[str, ...]) -> tuple[int, ...]:
        return tuple(round(1e6 * self.maximal_ages_s.get(channel, self.maximal_age_s)) for channel in channels)


@dataclass(frozen=True, slots=True)
class VehicleTable:
    """`[vehicle]`: by what a vehicle of this airframe is known on the link."""

    mav_types: tuple[int, ...]  # MAV_TYPE of its HEARTBEAT; empty: only by name


@dataclass(frozen=True, slots=True)
class ChecksTable:
    """`[checks]`: which of the general checks do not fit this airframe."""

    skip: tuple[str, ...]  # by id (docs/checks.md)


@dataclass(frozen=True, slots=True)
class Configuration:
    """Everything that the companion reads; the airframe's own tables are still unread TOML."""

    vehicle: VehicleTable
    checks: ChecksTable
    grid: Grid
    streams: dict[str, float]  # message -> Hz
    decision: Rules
    recovery: dict[str, Plan]  # fault id or class -> what mends it
    monitor: dict[str, Any]
    sitl: dict[str, Any]

    def __post_init__(self) -> None:
        for name, rate_hz in self.streams.items():
            if not 0.0 < rate_hz <= 200.0:
                raise ValueError(f"streams.{name} = {rate_hz} is no rate; give Hz > 0, at most 200")


@dataclass(frozen=True, slots=True)
class Source:
    """A parsed configuration and where each value came from."""

    table: Table
    origins: Mapping[str, str]  # "grid.rate_hz" -> file
    digest: str  # SHA-256 over the merged table: two runs with the same digest were configured alike


def read(packaged: str, packaged_name: str, owners: Path | None) -> Source:
    """Parse the packaged text and lay the owner's file over it.  Raises UserError for what is not TOML or not there."""
    table = _parse(packaged, packaged_name)
    origins = dict.fromkeys((path for path, _ in leaves(table)), packaged_name)
    if owners is not None:
        try:
            text = owners.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise UserError(f"{owners}: cannot read the configuration: {error}") from None
        over = _parse(text, str(owners))
        table = _laid_over(table, over)
        origins |= dict.fromkeys((path for path, _ in leaves(over)), str(owners))
    return Source(table, origins, hashlib.sha256(repr(sorted(leaves(table))).encode()).hexdigest())


def _parse(text: str, name: str) -> Table:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{name}: not valid TOML: {error}") from None


def _laid_over(under: Table, over: Table) -> Table:
    out = dict(under)
    for key, value in over.items():
        below = out.get(key)
        out[key] = _laid_over(below, value) if isinstance(value, dict) and isinstance(below, dict) else value
    return out


def leaves(table: Table, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Every value of nested tables with its dotted path."""
    for key, value in table.items():
        path = f"{prefix}{key}"
        if isinstance(value, dict):
            yield from leaves(value, path + ".")
        else:
            yield path, value


def convert(source: Source, table: Table, record: type[Record], path: str = "") -> Record:
    """A table into its record.  Raises UserError naming file, key and what is wrong."""
    _refuse_unknown(source, table, record, path)
    try:
        return msgspec.convert(table, record)
    except msgspec.ValidationError as error:
        key, what = _culprit(table, record, path.rstrip("."), str(error))
        raise UserError(f"{_said_in(source, key)}: {key or 'configuration'}: {what}") from None


def _culprit(table: Table, kind: Any, key: str, what: str) -> tuple[str, str]:
    """(key, what is wrong with it) of the innermost value that will not convert; `what`: the same of the whole table."""
    hints = get_type_hints(kind) if dataclasses.is_dataclass(kind) else {}
    for name, value in table.items():
        inner = hints[name] if hints else get_args(kind)[1]
        try:
            msgspec.convert(value, inner)
        except msgspec.ValidationError as error:
            path = f"{key}.{name}" if key else name
            inside = isinstance(value, dict) and (dataclasses.is_dataclass(inner) or get_origin(inner) is dict)
            return _culprit(value if inside else {}, inner, path, str(error))
    return key, what.partition(" - at `$")[0]


def _said_in(source: Source, key: str) -> str:
    """The files that have a say in this key or what is below it."""
    files = {file for name, file in source.origins.items() if name == key or name.startswith(f"{key}.")}
    return " + ".join(sorted(files or set(source.origins.values())))


def _refuse_unknown(source: Source, table: object, kind: object, path: str) -> None:
    if not isinstance(table, dict):
        return
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        hints = get_type_hints(kind)
        for key, value in table.items():
            if key not in hints:
                known = ", ".join(sorted(hints))
                raise UserError(f"{_said_in(source, path + key)}: unknown key {path}{key}; known here: {known}")
            _refuse_unknown(source, value, hints[key], f"{path}{key}.")
    elif get_origin(kind) is dict:
        for key, value in table.items():
            _refuse_unknown(source, value, get_args(kind)[1], f"{path}{key}.")
