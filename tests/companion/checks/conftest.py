"""A log written by hand: messages of one vehicle at chosen times, through the bench."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest

from companion.checks import Bench, Finding
from companion.dialect import Fields, by_name, encode
from companion.frames import Frame, candidate

START_US = 1_760_000_000_000_000
ARMED = 0x80 | 0x01

Messages = Callable[[float], list[tuple[str, dict]]]


@dataclass
class Log:
    """Frames with stamps; t_s is the vehicle's clock, arrivals follow it by `delay_s`."""

    type: int = 2
    autopilot: int = 3
    sysid: int = 1
    records: list[tuple[Frame, int | None]] = field(default_factory=list)
    seq: dict[int, int] = field(default_factory=dict)

    def send(self, t_s: float, name: str, fields: Fields, sysid: int | None = None, compid: int = 1, stamped: bool = True):
        sysid = self.sysid if sysid is None else sysid
        seq = self.seq[sysid] = (self.seq.get(sysid, -1) + 1) % 256
        stamp = {"time_boot_ms": round(t_s * 1e3)} if "time_boot_ms" in by_name(name).fields else {}
        frame = candidate(encode(name, {**stamp, **fields}, sysid=sysid, compid=compid, seq=seq), 0)
        assert frame is not None
        self.records.append((frame[0], START_US + round(t_s * 1e6) if stamped else None))

    def beat(self, t_s: float, armed: bool = True, mode: int = 4, **more):
        kind, pilot = more.pop("type", self.type), more.pop("autopilot", self.autopilot)
        fields = {"type": kind, "autopilot": pilot, "base_mode": ARMED if armed else 0x01, "custom_mode": mode}
        self.send(t_s, "HEARTBEAT", fields, **more)

    def fly(self, start_s: float, end_s: float, messages: Messages, hz: float = 4.0, armed: bool = True):
        """Heartbeats and SYSTEM_TIME at 1 Hz, and what `messages` says for each time at hz."""
        steps = round((end_s - start_s) * hz)
        for step in range(steps):
            t_s = start_s + step / hz
            if step % max(1, round(hz)) == 0:
                self.beat(t_s, armed)
                self.send(t_s, "SYSTEM_TIME", {})
            for name, fields in messages(t_s):
                self.send(t_s, name, fields)

    def findings(self, sysid: int | None = None) -> dict[str, Finding]:
        bench = Bench(sysid)
        for frame, stamp_us in self.records:
            bench.take(frame, stamp_us)
        return {finding.id: finding for finding in bench.finish()}


@pytest.fixture
def log() -> Callable[..., Log]:
    """Log(type=MAV_TYPE, autopilot=MAV_AUTOPILOT); a quadrotor of ArduPilot unless told otherwise."""
    return Log


PLANE_M_S, TURN_RAD_S = 20.0, 0.1


def circle(t_s: float, wind_north_m_s: float = 0.0) -> dict[str, float]:
    """A fixed wing in a level circle, 20 m/s through the air, once around in a minute."""
    yaw = math.remainder(TURN_RAD_S * t_s, 2.0 * math.pi)
    north_m = PLANE_M_S / TURN_RAD_S * math.sin(TURN_RAD_S * t_s) + wind_north_m_s * t_s
    east_m = PLANE_M_S / TURN_RAD_S * (1.0 - math.cos(TURN_RAD_S * t_s))
    north_m_s, east_m_s = PLANE_M_S * math.cos(yaw) + wind_north_m_s, PLANE_M_S * math.sin(yaw)
    roll = math.atan(PLANE_M_S * TURN_RAD_S / 9.80665)
    return {"yaw": yaw, "roll": roll, "n": north_m, "e": east_m, "vn": north_m_s, "ve": east_m_s}


