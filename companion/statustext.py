"""What is said to people on STATUSTEXT: cut into chunks of 50 bytes, and rationed.

Pure.  A text is said at once if it is new, a standing one is repeated rarely, and a burst of texts is spread out.
"""

from dataclasses import dataclass, field
from typing import Final

from companion.dialect import Fields
from companion.events import SEVERITY_MAVLINK, Severity

CHUNK_BYTES: Final = 50
PREFIX: Final = "mavfdi: "  # a ground station shows texts of every component alike: say who speaks
BURST: Final = 5  # texts that may go out at once
REFILL_US: Final = 1_000_000  # and one more each second
QUEUE: Final = 20  # texts that wait; what comes on top is counted, not kept, the least severe first


def chunks(text: str, severity: Severity, text_id: int) -> list[Fields]:
    """STATUSTEXT fields for a text of any length (MAVLink 2 chunking); text_id is used only if one is not enough.

    No character is cut in two.  A NUL in a chunk ends the text, as the message's definition has it: so a chunk that a
    longer character leaves short is filled with spaces, and a last one that is exactly full is followed by an empty one.
    """
    level = SEVERITY_MAVLINK[severity]
    whole = text.encode()
    if len(whole) <= CHUNK_BYTES:
        return [{"severity": level, "text": text}]
    pieces: list[str] = []
    while whole:
        cut = whole[:CHUNK_BYTES].decode("utf-8", "ignore")
        taken = len(cut.encode())
        whole = whole[taken:]
        pieces.append(cut + " " * (CHUNK_BYTES - taken) if whole else cut)
    if len(pieces[-1].encode()) == CHUNK_BYTES:
        pieces.append("")
    return [{"severity": level, "text": piece, "id": text_id, "chunk_seq": place} for place, piece in enumerate(pieces)]


@dataclass(slots=True)
class Speaker:
    """Says texts at a bounded rate.  `dropped` counts those that could not even wait."""

    dropped: int = 0
    _credit: int = BURST
    _refilled_us: int = 0
    _next_id: int = 1
    _waiting: list[tuple[int, int, Severity, str]] = field(default_factory=list)  # level, order, severity, text
    _order: int = 0

    def say(self, text: str, severity: Severity, now_us: int) -> list[Fields]:
        """-> STATUSTEXT messages to send now; what has to wait comes out of `tick`, the most severe first."""
        self._order += 1
        self._waiting.append((SEVERITY_MAVLINK[severity], self._order, severity, PREFIX + text))
        self._waiting.sort()
        out = self.tick(now_us)
        self.dropped += len(self._waiting[QUEUE:])
        del self._waiting[QUEUE:]
        return out

    def tick(self, now_us: int) -> list[Fields]:
        if not self._waiting:
            return []  # the credit is made up for when it is needed
        refill = (now_us - self._refilled_us) // REFILL_US
        if refill > 0:
            self._credit = min(BURST, self._credit + refill)
            self._refilled_us += refill * REFILL_US
        out: list[Fields] = []
        while self._waiting and self._credit > 0:
            self._credit -= 1
            _, _, severity, text = self._waiting.pop(0)
            out += chunks(text, severity, self._next_id)
            self._next_id = self._next_id % 0xFFFF + 1
        return out
