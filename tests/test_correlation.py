"""Correlations of the velocity's errors: what a run states against random noise, and what a store gives back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import leafflow_ti as lf
from leafflow_ti.api import plan_run
from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.config import load_config
from leafflow_ti.correlation import (
    KEY,
    USUAL_FRAMES,
    NoiseCorrelation,
    slope_weights,
    stated_correlation,
    velocity_covariance,
)
from leafflow_ti.errors import InputError
from leafflow_ti.field import CORRELATIONS, coarsened
from leafflow_ti.plan import Plan
from leafflow_ti.results import ResultStore
from leafflow_ti.splines import filter_radius, filter_taps, spline, support
from leafflow_ti.synthetic.plane import noise_scene, render

WIDTH, HEIGHT = 120, 56
SCENE = replace(
    noise_scene((WIDTH, HEIGHT)), n_cols=3, n_frames=9, zx=0.3, zy=-0.2, principal_px=(400.0, -100.0)
)  # fmt: skip
GEOMETRY = Geometry(SCENE.f_px, (400.0, -100.0), SCENE.baseline_mm)
NOISE = 2.5


def capture_of(images: np.ndarray) -> lf.Capture:
    return capture_from_array(images.astype(np.float32), GEOMETRY)


def plan(**options: Any) -> Plan:
    wanted = {"window": 33, "preshift": (-14, 0), "noise": NOISE, **options}
    return plan_run(capture_of(np.zeros((9, 1, 3, HEIGHT, WIDTH))), load_config(overrides=wanted))


def test_refined_windows_share_what_their_samples_do() -> None:
    """White noise, filtered and interpolated at positions anywhere between the pixels, under windows side by side.

    4000 of them know a correlation to .016. The gradient of the texture is taken as slow beside the noise.
    """
    refine = plan(window=33, thin=3).refine
    assert refine is not None
    rng, n, half, degree = np.random.default_rng(0), 4000, refine.across // 2, refine.degree
    radius, reach = filter_radius(degree), support(degree)
    length = 2 * (half * refine.thin + reach + radius) + 24
    noise = rng.normal(size=(n, length))
    coefficients = np.apply_along_axis(np.convolve, 1, noise, filter_taps(degree), "same")
    shift = rng.uniform(size=(n, 1))  # the warp of a window, the same for its neighbours
    offsets = refine.thin * np.arange(-half, half + 1)
    weights = np.exp(-0.5 * (offsets / refine.sigma) ** 2)

    def error(centre: int) -> np.ndarray:
        total = np.zeros(n)
        for offset, weight in zip(offsets, weights, strict=True):
            at = centre + offset
            basis = [spline(shift[:, 0] - k, degree) * coefficients[:, at + k] for k in range(-reach, reach + 2)]
            total += weight * np.sum(basis, axis=0)
        return total

    middle = length // 2 - 10
    stated = stated_correlation(plan(window=33, thin=3))["x"]
    first = error(middle)
    for distance in (1, 2, 3, 4, 6, 9, 12, 18):
        found = np.corrcoef(first, error(middle + distance))[0, 1]
        assert found == pytest.approx(stated[distance], abs=0.06), distance


def test_slopes_over_frames_are_those_of_a_regression() -> None:
    for frames, accelerated in (((-3.0, -1.5, 0.0, 2.0, 3.0), True), ((-1.0, 0.0, 1.0, 2.0), False)):
        degree = 2 if accelerated else 1
        basis = [np.polyfit(frames, one, degree)[-2] for one in np.eye(len(frames))]
        np.testing.assert_allclose(slope_weights(frames, accelerated), basis, atol=1e-12)


def test_near_frames_agree_and_far_ones_oppose() -> None:
    """Nine frames about their middle: weights -4..4, R(1) = 40/60. Without refinement the filters decide."""
    along = stated_correlation(plan())["t"]
    assert along[:2] == [1.0, pytest.approx(40 / 60, abs=1e-4)]
    assert min(along) < -0.3
    assert len(along) == 9
    response = plan(refine=0).problem.sampling.t.response(True, 0)
    wanted = [float(np.dot(response[d:], response[: response.size - d]) / np.dot(response, response)) for d in range(9)]
    np.testing.assert_allclose(stated_correlation(plan(refine=0))["t"], wanted[: response.size], atol=1e-4)
    assert "t" not in stated_correlation(plan(model="depth", motion="auto", refine=0))


@pytest.fixture(scope="module", params=[({"refine": 0}, 16), ({"refine": 2, "thin": 2}, 12)], ids=["model", "refined"])
def realisations(request: pytest.FixtureRequest) -> list[lf.Field]:
    """Results [7, 11] of the same scene under noise, every fourth pixel."""
    options, seeds = request.param
    images, rng = render(SCENE), np.random.default_rng(0)
    wanted = {"window": 25, "preshift": (-14, 0), "noise": NOISE, "stride": 4, "roi": (40, 14, 81, 42), **options}
    return [lf.estimate(capture_of(images + rng.normal(0, NOISE, images.shape)), 4, **wanted) for _ in range(seeds)]


def test_correlations_of_a_run_are_those_of_its_errors(realisations: list[lf.Field]) -> None:
    """Over noise realisations, three components: a correlation near 0 is known to some .07. Off the axis the
    components' errors depend on each other, as their maps say."""
    velocity = np.stack([[f[f"velocity_{a}"] for a in "xyz"] for f in realisations])
    error = velocity - velocity.mean(axis=0)
    scatter = error / error.std(axis=0)
    stated = NoiseCorrelation.of(realisations[0])
    for d in (1, 2, 3, 4):
        z = np.mean(scatter[..., d:] * scatter[..., :-d])
        assert z == pytest.approx(stated.x[d], abs=0.2), d
    covariance = np.mean([velocity_covariance(f) for f in realisations], axis=(0, 1, 2))
    by_scatter = np.einsum("niyx,njyx->ij", error, error) / ((len(error) - 1) * error[0, 0].size)

    def correlations(C: np.ndarray) -> np.ndarray:
        return np.asarray(C / np.sqrt(np.outer(np.diag(C), np.diag(C))))

    np.testing.assert_allclose(correlations(by_scatter), correlations(covariance), atol=0.04)
    assert abs(correlations(covariance)[0, 2]) > 0.9
    # The model's own errors of the approach are up to a third too small.
    np.testing.assert_allclose(np.diag(by_scatter), np.diag(covariance), rtol=1.0)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_correlations_of_derivatives_are_those_of_slopes(realisations: list[lf.Field], axis: str) -> None:
    """A slope is a derivative along its own axis, and a mean over the window along the other one.

    Over the 7 x 11 pixels are some ten windows' worth of independent noise, times the realisations: a correlation near
    0 is known to .1, of neighbours better. Those of derivatives and of values differ by up to .8.
    """
    slopes = np.stack([field[f"slope_{axis}"] for field in realisations])
    error = slopes - slopes.mean(axis=0)
    scatter = error / error.std(axis=0)
    stated = NoiseCorrelation.of(realisations[0])
    across = {"x": "y", "y": "x"}[axis]
    for along, wanted in ((axis, getattr(stated, f"{axis}_gradient")), (across, getattr(stated, across))):
        places = np.moveaxis(scatter, {"x": 2, "y": 1}[along], 0)
        for d in (1, 2, 3, 4, 5):
            assert np.mean(places[d:] * places[:-d]) == pytest.approx(wanted[d], abs=0.25), (along, d)
    assert getattr(stated, f"{axis}_gradient")[4] < -0.4


