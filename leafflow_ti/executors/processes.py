"""Several batches at a time, each in a process of its own on this machine."""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

from leafflow_ti.capture import Capture
from leafflow_ti.errors import RunError
from leafflow_ti.events import event, warn
from leafflow_ti.executors import Executor
from leafflow_ti.executors.child import Child, Message
from leafflow_ti.plan import Plan
from leafflow_ti.progress import add_seconds
from leafflow_ti.results import ResultStore
from leafflow_ti.schedule import Batch, Failure, Schedule
from leafflow_ti.worker import Job

STARTS = 3
"""How often a worker that does not come to work is started."""
DEATHS = 10
"""How many workers may die at their work before one unit of the whole run is done."""
CLOSING_S = 2.0
"""How long workers may take to end when the work is done: compiled kernels are kept then."""
KILLING_S = 1.0
"""How long the system may take to end those that are killed."""
LISTENING_S = 0.5
"""Between two looks whether this process is interrupted, where the system does not wake it up for that."""


@dataclass(frozen=True)
class _Task:
    """A batch that a worker computes."""

    batch: Batch
    schedule: Schedule
    store: ResultStore

    def lost(self, reason: str) -> int:
        """Its worker is gone, perhaps before it could say what it had done. Returns the units done in the store."""
        done = self.store.done()
        for unit in self.batch.units:
            if unit in done:
                self.schedule.unit_done(self.batch, unit)
        self.schedule.lost(self.batch, f"its worker died ({reason})")
        return len(done)


@dataclass(eq=False)
class _Seat:
    """The place of one worker. ``starts``: how often it was filled since its worker was last ready."""

    number: int
    environment: dict[str, str]
    child: Child | None = None
    starts: int = 0
    ready: bool = False
    device: str = ""
    failure: Failure | None = None
    """Why it could not begin."""
    task: _Task | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    """Per stage, of the worker that sits here."""


