"""What the texture does not determine has no value and an infinite standard error; errors of the rest are as stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr
from moving_texture import BASELINE_MM, F_PX, Moving, Texture, checks, half, plain, stripes

import leafflow_ti as lf
from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.config import load_config
from leafflow_ti.field import IDENTIFIED
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

MODELS = ["flow", "flow-affine", "affine", "affine-4d"]
SCENES: dict[str, Texture] = {
    "vertical": stripes(0.0),
    "nearly-vertical": stripes(0.1),
    "oblique": stripes(0.8),
    "horizontal": stripes(np.pi / 2),
    "single-frequency": checks,
    "half": half,
    "plain": plain,
}


def share(field: lf.Field, group: str) -> float:
    """Part of the pixels off the border that identify a group."""
    inside = field.status != Status.BORDER
    return float(np.mean((field["identified"][inside] & IDENTIFIED[group]) > 0))


def known(field: lf.Field, name: str) -> float:
    """Part of the pixels with status aperture that have a value."""
    return float(np.mean(np.isfinite(field[name][field.status == Status.APERTURE])))


@pytest.mark.parametrize("noise", [0.5, 2.0, 8.0])
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("scene", SCENES)
def test_no_confident_nonsense(scene: str, model: str, noise: float) -> None:
    moving = Moving(SCENES[scene], noise)
    field = moving.measure(model)
    for name, value in moving.truth.items():
        if name not in field:
            continue
        std = field[f"{name}_std"]
        there = np.isfinite(std)
        np.testing.assert_array_equal(there, np.isfinite(field[name]), err_msg=name)
        if there.any():
            assert np.mean(np.abs(field[name] - value)[there] <= 4 * std[there]) >= 0.98, name


@pytest.mark.parametrize("estimator", ["ols", "tls", "tls-equilibrated"])
@pytest.mark.parametrize("model", MODELS)
def test_stripes_determine_the_flow_across_them_alone(model: str, estimator: str) -> None:
    for angle, lost in ((0.0, "y"), (np.pi / 2, "x")):
        field = Moving(stripes(angle)).measure(model, estimator=estimator)
        assert np.mean(field.status[field.status != Status.BORDER] == Status.APERTURE) >= 0.98
        assert share(field, "flow") <= 0.02
        assert known(field, f"flow_{lost}") <= 0.02
        assert known(field, f"flow_{'x' if lost == 'y' else 'y'}") >= 0.98
        if model == "flow-affine":
            kept = "x" if lost == "y" else "y"
            assert share(field, "flow_gradient") <= 0.02
            for name in (f"flow_{lost}x", f"flow_{lost}y", f"strain_{lost}{lost}", "strain_xy"):
                assert known(field, name) <= 0.02, name
            assert known(field, f"strain_{kept}{kept}") >= 0.98
    field = Moving(stripes(0.8)).measure(model, estimator=estimator)
    assert known(field, "flow_x") <= 0.02
    assert known(field, "flow_y") <= 0.02


@pytest.mark.parametrize("model", ["affine", "affine-4d"])
def test_stripes_along_the_cameras_determine_no_depth(model: str) -> None:
    """Nor, without it, any motion in space; the flow across the stripes stays."""
    field = Moving(stripes(np.pi / 2)).measure(model)
    for group in ("depth", "normals", "translation", "rotation", "flow"):
        assert share(field, group) <= 0.02, group
    assert known(field, "flow_y") >= 0.98
    across = Moving(stripes(0.0)).measure(model)
    assert share(across, "depth") >= 0.98
    assert share(across, "translation") <= 0.02


@pytest.mark.parametrize("model", MODELS)
def test_texture_in_all_directions_identifies_every_group(model: str) -> None:
    field = Moving(checks).measure(model)
    grid = ["depth", "normals", "translation", "rotation"] if not model.startswith("flow") else []
    wanted = ["flow", *(["flow_gradient"] if model == "flow-affine" else []), *grid]
    assert {group for group in IDENTIFIED if share(field, group) == 1} == set(wanted)
    assert {group for group in IDENTIFIED if share(field, group) > 0} == set(wanted)


@pytest.mark.parametrize("angle", [0.0, 0.1, 0.8, 2.2])
@pytest.mark.parametrize("model", ["flow", "flow-affine", "affine-4d"])
@pytest.mark.parametrize("noise", [0.5, 5.0])
def test_normal_flow_where_only_that_is_determined(model: str, angle: float, noise: float) -> None:
    moving = Moving(stripes(angle), noise)
    field = moving.measure(model)
    aperture = field.status == Status.APERTURE
    direction = np.array([np.cos(angle), np.sin(angle)])
    size = direction @ moving.flow
    for n, axis in zip(direction, "xy", strict=True):
        found, std = field[f"normal_flow_{axis}"], field[f"normal_flow_{axis}_std"]
        assert np.isnan(found[~aperture]).all()
        assert np.isnan(std[~aperture]).all()
        there = aperture & np.isfinite(found)
        assert there.sum() >= 0.98 * aperture.sum()
        error = np.abs(found - size * n)[there]
        assert np.mean(error <= 4 * std[there]) >= 0.98
        # A noise of 5 of 40 grey values, windows of some 200 px: a hundredth of a pixel.
        assert np.median(error) < 0.005 * noise + 0.002


def test_identified_groups_are_stored_as_flags(tmp_path: Path) -> None:
    """Values that are lost, infinite errors and bits come back from a results store, with the meaning of the bits."""
    moving = Moving(stripes(0.0), n_cameras=1)
    field, out = moving.measure("flow"), tmp_path / "out.zarr"
    config = load_config(overrides={"model": "flow", "window": 17, "sigma": 5.0, "frames": "3:4"})
    lf.run(capture_from_array(moving.images(), Geometry(F_PX, (25.5, 21.5), (BASELINE_MM, BASELINE_MM))), out, config)
    found = ResultStore.open(out).field(0)
    assert set(found) == set(field)
    for name in field:
        assert found[name].dtype == field[name].dtype
        np.testing.assert_array_equal(found[name], field[name], err_msg=name)
    assert np.isinf(found["flow_y_std"]).any()
    flags = zarr.open_group(out)["identified"].attrs
    assert dict(zip(flags["flag_meanings"].split(), flags["flag_masks"], strict=True)) == IDENTIFIED


@pytest.mark.parametrize(("contrast", "divergence"), [(4.0, 0.05), (8.0, 0.05), (8.0, 0.1)])
def test_misfit_is_no_noise_and_mixes_nothing_in(contrast: float, divergence: float) -> None:
    """Strong stripes that diverge, which the model leaves out, over weak ones at right angles, which hold less than
    that residual but far more than the noise: these determine the flow across them, and it must not be mixed with
    what the strong ones leave."""
    y, x = np.mgrid[:44, :52] - np.array([22.0, 26.0])[:, None, None]
    wave = 2 * np.pi / 9
    clean = [
        100 + 40 * np.cos(wave * x * np.exp(-divergence * t)) + contrast * np.cos(wave * (y - 0.2 * t))
        for t in range(-3, 4)
    ]
    images = np.array(clean) + np.random.default_rng(0).normal(0, 0.3, (7, 44, 52))
    field = lf.estimate(capture_from_array(images[:, None, None]), frame=3, model="flow", window=17, noise=0.3)
    inside = field.status != Status.BORDER
    error, std = field["flow_y"][inside] - 0.2, field["flow_y_std"][inside]
    assert np.isfinite(error).mean() > 0.95
    assert np.mean(np.abs(error) <= 4 * std) >= 0.98
    assert np.sqrt(np.mean(error[np.isfinite(error)] ** 2)) < 0.05
