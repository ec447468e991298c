"""Ctrl-C at moments spread over every command: how long until it has ended, with which words, and what is left behind.

Each trial is a process group of its own that gets SIGINT, as a terminal sends it. Silent are those that were hit while
the engine compiled, when no Python runs (see ``leafflow_ti.stopping``), or before the program had begun.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile

from leafflow_ti.errors import LeafflowError, RunError
from leafflow_ti.results import ResultStore
from perf.cases import Options
from perf.cold_start import command as run_command
from perf.figures import Figure, Outcome

GOAL_S = 2.0
EARLIEST_S = 0.1
"""Before the first moment: Python's own start."""
TRACEBACK_LINES = 12
"""Of a traceback, for the report."""
LONGEST_S = 60.0
"""A process that has not ended so long after the signal is killed."""


@dataclass(frozen=True)
class Settings:
    """The capture, and how many ``moments`` each command is interrupted at."""

    size: str = "240x160"
    frames: str = "11"
    large: str = "800x600"
    moments: int = 12


@dataclass(frozen=True)
class Command:
    """One command line: words with ``{}`` names of the files of ``Stage``. ``cold``: on an empty kernel cache;
    ``keeps``: a results store that it changes, copied for each trial."""

    name: str
    words: str
    cold: bool = False
    keeps: bool = False


COMMANDS = (
    Command("run, empty kernel cache", "run {capture} -o {out}.zarr", cold=True),
    Command("run", "run {capture} -o {out}.zarr"),
    Command("run --workers 2", "run {capture} -o {out}.zarr --workers 2 --refine 0"),
    Command("run, large images", "run {large} -o {out}.zarr --frames 4:5 --no-quicklook"),
    Command("growth", "growth {store}", keeps=True),
    Command("track", "track {store} -o {out}.csv"),
    Command("regions", "regions {store} --labels {labels} -o {out}.csv"),
    Command("export", "export {store} --to vtk -o {out}-vtk"),
    Command("report", "report {store} -o {out}.html"),
    Command("evaluate", "evaluate {store} --truth {capture}/truth.npz"),
    Command("simulate", "simulate cube {out} --size 400x300"),
    Command("check", "check {capture}"),
    Command("profile", "profile {capture}"),
    Command("demo", "demo {out}"),
)


@dataclass(frozen=True)
class Answer:
    """How one process took the signal. ``seconds``: from it to the end; None: it had ended before."""

    seconds: float | None
    code: int
    text: str

    @property
    def kind(self) -> str:
        """``in time``: it had ended before; ``said``: with one line; ``silent``; or what was wrong."""
        last = self.text.strip().splitlines()[-1:] or [""]
        if "Traceback" in self.text:
            return f"traceback: {' | '.join(self.text.strip().splitlines()[-TRACEBACK_LINES:])}"
        if self.seconds is None or self.code == 0:
            return "in time" if self.code == 0 else f"failed by itself: {last[0]}"
        if self.code == 130 and last[0].startswith("error: interrupted"):
            return "said"
        return "silent" if self.code == -signal.SIGINT else f"exit code {self.code}: {last[0]}"


def interrupted(words: list[str], cache: Path, moment: float, number: signal.Signals = signal.SIGINT) -> Answer:
    """Start ``leafflow-ti``, send the signal after ``moment`` seconds, wait for the end."""
    process = subprocess.Popen(
        [sys.executable, "-m", "leafflow_ti.cli.main", *words], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        text=True, env={**os.environ, "LEAFFLOW_TI_CACHE": str(cache)}, start_new_session=True,
    )  # fmt: skip
    try:
        return Answer(None, *_ended(process, moment))
    except subprocess.TimeoutExpired:
        began = time.perf_counter()
        os.killpg(process.pid, number)
    with contextlib.suppress(subprocess.TimeoutExpired):
        code, text = _ended(process, LONGEST_S)
        return Answer(time.perf_counter() - began, code, text)
    os.killpg(process.pid, signal.SIGKILL)
    return Answer(LONGEST_S, *_ended(process, LONGEST_S))


def _ended(process: subprocess.Popen[str], seconds: float) -> tuple[int, str]:
    _, text = process.communicate(timeout=seconds)
    return process.returncode, text


