"""MAVLink's message definitions, taken from pymavlink, in the form that reading and writing frames needs.

Nothing else of pymavlink is used by the companion: no `mavutil`, no parameter client, no signing.
"""

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import MappingProxyType
from typing import Final

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as messages

Value = int | float | str | tuple[int, ...] | tuple[float, ...]
Fields = Mapping[str, Value]

MAGIC_V1: Final = 0xFE
MAGIC_V2: Final = 0xFD
SIGNED: Final = 0x01  # the only incompatibility flag there is; a frame with another one cannot be read
SIGNATURE_BYTES: Final = 13
CRC_BYTES: Final = 2
HEADER_BYTES: Final = MappingProxyType({MAGIC_V1: 6, MAGIC_V2: 10})
LONGEST_FRAME_BYTES: Final = 10 + 255 + CRC_BYTES + SIGNATURE_BYTES


@dataclass(frozen=True, slots=True)
class Definition:
    """One message type: how its payload is laid out and how its CRC is seeded."""

    id: int
    name: str
    crc_extra: int
    seed: bytes  # crc_extra as the byte that ends what the CRC is taken over
    layout: struct.Struct
    fields: tuple[str, ...]  # in the order of the wire
    types: tuple[str, ...]  # "uint32_t", "char", ..., in the same order
    counts: tuple[int, ...]  # 0: a scalar, else an array of so many (a char array is one text)
    starts: tuple[int, ...]  # where the field begins in the unpacked tuple
    units: Mapping[str, str]  # wire units as MAVLink writes them: "cm/s", "degE7"
    scalar: bool  # has it neither texts nor arrays?

    def unpack(self, payload: bytes) -> tuple[int | float | bytes, ...]:
        """Payload -> flat tuple.  MAVLink 2 cuts trailing zeros, newer definitions append fields: both are read."""
        size = self.layout.size
        if len(payload) < size:
            payload = payload + bytes(size - len(payload))
        elif len(payload) > size:
            payload = payload[:size]
        return self.layout.unpack(payload)


@cache
def definition(message_id: int) -> Definition | None:
    """The definition of a message id, None if pymavlink's `all` dialect does not know it."""
    message = messages.mavlink_map.get(message_id)
    if message is None:
        return None
    types = dict(zip(message.fieldnames, message.fieldtypes, strict=True))
    starts, position = [], 0
    counts = []
    for name, count in zip(message.ordered_fieldnames, message.array_lengths, strict=True):
        text = types[name] == "char"
        starts.append(position)
        counts.append(count)
        position += 1 if text or count == 0 else count
    return Definition(
        message.id,
        message.msgname,
        message.crc_extra,
        bytes((message.crc_extra,)),
        message.unpacker,
        tuple(message.ordered_fieldnames),
        tuple(types[name] for name in message.ordered_fieldnames),
        tuple(counts),
        tuple(starts),
        dict(message.fieldunits_by_name),
        not any(counts) and "char" not in types.values(),
    )


def name_of(message_id: int) -> str:
    """The name of a message id, UNKNOWN_<id> where the dialect does not know it."""
    message = definition(message_id)
    return message.name if message is not None else f"UNKNOWN_{message_id}"


# Messages of MAVLink's common.xml (2026) that pymavlink's `all` dialect lacks, as PX4 sends them: id -> (name, CRC_EXTRA).
# Enough to check a frame and to say what it is; their fields are not read.
ELSEWHERE: Final[Mapping[int, tuple[str, int]]] = MappingProxyType(
    {
        80: ("COMMAND_CANCEL", 14),
        290: ("ESC_INFO", 251),
        291: ("ESC_STATUS", 10),
        300: ("PROTOCOL_VERSION", 217),
        371: ("FUEL_STATUS", 10),
        372: ("BATTERY_INFO", 26),
        380: ("TIME_ESTIMATE_TO_TARGET", 232),
        395: ("COMPONENT_INFORMATION", 0),
        396: ("COMPONENT_INFORMATION_BASIC", 50),
        397: ("COMPONENT_METADATA", 182),
        410: ("EVENT", 160),
        411: ("CURRENT_EVENT_SEQUENCE", 106),
        412: ("REQUEST_EVENT", 33),
        413: ("RESPONSE_EVENT_ERROR", 77),
    }
)


def recognised(raw: bytes, message_id: int) -> str | None:
    """The name of a frame that the dialect does not know, if its CRC fits a definition of ELSEWHERE."""
    found = ELSEWHERE.get(message_id)
    if found is None:
        return None
    name, extra = found
    end = HEADER_BYTES[raw[0]] + raw[1]
    fits = mcrf4xx(raw[1:end] + bytes((extra,))) == raw[end] | raw[end + 1] << 8
    return name if fits else None


def known_ids() -> dict[int, int]:
    """CRC_EXTRA of every message id of the dialect."""
    return {message_id: message.crc_extra for message_id, message in messages.mavlink_map.items()}


@cache
def by_name(name: str) -> Definition:
    """The definition of a message name.  Raises KeyError for a name that the dialect does not have."""
    for message_id, message in messages.mavlink_map.items():
        if message.msgname == name:
            found = definition(message_id)
            assert found is not None  # it came from the same map
            return found
    raise KeyError(name)


def encode(name: str, fields: Fields, *, sysid: int, compid: int, seq: int) -> bytes:
    """One MAVLink 2 frame, unsigned.  Fields left out are zero.  Raises KeyError for an unknown message or field."""
    message = by_name(name)
    if unknown := set(fields) - set(message.fields):
        raise KeyError(f"{name} has no field {', '.join(sorted(unknown))}")
    values: list[int | float | bytes] = []
    for field, kind, count in zip(message.fields, message.types, message.counts, strict=True):
        value = fields.get(field, "" if kind == "char" else (0,) * count if count else 0)
        if isinstance(value, str):
            values.append(value.encode() or b"\0")  # a single character is never none
        elif isinstance(value, tuple):
            values.extend(value + (0,) * (count - len(value)))
        else:
            values.append(value)
    payload = message.layout.pack(*values).rstrip(b"\0") or b"\0"  # never empty: the protocol keeps the first byte
    head = struct.pack("<BBBBBBHB", len(payload), 0, 0, seq & 0xFF, sysid, compid, message.id & 0xFFFF, message.id >> 16)
    crc = mcrf4xx(head + payload + message.seed)
    return bytes((MAGIC_V2,)) + head + payload + struct.pack("<H", crc)


def decode_fields(message: Definition, payload: bytes) -> dict[str, Value]:
    """All fields by name; char arrays as text up to their first NUL, other arrays as tuples."""
    flat = message.unpack(payload)
    if message.scalar:
        return dict(zip(message.fields, flat, strict=True))  # type: ignore[arg-type]  # no texts among them
    out: dict[str, Value] = {}
    for name, count, start in zip(message.fields, message.counts, message.starts, strict=True):
        value = flat[start]
        if isinstance(value, bytes):
            out[name] = value.partition(b"\0")[0].decode("utf-8", "replace")
        else:
            out[name] = value if count == 0 else flat[start : start + count]  # type: ignore[assignment]  # numbers all
    return out
