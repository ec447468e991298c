"""The client of a Dask cluster: of one that runs elsewhere, or of one that is started here and ends with its use."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import TYPE_CHECKING, TypeVar

from leafflow_ti.config_sections import PlanSection
from leafflow_ti.errors import RunError, UsageError
from leafflow_ti.events import event
from leafflow_ti.executors.processes import STARTS
from leafflow_ti.runtime import usable_threads

if TYPE_CHECKING:
    from distributed import Client, LocalCluster

LOCAL = "local"
ANSWER_S = 6.0
"""Seconds within which a scheduler answers, or comes back when the connection is lost."""

Made = TypeVar("Made")


@contextlib.contextmanager
def connected(where: str | Client, plan: PlanSection) -> Iterator[Client]:
    """A client of the scheduler at an address, of a new cluster of ``plan.workers`` processes ("local"), or as given.

    Raises UsageError for what is no address, RunError where nobody answers, or new processes die.
    """
    from distributed import Client

    if isinstance(where, Client):
        if where.asynchronous:
            raise UsageError("dask: the client is asynchronous; give one that is not, or the scheduler's address")
        yield where
        return
    with contextlib.ExitStack() as inside:
        scheduler = inside.enter_context(_local_cluster(plan)) if where == LOCAL else _checked(where)
        inside.enter_context(_silent("distributed.client"))
        try:
            client = Client(scheduler, timeout=ANSWER_S, set_as_default=False)
        except OSError:
            raise RunError(
                f"no Dask scheduler answers at {where} within {ANSWER_S:g} s: start one ('dask scheduler'), or give "
                "another address"
            ) from None
        yield inside.enter_context(client)


@contextlib.contextmanager
def _silent(name: str) -> Iterator[None]:
    """A logger says nothing, as what it would say is told as an error."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(level)


def _checked(address: str) -> str:
    """As it is; UsageError for what is none. A client that fails for that can hardly be closed."""
    from distributed import Security
    from distributed.comm import get_address_host_port, parse_address

    try:
        get_address_host_port(address, strict=True)
    except ValueError as error:
        raise UsageError(
            f"--dask '{address}': {error}; give local, or the address of a scheduler, such as tcp://192.168.0.7:8786"
        ) from None
    if parse_address(address)[0] == "tls" and Security().get_connection_args("client")["ssl_context"] is None:
        raise UsageError(f"--dask {address}: Dask's configuration names no certificates (distributed.comm.tls)")
    return address


@contextlib.contextmanager
def _local_cluster(plan: PlanSection) -> Iterator[LocalCluster]:
    """Processes that compute a batch each, reached from this machine alone. None is ended for its memory: the plan has
    given it a share. They end at once where the block ends with an error, else in good order."""
    from distributed import LocalCluster

    def start() -> LocalCluster:
        for attempt in range(1, STARTS + 1):
            try:
                return LocalCluster(
                    n_workers=plan.workers, threads_per_worker=plan.threads_each(usable_threads()), memory_limit=None,
                    scheduler_kwargs={"dashboard": False, "dashboard_address": "127.0.0.1:0"},
                    silence_logs=logging.CRITICAL,
                )  # fmt: skip
            except RuntimeError as error:  # a process has died before it was there; those beside it are ended
                failure = f"{error}".rstrip(".")
                event(
                    "worker_lost", f"the local Dask cluster has not started ({failure})", logging.ERROR, start=attempt
                )
        raise RunError(
            f"the local Dask cluster was started {STARTS} times, and its workers died ({failure}): use fewer of them, "
            "or --workers without --dask"
        )

    cluster = _uninterrupted(start, lambda cluster: cluster.close())
    try:
        yield cluster
    except BaseException:
        _kill_workers(cluster)
        raise
    finally:
        cluster.close()


def _kill_workers(cluster: LocalCluster) -> None:
    for nanny in cluster.workers.values():
        nanny.auto_restart = False
        if nanny.pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL if hasattr(signal, "SIGKILL") else signal.SIGTERM)


def _uninterrupted(start: Callable[[], Made], stop: Callable[[Made], object]) -> Made:
    """What ``start`` returns. Interrupts from the terminal, which are ours to answer, do not reach the threads and
    processes that it starts; if one comes meanwhile, ``stop`` is called in the end."""
    started: Future[Made] = Future()

    def begin() -> None:
        if hasattr(signal, "pthread_sigmask"):  # threads and processes inherit it
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            started.set_result(start())
        except BaseException as error:
            started.set_exception(error)

    threading.Thread(target=begin, name="start", daemon=True).start()
    try:
        return started.result()
    except KeyboardInterrupt:
        started.add_done_callback(lambda done: None if done.exception() else stop(done.result()))
        raise
