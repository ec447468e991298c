"""The synthetic plane: rendering follows material points, truth is their motion, the sensor does what it says."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.exact_flow import optical_flow
from leafflow_ti.synthetic.geometry import plane_axes, rotation_matrix, tangent_axes
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.plane import (
    PlaneScene,
    noise_scene,
    render,
    render_image,
    sinusoid_scene,
    truth,
)

SCENE = PlaneScene(
    f_px=700.0,
    baseline_mm=(0.6, 0.9),
    n_cols=3,
    n_rows=3,
    n_frames=5,
    size=(24, 16),
    centre=(1.5, -0.5, 90.0),
    zx=0.5,
    zy=-0.8,
    velocity=(0.3, -0.2, 0.5),
    omega=(0.02, -0.03, 0.01),
    rotation_centre=(2.0, 3.0, 95.0),
    acceleration=(0.02, 0.03, -0.01),
    wavelengths_mm=(2.0, 3.0),
    alpha=0.3,
    beta=0.7,
)


NOISE = replace(SCENE, texture="noise", wavelengths_mm=(2.0, 9.0), amplitude=25.0)


def trajectory(scene: PlaneScene, start: np.ndarray, t: float) -> np.ndarray:
    """Position of a material point, by another library's rotations."""
    pivot = np.array(scene.rotation_centre or scene.centre)
    turned = Rotation.from_rotvec(t * np.array(scene.omega)).apply(start - pivot)
    return pivot + t * np.array(scene.velocity) + 0.5 * t**2 * np.array(scene.acceleration) + turned


def on_plane(scene: PlaneScene, x: float, y: float) -> np.ndarray:
    X0, Y0, Z0 = scene.centre
    return np.array([x, y, Z0 + scene.zx * (x - X0) + scene.zy * (y - Y0)])


def grey_of_point(scene: PlaneScene, point: np.ndarray, frame: int, row: int, col: int) -> float:
    """Rendered grey value exactly where ``point`` is seen: the only pixel of an image with moved principal point."""
    sx, sy = (col - 1) * scene.baseline_mm[0], (row - 1) * scene.baseline_mm[1]
    x, y = scene.f_px * (point[:2] - (sx, sy)) / point[2]
    return float(render_image(replace(scene, size=(1, 1), principal_px=(-x, -y)), frame, row, col)[0, 0])


# --- rotations -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (1e-9, 0.0, 0.0), (0.3, -1.2, 0.7), (0.0, np.pi, 0.0)])
def test_rotation_matrix(vector: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(rotation_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-15)


def test_plane_axes_are_the_smallest_turn_to_the_normal() -> None:
    axes = plane_axes(0.5, -0.8)
    normal = np.array([-0.5, 0.8, 1.0]) / np.sqrt(1.89)
    np.testing.assert_allclose(axes[:, 2], normal, atol=1e-15)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-15)
    assert np.linalg.norm(Rotation.from_matrix(axes).as_rotvec()) == pytest.approx(np.arccos(normal[2]), abs=1e-14)


def test_tangent_axes_lie_in_the_plane() -> None:
    axes, normal = tangent_axes(0.5, -0.8), plane_axes(0.5, -0.8)[:, 2]
    np.testing.assert_allclose(axes.T @ axes, np.eye(2), atol=1e-15)
    np.testing.assert_allclose(normal @ axes, 0.0, atol=1e-15)
    np.testing.assert_allclose(np.cross(axes[:, 0], axes[:, 1]), normal, atol=1e-15)
    assert axes[1, 0] == 0.0
    assert axes[1, 1] > 0.0


# --- texture and motion ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scene", [SCENE, replace(NOISE, supersampling=1)], ids=["waves", "noise"])
@pytest.mark.parametrize("start", [(1.5, -0.5), (-1.0, 1.2), (3.1, 0.4)])
def test_a_material_point_keeps_its_grey_value(scene: PlaneScene, start: tuple[float, float]) -> None:
    point = on_plane(scene, *start)
    grey = [
        grey_of_point(scene, trajectory(SCENE, point, frame - 2.0), frame, row, col)
        for frame in range(5)
        for row in range(3)
        for col in range(3)
    ]
    np.testing.assert_allclose(grey, grey[0], rtol=1e-10)


