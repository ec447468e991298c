"""How signals stop the program: the first one as an exception, so that all is left in order; the second at once.

Only the command line takes signals into its hands (``stoppable``). A program that embeds the package keeps its own
handlers, and everything here leaves them alone.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from leafflow_ti.errors import Interrupted

SIGNALS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
"""Signal -> what the program says when it has ended."""
AGAIN_S = 0.01
"""Until an interrupt comes again that went to a place where it could not be raised."""


@dataclass
class Stop:
    """Which signal has come, if any, and what it replaced."""

    number: signal.Signals | None = None
    earlier: dict[signal.Signals, Any] = field(default_factory=dict)
    alarm: Any = None
    usual_hook: Callable[[Any], None] = sys.__unraisablehook__

    def handle(self, number: int, _frame: FrameType | None) -> None:
        """The handler: the next signal ends the process."""
        self.number = signal.Signals(number)
        for known in self.earlier:
            signal.signal(known, signal.SIG_DFL)
        raise self.interrupt()

    def lost(self, about: Any) -> None:
        """In place of ``sys.unraisablehook``: an interrupt that hit a destructor, where exceptions go no further, comes
        again."""
        if isinstance(about.exc_value, Interrupted) and hasattr(signal, "setitimer"):
            self.alarm = signal.signal(signal.SIGALRM, self._again)
            signal.setitimer(signal.ITIMER_REAL, AGAIN_S)
        else:
            self.usual_hook(about)

    def _again(self, _number: int, _frame: FrameType | None) -> None:
        raise self.interrupt()

    def interrupt(self) -> Interrupted:
        """The exception for the signal that has come."""
        number = self.number or signal.SIGINT
        return Interrupted(SIGNALS[number], 128 + number)


_stop: Stop | None = None
"""Set while signals are ours."""


@contextlib.contextmanager
def stoppable(whole_process: bool = False) -> Iterator[Stop]:
    """Signals stop the block by ``Interrupted``; what it is given says which came, also if the exception was lost on
    its way out of foreign code.

    A signal that is ignored (``nohup``, jobs in the background of a script) stays so, and so does everything in
    threads, which get no signals. ``whole_process``: nothing follows but the process's end, which signals do not
    disturb any more: what the engine keeps for the next process is written then.
    """
    global _stop
    stop = Stop()
    if not _in_main_thread() or _stop is not None:
        yield stop
        return
    wanted = [s for s in SIGNALS if signal.getsignal(s) not in (signal.SIG_IGN, None)]
    stop.earlier = {s: signal.signal(s, stop.handle) for s in wanted}
    stop.usual_hook, sys.unraisablehook = sys.unraisablehook, stop.lost
    _stop = stop
    try:
        yield stop
    finally:
        _stop, sys.unraisablehook = None, stop.usual_hook
        if stop.alarm is not None:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, stop.alarm)
        for known, handler in stop.earlier.items():
            signal.signal(known, signal.SIG_IGN if whole_process and stop.number is None else handler)


@contextlib.contextmanager
def ended_at_once() -> Iterator[None]:
    """Signals end the process without a word while the block runs: for a call of foreign code that lasts so long that
    nobody would wait for Python's turn. Results survive it, as they survive any kill.

    Nothing changes outside of ``stoppable``, in threads, and for the first process of a container, which the system
    does not end by a signal without handler.
    """
    ours = _stop is not None and _stop.number is None and _in_main_thread() and os.getpid() != 1
    handlers = dict.fromkeys(_stop.earlier, _stop.handle) if _stop is not None and ours else {}
    for known in handlers:
        signal.signal(known, signal.SIG_DFL)
    try:
        yield
    finally:
        for known, handler in handlers.items():
            signal.signal(known, handler)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()
