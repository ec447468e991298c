"""One batch after the other, in this process."""

from __future__ import annotations

import time
from functools import partial
from types import TracebackType
from typing import Self

from leafflow_ti.capture import Capture
from leafflow_ti.executors import PAUSE_S, Executor
from leafflow_ti.plan import Plan
from leafflow_ti.results import ResultStore
from leafflow_ti.schedule import Batch, Failure, Schedule
from leafflow_ti.worker import Worker


class Serial(Executor):
    """Computes in this process; kernels are compiled as the context begins."""

    label = "1 process"

    def __init__(self, plan: Plan, capture: Capture) -> None:
        self._run = plan, capture
        self._worker: Worker | None = None
        self._seconds: dict[str, float] = {}

    def __enter__(self) -> Self:
        self._worker = Worker(*self._run)
        self.device = str(self._worker.device)
        self.compile_seconds = self._worker.warm_up()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._seconds, self._worker = self.seconds, None  # and with it the memory of its arrays

    @property
    def seconds(self) -> dict[str, float]:
        """See ``Executor``."""
        return self._worker.seconds if self._worker else self._seconds

    def work(self, schedule: Schedule, store: ResultStore) -> None:
        """See ``Executor``."""
        while (batch := schedule.take()) is not None:
            failure = self._compute(schedule, store, batch)
            if failure is None:
                schedule.ended(batch)
            elif schedule.failed(batch, failure):
                time.sleep(PAUSE_S)

    def _compute(self, schedule: Schedule, store: ResultStore, batch: Batch) -> Failure | None:
        assert self._worker is not None, "work is done inside the context"
        try:
            self._worker.compute(store, batch.units, partial(schedule.unit_done, batch))
        except Exception as error:
            return Failure.of(error)
        return None
