"""Leaves that hide each other, masks, tiles, gaps: what the adaptive preshift makes of scenes with several surfaces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from small_plane import assert_same, files_of
from test_adaptive import F_PX, captured, errors, exact, rms, scene_of
from test_cli import call

import leafflow_ti as lf
from leafflow_ti import plan
from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.config import RunConfig, load_config
from leafflow_ti.plan import make_plan
from leafflow_ti.progress import Progress
from leafflow_ti.status import HAS_VALUE, Status
from leafflow_ti.synthetic.leaves import LeavesScene, render_image, truth
from leafflow_ti.synthetic.write import write_scene
from perf.leaves import alone
from perf.leaves import exact as exact_of_leaf

LEAVES = LeavesScene(
    size=(201, 151), n_cols=5, n_rows=3, n_frames=5, leaves=3, disparity_px=(3.0, 15.0), motion_px=6.0,
    supersampling=1, noise=1.0,
)  # fmt: skip
SLANTED = replace(scene_of(3.3, baseline_mm=2.2), zx=0.9, size=(201, 131), noise=1.0)
"""Has several labels within a tile."""
MIDDLE = (32, 32, 169, 119)
"""Windows there are full."""
OPTIONS: dict[str, object] = {
    "model": "affine-scene-flow", "window": 17, "size_time": 3, "taps_time": "3", "stride": 4, "refine": 4,
    "brightness": "spatial", "border": "clip", "preshift": "adaptive", "precision": "f32",
}  # fmt: skip
TWO_MOTIONS: dict[str, object] = {
    "model": "flow-affine", "window": 17, "sigma": 5.0, "size_time": 3, "taps_time": "3", "stride": 2, "refine": 0,
    "preshift": "adaptive", "border": "clip",
}  # fmt: skip


def rendered(scene: LeavesScene, render: object) -> Capture:
    images = np.empty((scene.n_frames, scene.n_rows, scene.n_cols, scene.size[1], scene.size[0]), np.float32)
    for key in np.ndindex(images.shape[:3]):
        images[key] = render(*key)  # type: ignore[operator]
    return capture_from_array(images, Geometry(scene.f_px, scene.principal, scene.baseline_mm))


@pytest.fixture(scope="module")
def leaves() -> Capture:
    return rendered(LEAVES, lambda *key: render_image(LEAVES, *key))


@pytest.fixture(scope="module")
def measured(leaves: Capture) -> lf.Field:
    return lf.estimate(leaves, **OPTIONS)


def face_at(field: lf.Field) -> np.ndarray:
    return truth(LEAVES)["face"][np.ix_(field.y, field.x)]


def test_leaves_are_measured_as_each_alone(measured: lf.Field) -> None:
    """Within three times the error of the same plane without an outline and without others before it."""
    face, near = face_at(measured), []
    for label in range(1, LEAVES.leaves + 1):
        seen = face == label
        single = lf.estimate(rendered(LEAVES, alone(LEAVES, label)), **{**OPTIONS, "stride": 8, "roi": MIDDLE})
        ok, known = single.status == Status.OK, exact_of_leaf(LEAVES, label, single)
        wanted = exact_of_leaf(LEAVES, label, measured)
        for name in ("depth", "velocity_x", "velocity_y", "velocity_z"):
            level = float(np.sqrt(np.nanmean((single[name] - known[name])[ok] ** 2)))
            near.append((np.abs(measured[name] - wanted[name]) <= 3 * level)[seen])
    assert np.concatenate(near).mean() > 0.88
    for n, name in enumerate(("depth", "velocity_x", "velocity_y", "velocity_z")):
        # These leaves are two to four windows wide: half of their pixels have one that ends at an outline.
        assert np.concatenate(near[n::4]).mean() > 0.8, name


def test_errors_are_what_error_bars_say_where_others_hide(measured: lf.Field) -> None:
    face = face_at(measured)
    for label in range(1, LEAVES.leaves + 1):
        wanted = exact_of_leaf(LEAVES, label, measured)
        own = (face == label) & (measured.status == Status.OK)
        assert own.sum() > 0.7 * (face == label).sum()
        for name, values in wanted.items():
            assert (np.abs(measured[name] - values) < 3 * measured[f"{name}_std"])[own].mean() > 0.9, name


def test_status_of_leaves(measured: lf.Field) -> None:
    """Next to all leaf pixels have a value; those beside another surface say so; the search's have no error bars."""
    leaf = face_at(measured) > 0
    assert np.isin(measured.status, HAS_VALUE)[leaf].mean() > 0.95
    assert 0.02 < (measured.status == Status.CONTESTED)[leaf].mean() < 0.25
    coarse = measured.status == Status.COARSE
    # Where others hide a leaf from most images the refinement takes those that are left.
    assert coarse[leaf].mean() < 0.03
    assert np.isfinite(measured["depth"][coarse]).all()
    assert np.isnan(measured["depth_std"][coarse]).all()


