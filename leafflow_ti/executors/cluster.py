"""Batches as tasks of a Dask cluster: one started here, one that runs elsewhere, or that of a user's own client.

Dask carries tasks to processes and says which of them are alive. What is tried again, and how often, the schedule alone
decides: a task is bound to one process, so that Dask does not carry one that kills it to the next by itself. Only text
and numbers travel; images and results go through the file system that all processes share.
"""

from __future__ import annotations

import contextlib
import importlib.util
import logging
import secrets
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Event
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from leafflow_ti.capture import Capture
from leafflow_ti.config import RunConfig
from leafflow_ti.errors import ConfigError, MissingExtra, RunError
from leafflow_ti.events import event, warn
from leafflow_ti.executors import Executor
from leafflow_ti.executors.cluster_client import ANSWER_S, LOCAL, connected
from leafflow_ti.executors.cluster_worker import Answer, Order, compute, forget, prepare
from leafflow_ti.executors.processes import DEATHS, STARTS, visible_gpus
from leafflow_ti.plan import Plan
from leafflow_ti.progress import add_seconds
from leafflow_ti.results import ResultStore
from leafflow_ti.schedule import Batch, Failure, Schedule
from leafflow_ti.worker import Job

if TYPE_CHECKING:
    from distributed import Client, Future

_GPU = "CUDA_VISIBLE_DEVICES"
WORKERLESS_S = 60.0
"""Seconds that a cluster may be without workers."""
LOOK_S = 0.5
"""Seconds between two looks who is there and what is done."""


@dataclass(eq=False)
class _Member:
    """A process of the cluster."""

    address: str
    order: Order
    environment: dict[str, str]
    task: Future | None = None
    process: str = ""
    """Which one it is, known when it is prepared."""
    sees_store: bool = False
    batch: Batch | None = None
    n_done: int = 0
    """Units of its batch that are known to be done."""
    refused: Exception | None = None
    """Why it is of no use."""


