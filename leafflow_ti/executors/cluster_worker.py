"""What runs inside a process of a Dask cluster: plain values in, plain values out.

Such a process belongs to its user and may have many threads; the engine is started and used on one thread of ours, so
that never two batches are computed at once. What was prepared for a run is kept for its next batch: one at most.
"""

from __future__ import annotations

import os
import secrets
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from threading import Event
from typing import Any

from leafflow_ti.events import warnings_said
from leafflow_ti.executors import PAUSE_S
from leafflow_ti.results import ResultStore
from leafflow_ti.schedule import Failure
from leafflow_ti.worker import Job, Worker

LOOK_S = 0.5
"""Seconds between two looks whether anybody still waits for a batch."""

Order = tuple[str, str]
"""A run: a word that no other run has, and its ``worker.Job`` as JSON."""
Answer = dict[str, Any]
"""JSON values. ``process``: which one answers; ``failure``: message and exit code of what went wrong, if anything;
``seconds`` per stage, since they were last told."""

_process = secrets.token_hex(8)
"""Tells this process from a later one that has its address."""
_engine = ThreadPoolExecutor(1, "leafflow-ti")


@dataclass
class _Prepared:
    """What this process keeps of a run."""

    order: Order
    worker: Worker
    compile_seconds: float
    store: ResultStore | None = None
    told: dict[str, float] = field(default_factory=dict)

    def open(self) -> ResultStore:
        """The results, which must have been made."""
        self.store = self.store or self.worker.open(Job.of_json(self.order[1]).out)
        return self.store

    def untold(self) -> dict[str, float]:
        """Seconds per stage since this was last asked."""
        before, self.told = self.told, self.worker.seconds
        return {stage: seconds - before.get(stage, 0.0) for stage, seconds in self.told.items()}


_kept: _Prepared | None = None


class _Unwanted(BaseException):
    """Nobody waits for the batch any more: no failure of a unit."""


def prepare(order: Order, environment: dict[str, str], store_is_made: bool) -> Answer:
    """Get ready for a run: start the engine, compile the kernels, open the results.

    ``environment``: variables to set before. The answer has ``device``, ``compile_seconds`` and ``sees_store``, or a
    ``failure`` where this process is of no use.
    """
    os.environ.update(environment)
    return _engine.submit(_prepared, order, store_is_made).result()


def compute(order: Order, process: str, units: list[int]) -> Answer:
    """Compute units of a run that ``process`` was prepared for, and write them into its results.

    The answer has ``done``, units that were written; ``warnings`` that were said; ``failure`` of the first unit that is
    not done. It has ``process`` alone where another one has taken the place of the one that was meant. Ends early where
    the task was cancelled, or whoever submitted it is gone.
    """
    if process != _process:
        return {"process": _process}
    cancelled, unwanted = _task_cancelled(), Event()
    batch = _engine.submit(_computed, order, units, unwanted)
    while not wait((batch,), LOOK_S).done:
        if cancelled():
            unwanted.set()
    return batch.result()


def forget(order: Order) -> None:
    """Give back the memory of a run, when what it computes is done; returns at once."""
    _engine.submit(_forget, order)


def _task_cancelled() -> Callable[[], bool]:
    """Tells whether the task that calls this was cancelled since."""
    from distributed import get_worker

    worker = get_worker()
    key, tasks = worker.get_current_task(), worker.state.tasks
    return lambda: key not in tasks or tasks[key].state == "cancelled"


def _answer(work: Callable[[], Answer]) -> Answer:
    try:
        return {"process": _process, **work()}
    except Exception as error:
        failure = Failure.of(error)
        return {"process": _process, "failure": [failure.message, failure.exit_code]}


def _prepared(order: Order, store_is_made: bool) -> Answer:
    def work() -> Answer:
        run = _run(order)
        if store_is_made:
            run.open()
        device, sees_store = str(run.worker.device), run.store is not None
        return {"device": device, "compile_seconds": run.compile_seconds, "sees_store": sees_store,
                "seconds": run.untold()}  # fmt: skip

    return _answer(work)


def _run(order: Order) -> _Prepared:
    """What is kept of a run, else made."""
    global _kept
    if _kept is None or _kept.order != order:
        _kept = None  # its memory goes before new memory is taken
        worker = Worker.of(Job.of_json(order[1]))
        _kept = _Prepared(order, worker, worker.warm_up())
    return _kept


def _forget(order: Order) -> None:
    global _kept
    if _kept is not None and _kept.order == order:
        _kept = None


def _computed(order: Order, units: list[int], unwanted: Event) -> Answer:
    done: list[int] = []

    def finished(unit: int) -> None:
        done.append(unit)
        if unwanted.is_set():
            raise _Unwanted

    def work() -> Answer:
        run = _run(order)  # made again where another run came between two batches
        try:
            run.worker.compute(run.open(), units, finished)
        except _Unwanted:
            _forget(order)
        return {}

    with warnings_said() as said:
        answer = _answer(work)
        if "failure" in answer:
            time.sleep(PAUSE_S)
        seconds = _kept.untold() if _kept else {}
        return {**answer, "done": done, "seconds": seconds, "warnings": said}
