"""Loaded by the workers of a test's Dask cluster: they compute nothing but the number of a unit, and go wrong as a file
says, whose path is in the environment.

The file holds JSON: ``deadly``, units that kill whoever is about to write them; ``blind``, names of workers that do not
see the capture; ``slow``: seconds that a unit takes.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from leafflow_ti.errors import InputError
from leafflow_ti.executors import cluster_worker
from leafflow_ti.results import ResultStore
from leafflow_ti.worker import Job

VARIABLE = "LEAFFLOW_TI_TEST_FAULTS"
_name: Any = None


def faults(kind: str, default: Any) -> Any:
    path = Path(os.environ.get(VARIABLE, "none"))
    return json.loads(path.read_text()).get(kind, default) if path.exists() else default


class FakeWorker:
    """Stands where ``worker.Worker`` does."""

    device = "nothing"

    def __init__(self) -> None:
        self._written = 0

    @property
    def seconds(self) -> dict[str, float]:
        return {"compile": 1.0, "write": float(self._written)}

    @classmethod
    def of(cls, job: Job) -> FakeWorker:
        if _name in faults("blind", []):
            raise InputError(f"{job.capture}: no such file")
        if faults("deadly", []):
            time.sleep(1.0)  # Dask does not restart a worker that dies while it is still being registered
        return cls()

    def warm_up(self) -> float:
        return 1.0

    def open(self, out: str) -> ResultStore:
        return ResultStore.open(out)

    def compute(self, store: ResultStore, units: list[int], done: Callable[[int], None]) -> None:
        for unit in units:
            time.sleep(faults("slow", 0.0))
            if unit in faults("deadly", []):
                os.kill(os.getpid(), signal.SIGKILL)
            write(store, unit)
            self._written += 1
            done(unit)


def write(store: ResultStore, unit: int) -> None:
    """Every map holds the number of the unit."""
    frame, band = divmod(unit, store.bands)
    rows = slice(band * store.unit_rows, min((band + 1) * store.unit_rows, store.y.size))
    values = np.full((rows.stop - rows.start, store.x.size), unit, np.float32)
    store.write_unit(unit, frame, rows, dict.fromkeys(store.names, values), np.zeros(values.shape, np.uint8))


def dask_setup(worker: Any) -> None:
    """Called by Dask as a worker starts."""
    global _name
    _name = worker.name
    cluster_worker.Worker = FakeWorker  # type: ignore[assignment, misc]
