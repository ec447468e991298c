"""The sinusoid of section 5.3: exact without noise; with it, beside the affine model and the Cramér-Rao bound."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.synthetic.bound import cramer_rao
from leafflow_ti.synthetic.plane import PlaneScene
from perf.cases import Options
from perf.dissertation import scenes
from perf.figures import Figure, Outcome
from perf.refinement.common import STANDARD, Pair, mean, measure

VECTORS = {"velocity": ("N", slice(3, 6)), "rotation": ("Omega", slice(6, 9))}
"""Stem of the maps -> symbol, and place among the unknowns."""
NOISE_FREE = {"velocity": 5e-5, "rotation": 2e-6}
GAIN = 1.5
"""How many times the error of the affine model is to be larger."""
EFFICIENCY = 1.2
"""Most that the error may be over the bound."""


@dataclass(frozen=True)
class Settings:
    """Every ``stride``-th pixel in the middle of the image; ``noise`` in grey values of a range of 100."""

    steps: int = 8
    thin: int = 2
    stride: int = 8
    noise: float = 2.5
    seeds: int = 20
    deformation: str = "auto"


def _measure(plane: PlaneScene, settings: Settings, precision: str) -> Pair:
    return measure(
        scenes.capture(plane, plane.seed), scenes.truth(plane), settings.steps, thin=settings.thin, preshift=(-14, 0),
        stride=settings.stride, roi=scenes.middle(plane), precision=precision, deformation=settings.deformation,
    )  # fmt: skip


def bound(plane: PlaneScene, settings: Settings, sigma: float | None) -> NDArray[Any]:
    """Root of the bound [15 or fewer] for each unknown, at the middle pixel; ``sigma``: weights as precision."""
    x, y = (n // 2 for n in plane.size)
    modes = {"none": 0, "strain": 3}.get(settings.deformation, 1)
    return np.asarray(
        plane.noise * np.sqrt(np.diag(cramer_rao(plane, x, y, STANDARD["window"], modes=modes, sigma=sigma)))
    )


def _noise_free(settings: Settings) -> list[Figure]:
    figures = []
    for precision in ("f64", "f32"):
        pair = _measure(scenes.sinusoid(windows=2), settings, precision)
        before, after = pair.angles("start"), pair.angles()
        figures += [
            Figure(
                f"AAE of {symbol}, noise free, {precision}", mean(after[name]), "deg", NOISE_FREE[name],
                note=f"affine {mean(before[name]):.3g}",
            )
            for name, (symbol, _) in VECTORS.items()
        ]  # fmt: skip
    return figures


def _noisy(settings: Settings) -> list[Figure]:
    plane = scenes.sinusoid(windows=2, noise=settings.noise)
    pairs = [
        _measure(scenes.sinusoid(windows=2, noise=settings.noise, seed=seed), settings, "f32")
        for seed in range(settings.seeds)
    ]
    unweighted, weighted = bound(plane, settings, None), bound(plane, settings, STANDARD["sigma"])
    figures = []
    for name, (symbol, part) in VECTORS.items():
        before, after = (mean(np.stack([pair.angles(which)[name] for pair in pairs])) for which in ("start", "refined"))
        parts = np.stack([[pair.error(f"{name}_{axis}") for axis in "xyz"] for pair in pairs])
        error = np.sqrt(mean(np.sum(parts**2, axis=1)))
        label = f"noise {settings.noise:g}"
        figures += [
            Figure(f"AAE of {symbol}, {label}", after, "deg", note=f"affine {before:.3g}"),
            Figure(f"AAE of {symbol}, {label}, affine over refined", before / after, "x", low=GAIN),
            Figure(
                f"error of {symbol} over its bound, {label}, pixels weighted", error / _length(weighted[part]), "x",
                EFFICIENCY,
            ),
            Figure(
                f"error of {symbol} over its bound, {label}, pixels alike", error / _length(unweighted[part]), "x",
                note="the window weights its pixels",
            ),
        ]  # fmt: skip
    return figures


def _length(errors: NDArray[Any]) -> float:
    return float(np.linalg.norm(errors))


def run(options: Options) -> Outcome:
    """The case; quick: two sequences."""
    settings = Settings(seeds=2) if options.quick else Settings()
    notes = (
        "bound: Cramér-Rao, exact model, texture unknown, all images; weighted: pixels known as well as the window "
        "weights them; alike: all of the window's pixels known equally",
    )
    return Outcome((*_noise_free(settings), *_noisy(settings)), asdict(settings), notes)
