"""What the refinement costs beside the affine stages, and whether it is proportional to images and samples.

The time of the refinement is that of the whole job with it, less that of the same job without, medians of turns.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from leafflow_ti.api import estimate
from leafflow_ti.capture import Capture
from perf.bench import Scene
from perf.cases import Options
from perf.figures import Figure, Outcome
from perf.refinement.common import STANDARD

GOAL = 1.0
LINEAR = 1.25
"""Most that a sample may cost at one abscissa over another."""

MARGIN_PX = 24
"""What motion, disparity beyond the preshift and filters add to half a window."""
FILTER_FRAMES = 4
"""Frames that the derivative filters add to the window in time."""


@dataclass(frozen=True)
class Settings:
    """The refined output has every ``stride``-th pixel; ``fine``: stride of what it is compared with."""

    scene: Scene = field(default_factory=Scene)
    steps: int = 3
    thin: int = 3
    stride: int = 16
    fine: int = 1
    cameras: tuple[int, ...] = (5, 9, 13)
    sizes_time: tuple[int, ...] = (3, 5, 7)
    windows: tuple[int, ...] = (33, 65, 97)
    repeats: int = 5


def _times(capture: Capture, jobs: dict[str, dict[str, Any]], repeats: int) -> dict[str, float]:
    """Median seconds of each job, in turns, so that what else the machine does hits all."""
    for options in jobs.values():
        estimate(capture, **options)  # compiles
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(repeats):
        for name, options in jobs.items():
            began = time.perf_counter()
            estimate(capture, **options)
            seconds[name].append(time.perf_counter() - began)
    return {name: statistics.median(found) for name, found in seconds.items()}


def _job(settings: Settings, scene: Scene, **options: Any) -> tuple[Capture, dict[str, Any]]:
    """The capture, and the options of the affine stages at the coarse stride; every sample lies inside the images."""
    wide = replace(scene, window=max(scene.window, options.pop("reach", 0)) + 2 * MARGIN_PX)
    capture = wide.capture()
    given = {"model": STANDARD["model"], "stride": settings.stride, "window": scene.window, **options}
    return capture, wide.options(capture, **given)


def _ratio(settings: Settings) -> Iterator[Figure]:
    """The refinement at a coarse stride beside all affine stages at a fine one."""
    steps, thin = settings.steps, settings.thin
    capture, coarse = _job(settings, settings.scene)
    jobs = {
        "fine": {**coarse, "stride": settings.fine},
        "coarse": coarse,
        "refined": {**coarse, "refine": steps, "thin": thin},
    }
    seconds = _times(capture, jobs, settings.repeats)
    alone = seconds["refined"] - seconds["coarse"]
    each = f"{1e3 * alone / _pixels(settings):.3g} ms per output pixel"
    label = f"{steps} steps at stride {settings.stride}, thinned by {thin}"
    yield Figure(f"affine stages, stride {settings.fine}", 1e3 * seconds["fine"], "ms")
    yield Figure(f"affine stages, stride {settings.stride}", 1e3 * seconds["coarse"], "ms")
    yield Figure(f"refinement, {label}", 1e3 * alone, "ms", note=each)
    yield Figure(f"refinement over affine stages at stride {settings.fine}", alone / seconds["fine"], "x", GOAL)


def _pixels(settings: Settings) -> int:
    return int((-(-settings.scene.out_px // settings.stride)) ** 2)


def _per_sample(settings: Settings, scene: Scene, window: int, **options: Any) -> float:
    """Nanoseconds of the refinement per sample of an image, step and output pixel."""
    capture, start = _job(settings, scene, reach=window, **options)
    refined = {**start, "refine": settings.steps, "thin": settings.thin, "refine_window": window}
    seconds = _times(capture, {"start": start, "refined": refined}, settings.repeats)
    samples = (window // 2 // settings.thin * 2 + 1) ** 2 * scene.cameras * scene.frames
    return 1e9 * (seconds["refined"] - seconds["start"]) / (samples * settings.steps * _pixels(settings))


def _linear(settings: Settings) -> Iterator[Figure]:
    """Cost of a sample against cameras, frames and the window's size."""
    base = settings.scene
    sweeps = {
        "cameras": {n: _per_sample(settings, replace(base, cameras=n), base.window) for n in settings.cameras},
        "frames": {
            n + FILTER_FRAMES: _per_sample(settings, replace(base, frames=n + FILTER_FRAMES), base.window, size_time=n)
            for n in settings.sizes_time
        },
        "pixels across the window": {n: _per_sample(settings, base, n) for n in settings.windows},
    }
    for name, found in sweeps.items():
        first, *_, last = found.values()
        note = ", ".join(f"{n}: {value:.3g} ns" for n, value in found.items())
        yield Figure(f"a sample at the most {name} over one at the least", last / first, "x", LINEAR, note=note)


def measure(settings: Settings) -> Outcome:
    """Cost beside the affine stages, and of a sample."""
    return Outcome((*_ratio(settings), *_linear(settings)), asdict(settings))


def run(options: Options) -> Outcome:
    """The case; quick: a smaller output, two repetitions."""
    return measure(Settings(Scene(out_px=64), repeats=2) if options.quick else Settings())
