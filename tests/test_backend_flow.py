"""Dense flow and disparity of the backend: against naive loops, exact motion, scikit-image; what they accept."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from reference.follow import step

from leafflow_ti.backend import epi_disparity, optical_flow
from leafflow_ti.backend.compat import cv2
from leafflow_ti.backend.compat.skimage.registration import optical_flow_ilk
from leafflow_ti.errors import ConfigError, InputError
from leafflow_ti.filters import gaussian_weights
from leafflow_ti.stages.follow import HOLD_FLOW, HOLD_SLOPES, Following, Level, halved, median_of_nine, resized
from leafflow_ti.synthetic.affine_images import affine_images

GRADIENT = np.array([[0.010, -0.008], [0.006, -0.012]])
SHAPE = (70, 90)
INNER = (slice(None), slice(14, -14), slice(14, -14))


def moving(frames: int, noise: float = 0.0, seed: int = 0, reference: int | None = None) -> tuple[Any, Any]:
    """Frames [t, y, x] and their flow at the reference."""
    levers = np.arange(float(frames)) - ((frames - 1) // 2 if reference is None else reference)
    return affine_images(SHAPE, levers, (1.3, -0.8), GRADIENT, noise, seed)


def epe(found: Any, truth: Any) -> float:
    """Mean end-point error."""
    return float(np.mean(np.linalg.norm(found - truth, axis=0)))


def assert_follow_equals_twin(device: Any, components: int, affine: bool, limit: float) -> None:
    """Two steps from a flow that leads out of some of the images, one pixel more than the lanes wide."""
    random = np.random.default_rng(5)
    levers = np.array([-1.0, 0.0, 1.0, 2.5])
    images, _ = affine_images((9, 67), levers, (0.7, -0.4), np.zeros((2, 2)), noise=0.02)
    weights = gaussian_weights(7, 1.7)
    start = random.normal(0.0, 0.8, (components, 9, 67))
    how = Following(components, affine, tuple(weights.tolist()), steps=2)
    flow, std = Level(device, images.astype(device.real("storage")), levers, how).solve(start, errors=True)
    hold = (HOLD_FLOW, HOLD_SLOPES)
    # Damping is that of the first step.
    wanted, _ = step(images, levers, start, weights, affine, hold)
    once, _ = Level(device, images.astype(device.real("storage")), levers, _one_step(how)).solve(start, errors=False)
    # A pixel that ends at an image's very border is inside or not by rounding: there alone values may differ.
    assert np.mean(np.abs(once - wanted) > limit * np.abs(wanted).max()) <= 0.002
    assert std is not None
    again, errors = step(images, levers, once.astype(float), weights, affine, hold)
    assert np.mean(np.abs(flow - again) > 0.02 * np.abs(again).max()) <= 0.01
    np.testing.assert_allclose(np.median(std / errors), 1.0, atol=0.01)


def _one_step(how: Following) -> Following:
    return Following(how.components, how.affine, how.weights, steps=1)


@pytest.mark.parametrize(("components", "affine"), [(1, True), (2, False), (2, True)])
def test_a_step_equals_naive_loops(device: Any, precision: str, components: int, affine: bool) -> None:
    # f32: sums of squares of grey values rounded to 6e-8, systems of condition 1e3. f64: spline coefficients are cut
    # off at 1e-7 of the largest.
    assert_follow_equals_twin(device(precision), components, affine, 1e-3 if precision == "f32" else 2e-6)


@pytest.mark.parametrize(("frames", "noise", "limit"), [(2, 0.0, 2e-3), (5, 0.0, 5e-4), (5, 0.05, 2.5e-2)])
def test_affine_motion_is_found(frames: int, noise: float, limit: float) -> None:
    images, truth = moving(frames, noise)
    flow, std = optical_flow(images.astype(np.float32), errors=True)
    assert flow.shape == std.shape == (2, *SHAPE)
    assert flow.dtype == np.float32
    assert np.isfinite(flow).all()
    assert np.isfinite(std).all()
    assert epe(flow[INNER], truth[INNER]) < limit


def test_standard_errors_are_true() -> None:
    """Mean of four noises; the truth lies within what 2 % of noise leaves."""
    ratios = []
    for seed in range(4):
        images, truth = moving(5, 0.02, seed)
        flow, std = optical_flow(images.astype(np.float32), errors=True)
        ratios.append(np.sqrt(np.mean((flow - truth)[INNER] ** 2) / np.mean(std[INNER] ** 2)))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.2)


def test_reference_and_long_sequences() -> None:
    images, truth = moving(5, reference=0)
    assert epe(optical_flow(images, reference=0)[INNER], truth[INNER]) < 2e-3
    many = np.concatenate([np.full((9, *SHAPE), 7.0), moving(15)[0], np.full((9, *SHAPE), 7.0)])
    np.testing.assert_array_equal(optical_flow(many), optical_flow(many[9:24]))


def test_many_pixels_of_motion() -> None:
    images, truth = affine_images((128, 160), np.arange(3.0) - 1, (7.5, -4.0), np.zeros((2, 2)))
    assert epe(optical_flow(images)[:, 16:-16, 16:-16], truth[:, 16:-16, 16:-16]) < 2e-3


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize(("disparity", "ramp"), [(0.37, 0.0), (0.0, 2.0)])
def test_disparity_of_nine_noisy_views(axis: str, disparity: float, ramp: float) -> None:
    gradient = np.array([[ramp / 128, 0.0], [0.0, 0.0]])
    views, flow = affine_images((96, 128), np.arange(9.0) - 4, (disparity, 0.0), gradient, noise=0.01)
    views, truth = (views, flow[0]) if axis == "x" else (views.transpose(0, 2, 1), flow[0].T)
    found, std = epi_disparity(views.astype(np.float32), axis=axis, errors=True)
    error = (found - truth)[12:-12, 12:-12]
    assert np.sqrt(np.mean(error**2)) < 0.004
    assert np.sqrt(np.mean(error**2) / np.mean(std[12:-12, 12:-12] ** 2)) == pytest.approx(1.0, abs=0.2)


def test_any_images_give_finite_maps() -> None:
    random = np.random.default_rng(0)
    for shape in ((3, 3), (5, 40), (17, 70)):
        images = random.integers(0, 255, (3, *shape)).astype(np.uint8)
        for values in (images, np.zeros_like(images)):
            flow, std = optical_flow(values, errors=True)
            assert np.isfinite(flow).all()
            assert np.isfinite(std).all()
    assert not optical_flow(np.zeros((2, 20, 20))).any()


def test_what_does_not_fit_is_one_line() -> None:
    images = np.zeros((3, 20, 20))
    bad = images.copy()
    bad[1, 3, 4] = np.nan
    for wrong in (images[0], images[:1], images[:, :2], bad):
        with pytest.raises(InputError) as caught:
            optical_flow(wrong)
        assert "\n" not in str(caught.value)
        with pytest.raises(ValueError):  # noqa: PT011 - what users of NumPy expect
            epi_disparity(wrong)
    options: tuple[dict[str, Any], ...] = (
        {"model": "depth"}, {"window": 4}, {"sigma": 0.0}, {"steps": 0}, {"levels": -1}, {"reference": 3},
    )  # fmt: skip
    for option in options:
        with pytest.raises(ConfigError, match=next(iter(option))):
            optical_flow(images, **option)
    with pytest.raises(ConfigError, match="axis"):
        epi_disparity(images, axis="s")
    with pytest.raises(InputError, match="initial"):
        optical_flow(images, initial=np.zeros((2, 20, 21)))


def test_out_is_written() -> None:
    images, _ = moving(3)
    images = images.astype(np.float32)
    out = np.full((2, *SHAPE), np.nan, np.float32)
    assert optical_flow(images, out=out) is out
    np.testing.assert_array_equal(out, optical_flow(images))


def test_pyramid_and_median() -> None:
    y, x = np.mgrid[:21, :30].astype(float)
    plane = np.stack([3 * x - 2 * y, 0 * x + 5])
    small = halved(plane)
    assert small.shape == (2, 11, 15)
    np.testing.assert_allclose(small[:, 1:-1, 1:-1], plane[:, 2:-2:2, 2:-2:2][..., : small.shape[2] - 2], atol=1e-12)
    np.testing.assert_allclose(resized(plane[:, ::2, ::2], (21, 30))[:, :, :-1], 2 * plane[:, :, :-1], atol=1e-12)
    spoiled = np.full((1, 6, 7), 2.0)
    spoiled[0, 0, 0] = spoiled[0, 3, 3] = 90.0
    np.testing.assert_array_equal(median_of_nine(spoiled), 2.0)


@pytest.mark.parametrize("options", [{}, {"gaussian": True}, {"prefilter": True, "radius": 5}])
def test_ilk_agrees_with_scikit_image(options: dict[str, Any]) -> None:
    """Within what the other is off by itself: images are linear between pixels there."""
    registration: Any = pytest.importorskip("skimage.registration")
    images, flow = affine_images((96, 96), np.arange(2.0), (0.9, -0.6), 0.3 * GRADIENT)
    one, two = (images / 255).astype(np.float32)
    truth, inner = flow[::-1], (slice(None), slice(12, -12), slice(12, -12))
    ours, theirs = (run(one, two, **options) for run in (optical_flow_ilk, registration.optical_flow_ilk))
    assert ours.shape == theirs.shape
    assert ours.dtype == theirs.dtype
    assert epe(ours[inner], truth[inner]) < epe(theirs[inner], truth[inner])
    assert epe(ours[inner], theirs[inner]) < 0.05


def test_ilk_of_volumes_is_refused() -> None:
    with pytest.raises(InputError, match="volumes"):
        optical_flow_ilk(np.zeros((5, 20, 20)), np.zeros((5, 20, 20)))
    with pytest.raises(InputError, match="shapes"):
        optical_flow_ilk(np.zeros((20, 20)), np.zeros((20, 21)))
    with pytest.raises(ConfigError, match="float16"):
        optical_flow_ilk(np.zeros((20, 20)), np.zeros((20, 20)), dtype=np.float16)


def test_shapes_of_opencv() -> None:
    images, truth = moving(2)
    one, two = np.round(images).astype(np.uint8)
    wanted = truth.transpose(1, 2, 0)
    flow = cv2.calcOpticalFlowFarneback(one, two, None, 0.5, 3, 21, 3, 5, 1.2, cv2.OPTFLOW_FARNEBACK_GAUSSIAN)
    assert flow.shape == (*SHAPE, 2)
    assert flow.dtype == np.float32
    assert np.abs(flow - wanted)[14:-14, 14:-14].mean() < 0.02
    begun = wanted.astype(np.float32)
    found = cv2.calcOpticalFlowFarneback(one, two, begun, 0.5, 1, 21, 1, 5, 1.2, cv2.OPTFLOW_USE_INITIAL_FLOW)
    assert found is begun
    assert np.abs(begun - wanted)[14:-14, 14:-14].mean() < 0.02
    program = cv2.DenseOpticalFlow(sigma=6)
    np.testing.assert_array_equal(program.calc(one, two), program.calc(one, two, None))
    program.collectGarbage()
    with pytest.raises(InputError, match="float32"):
        program.calc(one, two, np.zeros(SHAPE))
    with pytest.raises(ConfigError, match="pyr_scale"):
        cv2.calcOpticalFlowFarneback(one, two, None, 1.5, 3, 21, 3, 5, 1.2, 0)
