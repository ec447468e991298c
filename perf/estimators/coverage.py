"""Whether error bars are true: the shares of the errors within one and two of them, by estimator, model and noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from leafflow_ti.api import estimate
from leafflow_ti.errors import RunError
from leafflow_ti.field import Field
from leafflow_ti.metrics import Coverage, coverage
from leafflow_ti.synthetic.plane import PlaneScene, noise_scene
from perf.cases import Options
from perf.curves import Curves, draw_curves
from perf.dissertation import scenes
from perf.estimators.patterns import AffineFlow, Array, Scene
from perf.estimators.patterns import measure as measure_flow
from perf.figures import Figure, Outcome
from perf.refinement.common import true_maps
from perf.refinement.coverage import MARGIN_PX

NORMAL = {"within_1": 0.683, "within_2": 0.954}
"""Shares of normal errors."""
POINTS = 0.05
"""By how much a share may differ from that of normal errors, as a goal."""
FLOW = AffineFlow((0.6, -0.4), ((0.004, -0.006), (0.006, 0.002)))
Measured = Iterator[tuple[Field, Mapping[str, Array]]]


@dataclass(frozen=True)
class Settings:
    """Windows of ``flow_px`` and ``plane_px`` pixels, two σ apart, ``across`` squared, over ``seeds`` of every noise
    [grey values]."""

    estimators: tuple[str, ...] = ("ols", "tls-equilibrated", "for3")
    noises: tuple[float, ...] = (0.5, 1.0, 2.5, 5.0, 10.0)
    across: int = 4
    seeds: int = 20
    flow_px: int = 33
    plane_px: int = 65

    def apart(self, window: int) -> int:
        """Distance of the evaluated pixels, two σ of the window."""
        return 2 * round(19 / 65 * window)


def flows(settings: Settings, estimator: str, noise: float) -> Measured:
    """Affine flow of one camera, and its truth."""
    step = settings.apart(settings.flow_px)
    side = (settings.across - 1) * step + 1
    scene = Scene(FLOW, size=side + settings.flow_px + 9, noise=noise)
    first = (scene.size - side) // 2
    roi = (first, first, first + side, first + side)
    for seed in range(settings.seeds):
        field = measure_flow(
            replace(scene, seed=seed).images(), model="flow-affine", estimator=estimator, window=settings.flow_px,
            stride=step, roi=roi,
        )  # fmt: skip
        true = scene.truth[np.ix_(field.y, field.x)]
        yield field, {"flow_x": true[..., 0], "flow_y": true[..., 1]}


def planes(settings: Settings, estimator: str, noise: float) -> Measured:
    """A turning plane before nine cameras, affine model in 4D."""
    step = settings.apart(settings.plane_px)
    side = (settings.across - 1) * step + 1
    across = side + 2 * MARGIN_PX
    scene: PlaneScene = replace(noise_scene((across + 8 * 14, across)), noise=noise)
    x, y = ((n - side) // 2 for n in scene.size)
    view: dict[str, Any] = {"preshift": (-14, 0), "roi": (x, y, x + side, y + side), "stride": step, "refine": 0}
    for seed in range(settings.seeds):
        field = estimate(
            scenes.capture(scene, seed), model="affine-4d", motion="rotation", estimator=estimator,
            window=settings.plane_px, **view,
        )  # fmt: skip
        yield field, true_maps(scenes.truth(scene), field.y, field.x)


MODELS = {"flow-affine": flows, "affine-4d": planes}


def covered(measured: Measured) -> dict[str, Coverage]:
    """Coverage of every map that has an error bar and a truth. Raises RunError if one has no finite value at all."""
    errors: dict[str, list[Array]] = {}
    for field, true in measured:
        for name in true:
            if f"{name}_std" in field:
                errors.setdefault(name, []).append(np.stack([field[name], true[name], field[f"{name}_std"]]))
    found = {name: coverage(*np.concatenate(parts, axis=1)) for name, parts in errors.items()}
    missing = [name for name, spread in found.items() if spread is None]
    if missing or not found:
        raise RunError(f"{', '.join(missing) or 'no map'}: no pixel has a value and an error bar")
    return {name: spread for name, spread in found.items() if spread}


def _figures(label: str, shares: Mapping[str, Coverage]) -> list[Figure]:
    """The share of the map that is farthest from that of normal errors."""
    figures = []
    for which, normal in NORMAL.items():
        values = {name: getattr(spread, which) for name, spread in shares.items()}
        name = max(values, key=lambda key: abs(values[key] - normal))
        spread = shares[name]
        note = f"{name}, scatter over error bar {spread.std:.2f}, n = {spread.n}"
        note += f"; mean of all maps {_mean(shares, which):.3f}"
        text = f"{label}: share within {which[-1]} error bars, farthest map"
        figures.append(Figure(text, values[name], "", min(1.0, normal + POINTS), low=normal - POINTS, note=note))
    return figures


def _mean(shares: Mapping[str, Coverage], which: str) -> float:
    """Mean share of all maps."""
    return float(np.mean([getattr(spread, which) for spread in shares.values()]))


def run_settings(settings: Settings, out: Path) -> Outcome:
    """All models, estimators and noises."""
    figures, panels = [], []
    for model, measured in MODELS.items():
        within: dict[str, list[float]] = {}
        for estimator in settings.estimators:
            for noise in settings.noises:
                shares = covered(measured(settings, estimator, noise))
                figures += _figures(f"{model}, {estimator}, noise {noise:g}", shares)
                for which in NORMAL:
                    within.setdefault(f"{estimator}, {which[-1]} std", []).append(_mean(shares, which))
        panels.append(
            Curves(
                model, "noise [grey values]", "share of the errors", settings.noises, within, True, limits=(0.0, 1.0)
            )
        )
    return Outcome(tuple(figures), asdict(settings), (), (draw_curves(out / "estimators-coverage.png", panels),))


def run(options: Options) -> Outcome:
    """The case; quick: one estimator and noise, two sequences of four windows."""
    quick = Settings(("tls-equilibrated",), (2.5,), across=2, seeds=2)
    return run_settings(quick if options.quick else Settings(), options.out)