def test_strain_stretches_lengths_along_its_axes() -> None:
    """The metric tensor of the moved axes is (1 + t E)², whatever the rigid motion."""
    rates = np.array([0.02, -0.01, 0.015])
    scene = replace(SCENE, strain=tuple(rates.tolist()), growth=0.005)
    e1, e2 = tangent_axes(SCENE.zx, SCENE.zy).T
    tensor = np.array([[0.025, 0.015], [0.015, -0.005]])
    for t in (-2.0, 1.0, 2.0):
        centre, first, second = (scene.place(p, t) for p in (np.zeros(3), e1, e2))
        moved = np.stack([first - centre, second - centre])
        np.testing.assert_allclose(centre, trajectory(SCENE, np.array(SCENE.centre), t), atol=1e-12)
        np.testing.assert_allclose(moved @ moved.T, np.linalg.matrix_power(np.eye(2) + t * tensor, 2), atol=1e-12)
        np.testing.assert_allclose(scene.material(first, t), e1, atol=1e-12)
    h = 1e-3
    points = np.array(SCENE.centre) + np.stack([e1, e2, 2.0 * e1 - e2])
    before, now, after = (scene.place(points - np.array(SCENE.centre), t) for t in (-h, 0.0, h))
    velocity, acceleration = scene.point_motion(points)
    np.testing.assert_allclose(velocity, (after - before) / (2 * h), atol=1e-9)
    np.testing.assert_allclose(acceleration, (after - 2 * now + before) / h**2, atol=1e-7)
    maps = truth(scene)
    np.testing.assert_allclose(maps["strain_rate"], np.broadcast_to([2.5, -0.5, 1.5], (16, 24, 3)), atol=1e-12)
    # The area's rate is the trace but for terms of third order.
    np.testing.assert_allclose(maps["growth_rate"], 100.0 * 0.02, atol=0.03)


def test_growth_is_the_same_strain_in_all_directions() -> None:
    one, other = replace(SCENE, growth=0.01), replace(SCENE, strain=(0.01, 0.01, 0.0))
    np.testing.assert_array_equal(render(one, [0, 4]), render(other, [0, 4]))
    assert np.abs(render(one, [4]) - render(SCENE, [4])).max() > 0.5


