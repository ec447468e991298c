"""Seconds from the command to the first result: on an empty cache of compiled kernels, and in the next process.

The command is ``leafflow-ti run`` with its default model on a small simulated capture, one frame; every run is a
process of its own. The kernel cache is a temporary folder (``LEAFFLOW_TI_CACHE``).
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from leafflow_ti.errors import RunError
from leafflow_ti.results import ResultStore
from perf.cases import Options
from perf.figures import Figure, Outcome

EMPTY_GOAL_S, SECOND_GOAL_S = 30.0, 5.0
"""Compiling on an empty cache; from the command to the result on a full one."""


@dataclass(frozen=True)
class Settings:
    """A cube of 9 cameras and 9 frames: affine-scene-flow and its refinement, and ``without`` it. ``repeats``: warm
    processes."""

    size: str = "256x160"
    options: tuple[str, ...] = ("--frames", "4:5")
    without: tuple[str, ...] = ("--refine", "0")
    repeats: int = 3


@dataclass(frozen=True)
class Cost:
    """Seconds of a process: on the clock, and of CPU time, which other work on the machine does not lengthen."""

    wall: float
    cpu: float


def _children_cpu() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def command(arguments: list[str], cache: Path) -> Cost:
    """Run ``leafflow-ti`` as a process of its own. Raises RunError with its last line if it fails."""
    began, before = time.perf_counter(), _children_cpu()
    done = subprocess.run(
        [sys.executable, "-m", "leafflow_ti.cli.main", *arguments],
        env={**os.environ, "LEAFFLOW_TI_CACHE": str(cache)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    cost = Cost(time.perf_counter() - began, _children_cpu() - before)
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        raise RunError(f"leafflow-ti {arguments[0]} ended with code {done.returncode}: {' '.join(last)}")
    return cost


def _runs(capture: Path, cache: Path, repeats: int, options: tuple[str, ...]) -> tuple[list[Cost], list[float]]:
    """Cost, and seconds of compiling or loading, of a run on an empty cache and of ``repeats`` more."""
    costs, compiling = [], []
    for n in range(1 + repeats):
        out = cache.with_name(f"{cache.name}-{n}.zarr")
        costs.append(command(["run", str(capture), "-o", str(out), "--no-quicklook", "--quiet", *options], cache))
        compiling.append(float(ResultStore.open(out).attrs["timings"]["stages"]["compile"]))
    return costs, compiling


def measure(settings: Settings) -> Outcome:
    """First and second process, compile seconds apart."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        capture, cache = folder / "cube", folder / "kernels"
        command(["simulate", "cube", str(capture), "--size", settings.size], cache)
        costs, compiling = _runs(capture, cache, settings.repeats, settings.options)
        _, affine = _runs(capture, folder / "affine", settings.repeats, (*settings.options, *settings.without))
        size = sum(file.stat().st_size for file in cache.rglob("*") if file.is_file())
    first, *later = costs
    best = min(later, key=lambda cost: cost.wall)
    loading, affine_loading = min(compiling[1:]), min(affine[1:])
    figures = (
        Figure("empty cache: command to result", first.wall, "s", note=f"CPU {first.cpu:.1f} s"),
        Figure("empty cache: compiling", compiling[0], "s", EMPTY_GOAL_S, note=f"{affine[0]:.1f} s unrefined"),
        Figure(
            "second process: command to result", later[0].wall, "s", SECOND_GOAL_S, note=f"CPU {later[0].cpu:.1f} s"
        ),
        Figure(f"fastest of {len(later)}: loading kernels", loading, "s", note=f"{affine_loading:.1f} s unrefined"),
        Figure(
            f"fastest of {len(later)}: command to result", best.wall, "s", SECOND_GOAL_S, note=f"CPU {best.cpu:.1f} s"
        ),
        Figure("kernel cache", size / 2**20, "MiB"),
    )
    return Outcome(figures, asdict(settings), ("pictures are off; every other option is the default",))


def run(options: Options) -> Outcome:
    """The case; quick: one warm process."""
    return measure(Settings(repeats=1) if options.quick else Settings())
