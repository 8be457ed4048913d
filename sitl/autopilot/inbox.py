"""What the autopilot understands: one function a message, all in one table.  Everything else it only forwards."""

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, TypeAlias

from pymavlink.dialects.v20 import all as dialect

from sitl.autopilot import housekeeping as tell
from sitl.autopilot import mission
from sitl.autopilot.commands import Command, Result, obey
from sitl.autopilot.frames import pack
from sitl.autopilot.housekeeping import BASE_MODE_CUSTOM, Severity
from sitl.autopilot.misbehaviour import CommandMode
from sitl.autopilot.parameters import Refusal

if TYPE_CHECKING:
    from sitl.autopilot.autopilot import Autopilot
    from sitl.autopilot.routing import Client

Message: TypeAlias = dialect.MAVLink_message

SET_MODE_ID = 11


def understand(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    """Do what a message that is meant for this autopilot asks for."""
    action = _ACTIONS.get(message.get_type())
    if action is not None:
        action(autopilot, client, message)


def _command_long(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    params = (
        message.param1, message.param2, message.param3, message.param4, message.param5, message.param6, message.param7,
    )  # fmt: skip
    _command(autopilot, client, message, params)


def _command_int(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    params = (
        message.param1, message.param2, message.param3, message.param4, float(message.x), float(message.y), message.z,
    )  # fmt: skip
    _command(autopilot, client, message, params)


def _command(
    autopilot: "Autopilot",
    client: "Client",
    message: "Message",
    params: tuple[float, float, float, float, float, float, float],
) -> None:
    command = Command(message.command, params, client.key, message.get_srcSystem(), message.get_srcComponent())
    switches = autopilot.misbehaviour
    mode = CommandMode(switches.command_mode)
    if mode is CommandMode.IGNORE:
        return
    answers = {
        CommandMode.DENY: Result.DENIED,
        CommandMode.REJECT: Result.TEMPORARILY_REJECTED,
        CommandMode.LIE: Result.ACCEPTED,
    }
    result = answers[mode] if mode in answers else obey(autopilot, client, command)
    if mode is CommandMode.LATE:
        autopilot.later(switches.command_delay_s, lambda: autopilot.acknowledge(client, command, result))
    else:
        autopilot.acknowledge(client, command, result, 0 if result is Result.IN_PROGRESS else 255)


def _set_mode(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    """SET_MODE is acknowledged under its own message number, as on ArduPilot."""
    done = bool(message.base_mode & BASE_MODE_CUSTOM) and autopilot.set_mode(message.custom_mode)
    result = Result.ACCEPTED if done else Result.DENIED
    autopilot.send(
        client, tell.command_ack(SET_MODE_ID, result, 255, message.get_srcSystem(), message.get_srcComponent())
    )  # fmt: skip


def _param_request_list(autopilot: "Autopilot", client: "Client", _message: "Message") -> None:
    client.parameters_left.clear()
    client.parameters_left.extend(range(len(autopilot.parameters.names)))


def _param_request_read(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    names = autopilot.parameters.names
    index: int = message.param_index
    if index == -1 and message.param_id in autopilot.parameters:
        autopilot.send_parameter(client, names.index(message.param_id))
    elif 0 <= index < len(names):
        autopilot.send_parameter(client, index)
    else:
        _param_error(autopilot, client, message, Refusal.UNKNOWN_NAME, index)


def _param_set(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    name: str = message.param_id
    meeting = autopilot.parameters.meet(name, message.param_value)
    switches = autopilot.misbehaviour
    if switches.reboot_at_set and switches.sets_met == switches.reboot_at_set and not math.isnan(meeting.stored):
        switches.reboot_at_set = 0
        autopilot.reboot()
        return
    if meeting.applied:
        autopilot.apply_parameter(name, meeting.stored)
    if meeting.echoed:
        autopilot.echo_parameter(name, meeting.echo, meeting.delay_s)
        if not meeting.applied and meeting.refusal:
            autopilot.say(Severity.WARNING, f"Param write denied ({name})")
    if meeting.refusal:
        _param_error(autopilot, client, message, meeting.refusal, -1)


def _param_error(autopilot: "Autopilot", client: "Client", message: "Message", refusal: Refusal, index: int) -> None:
    if autopilot.param_errors:
        autopilot.send(
            client,
            pack(
                "PARAM_ERROR", target_system=message.get_srcSystem(), target_component=message.get_srcComponent(),
                param_id=message.param_id.encode("ascii", "replace")[:16], param_index=index, error=refusal,
            ),
        )  # fmt: skip


def _request_data_stream(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    autopilot.set_group(client, message.req_stream_id, message.req_message_rate if message.start_stop else 0)


def _timesync(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    if message.tc1 == 0:
        autopilot.send(client, tell.timesync(max(1, autopilot.time_us * 1000), message.ts1))
    else:
        autopilot.time_answers[client.key] = message.ts1


def _ping(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    if message.target_system == 0:  # a question; answers carry a target
        autopilot.send(
            client,
            pack(
                "PING", time_usec=message.time_usec, seq=message.seq, target_system=message.get_srcSystem(),
                target_component=message.get_srcComponent(),
            ),
        )  # fmt: skip


def _mission_request_list(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    source = (message.get_srcSystem(), message.get_srcComponent())
    autopilot.send(client, mission.count(autopilot.mission, message.mission_type, *source))


def _mission_request(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    source = (message.get_srcSystem(), message.get_srcComponent())
    autopilot.send(client, mission.item(autopilot.mission, message.seq, message.mission_type, *source))


def _mission_change(autopilot: "Autopilot", client: "Client", message: "Message") -> None:
    source = (message.get_srcSystem(), message.get_srcComponent())
    autopilot.send(client, mission.acknowledgement(mission.ACK_DENIED, message.mission_type, *source))


_ACTIONS: Mapping[str, Callable[["Autopilot", "Client", "Message"], None]] = {
    "COMMAND_LONG": _command_long,
    "COMMAND_INT": _command_int,
    "SET_MODE": _set_mode,
    "PARAM_REQUEST_LIST": _param_request_list,
    "PARAM_REQUEST_READ": _param_request_read,
    "PARAM_SET": _param_set,
    "REQUEST_DATA_STREAM": _request_data_stream,
    "TIMESYNC": _timesync,
    "PING": _ping,
    "MISSION_REQUEST_LIST": _mission_request_list,
    "MISSION_REQUEST_INT": _mission_request,
    "MISSION_REQUEST": _mission_request,
    "MISSION_COUNT": _mission_change,
    "MISSION_CLEAR_ALL": _mission_change,
}
