"""A worker process as its parent sees it: JSON lines out and in, and how it ended."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from typing import IO, Any

MODULE = "leafflow_ti.executors.process_worker"
LAST_LINES = 20
"""Of the standard error, for messages."""
DRAINING_S = 1.0
"""How long the last words of a process that has ended are waited for: others may hold its standard error open."""

Message = dict[str, Any]


class Child:
    """A process that is started with a job, and that sends messages (see ``process_worker``) into an inbox.

    They come there as ``(child, message)``, by a thread of the child's; the last one is ``gone``, with ``reason``: the
    signal or exit code in words. ``environment``: variables beside those of this process.
    """

    def __init__(
        self,
        inbox: queue.SimpleQueue[tuple[Child, Message]],
        job: str,
        environment: Mapping[str, str],
        command: Sequence[str] = (sys.executable, "-m", MODULE),
    ) -> None:
        # Modules are found where this process finds them, wherever it was started from.
        path = os.pathsep.join(os.path.abspath(p) for p in sys.path)  # noqa: PTH100 - not resolved: "" is the cwd
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8",
            errors="replace", env={**os.environ, "PYTHONPATH": path, **environment},
        )  # fmt: skip
        self._last: deque[str] = deque(maxlen=LAST_LINES)
        self._draining = threading.Thread(target=self._drain, args=(self._process.stderr,), daemon=True)
        self._hearing = threading.Thread(target=self._hear, args=(self._process.stdout, inbox), daemon=True)
        self._draining.start()
        self._hearing.start()
        self._send(job)

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def give(self, units: Sequence[int]) -> None:
        """Have it compute a batch."""
        self._send(json.dumps(units))

    def close(self) -> None:
        """Tell it that there is no more work; it ends by itself when it is idle."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # it has gone already, with a line unread
            self._process.stdin.close()

    def wait(self, end: float) -> None:
        """Wait until it has ended, at most until the clock (``time.monotonic``) is at ``end``."""
        for thread in (self._hearing, self._draining):
            thread.join(max(0.0, end - time.monotonic()))

    def kill(self) -> None:
        """End it now: the units that it has marked are whole."""
        self._process.kill()
        self.close()

    def _send(self, line: str) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # it is gone: its last message says so
            self._process.stdin.write(f"{line}\n")
            self._process.stdin.flush()

    def _drain(self, stream: IO[str]) -> None:
        with stream:
            self._last.extend(line.strip() for line in stream if line.strip())

    def _hear(self, stream: IO[str], inbox: queue.SimpleQueue[tuple[Child, Message]]) -> None:
        with stream:
            for line in stream:
                message = _message(line)
                if message is not None:
                    inbox.put((self, message))
        code = self._process.wait()
        self._draining.join(DRAINING_S)
        inbox.put((self, {"kind": "gone", "reason": _end_in_words(code, self._last)}))


def _message(line: str) -> Message | None:
    """None for a line that is none: one that was cut off by its writer's death, or that somebody else has printed."""
    try:
        found = json.loads(line)
    except ValueError:
        return None
    return found if isinstance(found, dict) and "kind" in found else None


def _end_in_words(code: int, last_lines: Sequence[str]) -> str:
    if code < 0:
        killed = ": killed, as the system does when memory runs out" if code == -signal.SIGKILL else ""
        return f"signal {-code}{killed}"
    return f"exit code {code}{': ' + last_lines[-1] if last_lines else ''}"
