"""What a second worker brings: seconds of one and of two workers with one thread each, taken in turns.

``computing``: from the moment when all workers are ready to the last unit, by worker processes and by a local Dask
cluster. ``whole``: a run from its beginning to its end, in a fresh process; one worker computes in that process itself.
"""

from __future__ import annotations

import importlib.util
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import leafflow_ti as lf
from leafflow_ti.executors.cluster_client import LOCAL, connected
from leafflow_ti.executors.processes import Processes
from leafflow_ti.plan import make_plan
from leafflow_ti.progress import Progress
from leafflow_ti.provenance import provenance
from leafflow_ti.run_store import create_store
from leafflow_ti.schedule import Schedule
from perf.cases import Options
from perf.figures import Figure, Outcome
from perf.fresh import fresh_run
from perf.sequence import write_images

SCALING = 1.7
"""Least that two workers must bring."""
WORKERS = (1, 2)


@dataclass(frozen=True)
class Settings:
    """Images of ``size`` by 9 cameras; the model is the default one, refined."""

    size: tuple[int, int] = (320, 240)
    frames: int = 40
    stride: int = 4
    repeats: int = 3

    def options(self, workers: int) -> dict[str, Any]:
        """Of a run, as keywords."""
        return {"preshift": (-14, 0), "stride": self.stride, "threads": 1, "workers": workers, "tile": self.size[1]}


def by_processes(capture: Path, out: Path, settings: Settings, workers: int) -> float:
    """Seconds that worker processes compute."""
    opened = lf.open_capture(capture)
    plan = make_plan(opened, lf.load_config(overrides=settings.options(workers)))
    store = create_store(out, plan, provenance(plan, opened), opened)
    with Processes(plan, opened, out, workers) as executor:
        executor.wait_for(workers)
        began = time.perf_counter()
        units = [unit.index for unit in plan.units()]
        executor.work(Schedule([units], lambda unit: None, workers, sum(plan.around)), store)
        return time.perf_counter() - began


def by_dask(capture: Path, out: Path, settings: Settings, workers: int) -> float:
    """The same of a local cluster, whose workers have compiled their kernels for a run before."""
    config = lf.load_config(overrides=settings.options(workers))
    states: list[Progress] = []
    with connected(LOCAL, config.plan) as client:
        for _ in range(2):
            lf.run(capture, out, config, overwrite=True, dask=client, progress=states.append)
    return states[-1].seconds


def whole(capture: Path, out: Path, settings: Settings, workers: int) -> float:
    """Seconds of a whole run, kernels compiled or loaded."""
    run = fresh_run(capture, out, settings.options(workers))
    return run.seconds + run.compile_seconds


WAYS: dict[str, Callable[[Path, Path, Settings, int], float]] = {
    "computing, processes": by_processes, "computing, Dask": by_dask, "whole run, processes": whole,
}  # fmt: skip


def measure(settings: Settings) -> Outcome:
    """All ways; a machine that others use, too, changes its pace, so that neighbours in time are compared."""
    figures, notes = list[Figure](), list[str]()
    with tempfile.TemporaryDirectory() as name:
        capture = write_images(Path(name) / "images", settings.size, settings.frames)
        for way, seconds_of in WAYS.items():
            if seconds_of is by_dask and importlib.util.find_spec("distributed") is None:
                notes.append("Dask: not installed")
                continue
            pairs = [
                [seconds_of(capture, Path(name) / f"{way}-{n}-{i}.zarr", settings, n) for n in WORKERS]
                for i in range(settings.repeats)
            ]
            for n, seconds in zip(WORKERS, zip(*pairs, strict=True), strict=True):
                figures.append(Figure(f"{way}: {n} worker{'s' * (n > 1)}", min(seconds), "s", note="least"))
            least = SCALING if way.startswith("computing") else None
            ratio = statistics.median(one / two for one, two in pairs)
            figures.append(Figure(f"{way}: two over one", ratio, "x", low=least, note="median of pairs"))
    return Outcome(tuple(figures), asdict(settings), tuple(notes))


def run(options: Options) -> Outcome:
    """The case; quick: few small frames, once."""
    return measure(Settings((120, 90), 14, 4, 1) if options.quick else Settings())
