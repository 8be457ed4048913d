"""The autopilot around one simulated flight: state, clock, messages out; no socket and no wall clock.

Bytes of clients go in by `receive`, time goes on by `step`, bytes for clients come out by `outgoing`.  What is said to it is
understood in `inbox` and `commands`.
"""

import contextlib
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as dialect

from sitl.autopilot import housekeeping as tell
from sitl.autopilot.commands import Command, Result
from sitl.autopilot.frames import Packed, layout, pack, source_of
from sitl.autopilot.housekeeping import ALL_SENSORS, Home, LandedState, Sensor, Severity, SystemState
from sitl.autopilot.inbox import understand
from sitl.autopilot.misbehaviour import BadLink, Misbehaviour
from sitl.autopilot.mission import MissionItem
from sitl.autopilot.parameters import INT32, REAL32, Parameters
from sitl.autopilot.routing import EVERYBODY, MOST_CLIENTS, NOT_FORWARDED, Client, Due, Routes, is_ours
from sitl.autopilot.streams import REQUEST_GROUPS, StreamTable
from sitl.vehicle import Fleet, Vehicle

Rates = Literal["stock", "fast"]

BOOT_US = 1_500_000  # a rebooting autopilot neither says nor hears anything for so long
ECHO_INDEX = 0xFFFF  # param_index of the echo of a setting, as ArduPilot's
PARAMETERS_A_STEP = 20  # of a list, to one client: it has streams to receive besides
MOST_WAITING = 10_000  # frames for one client that nobody takes away
PARSED_LEFTOVER = 1 << 16  # bytes already parsed that pymavlink's parser may keep before they are cut off

_UNBUILT = object()


@dataclass(frozen=True, slots=True)
class Source:
    """One message that can be sent on request or regularly."""

    name: str
    id: int
    default_us: int  # interval of a client that asked for nothing; 0: only on request
    build: Callable[[], Packed | None]  # None: what it would say is not known now


@dataclass(slots=True)
class Counters:
    """What happened on the links since the start."""

    frames_in: int = 0
    bad_bytes: int = 0
    frames_out: int = 0
    dropped: int = 0  # nobody took them away
    clients_evicted: int = 0


@dataclass(slots=True)
class _Later:
    at_us: int  # elapsed
    do: Callable[[], None]
    client: Hashable = field(default=None)
    command: int = -1  # the command under way, if it is one


