"""What MAVLink's field types leave of a channel: the rounding of the wire, without the wire.

For ensembles that fly without an autopilot but want to see what a companion would see.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as dialect

from sitl.vehicle import Field, Stream

INTEGER_TYPES = {"int8_t", "uint8_t", "int16_t", "uint16_t", "int32_t", "uint32_t", "int64_t", "uint64_t"}


@dataclass(frozen=True, slots=True)
class _Carrier:
    """How one channel travels."""

    column: int
    scale: float
    offset: float
    type: str  # MAVLink's: "int16_t", "float", "double"


def field_type(message: str, name: str) -> str:
    """MAVLink's type of a message's field ("distance[0]": that of the array's elements).  Raises KeyError if unknown."""
    kinds = {kind.msgname: kind for kind in dialect.mavlink_map.values()}
    kind = kinds[message]
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    return str(types[name.partition("[")[0]])


def _carriers(streams: Sequence[Stream], channels: Sequence[str]) -> tuple[_Carrier, ...]:
    first: dict[str, tuple[str, Field]] = {}
    for stream in streams:
        for each in stream.fields:
            first.setdefault(each.channel, (stream.message, each))
    return tuple(
        _Carrier(column, each.scale, each.offset, field_type(message, each.name))
        for column, channel in enumerate(channels)
        if channel in first
        for message, each in (first[channel],)
    )


def quantiser(streams: Sequence[Stream], channels: Sequence[str]) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """A function that rounds (..., channel) values, SI, as the wire does; it returns a new array of the same shape.

    A channel that travels in several messages is rounded as in the first of `streams` that carries it; one that does
    not travel is left as it is.  Integer fields round to the nearest count and stop at the ends of their type, floats
    pass through 32 bits, doubles stay.  NaN stays NaN.  The function raises ValueError if the last axis is not
    len(channels) long.  Source: MAVLink's common and ardupilotmega definitions, as pymavlink holds them.
    """
    carriers = _carriers(streams, channels)

    def quantise(values: NDArray[np.float64]) -> NDArray[np.float64]:
        if values.shape[-1] != len(channels):
            raise ValueError(f"values has shape {values.shape}, its last axis must hold {len(channels)} channels")
        rounded = np.array(values, dtype=np.float64)
        for carrier in carriers:
            wire = rounded[..., carrier.column] * carrier.scale + carrier.offset
            if carrier.type in INTEGER_TYPES:
                ends = np.iinfo(carrier.type.removesuffix("_t"))
                wire = np.clip(np.rint(wire), float(ends.min), float(ends.max))
            elif carrier.type == "float":
                wire = wire.astype(np.float32).astype(np.float64)
            rounded[..., carrier.column] = (wire - carrier.offset) / carrier.scale
        return rounded

    return quantise
