"""Work beside the computing: order kept, bounded, errors handed over, no thread left behind."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from leafflow_ti.background import Behind, prepared
from leafflow_ti.trace import Trace, active, span


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Iterator[None]:
    before = set(threading.enumerate())
    yield
    for thread in set(threading.enumerate()) - before:
        if isinstance(thread, threading.Timer):  # a test's own
            thread.join(30)
    assert set(threading.enumerate()) <= before


class Source:
    """Prepares lists of ``pieces`` squares, and remembers the order of what began."""

    def __init__(self, pieces: int = 3, fails_at: int | None = None) -> None:
        self.pieces, self.fails_at = pieces, fails_at
        self.begun: list[int] = []

    def __call__(self, item: int) -> tuple[list[int], list[Callable[[], None]]]:
        self.begun.append(item)
        value = [-1] * self.pieces

        def fill(k: int) -> None:
            if item == self.fails_at:
                raise OSError(f"item {item}")
            value[k] = item * item + k

        return value, [lambda k=k: fill(k) for k in range(self.pieces)]


@pytest.mark.parametrize("depth", [0, 1, 2, 9])
def test_values_come_in_order_and_complete(depth: int) -> None:
    found = list(prepared(Source(), range(20), depth, 4))
    assert found == [[t * t, t * t + 1, t * t + 2] for t in range(20)]


def test_no_more_is_prepared_than_the_depth_allows() -> None:
    source = Source()
    with contextlib.closing(prepared(source, range(20), 2, 4)) as values:
        for t, _ in enumerate(values):
            assert len(source.begun) == min(t + 3, 20)  # the one in use, and two


def test_pieces_of_one_item_are_worked_on_together() -> None:
    """Each piece waits for the other: one thread alone would never end."""
    meeting = threading.Barrier(2, timeout=30)

    def together(_: int) -> tuple[None, list[Callable[[], None]]]:
        return None, [lambda: meeting.wait() and None] * 2  # type: ignore[list-item, func-returns-value]

    assert list(prepared(together, range(3), 1, 2)) == [None] * 3


@pytest.mark.parametrize("depth", [0, 2])
def test_error_of_a_piece_is_raised_where_its_value_is_due(depth: int) -> None:
    found: list[int] = []
    values = (value[0] for value in prepared(Source(fails_at=3), range(20), depth, 4))
    with pytest.raises(OSError, match="item 3"):
        found.extend(values)
    assert found == [0, 1, 4]


def test_closing_drops_what_has_not_begun() -> None:
    gate, ran = threading.Event(), []

    def slow(item: int) -> tuple[int, list[Callable[[], None]]]:
        return item, [lambda: (gate.wait(30), ran.append(item))] if item else []  # type: ignore[list-item]

    values = prepared(slow, range(9), 4, 1)
    assert next(values) == 0
    threading.Timer(0.1, gate.set).start()
    values.close()
    assert ran == [1]  # the one that had begun


def test_spans_of_threads_count_for_the_active_trace() -> None:
    trace = Trace()

    def traced(_: int) -> tuple[None, list[Callable[[], None]]]:
        def work() -> None:
            with span("decode"):
                time.sleep(1e-3)

        return None, [work, work]

    def store(_: int) -> None:
        with span("write"):
            time.sleep(1e-3)

    with active(trace), Behind(store, 1) as behind:
        for _ in prepared(traced, range(2), 1, 2):
            behind.put(0)
    assert trace.seconds["decode"] >= 4e-3
    assert trace.seconds["write"] >= 2e-3


def test_results_are_stored_in_order_by_another_thread() -> None:
    stored: list[tuple[int, str]] = []
    with Behind(lambda item: stored.append((item, threading.current_thread().name)), 2) as behind:
        for t in range(50):
            behind.put(t)
    assert stored == [(t, "write") for t in range(50)]


def test_put_waits_while_enough_results_wait() -> None:
    gate, put = threading.Event(), []

    def give() -> None:
        with Behind(lambda _: gate.wait(30) and None, 2) as behind:  # type: ignore[func-returns-value]
            for t in range(5):
                behind.put(t)
                put.append(t)

    thread = threading.Thread(target=give)
    thread.start()
    time.sleep(0.2)
    assert put == [0, 1, 2]  # one is being stored, two wait
    gate.set()
    thread.join(30)
    assert put == list(range(5))


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_error_of_storing_surfaces_and_nothing_is_stored_after_it(error: BaseException) -> None:
    stored = []

    def store(item: int) -> None:
        if item == 2:
            raise error
        stored.append(item)

    given = []

    def give() -> None:
        with Behind(store, 1) as behind:
            for t in range(100):
                behind.put(t)
                given.append(t)

    with pytest.raises(type(error)):
        give()
    assert stored == [0, 1]
    assert len(given) <= 5  # at once, not at the end


def test_error_of_the_last_result_surfaces_at_the_end() -> None:
    def store(_: int) -> None:
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"), Behind(store, 4) as behind:
        behind.put(0)


def test_error_of_the_block_drops_what_waits() -> None:
    gate, stored = threading.Event(), []

    def store(item: int) -> None:
        gate.wait(30)
        stored.append(item)

    def give() -> None:
        with Behind(store, 4) as behind:
            for t in range(4):
                behind.put(t)
            threading.Timer(0.1, gate.set).start()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        give()
    assert stored in ([], [0])
