"""Runs as processes of the command line, each in a group of its own, and ways to kill them."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

POLL_S = 0.001
PATIENCE_S = 240.0
"""For a run that goes on; what takes longer hangs."""
ORPHAN_S = 30.0
"""For the workers of a run that was killed to notice it."""


@dataclass(frozen=True)
class Process:
    """A process as ``/proc`` tells it."""

    pid: int
    parent: int
    group: int
    zombie: bool


class Life:
    """A run's processes, started together: one command, or one for each shard. ``errors``: file of what they say."""

    def __init__(self, commands: Sequence[Sequence[str]], environment: dict[str, str], errors: Path) -> None:
        self.began = time.perf_counter()
        self.errors = errors
        with errors.open("wb") as file:
            self._commands = [
                subprocess.Popen(
                    [sys.executable, "-m", "leafflow_ti.cli.main", *command],
                    env=environment, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True,
                )
                for command in commands
            ]  # fmt: skip

    @property
    def over(self) -> bool:
        """Whether all commands have ended."""
        return all(command.poll() is not None for command in self._commands)

    def wait_for(self, reached: Callable[[], bool], rest_s: float) -> bool:
        """Wait for a moment, and ``rest_s`` longer; False if all has ended before. Raises TimeoutError."""
        while not reached():
            if self.over:
                return False
            if time.perf_counter() - self.began > PATIENCE_S:
                self.kill_all()
                raise TimeoutError(f"a run was not there after {PATIENCE_S:g} s")
            time.sleep(POLL_S)
        time.sleep(rest_s)
        return not self.over

    def kill_all(self) -> None:
        """Every process of the run."""
        for command in self._commands:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(command.pid, signal.SIGKILL)
            command.wait()

    def kill_one(self, rng: random.Random) -> None:
        """One of several commands, with all of its processes."""
        command = rng.choice(self._commands)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(command.pid, signal.SIGKILL)

    def kill_parent(self) -> None:
        """The first command alone: its workers are orphans."""
        self._commands[0].kill()

    def kill_worker(self, rng: random.Random) -> bool:
        """One of the processes that the first command has started; False if there is none."""
        workers = [p.pid for p in self._alive() if p.pid != self._commands[0].pid]
        if workers:
            with contextlib.suppress(ProcessLookupError):
                os.kill(rng.choice(workers), signal.SIGKILL)
        return bool(workers)

    def end(self) -> tuple[list[int], int]:
        """Wait until all has ended; exit codes, negative for signals, and how many processes outlived their command for
        longer than they may, which are killed. Raises TimeoutError."""
        codes = []
        for command in self._commands:
            try:
                codes.append(command.wait(PATIENCE_S))
            except subprocess.TimeoutExpired:
                self.kill_all()
                raise TimeoutError(f"a run did not end within {PATIENCE_S:g} s") from None
        until = time.perf_counter() + ORPHAN_S
        while (orphans := len(self._alive())) and time.perf_counter() < until:
            time.sleep(0.05)
        self.kill_all()
        return codes, orphans

    def _alive(self) -> list[Process]:
        groups = {command.pid for command in self._commands}
        return [p for p in processes() if p.group in groups and not p.zombie]


def processes() -> list[Process]:
    """All of this machine."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with contextlib.suppress(OSError):
                # The name, in brackets, may hold anything.
                state, parent, group = (entry / "stat").read_text(errors="replace").rpartition(")")[2].split()[:3]
                found.append(Process(int(entry.name), int(parent), int(group), state == "Z"))
    return found
