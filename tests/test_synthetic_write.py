"""Scenes as files, and the command ``simulate``."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from leafflow_ti.capture import open_capture
from leafflow_ti.cli.main import main
from leafflow_ti.errors import RunError, UsageError
from leafflow_ti.metrics import read_truth
from leafflow_ti.synthetic import cube, leaf, leaves, plane
from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.leaf import LeafScene
from leafflow_ti.synthetic.leaves import LeavesScene
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.plane import PlaneScene, sinusoid_scene
from leafflow_ti.synthetic.write import image_pattern, write_scene

SCENE = replace(sinusoid_scene(noise=1.0, size=(12, 8)), n_cols=3, n_frames=2, principal_px=(5.0, 4.25))


def truth_of(folder: Path) -> dict[str, np.ndarray]:
    with np.load(folder / "truth.npz") as archive:
        return dict(archive)


def command(*args: object) -> int:
    """Exit code of one command line."""
    with pytest.raises(SystemExit) as end:
        main([str(arg) for arg in args])
    code = end.value.code
    return code if isinstance(code, int) else 0


@pytest.mark.parametrize(
    ("grid", "pattern"),
    [
        ((1, 3, 2), "cam_{sx:02d}/frame_{t:03d}.tif"),
        ((3, 1, 2), "cam_{sy:02d}/frame_{t:03d}.tif"),
        ((2, 3, 2), "cam_{sy:02d}_{sx:02d}/frame_{t:03d}.tif"),
        ((1, 3, 1), "cam_{sx:02d}.tif"),
        ((1, 1, 2), "frame_{t:03d}.tif"),
        ((1, 1, 1), "image.tif"),
    ],
)
def test_every_grid_is_a_capture(grid: tuple[int, int, int], pattern: str, tmp_path: Path) -> None:
    rows, cols, frames = grid
    scene = replace(SCENE, n_rows=rows, n_cols=cols, n_frames=frames, bits=8)
    assert image_pattern(scene) == pattern
    write_scene(scene, tmp_path / "scene", interval_s=60.0)
    capture = open_capture(tmp_path / "scene")
    assert capture.shape == (frames, rows, cols, 8, 12)
    images = plane.render(scene)
    for t in range(frames):
        for sy in range(rows):
            for sx in range(cols):
                np.testing.assert_array_equal(capture.read(t, sy, sx, 0, 8, 0, 12), images[t, sy, sx])
    assert capture.frame_interval_s == 60.0
    assert capture.geometry is not None
    assert capture.geometry.f_px == scene.f_px
    assert capture.geometry.principal_px == (5.0, 4.25)
    assert capture.geometry.baseline_mm == (0.5 if cols > 1 else 0.0, 0.5 if rows > 1 else 0.0)


@pytest.mark.parametrize(
    ("bits", "dtype"),
    [(8, "uint8"), (10, "uint16"), (12, "uint16"), (14, "uint16"), (16, "uint16"), (None, "float32")],
)
def test_bit_depths(bits: int | None, dtype: str, tmp_path: Path) -> None:
    scene = replace(SCENE, bits=bits)
    write_scene(scene, tmp_path)
    stored = tifffile.imread(tmp_path / "cam_02" / "frame_001.tif")
    assert stored.dtype == dtype
    np.testing.assert_array_equal(stored, plane.render_image(scene, 1, 0, 2).astype(dtype))
    images = tomllib.loads((tmp_path / "capture.toml").read_text())["images"]
    assert images.get("bit_depth") == (bits if bits in (10, 12, 14) else None)


@pytest.mark.parametrize("scene", [SCENE, CubeScene(size=(40, 30), f_px=300.0, n_frames=1, n_cols=2)])
def test_truth_round_trip(scene: PlaneScene | CubeScene, tmp_path: Path) -> None:
    write_scene(scene, tmp_path / "new" / "scene")
    with np.load(tmp_path / "new" / "scene" / "truth.npz") as archive:
        stored = dict(archive)
    wanted = plane.truth(scene) if isinstance(scene, PlaneScene) else cube.truth(scene)
    for key, value in wanted.items():
        np.testing.assert_array_equal(stored[key], value)
    assert stored["frame"] == scene.n_frames // 2
    assert stored["f_px"] == scene.f_px
    np.testing.assert_array_equal(stored["baseline_mm"], scene.baseline_mm)
    np.testing.assert_array_equal(stored["principal"], scene.principal)
    assert read_truth(tmp_path / "new" / "scene" / "truth.npz")["omega"].shape == (*wanted["depth"].shape, 3)


def test_nothing_is_left_of_a_scene_that_fails(tmp_path: Path) -> None:
    turning = replace(SCENE, omega=(0.0, 1.0, 0.0), n_frames=5)
    with pytest.raises(UsageError, match="from behind"):
        write_scene(turning, tmp_path / "scene")
    assert list(tmp_path.iterdir()) == []


def test_writing_refuses(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("x")
    with pytest.raises(UsageError, match="not empty"):
        write_scene(SCENE, tmp_path)
    with pytest.raises(UsageError, match="interval = 0 s"):
        write_scene(SCENE, tmp_path / "scene", interval_s=0.0)
    with pytest.raises(RunError, match="cannot be written"):
        write_scene(SCENE, tmp_path / "precious.txt" / "scene")


# --- simulate --------------------------------------------------------------------------------------------------------


def read_images(folder: Path, frames: int, cols: int) -> np.ndarray:
    return np.array(
        [
            [tifffile.imread(folder / f"cam_{sx:02d}" / f"frame_{t:03d}.tif") for sx in range(cols)]
            for t in range(frames)
        ]
    )


def test_simulate_plane(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "p"
    options = (
        "--cameras 3 --rows 1 --frames 2 --size 12x8 --noise 1.5 --seed 4 --bits 12 --interval-s 30 --focal-px 700 "
        "--principal-px 5,4 --baseline-mm .7,.8 --centre-mm 1,2 --depth-mm 90 --slope-x -.3 --slope-y .2 "
        "--velocity -.1,.2,.3 --omega-deg .1,-.2,.3 --rotation-centre-mm 1,2,3 --acceleration .01,0,-.02 "
        "--offset 120 --amplitude 30 --wavelength-mm 2 --alpha-deg 30 --beta-deg 45 --brightness t,1,.01 "
        "--brightness sx,2,.02,.03,.04 --growth .5 --strain .1,-.1,.2 --supersampling 2"
    )
    assert command("simulate", "plane", out, *options.split()) == 0
    assert "2 frames of 1 x 3 cameras" in capsys.readouterr().out
    scene = PlaneScene(
        f_px=700.0,
        baseline_mm=(0.7, 0.8),
        n_cols=3,
        n_frames=2,
        size=(12, 8),
        principal_px=(5.0, 4.0),
        noise=1.5,
        seed=4,
        bits=12,
        centre=(1.0, 2.0, 90.0),
        zx=-0.3,
        zy=0.2,
        velocity=(-0.1, 0.2, 0.3),
        omega=tuple(np.radians((0.1, -0.2, 0.3)).tolist()),
        rotation_centre=(1.0, 2.0, 3.0),
        acceleration=(0.01, 0.0, -0.02),
        offset=120.0,
        amplitude=30.0,
        wavelengths_mm=(2.0, 2.0),
        alpha=np.pi / 6,
        beta=np.pi / 4,
        brightness=(BrightnessTerm("t", 1, 0.01), BrightnessTerm("sx", 2, 0.02, 0.03, 0.04)),
        growth=plane.linear_growth(0.5),
        strain=(0.001, -0.001, 0.002),
        supersampling=2,
    )
    np.testing.assert_array_equal(read_images(out, 2, 3), plane.render(scene)[:, 0])
    stored_truth = truth_of(out)
    np.testing.assert_allclose(stored_truth["growth_rate"], scene.growth_rate, rtol=1e-12)
    np.testing.assert_allclose(stored_truth["velocity"], plane.truth(scene)["velocity"], rtol=1e-12)


def test_simulate_plane_with_noise(tmp_path: Path) -> None:
    out = tmp_path / "p"
    options = "--texture noise --texture-seed 5 --cameras 1 --frames 1 --size 30x20 --bits 16"
    assert command("simulate", "plane", out, *options.split()) == 0
    scene = replace(plane.noise_scene((30, 20)), n_cols=1, n_frames=1, texture_seed=5, bits=16)
    np.testing.assert_array_equal(tifffile.imread(out / "image.tif"), plane.render(scene)[0, 0, 0])


def test_simulate_cube(tmp_path: Path) -> None:
    out = tmp_path / "c"
    options = (
        "--cameras 2 --frames 1 --size 40x30 --focal-px 300 --baseline-mm 6 --edges-mm 90,80,70 "
        "--orientation-deg 0,-40,0 --depth-mm 1100 --contrast 20 --background 9 --wavelength-mm 9,40 "
        "--texture-seed 3 --supersampling 2 --light spot --light-mm 10,20,30 "
        "--light-target-mm 1,2,900 --light-cone-deg 6 --ambient-share .4 --bits float --rows 1"
    )
    assert command("simulate", "cube", out, *options.split()) == 0
    scene = CubeScene(
        n_cols=2,
        n_frames=1,
        size=(40, 30),
        f_px=300.0,
        baseline_mm=(6.0, 6.0),
        bits=None,
        centre=(18.3, 0.0, 1100.0),
        edges_mm=(90.0, 80.0, 70.0),
        orientation=(0.0, np.radians(-40.0), 0.0),
        contrast=20.0,
        background=9.0,
        wavelengths_mm=(9.0, 40.0),
        texture_seed=3,
        supersampling=2,
        light="spot",
        light_mm=(10.0, 20.0, 30.0),
        light_target_mm=(1.0, 2.0, 900.0),
        light_cone=np.radians(6.0),
        ambient_share=0.4,
    )
    stored = np.array([tifffile.imread(out / f"cam_{sx:02d}.tif") for sx in range(2)])
    np.testing.assert_allclose(stored, cube.render(scene)[0, 0], rtol=1e-6)
    stored_truth = truth_of(out)
    assert set(np.unique(stored_truth["face"])) == {0, 1, 2}
    np.testing.assert_array_equal(stored_truth["growth_rate"], np.where(stored_truth["face"] > 0, 0.0, np.nan))


def test_simulate_leaf(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "l"
    options = (
        "--cameras 2 --frames 3 --size 60x50 --focal-px 700 --baseline-mm 4 --centre-mm .5,1 --depth-mm 90 "
        "--slope-x .1 --slope-y -.3 --turn-deg 30 --curvature .02,-.03 --half-mm 3,2 --pointed --velocity .1,0,.2 "
        "--omega-deg 1,2,3 --rotation-centre-mm 0,1,95 --acceleration .01,0,0 --growth .1,0 "
        "--brightness t,1,.01,.02,0 --offset 100 --contrast 20 --background 9 --wavelength-mm 1,5 "
        "--texture-seed 4 --supersampling 2 --interval-s 60"
    )
    assert command("simulate", "leaf", out, *options.split()) == 0
    assert "--preshift -31,0" in capsys.readouterr().out
    scene = LeafScene(
        n_cols=2,
        n_frames=3,
        size=(60, 50),
        f_px=700.0,
        baseline_mm=(4.0, 4.0),
        centre=(0.5, 1.0, 90.0),
        zx=0.1,
        zy=-0.3,
        turn=np.radians(30.0),
        curvature=(0.02, -0.03, 0.0),
        half_mm=(3.0, 2.0),
        pointed=True,
        velocity=(0.1, 0.0, 0.2),
        omega=tuple(np.radians([1.0, 2.0, 3.0]).tolist()),
        rotation_centre=(0.0, 1.0, 95.0),
        acceleration=(0.01, 0.0, 0.0),
        growth=(0.001, 0.0, 0.0),
        brightness=(BrightnessTerm("t", 1, 0.01, 0.02, 0.0),),
        offset=100.0,
        contrast=20.0,
        background=9.0,
        wavelengths_mm=(1.0, 5.0),
        texture_seed=4,
        supersampling=2,
    )
    np.testing.assert_array_equal(tifffile.imread(out / "cam_01" / "frame_002.tif"), leaf.render_image(scene, 2, 0, 1))
    labels = tifffile.imread(out / "labels.tif")
    assert labels.dtype == np.uint8
    np.testing.assert_array_equal(labels, truth_of(out)["region"])
    assert 100 < np.count_nonzero(labels == 1) < labels.size
    assert open_capture(out).frame_interval_s == 60.0


@pytest.mark.parametrize(("text", "growth"), [("0.1", 3 * (plane.linear_growth(0.1),)), ("0.2,0.1", (2e-3, 1e-3, 0.0))])
def test_growth_of_a_leaf(text: str, growth: tuple[float, ...], tmp_path: Path) -> None:
    small = ["--size", "40x30", "--cameras", "1", "--frames", "1", "--supersampling", "1"]
    assert command("simulate", "leaf", tmp_path / "l", *small, "--growth", text) == 0
    scene = LeafScene(size=(40, 30), n_cols=1, n_frames=1, growth=growth)  # type: ignore[arg-type]
    stored = truth_of(tmp_path / "l")
    assert read_truth(tmp_path / "l" / "truth.npz")["strain_rate"].shape == (30, 40, 3)
    for name, values in leaf.truth(scene).items():
        np.testing.assert_array_equal(stored[name], values, err_msg=name)


def test_simulate_leaves(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "l"
    options = (
        "--cameras 3 --frames 3 --size 60x50 --focal-px 500 --baseline-mm 4 --leaves 3 --disparity-px 2,9 "
        "--motion-px 3 --light-change .02,.1,0 --offset 100 --contrast 20 --wavelength-px 6,30 "
        "--layout-seed 4 --supersampling 1"
    )
    assert command("simulate", "leaves", out, *options.split()) == 0
    assert "--preshift" not in capsys.readouterr().out  # there is no one disparity
    scene = LeavesScene(
        n_cols=3,
        n_frames=3,
        size=(60, 50),
        f_px=500.0,
        baseline_mm=(4.0, 4.0),
        leaves=3,
        disparity_px=(2.0, 9.0),
        motion_px=3.0,
        light_change=(0.02, 0.1, 0.0),
        offset=100.0,
        contrast=20.0,
        wavelengths_px=(6.0, 30.0),
        layout_seed=4,
        supersampling=1,
    )
    np.testing.assert_array_equal(
        tifffile.imread(out / "cam_02" / "frame_001.tif"), leaves.render_image(scene, 1, 0, 2)
    )
    stored_truth = truth_of(out)
    assert stored_truth["omega"].shape == (50, 60, 3)
    np.testing.assert_array_equal(stored_truth["face"], leaves.truth(scene)["face"])


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["plane", "--size", "30"], "--size 30: must be WIDTHxHEIGHT"),
        (["plane", "--velocity", "1,2"], "--velocity 1,2: 3 numbers are needed, not 2"),
        (["plane", "--velocity", "a,b,c"], "must be numbers"),
        (["plane", "--bits", "nine"], "--bits nine"),
        (["plane", "--bits", "9"], "bits = 9"),
        (["plane", "--centre-mm", "1"], "--centre-mm 1: 2 numbers"),
        (["plane", "--brightness", "q,1,2"], "AXIS t, sx or sy"),
        (["plane", "--brightness", "t,1"], "--brightness t,1,"),
        (["plane", "--slope-x", "nan"], "zx = nan"),
        (["plane", "--growth", "-100"], "growth = -100 %/frame: an area cannot lose all of itself"),
        (["plane", "--growth", "70"], "would vanish within the 9 frames"),
        (["plane", "--strain", "1,2"], "--strain 1,2: 3 numbers"),
        (["plane", "--texture", "dots"], "texture 'dots'"),
        (["cube", "--light", "moon"], "light 'moon'"),
        (["leaf", "--growth", "1,2,3"], "--growth 1,2,3: 1 or 2 numbers"),
        (["leaf", "--curvature", "1"], "--curvature 1: 2 or 3 numbers"),
        (["cube", "--frames", "0"], "n_frames = 0"),
    ],
)
def test_bad_values_are_one_line(
    args: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[Any]
) -> None:
    assert command("simulate", args[0], tmp_path / "out", *args[1:]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()
