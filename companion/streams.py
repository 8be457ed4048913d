"""Asking the autopilot for the messages that the airframe needs, and noticing which of them do not come.

Pure; all times are arrival stamps.  First MAV_CMD_SET_MESSAGE_INTERVAL, what still does not come by the older
REQUEST_DATA_STREAM, and what does not come then is said rather than going blind quietly.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from companion.dialect import by_name
from companion.effects import Send

CHECK_US: Final = 4_000_000  # what has been asked for is counted over so long
ENOUGH: Final = 0.5  # of what the rate promises: radios thin out

# ArduPilot's stream groups (GCS_Mavlink.cpp of its vehicles)
GROUPS: Final[Mapping[str, int]] = {
    "HIGHRES_IMU": mavlink.MAV_DATA_STREAM_RAW_SENSORS,
    "SCALED_PRESSURE": mavlink.MAV_DATA_STREAM_RAW_SENSORS,
    "GPS_RAW_INT": mavlink.MAV_DATA_STREAM_EXTENDED_STATUS,
    "NAV_CONTROLLER_OUTPUT": mavlink.MAV_DATA_STREAM_EXTENDED_STATUS,
    "SERVO_OUTPUT_RAW": mavlink.MAV_DATA_STREAM_RC_CHANNELS,
    "GLOBAL_POSITION_INT": mavlink.MAV_DATA_STREAM_POSITION,
    "ATTITUDE": mavlink.MAV_DATA_STREAM_EXTRA1,
    "ATTITUDE_TARGET": mavlink.MAV_DATA_STREAM_EXTRA1,
    "VFR_HUD": mavlink.MAV_DATA_STREAM_EXTRA2,
    "WIND": mavlink.MAV_DATA_STREAM_EXTRA3,
    "WHEEL_DISTANCE": mavlink.MAV_DATA_STREAM_EXTRA3,
}


@dataclass(slots=True)
class Streams:
    """The streams wanted of one vehicle: message -> Hz."""

    wanted_hz: Mapping[str, float]
    missing: tuple[str, ...] = ()  # found missing in the end
    _round: int = -1  # 0, 1: intervals asked; 2: groups asked; 3: settled
    until_us: int = 0  # the present count ends then
    _counts: Counter[str] = field(default_factory=Counter)

    def heard(self, message: str) -> None:
        self._counts[message] += 1

    def ask(self, now_us: int) -> list[Send]:
        """Begin (again): the vehicle has just been found, or has rebooted and forgotten."""
        self._round, self.missing = 0, ()
        return self._intervals(self.wanted_hz, now_us)

    def tick(self, now_us: int) -> list[Send]:
        """-> further requests; sets `missing` when nothing has helped."""
        if self._round not in (0, 1, 2) or now_us < self.until_us:
            return []
        lacking = [
            name
            for name, rate_hz in self.wanted_hz.items()
            if self._counts[name] < max(1.0, ENOUGH * rate_hz * CHECK_US * 1e-6)
        ]
        self._round = self._round + 1 if lacking else 3
        looked_us = self.until_us  # not now_us: nothing may depend on when somebody happened to look
        if self._round == 1:
            return self._intervals({name: self.wanted_hz[name] for name in lacking}, looked_us)
        if self._round == 2:
            self._begin_count(looked_us)
            groups: dict[int, float] = {}
            for name in lacking:
                if name in GROUPS:  # one rate for all of a group: that of the one in most haste
                    groups[GROUPS[name]] = max(self.wanted_hz[name], groups.get(GROUPS[name], 1.0))
            return [
                Send("REQUEST_DATA_STREAM", {"req_stream_id": group, "req_message_rate": round(rate_hz), "start_stop": 1})
                for group, rate_hz in sorted(groups.items())
            ]
        self.missing = tuple(lacking)
        return []

    def _intervals(self, rates_hz: Mapping[str, float], now_us: int) -> list[Send]:
        self._begin_count(now_us)
        command = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        return [
            Send("COMMAND_LONG", {"command": command, "param1": float(by_name(name).id), "param2": 1e6 / rate_hz})
            for name, rate_hz in rates_hz.items()
        ]

    def _begin_count(self, now_us: int) -> None:
        self._counts.clear()
        self.until_us = now_us + CHECK_US