@dataclass
class Plane:
    """What a fixed wing in a circle sends; every attribute is a way in which it can be wrong."""

    wind_north_m_s: float = 3.0
    airspeed: Callable[[float], float] = lambda t_s: PLANE_M_S + 0.1 * math.sin(t_s)
    gps_north_m: Callable[[float], float] = lambda _: 0.0
    gps_velocity_north_m_s: Callable[[float], float] = lambda _: 0.0
    fix: Callable[[float], int] = lambda _: 3
    baro_m: Callable[[float], float] = lambda _: 0.0
    gyro_1: Callable[[float], float] = lambda _: 0.0  # rad/s about z, first IMU
    gyro_both: Callable[[float], float] = lambda _: 0.0
    accelerometer_1: Callable[[float], float] = lambda _: 0.0  # m/s2 along y
    accelerometer_both: Callable[[float], float] = lambda _: 0.0
    magnet: Callable[[float], float] = lambda _: 0.0  # mG along x, first compass
    frozen: Callable[[float], bool] = lambda _: False
    nav_roll_deg: Callable[[float], float] = lambda _: math.degrees(circle(0.0)["roll"])
    yaw_rad: Callable[[float], float] = lambda _: 0.0  # added to the heading told

    def messages(self, t_s: float) -> list[tuple[str, dict]]:
        c = circle(t_s, self.wind_north_m_s)
        vn, ve = c["vn"] + self.gps_velocity_north_m_s(t_s), c["ve"]
        ground = math.hypot(c["vn"], c["ve"])
        noise = 1 if round(t_s * 4.0) % 2 else -1  # one count, so that no two samples are alike
        roll, yaw = c["roll"], c["yaw"]
        rates = (0.0, TURN_RAD_S * math.sin(roll), TURN_RAD_S * math.cos(roll))
        # Coordinated: no side force; lift carries weight and turn.
        force = (0.0, 0.0, -9.80665 / math.cos(roll))
        earth = (200.0, 0.0, 500.0)
        north, east = math.cos(yaw), math.sin(yaw)
        mx = earth[0] * north
        my = -earth[0] * east * math.cos(roll) + earth[2] * math.sin(roll)
        mz = earth[0] * east * math.sin(roll) + earth[2] * math.cos(roll)

        def imu(gyro_z: float, acc_y: float, mag_x: float) -> dict:
            return {
                "xgyro": noise,
                "ygyro": round(1e3 * rates[1]),
                "zgyro": round(1e3 * (rates[2] + gyro_z)),
                "xacc": noise,
                "yacc": round((force[1] + acc_y) / 9.80665e-3),
                "zacc": round(force[2] / 9.80665e-3),
                "xmag": round(mx + mag_x),
                "ymag": round(my),
                "zmag": round(mz),
            }

        first = imu(
            self.gyro_1(t_s) + self.gyro_both(t_s),
            self.accelerometer_1(t_s) + self.accelerometer_both(t_s),
            self.magnet(t_s),
        )
        if self.frozen(t_s):
            first |= {"xgyro": 0, "ygyro": 0, "zgyro": 0}
        told = math.remainder(yaw + self.yaw_rad(t_s), 2.0 * math.pi)
        north_m = c["n"] + self.gps_north_m(t_s)
        pressure = 950.0 * math.exp(-(100.0 + self.baro_m(t_s)) / 8434.5)
        return [
            ("ATTITUDE", {"roll": roll, "yaw": told, "pitchspeed": rates[1], "yawspeed": rates[2]}),
            ("VFR_HUD", {"airspeed": self.airspeed(t_s), "groundspeed": ground, "alt": 100.0}),
            (
                "GLOBAL_POSITION_INT",
                {"relative_alt": 100_000, "vx": round(100.0 * c["vn"]), "vy": round(100.0 * c["ve"])},
            ),
            (
                "GPS_RAW_INT",
                {
                    "time_usec": round(t_s * 1e6),
                    "fix_type": self.fix(t_s),
                    "lat": round(north_m / 111_319.5 * 1e7),
                    "lon": round(c["e"] / 111_319.5 * 1e7),
                    "alt": 100_000,
                    "eph": 90,
                    "vel": round(100.0 * math.hypot(vn, ve)),
                    "cog": round(math.degrees(math.atan2(ve, vn)) % 360.0 * 100.0),
                    "satellites_visible": 12,
                },
            ),
            ("RAW_IMU", {"time_usec": round(t_s * 1e6), **first}),
            ("SCALED_IMU2", imu(self.gyro_both(t_s), self.accelerometer_both(t_s), 0.0)),
            ("SCALED_PRESSURE", {"press_abs": pressure}),
            ("NAV_CONTROLLER_OUTPUT", {"nav_roll": self.nav_roll_deg(t_s), "nav_pitch": 0.0}),
        ]


@pytest.fixture
def plane(log: Callable[..., Log]) -> Callable[..., dict[str, Finding]]:
    """plane(gyro_1=..., ...) -> findings of four minutes of a fixed wing in a circle."""

    def fly(seconds: float = 240.0, **wrong) -> dict[str, Finding]:
        flight = log(type=1)
        flight.fly(10.0, 10.0 + seconds, Plane(**wrong).messages)
        return flight.findings()

    return fly
