"""Growth of the surface: exact cases, the naive twin, its error bars, and a plane that really grows."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from estimate_bench import sampling_of
from reference import growth as twin
from small_plane import OPTIONS as SMALL_OPTIONS
from small_plane import SCENE
from small_plane import capture_of as small_capture
from test_kernels_accuracy import NOISE, OPTIONS, SINUSOID, capture_of

import leafflow_ti as lf
from leafflow_ti.api import plan_run
from leafflow_ti.config import load_config
from leafflow_ti.errors import UsageError
from leafflow_ti.growth import DIFFERENCES, VELOCITY, growth_maps
from leafflow_ti.plan import Plan
from leafflow_ti.sampling import AxisSampling, Sampling, difference_variance
from leafflow_ti.synthetic.plane import PlaneScene, linear_growth, render, truth

F_PX, PRINCIPAL, STEP = 900.0, (30.0, 20.0), 3
Y, X = range(2, 23, STEP), range(5, 35, STEP)
SAMPLING = sampling_of("line-x", True)
COVARIANCE = np.array([[2.0, -0.7, 0.5], [-0.7, 1.5, 0.3], [0.5, 0.3, 4.0]]) * 1e-6


def surface() -> np.ndarray:
    """Positions [h, w, 3] on a bent surface."""
    x, y = np.meshgrid((np.array(X) - PRINCIPAL[0]) / F_PX, (np.array(Y) - PRINCIPAL[1]) / F_PX)
    depth = 80 + 30 * x - 20 * y + 400 * x * x + 300 * x * y
    return np.stack([x, y, np.ones_like(x)], axis=-1) * depth[..., None]


def growth_of(s: np.ndarray, f: np.ndarray, known: np.ndarray | None = None, sampling: Sampling = SAMPLING) -> Any:
    """Growth rate and standard error from positions and velocities [h, w, 3], all errors as ``COVARIANCE``."""
    lower = [COVARIANCE[i, j] for i in range(3) for j in range(i + 1)]
    factors = [difference_variance(axis, 2 * STEP) for axis in (sampling.x, sampling.y)]
    planes = [np.full(s.shape[:2], c * k) for k in factors for c in lower]
    maps = {
        "depth": s[..., 2],
        **{n: f[..., k] for k, n in enumerate(VELOCITY)},
        **dict(zip(DIFFERENCES, planes, strict=True)),
    }
    if known is not None:
        maps = {name: np.where(known, values, np.nan) for name, values in maps.items()}
    found = growth_maps(maps, Y, X, F_PX, PRINCIPAL, sampling)
    return found["growth_rate"], found["growth_rate_std"]


def test_rigid_motion_is_no_growth() -> None:
    """However fast the rotation: .3 rad/frame would be 4.5 %/frame in a forward step. Rounding of 1e-16 by 1e-2."""
    s = surface()
    rate, _ = growth_of(s, np.array([0.4, -0.3, 1.0]) + np.cross([0.2, -0.2, 0.1], s - [3.0, 1.0, 80.0]))
    assert np.max(np.abs(rate)) < 1e-10


def test_expansion_is_its_area() -> None:
    s = surface()
    for percent in (-2.0, 0.1, 5.0):
        rate, _ = growth_of(s, linear_growth(percent) * (s - [3.0, 1.0, 80.0]))
        np.testing.assert_allclose(rate, percent, rtol=1e-10)


KNOWN = np.ones((len(Y), len(X)), bool)
KNOWN[2, 3] = KNOWN[3, 5] = KNOWN[5, 7:] = KNOWN[6, 8] = False
KNOWN[:, 1] = False
KNOWN[4:6, 0] = False


@pytest.mark.parametrize("size", [11, 3], ids=["overlapping windows", "windows apart"])
def test_growth_equals_the_twin(size: int) -> None:
    """Central, one-sided and missing differences, with the correlations of their errors."""
    pixel = AxisSampling.gaussian(SAMPLING.x.filters, size, 3.2)
    sampling = replace(SAMPLING, x=pixel, y=pixel)
    s = surface()
    f = 0.02 * np.sin(s[..., [1, 2, 0]]) + 0.003 * s[..., [0, 0, 1]]
    found = growth_of(s, f, KNOWN, sampling)
    wanted = twin.growth(s, f, COVARIANCE, KNOWN, STEP, sampling)
    missing = np.isnan(wanted[0]) & KNOWN
    assert missing.any()
    assert np.isfinite(wanted[0]).sum() > 30
    np.testing.assert_allclose(found[0], wanted[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found[1], wanted[1], rtol=1e-6)


def test_error_of_a_difference_is_that_of_random_windows() -> None:
    """Moments of filtered white noise in windows side by side: 4000 samples know their variance to 2 %."""
    axis, span = AxisSampling.gaussian(SAMPLING.x.filters, 21, 6.0), 4
    noise = np.random.default_rng(0).normal(size=(4000, axis.size + 2 * axis.filter_radius + span))
    smooth = np.apply_along_axis(np.convolve, 1, noise, axis.kernel(False), "valid")
    for power in (0, 1):
        e = [smooth[:, first : first + axis.size] @ axis.window(power) for first in (0, span)]
        found = np.var((e[1] - e[0]) / span) / np.mean([np.var(x) for x in e])
        assert difference_variance(axis, span, power) == pytest.approx(found, rel=0.1)


def test_growth_has_a_region_and_bands_of_its_own_size(tmp_path: Any) -> None:
    """Bands, a region and a mask see their neighbours; without growth nothing more than the region is computed."""
    capture = small_capture(SCENE)
    whole = lf.estimate(capture, 6, **SMALL_OPTIONS, stride=3)
    names = ("growth_rate", "growth_rate_std")
    only = lf.estimate(capture, 6, **SMALL_OPTIONS, stride=3, arrays=names, tile=2, roi=(15, 9, 40, 30))
    assert tuple(only) == names
    part = slice(3, 3 + only.shape[0]), slice(5, 5 + only.shape[1])
    assert np.isfinite(only["growth_rate"]).all()
    for name in names:
        np.testing.assert_array_equal(only[name], whole[name][part])
    without = lf.estimate(capture, 6, **SMALL_OPTIONS, stride=3, arrays=("depth",), roi=(15, 9, 40, 30))
    np.testing.assert_array_equal(without["depth"], whole["depth"][part])


def test_plan_asks_for_growth_where_velocity_has_three_components() -> None:
    capture = small_capture(SCENE)

    def plan(**options: object) -> Plan:
        return plan_run(capture, load_config(overrides={**SMALL_OPTIONS, **options}))

    assert "growth_rate_std" in plan().names
    assert plan().margin == 1
    assert plan(arrays="depth,velocity_x").margin == 0
    assert "growth_rate" not in plan(model="affine-translation", motion="translation").names
    assert "growth_rate" not in plan(model="depth", motion="auto").names


GROWING = replace(SINUSOID, velocity=(0.0073, -0.0037, 0.02))
STRIDE, ROI, EVERY = 8, (94, 34, 207, 147), slice(None, None, 7)
"""Output pixels of which every seventh, three window sigmas apart, is an independent sample."""


@functools.cache
def images(percent: float) -> np.ndarray:
    return render(replace(GROWING, growth=linear_growth(percent)))


def by_position(capture: lf.Capture, precision: str = "f32") -> lf.Field:
    """A velocity from the flow itself and the range constraint: rows that assume nothing about growth."""
    options = {"rows": "u+b5", "motion": "translation", "stride": STRIDE, "roi": ROI, "precision": precision}
    return lf.estimate(capture, **{**OPTIONS, **options})


def by_cameras(capture: lf.Capture, precision: str = "f32") -> lf.Field:
    """A velocity from the flow that every camera sees."""
    options = {"model": "scene-flow", "motion": "auto", "stride": 2 * STRIDE, "roi": ROI, "precision": precision}
    return lf.estimate(capture, **{**OPTIONS, **options})


def by_gradient(capture: lf.Capture) -> lf.Field:
    return lf.estimate(capture, **{**OPTIONS, "rows": "2d"}, stride=STRIDE, roi=ROI)


@pytest.mark.parametrize(("measure", "percent"), [(by_position, 0.1), (by_position, 1.0), (by_cameras, 1.0)])
def test_growing_plane_without_noise(measure: Callable[[lf.Capture, str], lf.Field], percent: float) -> None:
    """What is left are second-order terms of growth and motion over the window's frames (found 4e-4)."""
    scene = replace(GROWING, growth=linear_growth(percent))
    exact = truth(scene)
    found = measure(capture_of(scene, images(percent)), "f64")
    assert exact["growth_rate"] == pytest.approx(percent, rel=1e-9)
    np.testing.assert_allclose(found["growth_rate"], percent, atol=1e-3)