class Autopilot:
    """One vehicle on the network."""

    def __init__(
        self,
        vehicle: Vehicle,
        fleet: Fleet,
        *,
        sysid: int = 1,
        compid: int = 1,
        rates: Rates = "stock",
        release_s: float | None = 5.0,
        mission: Sequence[MissionItem] = (),
        unix_us: int = 0,
        seed: int = 0,
        misbehaviour: Misbehaviour | None = None,
        param_errors: bool = False,
    ) -> None:
        """An autopilot at boot time 0, standing still.

        fleet: one flight.  release_s: boot time at which it arms and releases itself, None: only when told to arm.
        unix_us: Unix time at the first boot, 0: not known.  seed: of the links that SIM_LINK_* spoils.
        param_errors: say PARAM_ERROR where an ArduPilot of before 2025 is silent.
        Raises KeyError for a stream that the fleet's channels or the dialect do not cover, ValueError for a parameter
        that is in the tables twice.
        """
        self.vehicle = vehicle
        self.fleet = fleet
        self.misbehaviour = misbehaviour if misbehaviour is not None else Misbehaviour()
        self.parameters = Parameters(vehicle.parameters, sysid, self.misbehaviour)
        self.mission = tuple(mission)
        self.sysid = sysid
        self.compid = compid
        self.param_errors = param_errors
        self.dt_s = _step_s(vehicle, rates)
        self.dt_us = round(self.dt_s * 1e6)
        self.time_us = 0  # boot clock: what all streams say
        self.elapsed_us = 0  # since the simulation began; no reboot puts it back
        self.released = False
        self.armed = False
        self.landed = False
        self.custom_mode = next(iter(vehicle.modes.values()), 0)
        self.routes = Routes()
        self.counters = Counters()
        self.time_answers: dict[Hashable, int] = {}  # by client: ts1 (ns) of its last answer to TIMESYNC
        self.everybody = True  # whether some link has no peer that was heard: whoever listens there is served unasked
        self._release_us = round(release_s * 1e6) if release_s is not None else -1
        self._unix_us = unix_us
        self._seed = seed
        self._silent_until_us = 0
        self._greeted = False
        self._battery_was_low = False
        self._flood_owed = 0.0
        self._later: list[_Later] = []
        self._table = StreamTable(vehicle.streams, fleet.channels)
        self._see(*fleet.observe())
        self.home = Home(*fleet.home)
        self._sources = self._build_sources(rates)
        self._by_id = {source.id: index for index, source in enumerate(self._sources)}
        self._built: dict[int, Packed | None] = {}
        self._clients: dict[Hashable, Client] = {}
        self._hearings = 0
        self._everybody = self._new_client(EVERYBODY)
        self._schedule(self._everybody)

    # Time

    def step(self) -> None:
        """Advance the vehicle and everything regular by `dt_s`."""
        self.elapsed_us += self.dt_us
        self.time_us += self.dt_us
        self._see(*(self.fleet.step(self.dt_s) if self.released else self.fleet.observe()))
        if not self.released and 0 <= self._release_us <= self.time_us:
            self.arm(force=True)
        if self.released and not self.landed and bool(self.fleet.landed[0]):
            self.landed = True
            self._disarmed("Landed, disarmed")
        if self.silent:
            return
        if not self._greeted:
            self._greeted = True
            self.send_heartbeat()
            self.say(Severity.INFO, f"{self.vehicle.name[:30]} simulated, ready")
        self._do_what_is_due()
        self._watch_battery()
        self._flood_owed += self.misbehaviour.flood_hz * self.dt_s
        useless, self._flood_owed = divmod(self._flood_owed, 1.0)
        for client in self._listeners():
            self._send_regular(client)
            for _ in range(int(useless)):
                self.send(client, pack("NAMED_VALUE_FLOAT", time_boot_ms=self.time_us // 1000 & 0xFFFFFFFF, name=b"flood"))
            if len(client.outbox) > MOST_WAITING:
                self.counters.dropped += len(client.outbox) - MOST_WAITING
                del client.outbox[:-MOST_WAITING]

    @property
    def silent(self) -> bool:
        """Whether it is rebooting."""
        return self.time_us < self._silent_until_us

    def reboot(self) -> None:
        """Start anew: clock at zero, parameters kept, all else forgotten; in the air it comes back armed."""
        self.parameters.store("STAT_BOOTCNT", self.parameters.value("STAT_BOOTCNT") + 1.0)
        self.sysid = int(self.parameters.value("SYSID_THISMAV"))
        self.time_us = 0
        self._silent_until_us = BOOT_US
        self._greeted = False
        self._battery_was_low = False
        self._flood_owed = 0.0
        self._later.clear()
        self._built.clear()
        self.routes.clear()
        self.armed = self.released and not self.landed
        if not self.armed:
            self.custom_mode = next(iter(self.vehicle.modes.values()), 0)
        for client in (self._everybody, *self._clients.values()):
            client.sequence = 0
            client.intervals_us.clear()
            client.parameters_left.clear()
            self._schedule(client)

    # Bytes

    def receive(self, key: Hashable, data: bytes) -> None:
        """Take bytes from one client, in any slices.  Whatever they are, nothing is raised."""
        if self.silent:
            return
        client = self._clients.get(key)
        if client is None:
            client = self._admit(key)
        for message in client.parser.parse_buffer(data) or ():
            if self.silent:
                break  # one of the messages before was a reboot
            self._take(client, message)
        if client.parser.buf_index > PARSED_LEFTOVER:  # pymavlink frees it only when nothing is left over
            del client.parser.buf[: client.parser.buf_index]
            client.parser.buf_index = 0

    def outgoing(self) -> list[tuple[Hashable, bytes]]:
        """Frames for each client since the last call, in order; EVERYBODY is who listens on links not heard from."""
        result: list[tuple[Hashable, bytes]] = []
        for client in (self._everybody, *self._clients.values()):
            if not client.outbox and not client.undisturbed:
                continue
            frames = client.outbox
            if self.misbehaviour.spoils_links or client.bad_link.holds:
                frames = client.bad_link.spoil(frames, self.misbehaviour)
            result += [(client.key, frame) for frame in frames]
            result += [(client.key, frame) for frame in client.undisturbed]
            client.outbox = []
            client.undisturbed = []
        self.counters.frames_out += len(result)
        return result

    @property
    def clients(self) -> tuple[Hashable, ...]:
        """Keys of the clients from which a good frame came."""
        return tuple(key for key, client in self._clients.items() if client.valid)

    def send(self, client: Client, message: Packed) -> bool:
        """Send one message to one client; False if it cannot be sent to it, or the autopilot is rebooting."""
        frame = b"" if self.silent else client.frame(message, self.sysid, self.compid)
        if frame:
            client.outbox.append(frame)
        return bool(frame)

    def send_to_all(self, message: Packed) -> None:
        """Send one message to all clients."""
        for client in self._listeners():
            self.send(client, message)

    def say(self, severity: Severity, text: str) -> None:
        """STATUSTEXT to all clients.  Raises ValueError for more than 50 bytes."""
        self.send_to_all(tell.statustext(severity, text))

    def ask_time(self, keys: Iterable[Hashable]) -> int:
        """Put TIMESYNC behind everything for these clients; -> the ts1 (ns) that answers will carry in `time_answers`."""
        ts1_ns = max(1, self.time_us * 1000)
        for key in keys:
            client = self._everybody if key is EVERYBODY else self._clients[key]
            client.undisturbed.append(client.frame(tell.timesync(0, ts1_ns), self.sysid, self.compid))
        return ts1_ns

    def send_heartbeat(self) -> None:
        """HEARTBEAT to all clients now, as at each change of what it says."""
        self.send_to_all(self._heartbeat())

    # What clients ask for

    def send_once(self, client: Client, message_id: int) -> Result:
        """Answer MAV_CMD_REQUEST_MESSAGE."""
        index = self._by_id.get(message_id)
        if index is None:
            return Result.UNSUPPORTED
        message = self._build(index)
        if message is None:
            return Result.TEMPORARILY_REJECTED
        return Result.ACCEPTED if self.send(client, message) else Result.FAILED

    def interval_us(self, client: Client, message_id: int) -> int:
        """Interval of a message for this client: -1 off, 0 no such message here."""
        index = self._by_id.get(message_id)
        if index is None:
            return 0
        interval_us = client.intervals_us.get(message_id, self._sources[index].default_us)
        return max(interval_us, self.dt_us) if interval_us > 0 else -1

    def set_interval(self, client: Client, message_id: int, interval_us: int) -> bool:
        """Set it: 0 as at the start, -1 off; False for a message that is not here, or a HEARTBEAT off."""
        if message_id not in self._by_id or (message_id == layout("HEARTBEAT").id and interval_us < 0):
            return False
        if interval_us == 0:
            client.intervals_us.pop(message_id, None)
        else:
            client.intervals_us[message_id] = max(interval_us, 0)
        self._schedule(client)
        return True

    def set_group(self, client: Client, group: int, rate_hz: int) -> None:
        """Obey REQUEST_DATA_STREAM: group 0 is all; rate 0 is off."""
        names = REQUEST_GROUPS.get(group, frozenset())
        if group == 0:
            names = frozenset(stream.message for stream in self.vehicle.streams).union(*REQUEST_GROUPS.values())
        for source in self._sources:
            if source.name in names:
                client.intervals_us[source.id] = round(1e6 / rate_hz) if rate_hz > 0 else 0
        self._schedule(client)

    def send_parameter(self, client: Client, index: int) -> None:
        """PARAM_VALUE of the parameter of this index."""
        self.send(client, self.parameter_message(self.parameters.names[index], index))

    def parameter_message(self, name: str, index: int) -> Packed:
        """PARAM_VALUE as stored."""
        return self._parameter_message(name, self.parameters.value(name), index)

    def echo_parameter(self, name: str, value: float, delay_s: float) -> None:
        """Tell all clients that this value is stored, now or later."""
        message = self._parameter_message(name, value, ECHO_INDEX)
        if delay_s > 0.0:
            self.later(delay_s, lambda: self.send_to_all(message))
        else:
            self.send_to_all(message)

    def apply_parameter(self, name: str, value: float) -> None:
        """Store a value that `Parameters.meet` gave, and let the airframe feel it."""
        self.parameters.store(name, value)
        if self.parameters.row(name).acts:
            self.fleet.command(0, name, value)

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter from outside the link, whatever misbehaviour is on.  Raises ValueError if it is refused."""
        refusal = self.parameters.refusal(name, value)
        if refusal:
            raise ValueError(f"parameter {name} = {value:g}: {refusal.name.lower().replace('_', ' ')}")
        self.apply_parameter(name, self.parameters.held(name, value))

    def acknowledge(self, client: Client, command: Command, result: Result, progress: int = 255) -> None:
        """COMMAND_ACK to who sent the command."""
        self.send(client, tell.command_ack(command.id, result, progress, command.system, command.component))

    def finish_later(self, client: Client, command: Command, after_s: float) -> None:
        """Answer ACCEPTED after this time, once for repeated requests."""
        if not any(item.client == client.key and item.command == command.id for item in self._later):
            self.later(after_s, lambda: self.acknowledge(client, command, Result.ACCEPTED, 100), client.key, command.id)

    def later(self, after_s: float, do: Callable[[], None], client: Hashable = None, command: int = -1) -> None:
        """Do something at a later step; a reboot forgets it."""
        self._later.append(_Later(self.elapsed_us + round(after_s * 1e6), do, client, command))

    # Flight

    @property
    def ready_to_arm(self) -> bool:
        """Whether the prearm check passes: all sensors that it has are healthy."""
        return self._table.has_fix()

    def arm(self, *, force: bool = False) -> Result:
        """Arm and release.  Denied after landing, rejected for now while a sensor is unhealthy, unless forced."""
        if self.landed:
            return Result.DENIED
        if self.armed:
            return Result.ACCEPTED
        if not force and not self.ready_to_arm:
            self.say(Severity.CRITICAL, "PreArm: GPS has no fix")
            return Result.TEMPORARILY_REJECTED
        self.armed = True
        self.released = True
        self.say(Severity.INFO, "Armed, released")
        self.send_heartbeat()
        return Result.ACCEPTED

    def disarm(self, *, force: bool = False) -> Result:
        """Disarm; in the air only by force.  What flies goes on flying."""
        if not self.armed:
            return Result.ACCEPTED
        if not force:
            return Result.DENIED
        self._disarmed("Disarmed in flight")
        return Result.ACCEPTED

    def set_mode(self, custom_mode: int) -> bool:
        """Change the flight mode; False if the airframe does not have it."""
        for name, number in self.vehicle.modes.items():
            if number == custom_mode:
                self.custom_mode = custom_mode
                with contextlib.suppress(KeyError):  # most airframes fly in one mode and know of none
                    self.fleet.command(0, "MODE", float(custom_mode))
                self.say(Severity.INFO, f"Mode {name[:40]}")
                self.send_heartbeat()
                return True
        return False

    # Inside

    def _see(self, values: NDArray[np.float64], age_s: NDArray[np.float64]) -> None:
        self._values = values[0]
        self._table.take(values[0], age_s[0], self.time_us)
        self._built = {}

    def _disarmed(self, text: str) -> None:
        self.armed = False
        self.say(Severity.INFO, text)
        self.send_heartbeat()

    def _do_what_is_due(self) -> None:
        due = [item for item in self._later if item.at_us <= self.elapsed_us]
        if due:
            self._later = [item for item in self._later if item.at_us > self.elapsed_us]
            for item in due:
                item.do()

    def _watch_battery(self) -> None:
        low = self._battery_low()
        if low and not self._battery_was_low:
            self.say(Severity.WARNING, f"Battery 1 is low {self.parameters.value('SIM_BATT_VOLTAGE'):.2f}V")
        self._battery_was_low = low

    def _battery_low(self) -> bool:
        return self.parameters.value("SIM_BATT_VOLTAGE") < self.parameters.value("BATT_LOW_VOLT")

    def _parameter_message(self, name: str, value: float, index: int) -> Packed:
        kind = INT32 if self.parameters.row(name).integer else REAL32
        return tell.param_value(name, value, kind, len(self.parameters.names), index)

    def _build_sources(self, rates: Rates) -> tuple[Source, ...]:
        second_us = 1_000_000
        own: tuple[tuple[str, int, Callable[[], Packed | None]], ...] = (
            ("HEARTBEAT", second_us, self._heartbeat),
            ("SYS_STATUS", second_us, self._sys_status),
            ("EXTENDED_SYS_STATE", second_us, self._extended_sys_state),
            ("SYSTEM_TIME", second_us, self._system_time),
            ("HOME_POSITION", 0, lambda: tell.home_position(self.home, self.time_us)),
            ("AUTOPILOT_VERSION", 0, lambda: tell.autopilot_version(self.sysid)),
            ("MISSION_CURRENT", second_us if self.mission else 0, lambda: tell.mission_current(len(self.mission))),
        )
        sources = [Source(name, layout(name).id, interval_us, build) for name, interval_us, build in own]
        for index, stream in enumerate(self.vehicle.streams):
            rate_hz = stream.fast_hz if rates == "fast" else stream.stock_hz
            interval_us = round(1e6 / rate_hz) if rate_hz > 0.0 else 0
            sources.append(Source(stream.message, layout(stream.message).id, interval_us, _packer(self._table, index)))
        return tuple(sources)

    def _heartbeat(self) -> Packed:
        state = SystemState.ACTIVE if self.armed else SystemState.STANDBY
        return tell.heartbeat(self.vehicle.mav_type, self.armed, self.custom_mode, state)

    def _sys_status(self) -> Packed:
        healthy = ALL_SENSORS
        if not self._table.has_fix():
            healthy &= ~(Sensor.GPS | Sensor.PREARM_CHECK)
        if self._battery_low():
            healthy &= ~Sensor.BATTERY
        return tell.sys_status(healthy, self.parameters.value("SIM_BATT_VOLTAGE"), 0.0)

    def _extended_sys_state(self) -> Packed:
        return tell.extended_sys_state(
            LandedState.IN_AIR if self.released and not self.landed else LandedState.ON_GROUND
        )  # fmt: skip

    def _system_time(self) -> Packed:
        return tell.system_time(self._unix_us + self.elapsed_us if self._unix_us else 0, self.time_us)

    def _build(self, index: int) -> Packed | None:
        message = self._built.get(index, _UNBUILT)
        if message is _UNBUILT:
            message = self._built[index] = self._sources[index].build()
        return message  # type: ignore[return-value]  # the sentinel is gone here

    def _listeners(self) -> list[Client]:
        heard = [client for client in self._clients.values() if client.valid]
        return [self._everybody, *heard] if self.everybody else heard

    def _new_client(self, key: Hashable) -> Client:
        parser = dialect.MAVLink(None)
        parser.robust_parsing = True
        # Its own sequence of chances for each client: the traffic of one does not change what another loses.
        return Client(key, BadLink(self._seed + len(self._clients)), parser)

    def _admit(self, key: Hashable) -> Client:
        if len(self._clients) >= MOST_CLIENTS:
            gone = min(self._clients.values(), key=lambda client: (client.valid, client.heard_at))
            del self._clients[gone.key]
            self.time_answers.pop(gone.key, None)
            self.routes.forget(gone.key)
            self.counters.clients_evicted += 1
        client = self._clients[key] = self._new_client(key)
        self._hearings += 1
        client.heard_at = self._hearings
        # It may have listened among everybody so far, and must not take the change for lost frames.
        client.sequence = self._everybody.sequence
        self._schedule(client)
        return client

    def _schedule(self, client: Client) -> None:
        client.schedule = []
        for index, source in enumerate(self._sources):
            interval_us = client.intervals_us.get(source.id, source.default_us)
            if interval_us > 0:
                # Multiples of the interval, whoever asked when: samples taken at round times leave at once.
                client.schedule.append(Due((self.time_us // interval_us + 1) * interval_us, interval_us, index))

    def _send_regular(self, client: Client) -> None:
        now_us = self.time_us
        for due in client.schedule:
            if due.at_us <= now_us:
                due.at_us = (now_us // due.interval_us + 1) * due.interval_us
                message = self._build(due.source)
                if message is not None:
                    self.send(client, message)
        for _ in range(min(PARAMETERS_A_STEP, len(client.parameters_left))):
            self.send_parameter(client, client.parameters_left.popleft())

    def _take(self, client: Client, message: dialect.MAVLink_message) -> None:
        kind: str = message.get_type()
        raw = bytes(message.get_msgbuf())
        if kind == "BAD_DATA":
            self.counters.bad_bytes += len(raw)
            return
        unknown = kind.startswith("UNKNOWN_")
        if unknown and not client.valid:
            return  # nothing vouches for its checksum, nor for its sender
        system, component = source_of(raw)
        if (system, component) == (self.sysid, self.compid):
            return  # our own words coming back
        self.counters.frames_in += 1
        self._hearings += 1
        client.heard_at = self._hearings
        if not unknown:
            if client.hear(raw):
                self.send(client, self._heartbeat())
            self.routes.learn(system, component, client.key)
        target = (int(getattr(message, "target_system", 0)), int(getattr(message, "target_component", 0)))
        if kind not in NOT_FORWARDED and target != (self.sysid, self.compid):
            for other in self._listeners():
                if other is not client and self.routes.leads(*target, other.key):
                    other.outbox.append(raw)
        if is_ours(self.sysid, self.compid, *target, self.routes):
            understand(self, client, message)


def _step_s(vehicle: Vehicle, rates: Rates) -> float:
    """The stock step, or the longest one that is short enough for the fastest stream."""
    if rates == "stock":
        return vehicle.steps_s[0]
    fastest_hz = max((stream.fast_hz for stream in vehicle.streams), default=0.0)
    short_enough = [step_s for step_s in vehicle.steps_s if step_s * fastest_hz <= 1.0 + 1e-9]
    return max(short_enough, default=min(vehicle.steps_s))


def _packer(table: StreamTable, index: int) -> Callable[[], Packed | None]:
    return lambda: table.pack(index)
