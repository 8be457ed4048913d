"""Thousands of simulated flights through an airframe's monitor: one row a flight, kept as Parquet, resumable.

A batch of flights is flown and judged in one process (`fly`); batches run side by side here or on a cluster.  Who runs
them hands the rows to `Store`.  A row depends on its seed and the settings alone.
"""

from companion.campaign.crew import Cluster, Flown, batches, flown_here
from companion.campaign.flight import Batch, Rehearsed, fly, grid, listener, prepare, rehearse
from companion.campaign.rows import Columns, Score, column_names, table
from companion.campaign.settings import Settings, settings, settings_of, with_detector
from companion.campaign.store import FILE_NAME, PARTS_NAME, Store, check_same, kept_settings

__all__ = [
    "FILE_NAME",
    "PARTS_NAME",
    "Batch",
    "Cluster",
    "Columns",
    "Flown",
    "Rehearsed",
    "Score",
    "Settings",
    "Store",
    "batches",
    "check_same",
    "column_names",
    "flown_here",
    "fly",
    "grid",
    "kept_settings",
    "listener",
    "prepare",
    "rehearse",
    "settings",
    "settings_of",
    "table",
    "with_detector",
]
