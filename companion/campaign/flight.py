"""Flying and judging: a batch of flights on the grid directly, or one seed of it through real MAVLink bytes."""

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace

import numpy as np

from companion.airframe import Airframe
from companion.campaign.rows import BoolArray, Columns, FloatArray, Score, column_names, injected, truths
from companion.compiler import compiler
from companion.decision import Policy
from companion.decode import PLAUSIBLE, TABLE, WIRE_UNITS, Row, dimension_of
from companion.dialect import by_name
from companion.effects import Effect, Judged
from companion.events import Json
from companion.journal import counters
from companion.rehearsal import COMPANION, EPOCH_US, Rehearsal
from fdi.verdict import Monitor
from sitl.autopilot import Autopilot
from sitl.autopilot.autopilot import Rates
from sitl.ensemble import RELEASE_US, Ensemble, Grid, draw_faults, step_s
from sitl.link import HEARTBEAT, Listener, Pipe, Reading
from sitl.vehicle import Fleet, Injected, Vehicle


@dataclass(frozen=True, slots=True)
class Batch:
    """Flights of consecutive seeds, to be flown and judged together, here or elsewhere."""

    airframe: Airframe
    first_seed: int
    flights: int
    faults: tuple[str, ...]
    duration_s: float
    link: bool

    @property
    def seeds(self) -> range:
        return range(self.first_seed, self.first_seed + self.flights)


@dataclass(frozen=True, slots=True)
class Prepared:
    """A batch at the moment before it flies."""

    fleet: Fleet
    faults: list[Injected | None]  # what is to happen to each flight
    ensemble: Ensemble
    score: Score


def prepare(batch: Batch) -> Prepared:
    """Build the vehicles of a batch.  Raises ValueError for a fault that they cannot have, or rows they cannot give."""
    airframe, simulator = batch.airframe, batch.airframe.load_simulator()
    vehicle: Vehicle = simulator.VEHICLE
    faults = draw_faults(batch.seeds, batch.faults, vehicle.fault_ids, batch.duration_s)
    fleet: Fleet = simulator.Fleet(airframe.simulator_config(simulator), batch.seeds, faults)
    ensemble = Ensemble(vehicle, fleet, batch.seeds, grid(airframe), listener(airframe, vehicle) if batch.link else None)
    onset_s = np.array([math.inf if fault is None else fault.onset_s for fault in faults])
    return Prepared(fleet, faults, ensemble, Score(airframe.detector, onset_s))


def fly(batch: Batch) -> Columns:
    """The rows of a batch, in the order of its seeds.  Raises ValueError as `prepare`."""
    prepared = prepare(batch)
    ensemble, score = prepared.ensemble, prepared.score
    monitor: Monitor = batch.airframe.monitor(flights=batch.flights, compiler=compiler())
    for row in ensemble.rows(batch.duration_s):
        score.note(row.t_us, row.flying, monitor.step(row.values, row.age_s))
    down = ensemble.touchdown_us >= 0
    flight_s = np.where(down, ensemble.touchdown_us / 1e6, batch.duration_s)
    return _rows(batch, prepared, flight_s, down)


def _rows(batch: Batch, prepared: Prepared, flight_s: FloatArray, down: BoolArray) -> Columns:
    """The rows of flights that are over; flight_s, down: (flight,)."""
    columns: Columns = {"seed": np.array(batch.seeds, dtype=np.int64), "flight_s": flight_s}
    columns |= injected(prepared.fleet, prepared.faults) | prepared.score.columns() | truths(prepared.fleet, down)
    return {name: columns[name] for name in column_names(batch.airframe.detector, prepared.fleet)}


def grid(airframe: Airframe) -> Grid:
    """The rows that the airframe's monitor takes."""
    channels, table = airframe.detector.channels, airframe.configuration.grid
    return Grid(channels, table.period_us, table.maximal_age_us(channels))