def test_noise_is_averaged_over_the_pixel() -> None:
    assert NOISE.rays_per_axis == 4
    fine = replace(NOISE, supersampling=1, size=(96, 64), f_px=2800.0, principal_px=(47.5, 31.5))
    image = render_image(fine, 1, 2, 0).reshape(16, 4, 24, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(render_image(NOISE, 1, 2, 0), image, rtol=1e-12)


def test_noise_has_its_contrast_and_does_not_repeat() -> None:
    image = render(noise_scene((161, 161)), [4], ([0], [4]))[0, 0, 0]
    assert image.mean() == pytest.approx(100.0, abs=10.0)
    assert image.std() == pytest.approx(25.0, rel=0.3)
    spectrum = np.abs(np.fft.fft2((image - image.mean()) * np.outer(np.hanning(161), np.hanning(161)))) ** 2
    correlation = np.fft.fftshift(np.fft.ifft2(spectrum).real) / spectrum.mean()
    y, x = np.mgrid[-80:81, -80:81]
    # The longest wave is 27 px: beyond it only what a few hundred independent waves leave by chance.
    assert correlation[(x**2 + y**2 > 27**2)].max() < 0.5
    assert np.abs(render(replace(noise_scene(), texture_seed=2), [4], ([0], [4]))[0, 0, 0] - image).max() > 20.0


def test_texture_has_its_wavelengths_and_directions() -> None:
    scene = replace(SCENE, zx=0.0, zy=0.0, omega=(0.0, 0.0, 0.0), alpha=0.3, beta=None)
    X0, Y0, Z0 = scene.centre
    first, second = np.array([np.cos(0.3), np.sin(0.3), 0.0]), np.array([-np.sin(0.3), np.cos(0.3), 0.0])
    centre = np.array([X0, Y0, Z0])
    for offset, wanted in [
        (0.0 * first, 150.0),
        (1.0 * first, 50.0),
        (1.5 * second, 50.0),
        (1.0 * first + 1.5 * second, 150.0),
        (0.5 * first, 100.0),
    ]:
        assert grey_of_point(scene, centre + offset, 2, 1, 1) == pytest.approx(wanted, abs=1e-9)
    sheared = replace(scene, beta=0.3 + np.pi / 4)
    along = np.array([np.cos(0.3 + np.pi / 4), np.sin(0.3 + np.pi / 4), 0.0])
    expected = 100.0 + 50.0 * np.cos(np.pi * np.cos(np.pi / 4))
    assert grey_of_point(sheared, centre + along, 2, 1, 1) == pytest.approx(expected, abs=1e-9)


def test_brightness_multiplies_by_the_exponential() -> None:
    terms = (
        BrightnessTerm("t", 1, 0.05, 0.01, -0.02),
        BrightnessTerm("t", 2, -0.03),
        BrightnessTerm("sx", 1, 0.02, 0.0, 0.01),
        BrightnessTerm("sy", 2, 0.04),
    )
    lit = replace(SCENE, brightness=terms)
    start = on_plane(SCENE, 2.5, -1.1)
    dx, dy = 1.0, -0.6
    for frame, row, col in [(2, 1, 1), (0, 1, 1), (4, 0, 2), (3, 2, 0)]:
        t, sx, sy = frame - 2.0, (col - 1) * 0.6, (row - 1) * 0.9
        h = (0.05 + 0.01 * dx - 0.02 * dy) * t - 0.03 * t**2 + (0.02 + 0.01 * dy) * sx + 0.04 * sy**2
        point = trajectory(SCENE, start, t)
        ratio = grey_of_point(lit, point, frame, row, col) / grey_of_point(SCENE, point, frame, row, col)
        assert np.log(ratio) == pytest.approx(h, abs=1e-12)


def test_truth_is_what_moves() -> None:
    maps = truth(SCENE)
    x, y = (np.arange(24) - 11.5) / 700.0, (np.arange(16) - 7.5) / 700.0
    rays = np.stack([*np.broadcast_arrays(x, y[:, None]), np.ones((16, 24))], axis=-1)
    points = maps["depth"][..., None] * rays
    X0, Y0, Z0 = SCENE.centre
    np.testing.assert_allclose(
        points[..., 2], Z0 + 0.5 * (points[..., 0] - X0) - 0.8 * (points[..., 1] - Y0), rtol=1e-13
    )
    assert (maps["zx"] == 0.5).all()
    assert (maps["zy"] == -0.8).all()
    h = 0.1
    for row, col in [(0, 0), (15, 23), (7, 4)]:
        before, now, after = (trajectory(SCENE, points[row, col], t) for t in (-h, 0.0, h))
        np.testing.assert_allclose(maps["velocity"][row, col], (after - before) / (2 * h), atol=1e-5)
        np.testing.assert_allclose(maps["acceleration"][row, col], (after - 2 * now + before) / h**2, atol=1e-5)
        place = np.array([x[col] * 700.0, y[row] * 700.0, 0.0, 0.0, 0.0])
        np.testing.assert_allclose(maps["flow"][row, col], optical_flow(SCENE, place), atol=1e-10)
    np.testing.assert_array_equal(maps["omega"], SCENE.omega)


def test_cameras_and_frames_are_the_axes() -> None:
    images = render(SCENE)
    assert images.shape == (5, 3, 3, 16, 24)
    np.testing.assert_array_equal(images[3, 0, 2], render_image(SCENE, 3, 0, 2))
    np.testing.assert_array_equal(render(SCENE, frames=[3], cameras=([0, 2], [2])), images[3:4, 0::2, 2:])


def test_sinusoid_is_the_one_of_the_dissertation() -> None:
    scene = sinusoid_scene()
    assert scene.f_px * scene.baseline_mm[0] / scene.centre[2] == pytest.approx(13.636, abs=1e-3)
    assert np.degrees(np.linalg.norm(scene.omega)) == pytest.approx(0.003)
    np.testing.assert_allclose(np.array(scene.omega) / scene.omega[0], (1.0, 1.5, 1.0))
    maps = truth(scene)
    np.testing.assert_allclose(maps["velocity"][80, 80], (0.0073, -0.0037, 0.06), rtol=1e-13)
    assert maps["depth"][80, 80] == pytest.approx(100.0)
    image = render(scene, frames=[4], cameras=([0], [4]))[0, 0, 0]
    assert image[80, 80] == pytest.approx(150.0)
    assert image.min() >= 50.0


# --- sensor ----------------------------------------------------------------------------------------------------------


def test_noise_is_white_and_repeatable() -> None:
    scene = replace(sinusoid_scene(noise=2.5, size=(64, 64)), n_cols=2, n_frames=2)
    noise = render(scene) - render(replace(scene, noise=0.0))
    n = noise.size
    assert abs(noise.std() / 2.5 - 1.0) < 5.0 / np.sqrt(2.0 * n)
    assert abs(noise.mean()) < 5.0 * 2.5 / np.sqrt(n)
    flat = noise.reshape(4, -1)
    assert np.abs(np.corrcoef(flat) - np.eye(4)).max() < 5.0 / np.sqrt(flat.shape[1])
    np.testing.assert_array_equal(render(scene, frames=[1]), render(scene)[1:])
    assert np.abs(render(replace(scene, seed=1)) - render(scene)).max() > 1.0


@pytest.mark.parametrize(("bits", "scale"), [(8, 1), (10, 4), (12, 16), (14, 64), (16, 256)])
def test_bit_depth_rounds_and_clips(bits: int, scale: int) -> None:
    scene = replace(SCENE, offset=128.0, amplitude=200.0)
    real, stored = render(scene), render(replace(scene, bits=bits))
    top = 2**bits - 1
    assert stored.min() == 0.0
    assert stored.max() == top
    np.testing.assert_array_equal(stored, np.rint(stored))
    inside = (scale * real > 0) & (scale * real < top)
    assert np.abs(stored - scale * real)[inside].max() <= 0.5


# --- refusals --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"n_cols": 0}, "n_cols = 0"),
        ({"size": (0, 5)}, "0x5"),
        ({"f_px": 0.0}, "f_px"),
        ({"noise": -1.0}, "noise"),
        ({"seed": -1}, "seed"),
        ({"bits": 9}, "bits = 9"),
        ({"baseline_mm": (0.0, 1.0)}, "baseline along x"),
        ({"centre": (0.0, 0.0, -1.0)}, "in front"),
        ({"wavelengths_mm": (0.0, 1.0)}, "wavelengths"),
        ({"texture": "stripes"}, "texture 'stripes'"),
        ({"texture": "noise", "wavelengths_mm": (2.0, 2.0)}, "shortest, then the longest"),
        ({"supersampling": 0}, "supersampling = 0"),
        ({"texture_seed": -1}, "texture_seed = -1"),
        ({"strain": (0.0, 0.0, 0.6)}, "vanish within the 5 frames"),
        ({"strain": (0.0, 0.0, float("nan"))}, "strain = nan"),
        ({"zx": float("nan")}, "zx = nan"),
        ({"velocity": (0.0, float("inf"), 0.0)}, "velocity = inf"),
    ],
)
def test_scene_refuses(change: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        replace(SCENE, **change)


@pytest.mark.parametrize(
    ("args", "says"), [(("u", 1, 0.1), "axis 'u'"), (("t", 0, 0.1), "power 0"), (("t", 1, np.nan), "nan")]
)
def test_brightness_refuses(args: tuple[Any, ...], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        BrightnessTerm(*args)


def test_plane_must_show_its_front() -> None:
    with pytest.raises(UsageError, match="edge-on or from behind"):
        render(replace(SCENE, zx=120.0))
    with pytest.raises(UsageError, match="t = 2 frames"):
        render(replace(SCENE, omega=(0.0, -1.0, 0.0), rotation_centre=None), frames=[4])
    with pytest.raises(UsageError, match="frame 5 does not exist"):
        render(SCENE, frames=[5])
    with pytest.raises(UsageError, match="camera row -1"):
        render(SCENE, cameras=([-1], [0]))
