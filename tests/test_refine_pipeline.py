"""Refined maps of the pipeline: what becomes of each status, and that how the work is cut changes no bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_plane import assert_same, capture_of, files_of

import leafflow_ti as lf
from leafflow_ti import refinement
from leafflow_ti.capture import Capture
from leafflow_ti.config import RunConfig, load_config
from leafflow_ti.correlation import velocity_covariance
from leafflow_ti.field import CORRELATIONS, IDENTIFIED
from leafflow_ti.status import Status
from leafflow_ti.synthetic.plane import PlaneScene, truth

SCENE = PlaneScene(
    f_px=900.0,
    baseline_mm=(0.3, 0.3),
    n_cols=5,
    n_frames=7,
    size=(93, 77),
    centre=(0.3, -0.2, 80.0),
    zx=0.3,
    zy=-0.2,
    velocity=(0.021, -0.014, 0.06),
    omega=(0.002, -0.003, 0.004),
    texture="noise",
    wavelengths_mm=(0.6, 3.0),
    amplitude=25.0,
    noise=1.0,
)
OPTIONS: dict[str, Any] = {
    "model": "affine-4d",
    "motion": "rotation",
    "preshift": (-3, 0),
    "window": 21,
    "sigma": 6.0,
    "refine": 3,
    "refine_window": 31,
    "thin": 2,
    "stride": 5,
}


@pytest.fixture(scope="module")
def capture() -> Capture:
    return capture_of(SCENE)


FEW: dict[str, Any] = {**OPTIONS, "taps_time": "3", "size_time": 1}
"""Filters that see three frames."""


def measure(capture: Capture, **options: Any) -> lf.Field:
    return lf.estimate(capture, 3, **{**OPTIONS, **options})


def config(**options: Any) -> RunConfig:
    return load_config(overrides={**OPTIONS, **options})


@pytest.fixture(scope="module")
def refined(capture: Capture) -> lf.Field:
    return measure(capture)


@pytest.fixture(scope="module")
def plain(capture: Capture) -> lf.Field:
    return measure(capture, refine=0)


def test_refined_maps_are_better_and_know_how_good(refined: lf.Field, plain: lf.Field) -> None:
    ok = refined.status == Status.OK
    assert ok.sum() > 30
    assert ok.sum() > 0.95 * (plain.status == Status.OK).sum()
    maps = {name: values[::5, ::5] for name, values in truth(SCENE).items() if np.ndim(values) >= 2}
    wanted = {"depth": maps["depth"], "slope_x": maps["zx"], "slope_y": maps["zy"]}
    wanted |= {f"velocity_{axis}": maps["velocity"][..., i] for i, axis in enumerate("xyz")}
    for name, values in wanted.items():
        errors, before = (field[name][ok] - values[ok] for field in (refined, plain))
        assert np.std(errors) < np.std(before), name
        # Windows overlap: some dozens of pixels are worth some five windows.
        assert 0.4 < np.sqrt(np.mean((errors / refined[f"{name}_std"][ok]) ** 2)) < 1.8, name
    assert np.abs(refined["growth_rate"][ok]).max() < 5 * refined["growth_rate_std"][ok].max()


def test_what_follows_from_the_parameters(refined: lf.Field) -> None:
    """Flow, disparity and their errors, from depth and velocity at each pixel."""
    ok = refined.status == Status.OK
    x = refined.x[None, :] - SCENE.principal[0]
    flow = (SCENE.f_px * refined["velocity_x"] - x * refined["velocity_z"]) / refined["depth"]
    np.testing.assert_allclose(refined["flow_x"][ok], flow[ok], rtol=1e-4, atol=1e-6)
    disparity = refined["disparity"]
    constant = np.abs(disparity * refined["depth"])[ok]
    np.testing.assert_allclose(constant, SCENE.f_px * (1.0 if constant[0] > 500 else 0.3), rtol=1e-3)
    share = (refined["disparity_std"] / np.abs(disparity))[ok] / (refined["depth_std"] / refined["depth"])[ok]
    np.testing.assert_allclose(share, 1.0, rtol=1e-3)


def test_without_steps_nothing_is_refined(plain: lf.Field, monkeypatch: pytest.MonkeyPatch, capture: Capture) -> None:
    """The model's maps are those that the refinement begins with and leaves where it fails, bit for bit."""
    usual = refinement._call

    def fails(*arguments: Any) -> Any:
        found = usual(*arguments)
        return replace(found, code=np.ones_like(found.code))

    monkeypatch.setattr(refinement, "_call", fails)
    failed = measure(capture)
    had = plain.status == Status.OK
    assert had.sum() > 30
    np.testing.assert_array_equal(failed.status[had], Status.UNREFINED)
    np.testing.assert_array_equal(failed.status[~had], plain.status[~had])
    for name in plain:
        assert failed[name].tobytes() == plain[name].tobytes(), name
    assert np.isnan(failed["acceleration_x"]).all()