def listener(airframe: Airframe, vehicle: Vehicle) -> Listener:
    """What the companion takes from the vehicle's messages, by its own decode table and the streams it asks for.

    Raises ValueError for a channel that none of them carries.
    """
    channels, table = airframe.detector.channels, airframe.configuration.grid
    constants = {stream.message: stream.constants for stream in vehicle.streams}
    readings = tuple(
        _reading(row, channels.index(row.channel))
        for row in TABLE
        if row.channel in channels
        and (row.message in constants or row.message == HEARTBEAT)
        and (row.instance is None or constants[row.message].get(row.instance[0], 0) == row.instance[1])
    )
    if missing := set(range(len(channels))) - {reading.channel for reading in readings}:
        raise ValueError(f"no message of the simulator carries the channel {channels[min(missing)]}")
    return Listener(readings, airframe.configuration.streams, table.period_us, table.maximal_age_us(channels))


def _reading(row: Row, channel: int) -> Reading:
    unit = by_name(row.message).units.get(row.field.partition("[")[0], "")
    factor = 1.0 if row.mask else WIRE_UNITS[unit][1]
    unknown = math.nan if row.unknown is None else row.unknown
    return Reading(row.message, row.field, channel, factor, unknown, PLAUSIBLE[dimension_of(row.channel)])


class Spoilt(Autopilot):
    """An autopilot whose only client, the companion, is behind a bad line."""

    pipe: Pipe | None = None

    def outgoing(self) -> list[tuple[Hashable, bytes]]:
        frames = super().outgoing()
        if self.pipe is None:
            return frames
        sent = (frame for key, frame in frames if key == COMPANION)
        return [(COMPANION, frame) for frame in self.pipe.carry(sent, self.time_us, self.armed)]


@dataclass(frozen=True, slots=True)
class Rehearsed:
    """One flight through real MAVLink bytes."""

    columns: Columns  # its row
    lines: list[dict[str, Json]]  # its events
    log: bytes  # what a live run would have recorded
    onsets: list[tuple[str, float]]  # injected faults and when, on the clock of the events
    release_s: float  # on that clock


def rehearse(batch: Batch, observe: Callable[[Effect], None]) -> Rehearsed:
    """Fly the first seed of a batch through real MAVLink bytes; observe is handed every effect.

    Nothing is mended: the flight is the batch's.  With `batch.link` the bytes suffer what the batch's line does.
    """
    alone = replace(batch, flights=1)
    airframe, seed = batch.airframe, batch.first_seed
    vehicle: Vehicle = airframe.load_simulator().VEHICLE
    prepared = prepare(alone)
    release_s = RELEASE_US / 1e6
    rates: Rates = "stock" if step_s(vehicle, grid(airframe).period_us) == vehicle.steps_s[0] else "fast"
    autopilot = Spoilt(vehicle, prepared.fleet, seed=seed, rates=rates, release_s=release_s)
    if batch.link:
        autopilot.pipe = Pipe(vehicle, prepared.fleet.channels, listener(airframe, vehicle), seed)

    def note(effect: Effect) -> None:
        if isinstance(effect, Judged):
            t_us = effect.row.t_us - RELEASE_US
            prepared.score.note(t_us, np.array([autopilot.armed and t_us >= 0]), effect.verdict)
        observe(effect)

    rehearsal = Rehearsal(airframe, autopilot, Policy.OFF, keep_log=True, observe=note)
    rehearsal.journal.begin(EPOCH_US, {"seed": seed})
    end_us = RELEASE_US + round(batch.duration_s * 1e6)
    while autopilot.elapsed_us < end_us and not autopilot.landed:
        rehearsal.step()
    why = "landed" if autopilot.landed else "the flight is over"
    rehearsal.journal.end(EPOCH_US + autopilot.elapsed_us, why, {**counters(rehearsal.core)})
    down = np.array([autopilot.landed])
    flight_s = np.array([(autopilot.elapsed_us - RELEASE_US) / 1e6])
    onsets = [(fault.id, release_s + fault.onset_s) for fault in prepared.faults if fault is not None]
    columns = _rows(alone, prepared, flight_s, down)
    return Rehearsed(columns, rehearsal.journal.lines, bytes(rehearsal.log), onsets, release_s)
