"""Who flies the batches: processes of this machine, or the workers of a cluster; the rows are the same."""

import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Sequence
from concurrent import futures
from dataclasses import dataclass, field
from importlib.metadata import version
from multiprocessing.process import BaseProcess
from typing import Any, Final

from companion.airframe import Airframe
from companion.campaign.flight import Batch, fly
from companion.campaign.rows import Columns
from companion.campaign.settings import Settings
from companion.errors import UserError

BATCH: Final = 500  # flights side by side: from here on Python's share is small, and a lost batch costs seconds
TICK_S: Final = 0.5  # between two looks at batches that are still flying

Flown = Generator[Columns | None]  # the rows of each batch that is down; None: still flying


def batches(airframe: Airframe, wanted: Settings, missing: Sequence[range], workers: int) -> list[Batch]:
    """What is to be flown, in batches that keep all workers busy to the end."""
    left = sum(len(run) for run in missing)
    rounds = math.ceil(left / (BATCH * workers))
    size = max(1, math.ceil(left / max(1, rounds * workers)))
    return [
        Batch(airframe, first, min(size, run.stop - first), wanted.faults, wanted.duration_s, wanted.link)
        for run in missing
        for first in range(run.start, run.stop, size)
    ]


def flown_here(work: Sequence[Batch], jobs: int) -> Flown:
    """The rows of each batch as it comes down, from so many processes; None every TICK_S while all are in the air.

    With one job, or one batch, everything is flown in this process.  Closed early, or left by an exception, it stops what
    is still flying.  Raises UserError if a process was killed.
    """
    if min(jobs, len(work)) <= 1:
        yield from map(fly, work)
        return
    before = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    pool = futures.ProcessPoolExecutor(min(jobs, len(work)), context, _attend_parent)
    try:
        pending = {pool.submit(fly, batch) for batch in work}
        while pending:
            done, pending = futures.wait(pending, TICK_S, futures.FIRST_COMPLETED)
            yield from (each.result() for each in done)
            if not done:
                yield None
        pool.shutdown()
    except futures.process.BrokenProcessPool:
        raise UserError("a process of the campaign was killed, perhaps for want of memory; give fewer --jobs") from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - before:
            child.terminate()


def _attend_parent() -> None:
    """In a process of the campaign: leave stopping to the parent, and do not outlive it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None  # it was started by one
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


@dataclass(slots=True)
class Cluster:
    """The workers behind a scheduler of dask.distributed."""

    address: str
    workers: int = field(init=False)  # batches that fly at the same time
    _client: Any = field(init=False)

    def __post_init__(self) -> None:
        """Raises UserError if nobody answers there, nobody works there, or with another version than ours."""
        try:
            from distributed import Client
        except ModuleNotFoundError:
            raise UserError("a cluster needs dask.distributed; install it with: pip install 'mavfdi[cluster]'") from None
        try:
            connect: Callable[..., Any] = Client  # untyped
            self._client = connect(self.address, timeout=10, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise UserError(f"--cluster {self.address}: no scheduler answers: {error}") from None
        try:
            self.workers = sum(self._client.nthreads().values())
            if not self.workers:
                raise UserError(f"--cluster {self.address}: the scheduler has no workers; start some: dask worker ADDRESS")
            for worker, found in self._client.run(version, "mavfdi", on_error="return").items():
                if found != version("mavfdi"):
                    raise UserError(f"--cluster: {worker} has mavfdi {found}, here is {version('mavfdi')}; install the same")
        except UserError:
            self.close()
            raise

    def flown(self, work: Sequence[Batch]) -> Flown:
        """As `flown_here`; a batch whose worker is lost is flown by another."""
        pending = self._client.map(fly, work, pure=False)
        while pending:
            done = [each for each in pending if each.done()]
            pending = [each for each in pending if each not in done]
            yield from (each.result() for each in done)
            if not done:
                time.sleep(TICK_S)
                yield None

    def close(self) -> None:
        self._client.close()
