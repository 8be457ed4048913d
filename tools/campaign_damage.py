"""Damage logs on purpose and count what readers lose and what they wrongly accept.

Clean logs of MAVLink 1, 2, mixed and signed frames are made from our own simulator's flight; then 1 % of the frames are hit
by each kind of damage: flipped payload, length or magic bytes, frames cut at head or tail, rubbish between records, rubbish
rich in 0xFD and 0xFE, rubbish stamps.  The truth is known: which frames are untouched, byte for byte.  mavfdi reads by both
of its readers, pymavlink by `mavutil`, fasttlogparser by counts (it gives no frames: a loss and a false frame of one type
would cancel).

    python tools/campaign_damage.py --frames 60000 --seed 910000000 --yardstick PYTHON_WITH_FASTTLOGPARSER

Exit code 1 if mavfdi loses or wrongly accepts a frame.
"""

import argparse
import hashlib
import os
import random
import struct
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from companion import columns
from companion.dialect import SIGNATURE_BYTES, definition
from companion.frames import Check, IncompleteError, candidate
from companion.tlog import Reader

STAMP_US = 1_767_225_600_000_000
HIT = 0.01
PARSER = """
import json, sys, fasttlogparser
found, _ = fasttlogparser.parseTLog(sys.argv[1])
print(json.dumps({name: len(next(iter(fields.values()))) for name, fields in found.items()}))
"""


def flight(frames: int) -> list[bytes]:
    """MAVLink 2 frames of a simulated flight, repeated up to the number asked for."""
    from companion.airframe import load
    from companion.decision import Policy
    from companion.rehearsal import Rehearsal
    from sitl.autopilot import Autopilot

    airframe = load("parafoil")
    simulator = airframe.load_simulator()
    fleet = simulator.Fleet(airframe.simulator_config(simulator), [1], None)
    rehearsal = Rehearsal(airframe, Autopilot(simulator.VEHICLE, fleet), Policy.OFF, keep_log=True)
    rehearsal.fly(min(600.0, 10.0 + frames / 90.0))
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "flight.tlog"
        path.write_bytes(bytes(rehearsal.log))
        raws = [record.frame.raw for record in Reader(path)]
    return [raws[place % len(raws)] for place in range(frames)]


def as_version_1(raw: bytes) -> bytes:
    """The same message as MAVLink 1, where its id and its payload allow it; else unchanged."""
    from fastcrc.crc16 import mcrf4xx

    message_id = raw[7] | raw[8] << 8 | raw[9] << 16
    message = definition(message_id)
    if message_id > 255 or message is None:
        return raw
    payload = raw[10 : 10 + raw[1]].ljust(min(255, message.layout.size), b"\0")
    head = bytes((len(payload), raw[4], raw[5], raw[6], message_id))
    crc = mcrf4xx(head + payload + bytes((message.crc_extra,)))
    return b"\xfe" + head + payload + struct.pack("<H", crc)


def as_signed(raw: bytes, number: int) -> bytes:
    """The same frame with a signature (of a key that nobody has: readers do not check it)."""
    from fastcrc.crc16 import mcrf4xx

    message = definition(raw[7] | raw[8] << 8 | raw[9] << 16)
    if raw[0] != 0xFD or message is None:
        return raw
    body = bytearray(raw[:-2])
    body[2] |= 1
    crc = struct.pack("<H", mcrf4xx(bytes(body[1:]) + bytes((message.crc_extra,))))
    return bytes(body) + crc + b"\x01" + hashlib.sha256(struct.pack("<Q", number) + raw).digest()[: SIGNATURE_BYTES - 1]


KINDS: dict[str, Callable[[bytes, int], bytes]] = {
    "v1": lambda raw, _: as_version_1(raw),
    "v2": lambda raw, _: raw,
    "mixed": lambda raw, number: as_version_1(raw) if number * 7 % 10 < 5 else raw,
    "signed": as_signed,
}
DAMAGES = ("payload", "length", "magic", "head", "tail", "rubbish", "rich", "stamp")


@dataclass(slots=True)
class Damaged:
    """A log and the frames in it that are whole."""

    data: bytes
    good: list[bytes]


def flip(raw: bytes, place: int, rng: random.Random) -> bytes:
    return raw[:place] + bytes((raw[place] ^ rng.randrange(1, 256),)) + raw[place + 1 :]


