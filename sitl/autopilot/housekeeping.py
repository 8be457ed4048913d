"""The messages in which the autopilot speaks of itself: heartbeat, health, state, clock, home, version.

Pure functions from what is to be said to a packed message.
"""

import math
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from sitl.autopilot.frames import Packed, pack

AUTOPILOT_ARDUPILOTMEGA = 3  # parameters are plain casts here, and clients read them so for this autopilot alone
BASE_MODE_CUSTOM = 1
BASE_MODE_ARMED = 128


class SystemState(IntEnum):
    """MAV_STATE."""

    STANDBY = 3
    ACTIVE = 4


class LandedState(IntEnum):
    """MAV_LANDED_STATE."""

    ON_GROUND = 1
    IN_AIR = 2


class Severity(IntEnum):
    """MAV_SEVERITY."""

    EMERGENCY = 0
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6


class Sensor(IntFlag):
    """MAV_SYS_STATUS_SENSOR, those that this autopilot has."""

    GYRO = 0x01
    ACCEL = 0x02
    MAG = 0x04
    ABSOLUTE_PRESSURE = 0x08
    GPS = 0x20
    MOTOR_OUTPUTS = 0x8000
    AHRS = 0x200000
    BATTERY = 0x2000000
    PREARM_CHECK = 0x10000000


ALL_SENSORS = Sensor(0x01 | 0x02 | 0x04 | 0x08 | 0x20 | 0x8000 | 0x200000 | 0x2000000 | 0x10000000)

# MAV_PROTOCOL_CAPABILITY: PARAM_FLOAT, MISSION_INT, COMMAND_INT, MAVLINK2, PARAM_ENCODE_C_CAST
CAPABILITIES = 0x02 | 0x04 | 0x08 | 0x2000 | 0x20000
VERSION = 0x00010000  # 0.1.0, "dev"


@dataclass(frozen=True, slots=True)
class Home:
    """Where distances and heights are counted from."""

    latitude_rad: float = 0.0
    longitude_rad: float = 0.0
    altitude_m: float = 0.0  # above mean sea level


def heartbeat(mav_type: int, armed: bool, custom_mode: int, state: SystemState) -> Packed:
    """HEARTBEAT."""
    return pack(
        "HEARTBEAT", type=mav_type, autopilot=AUTOPILOT_ARDUPILOTMEGA, custom_mode=custom_mode, system_status=state,
        base_mode=BASE_MODE_CUSTOM | (BASE_MODE_ARMED if armed else 0), mavlink_version=3,
    )  # fmt: skip


def sys_status(healthy: Sensor, voltage_v: float, load: float) -> Packed:
    """SYS_STATUS; load 0..1."""
    return pack(
        "SYS_STATUS", onboard_control_sensors_present=ALL_SENSORS, onboard_control_sensors_enabled=ALL_SENSORS,
        onboard_control_sensors_health=healthy, load=round(1000.0 * load), voltage_battery=round(1000.0 * voltage_v),
        current_battery=-1, battery_remaining=-1,
    )  # fmt: skip


def extended_sys_state(landed: LandedState) -> Packed:
    """EXTENDED_SYS_STATE of a vehicle that is no VTOL."""
    return pack("EXTENDED_SYS_STATE", vtol_state=0, landed_state=landed)


def system_time(unix_us: int, boot_us: int) -> Packed:
    """SYSTEM_TIME; unix_us 0: not known."""
    return pack("SYSTEM_TIME", time_unix_usec=unix_us, time_boot_ms=boot_us // 1000 & 0xFFFFFFFF)


def timesync(tc1_ns: int, ts1_ns: int) -> Packed:
    """TIMESYNC: a question with tc1 = 0, else an answer."""
    return pack("TIMESYNC", tc1=tc1_ns, ts1=ts1_ns)


def home_position(home: Home, boot_us: int) -> Packed:
    """HOME_POSITION, level, without an approach."""
    return pack(
        "HOME_POSITION", latitude=round(math.degrees(home.latitude_rad) * 1e7),
        longitude=round(math.degrees(home.longitude_rad) * 1e7), altitude=round(home.altitude_m * 1000.0),
        q=(1.0, 0.0, 0.0, 0.0), time_usec=boot_us,
    )  # fmt: skip


def autopilot_version(sysid: int) -> Packed:
    """AUTOPILOT_VERSION of the simulator."""
    return pack(
        "AUTOPILOT_VERSION", capabilities=CAPABILITIES, flight_sw_version=VERSION, uid=sysid,
        flight_custom_version=tuple(b"mavfdi\0\0"),
    )  # fmt: skip


def mission_current(items: int) -> Packed:
    """MISSION_CURRENT; without a mission MISSION_STATE_NO_MISSION (1), else not started (2)."""
    return pack("MISSION_CURRENT", seq=0, total=items or 0xFFFF, mission_state=2 if items else 1)


def statustext(severity: Severity, text: str) -> Packed:
    """STATUSTEXT.  Raises ValueError for a text that does not fit its 50 bytes."""
    if len(text.encode()) > 50:
        raise ValueError(f"STATUSTEXT holds 50 bytes, {text!r} has {len(text.encode())}")
    return pack("STATUSTEXT", severity=severity, text=text.encode())


def message_interval(message_id: int, interval_us: int) -> Packed:
    """MESSAGE_INTERVAL: -1 off, 0 not available."""
    return pack("MESSAGE_INTERVAL", message_id=message_id, interval_us=interval_us)


def param_value(name: str, value: float, param_type: int, count: int, index: int) -> Packed:
    """PARAM_VALUE."""
    return pack(
        "PARAM_VALUE", param_id=name.encode(), param_value=value, param_type=param_type, param_count=count, param_index=index
    )  # fmt: skip


def command_ack(command: int, result: int, progress: int, system: int, component: int) -> Packed:
    """COMMAND_ACK; progress in percent, 255 unknown."""
    return pack(
        "COMMAND_ACK", command=command, result=result, progress=progress, target_system=system, target_component=component
    )  # fmt: skip