class Dask(Executor):
    """Computes on a Dask cluster, one batch at a time per process.

    ``where``: "local" for a cluster of ``plan.workers`` processes, which ends with the context; the address of a
    scheduler; or a ``distributed.Client``, which stays open. Raises MissingExtra without the package, ConfigError for
    images in memory; as the context begins, UsageError for what is no address, RunError where nobody answers or no
    worker comes, else what makes all workers useless.
    """

    label = "Dask"

    def __init__(self, plan: Plan, capture: Capture, out: Path, where: str | Client) -> None:
        if importlib.util.find_spec("distributed") is None:
            raise MissingExtra("distributed", "dask", "computing on Dask")
        if where != LOCAL:
            _check_paths(plan.config)
        self._order = partial(_order, secrets.token_hex(8), plan, capture, out)
        self._order(threads=1)  # raises here what makes it impossible
        self._where, self._plan = where, plan.config.plan
        gpus = where == LOCAL and plan.config.arch in ("auto", "cuda")
        self._gpus = visible_gpus() if gpus else []
        self._members: dict[str, _Member] = {}
        self._seconds: dict[str, float] = {}
        self._inside = contextlib.ExitStack()
        self._changed = Event()
        self._stillborn = self._deaths = self._most = 0
        self._alone_since: float | None = None

    @property
    def seconds(self) -> dict[str, float]:
        """See ``Executor``."""
        return self._seconds

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as inside:
            self._client = inside.enter_context(connected(self._where, self._plan))
            inside.callback(self._leave)
            while not self.device:
                self._look()
                for member in self._members.values():
                    self._prepare(member, store_is_made=False)
                for member, answer in self._answers():
                    self._ready(member, answer)
            self._inside = inside.pop_all()
        n = len(self._members)
        self.label, self.device = f"Dask, {n} worker{'s' * (n > 1)}", f"{n} x {self.device}"
        # More may join a cluster that others decide on: then not all units should lie in one batch.
        self.workers = n if self._where == LOCAL else max(n, 2)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._inside.__exit__(kind, error, where)

    def work(self, schedule: Schedule, store: ResultStore) -> None:
        """See ``Executor``."""
        while not schedule.over:
            for gone in self._look():
                self._lost(gone, schedule, store)
            for member in self._members.values():
                if not member.sees_store:
                    self._prepare(member, store_is_made=True)
                elif member.task is None and (batch := schedule.take()) is not None:
                    member.batch, member.n_done = batch, 0
                    self._submit(member, compute, member.order, member.process, list(batch.units))
            for member, answer in self._answers():
                if member.batch is None:
                    self._ready(member, answer)
                elif answer.get("process") == member.process:
                    self._ended(member, member.batch, answer, schedule)
                else:
                    self._lost(member, schedule, store)
            for member in self._members.values():
                _catch_up(member, schedule, store)

    # What is asked

    def _look(self) -> list[_Member]:
        """See which processes there are; gives those that have gone. Raises where none is of use."""
        there = self._threads()
        gone = [self._gone(member) for address, member in list(self._members.items()) if address not in there]
        for address in there.keys() - self._members.keys():
            self._members[address] = _Member(address, self._order(there[address]), self._share_of_gpus())
        self._most = max(self._most, len(there))
        refused = [m.refused for m in self._members.values() if m.refused]
        if refused and len(refused) == len(there):
            raise refused[0]
        self._bear_being_alone(bool(there))
        return gone

    def _share_of_gpus(self) -> dict[str, str]:
        """The one that the fewest of our own processes have; others have what their user gives them."""
        taken = Counter(member.environment.get(_GPU) for member in self._members.values())
        return {_GPU: min(self._gpus, key=lambda gpu: taken[gpu])} if self._gpus else {}

    def _threads(self) -> dict[str, int]:
        """Address of each process -> threads that its user gives it."""
        self._stay_connected()
        try:
            return dict(self._client.nthreads())
        except Exception as error:  # of many kinds, by what the connection was doing
            raise self._cut_off(f" ({type(error).__name__}: {error})") from None

    def _stay_connected(self) -> None:
        """Wait while a lost connection is taken up again; RunError where it is not."""
        while self._client.status == "connecting":
            time.sleep(LOOK_S)
        if self._client.status != "running":
            raise self._cut_off("")

    def _cut_off(self, why: str) -> RunError:
        return RunError(f"{self._name} does not answer any more{why}; --resume goes on with what is done")

    def _bear_being_alone(self, company: bool) -> None:
        now = time.monotonic()
        if company:
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = now
            event("waiting", f"{self._name} has no worker: waiting {WORKERLESS_S:g} s for one", logging.WARNING)
        elif now - self._alone_since > WORKERLESS_S:
            raise RunError(f"{self._name} had no worker for {WORKERLESS_S:g} s: start some, then go on with --resume")

    def _prepare(self, member: _Member, store_is_made: bool) -> None:
        ready = member.sees_store if store_is_made else member.process
        if not ready and member.task is None and member.refused is None:
            self._submit(member, prepare, member.order, member.environment, store_is_made)

    def _submit(self, member: _Member, function: Callable[..., Answer], *args: Any) -> None:
        member.task = self._client.submit(
            function, *args, key=f"leafflow-ti-{function.__name__}-{secrets.token_hex(8)}",
            workers=[member.address], allow_other_workers=False, pure=False, retries=0,
        )  # fmt: skip
        member.task.add_done_callback(lambda _: self._changed.set())

    # What is answered

    def _answers(self) -> Iterator[tuple[_Member, Answer]]:
        """Wait until a task has ended, or it is time to look around; an answer without a process comes from one that
        died."""
        self._changed.wait(LOOK_S)
        self._changed.clear()
        self._stay_connected()
        for member in list(self._members.values()):
            if member.task is not None and member.task.done():
                answer = _answer(member.task)
                member.task = None
                if "process" not in answer:
                    self._gone(member)
                yield member, answer

    def _ready(self, member: _Member, answer: Answer) -> None:
        """A process was prepared, or is of no use."""
        if "failure" in answer:
            member.refused = self._refusal(member, Failure(*answer["failure"]))
            # No warning of the run: those are kept with its results, where addresses have no place.
            event("worker_refused", f"the run goes on without a worker: {member.refused}", logging.WARNING)
        elif "process" in answer:
            self._stillborn = 0
            add_seconds(self._seconds, answer.get("seconds", {}))
            member.process, member.sees_store = answer["process"], answer["sees_store"]
            if not self.device:
                self.device, self.compile_seconds = answer["device"], answer["compile_seconds"]

    def _ended(self, member: _Member, batch: Batch, answer: Answer, schedule: Schedule) -> None:
        """A process has computed its batch, or failed to."""
        member.batch = None
        for unit in answer.get("done", ()):
            schedule.unit_done(batch, unit)
        add_seconds(self._seconds, answer.get("seconds", {}))
        for text in answer.get("warnings", ()):
            warn(text)
        if "failure" not in answer:
            schedule.ended(batch)
        else:
            schedule.failed(batch, Failure(*answer["failure"]))

    def _gone(self, member: _Member) -> _Member:
        """A process has died, or was replaced; raises RunError where none comes to work."""
        if self._members.pop(member.address, None) is None:
            return member
        event("worker_lost", f"worker {member.address} is lost", logging.ERROR, worker=member.address)
        self._stillborn += not member.process
        if self._stillborn >= STARTS * max(1, self._most):
            raise RunError(
                f"{self._stillborn} workers in a row have died before they were ready: the logs of {self._name} say why"
            )
        return member

    def _lost(self, member: _Member, schedule: Schedule, store: ResultStore) -> None:
        """A process is gone, with its batch if it had one."""
        self._gone(member)
        if member.batch is None:
            return
        _catch_up(member, schedule, store)
        schedule.lost(member.batch, "its worker died")
        self._deaths += 1
        if self._deaths >= DEATHS and not schedule.done:
            raise RunError(
                f"{self._deaths} workers have died before anything was computed: try more memory for each; the logs of "
                f"{self._name} say more"
            )

    def _refusal(self, member: _Member, failure: Failure) -> Exception:
        """Why a process is of no use, with its address where that is news to the user."""
        if self._where == LOCAL:
            return failure.error()
        paths = " (workers must see capture and results under the paths that you give)"
        says = f"worker {member.address}: {failure.message}{paths if failure.repeats else ''}"
        return replace(failure, message=says).error()

    @property
    def _name(self) -> str:
        """What the user calls the cluster."""
        if self._where == LOCAL:
            return "the local Dask cluster"
        where = self._where if isinstance(self._where, str) else self._client.scheduler.address
        return f"the Dask cluster at {where}"

    def _leave(self) -> None:
        """Cancel what is not done, and have processes that go on without us give back our memory: nobody waits."""
        from distributed import fire_and_forget

        for member in self._members.values():
            with contextlib.suppress(Exception):  # the connection may be what has ended the run
                if member.task is not None:
                    member.task.cancel()
                if member.process and self._where != LOCAL:
                    here = {"workers": [member.address], "allow_other_workers": True}
                    fire_and_forget(self._client.submit(forget, member.order, pure=False, **here))
        self._members.clear()


