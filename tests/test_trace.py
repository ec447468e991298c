"""Spans: self time per stage and thread, and the trace file that viewers open."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextvars import copy_context
from pathlib import Path

import pytest

from leafflow_ti.errors import RunError
from leafflow_ti.trace import STAGES, Trace, active, span


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """A clock that stands still until a test moves it: [ns]."""
    now = [0]
    monkeypatch.setattr("leafflow_ti.trace.time.perf_counter_ns", lambda: now[0])
    return now


def spend(clock: list[int], seconds: float) -> None:
    clock[0] += round(seconds * 1e9)


def test_only_the_innermost_span_counts(clock: list[int]) -> None:
    trace = Trace()
    with active(trace), span("host"):
        spend(clock, 1)
        for _ in range(2):
            with span("filter"):
                spend(clock, 2)
                with span("host"):
                    spend(clock, 4)
        with span("fit"), span("fit"):
            spend(clock, 8)
    assert trace.seconds == {"filter": 4.0, "fit": 8.0, "host": 9.0}
    assert list(trace.seconds) == [s for s in STAGES if s in trace.seconds]


def test_a_span_that_raises_counts_and_leaves_the_others_whole(clock: list[int]) -> None:
    trace = Trace()

    def fails() -> None:
        with span("read"):
            spend(clock, 3)
            raise ZeroDivisionError

    with active(trace), span("host"):
        with pytest.raises(ZeroDivisionError):
            fails()
        spend(clock, 1)
    assert trace.seconds == {"read": 3.0, "host": 1.0}


def test_spans_without_a_trace_do_nothing() -> None:
    trace = Trace(keep=True)
    with active(trace), active(None), span("read"):
        pass
    with span("read"):
        pass
    assert trace.seconds == {}
    assert trace.events == []


def test_threads_are_counted_apart_and_summed(clock: list[int]) -> None:
    trace = Trace(keep=True)

    def work() -> None:
        with span("decode"):
            spend(clock, 2)

    with active(trace), span("host"):
        thread = threading.Thread(target=copy_context().run, args=(work,), name="reader")
        thread.start()
        thread.join()
    # The other thread's time is not taken from the span that waited for it.
    assert trace.seconds == {"decode": 2.0, "host": 2.0}
    assert trace.events is not None
    assert len({event.thread for event in trace.events}) == 2


def test_threads_that_have_ended_leave_their_sums_alone(clock: list[int]) -> None:
    """A long run reads with some new threads for every frame."""
    trace = Trace()

    def work() -> None:
        with span("decode"):
            spend(clock, 2)

    with active(trace), span("host"):
        for n in range(50):
            thread = threading.Thread(target=copy_context().run, args=(work,))
            thread.start()
            thread.join()
            assert trace.seconds == {"decode": 2.0 * (n + 1)}
            assert len(trace._threads) <= 2


def test_barrier_ends_the_spans_of_the_device_alone(clock: list[int]) -> None:
    trace = Trace(barrier=lambda: spend(clock, 5))
    with active(trace):
        for stage in ("filter", "read", "solve"):
            with span(stage):
                pass
    assert trace.seconds == {"filter": 5.0, "solve": 5.0}


def events_of(path: Path) -> tuple[list[dict], list[dict]]:
    """Complete and metadata events of a trace file, checked against the format."""
    found = json.loads(path.read_text(encoding="utf-8"))["traceEvents"]
    for event in found:
        assert event["ph"] in ("X", "M")
        assert isinstance(event["name"], str)
        assert all(isinstance(event[key], int) for key in ("pid", "tid"))
        if event["ph"] == "X":
            assert event["cat"] in STAGES
            assert event["ts"] >= 0
            assert event["dur"] >= 0
        else:
            assert event["name"] in ("process_name", "thread_name")
            assert isinstance(event["args"]["name"], str)
    return [e for e in found if e["ph"] == "X"], [e for e in found if e["ph"] == "M"]


def assert_nested(events: list[dict]) -> None:
    """Of one thread: any two spans lie inside each other or apart (to a rounding of a nanosecond)."""
    for tid in {e["tid"] for e in events}:
        open_until: list[float] = []
        for e in sorted((e for e in events if e["tid"] == tid), key=lambda e: (e["ts"], -e["dur"])):
            while open_until and open_until[-1] <= e["ts"] + 1e-3:
                open_until.pop()
            end = e["ts"] + e["dur"]
            assert not open_until or end <= open_until[-1] + 1e-3, e
            open_until.append(end)


def test_trace_file_is_valid_and_nested(tmp_path: Path) -> None:
    trace = Trace(keep=True)

    def work() -> None:
        with span("decode"), span("read", "a file"):
            pass

    with active(trace):
        thread = threading.Thread(target=copy_context().run, args=(work,), name="reader")
        thread.start()
        for t in range(3):
            with span("host", f"frame {t}"), span("filter"):
                pass
        thread.join()
    trace.write(tmp_path / "t.json")
    spans, names = events_of(tmp_path / "t.json")
    assert len(spans) == 8
    assert {"frame 0", "frame 1", "frame 2", "a file"} < {e["name"] for e in spans}
    assert min(e["ts"] for e in spans) == 0
    assert_nested(spans)
    threads = {e["tid"]: e["args"]["name"] for e in names if e["name"] == "thread_name"}
    assert set(threads) == {e["tid"] for e in spans}
    assert "reader" in threads.values()


def test_nesting_check_finds_overlap() -> None:
    crossing = [{"tid": 1, "ts": 0.0, "dur": 5.0}, {"tid": 1, "ts": 3.0, "dur": 5.0}]
    with pytest.raises(AssertionError):
        assert_nested(crossing)


def test_trace_file_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"absent.*cannot be written \(No such file or directory\): name another file"):
        Trace(keep=True).write(tmp_path / "absent" / "t.json")
    with pytest.raises(ValueError, match="keeps no events"):
        Trace().write(tmp_path / "t.json")
