"""Progress of a run on one line of standard error: rewritten on a terminal, one line now and then elsewhere."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from typing import ClassVar, TextIO

from leafflow_ti.number_text import duration
from leafflow_ti.progress import Progress

TERMINAL_INTERVAL_S = 0.1
LOG_INTERVAL_S = 30.0


def format_rate(pixels_per_second: float) -> str:
    """``850 px/s``, ``12.3 kpx/s``, ``1.2 Mpx/s``."""
    for scale, prefix in ((1e6, "M"), (1e3, "k")):
        if pixels_per_second >= scale:
            return f"{pixels_per_second / scale:.1f} {prefix}px/s"
    return f"{pixels_per_second:.0f} px/s"


def format_progress(progress: Progress) -> str:
    """Units, percent, speed and time left, as far as they are known."""
    share = progress.pixels_done / progress.pixels_total if progress.pixels_total else 1.0
    parts = [f"unit {progress.done_units}/{progress.total_units}", f"{share:.0%}"]
    if progress.pixels_per_second is not None and progress.seconds_left is not None:
        parts += [format_rate(progress.pixels_per_second), f"{duration(round(progress.seconds_left))} left"]
    return ", ".join(parts)


class RewrittenLine:
    """A line of a terminal that is written again and again until it is closed."""

    _open: ClassVar[RewrittenLine | None] = None
    _lock: ClassVar[threading.RLock] = threading.RLock()  # warnings come from any thread

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._text = ""

    def show(self, text: str) -> None:
        """Write this in place of what is there."""
        with self._lock:
            self._stream.write("\r" + text.ljust(len(self._text)))
            self._stream.flush()
            self._text = text
            RewrittenLine._open = self

    def close(self) -> None:
        """Leave the line as it is and go to the next one."""
        with self._lock:
            if self._text:
                self._stream.write("\n")
                self._stream.flush()
                self._text = ""
                RewrittenLine._open = None

    @classmethod
    def beside(cls, line: str, stream: TextIO) -> None:
        """Write a line of its own; the rewritten line, if there is one, goes on below it."""
        with cls._lock:
            rewritten = cls._open
            if rewritten:
                rewritten._stream.write("\r" + " " * len(rewritten._text) + "\r")
                rewritten._stream.flush()
            stream.write(line + "\n")
            stream.flush()
            if rewritten:
                rewritten.show(rewritten._text)


def end_line() -> None:
    """Leave the line that shows progress, if there is one, and go to the next one."""
    if RewrittenLine._open:
        RewrittenLine._open.close()


def write_line(text: str) -> None:
    """Write a line to standard error, never into the midst of one that shows progress."""
    RewrittenLine.beside(text, sys.stderr)


def counted(what: str) -> Callable[[int, int], None] | None:
    """Shows ``image 3/12`` on standard error, rewritten, where that is a terminal; None elsewhere."""
    if not sys.stderr.isatty():
        return None
    line = RewrittenLine(sys.stderr)

    def show(done: int, total: int) -> None:
        line.show(f"{what} {done}/{total}")
        if done == total:
            line.close()

    return show


class ProgressLine:
    """Callable that shows a ``Progress``; ``close`` ends the line of a terminal.

    On a terminal at most every 0.1 s, elsewhere every 30 s (a log stays short); the first and the last always.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._line = RewrittenLine(self._stream) if self._stream.isatty() else None
        self._interval = TERMINAL_INTERVAL_S if self._line else LOG_INTERVAL_S
        self._next = 0.0

    def __call__(self, progress: Progress) -> None:
        now = time.monotonic()
        if now < self._next and progress.done_units < progress.total_units:
            return
        self._next = now + self._interval
        text = format_progress(progress)
        if self._line:
            self._line.show(text)
        else:
            self._stream.write(text + "\n")
            self._stream.flush()

    def close(self) -> None:
        """Leave the line as it is and go to the next one."""
        if self._line:
            self._line.close()
