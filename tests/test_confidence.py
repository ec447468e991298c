"""The four cases of a window, and the confidence: pixels in its order have errors in their order."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from moving_texture import F_PX, Moving, Texture, checks, plain, stripes
from scipy.ndimage import gaussian_filter

import leafflow_ti as lf
from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.status import Status
from perf import yosemite
from perf.inputs import absent


def measure(images: np.ndarray, **options: object) -> lf.Field:
    height, width = images.shape[-2:]
    geometry = Geometry(F_PX, ((width - 1) / 2, (height - 1) / 2), (1.0, 1.0))
    usual: dict[str, object] = {"model": "flow-affine", "window": 17, "sigma": 5.0, "stride": 1}
    return lf.estimate(capture_from_array(images, geometry), **{**usual, **options})


def shares(field: lf.Field) -> dict[Status, float]:
    inside = field.status[field.status != Status.BORDER]
    return {Status(int(code)): float(np.mean(inside == code)) for code in np.unique(inside)}


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("given", [True, False], ids=["given", "auto"])
@pytest.mark.parametrize("noise", [0.3, 1.0, 4.0, 10.0])
@pytest.mark.parametrize(
    ("texture", "status"), [(checks, Status.OK), (stripes(0.8), Status.APERTURE), (plain, Status.NO_STRUCTURE)]
)
@pytest.mark.parametrize("model", ["flow", "flow-affine"])
def test_three_cases(texture: Texture, status: Status, model: str, noise: float, given: bool, precision: str) -> None:
    found = shares(Moving(texture, noise).measure(model, noise=noise if given else "auto", precision=precision))
    assert found.get(status, 0) >= 0.98, found


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("noise", [0.3, 1.0, 4.0, 10.0])
@pytest.mark.parametrize("model", ["flow", "flow-affine"])
def test_texture_that_moves_as_nothing_is_the_fourth(model: str, noise: float, precision: str) -> None:
    """Another texture in every frame: no noise of any level explains it."""
    random = np.random.default_rng(0)
    texture = gaussian_filter(random.normal(size=(7, 1, 1, 44, 52)), (0, 0, 0, 1.0, 1.0))
    images = 100 + 40 * texture / texture.std() + random.normal(0, noise, texture.shape)
    found = shares(measure(images, model=model, noise=noise, precision=precision, window=25, sigma=7))
    assert found.get(Status.INCOHERENT, 0) >= 0.98, found


def two_motions(noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Two surfaces side by side under a texture that fades from the upper to the lower border: images and true flow."""
    size = (90, 70)
    left, right = (
        Moving(texture, 0.0, flow, size, n_cameras=1).images()
        for texture, flow in ((checks, (0.3, -0.2)), (lambda x, y: checks(y, 1.1 * x), (-0.25, 0.3)))
    )
    x, y = np.arange(size[0]), np.arange(size[1])[:, None]
    fading = np.exp(-y / 16.0)
    images = 100 + fading * (np.where(x < size[0] // 2, left, right) - 100)
    flow = np.where((x < size[0] // 2)[..., None], (0.3, -0.2), (-0.25, 0.3)) + np.zeros((size[1], 1, 1))
    return images + np.random.default_rng(3).normal(0, noise, images.shape), flow


def mean_errors(field: lf.Field, error: np.ndarray, parts: tuple[float, ...]) -> list[float]:
    """Mean error of the most confident part of the pixels, for each of ``parts``."""
    known = np.isfinite(error)
    order = np.argsort(-field["confidence"][known], kind="stable")
    return [float(error[known][order][: int(part * order.size)].mean()) for part in parts]


@pytest.mark.parametrize("noise", [0.5, 2.0])
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_errors_fall_with_the_density(noise: float, precision: str) -> None:
    images, flow = two_motions(noise)
    field = measure(images, precision=precision)
    error = np.hypot(field["flow_x"] - flow[..., 0], field["flow_y"] - flow[..., 1])
    curve = mean_errors(field, error, (0.2, 0.4, 0.6, 0.8, 1.0))
    assert curve == sorted(curve)
    assert curve[0] < 0.25 * curve[-1]


def test_confidence_is_a_share_and_none_without_texture() -> None:
    strong, none = Moving(checks, 1.0).measure("flow-affine"), Moving(plain, 1.0).measure("flow-affine")
    for field in (strong, none):
        inside = field.status != Status.BORDER
        assert "confidence_std" not in field
        assert np.isnan(field["confidence"][~np.isin(field.status, (Status.OK, Status.APERTURE))]).all()
        assert np.all(field["confidence"][inside & (field.status == Status.OK)] <= 1)
    assert np.nanmin(strong["confidence"]) > 0.5
    weak = Moving(stripes(0.3), 1.0).measure("flow-affine")
    assert np.nanmax(weak["confidence"]) < 0.1


@pytest.mark.skipif(absent(yosemite.NAME) is not None, reason="the sequence is not there")
def test_the_confident_half_of_yosemite_has_half_the_error(tmp_path: Path) -> None:
    field = yosemite.estimate_flow(tmp_path, **yosemite.PLAIN, stride=2)
    half, whole = mean_errors(field, yosemite.errors_of(field, yosemite.Truth.read()), (0.5, 1.0))
    assert half <= 0.5 * whole
