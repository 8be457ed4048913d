"""MAVLink frames straight from the definitions' tables, without message objects.

A simulator at full speed spends most of its time packing; pymavlink's message objects cost some 20 us a frame, this about 2.
The definitions (field order, format, CRC seed) are pymavlink's own, read once a message.  Parsing stays pymavlink's.
Source: MAVLink guide, "Packet Serialization".
"""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

from fastcrc import crc16
from pymavlink.dialects.v20 import all as dialect

MARKER_V1 = 0xFE
MARKER_V2 = 0xFD
UNSENDABLE = -1  # length of a message that MAVLink 1 has no place for

_HEADER_V2 = struct.Struct("<BBBBBBHB")
_HEADER_V1 = struct.Struct("<BBBBB")
_CRC = struct.Struct("<H")

Value = float | int | bytes | Sequence[float]


@dataclass(frozen=True, slots=True)
class Layout:
    """How one message lies in its payload: flat slots in wire order, an array's elements one slot each."""

    name: str
    id: int
    format: struct.Struct
    crc_extra: bytes
    first_slot: Mapping[str, int]  # by field
    slot_count: Mapping[str, int]  # by field; text is one slot
    code: Mapping[str, str]  # by field, struct's letter ("c" for text)
    blank: tuple[float | bytes, ...]  # all slots zero

    def slot(self, field: str) -> tuple[int, str]:
        """Slot and struct letter of "vx" or "distance[1]".  Raises KeyError for a field the message does not have."""
        name, bracket, index = field.partition("[")
        element = int(index.rstrip("]")) if bracket else 0
        if name not in self.first_slot or not 0 <= element < self.slot_count[name]:
            raise KeyError(f"{self.name} has no field {field}")
        return self.first_slot[name] + element, self.code[name]


@dataclass(frozen=True, slots=True)
class Packed:
    """One message ready for the frame of any client."""

    layout: Layout
    payload: bytes  # full length, zeros at the end still there


@cache
def layout(name: str) -> Layout:
    """Layout of a message by its name.  Raises KeyError for a name that the dialect does not have."""
    message = _classes()[name]
    first_slot: dict[str, int] = {}
    blank: list[float | bytes] = []
    codes = dict(zip(message.ordered_fieldnames, bytes(message.native_format).decode().lstrip("<"), strict=True))
    counts = dict(zip(message.ordered_fieldnames, (max(1, length) for length in message.lengths), strict=True))
    for field in message.ordered_fieldnames:
        first_slot[field] = len(blank)
        blank += [b"" if codes[field] == "c" else 0] * counts[field]
    return Layout(
        name, message.id, message.unpacker, bytes([message.crc_extra]), first_slot, counts, codes, tuple(blank)
    )  # fmt: skip


@cache
def _classes() -> dict[str, type[dialect.MAVLink_message]]:
    return {message.msgname: message for message in dialect.mavlink_map.values()}


def knows(name: str) -> bool:
    """Whether the dialect has a message of this name."""
    return name in _classes()


def pack(name: str, /, **fields: Value) -> Packed:
    """Pack one message in wire units; fields left out are zero.  Raises KeyError (field), struct.error (value)."""
    where = layout(name)
    slots = list(where.blank)
    for field, value in fields.items():
        first = where.first_slot[field]
        if isinstance(value, (float, int, bytes)):
            slots[first] = value
        else:
            slots[first : first + where.slot_count[field]] = value
    return Packed(where, where.format.pack(*slots))


def frame_v2(message: Packed, sequence: int, sysid: int, compid: int) -> bytes:
    """Frame of MAVLink 2: trailing zeros of the payload cut, at least one byte left, unsigned."""
    payload = message.payload.rstrip(b"\0") or message.payload[:1]
    number = message.layout.id
    body = _HEADER_V2.pack(len(payload), 0, 0, sequence, sysid, compid, number & 0xFFFF, number >> 16) + payload
    return b"\xfd" + body + _CRC.pack(crc16.mcrf4xx(body + message.layout.crc_extra))


def frame_v1(message: Packed, sequence: int, sysid: int, compid: int) -> bytes:
    """Frame of MAVLink 1: full length without the extension fields; empty where MAVLink 1 cannot carry the message."""
    length = length_v1(message.layout.id)
    if length == UNSENDABLE:
        return b""
    body = _HEADER_V1.pack(length, sequence, sysid, compid, message.layout.id) + message.payload[:length]
    return b"\xfe" + body + _CRC.pack(crc16.mcrf4xx(body + message.layout.crc_extra))


@cache
def length_v1(message_id: int) -> int:
    """Payload length in MAVLink 1, or UNSENDABLE.

    Where the extension fields begin is not in pymavlink's MAVLink 2 tables; its MAVLink 1 tables have none.
    """
    from pymavlink.dialects.v10 import all as dialect_v1  # few runs ever meet a MAVLink 1 client

    message = dialect_v1.mavlink_map.get(message_id)
    return message.unpacker.size if message is not None and message_id < 256 else UNSENDABLE


def source_of(raw: bytes) -> tuple[int, int]:
    """(system, component) that sent this frame."""
    return (raw[5], raw[6]) if raw[0] == MARKER_V2 else (raw[3], raw[4])
