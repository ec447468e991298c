"""How far a run has come, in words, on terminals and in logs."""

from __future__ import annotations

import io
import itertools

import pytest

from leafflow_ti.cli.progress import ProgressLine, format_progress, format_rate
from leafflow_ti.number_text import duration
from leafflow_ti.progress import Progress


def test_progress_in_words() -> None:
    assert format_progress(Progress(3, 12, 250_000, 1_000_000, 10.0)) == "unit 3/12, 25%, 25.0 kpx/s, 30 s left"
    assert format_progress(Progress(0, 12, 0, 1_000_000, 0.0)) == "unit 0/12, 0%"
    assert format_progress(Progress(0, 0, 0, 0, 0.0)) == "unit 0/0, 100%"
    assert [duration(s) for s in (59.4, 200, 7500)] == ["59 s", "3 min 20 s", "2 h 05 min"]
    assert [format_rate(r) for r in (850, 12_340, 1.2e6)] == ["850 px/s", "12.3 kpx/s", "1.2 Mpx/s"]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def progress_of(stream: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> str:
    """What a run of 300 units, one every 50 ms, writes."""
    now = [100.0]
    monkeypatch.setattr("leafflow_ti.cli.progress.time.monotonic", lambda: now[0])
    line = ProgressLine(stream)
    for unit in range(1, 301):
        line(Progress(unit, 300, unit * 100, 30_000, unit * 0.05))
        now[0] += 0.05
    line.close()
    return stream.getvalue()


def test_log_gets_few_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    text = progress_of(io.StringIO(), monkeypatch)
    assert text.splitlines() == ["unit 1/300, 0%, 2.0 kpx/s, 15 s left", "unit 300/300, 100%, 2.0 kpx/s, 0 s left"]


def test_terminal_gets_one_line_rewritten(monkeypatch: pytest.MonkeyPatch) -> None:
    text = progress_of(Terminal(), monkeypatch)
    assert text.count("\n") == 1
    assert text.endswith("0 s left\n")
    states = text.rstrip("\n").split("\r")
    assert 100 <= len(states) <= 152
    assert all(
        len(later) >= len(earlier.rstrip()) for earlier, later in itertools.pairwise(states)
    )  # nothing is left over
