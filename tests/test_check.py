"""What ``check`` finds: displaced and turned cameras, light, saturation, dead pixels, texture, disparities, motions."""

from __future__ import annotations

import functools
import json
from pathlib import Path

import numpy as np
import pytest
import tifffile

import leafflow_ti as lf
from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.cli.main import main
from leafflow_ti.inspection_report import Report
from leafflow_ti.photometry import defects, texture_of
from leafflow_ti.positions import robust_solution
from leafflow_ti.synthetic.plane import PlaneScene
from leafflow_ti.synthetic.rig import rays_of

F, Z, CAMERAS, NOISE = 5681.8, 400.0, 7, 1.0
SCENE = PlaneScene(  # 1 mm steps, some 14 px of disparity
    f_px=F, baseline_mm=(1.0, 1.0), n_cols=CAMERAS, n_frames=3, size=(300, 220), centre=(0.0, 0.0, Z), zx=0.3, zy=-0.2,
    texture="noise", wavelengths_mm=(6 * Z / F, 40 * Z / F), amplitude=25.0, offset=100.0, velocity=(0.1, 0.0, 0.0),
)  # fmt: skip
GEOMETRY = Geometry(F, SCENE.principal, (1.0, 0.0))


@functools.cache
def _image(k: int, off_mm: tuple[float, float] = (0.0, 0.0), roll: float = 0.0, t: float = 0.0) -> np.ndarray:
    """Image of camera k, which stands ``off_mm`` from its place and is turned by ``roll`` rad; no noise."""
    camera = SCENE.camera_position(0, k) + np.array([*off_mm, 0.0])

    def shade(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        rays = rays_of(x, y)
        # What the turned camera shows at (x, y) lies at the place turned back.
        flat = rays[..., :2] + roll * np.stack([rays[..., 1], -rays[..., 0]], axis=-1)
        points = SCENE.intersect(np.concatenate([flat, rays[..., 2:]], axis=-1), camera, t)
        return SCENE.albedo(SCENE.material(points, t))

    return SCENE.integrate(shade, 3)


def _capture(
    off: dict[int, tuple[float, float]] | None = None, roll: dict[int, float] | None = None, seed: int = 0
) -> Capture:
    images = [_image(k, (off or {}).get(k, (0.0, 0.0)), (roll or {}).get(k, 0.0)) for k in range(CAMERAS)]
    noisy = np.array(images) + NOISE * np.random.default_rng(seed).standard_normal((CAMERAS, *images[0].shape))
    return capture_from_array(noisy[None, None].astype(np.float32), GEOMETRY)


def _problems(found: Report) -> list[str]:
    return [one.text for one in found.advice if one.kind == "problem"]


@pytest.mark.parametrize("seed", [0, 1])
def test_an_exact_grid_raises_no_alarm(seed: int) -> None:
    found = lf.check(_capture(seed=seed))
    assert found.fine, _problems(found)
    assert found.noise == pytest.approx(NOISE, rel=0.1)
    assert found.disparity_px == (pytest.approx(-14.5, abs=0.4), pytest.approx(-13.9, abs=0.4))
    assert found.motion_px is None
    for camera in found.cameras:
        assert camera.off_um is not None
        assert camera.off_error_um is not None
        assert camera.roll_mrad is not None
        assert max(np.abs(camera.off_um) / camera.off_error_um) < 3
        assert max(camera.off_error_um) < 0.5
        assert abs(camera.roll_mrad[0]) < 0.1
        assert camera.gain is None or camera.gain == pytest.approx(1.0, abs=0.002)


@pytest.mark.parametrize(
    "off", [{5: (0.01, 0.0)}, {0: (0.0, -0.01)}, {CAMERAS // 2: (-0.01, 0.0)}, {1: (0.01, 0.0), 4: (0.0, 0.01)}]
)
def test_ten_micrometres_are_found(off: dict[int, tuple[float, float]]) -> None:
    """Every camera, also the reference, within three standard errors of where it stands."""
    found = lf.check(_capture(off))
    for k, camera in enumerate(found.cameras):
        assert camera.off_um is not None
        assert camera.off_error_um is not None
        true = 1e3 * np.array(off.get(k, (0.0, 0.0)))
        assert np.all(np.abs(camera.off_um - true) < 3 * np.array(camera.off_error_um)), f"camera {k}"
    assert not found.fine
    named = {k for k in range(CAMERAS) for text in _problems(found) if f"(row 0, column {k}) stands" in text}
    assert named == set(off)
    assert found.positions_line is not None
    pasted = np.array(json.loads(found.positions_line.partition("= ")[2]))
    true = np.array([(k + off.get(k, (0.0, 0.0))[0], off.get(k, (0.0, 0.0))[1]) for k in range(CAMERAS)])
    np.testing.assert_allclose(pasted - pasted[2], true - true[2], atol=1e-3)


def test_turned_cameras_are_found() -> None:
    found = lf.check(_capture(roll={2: 2e-3}))
    rolls = [camera.roll_mrad for camera in found.cameras]
    assert rolls[2] is not None
    assert rolls[2][0] == pytest.approx(2.0, abs=3 * rolls[2][1])
    assert any("column 2) is turned about its axis by 2.0" in text for text in _problems(found))
    # The whole row stands on a line that is turned against the images.
    slanted = lf.check(_capture({k: (0.0, 0.02 * (k - 3)) for k in range(CAMERAS)}))
    assert slanted.turn_mrad is not None
    assert slanted.turn_mrad[0] == pytest.approx(20.0, abs=max(3 * slanted.turn_mrad[1], 0.1))
    assert any("is turned by 20.0" in text for text in _problems(slanted))
    assert all(max(np.abs(camera.off_um or (9.0,))) < 1.0 for camera in slanted.cameras)


def test_light_saturation_and_dead_pixels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = np.array([_image(k) for k in range(CAMERAS)])
    images += NOISE * np.random.default_rng(0).standard_normal(images.shape)
    images[1] = 1.1 * images[1] - 4.0
    images[5] *= 1.45
    images[:, 40, 50] = 250.0
    images[:, 41, 90] = 3.0
    for k, image in enumerate(images):
        tifffile.imwrite(tmp_path / f"{k}.tif", np.clip(np.rint(image), 0, 255).astype(np.uint8))
    (tmp_path / "capture.toml").write_text(
        f'[images]\npattern = "{{sx}}.tif"\n[camera]\nfocal_length_px = {F}\n[grid]\nbaseline_mm = 1.0\n'
    )
    capture = lf.open_capture(tmp_path)
    found = lf.check(capture)
    assert found.cameras[1].gain == pytest.approx(1.1, abs=0.005)
    assert found.cameras[1].offset == pytest.approx(-4.0, abs=0.6)
    assert found.defects == ((40, 50), (41, 90))
    assert any("differ in gain" in one.text for one in found.advice)
    for k, image in enumerate(images):
        tifffile.imwrite(tmp_path / f"{k}.tif", np.clip(np.rint(1.7 * image), 0, 255).astype(np.uint8))
    bright = lf.check(tmp_path)
    assert bright.cameras[5].saturated == pytest.approx(np.mean(np.rint(1.7 * images[5]) >= 255), abs=1e-3)
    assert any("column 5) are saturated: lower the exposure" in text for text in _problems(bright))
    with pytest.raises(SystemExit) as end:
        main(["check", str(tmp_path)])
    assert end.value.code == 4
    assert "saturated: lower the exposure" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["check", str(tmp_path), "--json"])
    values = json.loads(capsys.readouterr().out)
    assert values["fine"] is False
    assert len(values["cameras"]) == CAMERAS


def test_motion_and_changing_light_of_one_camera() -> None:
    """.1 mm per frame are 1.4 px; the last frame is 5 % brighter."""
    images = np.array([_image(3, t=t) for t in (-1.0, 0.0, 1.0)])
    images[2] *= 1.05
    images += NOISE * np.random.default_rng(0).standard_normal(images.shape)
    found = lf.check(capture_from_array(images[:, None, None].astype(np.float32)))
    assert found.motion_px == pytest.approx(1.42, abs=0.3)
    assert found.frame_gains[2] == pytest.approx(1.05, abs=0.01)
    assert found.positions_mm is None
    texts = " ".join(one.text for one in found.advice)
    assert "brightness changes by up to 5" in texts
    assert "px per frame, more than filters along time follow" in texts


def test_a_blank_wall_has_too_little_texture() -> None:
    blank = 100.0 + np.random.default_rng(0).standard_normal((1, 1, 3, 150, 160))
    found = lf.check(capture_from_array(blank.astype(np.float32), Geometry(F, (80.0, 75.0), (1.0, 0.0))))
    assert not found.fine
    assert found.positions_mm is None
    assert found.texture.share == 0.0
    assert any("too little texture" in text for text in _problems(found))


def test_texture_of_a_wave() -> None:
    """Two crossed waves of 12 px: their wavelength, and the error of a displacement by Cramér and Rao."""
    y, x = np.mgrid[:200, :200].astype(float)
    k = 2 * np.pi / 12
    clean = 100 + 20 * (np.sin(k * x) + np.sin(k * y))
    noisy = clean + np.random.default_rng(0).standard_normal(clean.shape)
    found = texture_of(noisy, 1.0, 65)
    assert found.contrast == pytest.approx(20.0, rel=0.02)
    assert found.wavelength_px == pytest.approx(12.0, rel=0.06)  # central differences see sin(k) / k = .955 of it
    assert found.error_px == pytest.approx(1.0 / (65 * 20 * k / np.sqrt(2)), rel=0.07)
    assert found.share == 1.0


def test_defects_need_a_moving_scene_and_enough_images() -> None:
    rng = np.random.default_rng(0)
    images = [rng.normal(100, 10, (60, 70)) for _ in range(8)]
    assert defects(images, 1.0).size == 0
    for image in images:
        image[20, 30] = 255.0
    assert defects(images, 1.0).tolist() == [[20, 30]]
    assert defects(images[:4], 1.0).size == 0
    for image in images:
        image[40] = 200.0  # a line along the cameras' own
    assert defects(images, 1.0).tolist() == [[20, 30]]


def test_robust_solution_forgets_a_third_of_the_rows() -> None:
    x = np.arange(9.0)
    wanted = 2.0 + 3.0 * x
    wanted[[1, 5, 8]] += (7.0, -4.0, 9.0)
    found, _ = robust_solution(np.column_stack([np.ones(9), x]), wanted, 0.0)
    np.testing.assert_allclose(found, [2.0, 3.0], atol=1e-9)
