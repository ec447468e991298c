"""``affine-scene-flow``, which measures every camera's own flow, against ``affine-4d`` on the same capture.

Both do the whole job, one frame from arrays in memory to maps, in turns, so that what else the machine does hits both.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import asdict, dataclass, field

from leafflow_ti.api import estimate
from perf.bench import Scene
from perf.cases import Options
from perf.figures import Figure, Outcome

MODELS = ("affine-4d", "affine-scene-flow")
GOAL = 4.0


@dataclass(frozen=True)
class Settings:
    """``repeats`` of each model and stride."""

    scene: Scene = field(default_factory=Scene)
    strides: tuple[int, ...] = (1, 4)
    repeats: int = 5


def measure(settings: Settings) -> Outcome:
    """Medians of both models, and their ratio."""
    capture = settings.scene.capture()
    figures = []
    for stride in settings.strides:
        options = {model: settings.scene.options(capture, model=model, stride=stride) for model in MODELS}
        pixels = 0
        for given in options.values():
            pixels = estimate(capture, **given).status.size  # compiles
        seconds: dict[str, list[float]] = {model: [] for model in MODELS}
        for _ in range(settings.repeats):
            for model, given in options.items():
                began = time.perf_counter()
                estimate(capture, **given)
                seconds[model].append(time.perf_counter() - began)
        medians = {model: statistics.median(found) for model, found in seconds.items()}
        figures += [
            Figure(f"{model}, stride {stride}", 1e6 * median / pixels, "us/px") for model, median in medians.items()
        ]
        ratio = medians["affine-scene-flow"] / medians["affine-4d"]
        figures.append(Figure(f"affine-scene-flow over affine-4d, stride {stride}", ratio, "x", GOAL))
    return Outcome(tuple(figures), asdict(settings))


def run(options: Options) -> Outcome:
    """The case; quick: a smaller output, two repetitions."""
    return measure(Settings(Scene(out_px=64), repeats=2) if options.quick else Settings())
