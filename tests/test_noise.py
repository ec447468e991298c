"""Error bars against repeated noise: do predicted covariances describe what really happens?"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import estimate_bench
import numpy as np
import pytest
from reference import chain
from reference.sequences import affine_sequence

import leafflow_ti as lf
from leafflow_ti.capture import capture_from_array
from leafflow_ti.models import MODELS, column_set
from leafflow_ti.stages.thresholds import DENOISE
from leafflow_ti.status import Status

SCENE = replace(
    estimate_bench.SCENE,
    noise=2.0,
    velocity=(0.01, -0.007, 0.0),
    omega=(0.0, 0.0, 0.0),
    acceleration=(0.0, 0.0, 0.0),
    wavelengths_mm=(0.8, 0.8),
    alpha=0.3,
    beta=0.3,
)
"""Nearly still, so that noise is all that disturbs; all its spatial frequencies are equally high, as ρ supposes."""

SEEDS = 40
PLACES = ((0, 0), (0, 1), (1, 0), (1, 1))
DISTANCE = 17  # px: windows of 11 and filters of 5 pixels do not overlap, so the places are independent samples


@functools.cache
def estimates(
    make_bench: Callable, model: str, estimator: str, light: tuple[str, str] = ("none", "none")
) -> tuple[list[str], np.ndarray, np.ndarray, np.ndarray]:
    """Over seeds and places: parameters [n, places, m], predicted standard deviations likewise, noise variances."""
    sampling = estimate_bench.sampling_of("line-x", True)
    columns = column_set(MODELS[model], light[0], sampling.camera_axes, sampling.sampled, light[1])
    names = [f"{axis}: {c.channel}{c.offset}" for axis in columns.solutions for c in columns.columns[: columns.n_flow]]
    halo = sampling.x.radius + sampling.x.filter_radius
    size = (DISTANCE + 1 + 2 * halo, DISTANCE + 1 + 2 * halo)
    found, predicted, variances = [], [], []
    for seed in range(SEEDS):
        images = estimate_bench.rendered(replace(SCENE, seed=seed), "line-x", size)
        bench = make_bench(images, sampling, columns, "f32", (2, 2), DISTANCE)
        result = bench.estimate(estimator=estimator)
        assert (result.status == Status.OK).all()
        std = []
        for place in PLACES:
            smooth, energy = bench.planes[-2, *place], bench.planes[-3, *place]
            cov = chain.covariances(
                bench.tensor(*place), result.variance[place], columns, sampling, smooth / energy, DENOISE[estimator]
            )
            _, cov = chain.at_centre(result.parameters[place].T, cov, columns)
            std.append(np.concatenate([np.sqrt(np.diag(cov[k, k])) for k in range(columns.n_time_like)]))
        found.append([result.parameters[place].ravel() for place in PLACES])
        predicted.append(std)
        variances.append([result.variance[place] for place in PLACES])
    return names, np.array(found), np.array(predicted), np.array(variances)


@pytest.mark.parametrize("estimator", ["ols", "tls-equilibrated"])
@pytest.mark.parametrize(
    ("model", "light"), [("affine", ("none", "none")), ("affine-4d", ("none", "none")), ("affine", ("spatial", "both"))]
)
def test_predicted_standard_deviations_are_the_empirical_ones(
    make_bench: Callable, model: str, estimator: str, light: tuple[str, str]
) -> None:
    """160 samples about 4 means know a standard deviation to 1 / sqrt(2 * 156) = 6 %, so .7 to 1.4 is five of these
    standard errors: that much more than chance is left to the approximations of the covariance. ρ is that of the
    gradient; of the image itself, which brightness is measured by, one more smoothing leaves nearly all, so that the
    errors of brightness are underrated by up to the square root of ρ, here .68."""
    names, found, predicted, _ = estimates(make_bench, model, estimator, light)
    empirical = np.sqrt(np.mean(np.var(found, axis=0, ddof=1), axis=0))
    ratio = np.sqrt(np.mean(predicted**2, axis=(0, 1))) / empirical
    lowest = [0.5 if ": i" in name else 0.7 for name in names]
    named = dict(zip(names, ratio.round(2).tolist(), strict=True))
    assert all(low <= r <= 1.4 for low, r in zip(lowest, ratio, strict=True)), named


@pytest.mark.parametrize("estimator", ["ols", "tls-equilibrated"])
def test_noise_variance_is_found(make_bench: Callable, estimator: str) -> None:
    """One window holds some hundred independent residuals, all of them ten thousand: 10 % is far above chance."""
    *_, variances = estimates(make_bench, "affine", estimator)
    assert variances.mean(axis=(0, 1)) == pytest.approx(SCENE.noise**2, rel=0.1)


@pytest.mark.parametrize("estimator", ["ols", "tls-equilibrated", "for3"])
def test_error_bars_where_windows_are_cut_off(estimator: str) -> None:
    """A quarter of the window is left at a corner, half at an edge. 40 samples of 4 neighbours know a standard
    deviation to some 11 %; at the edge, where the window is lopsided, bars are up to 30 % too large."""
    clean = affine_sequence(np.array([[0.3, 0.0, 0.0], [-0.2, 0.0, 0.0]]), 5, (44, 44), noise=0.0, seed=1)
    found = []
    for seed in range(40):
        images = clean + np.random.default_rng(seed).normal(0, 2, clean.shape)
        field = lf.estimate(
            capture_from_array(images), frame=2, model="flow-affine", estimator=estimator, window=21, size_time=1,
            border="clip", noise=2, precision="f64",
        )  # fmt: skip
        found.append((field["flow_x"] - 0.3) / field["flow_x_std"])
    spread = np.sqrt(np.mean(np.square(found), axis=0))
    middle = slice(18, 26)
    places = {"corner": spread[2:4, 2:4], "edge": spread[middle, 2:4], "inside": spread[middle, middle]}
    for place, value in places.items():
        assert 0.6 <= np.sqrt(np.nanmean(value**2)) <= 1.35, place


def test_error_bars_of_least_squares_hold_its_bias() -> None:
    """Noise of half the contrast pulls least squares to 0 by twice its scatter: without the bias in its error bars,
    errors are 2.4 of them. 12 images know the root mean square to 10 %, the bias is itself an estimate of 20 %."""
    scores = []
    for seed in range(12):
        flow = np.array([[0.5, 0.0, 0.0], [-0.4, 0.0, 0.0]])
        images = affine_sequence(flow, 5, (72, 72), wavelengths=(8.0, 30.0), noise=12.0, seed=seed)
        field = lf.estimate(
            capture_from_array(images), frame=2, model="flow", estimator="ols", window=45, stride=9, precision="f64"
        )
        for axis, true in (("x", 0.5), ("y", -0.4)):
            error, std = field[f"flow_{axis}"] - true, field[f"flow_{axis}_std"]
            scores.append((error / std)[np.isfinite(error)])
    assert 0.7 <= np.sqrt(np.mean(np.square(np.concatenate(scores)))) <= 1.4
