"""Windows that a mask or a border cuts: the stages against the naive twin, and what noise does to their estimates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from test_kernels_estimate import assert_maps_equal
from tolerances import tolerance

import leafflow_ti as lf
from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.models import MODELS
from leafflow_ti.stages.thresholds import DENOISE
from leafflow_ti.status import Status
from leafflow_ti.synthetic.plane import PlaneScene, render, truth

CUT = [(model, "none" if "flow" in model else "spatial", grid) for model, grid in (
    ("flow", "single"), ("flow-affine", "single"), ("flow-quadratic", "single"), ("depth", "line-x"),
    ("affine-translation", "line-x"), ("affine", "square"), ("affine-4d", "line-y"), ("affine-5d", "square"),
    ("affine-scene-flow", "line-x"), ("scene-flow", "line-x"),
)]  # fmt: skip
ALONE = [c for c in CUT if not MODELS[c[0]].own_flows]
MASKS = ("half", "corner", "spots")


def masked(b: Any, mask: str) -> Any:
    """The bench with only a part of its pixels valid: half of some windows, a corner; "spots" differ by frame."""
    t, (height, width) = len(b.images), b.images.shape[3:]
    x, y = b.position(1, 3)
    valid = np.ones((t, height, width), bool)
    if mask != "spots":
        valid[:, :, x + 4 :] = False
    if mask == "corner":
        valid[:, : y - 3] = False
    if mask == "spots":
        valid[t // 2, y - 4, x - 2] = valid[-1, y + 1, x + 5] = False
    return replace(b, valid=valid)


@pytest.mark.parametrize("estimator", ["ols", "tls", "tls-equilibrated"])
@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize(("model", "brightness", "grid"), ALONE)
def test_parameters_equal_the_twin(
    bench: Callable, model: str, brightness: str, grid: str, mask: str, precision: str, estimator: str
) -> None:
    if model == "flow-quadratic" and mask != "spots":
        pytest.skip("half of so small a window does not determine second derivatives")
    assert_parameters_equal(masked(bench(model, brightness, grid, precision), mask), estimator)


def assert_parameters_equal(b: Any, estimator: str, solvers: tuple[str, ...] = ("fast", "jacobi")) -> None:
    """Of some pixels, but those of which too little is seen: as the twin has them."""
    found = {solver: b.estimate(estimator=estimator, solver=solver) for solver in solvers}
    for pixel in ((1, 3), (1, 0), (2, 4)):
        solved, _ = b.solved(*pixel, found[solvers[0]].problem)
        P, cov = solved.at_centre(b.columns, b.sampling, DENOISE[estimator])
        std = np.sqrt([np.diag(cov[k, k]) for k in range(b.columns.n_time_like)])
        for result in found.values():
            if result.status[pixel] == Status.BORDER:
                continue
            assert np.max(np.abs(result.parameters[pixel] - P.T) / std) <= tolerance(b.device).parameters
            assert result.variance[pixel] == pytest.approx(solved.variance, rel=tolerance(b.device).errors)


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize(("model", "brightness", "grid"), [c for c in CUT if c[0] != "flow"])
def test_maps_equal_the_twin(bench: Callable, model: str, brightness: str, grid: str, mask: str) -> None:
    b = masked(bench(model, brightness, grid, "f64"), mask)
    assert_maps_equal(b, b.estimate(MODELS[model].motions[0] if MODELS[model].motions else None))


# --- what masks and noise do to estimates ----------------------------------------------------------------------------

SCENE = PlaneScene(
    f_px=900.0, baseline_mm=(0.3, 0.3), n_cols=7, n_frames=9, size=(150, 121), centre=(0.3, -0.2, 80.0),
    zx=0.2, zy=-0.1, velocity=(0.021, -0.014, 0.06), omega=(0.001, -0.0015, 0.002), wavelengths_mm=(0.6, 0.75),
    alpha=0.4, beta=1.0,
)  # fmt: skip
MIDDLE = 4
OPTIONS: dict[str, Any] = {"window": 33, "sigma": 8.0, "preshift": (-3, 0), "motion": "rotation"}


def measured(images: np.ndarray, mask: np.ndarray, path: Path, **options: Any) -> lf.Field:
    """The middle frame of images of ``SCENE`` where the mask [y, x] allows it."""
    height, width = mask.shape
    path.write_bytes(b"P5 %d %d 255\n" % (width, height) + (255 * mask).astype(np.uint8).tobytes())
    capture = capture_from_array(images, Geometry(SCENE.f_px, SCENE.principal, SCENE.baseline_mm))
    return lf.estimate(capture, MIDDLE, mask=path, **{**OPTIONS, **options})


def exact(name: str) -> np.ndarray:
    """What a map should be [y, x]."""
    found, (width, height) = truth(SCENE), SCENE.size
    value = {
        "depth": found["depth"], "slope_x": found["zx"], "slope_y": found["zy"],
        **{f"velocity_{a}": found["velocity"][..., i] for i, a in enumerate("xyz")},
    }[name]  # fmt: skip
    return np.broadcast_to(value, (height, width))


def test_noise_does_not_bias_windows_cut_in_half(tmp_path: Path) -> None:
    """Noise of a fifth of the contrast, at the edge of a mask: by the noise matrix of a whole window, slopes would be
    1.0 and depths .8 standard deviations of a pixel off there; 30 times 5 pixels know their mean to a tenth."""
    clean, random = render(SCENE), np.random.default_rng(1)
    mask = np.zeros(clean.shape[-2:], bool)
    mask[:, 30:120] = True
    at = np.s_[70:90:4, 30]
    errors: dict[str, list[np.ndarray]] = {"depth": [], "slope_x": []}
    for _ in range(30):
        noisy = clean + random.normal(0, 5.0, clean.shape)
        field = measured(noisy, mask, tmp_path / "m.pgm", model="affine-4d", stride=1, noise=5.0, roi=(30, 70, 31, 90))
        for name, found in errors.items():
            found.append(field[name][::4, 0] - exact(name)[at])
    for name, found in errors.items():
        assert abs(np.mean(found)) < 0.5 * np.std(found, axis=0).mean(), name


def leaf() -> np.ndarray:
    """A mask [y, x] of ``SCENE``."""
    width, height = SCENE.size
    y, x = np.mgrid[:height, :width]
    return np.asarray(((x - 75) / 60) ** 2 + ((y - 60) / 44) ** 2 < 1)


def beside_another_surface(images: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The images with noise in place of the surface but for the mask and the 4 px that it moves by in the window."""
    random, far = np.random.default_rng(3), distance_transform_edt(~mask) > 4
    for k in range(SCENE.n_cols):
        elsewhere = np.roll(far, OPTIONS["preshift"][0] * (k - SCENE.n_cols // 2), axis=1)
        shown = images[:, :, k]
        shown[..., elsewhere] = random.normal(100, 40, shown[..., elsewhere].shape)
    return images


def rings(mask: np.ndarray, at: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels lie in the outermost 10 px of a mask, and which further in than windows reach."""
    inside = distance_transform_edt(mask)[at]
    return (inside > 0) & (inside <= 10), inside > 20


@pytest.mark.parametrize("model", ["affine-4d", "affine-scene-flow"])
def test_the_edge_of_a_leaf_is_as_good_as_its_middle(model: str, tmp_path: Path) -> None:
    """Without noise and refinement, within a factor of 2, beside another surface that the mask leaves out."""
    mask = leaf()
    images = beside_another_surface(render(SCENE), mask)
    height, width = mask.shape
    options = {"stride": 4, "precision": "f64", "noise": 0.0, "border": "clip", "refine": 0}
    field = measured(images, mask, tmp_path / "m.pgm", model=model, **options)
    at = np.ix_(range(0, height, 4), range(0, width, 4))
    ring, middle = rings(mask, at)
    assert np.isfinite(field["depth"][ring]).all()
    for names in (["depth"], ["slope_x", "slope_y"], ["velocity_x", "velocity_y", "velocity_z"]):
        error = np.sqrt(sum((field[n] - exact(n)[at]) ** 2 for n in names))
        assert np.nanmedian(error[ring]) <= 2 * np.nanmedian(error[middle]), names


@pytest.mark.parametrize("model", ["affine-4d", "affine-scene-flow"])
def test_the_refined_edge_of_a_noisy_leaf_is_as_good_as_its_middle(model: str, tmp_path: Path) -> None:
    """With noise of 1 % of the contrast half a window knows less, velocities across the line of sight least: depth,
    slopes and velocity (as a vector) are within a factor of 2 all the same."""
    mask = leaf()
    images = render(SCENE)
    images += np.random.default_rng(2).normal(0, 0.25, images.shape)
    height, width = mask.shape
    options = {"stride": 4, "noise": 0.25, "border": "clip", "refine": 3}
    field = measured(images, mask, tmp_path / "m.pgm", model=model, **options)
    at = np.ix_(range(0, height, 4), range(0, width, 4))
    ring, middle = rings(mask, at)
    for names in (["depth"], ["slope_x", "slope_y"], ["velocity_x", "velocity_y", "velocity_z"]):
        error = np.sqrt(sum((field[n] - exact(n)[at]) ** 2 for n in names))
        assert np.nanmedian(error[ring]) <= 2 * np.nanmedian(error[middle]), names
