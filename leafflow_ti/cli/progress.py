"""Progress of a run on one line of standard error: rewritten on a terminal, one line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import TextIO

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


def counted(what: str) -> Callable[[int, int], None] | None:
    """Shows ``image 3/12`` on standard error, rewritten, where that is a terminal; None elsewhere."""
    if not sys.stderr.isatty():
        return None

    def show(done: int, total: int) -> None:
        sys.stderr.write(f"\r{what} {done}/{total}" + ("\n" if done == total else ""))
        sys.stderr.flush()

    return show


class ProgressLine:
    """Callable that shows a ``Progress``; ``close`` ends the line of a terminal.

    On a terminal at most every 0.1 s, elsewhere every 30 s (a log stays short); the first and the last always.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._terminal = self._stream.isatty()
        self._interval = TERMINAL_INTERVAL_S if self._terminal else LOG_INTERVAL_S
        self._next = 0.0
        self._width = 0

    def __call__(self, progress: Progress) -> None:
        now = time.monotonic()
        if now < self._next and progress.done_units < progress.total_units:
            return
        self._next = now + self._interval
        text = format_progress(progress)
        if self._terminal:
            self._stream.write("\r" + text.ljust(self._width))
            self._width = len(text)
        else:
            self._stream.write(text + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Leave the line as it is and go to the next one."""
        if self._terminal and self._width:
            self._stream.write("\n")
            self._stream.flush()
            self._width = 0
