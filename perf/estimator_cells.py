"""What it costs that the samples of a cell share a weight: the weighted estimators against their form sample by sample.

Both by the naive float64 twin, on the same window weights: cells of one pixel (stride 1) and blocks of pixels (with a
stride), with all camera and time samples in one cell. Differences are counted in standard errors of the parameters.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.filters import filter_set
from leafflow_ti.models import MODELS, column_set
from leafflow_ti.sampling import AxisSampling, Sampling, column_noise
from leafflow_ti.synthetic.plane import noise_scene, render
from perf.cases import Options
from perf.figures import Figure, Outcome

Array = NDArray[np.float64]
TWINS = Path(__file__).resolve().parents[1] / "tests"
"""Folder of the package ``reference``."""
DIVERGENCE = np.array([[0.3, 0.02, -0.01], [-0.2, 0.01, 0.02]])
"""Flow [px/frame] times (1, x, y)."""
PRESHIFT_PX = -14


@dataclass(frozen=True)
class Settings:
    """``windows``: size [px] and stride; the latter's blocks are as ``sampling.Blocks`` has them."""

    noises: tuple[float, ...] = (1.0, 2.5, 5.0)
    seeds: int = 4
    windows: tuple[tuple[int, int], ...] = ((31, 1), (37, 4))
    rounds: int = 8
    sigma: float = 2.5


def twins() -> tuple[ModuleType, ModuleType, ModuleType]:
    """The naive twins: of sequences, of the way to the parameters, of the weighted estimators."""
    if str(TWINS) not in sys.path:
        sys.path.append(str(TWINS))
    from reference import chain, estimators, sequences

    return sequences, chain, estimators


def _flow(sampling: Sampling, noise: float, seed: int) -> Array:
    side = 2 * (sampling.x.radius + sampling.x.filter_radius) + 1
    images: Array = twins()[0].affine_sequence(
        DIVERGENCE, 2 * sampling.t.radius + 1, (side, side), noise=noise, seed=seed
    )
    return images


def _cameras(sampling: Sampling, noise: float, seed: int) -> Array:
    """Preshifted images of a turning plane, each rendered with the principal point that takes the preshift off."""
    side = 2 * (sampling.x.radius + sampling.x.filter_radius) + 1
    scene = replace(noise_scene((side, side)), noise=noise, seed=seed, n_cols=2 * sampling.sx.radius + 1)
    x, y = scene.principal
    cameras = range(scene.n_cols)
    shifted = [replace(scene, principal_px=(x - PRESHIFT_PX * (c - scene.n_cols // 2), y)) for c in cameras]
    return np.concatenate([render(one, cameras=([0], [c])) for c, one in zip(cameras, shifted, strict=True)], axis=2)


SCENES: dict[str, tuple[str, Callable[[Sampling, float, int], Array]]] = {
    "flow-affine": ("diverging flow of .02 px/px", _flow),
    "affine-4d": ("turning plane, 9 cameras", _cameras),
}


def _sampling(model: str, size: int, stride: int) -> Sampling:
    pixel = AxisSampling.gaussian(filter_set("5"), size, 0.29 * size, stride)
    series = AxisSampling.gaussian(filter_set("5"), 5, 1.0)
    return Sampling(pixel, pixel, sx=series if model == "affine-4d" else AxisSampling(), t=series)


def _schemes(settings: Settings, noise: float) -> dict[str, Callable[[Any], Any]]:
    """The weighted estimators as functions of the cells; the penalty's scale fixed at a multiple of the noise."""
    estimators, rounds = twins()[2], settings.rounds
    fixed = estimators.Schedule(0.0, 1.0, estimators.Level(settings.sigma**2), 0, 0, rounds, noise**2)
    return {
        "sampson": lambda cells: estimators.sampson(cells, rounds),
        "fns": lambda cells: estimators.fns(cells, rounds),
        "for3": lambda cells: estimators.for3(cells, rounds),
        "robust-tls": lambda cells: estimators.robust_tls(cells, "lorentzian", fixed),
    }


def _differences(model: str, size: int, stride: int, settings: Settings) -> Iterator[tuple[str, Array, Array]]:
    """Scheme, and differences [n_flow, k] in standard errors to its exact form: of cells, of the unweighted fit."""
    _, chain, estimators = twins()
    sampling = _sampling(model, size, stride)
    columns = column_set(MODELS[model], "none", sampling.camera_axes, sampling.sampled)
    for noise in settings.noises:
        for seed in range(settings.seeds):
            images = SCENES[model][1](sampling, noise, seed)
            middle = (images.shape[4] // 2, images.shape[3] // 2)
            shared, exact = (
                estimators.Cells.at(images, sampling, columns, middle, exact=exact) for exact in (False, True)
            )
            plain = estimators.plain(shared, "tls-equilibrated").P
            variance = chain.noise_variance(shared.tensor, plain, columns, column_noise(sampling, columns))
            rho = chain.texture_smoothness(images, sampling, *middle)
            covariance = chain.covariances(shared.tensor, variance, columns, sampling, rho)
            errors = np.sqrt([np.diag(covariance[k, k]) for k in range(columns.n_time_like)]).T
            for name, scheme in _schemes(settings, noise).items():
                found = scheme(exact).P
                yield name, (scheme(shared).P - found) / errors, (plain - found) / errors


def _figures(model: str, size: int, stride: int, settings: Settings) -> Iterator[Figure]:
    found: dict[str, tuple[list[Array], list[Array]]] = {}
    for name, shared, plain in _differences(model, size, stride, settings):
        for values, new in zip(found.setdefault(name, ([], [])), (shared, plain), strict=True):
            values.append(new)
    blocks = _sampling(model, size, stride).x.blocked.step
    for name, (shared, plain) in found.items():
        label = f"{model}, cells of {blocks}x{blocks} px: {name}"
        note = f"rms; the fit without weights is off by {np.sqrt(np.mean(np.square(plain))):.2g}"
        yield Figure(label, float(np.sqrt(np.mean(np.square(shared)))), "standard errors", 0.1, note=note)
        yield Figure(label, float(np.max(np.abs(shared))), "standard errors", note="largest")


def run(options: Options) -> Outcome:
    """The case; quick: one noise, one sequence, flow alone."""
    settings = Settings((2.5,), seeds=1, windows=((19, 1), (19, 2))) if options.quick else Settings()
    models = ("flow-affine",) if options.quick else tuple(SCENES)
    figures = [f for m in models for size, stride in settings.windows for f in _figures(m, size, stride, settings)]
    return Outcome(tuple(figures), asdict(settings) | {m: SCENES[m][0] for m in models})
