"""What the pure half asks of the world: messages to send, a record to keep, a person to tell.  In their order."""

from dataclasses import dataclass

from companion.align import GridRow
from companion.dialect import Fields
from companion.events import Event
from fdi.verdict import Verdict


@dataclass(frozen=True, slots=True)
class Send:
    """One message to the vehicle and whoever else listens."""

    message: str
    fields: Fields


@dataclass(frozen=True, slots=True)
class Save:
    """Keep this text safe on disk before anything behind it is done; empty: there is nothing to keep any more."""

    record: str


@dataclass(frozen=True, slots=True)
class Tell:
    """One event for the files and the views; `spoken`: say it on STATUSTEXT too, in these words."""

    event: Event
    spoken: str = ""


@dataclass(frozen=True, slots=True)
class Judged:
    """One row of the grid has been judged: for live views, pictures and summaries."""

    row: GridRow
    verdict: Verdict


Effect = Send | Save | Tell | Judged
