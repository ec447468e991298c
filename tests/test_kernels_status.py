"""Inputs at the edge: every pixel says why it has no value, and bad pixels reach no further than their windows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import leafflow_ti as lf
from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.field import CORRELATIONS, IDENTIFIED
from leafflow_ti.status import HAS_VALUE, Status
from leafflow_ti.synthetic.plane import PlaneScene, render

SCENE = PlaneScene(
    f_px=900.0,
    baseline_mm=(0.3, 0.3),
    n_cols=5,
    n_frames=7,
    size=(64, 44),
    centre=(0.3, -0.2, 80.0),
    zx=0.2,
    zy=-0.1,
    velocity=(0.021, -0.014, 0.06),
    wavelengths_mm=(0.6, 0.75),
    alpha=0.4,
    beta=1.0,
    noise=1.0,
)
RADIUS = 4 + 2  # of the window and of the filters
MODELS = ["flow", "flow-affine", "affine-4d"]
ESTIMATORS = ["ols", "tls", "tls-equilibrated"]


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return render(SCENE)


def measure(images: np.ndarray, model: str = "affine-4d", **options: object) -> lf.Field:
    if model.startswith("flow"):
        images = images[:, :, 2:3]
    else:
        options = {"motion": "rotation", "preshift": (-3, 0), **options}
    capture = capture_from_array(images, Geometry(SCENE.f_px, SCENE.principal, SCENE.baseline_mm))
    return lf.estimate(capture, model=model, **{"window": 9, "sigma": 2.5, "stride": 1, **options})


def statuses(field: lf.Field) -> set[Status]:
    """Codes that occur away from the border."""
    return {Status(int(code)) for code in np.unique(field.status)} - {Status.BORDER}


def assert_values_follow_status(field: lf.Field) -> None:
    """Values are where the status says so, but for groups that are not identified."""
    empty = ~np.isin(field.status, HAS_VALUE)
    around = np.pad(empty, 1, constant_values=True)
    alone = (around[:-2, 1:-1] & around[2:, 1:-1]) | (around[1:-1, :-2] & around[1:-1, 2:])
    assert not field["identified"][empty].any()
    for name in (n for n in field if n != "identified"):
        # The area of a surface element takes a neighbour along x and one along y.
        none = empty | alone if name.startswith("growth_rate") else empty
        if name.startswith("normal_flow"):
            none = field.status != Status.APERTURE
        if name in CORRELATIONS:  # of components that are all determined
            none = none | np.isinf([field[f"velocity_{a}_std"] for a in "xyz"]).any(axis=0)
        unknown = np.isnan(field[name])
        assert unknown[none].all(), name
        if f"{name}_std" in field and not name.startswith("growth_rate"):
            lost = unknown & ~none
            np.testing.assert_array_equal(np.isinf(field[f"{name}_std"]), lost, err_msg=name)
        elif not name.startswith("growth_rate"):
            np.testing.assert_array_equal(unknown, none, err_msg=name)


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("grey", [0.0, 1e-3, 107.3, 65535.0])
def test_constant_images_have_no_structure(
    images: np.ndarray, grey: float, model: str, estimator: str, precision: str
) -> None:
    field = measure(np.full_like(images, grey), model, estimator=estimator, precision=precision)
    assert statuses(field) == {Status.NO_STRUCTURE}
    assert_values_follow_status(field)


def share(field: lf.Field, *codes: Status) -> float:
    """Part of the pixels off the border that have one of the codes."""
    return float(np.isin(field.status, codes).sum() / np.sum(field.status != Status.BORDER))


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("model", MODELS)
def test_pure_noise_has_no_value(images: np.ndarray, model: str, estimator: str) -> None:
    noise = np.random.default_rng(0).normal(100, 5, images.shape)
    field = measure(noise, model, estimator=estimator, window=25, sigma=7)
    assert statuses(field) <= {Status.NO_STRUCTURE, Status.INCOHERENT}
    # A window of noise may by chance look smooth enough for texture: then it is texture that does not move as one.
    assert np.mean(field.status[field.status != Status.BORDER] == Status.NO_STRUCTURE) >= 0.9
    assert_values_follow_status(field)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("model", MODELS)
def test_images_that_share_nothing_are_incoherent(images: np.ndarray, model: str, estimator: str) -> None:
    """Good smooth texture everywhere, but another one in every image."""
    random = np.random.default_rng(0)
    texture = gaussian_filter(random.normal(size=images.shape), (0, 0, 0, 1.5, 1.5))
    field = measure(100 + 30 * texture / texture.std(), model, estimator=estimator, window=25, sigma=7)
    assert statuses(field) == {Status.INCOHERENT}
    assert_values_follow_status(field)


@pytest.mark.parametrize("solver", ["fast", "jacobi"])
@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("model", MODELS)
def test_one_dimensional_texture_is_an_aperture_problem(model: str, estimator: str, solver: str) -> None:
    stripes = render(replace(SCENE, wavelengths_mm=(0.6, 1e9)))
    field = measure(stripes, model, estimator=estimator, solver=solver)
    off_border = field.status[field.status != Status.BORDER]
    assert np.mean(off_border == Status.APERTURE) >= 0.98  # by chance the noise looks like texture across the stripes
    assert_values_follow_status(field)
    if model == "flow":
        # Along the stripes nothing is known, and the standard errors say so.
        known = measure(render(SCENE), model, estimator=estimator)["flow_y_std"]
        assert np.nanmedian(field["flow_y_std"]) > 5 * np.nanmedian(known)


def test_full_texture_is_ok(images: np.ndarray) -> None:
    """What the other tests spoil."""
    for model in MODELS:
        field = measure(images, model)
        assert statuses(field) == {Status.OK}
        assert_values_follow_status(field)
        wanted = ["flow"] if model.startswith("flow") else ["flow", "depth", "normals", "translation"]
        for group in wanted:
            assert (field["identified"][field.status == Status.OK] & IDENTIFIED[group]).all(), group


def test_preshift_out_of_the_image_is_border(images: np.ndarray) -> None:
    """The border is as wide as window, filters and the shift of the outermost camera; everything, for large shifts."""
    border = measure(images).status == Status.BORDER
    rows, cols = (np.flatnonzero(~border.all(axis=axis)) for axis in (1, 0))
    height, width = border.shape
    assert (rows[0], height - 1 - rows[-1]) == (RADIUS, RADIUS)
    assert (cols[0], width - 1 - cols[-1]) == (RADIUS + 6, RADIUS + 6)
    assert not border[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1].any()
    assert statuses(measure(images, preshift=(-40, 0))) == set()


def test_pixels_that_are_not_finite_stay_in_their_windows(images: np.ndarray) -> None:
    whole = measure(images, noise=1.0)  # else estimated from the broken image, too
    broken = images.copy()
    broken[3, 0, 2, 20, 30] = np.nan
    broken[2, 0, 2, 21, 34] = np.inf
    field = measure(broken, noise=1.0)
    assert np.argwhere(field.status == Status.NOT_FINITE).tolist() == [[20, 30]]
    assert field.status[21, 34] == Status.OK  # finite at the frame that is measured
    assert_values_follow_status(field)
    # The standard errors look at the gradient smoothed once more: one filter radius further; growth at neighbours.
    near = np.zeros(field.shape, bool)
    near[20 - RADIUS - 3 : 21 + RADIUS + 4, 30 - RADIUS - 3 : 34 + RADIUS + 4] = True
    for name in whole:
        np.testing.assert_array_equal(field[name][~near], whole[name][~near], err_msg=name)
    assert 0 < np.nanmax(np.abs(field["depth"] - whole["depth"]) / field["depth_std"]) < 8


def test_masked_pixels_have_no_influence(images: np.ndarray, tmp_path: Path) -> None:
    keep = np.full(images.shape[-2:], 255, np.uint8)
    keep[18:26, 24:40] = 0
    (tmp_path / "mask.pgm").write_bytes(b"P5 64 44 255\n" + keep.tobytes())
    field = measure(images, "flow-affine", mask=tmp_path / "mask.pgm")
    np.testing.assert_array_equal((field.status == Status.MASKED)[keep == 0], True)
    np.testing.assert_array_equal((field.status == Status.MASKED)[keep != 0], False)
    assert_values_follow_status(field)
    spoiled = images.copy()
    spoiled[..., keep == 0] = 1e4
    other = measure(spoiled, "flow-affine", mask=tmp_path / "mask.pgm")
    np.testing.assert_array_equal(field.status, other.status)
    for name in ("flow_x", "flow_y"):
        np.testing.assert_array_equal(field[name], other[name], err_msg=name)