def _answer(task: Future) -> Answer:
    """Of a task that has ended; none, where its process or the connection ended first."""
    from distributed import KilledWorker

    try:
        answer: Answer = task.result(timeout=ANSWER_S)
    except (CancelledError, KilledWorker, TimeoutError):
        return {}
    except Exception as error:  # it could not even begin: package not installed there
        return {
            "process": "",
            "failure": [f"the task cannot begin: {type(error).__name__}: {error}", RunError.exit_code],
        }
    return answer


def _catch_up(member: _Member, schedule: Schedule, store: ResultStore) -> None:
    """Tell of units that are done, by their markers: they follow each other."""
    while member.batch is not None and member.n_done < len(member.batch.units):
        unit = member.batch.units[member.n_done]
        if not store.is_done(unit):
            return
        member.n_done += 1
        schedule.unit_done(member.batch, unit)


def _order(run: str, plan: Plan, capture: Capture, out: Path, threads: int) -> Order:
    """For a process with so many threads, unless the configuration asks for others."""
    section = plan.config.plan
    if section.threads == "auto":
        section = section.model_copy(update={"threads": threads})
    config = plan.config.model_copy(update={"plan": section})
    return run, Job.of(replace(plan, config=config), capture, out).to_json()


def _check_paths(config: RunConfig) -> None:
    """Raises ConfigError for paths that mean something else in other folders."""
    for key, path in (("output.mask", config.output.mask), ("range_flow.depth", config.range_flow.depth)):
        if path and not Path(path).is_absolute():
            raise ConfigError(
                f"{key} = '{path}': workers of a cluster have other current folders: give an absolute path"
            )
