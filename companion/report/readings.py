"""What the page shows of the log itself, whatever the vehicle: frames by time, gaps, and a few standard curves.

Read a second time from the file, as columns where numba is installed, else frame by frame with the same outcome.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.analysis import Analysis, compiled_reader
from companion.checks import Status
from companion.decode import WIRE_UNITS
from companion.dialect import by_name
from companion.tlog import LINK_MASK, PLAUSIBLE_US, Reader

Array = NDArray[np.float64]
Source = tuple[int, int]  # system, component

MOST_BINS: Final = 600  # of the frame rates
SHORTEST_BIN_S: Final = 1.0
BREAK_S: Final = 10.0  # a curve is not drawn across a longer time without samples
GAP_S: Final = 5.0  # MAVLink heartbeat protocol: a vehicle is lost after 4 to 5 beats
DEGREES: Final = 180.0 / math.pi


@dataclass(frozen=True, slots=True)
class Curve:
    """One line of a figure: (sample,) times and values, NaN where unknown."""

    name: str
    t_s: Array
    value: Array


@dataclass(frozen=True, slots=True)
class Panel:
    """Curves that share an axis."""

    title: str  # with the unit in which people read it
    curves: tuple[Curve, ...]


@dataclass(frozen=True, slots=True)
class Readings:
    """clock: what the times count from.  span: first and last time.

    rates: frames a second of each source; gaps: (start, end) without the vehicle.
    """

    clock: str
    span: tuple[float, float]
    rates: tuple[Curve, ...]
    gaps: tuple[tuple[float, float], ...]
    panels: tuple[Panel, ...]


@dataclass(frozen=True, slots=True)
class Pick:
    """One standard curve.  factor: from SI to what people read; unknown: wire value that says so, in SI."""

    panel: str
    message: str
    field: str
    name: str
    factor: float = 1.0
    unknown: float = math.nan


PICKS: Final = (
    Pick("height, m", "GLOBAL_POSITION_INT", "relative_alt", "above home"),
    Pick("height, m", "VFR_HUD", "alt", "above sea level"),
    Pick("speed, m/s", "VFR_HUD", "groundspeed", "over ground"),
    Pick("speed, m/s", "VFR_HUD", "airspeed", "air"),
    Pick("attitude, deg", "ATTITUDE", "roll", "roll", DEGREES),
    Pick("attitude, deg", "ATTITUDE", "pitch", "pitch", DEGREES),
    Pick("battery, V", "SYS_STATUS", "voltage_battery", "voltage", 1.0, 65.535),
    Pick("GPS satellites", "GPS_RAW_INT", "satellites_visible", "used or seen", 1.0, 255.0),
    Pick("vibration, m/s²", "VIBRATION", "vibration_x", "x"),
    Pick("vibration, m/s²", "VIBRATION", "vibration_y", "y"),
    Pick("vibration, m/s²", "VIBRATION", "vibration_z", "z"),
)
MESSAGES: Final = tuple(dict.fromkeys(pick.message for pick in PICKS))


@dataclass(frozen=True, slots=True)
class Table:
    """Messages of one type: (message,) stamps, sources (sysid * 256 + compid), and their fields in SI by name."""

    stamp_us: NDArray[np.int64]
    source: NDArray[np.int64]
    fields: Mapping[str, Array]


@dataclass(frozen=True, slots=True)
class Contents:
    """All stamped frames, (frame,) each, and the tables of MESSAGES that the log has."""

    stamp_us: NDArray[np.int64]
    source: NDArray[np.int64]
    tables: Mapping[str, Table]


def read(analysis: Analysis) -> Readings:
    """The readings of a log that has been analysed.  Raises UserError as `analyze`."""
    path = analysis.path
    contents = _compiled(path) if compiled_reader() is not None else _plain(path)
    if not len(contents.stamp_us):
        return Readings("since the log began", (0.0, 0.0), (), (), ())
    flight = analysis.flight
    judged = (flight.sysid or 0) * 256 + (flight.compid or 0)
    clock, zero_us = _clock(analysis, contents, judged)
    own = contents.stamp_us[contents.source == judged]
    steps = np.flatnonzero(np.diff(own) > GAP_S * 1e6)
    gaps = tuple(((own[k] - zero_us) / 1e6, (own[k + 1] - zero_us) / 1e6) for k in steps.tolist())
    span = ((int(contents.stamp_us.min()) - zero_us) / 1e6, (int(contents.stamp_us.max()) - zero_us) / 1e6)
    return Readings(clock, span, tuple(_rates(contents, zero_us)), gaps, tuple(_panels(contents, judged, zero_us)))


def _compiled(path: Path) -> Contents:
    columns = compiled_reader()
    assert columns is not None  # asked before
    index = columns.read(path)
    stamped = _plausible(index.stamps_us)
    tables = {}
    for name, found in index.columns(MESSAGES).items():
        usable = _plausible(found.stamp_us)
        source = found.sysid.astype(np.int64) * 256 + found.compid
        wanted = [pick.field for pick in PICKS if pick.message == name] + _boot_field(name)
        fields = {field: found.fields[field][usable].astype(np.float64) for field in wanted}
        tables[name] = Table(found.stamp_us[usable].astype(np.int64), source[usable], fields)
    stamps_us = (index.stamps_us[stamped] & ~np.uint64(LINK_MASK)).astype(np.int64)
    return Contents(stamps_us, index.sources[stamped].astype(np.int64), tables)


def _plausible(stamps_us: NDArray[np.uint64]) -> NDArray[np.bool_]:
    usable: NDArray[np.bool_] = (stamps_us >= PLAUSIBLE_US.start) & (stamps_us < PLAUSIBLE_US.stop)
    return usable


def _boot_field(message: str) -> list[str]:
    return ["time_boot_ms"] if "time_boot_ms" in by_name(message).fields else []


def _plain(path: Path) -> Contents:
    stamps: list[int] = []
    sources: list[int] = []
    rows: dict[str, list[tuple[float, ...]]] = {}
    wanted = {name: [pick.field for pick in PICKS if pick.message == name] + _boot_field(name) for name in MESSAGES}
    for stamp_us, frame in Reader(path):
        if stamp_us is None or stamp_us not in PLAUSIBLE_US:
            continue
        stamps.append(stamp_us & ~LINK_MASK)
        sources.append(frame.sysid * 256 + frame.compid)
        if frame.name in wanted:
            fields, message = frame.fields(), by_name(frame.name)
            row = [float(stamps[-1]), float(sources[-1])]
            for name in wanted[frame.name]:
                value = fields[name]
                assert isinstance(value, int | float)  # no pick is a text or an array
                row.append(value * WIRE_UNITS.get(message.units.get(name, ""), ("1", 1.0))[1])
            rows.setdefault(frame.name, []).append(tuple(row))
    tables = {}
    for name, found in rows.items():
        table = np.array(found, dtype=np.float64)  # a stamp is below 2^53: exact
        fields_si = {field: table[:, 2 + place] for place, field in enumerate(wanted[name])}
        tables[name] = Table(table[:, 0].astype(np.int64), table[:, 1].astype(np.int64), fields_si)
    return Contents(np.array(stamps, dtype=np.int64), np.array(sources, dtype=np.int64), tables)


def _clock(analysis: Analysis, contents: Contents, judged: int) -> tuple[str, int]:
    """(name, stamp at its zero): the vehicle's clock where it ran through, so that all figures have one axis."""
    steady = all(finding.status is Status.OK for finding in analysis.findings if finding.id in ("reboot", "clock"))
    offsets = [
        int((table.stamp_us[own] - table.fields["time_boot_ms"][own] * 1e3).min())
        for table in contents.tables.values()
        if "time_boot_ms" in table.fields and (own := table.source == judged).any()
    ]
    if analysis.flight.clocked and steady and offsets:
        return "vehicle clock", min(offsets)
    return "since the log began", int(contents.stamp_us[0])


