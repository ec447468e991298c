"""Where the units of a run are computed: in this process, or elsewhere; each way is one module."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self

from leafflow_ti.results import ResultStore
from leafflow_ti.schedule import Schedule

PAUSE_S = 0.2
"""Before what has failed is tried again: what a network drive needs to come back."""


class Executor(ABC):
    """Computes the batches of a schedule. It is a context: as it begins, its workers start, and their devices with
    them; DeviceError where that is impossible.

    ``workers``: how many batches it computes at a time; ``label``: in words what it is; ``device``: what it computes
    on, known inside; ``compile_seconds``: of the kernels, until the first worker was ready.
    """

    label: str
    workers: int = 1
    device: str = ""
    compile_seconds: float = 0.0

    @property
    @abstractmethod
    def seconds(self) -> dict[str, float]:
        """Per stage, of all workers together, so far."""

    @abstractmethod
    def __enter__(self) -> Self: ...

    @abstractmethod
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None: ...

    @abstractmethod
    def work(self, schedule: Schedule, store: ResultStore) -> None:
        """Compute until the schedule is over, into a store; raises what the schedule raises."""
