"""What all checks share about the flight under judgement: whose it is, its clock, whether it is armed and moving.

Pure; the bench writes it, the checks read it.
"""

import math
from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion.checks.finding import Span
from companion.checks.reading import Imu, Step
from companion.checks.series import Series
from companion.dialect import Fields

MOVING_M_S: Final = 1.0  # ground speed above which a vehicle is under way
AIRBORNE_M: Final = 3.0  # above where it was armed
FLYING_M_S: Final = 8.0  # ground speed that no fixed wing rolls with for long

FIXED_WING: Final = frozenset({mavlink.MAV_TYPE_FIXED_WING, *range(19, 26)})  # 19 to 25: MAV_TYPE_VTOL_*
MOTORS: Final = {mavlink.MAV_TYPE_QUADROTOR: 4, mavlink.MAV_TYPE_HEXAROTOR: 6, mavlink.MAV_TYPE_OCTOROTOR: 8}
ROTORS: Final = frozenset(
    {
        *MOTORS,
        mavlink.MAV_TYPE_TRICOPTER,
        mavlink.MAV_TYPE_COAXIAL,
        mavlink.MAV_TYPE_HELICOPTER,
        mavlink.MAV_TYPE_DODECAROTOR,
    }
)
SURFACE: Final = frozenset({mavlink.MAV_TYPE_GROUND_ROVER, mavlink.MAV_TYPE_SURFACE_BOAT})

MODES: Final = {
    **dict.fromkeys(FIXED_WING, "PLANE_MODE"),
    **dict.fromkeys(ROTORS, "COPTER_MODE"),
    **dict.fromkeys(SURFACE, "ROVER_MODE"),
    mavlink.MAV_TYPE_SUBMARINE: "SUB_MODE",
}
PX4_MAIN_MODES: Final = {1: "manual", 2: "altctl", 3: "posctl", 4: "auto", 5: "acro", 6: "offboard", 7: "stabilized"}
PX4_AUTO_MODES: Final = {
    1: "ready",
    2: "takeoff",
    3: "loiter",
    4: "mission",
    5: "rtl",
    6: "land",
    8: "follow",
    9: "precland",
}


@dataclass(slots=True)
class Flight:
    """The one vehicle under judgement.  t_s: vehicle clock, s; arrival_s: when the newest frame came, NaN if unstamped."""

    sysid: int | None = None
    compid: int | None = None
    type: int = mavlink.MAV_TYPE_GENERIC
    autopilot: int = mavlink.MAV_AUTOPILOT_GENERIC
    clocked: bool = False  # does t_s count from the vehicle's boot?
    boot: int = 0  # grows with every reboot or jump of the clock: stamps of two boots cannot be compared
    t_s: float = 0.0
    arrival_s: float = math.nan
    armed: bool = False
    ever_armed: bool = False
    mode: int | None = None
    ground_speed_m_s: float = math.nan
    height_m: float = math.nan  # above home
    landed_state: int = mavlink.MAV_LANDED_STATE_UNDEFINED
    airborne: bool = False  # in the air as far as is known; False where nothing tells
    under_way: bool = False  # in the air, or moving on the ground or water; where nothing tells, armed is enough
    imu: Imu | None = None  # what the inertial message in hand holds; None while not under way
    attitude: Series = field(default_factory=Series)  # rows of ATTITUDE: ANGLES, then RATES
    inertial: Series = field(default_factory=Series)  # of the first sensor while under way: GYRO, ACCELERATION, MAGNETIC
    gps_step: Step | None = None  # to the GPS_RAW_INT in hand from the one before
    armed_spans: list[Span] = field(default_factory=list)
    modes: list[tuple[float, str]] = field(default_factory=list)
    _armed_since_s: float = 0.0

    @property
    def fixed_wing(self) -> bool:
        return self.type in FIXED_WING

    @property
    def rotors(self) -> bool:
        return self.type in ROTORS

    @property
    def ardupilot(self) -> bool:
        return bool(self.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA)

    def move(self) -> None:
        """Follow what changed of armed state, speed, height or landed state: asked for far more often than it changes."""
        self.airborne = self.armed and self._in_air()
        moving = self.armed and self.ground_speed_m_s > MOVING_M_S
        untold = self.armed and math.isnan(self.ground_speed_m_s) and math.isnan(self.height_m)
        self.under_way = self.airborne or (moving and not self.rotors) or untold

    def _in_air(self) -> bool:
        if self.landed_state in (mavlink.MAV_LANDED_STATE_ON_GROUND, mavlink.MAV_LANDED_STATE_IN_AIR):
            return bool(self.landed_state == mavlink.MAV_LANDED_STATE_IN_AIR)
        if self.fixed_wing:
            return self.ground_speed_m_s > FLYING_M_S
        return self.rotors and self.height_m > AIRBORNE_M

    def beat(self, fields: Fields) -> None:
        """A HEARTBEAT of the vehicle's autopilot."""
        base, mode = fields["base_mode"], fields["custom_mode"]
        assert isinstance(base, int)
        assert isinstance(mode, int)
        armed = bool(base & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        if armed != self.armed:
            if armed:
                self._armed_since_s = self.t_s
                self.ever_armed = True
            else:
                self.disarm(self.t_s)
            self.armed = armed
        if mode != self.mode:
            self.mode = mode
            self.modes.append((self.t_s, self.mode_name(mode)))

    def disarm(self, t_s: float) -> None:
        """The armed time that stands open ends here."""
        if self.armed:
            self.armed_spans.append((self._armed_since_s, max(t_s, self._armed_since_s)))
            self.armed = False

    def mode_name(self, mode: int) -> str:
        """The autopilot's name of a custom mode, its number where none is known."""
        if self.autopilot == mavlink.MAV_AUTOPILOT_PX4:
            main, sub = mode >> 16 & 0xFF, mode >> 24 & 0xFF
            name = PX4_MAIN_MODES.get(main, f"mode {main}")
            return f"{name} {PX4_AUTO_MODES.get(sub, sub)}" if main == 4 else name
        group = MODES.get(self.type, "")
        entry = mavlink.enums.get(group, {}).get(mode) if self.ardupilot else None
        return str(entry.name).removeprefix(group + "_").lower() if entry is not None else f"mode {mode}"
