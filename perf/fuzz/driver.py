"""Rounds of trials in a child process with a cap on its memory and a watchdog; it is started anew when it dies.

An input that brought a defect to light is kept below ``--out`` with what was found; the same ``--seed`` repeats it.
"""

from __future__ import annotations

import contextlib
import json
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from perf.cases import Options
from perf.figures import Figure, Outcome
from perf.fuzz.trial import KINDS, Verdict, load

TIMEOUT_S = 10.0
STARTUP_S = 120.0
"""A child imports the program and makes its seeds before its first answer."""
COUNT, QUICK = 2000, 200
SHOWN = 10


class Child:
    """A process that judges trials of one kind, started when it is first needed."""

    def __init__(self, kind: str, seed: int, folder: Path) -> None:
        self._command = [sys.executable, "-m", "perf.fuzz.child", kind, str(seed), str(folder)]
        self._process: subprocess.Popen[str] | None = None
        self.starts = 0

    def ask(self, number: int) -> Verdict:
        """Verdict of trial ``number``: also where the process hangs or dies of it."""
        limit = TIMEOUT_S
        if self._process is None:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
            )
            self.starts += 1
            limit += STARTUP_S
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{number}\n")
        self._process.stdin.flush()
        ready, _, _ = select.select([self._process.stdout], [], [], limit)
        line = self._process.stdout.readline() if ready else ""
        if line:
            return Verdict(**json.loads(line))
        if ready:
            with contextlib.suppress(subprocess.TimeoutExpired):  # its answers have ended: it is dead, or about to be
                self._process.wait(TIMEOUT_S)
        code = self.close()
        if not ready:
            return Verdict("defect", f"no answer within {limit:g} s")
        name = signal.Signals(-code).name if code < 0 else f"code {code}"
        return Verdict("defect", f"the process died: {name}")

    def close(self) -> int:
        """End the process; its exit code, 0 if there is none."""
        if self._process is None:
            return 0
        self._process.kill()  # does nothing to one that has ended
        code = self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()
        self._process = None
        return code


@dataclass
class Tally:
    """What the trials of one kind came to."""

    outcomes: Counter[str] = field(default_factory=Counter)
    defects: dict[int, str] = field(default_factory=dict)
    slowest: float = 0.0
    starts: int = 0


def trials(kind: str, seed: int, numbers: Iterable[int], folder: Path) -> Iterator[tuple[int, Verdict, float]]:
    """Number, verdict and seconds of each trial; the files of the last one are in ``folder``."""
    child = Child(kind, seed, folder)
    try:
        for number in numbers:
            first, began = child.starts, time.perf_counter()
            verdict = child.ask(number)
            yield number, verdict, 0.0 if child.starts > first else time.perf_counter() - began
    finally:
        child.close()


def fuzz(kind: str, count: int, seed: int, out: Path) -> Tally:
    """``count`` trials of one kind; inputs with a defect are kept in ``out``."""
    tally = Tally()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as scratch:
        folder = Path(scratch) / "trial"
        for number, verdict, seconds in trials(kind, seed, range(count), folder):
            tally.outcomes[verdict.outcome] += 1
            tally.slowest = max(tally.slowest, seconds)
            if verdict.defect:
                tally.defects[number] = verdict.defect
                _keep(folder, out / f"{kind}-{seed}-{number}", verdict.defect)
    return tally


def _keep(folder: Path, target: Path, defect: str) -> None:
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(folder, target, symlinks=True, ignore=_not_plain)
    (target / "defect.txt").write_text(defect + "\n", encoding="utf-8")


def _not_plain(directory: str, names: list[str]) -> list[str]:
    """What cannot be copied: pipes, sockets."""
    found = [Path(directory) / name for name in names]
    return [path.name for path in found if not (path.is_file() or path.is_dir() or path.is_symlink())]


def run(options: Options) -> Outcome:
    """All kinds, ``--count`` inputs together."""
    total = options.count or (QUICK if options.quick else COUNT)
    shares = {name: load(name).share for name in KINDS}
    figures: list[Figure] = []
    notes: list[str] = []
    for name, share in shares.items():
        count = round(total * share / sum(shares.values()))
        tally = fuzz(name, count, options.seed, options.out / "fuzz")
        figures += [
            Figure(f"{name}: inputs", count),
            *(Figure(f"{name}: {outcome}", n) for outcome, n in sorted(tally.outcomes.items()) if outcome != "defect"),
            Figure(f"{name}: defects", len(tally.defects), reference=0),
            Figure(f"{name}: slowest", tally.slowest, "s", reference=TIMEOUT_S),
        ]
        notes += [f"{name} {number}: {text.splitlines()[-1]}" for number, text in list(tally.defects.items())[:SHOWN]]
    return Outcome(tuple(figures), {"seed": options.seed, "inputs": total}, tuple(notes))
