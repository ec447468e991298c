"""A worker in a process of its own: ``python -m leafflow_ti.executors.process_worker``.

It reads one line of JSON after the other from its standard input: a job (``worker.Job``), then batches (lists of
units), until that ends. What it has to say goes to its standard output likewise, as objects with a ``kind``: ``ready``,
once kernels are compiled (``device``, ``seconds`` per stage so far); ``unit`` for each that is written (``unit``,
``seconds``); ``ended`` or ``failed`` (``message``, ``exit_code``) for each batch, the latter also instead of ``ready``;
``warning`` (``message``, ``facts``).
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import logging
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from leafflow_ti.errors import LeafflowError
from leafflow_ti.events import LOGGER
from leafflow_ti.executors import PAUSE_S
from leafflow_ti.results import ResultStore
from leafflow_ti.schedule import Failure
from leafflow_ti.worker import Job, Worker

PARTING_S = 1.0
"""How long a worker may take to end by itself when nobody listens any more."""
_PR_SET_PDEATHSIG = 1

Say = Callable[..., None]


def main() -> None:
    """Serve one run."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the terminal's interrupt is the parent's business, as we are
    _die_with_parent()
    say, lines = _channel(), _incoming()
    LOGGER.addHandler(_Warnings(say))
    text = lines.get()
    if text is not None:
        _serve(Job.of_json(text), lines, say)


def _serve(job: Job, lines: queue.SimpleQueue[str | None], say: Say) -> None:
    try:
        worker = Worker.of(job)
        worker.warm_up()
    except LeafflowError as error:  # others are told by the standard error
        _say_failed(say, error)
        return
    say("ready", device=str(worker.device), seconds=worker.seconds)
    store: ResultStore | None = None
    while (text := lines.get()) is not None:
        try:
            store = store or worker.open(job.out)
            worker.compute(store, json.loads(text), lambda unit: say("unit", unit=unit, seconds=worker.seconds))
        except Exception as error:
            time.sleep(PAUSE_S)
            _say_failed(say, error)
        else:
            say("ended", seconds=worker.seconds)


def _say_failed(say: Say, error: Exception) -> None:
    failure = Failure.of(error)
    say("failed", message=failure.message, exit_code=failure.exit_code)


def _channel() -> Say:
    """What writes messages to the standard output, which nothing else reaches from now on: engine and drivers print
    there as well, and are led to the standard error."""
    sys.stdout.flush()
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    lock = threading.Lock()

    def say(kind: str, **facts: Any) -> None:
        line = json.dumps({"kind": kind, **facts})
        with lock, contextlib.suppress(BrokenPipeError):  # nobody listens: see ``_incoming``
            channel.write(f"{line}\n")
            channel.flush()

    return say


def _incoming() -> queue.SimpleQueue[str | None]:
    """The lines of the standard input as they come, None where it ends: then this process ends, come what may."""
    lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)
        lines.put(None)
        time.sleep(PARTING_S)  # idle workers are gone by then, and their compiled kernels kept
        os._exit(1)

    threading.Thread(target=read, name="incoming", daemon=True).start()
    return lines


def _die_with_parent() -> None:
    """Have the system end this process with its parent, even in the middle of a long compilation. Linux only: elsewhere
    the end of the standard input is noticed as soon as the engine lets go of the interpreter."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


class _Warnings(logging.Handler):
    """Hands warnings on to the parent, which writes them down."""

    def __init__(self, say: Say) -> None:
        super().__init__(logging.WARNING)
        self._say = say

    def emit(self, record: logging.LogRecord) -> None:
        if getattr(record, "event", None) == "warning":
            self._say("warning", message=record.getMessage(), facts=getattr(record, "facts", {}))


if __name__ == "__main__":
    main()
