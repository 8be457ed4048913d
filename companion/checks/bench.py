"""Runs every check over one log: fed its frames in order, asked once at the end.

Pure: no clock and no file; arrival stamps come with the frames.  One vehicle is judged, the first autopilot heard or the one
that is asked for; of all others only what they do to the link.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion.checks.bootclock import BootClock, Clocks, Reboots
from companion.checks.finding import EVERY_BEAT, EVERY_FRAME, Check, Finding, Result, Status, Unit, absent, number
from companion.checks.flight import Flight
from companion.checks.reading import INSTANCES, NONE, Steps, attitude, imu
from companion.checks.table import CLOCK, REBOOT, ROWS
from companion.dialect import Definition, Fields, by_name, decode_fields
from companion.frames import Frame
from companion.vehicle import NO_VEHICLE

WAIT_FRAMES: Final = 5000  # for an autopilot and its clock, before the rest is judged without
WAIT_S: Final = 10.0
NOTHING: Final[Fields] = {}
HEARTBEAT_ID: Final = mavlink.MAVLINK_MSG_ID_HEARTBEAT

Take = Callable[[str, Fields, float, Frame], None]


@dataclass(slots=True)
class Bench:
    """All checks over one log.

        bench = Bench()
        for record in reader:
            bench.take(record.frame, record.stamp_us)
        findings = bench.finish()

    sysid: judge this system's autopilot instead of the first one heard.
    """

    sysid: int | None = None
    flight: Flight = field(default_factory=Flight)
    clock: BootClock = field(default_factory=BootClock)
    _units: list[tuple[Check, Unit]] = field(default_factory=list)
    _every: list[Take] = field(default_factory=list)
    _beats: list[Take] = field(default_factory=list)
    _wanted: dict[int, list[Take]] = field(default_factory=dict)  # by message id, of the vehicle's autopilot
    _heard: set[int] = field(default_factory=set)
    _waiting: list[tuple[Frame, float]] | None = field(default_factory=list)
    _waiting_since_s: float = math.nan
    _arrival_s: float = math.nan
    _steps: Steps = field(default_factory=Steps)

    def __post_init__(self) -> None:
        # What all checks share is read first, of these messages even if no check needs them.
        shared: dict[str, Take] = {
            "HEARTBEAT": self._beat,
            "VFR_HUD": self._speed,
            "GLOBAL_POSITION_INT": self._height,
            "EXTENDED_SYS_STATE": self._landed,
            "GPS_RAW_INT": self._step,
            "ATTITUDE": self._attitude,
            **dict.fromkeys((*INSTANCES, "HIGHRES_IMU"), self._imu),
        }
        self._wanted = {by_name(name).id: [take] for name, take in shared.items()}
        self._wanted[by_name("SYSTEM_TIME").id] = []  # for the clock alone
        for check, build in ROWS:
            self._add(check, build(check, self.flight))
        self._add(REBOOT, Reboots(REBOOT, self.flight, self.clock))
        self._add(CLOCK, Clocks(CLOCK, self.flight, self.clock))

    def _add(self, check: Check, unit: Unit) -> None:
        self._units.append((check, unit))
        if EVERY_FRAME in check.needs:
            self._every.append(unit.take)
        elif EVERY_BEAT in check.needs:
            self._beats.append(unit.take)
        else:
            for name in dict.fromkeys(name for names in (*check.needs, *check.also) for name in names.split("|")):
                self._wanted.setdefault(by_name(name).id, []).append(unit.take)

    def take(self, frame: Frame, arrival_us: int | None) -> None:
        """The next frame of the log.  arrival_us: its stamp, None where it has none (or no plausible one)."""
        if frame.definition is None:
            return  # its CRC could not be checked: nothing in it is believed
        if arrival_us is not None:
            self._arrival_s = arrival_us / 1e6
        if self._waiting is None:
            self._judge(frame, self._arrival_s)
        else:
            self._keep(frame, frame.definition)

    def _keep(self, frame: Frame, message: Definition) -> None:
        """Nothing is judged before the vehicle and its clock are known."""
        assert self._waiting is not None  # else it would be judged
        self._waiting.append((frame, self._arrival_s))
        if self.flight.sysid is None and frame.message_id == HEARTBEAT_ID:
            self._offer(frame)
        if math.isnan(self._waiting_since_s):
            self._waiting_since_s = self._arrival_s
        own = (frame.sysid, frame.compid) == (self.flight.sysid, self.flight.compid)
        clocked = own and "time_boot_ms" in message.fields
        late = len(self._waiting) >= WAIT_FRAMES or abs(self._arrival_s - self._waiting_since_s) > WAIT_S
        if clocked or late:
            self._release()

    def _offer(self, frame: Frame) -> None:
        beat = frame.fields()
        kind, autopilot = int(number(beat, "type")), int(number(beat, "autopilot"))
        if autopilot == mavlink.MAV_AUTOPILOT_INVALID or kind in NO_VEHICLE:
            return
        if self.sysid is None or self.sysid == frame.sysid:
            flight = self.flight
            flight.sysid, flight.compid, flight.type, flight.autopilot = frame.sysid, frame.compid, kind, autopilot

    def _release(self) -> None:
        """Judge what was kept back; what came before the vehicle's first stamp gets the time counted back from there."""
        waiting, self._waiting = self._waiting or [], None
        arrivals = [arrival_s for _, arrival_s in waiting if math.isfinite(arrival_s)]
        for frame, arrival_s in waiting:
            if frame.sysid == self.flight.sysid and frame.compid == self.flight.compid:
                stamp = frame.fields().get("time_boot_ms")
                if isinstance(stamp, int) and stamp > 0:
                    self.clock.expect(stamp / 1e3, arrival_s - arrivals[0] if math.isfinite(arrival_s) else 0.0)
                    break
        for frame, arrival_s in waiting:
            self._judge(frame, arrival_s)

    def _judge(self, frame: Frame, arrival_s: float) -> None:
        flight, clock = self.flight, self.clock
        message = frame.definition
        assert message is not None  # `take` lets no other in
        name, message_id = message.name, message.id
        flight.arrival_s = arrival_s
        if flight.sysid is None and message_id == HEARTBEAT_ID:
            self._offer(frame)
        ours = frame.compid == flight.compid and frame.sysid == flight.sysid
        clock.arrive(arrival_s)
        takes = self._wanted.get(message_id) if ours else None
        if takes is None:  # nothing in it is looked at
            flight.t_s = t_s = clock.now_s()
        else:
            self._heard.add(message_id)
            fields = decode_fields(message, frame.payload)
            flight.t_s = t_s = clock.read(fields, flight.armed)
            flight.clocked = clock.started
            flight.boot = len(clock.jumps)
            for take in takes:
                take(name, fields, t_s, frame)
        for take in self._every:
            take(name, NOTHING, t_s, frame)
        if message_id == HEARTBEAT_ID:
            for take in self._beats:
                take(name, NOTHING, t_s, frame)

    def _beat(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        if number(fields, "autopilot") == self.flight.autopilot and number(fields, "type") == self.flight.type:
            self.flight.beat(fields)  # a beat of another kind under the same id is not the vehicle's
            self.flight.move()

    def _speed(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        self.flight.ground_speed_m_s = number(fields, "groundspeed")
        self.flight.move()

    def _height(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        self.flight.height_m = number(fields, "relative_alt") / 1e3
        self.flight.move()

    def _landed(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        self.flight.landed_state = int(number(fields, "landed_state"))
        self.flight.move()

    def _step(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        self.flight.gps_step = self._steps.take(fields, t_s)

    def _attitude(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        self.flight.attitude.take(self.flight.boot, (t_s, *attitude(fields)))

    def _imu(self, name: str, fields: Fields, t_s: float, frame: Frame) -> None:
        flight = self.flight
        flight.imu = found = imu(name, fields, flight.ardupilot) if flight.under_way else None
        if found is not None and found.instance == 0:
            gyro, acceleration, magnetic = found.gyro_rad_s or NONE, found.acceleration_m_s2 or NONE, found.field_mg or NONE
            flight.inertial.take(flight.boot, (t_s, *gyro, *acceleration, *magnetic))

    def finish(self) -> list[Finding]:
        """What was found, one finding a check, in the order of the table."""
        if self._waiting is not None:
            self._release()
        self.flight.disarm(self.flight.t_s)
        return [self._finding(check, unit) for check, unit in self._units]

    def _finding(self, check: Check, unit: Unit) -> Finding:
        result = self._result(check, unit)
        if self.clock.started:
            return Finding(check.id, result.status, result.text, result.t, result.spans)
        return Finding(check.id, result.status, result.text)

    def _result(self, check: Check, unit: Unit) -> Result:
        if EVERY_FRAME in check.needs or EVERY_BEAT in check.needs:
            return unit.finish()
        if self.flight.sysid is None:
            return absent("no autopilot's HEARTBEAT")
        for names in check.needs:
            if not any(by_name(name).id in self._heard for name in names.split("|")):
                return absent(f"no {names.replace('|', ' or ')} message")
        return unit.finish()


def worst(findings: list[Finding]) -> Status:
    """The gravest status of all; NOT_AVAILABLE if nothing could be judged."""
    order = (Status.FAULT, Status.WARNING, Status.OK)
    return next((status for status in order if any(finding.status is status for finding in findings)), Status.NOT_AVAILABLE)