def damage(raws: list[bytes], kind: str, rng: random.Random) -> Damaged:
    out, good = bytearray(), []
    for number, raw in enumerate(raws):
        stamp = struct.pack(">Q", STAMP_US + 2000 * number)
        if rng.random() >= HIT:
            out += stamp + raw
            good.append(raw)
            continue
        header = 6 if raw[0] == 0xFE else 10
        match kind:
            case "payload":
                out += stamp + flip(raw, header + rng.randrange(max(1, raw[1])), rng)
            case "length":
                out += stamp + flip(raw, 1, rng)
            case "magic":
                out += stamp + flip(raw, 0, rng)
            case "head":
                out += stamp + raw[rng.randrange(1, len(raw) - 2) :]
            case "tail":  # without its CRC: cut behind it, or with one byte left of it, it may be whole by chance
                out += stamp + raw[: rng.randrange(1, header + raw[1])]
            case "rubbish" | "rich":
                count = rng.randrange(1, 300)
                rich = kind == "rich"
                out += bytes(
                    rng.choice((0xFD, 0xFE)) if rich and rng.random() < 0.6 else rng.randrange(256) for _ in range(count)
                )
                out += stamp + raw
                good.append(raw)
            case _:
                out += struct.pack(">Q", rng.getrandbits(64)) + raw
                good.append(raw)
    return Damaged(bytes(out), good)


def accidental(found: Damaged, kept: Counter[bytes]) -> int:
    """Of the frames accepted beyond the good ones, those that a right CRC makes indistinguishable from a frame."""
    extra = kept - Counter(found.good)
    count = 0
    for raw, times in extra.items():
        try:
            looked = candidate(raw, 0)
        except IncompleteError:
            continue
        count += times if looked is not None and looked[1] is Check.GOOD else 0
    return count


def by_pymavlink(path: Path) -> Counter[bytes]:
    os.environ["MAVLINK20"] = "1"
    os.environ["MAVLINK_DIALECT"] = "all"
    from pymavlink import mavutil

    log = mavutil.mavlink_connection(str(path), robust_parsing=True, dialect="all")
    kept: Counter[bytes] = Counter()
    while (message := log.recv_msg()) is not None:
        if message.get_type() != "BAD_DATA":
            kept[bytes(message.get_msgbuf())] += 1
    log.close()
    return kept


def by_parser(path: Path, python: str, good: list[bytes]) -> str:
    """Lost by counts of message types."""
    done = subprocess.run([python, "-c", PARSER, str(path)], capture_output=True, text=True, check=False)
    if done.returncode:
        return "-"
    import json

    counts = json.loads(done.stdout.splitlines()[-1])
    lost = 0
    for message_id, count in Counter(_message_id(raw) for raw in good).items():
        message = definition(message_id)
        lost += max(0, count - counts.get(message.name if message else "", 0))
    return str(lost)


def _message_id(raw: bytes) -> int:
    return raw[5] if raw[0] == 0xFE else raw[7] | raw[8] << 8 | raw[9] << 16


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else "")
    parser.add_argument("--frames", type=int, default=60_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--yardstick", help="Python that has fasttlogparser")
    parser.add_argument("--no-pymavlink", action="store_true", help="leave out the slow one")
    args = parser.parse_args()
    plain = flight(args.frames)
    failed = 0
    print(f"{args.frames} frames a log, {HIT:.0%} hit; lost / wrongly accepted")
    print(f"{'log':8}{'damage':10}{'good':>8}  {'mavfdi':>12}{'plain reader':>14}{'pymavlink':>12}{'fasttlogparser':>16}")
    for place, (version, make) in enumerate(KINDS.items()):
        rng = random.Random(args.seed + 1000 * place)
        raws = [make(raw, number) for number, raw in enumerate(plain)]
        for kind in DAMAGES:
            found = damage(raws, kind, rng)
            with tempfile.TemporaryDirectory() as scratch:
                path = Path(scratch) / "damaged.tlog"
                path.write_bytes(found.data)
                compiled = Counter(record.frame.raw for record in columns.read(path).records())
                slow = Counter(record.frame.raw for record in Reader(path))
                cells = []
                for kept in (compiled, slow):
                    lost = sum((Counter(found.good) - kept).values())
                    extra = sum((kept - Counter(found.good)).values())
                    chance = accidental(found, kept)
                    failed += lost + extra - chance
                    cells.append(f"{lost} / {extra - chance}" + (f" (+{chance})" if chance else ""))
                if args.no_pymavlink:
                    cells.append("-")
                else:
                    kept = by_pymavlink(path)
                    lost = sum((Counter(found.good) - kept).values())
                    cells.append(f"{lost} / {sum((kept - Counter(found.good)).values())}")
                cells.append(by_parser(path, args.yardstick, found.good) if args.yardstick else "-")
            print(
                f"{version:8}{kind:10}{len(found.good):8}  {cells[0]:>12}{cells[1]:>14}{cells[2]:>12}{cells[3]:>16}",
                flush=True,
            )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
