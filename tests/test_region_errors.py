"""Standard errors of means over regions: against noise realisations, double sums, and exact weights."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flat_leaf import (
    DEPTH,
    F_PX,
    LEAF,
    PRINCIPAL,
    SIZE,
    X,
    Y,
    attributes,
    label_image,
    leaf_maps,
    write_store,
)  # fmt: skip
from numpy.typing import NDArray

from leafflow_ti.correlation import NoiseCorrelation
from leafflow_ti.deformation import Gauge
from leafflow_ti.field import CORRELATIONS, Field, with_std
from leafflow_ti.region_divergence import Adjoint, differenced, fitted
from leafflow_ti.region_noise import RegionNoise, mean_variance
from leafflow_ti.region_rows import certain
from leafflow_ti.region_table import over_frames
from leafflow_ti.regions import measure_regions
from leafflow_ti.results import ResultStore
from leafflow_ti.surface_growth import strain_of


def correlated_noise(kernels: tuple[NDArray[Any], NDArray[Any]], n: int, seed: int = 0) -> NDArray[np.float64]:
    """Fields [n, y, x] of white noise filtered along y and x, of variance 1."""
    ky, kx = (k / np.linalg.norm(k) for k in kernels)
    rng = np.random.default_rng(seed)
    white = rng.normal(size=(n, Y.size + ky.size - 1, X.size + kx.size - 1))
    for axis, kernel in ((1, ky), (2, kx)):
        white = np.apply_along_axis(np.convolve, axis, white, kernel, "valid")
    return white


def autocorrelation(kernel: NDArray[Any]) -> NDArray[np.float64]:
    found = np.correlate(kernel, kernel, "full")[kernel.size - 1 :]
    return np.asarray(found / found[0])


WINDOW = np.exp(-0.5 * (np.arange(-9, 10) / 3.0) ** 2)
RAMP = WINDOW * np.arange(-9, 10)


def noise_of_windows(**options: Any) -> RegionNoise:
    value, gradient = autocorrelation(WINDOW), autocorrelation(RAMP)
    return RegionNoise((value, value), (gradient, gradient), np.ones(1), refined=True, **options)


def calibration(errors: NDArray[Any], predicted: list[float]) -> float:
    """Standard deviation of (estimate - truth) / standard error over the realisations."""
    return float(np.std(errors / np.array(predicted)))


@pytest.mark.parametrize("name", ["depth", "velocity_x", "slope_x", "slope_y", "rotation_z", "growth_rate"])
@pytest.mark.parametrize("region", ["leaf", "whole", "few"])
def test_errors_of_means_are_those_of_the_noise(name: str, region: str) -> None:
    """Noise as windows make it: means of it (depth), differences along an axis (slopes), or both (growth)."""
    n = 300
    kernels = {"slope_x": [(WINDOW, RAMP)], "slope_y": [(RAMP, WINDOW)]}.get(name, [(WINDOW, WINDOW)])
    if name in ("rotation_z", "growth_rate"):
        kernels = [(WINDOW, RAMP), (RAMP, WINDOW)]
    noise = sum(correlated_noise(pair, n, seed) for seed, pair in enumerate(kernels)) / np.sqrt(len(kernels))
    y, x = np.indices((Y.size, X.size))
    mask = {"leaf": np.hypot((y - 15) / 9, (x - 20) / 14) < 1, "whole": y >= 0, "few": (y < 4) & (x < 5)}[region]
    std = 0.5 + x / X.size  # pixels are not equally sure
    weights = np.where(mask, 1 + 0.3 * np.sin(x), 0.0)
    weights /= weights.sum()
    terms = noise_of_windows().terms(name, {})
    predicted = np.sqrt(mean_variance(weights, std, terms))
    found = calibration((noise * std * weights).sum(axis=(1, 2)), [predicted] * n)
    assert 0.85 < found < 1.17  # of 300 realisations: 4 % by chance; the rest is that errors vary over the region


def naive_variance(weights: NDArray[Any], std: NDArray[Any], r: NDArray[Any]) -> float:
    """Pixel by pixel."""
    at = np.argwhere(weights != 0)
    total = 0.0
    for i in at:
        for j in at:
            dy, dx = np.abs(i - j)
            if dy < r.size and dx < r.size:
                total += weights[tuple(i)] * std[tuple(i)] * weights[tuple(j)] * std[tuple(j)] * r[dy] * r[dx]
    return float(total)


def test_variance_of_a_mean_against_its_double_sum() -> None:
    rng = np.random.default_rng(3)
    weights = np.where(rng.random((7, 9)) < 0.7, rng.random((7, 9)), 0.0)
    std = np.where(weights > 0, rng.random((7, 9)), np.nan)  # what does not count may have no error
    r = autocorrelation(WINDOW)[::3]
    (term,) = RegionNoise((r, r), None, np.ones(1), True).terms("depth", {})
    np.testing.assert_allclose(mean_variance(weights, std, (term,)), naive_variance(weights, np.nan_to_num(std), r))


MOVING = (*with_std(("depth", "slope_x", "slope_y", "velocity_x", "velocity_y", "velocity_z", "growth_rate",
                     "area_rate")), *CORRELATIONS)  # fmt: skip


def noisy_motion(seed: int) -> Mapping[str, NDArray[Any]]:
    """Maps of a slanted plane at rest, with noise of the motion as windows make it, and growth that follows from it."""
    zx, zy = 0.6, -0.5
    rx, ry = np.meshgrid((X - PRINCIPAL[0]) / F_PX, (Y - PRINCIPAL[1]) / F_PX)
    rays = np.stack([rx, ry, np.ones_like(rx)], -1)
    one, two, three = (correlated_noise((WINDOW, WINDOW), 1, 3 * seed + k)[0] for k in range(3))
    sigma = np.array([0.004, 0.004, 0.02])
    m = np.stack([one, two, 0.6 * one + 0.8 * three], -1) * sigma  # across the line of sight, and approach
    covariance = np.diag(sigma**2)
    covariance[0, 2] = covariance[2, 0] = 0.6 * sigma[0] * sigma[2]
    to_n = np.broadcast_to(np.eye(3), (*rx.shape, 3, 3)).copy()
    to_n[..., :2, 2] = rays[..., :2]
    c = to_n @ covariance @ np.swapaxes(to_n, -1, -2)
    n, std = np.einsum("...ij,...j->...i", to_n, m), np.sqrt(np.einsum("...ii->...i", c))
    found: dict[str, NDArray[Any]] = {name: np.full(rx.shape, 1e-3) for name in MOVING}
    found |= {"depth": DEPTH / (1 - zx * rx - zy * ry), "slope_x": np.full(rx.shape, zx),
              "slope_y": np.full(rx.shape, zy)}  # fmt: skip
    for k, axis in enumerate("xyz"):
        found[f"velocity_{axis}"], found[f"velocity_{axis}_std"] = n[..., k], std[..., k]
    for name, (i, j) in zip(CORRELATIONS, ((0, 1), (0, 2), (1, 2)), strict=True):
        found[name] = c[..., i, j] / (std[..., i] * std[..., j])
    return found


def run_attributes(gauge: Gauge) -> dict[str, Any]:
    """As of a run with the windows ``WINDOW`` [output pixels], 4 px apart."""
    r, gradient = (np.repeat(autocorrelation(k), 4).tolist() for k in (WINDOW, RAMP))
    plan = attributes()["plan"] | {"noise_correlation": {"x": r, "y": r, "x_gradient": gradient, "y_gradient": gradient,
                                                         "t": [1.0]}}  # fmt: skip
    return attributes(refined=False) | {"plan": plan, "growth": {"strain_window_px": gauge.side, "average_frames": 1}}


@pytest.fixture(scope="module")
def still_plane(tmp_path_factory: pytest.TempPathFactory) -> ResultStore:
    """Thirty frames of a plane at rest, each with its own noise, and growth as it follows from the motion."""
    gauge = Gauge.of(29, 4)
    noise = NoiseCorrelation(autocorrelation(WINDOW), autocorrelation(WINDOW), np.ones(1))

    def maps(t: int) -> Mapping[str, NDArray[Any]]:
        found = dict(noisy_motion(t))
        as_f4 = {name: values.astype(np.float32) for name, values in found.items()}
        field = Field(as_f4, np.zeros((Y.size, X.size), np.uint8), Y, X, t, run_attributes(gauge))
        strain = strain_of(field, gauge, noise).maps()
        return found | {name: strain[name] for name in ("area_rate", "area_rate_std")}

    path = tmp_path_factory.mktemp("still") / "out.zarr"
    return write_store(path, MOVING, maps, frames=range(30), attrs=run_attributes(gauge))


@pytest.mark.parametrize("region", ["inside", "at the border"])
def test_errors_of_mean_growth_from_the_motion(region: str, still_plane: ResultStore) -> None:
    """(Estimate - truth) / standard error over thirty noise realisations, of fits that overlap much."""
    image = np.zeros(SIZE[::-1], int)
    image[(slice(30, 90), slice(40, 120)) if region == "inside" else (slice(0, 80), slice(0, 90))] = 1
    rows = measure_regions(still_plane, image, still=True).of(1)
    pull = rows["area_rate_percent_per_frame"] / rows["area_rate_se_percent_per_frame"]
    assert 0.75 < np.std(pull) < 1.3  # 13 % by chance
    # As values that do not cancel, errors would be as large as this:
    assert rows["area_rate_se_percent_per_frame"].mean() < 0.5 * rows["area_rate_sd_percent_per_frame"].mean()


@pytest.mark.parametrize("adjoint", [differenced, fitted((2, 3))])
def test_weights_of_velocities_are_those_of_their_derivatives(adjoint: Adjoint) -> None:
    """``Σ along · D v = Σ adjoint(along) v`` for derivatives by hand, pixel by pixel, with gaps."""
    rng = np.random.default_rng(5)
    known = rng.random((8, 9)) < 0.8
    values, along_x, along_y = rng.normal(size=(3, 8, 9))
    along_x, along_y = (np.where(known, along, 0.0) for along in (along_x, along_y))
    total = 0.0
    for y, x in np.argwhere(known):
        if adjoint is differenced:
            slopes = []
            for dy, dx in ((0, 1), (1, 0)):
                ends = [(y + s * dy, x + s * dx) for s in (-1, 1)]
                ends = [e if 0 <= e[0] < 8 and 0 <= e[1] < 9 and known[e] else (y, x) for e in ends]
                span = sum(abs(ends[1][k] - ends[0][k]) for k in (0, 1))
                slopes.append((values[ends[1]] - values[ends[0]]) / span if span else 0.0)
        else:
            at = [(i, j) for i, j in np.argwhere(known) if abs(i - y) <= 2 and abs(j - x) <= 3]
            plane = np.array([[1, j, i] for i, j in at])
            slopes = np.linalg.lstsq(plane, np.array([values[i, j] for i, j in at]))[0][1:]
        total += along_x[y, x] * slopes[0] + along_y[y, x] * slopes[1]
    np.testing.assert_allclose((adjoint(along_x, along_y, known) * values).sum(), total, rtol=1e-9)


def test_old_stores_count_errors_as_the_same_throughout_a_window(tmp_path: Path) -> None:
    attrs = attributes()
    del attrs["plan"]["noise_correlation"]
    store = write_store(tmp_path / "o.zarr", LEAF, leaf_maps(), attrs=attrs)
    table = measure_regions(store, label_image())
    assert "does not state how errors hang together" in table.notes[0]
    np.testing.assert_allclose(table.of(1)["growth_se_percent_per_frame"], 0.02, rtol=1e-5)  # the pixel's own


def test_pixels_as_good_as_the_median_count_alike() -> None:
    weights = certain(np.array([[1.0, 2.0, 2.0], [4.0, np.nan, np.inf]]))
    assert weights == pytest.approx(np.array([[1.0, 1.0, 1.0], [0.25, 0.0, 0.0]]))
    assert not certain(np.full((2, 2), np.nan)).any()


def test_means_over_frames_know_what_frames_share() -> None:
    rng = np.random.default_rng(0)
    kernel = np.array([1.0, 0.5, -0.5])
    series = np.apply_along_axis(np.convolve, 1, rng.normal(size=(2000, 14)), kernel / np.linalg.norm(kernel), "valid")
    errors = np.full(12, 0.3)
    errors[4] = np.nan  # a frame in which the region was not seen
    found = [over_frames(np.where(errors > 0, 0.3 * s, np.nan), errors, tuple(autocorrelation(kernel))) for s in series]
    pulls = [mean / se for mean, se in found]
    assert 0.95 < np.std(pulls) < 1.05
    assert np.isnan(over_frames(np.full(3, np.nan), np.ones(3), (1.0,))).all()