def begin_elsewhere(monkeypatch: pytest.MonkeyPatch, wrong: Any) -> list[int]:
    """Let the first call of the refinement begin with the depth of some pixels ``wrong(rows, cols)`` off by far.

    The numbers of pixels of all calls.
    """
    usual, calls = refinement._call, []

    def call(stage: Any, place: Any, rows: Any, cols: Any, start: Any, *others: Any) -> Any:
        if not calls:
            start = start.copy()
            start[wrong(rows, cols), 0] *= 3.0
        calls.append(len(rows))
        return usual(stage, place, rows, cols, start, *others)

    monkeypatch.setattr(refinement, "_call", call)
    return calls


def test_a_pixel_begins_again_where_its_neighbour_ended(
    capture: Capture, refined: lf.Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (refined.status == Status.UNREFINED).sum()
    calls = begin_elsewhere(monkeypatch, lambda rows, cols: np.arange(len(rows)) == len(rows) // 2)
    found = measure(capture)
    assert calls[1] == before + 1 or calls[1] == 1
    np.testing.assert_array_equal(found.status, refined.status)
    ok = found.status == Status.OK
    off = (found["depth"] - refined["depth"])[ok] / refined["depth_std"][ok]
    assert np.abs(off).max() < 0.3


def test_pixels_that_all_begin_elsewhere_keep_the_models_values(
    capture: Capture, plain: lf.Field, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin_elsewhere(monkeypatch, lambda rows, cols: slice(None))
    found = measure(capture)
    lost = found.status == Status.UNREFINED
    assert lost.sum() > 0.9 * (plain.status == Status.OK).sum()
    for name in plain:
        assert found[name][lost].tobytes() == plain[name][lost].tobytes(), name


def test_one_step_is_a_step(capture: Capture, refined: lf.Field) -> None:
    """A single evaluation: where it counts as refined, the values are near those of more steps."""
    one = measure(capture, refine=1)
    both = (one.status == Status.OK) & (refined.status == Status.OK)
    unrefined = one.status == Status.UNREFINED
    assert (both.sum() + unrefined.sum()) > 30
    assert (np.abs((one["depth"] - refined["depth"]) / refined["depth_std"])[both] < 2).all()


def test_strain_is_measured(capture: Capture) -> None:
    straining = capture_of(replace(SCENE, strain=(0.004, -0.002, 0.003), noise=0.2))
    found = measure(straining, deformation="strain")
    ok = found.status == Status.OK
    assert ok.sum() > 30
    for name, rate in zip(("11", "22", "12"), (0.4, -0.2, 0.3), strict=True):
        values, std = found[f"strain_rate_{name}"][ok], found[f"strain_rate_{name}_std"][ok]
        assert np.isfinite(std).all()
        assert np.mean(values) == pytest.approx(rate, abs=3 * float(std.mean()))
    growth = found["growth_rate"][ok]
    both = sum(found[f"strain_rate_{name}"][ok] for name in ("11", "22"))
    np.testing.assert_allclose(growth, both, atol=1e-3)
    axes = {"rate_1": 0.1 + np.hypot(0.3, 0.3), "rate_2": 0.1 - np.hypot(0.3, 0.3), "angle": np.pi / 8}
    for name, value in axes.items():
        values, std = found[f"principal_{name}"][ok], found[f"principal_{name}_std"][ok]
        assert np.isfinite(std).all()
        assert np.mean(values) == pytest.approx(value, abs=3 * float(std.mean()))


def test_velocities_have_the_correlations_of_their_covariance(capture: Capture, refined: lf.Field) -> None:
    """The refinement's, where it is refined; with the standard errors they make a covariance."""
    ok = refined.status == Status.OK
    covariance = velocity_covariance(refined)[ok]
    assert (np.linalg.eigvalsh(covariance / np.trace(covariance, axis1=1, axis2=2)[:, None, None]) > -1e-4).all()
    plain = measure(capture, refine=0)
    for name in CORRELATIONS:
        assert (np.abs(refined[name][ok]) <= 1).all()
        assert (refined[name][ok] != plain[name][ok]).any()
        assert np.isnan(refined[name][refined.status == Status.BORDER]).all()


FLAT = replace(
    SCENE, n_cols=1, zx=0.0, zy=0.0, velocity=(0.021, -0.014, 0.0), omega=(0.0, 0.0, 0.004),
    strain=(0.004, -0.002, 0.003),
)  # fmt: skip
IN_PLANE = {
    "flow_xx": 0.004, "flow_xy": 0.003 - 0.004, "flow_yx": 0.003 + 0.004, "flow_yy": -0.002,
    "strain_xx": 0.4, "strain_yy": -0.2, "strain_xy": 0.3,
}  # fmt: skip


@pytest.mark.parametrize("model", ["flow", "flow-affine", "flow-quadratic"])
def test_strain_of_a_plane_that_faces_one_camera(model: str) -> None:
    """Whatever the model begins with: the same values, error bars that are the scatter, and all groups identified."""
    flat = capture_of(FLAT)
    options = {"model": model, "motion": "auto", "window": 31, "sigma": 9.0, "thin": 1}
    plain, found = (measure(flat, **options, refine=steps) for steps in (0, 5))
    ok = found.status == Status.OK
    assert ok.sum() == (plain.status == Status.OK).sum() > 30
    true = IN_PLANE | {f"flow_{axis}": truth(FLAT)["flow"][::5, ::5, k][ok] for k, axis in enumerate("xy")}
    for name, value in true.items():
        for field in (found, plain):
            if name not in field:
                assert (model, field) == ("flow", plain)
                continue
            error = field[name][ok] - value
            # Windows overlap: they are worth some five. The flow is not affine in time; its models see that.
            limit = 0.1 * np.abs(value).mean() + 3 * float(field[f"{name}_std"][ok].mean())
            assert abs(error.mean()) < (limit if field is plain else 2 * float(field[f"{name}_std"][ok].mean())), name
        z = (found[name][ok] - value) / found[f"{name}_std"][ok]
        assert 0.4 < np.sqrt(np.mean(z**2)) < 1.8, name
    assert set(np.unique(found["identified"][ok])) == {IDENTIFIED["flow"] | IDENTIFIED["flow_gradient"]}
    np.testing.assert_allclose(found["strain_xx"], 100 * found["flow_xx"], rtol=1e-5)


def test_what_is_taken_as_rigid_has_no_strain() -> None:
    rigid = capture_of(replace(FLAT, strain=(0.0, 0.0, 0.0)))
    found = measure(rigid, model="flow-affine", motion="rotation", deformation="none", refine=5)
    ok = found.status == Status.OK
    assert ok.sum() > 30
    assert not [name for name in found if name.startswith("strain") or name in ("flow_xx", "flow_yy")]
    np.testing.assert_array_equal(found["flow_xy"][ok], -found["flow_yx"][ok])
    assert np.mean(found["flow_yx"][ok]) == pytest.approx(0.004, abs=2 * float(found["flow_yx_std"][ok].mean()))


def test_stripes_keep_their_status() -> None:
    """Texture in one direction: an aperture problem before is one after it; no structure is not looked at."""
    scene = replace(SCENE, texture="waves", wavelengths_mm=(0.9, 1e6), alpha=0.3, amplitude=50.0, noise=0.5)
    stripes = capture_of(scene)
    plain, found = measure(stripes, refine=0), measure(stripes)
    np.testing.assert_array_equal(found.status[plain.status != Status.OK], plain.status[plain.status != Status.OK])
    flat = capture_of(replace(scene, amplitude=0.0))
    assert (measure(flat).status == measure(flat, refine=0).status).all()
    assert not (measure(flat).status == Status.OK).any()


# --- how the work is cut ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"prefilter": "highpass", "sigma_pre": 3.0},
        {"precision": "f64"},
        {"brightness": "spatial"},
        {"model": "flow-affine"},
    ],
    ids=["plain", "prefilter", "f64", "lit", "one camera"],
)
def test_tiled_equals_whole(capture: Capture, more: dict[str, Any]) -> None:
    whole, tiled = (measure(capture, **more, tile=tile) for tile in (16, 3))
    assert_same(whole, tiled)


def test_tiled_equals_whole_with_mask(capture: Capture, refined: lf.Field, tmp_path: Path) -> None:
    mask = tmp_path / "mask.pgm"
    keep = np.full((77, 93), 255, np.uint8)
    keep[30:38, 40:52] = 0
    mask.write_bytes(b"P5 93 77 255\n" + keep.tobytes())
    whole, tiled = (measure(capture, mask=mask, tile=tile) for tile in (16, 3))
    assert_same(whole, tiled)
    assert (whole.status == Status.MASKED).sum() == np.sum(keep[::5, ::5] == 0)
    near = (whole.status == Status.OK) & (refined.status == Status.OK)
    assert (whole["depth"][near] != refined["depth"][near]).any()


def test_region_equals_crop_of_whole(capture: Capture, refined: lf.Field) -> None:
    region = measure(capture, roi=(30, 25, 66, 56))
    part = tuple(slice(n, n + size) for n, size in zip((5, 6), region.shape, strict=True))
    assert_same(refined, region, part)


def test_kept_stages_refine_as_new_ones(capture: Capture, refined: lf.Field) -> None:
    lf.release()
    new = measure(capture)
    kept = measure(capture)
    for field in (new, kept):
        np.testing.assert_array_equal(field.status, refined.status)
        for name in refined:
            np.testing.assert_array_equal(field[name], refined[name], err_msg=name)


def test_resumed_run_ends_with_the_same_bytes(capture: Capture, tmp_path: Path) -> None:
    wanted = config(tile=4, frames="2:5")

    def die(progress: Any) -> None:
        if progress.done_units == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lf.run(capture, tmp_path / "out.zarr", wanted, progress=die)
    assert len(lf.ResultStore.open(tmp_path / "out.zarr").done()) == 3
    lf.run(capture, tmp_path / "out.zarr", wanted, resume=True)
    lf.run(capture, tmp_path / "whole.zarr", wanted)
    assert files_of(tmp_path / "out.zarr") == files_of(tmp_path / "whole.zarr")
    store = lf.ResultStore.open(tmp_path / "out.zarr")
    assert_same(store.field(list(store.frames).index(3)), measure(capture, tile=4))


@pytest.mark.parametrize("frames", [(2, 2), (1, 3)])
def test_the_refinement_takes_more_frames_than_the_filters(
    capture: Capture, tmp_path: Path, frames: tuple[int, int]
) -> None:
    """Sliding through the sequence or not, it sees the same images."""
    options = {**FEW, "refine_frames": frames}
    lf.run(capture, tmp_path / "out.zarr", load_config(overrides=options))
    store = lf.ResultStore.open(tmp_path / "out.zarr")
    assert store.frames == tuple(range(frames[0], 7 - frames[1]))
    for index, frame in enumerate(store.frames):
        assert_same(store.field(index), lf.estimate(capture, frame, **options))


def test_the_same_frames_give_the_same_refinement(capture: Capture) -> None:
    """Filters of three and of five taps start it differently: it ends at the same place, within rounding and what its
    last step leaves; three frames alone end elsewhere, with twice the error bars of the velocity."""
    three, five = (
        lf.estimate(capture, 3, **{**OPTIONS, "refine": 12, "size_time": 1, "taps_time": taps, "refine_frames": more})
        for taps, more in (("3", 2), ("5", "auto"))
    )
    alone = lf.estimate(capture, 3, **{**FEW, "refine": 12})
    ok = (three.status == Status.OK) & (five.status == Status.OK) & (alone.status == Status.OK)
    assert ok.sum() > 40
    for name in ("depth", "velocity_x", "velocity_z", "rotation_z"):
        bar = five[f"{name}_std"][ok]
        assert np.quantile(np.abs(three[name] - five[name])[ok] / bar, 0.9) < 0.05, name
        assert np.median(np.abs(alone[name] - five[name])[ok] / bar) > 0.2, name
    assert np.median((alone["velocity_x_std"] / five["velocity_x_std"])[ok]) > 1.7
