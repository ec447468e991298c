"""The integer disparity per camera step, found from shifted textures: sign, fractions, grids, refusals."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.capture import Geometry, capture_from_array, find_preshift, open_capture
from leafflow_ti.capture.capture import Capture
from leafflow_ti.errors import InputError

DATA = Path(os.environ.get("LEAFFLOW_TI_DATA", Path(__file__).parents[2] / "shared" / "data"))
H, W, MARGIN = 72, 96, 128


def _texture(seed: int = 0) -> np.ndarray:
    """Spectrum of a large periodic image of soft noise, so that it can be shifted by any fraction."""
    shape = (H + 2 * MARGIN, W + 2 * MARGIN)
    noise = np.fft.rfft2(np.random.default_rng(seed).normal(size=shape))
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])
    return noise * np.exp(-2 * np.pi**2 * 1.5**2 * (fy**2 + fx**2))


def _view(spectrum: np.ndarray, dx: float, dy: float) -> np.ndarray:
    """The part seen by a camera in which every point appears at (x + dx, y + dy)."""
    shape = (H + 2 * MARGIN, W + 2 * MARGIN)
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])
    image = np.fft.irfft2(spectrum * np.exp(-2j * np.pi * (fx * dx + fy * dy)), shape)
    return 100 + 2000 * image[MARGIN:-MARGIN, MARGIN:-MARGIN]


def _grid(
    nu: tuple[float, float], rows: int, cols: int, frames: int = 1, noise: float = 0.0, **options: object
) -> Capture:
    rng = np.random.default_rng(1)
    images = np.empty((frames, rows, cols, H, W))
    for t, sy, sx in np.ndindex(images.shape[:3]):
        images[t, sy, sx] = _view(_texture(t), nu[0] * (sx - cols // 2), nu[1] * (sy - rows // 2))
    images += noise * images.std() * rng.normal(size=images.shape)
    geometry = Geometry(1000.0, (W / 2, H / 2), (5.0 * (cols > 1), 5.0 * (rows > 1)), **options)
    return capture_from_array(images, geometry)


@pytest.mark.parametrize("nu", [0, -1, -7, -14, -30, -40])
def test_whole_steps_along_x(nu: int) -> None:
    assert find_preshift(_grid((nu, 0), 1, 3)) == (nu, 0)


@pytest.mark.parametrize("nu", [-0.4, -2.3, -6.45, -6.55, -11.8])
def test_fractions_round_to_the_smallest_residual(nu: float) -> None:
    assert find_preshift(_grid((nu, 0), 1, 5, frames=2)) == (round(nu), 0)
    assert find_preshift(_grid((0, nu), 4, 1)) == (0, round(nu))


@pytest.mark.parametrize("nu", [(-5.2, -3.7), (-9.0, -9.0), (0.3, -12.1)])
def test_both_axes_of_a_grid(nu: tuple[float, float]) -> None:
    assert find_preshift(_grid(nu, 3, 4)) == (round(nu[0]), round(nu[1]))


def test_noise_as_strong_as_the_texture() -> None:
    assert find_preshift(_grid((-8.2, 0), 1, 5, frames=2, noise=0.7)) == (-8, 0)


def test_sign_and_use_of_the_answer() -> None:
    """Camera k = +1 shows the point at x + nu with nu < 0; the block taken with the answer stands still."""
    images = np.random.default_rng(2).normal(100, 1, (1, 1, 3, H, W))
    for k in (-1, 0, 1):
        images[0, 0, k + 1, 20:50, 40 - 6 * k : 56 - 6 * k] += np.random.default_rng(5).normal(0, 40, (30, 16))
    capture = capture_from_array(images, Geometry(1000.0, (47.5, 35.5), (5.0, 0.0)))
    nx, ny = find_preshift(capture)
    assert (nx, ny) == (-6, 0)
    block = capture.block([0], [0], range(3), 20, 50, 40, 56, (nx, ny))
    np.testing.assert_allclose(block[0, 0, 0], block[0, 0, 2], atol=10)
    assert block[0, 0, 1].std() > 30


def test_images_sheared_towards_each_other() -> None:
    """With an offset the seen disparity may have either sign, as long as the total one is that of a point in front."""
    assert find_preshift(_grid((3.2, 0), 1, 3, disparity_offset_px=(-8.6, 0.0))) == (3, 0)


def test_motion_against_the_baseline_is_an_error() -> None:
    with pytest.raises(InputError, match=r"\+9 px per step along x, against the sign of baseline_mm.*--preshift X,Y"):
        find_preshift(_grid((9, 0), 1, 3))


def test_a_single_camera_needs_none() -> None:
    assert find_preshift(capture_from_array(np.zeros((2, 1, 1, 20, 20)))) == (0, 0)


@pytest.mark.parametrize("fill", [0.0, 0.1, 255.0, 60000.1])
def test_constant_images_have_no_answer(fill: float) -> None:
    images = np.full((1, 1, 3, H, W), fill)
    with pytest.raises(InputError, match=r"no clear disparity along x.*--preshift X,Y"):
        find_preshift(capture_from_array(images, Geometry(1000.0, (0.0, 0.0), (5.0, 0.0))))


def test_unrelated_images_have_no_answer() -> None:
    images = np.stack([_view(_texture(seed), 0, 0) for seed in range(4)])[None, :, None]
    with pytest.raises(InputError, match="no clear disparity along y"):
        find_preshift(capture_from_array(images, Geometry(1000.0, (0.0, 0.0), (0.0, 5.0))))


@pytest.mark.parametrize("slope", [0.0, 0.05])
@pytest.mark.parametrize("noise", [0.0, 20.0])
def test_a_texture_that_repeats_is_told(slope: float, noise: float) -> None:
    """Also where perspective stretches it, so that a wrong multiple of the period correlates best."""
    x, rng = np.arange(W), np.random.default_rng(0)
    rows = rng.normal(1, 0.1, (H, 1))
    phase = [(x + (5 + slope * x) * k) * (1 + 0.1 * slope * x / W) for k in range(3)]
    images = np.stack([100 + 50 * rows * np.cos(2 * np.pi * p / 12) for p in phase])[None, None]
    images += noise * rng.normal(size=images.shape)
    with pytest.raises(InputError, match=r"repeats every (12|24|36|48) px along x, .*--preshift X,Y"):
        find_preshift(capture_from_array(images, Geometry(1000.0, (0.0, 0.0), (5.0, 0.0))))


def test_two_depths_give_the_larger_surface() -> None:
    front, back = _grid((-15, 0), 1, 3), _grid((-6, 0), 1, 3)
    images = np.concatenate(
        [
            capture.block([0], [0], range(3), 0, H, 0, W)[..., rows, :]
            for capture, rows in ((back, slice(45)), (front, slice(27)))
        ],
        axis=-2,
    )
    assert find_preshift(capture_from_array(images, front.geometry)) == (-6, 0)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_do_not_count(value: float) -> None:
    capture = _grid((-6, 0), 1, 3)
    images = capture.block([0], [0], range(3), 0, H, 0, W, dtype=np.float64)
    images[0, 0, :, :, :12] = value  # the same margin in all cameras: no texture that stands still
    images[0, 0, 1, 30:33, 40:44] = value
    assert find_preshift(capture_from_array(images, capture.geometry)) == (-6, 0)
    with pytest.raises(InputError, match="no grey values that are finite"):
        find_preshift(capture_from_array(np.full_like(images, value), capture.geometry))


def test_tiny_images() -> None:
    with pytest.raises(InputError, match="images of 12 px are too small"):
        find_preshift(capture_from_array(np.ones((1, 1, 2, 12, 40)), Geometry(1.0, (0.0, 0.0), (5.0, 0.0))))


def test_a_real_row_of_cameras(tmp_path: Path) -> None:
    """Tsukuba head and lamp: the disparities are 5 to 14 px to the left per step, most of the image near 5 to 7."""
    source = DATA / "tsukuba_row"
    if not source.is_dir():
        pytest.skip(f"no camera row in {source}")
    (tmp_path / "capture.toml").write_text(
        f'[images]\npattern = "{source.as_posix()}/scene1.row3.col{{sx}}.ppm"\n'
        "[camera]\nfocal_length_px = 1000.0\n[grid]\nbaseline_mm = 10.0\n",
        encoding="utf-8",
    )
    nx, ny = find_preshift(open_capture(tmp_path, outside=True))
    assert -14 <= nx <= -5
    assert ny == 0