@pytest.mark.parametrize(("measure", "percent"), [(by_position, 1.0), (by_gradient, 0.0)])
def test_growth_and_its_error_bar_with_noise(measure: Callable[[lf.Capture], lf.Field], percent: float) -> None:
    """216 samples know their mean to 7 % of one standard error and their spread to 5 %.

    The errors of the two sets of rows, means of the window and first moments of it, differ in what neighbours share.
    """
    deviations = []
    for seed in range(24):
        noise = np.random.default_rng(seed).normal(0, NOISE, images(percent).shape)
        found = measure(capture_of(GROWING, (images(percent) + noise).astype(np.float32)))
        z = (found["growth_rate"] - percent) / found["growth_rate_std"]
        deviations.append(z[EVERY, EVERY])
    assert abs(np.mean(deviations)) < 0.3
    assert 0.75 <= np.std(deviations) <= 1.3


def test_growth_of_a_scene() -> None:
    scene = PlaneScene(f_px=900.0, baseline_mm=(0.3, 0.3), growth=0.01, zx=0.3, omega=(0.01, 0.02, 0.0))
    assert scene.growth_rate == pytest.approx(100 * ((1.005 / 0.995) ** 2 - 1))
    assert linear_growth(scene.growth_rate) == pytest.approx(0.01)
    offsets = np.array([[1.0, 2.0, 0.3]])
    for t in (-2.0, 0.0, 3.0):
        np.testing.assert_allclose(scene.material(scene.place(offsets, t), t), offsets, atol=1e-12)
    h = 1e-4
    ends = [scene.place(offsets, t) for t in (-h, 0.0, h)]
    velocity, acceleration = scene.point_motion(ends[1])
    np.testing.assert_allclose(velocity, (ends[2] - ends[0]) / (2 * h), atol=1e-7)
    np.testing.assert_allclose(acceleration, (ends[2] - 2 * ends[1] + ends[0]) / h**2, atol=1e-5)


@pytest.mark.parametrize("growth", [0.3, -0.3, 2.1])
def test_scenes_that_vanish_are_refused(growth: float) -> None:
    with pytest.raises(UsageError, match="vanish within the"):
        PlaneScene(f_px=900.0, baseline_mm=(0.3, 0.3), growth=growth, n_frames=9 if abs(growth) < 2 else 1)
    with pytest.raises(UsageError, match="more than -100"):
        linear_growth(-100.0)