def store_of(path: Path, plan_attrs: dict[str, Any], stride: int = 4) -> ResultStore:
    x = np.arange(2, 40, stride)
    attrs = {"plan": plan_attrs, "config": "[window]\nsize = 21\n"}
    return ResultStore.create(path, frames=[0, 1], y=x, x=x, names=["depth"], chunk=(1, 4, x.size), attrs=attrs)


def test_a_store_gives_what_the_run_stated(tmp_path: Path) -> None:
    """At the distances of its pixels; 0 beyond."""
    stated = {axis: np.linspace(1, 0.1, 10).tolist() for axis in ("x", "y", "y_gradient")} | {"t": [1.0, 0.5, -0.5]}
    found = NoiseCorrelation.of(store_of(tmp_path / "o.zarr", {KEY: stated}))
    assert found.stated
    np.testing.assert_allclose(found.x, [1.0, 0.6, 0.2])
    np.testing.assert_allclose(found.y_gradient, [1.0, 0.6, 0.2])
    assert found.x_gradient is None
    np.testing.assert_allclose(found.between("x", 4)[0], [1.0, 0.6, 0.2, 0.0])
    np.testing.assert_allclose(found.between("y", [0, 2, 1])[1], [0.2, 1.0, 0.6])
    np.testing.assert_allclose(found.between("t", [3, 4, 9]), [[1, 0.5, 0], [0.5, 1, 0], [0, 0, 1]])


def test_older_stores_count_as_fully_correlated(tmp_path: Path) -> None:
    found = NoiseCorrelation.of(store_of(tmp_path / "o.zarr", {}))
    assert not found.stated
    np.testing.assert_array_equal(found.x, np.ones(6))
    assert found.t.size == USUAL_FRAMES


def test_covariance_is_made_of_errors_and_correlations() -> None:
    std, correlation = np.array([2.0, 3.0, 5.0]), {"xy": 0.5, "xz": -0.25, "yz": 0.1}
    maps = {f"velocity_{a}_std": np.array([s, np.inf]) for a, s in zip("xyz", std, strict=True)}
    maps |= {f"velocity_correlation_{pair}": np.array([r, np.nan]) for pair, r in correlation.items()}
    found = velocity_covariance(maps)
    np.testing.assert_allclose(found[0], [[4, 3, -2.5], [3, 9, 1.5], [-2.5, 1.5, 25]])
    assert not np.isfinite(found[1]).any()
    del maps[CORRELATIONS[1]]
    with pytest.raises(InputError, match="no map 'velocity_correlation_xz'"):
        velocity_covariance(maps)


def test_stored_correlations_keep_what_is_left_to_one() -> None:
    values = np.array([0.0, 1.0, -1.0, 0.9991, -0.731, np.nan, np.inf], np.float32)
    found = coarsened(values)
    np.testing.assert_allclose(found, values, atol=3.1e-5)
    assert np.abs(found[:5]).max() <= 1.0
    assert not (found[:5].view(np.uint32) & 0x3FF).any()
