"""The synthetic cube: faces, texture, light and supersampling."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.cube import CubeScene, render, render_image, truth
from leafflow_ti.synthetic.noise_texture import noise_texture, sample

SCENE = CubeScene(size=(81, 61), f_px=750.0, bits=None, n_rows=3, wavelengths_mm=(6.0, 25.0))
"""The default scene seen in fewer, larger pixels."""

ONE_RAY = replace(SCENE, supersampling=1, background=-1.0)
NORMALS = {
    1: Rotation.from_euler("y", -30, degrees=True).apply([-1, 0, 0]),
    2: Rotation.from_euler("y", -30, degrees=True).apply([0, 0, -1]),
}


def camera(row: int, col: int) -> np.ndarray:
    return np.array([5.0 * (col - 4), 5.0 * (row - 1), 0.0])


def face_point(label: int, u: float, v: float) -> np.ndarray:
    """World position at t = 0 of a point of the left (1) or right (2) face, u and v in mm from its centre."""
    local = [-50.0, u, v] if label == 1 else [u, v, -50.0]
    return np.array(SCENE.centre) + Rotation.from_euler("y", -30, degrees=True).apply(local)


def moved(start: np.ndarray, t: float) -> np.ndarray:
    turned = Rotation.from_euler("y", 0.4 * t, degrees=True).apply(start - np.array(SCENE.centre))
    return np.array(SCENE.centre) + t * np.array([-0.2, 0.0, -1.0]) + turned


def grey_of_point(scene: CubeScene, point: np.ndarray, frame: int, row: int, col: int) -> float:
    relative = point - camera(row, col)
    x, y = scene.f_px * relative[:2] / relative[2]
    return float(render_image(replace(scene, size=(1, 1), principal_px=(-x, -y)), frame, row, col)[0, 0])


def test_two_faces_inclined_by_60_and_30_degrees() -> None:
    maps = truth(CubeScene())
    face = maps["face"]
    assert set(np.unique(face)) == {0, 1, 2}
    columns = {label: np.nonzero(face[150] == label)[0] for label in (1, 2)}
    assert columns[1].max() + 1 == columns[2].min()
    for label, inclination in ((1, 60.0), (2, 30.0)):
        zx, zy = maps["zx"][face == label], maps["zy"][face == label]
        np.testing.assert_allclose(np.degrees(np.arctan(np.hypot(zx, zy))), inclination, atol=1e-9)
    assert maps["depth"][150][columns[2].min()] == pytest.approx(970.0, abs=0.2)
    assert np.isnan(maps["depth"][face == 0]).all()
    assert np.isfinite(maps["velocity"][face > 0]).all()


@pytest.mark.parametrize("label", [1, 2])
def test_truth_is_what_moves(label: int) -> None:
    maps = truth(SCENE)
    rows, cols = np.nonzero(maps["face"] == label)
    for row, col in zip(rows[::300], cols[::300], strict=True):
        point = maps["depth"][row, col] * np.array([(col - 40.0) / 750.0, (row - 30.0) / 750.0, 1.0])
        assert (point - face_point(label, 0.0, 0.0)) @ NORMALS[label] == pytest.approx(0.0, abs=1e-9)
        before, now, after = (moved(point, t) for t in (-0.1, 0.0, 0.1))
        np.testing.assert_allclose(maps["velocity"][row, col], (after - before) / 0.2, atol=1e-5)
        np.testing.assert_allclose(maps["acceleration"][row, col], (after - 2 * now + before) / 0.01, atol=1e-6)
        image = [750.0 * p[:2] / p[2] for p in (before, after)]
        np.testing.assert_allclose(maps["flow"][row, col], (image[1] - image[0]) / 0.2, atol=1e-5)


@pytest.mark.parametrize(("label", "u", "v"), [(1, 10.0, -20.0), (1, -31.0, 12.0), (2, -20.0, 5.0), (2, -40.0, -33.0)])
def test_texture_is_fixed_to_the_box(label: int, u: float, v: float) -> None:
    start = face_point(label, u, v)
    grey = [
        grey_of_point(ONE_RAY, moved(start, frame - 4.0), frame, row, col)
        for frame, row, col in [(4, 1, 4), (0, 1, 0), (8, 1, 8), (2, 0, 5), (7, 2, 1)]
    ]
    assert grey[0] > 0.0
    np.testing.assert_allclose(grey, grey[0], rtol=1e-9)


@pytest.mark.parametrize("label", [1, 2])
@pytest.mark.parametrize(("light", "follows"), [("spot", 0.0), ("spot-camera", 1.0)])
def test_spot_is_lambert_times_a_cone(light: str, follows: float, label: int) -> None:
    point = face_point(label, 12.0, -8.0)
    lit = replace(ONE_RAY, light=light)  # type: ignore[arg-type]
    ratios = []
    for row, col in [(1, 4), (0, 8)]:
        carrier = follows * camera(row, col)
        to_lamp = carrier + np.array([-150.0, -100.0, 0.0]) - point
        axis = np.array([-150.0, -100.0, -1000.0])
        cos_lambert = NORMALS[label] @ to_lamp / np.linalg.norm(to_lamp)
        off_axis = np.arccos(to_lamp @ axis / np.linalg.norm(to_lamp) / np.linalg.norm(axis))
        expected = 0.2 + 0.8 * cos_lambert * np.exp(-0.5 * (off_axis / np.radians(4.0)) ** 2)
        ratio = grey_of_point(lit, point, 4, row, col) / grey_of_point(ONE_RAY, point, 4, row, col)
        # The cone is in terms of the chord, which is shorter than the angle by its cube / 24.
        assert ratio == pytest.approx(expected, rel=1e-3)
        ratios.append(ratio)
    assert (abs(ratios[1] / ratios[0] - 1.0) > 1e-4) == (follows == 1.0)


def test_supersampling_averages_the_pixel() -> None:
    scene = replace(SCENE, supersampling=4, light="spot")
    fine = replace(scene, supersampling=1, size=(324, 244), f_px=3000.0, principal_px=(4 * 40.0 + 1.5, 4 * 30.0 + 1.5))
    image = render_image(fine, 6, 1, 2).reshape(61, 4, 81, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(render_image(scene, 6, 1, 2), image, rtol=1e-12)


def test_images_are_8_bit_and_never_black() -> None:
    images = render(replace(SCENE, bits=8), frames=[0, 8], cameras=([1], [0, 8]))
    assert images.shape == (2, 1, 2, 61, 81)
    np.testing.assert_array_equal(images, np.rint(images))
    assert images.min() >= 1.0
    assert images.max() <= 255.0
    assert images[..., 20:40, 20:60].std() > 15.0


def test_other_faces_have_labels_too() -> None:
    above = replace(SCENE, orientation=(0.5, 0.0, 0.0), rotation_centre=(0.0, 0.0, 1000.0))
    assert set(np.unique(truth(above)["face"])) <= {0, 2, 5, 6}
    assert len(np.unique(truth(above)["face"])) == 3
    turned = replace(SCENE, orientation=(0.0, np.pi / 6, 0.0), centre=(-18.3, 0.0, 1038.3))
    assert set(np.unique(truth(turned)["face"])) == {0, 2, 3}


def test_noise_texture_is_band_limited_and_periodic() -> None:
    field = noise_texture((1, 0), 100.0, 6.0, 25.0)
    n = field.shape[0]
    assert abs(field.mean()) < 1e-6
    assert field.std() == pytest.approx(1.0, abs=1e-5)
    power = np.abs(np.fft.fft2(field.astype(np.float64))) ** 2
    wave = np.hypot(np.fft.fftfreq(n, 1 / n)[:, None], np.fft.fftfreq(n, 1 / n))
    outside = (wave < 100.0 / 25.0) | (wave > 100.0 / 6.0)
    assert power[outside].sum() < 1e-9 * power.sum()
    u, v = np.array([3.0, -7.0, 41.0]), np.array([11.0, 0.5, -49.0])
    np.testing.assert_allclose(sample(field, 100.0, u, v), sample(field, 100.0, u + 100.0, v - 200.0), atol=1e-5)
    nodes = np.arange(3) * 100.0 / n
    np.testing.assert_allclose(sample(field, 100.0, nodes, np.zeros(3)), field[0, :3], atol=1e-6)
    assert not np.allclose(noise_texture((1, 1), 100.0, 6.0, 25.0), field)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"edges_mm": (0.0, 1.0, 1.0)}, "edges"),
        ({"wavelengths_mm": (8.0, 2.0)}, "wavelengths"),
        ({"supersampling": 0}, "supersampling"),
        ({"light": "moon"}, "moon"),
        ({"light_target_mm": (-150.0, -100.0, 0.0)}, "aimed at itself"),
        ({"light_cone": 0.0}, "cone"),
        ({"ambient_share": 1.5}, "ambient share"),
    ],
)
def test_scene_refuses(change: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        replace(SCENE, **change)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"wavelengths_mm": (0.01, 8.0)}, "too fine"),
        ({"wavelengths_mm": (4.44, 4.45), "edges_mm": (9.0, 9.0, 9.0)}, "widen the band"),
        ({"centre": (0.0, 0.0, 20.0)}, "inside the box"),
    ],
)
def test_rendering_refuses(change: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        render_image(replace(SCENE, **change), 4, 1, 4)
