"""Where the time goes: spans of the stages, summed per stage and, if wanted, kept one by one for a trace viewer.

A span is a stretch of one thread's time. Where spans lie inside each other, only the innermost counts (self time), so
that the seconds of one thread never exceed those on the clock; those of several threads together may. Any layer opens
spans with ``span``; they cost a microsecond while a trace is ``active``, and nothing to speak of otherwise.
"""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from leafflow_ti.errors import RunError

STAGES: dict[str, str] = {
    "compile": "compiling or loading the kernels",
    "read": "bytes from disk",
    "decode": "bytes to blocks of grey values",
    "wait": "computing has nothing to do: images are not there yet, or results not yet written",
    "search": "disparities and motions of a whole image, coarsely",
    "prefilter": "filter of every image against uneven light",
    "filter": "derivatives, products, sums over cameras and frames",
    "tensor": "windows along y and x: structure tensors",
    "solve": "null space and covariances",
    "fit": "geometry, motion, maps",
    "estimate": "null space to maps, where they are one launch",
    "splines": "spline coefficients of the images for the refinement",
    "refine": "Gauss-Newton on the grey values of all images",
    "write": "maps to disk",
    "host": "all else of the thread that computes",
}
"""Name of a stage -> what its seconds are spent on."""
DEVICE_STAGES = frozenset(("prefilter", "filter", "tensor", "solve", "fit", "estimate", "splines", "refine"))
BACKGROUND_STAGES = frozenset(("read", "decode", "write"))
"""What other threads do while the device computes."""


@dataclass(frozen=True, slots=True)
class Event:
    """One span: ``start`` and ``duration`` in ns (self time: ``own``), on the clock of ``time.perf_counter_ns``."""

    stage: str
    label: str
    thread: int
    start: int
    duration: int
    own: int


@dataclass(slots=True)
class _Thread:
    """What one thread has spent: ns per stage, and of each open span the ns of the spans inside it."""

    number: int
    thread: threading.Thread
    ns: dict[str, int] = field(default_factory=dict)
    inner: list[int] = field(default_factory=list)


class Trace:
    """Collects spans of all threads.

    ``keep``: hold every span as an ``Event``. ``barrier``: called before a span of a device stage ends, so that work
    which the device does later counts for the stage that gave the order.
    """

    def __init__(self, keep: bool = False, barrier: Callable[[], None] | None = None) -> None:
        self.events: list[Event] | None = [] if keep else None
        self.barrier = barrier
        self._local = threading.local()
        self._threads: list[_Thread] = []
        self._begun = 0
        self._ended: Counter[str] = Counter()
        self._lock = threading.Lock()

    def span(self, stage: str, label: str = "") -> AbstractContextManager[None]:
        """The time of a ``with`` block, for one of ``STAGES``; ``label``: its name in a trace viewer."""
        return _Span(self, stage, label or stage)

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds per stage so far, all threads together, in the order of ``STAGES``; open spans do not count yet."""
        with self._lock:
            total = {s: self._ended[s] + sum(thread.ns.get(s, 0) for thread in self._threads) for s in STAGES}
        return {stage: ns / 1e9 for stage, ns in total.items() if ns}

    def of_thread(self) -> _Thread:
        """The record of the calling thread."""
        found: _Thread | None = getattr(self._local, "record", None)
        if found is None:
            with self._lock:
                if self.events is None:
                    self._add_up_ended()
                self._begun += 1
                found = _Thread(self._begun, threading.current_thread())
                self._threads.append(found)
            self._local.record = found
        return found

    def _add_up_ended(self) -> None:
        """Keep the sums alone of threads that have ended: a long run reads with some new ones for every frame."""
        alive = []
        for record in self._threads:
            if record.thread.is_alive():
                alive.append(record)
            else:
                self._ended.update(record.ns)
        self._threads = alive

    def write(self, path: Path) -> None:
        """Write the events in the JSON Trace Event Format, which Perfetto and Chrome's about:tracing open.

        Complete events (``ph`` X) with ``ts`` and ``dur`` in microseconds, and the names of the threads. Raises
        RunError when the file cannot be written, ValueError for a trace that keeps no events.
        """
        if self.events is None:
            raise ValueError("this trace keeps no events")
        process = os.getpid()
        named: list[dict[str, Any]] = [_name("process_name", process, 0, "leafflow-ti")]
        named += [_name("thread_name", process, t.number, t.thread.name) for t in self._threads]
        began = min((e.start for e in self.events), default=0)
        spans = [
            {
                "name": e.label, "cat": e.stage, "ph": "X", "pid": process, "tid": e.thread,
                "ts": (e.start - began) / 1e3, "dur": e.duration / 1e3,
            }
            for e in sorted(self.events, key=lambda e: (e.start, -e.duration))
        ]  # fmt: skip
        try:
            path.write_text(json.dumps({"traceEvents": named + spans, "displayTimeUnit": "ms"}), encoding="utf-8")
        except OSError as error:
            raise RunError(f"{path}: cannot be written ({error.strerror}): name another file") from error


def _name(kind: str, process: int, thread: int, name: str) -> dict[str, Any]:
    return {"name": kind, "ph": "M", "pid": process, "tid": thread, "args": {"name": name}}


class _Span:
    """See ``Trace.span``."""

    __slots__ = ("_label", "_stage", "_start", "_trace")

    def __init__(self, trace: Trace, stage: str, label: str) -> None:
        self._trace, self._stage, self._label = trace, stage, label

    def __enter__(self) -> None:
        self._trace.of_thread().inner.append(0)
        self._start = time.perf_counter_ns()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        trace = self._trace
        if trace.barrier is not None and kind is None and self._stage in DEVICE_STAGES:
            trace.barrier()
        duration = time.perf_counter_ns() - self._start
        thread = trace.of_thread()
        own = duration - thread.inner.pop()
        thread.ns[self._stage] = thread.ns.get(self._stage, 0) + own
        if thread.inner:
            thread.inner[-1] += duration
        if trace.events is not None:
            trace.events.append(Event(self._stage, self._label, thread.number, self._start, duration, own))


_current: ContextVar[Trace | None] = ContextVar("leafflow_ti_trace", default=None)
_NO_SPAN = contextlib.nullcontext()


@contextlib.contextmanager
def active(trace: Trace | None) -> Iterator[None]:
    """Inside the block, ``span`` adds to ``trace``, or nowhere; other threads must be run in a copy of this context."""
    before = _current.set(trace)
    try:
        yield
    finally:
        _current.reset(before)


def span(stage: str, label: str = "") -> AbstractContextManager[None]:
    """A span of the active trace (see ``Trace.span``); nothing where none is active."""
    trace = _current.get()
    return _NO_SPAN if trace is None else trace.span(stage, label)
