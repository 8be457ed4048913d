"""Download of the mission that the vehicle was given (usually none): the answering side of MAVLink's mission protocol.

Uploading is refused: an airframe that flies a mission of its owner's has a real autopilot.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from sitl.autopilot.frames import Packed, pack

MISSION_TYPE_MISSION = 0
ACK_ACCEPTED = 0
ACK_INVALID_SEQUENCE = 13
ACK_DENIED = 14


@dataclass(frozen=True, slots=True)
class MissionItem:
    """One item as MISSION_ITEM_INT carries it; x and y in the units of its frame (degE7 in the global ones)."""

    command: int
    frame: int
    params: tuple[float, float, float, float]
    x: int
    y: int
    z_m: float


def count(items: Sequence[MissionItem], mission_type: int, system: int, component: int) -> Packed:
    """Answer to MISSION_REQUEST_LIST; geofence and rally points are always none."""
    number = len(items) if mission_type == MISSION_TYPE_MISSION else 0
    return pack(
        "MISSION_COUNT", target_system=system, target_component=component, count=number, mission_type=mission_type
    )  # fmt: skip


def item(items: Sequence[MissionItem], sequence: int, mission_type: int, system: int, component: int) -> Packed:
    """Answer to MISSION_REQUEST_INT, and to the old MISSION_REQUEST, which may be answered the same way."""
    if mission_type != MISSION_TYPE_MISSION or not 0 <= sequence < len(items):
        return acknowledgement(ACK_INVALID_SEQUENCE, mission_type, system, component)
    wanted = items[sequence]
    return pack(
        "MISSION_ITEM_INT", target_system=system, target_component=component, seq=sequence, frame=wanted.frame,
        command=wanted.command, current=int(sequence == 0), autocontinue=1, param1=wanted.params[0],
        param2=wanted.params[1], param3=wanted.params[2], param4=wanted.params[3], x=wanted.x, y=wanted.y,
        z=wanted.z_m, mission_type=mission_type,
    )  # fmt: skip


def acknowledgement(result: int, mission_type: int, system: int, component: int) -> Packed:
    """MISSION_ACK."""
    return pack(
        "MISSION_ACK", target_system=system, target_component=component, type=result, mission_type=mission_type
    )  # fmt: skip