def config(**options: object) -> RunConfig:
    return load_config(overrides={**OPTIONS, "refine": 0, **options})


def test_tiles_change_no_bit_without_refinement(leaves: Capture) -> None:
    """A pass is the same wherever its tile begins."""
    whole = lf.estimate(leaves, **{**OPTIONS, "refine": 0})
    assert_same(whole, lf.estimate(leaves, **{**OPTIONS, "refine": 0}, tile=7))


def measured_by_tiles(monkeypatch: pytest.MonkeyPatch, tile: int, across: int, **options: object) -> lf.Field:
    """The slanted plane ``SLANTED``, computed in tiles of so many output rows, and pixels across."""
    monkeypatch.setattr(plan, "TILE_PIXELS", across)
    return lf.estimate(
        captured(SLANTED), model="affine-4d", window=21, size_time=3, taps_time="3", stride=2, tile=tile,
        preshift="adaptive", border="clip", refine=0, **options,
    )  # fmt: skip


def test_tiles_change_no_bit_where_labels_lend(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixels at the image's border whose own label has no value take a neighbouring one's, of another tile, too."""
    narrow, whole = (measured_by_tiles(monkeypatch, tile, across) for tile, across in ((10, 32), (35, 192)))
    assert np.isin(whole.status, HAS_VALUE).mean() > 0.99
    assert_same(whole, narrow)


def test_resumed_run_ends_with_the_same_bytes(leaves: Capture, tmp_path: Path) -> None:
    wanted = config(tile=10, frames="2:3")

    def die(progress: Progress) -> None:
        if progress.done_units == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lf.run(leaves, tmp_path / "out.zarr", wanted, progress=die)
    lf.run(leaves, tmp_path / "out.zarr", wanted, resume=True)
    lf.run(leaves, tmp_path / "whole.zarr", wanted)
    assert files_of(tmp_path / "out.zarr") == files_of(tmp_path / "whole.zarr")


def test_no_seams_at_tiles_and_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps between neighbouring pixels of a slanted plane: where a tile ends, they are those that the same pixels have
    inside a tile; where the whole-pixel shift changes, as elsewhere but for what filters leave of half a pixel."""
    field, whole = (
        measured_by_tiles(monkeypatch, tile, across, roi=(50, 30, 150, 100)) for tile, across in ((10, 32), (35, 192))
    )
    ok = field.status == Status.OK
    assert ok.mean() > 0.99
    maps = exact(SLANTED)
    there = np.ix_(field.y, field.x)
    disparity = -F_PX * SLANTED.baseline_mm[0] / maps["depth"][there]
    aims = np.stack([np.rint(disparity), *(np.rint(maps[f"flow_{axis}"][there]) for axis in "xy")])
    assert len(np.unique(aims[0])) > 3
    border = (np.diff(aims, axis=2) != 0).any(axis=0)
    for name in ("depth", "velocity_x", "velocity_z"):
        for axis, size in ((0, 10), (1, 16)):
            steps = [np.diff(f[name], axis=axis) for f in (field, whole)]
            seams = np.arange(1, steps[0].shape[axis] + 1) % size == 0
            assert seams.sum() == 3
            np.testing.assert_array_equal(*(np.compress(seams, step, axis=axis) for step in steps))
        across = np.diff(np.where(ok, field[name] - maps[name][there], np.nan), axis=1)
        found = [float(np.sqrt(np.nanmean(d**2))) for d in (across[border], across[~border])]
        assert found[0] < 2.0 * found[1], name


def test_growth_is_not_told_across_surfaces(leaves: Capture) -> None:
    """Differences between velocities of two leaves are no growth."""
    field = lf.estimate(leaves, **{**OPTIONS, "model": "affine-4d", "refine": 0, "arrays": "depth,growth_rate"})
    values = field["growth_rate"][np.isfinite(field["growth_rate"])]
    assert values.size > 0.4 * field.status.size
    # Velocities of neighbouring leaves differ by 5 % of their distance per frame and more.
    assert np.percentile(np.abs(values), 98) < 100.0


def test_masked_leaf_is_measured_to_its_border(tmp_path: Path) -> None:
    """A tilted, moving leaf before another texture: errors of its outermost 10 px beside those within."""
    scene = replace(LEAVES, leaves=1, disparity_px=(4.0, 9.0), motion_px=3.0, n_rows=1, size=(181, 141))
    leaf = truth(scene)["face"] == 1
    mask = tmp_path / "mask.tif"
    tifffile.imwrite(mask, np.where(leaf, np.uint8(255), np.uint8(0)))
    capture = rendered(scene, lambda *key: render_image(scene, *key))
    field = lf.estimate(capture, **{**OPTIONS, "mask": mask, "window": 25, "stride": 2, "roi": roi_of(leaf, 2)})
    there = np.ix_(field.y, field.x)
    inside = eroded(leaf, 10)[there]
    ring = leaf[there] & ~inside
    ok = np.isin(field.status, (Status.OK, Status.CONTESTED))
    assert (field.status[~leaf[there]] == Status.MASKED).all()
    assert ok[ring].mean() > 0.9
    wanted = exact_of_leaf(scene, 1, field)
    for name in ("depth", "velocity_x", "velocity_y"):
        error = field[name] - wanted[name]
        assert np.median(np.abs(error[ring & ok])) < 2 * np.median(np.abs(error[inside & ok])), name


def roi_of(mask: np.ndarray, stride: int) -> tuple[int, int, int, int]:
    """The rectangle around a mask."""
    rows, cols = np.nonzero(mask)
    x, y = (int(n.min()) // stride * stride for n in (cols, rows))
    return x, y, int(cols.max()) + 1, int(rows.max()) + 1


def eroded(mask: np.ndarray, by: int) -> np.ndarray:
    """Pixels with none outside within ``by`` rows and columns."""
    wide = np.pad(~mask, by)
    shifts = range(2 * by + 1)
    rows = np.logical_or.reduce([wide[n : n + mask.shape[0]] for n in shifts])
    return ~np.logical_or.reduce([rows[:, n : n + mask.shape[1]] for n in shifts])


def two_motions() -> np.ndarray:
    """[t, 1, 1, y, x]: the left half rests, the right half moves 4 px/frame down before it."""
    random = np.random.default_rng(3)
    texture = [smooth(random.normal(size=(140, 120))) for _ in range(2)]
    frames = []
    for t in range(-2, 3):
        still, moving = texture[0][30:110, 10:110], texture[1][30 - 4 * t : 110 - 4 * t, 10:110]
        frames.append(np.where(np.arange(100) < 50, still, moving))
    return 100 + 30 * np.array(frames)[:, None, None] + random.normal(0, 0.5, (5, 1, 1, 80, 100))


def smooth(noise: np.ndarray) -> np.ndarray:
    """Wavelengths from some 5 px, variance 1."""
    for axis in range(2):
        for _ in range(3):
            noise = (np.roll(noise, 1, axis) + 2 * noise + np.roll(noise, -1, axis)) / 4
    return noise / noise.std()


def test_one_camera_with_two_motions() -> None:
    capture = capture_from_array(two_motions(), None)
    field = lf.estimate(capture, **TWO_MOTIONS)
    left, right = field.x < 46, field.x > 54
    rows = (field.y > 14) & (field.y < 66)
    for part, speed in ((left, 0.0), (right, 4.0)):
        at = np.ix_(rows, part)
        assert (field.status[at] == Status.OK).all()
        assert rms(field["flow_y"][at] - speed) < 0.02
        assert rms(field["flow_x"][at]) < 0.02


def test_pixels_that_are_not_finite_have_no_value() -> None:
    images = two_motions()
    images[2, 0, 0, 40:44, 20:24] = np.nan
    images[:, 0, 0, 20:60, 70:] = 100.0  # no texture
    field = lf.estimate(capture_from_array(images, None), **TWO_MOTIONS)
    assert (field.status[20:22, 10:12] == Status.NOT_FINITE).all()
    assert np.isnan(field["flow_x"][20:22, 10:12]).all()
    blank = np.ix_((field.y > 30) & (field.y < 50), field.x > 84)
    assert not np.isin(field.status[blank], (Status.OK, Status.COARSE)).any()
    assert (field.status[:, :8] == Status.OK).mean() > 0.8


def test_prefilter_and_mask_with_moved_images(tmp_path: Path) -> None:
    scene = scene_of(8.2)
    keep = np.zeros(scene.size[::-1], np.uint8)
    keep[30:64, 60:96] = 1
    tifffile.imwrite(tmp_path / "mask.tif", keep)
    field = lf.estimate(
        captured(scene), model="affine-4d", window=21, size_time=3, taps_time="3", stride=4, preshift="adaptive",
        prefilter="highpass", sigma_pre=6.0, mask=tmp_path / "mask.tif", border="clip", roi=(56, 28, 100, 68),
    )  # fmt: skip
    inside = keep[np.ix_(field.y, field.x)] > 0
    assert (field.status[inside] == Status.OK).mean() > 0.95
    assert (field.status[~inside] == Status.MASKED).all()
    found = errors(field, exact(scene))
    assert rms(found["flow_x"]) < 0.01
    assert rms(found["depth"]) < 0.05


CHOICES: list[tuple[bool, dict[str, object]]] = [
    (False, {"model": "affine-4d"}),
    (False, {"model": "affine-4d", "preshift": (-8, 0)}),
    (False, {"model": "affine-4d", "preshift": "uniform"}),
    (True, {"model": "affine-4d", "preshift": "adaptive"}),
    (False, {"model": "range-flow"}),
]


@pytest.mark.parametrize(("adaptive", "options"), CHOICES, ids=str)
def test_slow_planes_keep_one_shift(adaptive: bool, options: dict[str, object]) -> None:
    scene = scene_of(0.3, n_frames=9)
    plan = make_plan(captured(scene), load_config(overrides={"window": 21, **options}))
    assert plan.adaptive is adaptive


def test_what_moves_or_spreads_is_searched(leaves: Capture) -> None:
    for capture in (leaves, captured(scene_of(3.3)), captured(scene_of(8.2, "one"))):
        model = "flow-affine" if capture.n_cols == 1 else "affine-4d"
        plan = make_plan(capture, load_config(overrides={"window": 21, "model": model, "size_time": 1}))
        assert plan.adaptive, model
    for capture in (leaves, captured(scene_of(3.3))):
        given = {"window": 21, "model": "affine-4d", "size_time": 1, "preshift": (-8, 0)}
        plan = make_plan(capture, load_config(overrides=given))
        assert (plan.adaptive, plan.preshift) == (False, (-8, 0))


def test_dry_run_and_bad_ranges(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_scene(replace(scene_of(8.2), size=(81, 61), bits=8), tmp_path / "capture")
    run = (
        "run",
        tmp_path / "capture",
        "--model",
        "affine-4d",
        "--window",
        21,
        "--set",
        "window.size_time=1",
        "--dry-run",
    )
    assert call(*run) == 0
    assert "shifted as each pixel's disparity and motion need it, tiles of" in capsys.readouterr().out
    assert call(*run, "--disparity-range", "3,1") == 3
    assert "3,1" in capsys.readouterr().err.replace(" ", "").replace(".0", "")
    assert call(*run, "--motion-range", "0") == 3
    assert "motion_range" in capsys.readouterr().err