def _rates(contents: Contents, zero_us: int) -> Iterator[Curve]:
    """Frames a second, the busiest sources first."""
    first_us, last_us = int(contents.stamp_us.min()), int(contents.stamp_us.max())
    bin_s = max(SHORTEST_BIN_S, (last_us - first_us) / 1e6 / MOST_BINS)
    place = ((contents.stamp_us - first_us) / (bin_s * 1e6)).astype(np.int64)
    middle_s = (first_us - zero_us) / 1e6 + bin_s * (np.arange(int(place.max()) + 1, dtype=np.float64) + 0.5)
    found, counts = np.unique(contents.source, return_counts=True)
    whole = slice(0, -1 if len(middle_s) > 1 else 1)  # the last bin is cut off by the end of the log
    for source in found[np.argsort(-counts, kind="stable")].tolist():
        rates: Array = np.bincount(place[contents.source == source], minlength=len(middle_s)) / bin_s
        yield Curve(f"{source >> 8}/{source & 0xFF}", middle_s[whole], rates[whole])


def _panels(contents: Contents, judged: int, zero_us: int) -> Iterator[Panel]:
    for title in dict.fromkeys(pick.panel for pick in PICKS):
        curves = []
        for pick in PICKS:
            table = contents.tables.get(pick.message) if pick.panel == title else None
            if table is None or not (own := table.source == judged).any():
                continue
            value = table.fields[pick.field][own]
            value = np.where(np.isclose(value, pick.unknown, rtol=1e-9), math.nan, value * pick.factor)
            if np.isfinite(value).any():
                curves.append(_broken(pick.name, _seconds(table.stamp_us[own], zero_us), value))
        if curves:
            yield Panel(title, tuple(curves))


def _seconds(stamp_us: NDArray[np.int64], zero_us: int) -> Array:
    seconds: Array = (stamp_us - zero_us) / 1e6
    return seconds


def _broken(name: str, t_s: Array, value: Array) -> Curve:
    """With a hole where samples are far apart, or where the stamps of the log run back."""
    step_s = np.diff(t_s)
    holes = np.flatnonzero((step_s > BREAK_S) | (step_s < -1.0)) + 1
    times_s: Array = np.insert(t_s, holes, t_s[holes])
    return Curve(name, times_s, np.insert(value, holes, math.nan))