class Processes(Executor):
    """Computes in ``workers`` processes that are started as the context begins; one that dies is replaced.

    Each has its share of the machine's threads and memory, as the plan's configuration has it, and where there are
    GPUs, one of them. ``command``: of a worker, instead of the usual one. Raises ConfigError for images in memory.
    """

    def __init__(
        self, plan: Plan, capture: Capture, out: Path, workers: int, command: Sequence[str] | None = None
    ) -> None:
        self._job = Job.of(plan, capture, out).to_json()
        self._command = {} if command is None else {"command": command}
        self._inbox: queue.SimpleQueue[tuple[Child, Message]] = queue.SimpleQueue()
        gpus = visible_gpus() if plan.config.arch in ("auto", "cuda") else []
        shares = [{"CUDA_VISIBLE_DEVICES": gpus[i % len(gpus)]} if gpus else {} for i in range(workers)]
        self._seats = [_Seat(i, share) for i, share in enumerate(shares)]
        self._earlier: dict[str, float] = {}
        self._deaths = 0
        self.workers, self.label = workers, f"{workers} processes"

    def __enter__(self) -> Self:
        try:
            for seat in self._seats:
                self._fill(seat)
            self.wait_for(1)
        except BaseException:
            self._end(Child.kill, KILLING_S)
            raise
        return self

    def wait_for(self, workers: int) -> None:
        """Wait until so many are ready, or all that can be; raises what they say where that is none of them."""
        while sum(seat.ready for seat in self._seats) < min(
            workers, sum(seat.child is not None for seat in self._seats)
        ):
            self._listen()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        if kind is None:
            self._end(Child.close, CLOSING_S)
        self._end(Child.kill, KILLING_S)

    def _end(self, how: Callable[[Child], None], seconds: float) -> None:
        """End all workers, and wait for that at most so long."""
        children, end = [seat.child for seat in self._seats if seat.child], time.monotonic() + seconds
        for child in children:
            how(child)
        for child in children:
            child.wait(end)

    @property
    def seconds(self) -> dict[str, float]:
        """See ``Executor``."""
        total = dict(self._earlier)
        for seat in self._seats:
            add_seconds(total, seat.seconds)
        return total

    def work(self, schedule: Schedule, store: ResultStore) -> None:
        """See ``Executor``; RunError where workers die and die, and nothing at all is computed."""
        while not schedule.over:
            for seat in self._seats:
                if seat.child and seat.ready and seat.task is None and (batch := schedule.take()):
                    seat.task = _Task(batch, schedule, store)
                    seat.child.give(batch.units)
            self._listen()

    def _listen(self) -> None:
        """Wait for one message, and do what it calls for."""
        with contextlib.suppress(queue.Empty):
            child, message = self._inbox.get(timeout=LISTENING_S)
            seat = next((seat for seat in self._seats if seat.child is child), None)
            if seat is not None:  # else it was given up
                self._heard(seat, message)

    def _heard(self, seat: _Seat, message: Message) -> None:
        seat.seconds = message.get("seconds", seat.seconds)
        kind = message["kind"]
        if kind == "ready":
            self._is_ready(seat, message["device"])
        elif kind == "warning":
            warn(message["message"], **message["facts"])
        elif kind == "failed" and not seat.ready:
            seat.failure = Failure(message["message"], message["exit_code"])
        elif kind == "gone":
            self._is_gone(seat, message["reason"])
        elif seat.task is not None:
            task = seat.task
            if kind == "unit":
                task.schedule.unit_done(task.batch, message["unit"])
                return
            seat.task = None
            if kind == "ended":
                task.schedule.ended(task.batch)
            elif kind == "failed":
                task.schedule.failed(task.batch, Failure(message["message"], message["exit_code"]))

    def _is_ready(self, seat: _Seat, device: str) -> None:
        seat.ready, seat.device, seat.starts = True, device, 0
        if not self.device:
            self.device = f"{self.workers} x {device}"
            self.compile_seconds = seat.seconds.get("compile", 0.0)
        event("worker", f"worker {seat.number + 1} is ready: {device}", worker=seat.number + 1, device=device)

    def _is_gone(self, seat: _Seat, reason: str) -> None:
        event("worker_lost", f"worker {seat.number + 1} is lost: {reason}", logging.ERROR, worker=seat.number + 1,
              reason=reason)  # fmt: skip
        assert seat.child is not None
        seat.child.close()
        if seat.task is not None:
            task, seat.task = seat.task, None
            self._deaths += 1
            if task.lost(reason) == 0 and self._deaths >= DEATHS:
                raise RunError(
                    f"{self._deaths} workers have died before anything was computed, the last of them by {reason}: try "
                    "fewer of them, or more memory"
                )
        if not seat.ready and (seat.starts >= STARTS or (seat.failure and seat.failure.ends_all)):
            died = f"a worker was started {seat.starts} times, and died before it could begin ({reason})"
            self._go_without(seat, seat.failure or Failure(died))
        else:
            self._fill(seat)

    def _fill(self, seat: _Seat) -> None:
        """Start a worker."""
        add_seconds(self._earlier, seat.seconds)
        seat.seconds, seat.ready, seat.failure, seat.starts = {}, False, None, seat.starts + 1
        try:
            seat.child = Child(self._inbox, self._job, seat.environment, **self._command)
        except OSError as error:
            self._go_without(seat, Failure(f"a worker cannot be started ({error.strerror}): use fewer of them"))

    def _go_without(self, seat: _Seat, failure: Failure) -> None:
        """Give up this worker; raises why, if it was the last one."""
        seat.child = None
        if not any(other.child for other in self._seats):
            raise failure.error()
        warn(f"the run goes on without worker {seat.number + 1}: {failure.message}", worker=seat.number + 1)


def visible_gpus() -> list[str]:
    """Numbers or names of the CUDA devices that this process may use; none where that is unknown."""
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        return [name.strip() for name in chosen.split(",") if name.strip()]
    program = shutil.which("nvidia-smi")
    if program is None:
        return []
    with contextlib.suppress(OSError, subprocess.TimeoutExpired):
        found = subprocess.run([program, "-L"], capture_output=True, text=True, timeout=20, check=False)
        lines = found.stdout.splitlines() if found.returncode == 0 else []
        return [str(i) for i, _ in enumerate(line for line in lines if line.startswith("GPU "))]
    return []
