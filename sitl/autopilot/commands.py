"""What the autopilot does on COMMAND_LONG and COMMAND_INT: one function a command, all in one table.

Nothing is accepted that has no effect.  Source: MAVLink common.xml, MAV_CMD and MAV_RESULT; ArduPilot GCS_Common.cpp.
"""

import math
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

from sitl.autopilot import housekeeping as say
from sitl.autopilot.housekeeping import BASE_MODE_CUSTOM, Severity
from sitl.vehicle import Injection

if TYPE_CHECKING:
    from sitl.autopilot.autopilot import Autopilot
    from sitl.autopilot.routing import Client

FORCE = 21196.0  # param2 of MAV_CMD_COMPONENT_ARM_DISARM
NO_INTEGER = -1
CALIBRATION_S = 1.0
MESSAGE_INTERVAL_ID = 244

REQUEST_MESSAGE = 512
SET_MESSAGE_INTERVAL = 511
PREFLIGHT_CALIBRATION = 241


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5


@dataclass(frozen=True, slots=True)
class Command:
    """One command, whichever of the two messages brought it."""

    id: int
    params: tuple[float, float, float, float, float, float, float]  # 5 and 6 in degrees or metres where from COMMAND_INT
    client: Hashable
    system: int  # who sent it
    component: int


def obey(autopilot: "Autopilot", client: "Client", command: Command) -> Result:
    """Do it, as far as it can be done."""
    action = _ACTIONS.get(command.id)
    return action(autopilot, client, command) if action is not None else Result.UNSUPPORTED


def _whole(value: float) -> int:
    return int(value) if math.isfinite(value) and value == math.floor(value) else NO_INTEGER


def _arm_disarm(autopilot: "Autopilot", _client: "Client", command: Command) -> Result:
    force = command.params[1] == FORCE
    if command.params[0] == 1.0:
        return autopilot.arm(force=force)
    if command.params[0] == 0.0:
        return autopilot.disarm(force=force)
    return Result.DENIED


def _set_mode(autopilot: "Autopilot", _client: "Client", command: Command) -> Result:
    if _whole(command.params[0]) == NO_INTEGER or not _whole(command.params[0]) & BASE_MODE_CUSTOM:
        return Result.DENIED
    return Result.ACCEPTED if autopilot.set_mode(_whole(command.params[1])) else Result.DENIED


def _request_message(autopilot: "Autopilot", client: "Client", command: Command) -> Result:
    message_id = _whole(command.params[0])
    if message_id == MESSAGE_INTERVAL_ID:
        return _tell_interval(autopilot, client, _whole(command.params[1]))
    return autopilot.send_once(client, message_id)


def _get_message_interval(autopilot: "Autopilot", client: "Client", command: Command) -> Result:
    return _tell_interval(autopilot, client, _whole(command.params[0]))


def _tell_interval(autopilot: "Autopilot", client: "Client", message_id: int) -> Result:
    if not 0 <= message_id <= 0xFFFF:
        return Result.DENIED
    interval_us = autopilot.interval_us(client, message_id)
    autopilot.send(client, say.message_interval(message_id, interval_us))
    return Result.ACCEPTED if interval_us != 0 else Result.DENIED


def _set_message_interval(autopilot: "Autopilot", client: "Client", command: Command) -> Result:
    interval_us = command.params[1]
    if not math.isfinite(interval_us) or (interval_us < 0.0 and interval_us != -1.0) or interval_us > 2**31 - 1:
        return Result.DENIED
    return Result.ACCEPTED if autopilot.set_interval(client, _whole(command.params[0]), int(interval_us)) else Result.DENIED


def _capabilities(autopilot: "Autopilot", client: "Client", command: Command) -> Result:
    if command.params[0] != 1.0:
        return Result.DENIED
    autopilot.send(client, say.autopilot_version(autopilot.sysid))
    return Result.ACCEPTED


def _home_position(autopilot: "Autopilot", client: "Client", _command: Command) -> Result:
    autopilot.send(client, say.home_position(autopilot.home, autopilot.time_us))
    return Result.ACCEPTED


def _reboot(autopilot: "Autopilot", client: "Client", command: Command) -> Result:
    """Autopilot reboot only (param1 = 1).  In the air ArduPilot's watchdog does it, here the one who tests may."""
    if command.params[0] != 1.0:
        return Result.UNSUPPORTED if command.params[0] != 0.0 else Result.DENIED
    # The answer leaves before the lights go out: afterwards nobody would know what became of the command.
    autopilot.acknowledge(client, command, Result.ACCEPTED)
    autopilot.reboot()
    return Result.ACCEPTED


def _calibrate(autopilot: "Autopilot", client: "Client", command: Command) -> Result:
    """Gyro calibration (param1 = 1): takes its second on the ground, cannot be done while armed."""
    if command.params[0] != 1.0 or any(command.params[1:]):
        return Result.UNSUPPORTED
    if autopilot.armed:
        return Result.TEMPORARILY_REJECTED
    autopilot.finish_later(client, command, CALIBRATION_S)
    return Result.IN_PROGRESS


def _inject_failure(autopilot: "Autopilot", _client: "Client", command: Command) -> Result:
    unit, kind = _whole(command.params[0]), _whole(command.params[1])
    rows = [row for row in autopilot.vehicle.injections if (row.unit, row.type) == (unit, kind)]
    if not rows:
        return Result.UNSUPPORTED
    if autopilot.parameters.value("SYS_FAILURE_EN") != 1.0:
        return Result.DENIED
    instances = _instances(rows[0], command.params[2], command.params[3])
    for instance in instances:
        autopilot.fleet.command(0, rows[0].command, float(instance))
    return Result.ACCEPTED if instances else Result.DENIED


def _instances(row: Injection, instance: float, bitmask: float) -> tuple[int, ...]:
    """Which instances are meant, 1-based: one, all (0), or by bitmask where param3 is NaN; none if out of range."""
    if math.isnan(instance):
        mask = _whole(bitmask)
        if mask <= 0 or mask >> row.instances:
            return ()
        return tuple(i + 1 for i in range(row.instances) if mask >> i & 1)
    number = _whole(instance)
    if number == 0:
        return tuple(range(1, row.instances + 1))
    return (number,) if 1 <= number <= row.instances else ()


def _prearm_checks(autopilot: "Autopilot", _client: "Client", _command: Command) -> Result:
    if autopilot.armed:
        return Result.TEMPORARILY_REJECTED
    if not autopilot.ready_to_arm:
        autopilot.say(Severity.CRITICAL, "PreArm: GPS has no fix")
    return Result.ACCEPTED


_ACTIONS: Mapping[int, Callable[["Autopilot", "Client", Command], Result]] = {
    176: _set_mode,  # MAV_CMD_DO_SET_MODE
    PREFLIGHT_CALIBRATION: _calibrate,
    246: _reboot,  # MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
    400: _arm_disarm,  # MAV_CMD_COMPONENT_ARM_DISARM
    401: _prearm_checks,  # MAV_CMD_RUN_PREARM_CHECKS
    410: _home_position,  # MAV_CMD_GET_HOME_POSITION
    420: _inject_failure,  # MAV_CMD_INJECT_FAILURE
    510: _get_message_interval,
    SET_MESSAGE_INTERVAL: _set_message_interval,
    REQUEST_MESSAGE: _request_message,
    520: _capabilities,  # MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES
}