class Stage:
    """The inputs of all commands in a folder, and a place for what each trial writes."""

    def __init__(self, folder: Path, settings: Settings) -> None:
        self.cache, self._trials = folder / "kernels", folder / "trials"
        self._names = {"capture": folder / "cube", "store": folder / "cube.zarr", "labels": folder / "labels.tif",
                       "large": folder / "large"}  # fmt: skip
        for name, size, frames in (("capture", settings.size, settings.frames), ("large", settings.large, "9")):
            run_command(["simulate", "cube", str(self._names[name]), "--size", size, "--frames", frames], self.cache)
        run_command(["run", str(self._names["capture"]), "-o", str(self._names["store"]), "--quiet"], self.cache)
        run_command(["growth", str(self._names["store"])], self.cache)
        width, height = (int(n) for n in settings.size.split("x"))
        labels = np.repeat(np.array([[1, 2]], np.uint8), width // 2, axis=1).repeat(height, axis=0)
        tifffile.imwrite(self._names["labels"], labels)

    @contextlib.contextmanager
    def trial(self, command: Command) -> Iterator[tuple[list[str], Path, Path]]:
        """Words, kernel cache and folder of one trial, all removed afterwards."""
        names = {**self._names, "out": self._trials / "out"}
        cache = self._trials / "kernels" if command.cold else self.cache
        self._trials.mkdir()
        if command.keeps:
            names["store"] = self._trials / "kept.zarr"
            shutil.copytree(self._names["store"], names["store"])
        try:
            yield [word.format_map(names) for word in command.words.split()], cache, self._trials
        finally:
            shutil.rmtree(self._trials)


def faults_of(folder: Path, whole: dict[str, str]) -> list[str]:
    """What an interrupted command must not leave: stores that do not open, files that an undisturbed one does not
    write, or that are cut off. ``whole``: the files of an undisturbed one, and their contents."""
    found = []
    for store in folder.rglob("*.zarr"):
        try:
            ResultStore.open(store)
        except (LeafflowError, OSError, ValueError) as error:
            found.append(f"{store.name} does not open: {error}")
    for name, contents in contents_of(folder).items():
        if whole.get(name) is None:
            found.append(f"left behind: {name}")
        elif whole[name] != contents and not name.endswith(".html"):  # a page says when it was made
            found.append(f"cut off: {name}")
    return found


def contents_of(folder: Path) -> dict[str, str]:
    """Files below a folder, but for those of stores and of the engine, and their checksums; those of a store that is
    being made or removed stand for it."""
    found = {}
    for path in sorted(folder.rglob("*")):
        parts = path.relative_to(folder).parts
        if path.is_file() and not any(part.endswith(".zarr") or part == "kernels" for part in parts):
            name = "/".join(part for part in parts)
            hidden = next((part for part in parts if part.startswith(".") and ".zarr." in part), None)
            found[hidden or name] = "" if hidden else hashlib.sha256(path.read_bytes()).hexdigest()
    return {name: text for name, text in found.items() if text}


def measure(stage: Stage, command: Command, moments: int, rng: np.random.Generator) -> tuple[Figure, list[str]]:
    """Interrupt one command at moments spread evenly over its time, each shifted by chance; faults as lines."""
    with stage.trial(command) as (words, cache, folder):
        began = time.perf_counter()
        undisturbed = interrupted(words, cache, 600.0)
        length = time.perf_counter() - began
        if undisturbed.code:
            raise RunError(f"leafflow-ti {' '.join(words)} failed: {undisturbed.text.strip()}")
        whole = contents_of(folder)
    answers, faults = [], []
    for share in (np.arange(moments) + rng.random(moments)) / moments:
        moment = EARLIEST_S + float(share) * (length - EARLIEST_S)
        with stage.trial(command) as (words, cache, folder):
            answers.append(interrupted(words, cache, moment))
            bad = faults_of(folder, whole)
        if answers[-1].kind not in ("in time", "said", "silent"):
            bad.append(answers[-1].kind)
        faults += [f"{command.name} at {moment:.2f} of {length:.2f} s: {fault}" for fault in bad]
    kinds = [answer.kind for answer in answers]
    note = f"of {length:.1f} s; said {kinds.count('said')}, silent {kinds.count('silent')}, " \
           f"ended before {kinds.count('in time')}"  # fmt: skip
    worst = max((answer.seconds for answer in answers if answer.seconds is not None), default=0.0)
    return Figure(command.name, worst, "s", GOAL_S, note=note), faults


def run(options: Options) -> Outcome:
    """The case; quick: three moments. ``options.count``: so many."""
    settings = Settings(moments=options.count or (3 if options.quick else Settings.moments))
    rng = np.random.default_rng(options.seed)
    with tempfile.TemporaryDirectory() as name:
        stage = Stage(Path(name), settings)
        found = [measure(stage, command, settings.moments, rng) for command in COMMANDS]
    faults = [fault for _, bad in found for fault in bad]
    figures = (*(figure for figure, _ in found), Figure("faults", len(faults), "", 0))
    return Outcome(figures, {"moments": settings.moments, "seed": options.seed}, tuple(faults))
