"""Work beside the thread that computes: values prepared ahead of their use, results stored behind it.

The engine holds the interpreter while a kernel runs, so that other threads take over between kernels and whenever they
wait for the disk or decode. Threads live as long as the block that needs them: none is left behind, whatever happens.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context
from types import TracebackType
from typing import Any, Generic, Self, TypeVar

from leafflow_ti import trace

Item = TypeVar("Item")
Value = TypeVar("Value")

Prepared = tuple[Value, list[Callable[[], None]]]
"""A value, and the independent pieces of work that fill it."""


def prepared(
    prepare: Callable[[Item], Prepared[Value]], items: Iterable[Item], depth: int, threads: int
) -> Generator[Value, None, None]:
    """The values of ``items`` in their order, filled by ``threads`` up to ``depth`` items before they are asked for.

    ``depth`` 0: filled by the caller when asked for. What a piece raises is raised where its value is due. Close the
    iterator (``contextlib.closing``) when it is not used up: pieces that have not begun are dropped, begun ones end.
    """
    if depth == 0:
        for item in items:
            value, pieces = prepare(item)
            for piece in pieces:
                piece()
            del pieces
            yield value
        return
    pool = ThreadPoolExecutor(threads, "read")
    waiting: deque[tuple[Value, list[Future[None]]]] = deque()
    source = iter(items)

    def add() -> None:
        for item in source:
            value, pieces = prepare(item)
            waiting.append((value, [pool.submit(copy_context().run, piece) for piece in pieces]))
            return

    try:
        for _ in range(depth + 1):
            add()
        while waiting:
            value, filling = waiting.popleft()
            with trace.span("wait", "wait for images"):
                for future in filling:
                    future.result()
            del filling
            yield value
            del value  # the block goes before the next one comes
            add()
    finally:
        pool.shutdown(cancel_futures=True)


class Behind(Generic[Item]):
    """Stores results in the order in which they come, on a thread of its own, at most ``depth`` of them waiting.

    Used as a context manager. What storing raises is raised by the next ``put`` or at the end of the block, and
    nothing is stored after it. If the block itself ends with an error, what still waits is dropped.
    """

    def __init__(self, store: Callable[[Item], None], depth: int) -> None:
        self._store = store
        self._waiting: queue.Queue[Any] = queue.Queue(depth)
        self._error: BaseException | None = None
        self._dropping = False
        self._thread = threading.Thread(target=copy_context().run, args=(self._work,), name="write", daemon=True)

    def put(self, item: Item) -> None:
        """Hand over one result; waits while ``depth`` of them wait."""
        self._check()
        with trace.span("wait", "wait for the disk"):
            self._waiting.put(item)
        self._check()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._dropping = kind is not None
        try:
            self._finish()
        except BaseException:  # interrupted while the last results are stored
            self._dropping = True
            self._finish()
            raise
        if kind is None:
            self._check()

    def _finish(self) -> None:
        with trace.span("wait", "wait for the disk"):
            self._waiting.put(_END)
            self._thread.join()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        while (item := self._waiting.get()) is not _END:
            if self._dropping or self._error is not None:
                continue
            try:
                self._store(item)
            except BaseException as error:  # an interrupt, too, belongs to the thread that waits for us
                self._error = error


_END = object()
