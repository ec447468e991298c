"""The growing leaf: what is rendered follows its material, and its truth is the motion of that material."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.leaf import LeafScene, isotropic, render, render_image, truth
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.plane import PlaneScene
from leafflow_ti.synthetic.plane import truth as truth_of_plane

SCENE = LeafScene(
    f_px=900.0,
    baseline_mm=(1.5, 2.0),
    n_cols=3,
    n_rows=3,
    n_frames=5,
    size=(81, 61),
    bits=None,
    centre=(0.4, -0.2, 80.0),
    velocity=(0.1, -0.08, 0.2),
    omega=(0.02, -0.03, 0.015),
    rotation_centre=(1.0, 2.0, 85.0),
    acceleration=(0.02, 0.01, -0.03),
    curvature=(-0.06, 0.1, 0.04),
    half_mm=(3.0, 2.2),
    growth=(0.03, 0.01, -0.02),
    wavelengths_mm=(1.0, 4.0),
    supersampling=1,
)
PLACES = np.array([[0.0, 0.0], [1.5, -0.4], [-1.1, 1.0], [0.3, -1.7], [-2.2, -0.5]])
"""(p, q) on it."""


def some_pixels(maps: dict[str, Any]) -> list[tuple[int, int]]:
    return [(int(y), int(x)) for y, x in np.argwhere(maps["region"] == 1)[::97]]


def test_the_surface_bends_as_its_curvatures_say() -> None:
    p, q = PLACES.T
    offsets = SCENE.surface(PLACES) @ SCENE.axes
    np.testing.assert_allclose(offsets[:, :2], PLACES, atol=1e-12)
    np.testing.assert_allclose(offsets[:, 2], -0.03 * p**2 + 0.05 * q**2 + 0.04 * p * q, atol=1e-12)
    h = 1e-5
    zx, zy = SCENE.slopes(PLACES)
    for step in h * np.eye(2):
        dx, dy, dz = ((SCENE.surface(PLACES + step) - SCENE.surface(PLACES - step)) / (2.0 * h)).T
        np.testing.assert_allclose(dz, zx * dx + zy * dy, atol=1e-8)
    assert (zx[0], zy[0]) == pytest.approx((SCENE.zx, SCENE.zy))


@pytest.mark.parametrize("curvature", [SCENE.curvature, (0.0, 0.0, 0.0), (1e-9, 0.0, 0.0)])
def test_rays_meet_the_leaf_where_its_material_is(curvature: Any) -> None:
    scene = replace(SCENE, curvature=curvature)
    for frame, row, col in np.ndindex(5, 3, 3):
        t, camera = scene.time(frame), scene.camera_position(row, col)
        relative = scene.place(scene.surface(PLACES), t) - camera
        rays = relative / relative[:, 2:]
        np.testing.assert_allclose(scene.trace(rays, camera, t), PLACES, atol=1e-9)
        np.testing.assert_allclose(scene.pixels(relative + camera, camera), 900.0 * rays[:, :2] + [40.0, 30.0])


def test_the_nearer_part_hides_the_other() -> None:
    """A leaf bent to a half-pipe and seen from the side: its rim lies before its inside."""
    scene = replace(
        SCENE, zx=0.0, zy=0.0, turn=0.0, curvature=(0.0, -1.0, 0.0), half_mm=(3.0, 2.0), omega=(0.0, 0.0, 0.0)
    )
    camera = np.array(scene.centre) + np.array([0.0, 50.0, -2.0])
    ray = np.array([[0.0, -1.0, 0.02]])
    (_, q), *_ = scene.trace(ray, camera, 0.0)
    assert 0.0 < q < 2.0
    both = np.roots([0.5, -1.0 / 50.0, -1.0])  # offset z = -q²/2 meets z = -2 + (50 - q)/50
    assert q == pytest.approx(both.max())


def test_rendered_points_correspond() -> None:
    """A material point has one grey value wherever and whenever it is seen: looked at by the only pixel of an image."""
    grey = SCENE.albedo(PLACES)
    for frame, row, col in [(2, 1, 1), (0, 0, 2), (4, 2, 0), (3, 1, 2)]:
        camera, t = SCENE.camera_position(row, col), SCENE.time(frame)
        points = SCENE.place(SCENE.surface(PLACES), t)
        for point, wanted in zip(points, grey, strict=True):
            x, y = SCENE.pixels(point, camera) - np.array(SCENE.principal)
            only = replace(SCENE, size=(1, 1), principal_px=(-float(x), -float(y)))
            assert render_image(only, frame, row, col)[0, 0] == pytest.approx(wanted, rel=1e-9)


def test_truth_is_what_moves() -> None:
    """Velocity, acceleration, flow and rotation by finite differences of followed material."""
    maps = truth(SCENE)
    y, x = np.array(some_pixels(maps)).T
    points = SCENE.seen(x, y)
    np.testing.assert_allclose(points[:, 2], maps["depth"][y, x], rtol=1e-12)
    h = 0.01
    before, now, after = (SCENE.follow(points, t) for t in (-h, 0.0, h))
    np.testing.assert_allclose(now, points, atol=1e-11)
    np.testing.assert_allclose(maps["velocity"][y, x], (after - before) / (2 * h), atol=1e-6)
    np.testing.assert_allclose(maps["acceleration"][y, x], (after - 2 * now + before) / h**2, atol=1e-6)
    flow = (SCENE.pixels(after) - SCENE.pixels(before)) / (2 * h)
    np.testing.assert_allclose(maps["flow"][y, x], flow, atol=1e-4)


def test_rotation_and_strain_are_those_of_surface_elements() -> None:
    """Two short lines on the surface move by v = ω × d + D d, with D the strain rates in the surface."""
    maps = truth(SCENE)
    y, x = np.array(some_pixels(maps)).T
    h, dt = 0.02, 1e-4
    for dx, dy in ((h, 0.0), (0.0, h), (h, -h)):
        ends = [SCENE.seen(x + sign * dx, y + sign * dy) for sign in (1.0, -1.0)]
        d = ends[0] - ends[1]
        v = sum(sign * (SCENE.follow(p, dt) - SCENE.follow(p, -dt)) for sign, p in zip((1, -1), ends, strict=True))
        v = v / (2.0 * dt)
        zx, zy = maps["zx"][y, x], maps["zy"][y, x]
        e1 = np.stack([np.ones_like(zx), 0.0 * zx, zx], axis=-1)
        e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
        normal = np.stack([-zx, -zy, np.ones_like(zx)], axis=-1) / np.sqrt(1.0 + zx**2 + zy**2)[:, None]
        e2 = np.cross(normal, e1)
        d11, d22, d12 = maps["strain_rate"][y, x].T / 100.0
        a, b = np.sum(d * e1, axis=-1), np.sum(d * e2, axis=-1)
        stretched = (d11 * a + d12 * b)[:, None] * e1 + (d12 * a + d22 * b)[:, None] * e2
        length = np.linalg.norm(d, axis=-1, keepdims=True)
        np.testing.assert_allclose(v / length, (np.cross(maps["omega"][y, x], d) + stretched) / length, atol=1e-6)


def test_growth_and_surface_strain_are_those_of_one_frame() -> None:
    """Area and metric of small elements, half a frame before and half a frame after."""
    maps = truth(SCENE)
    y, x = np.array(some_pixels(maps)).T
    h = 0.01
    sides = [
        [SCENE.follow(SCENE.seen(x + sign * dx, y + sign * dy), t) for sign in (1.0, -1.0) for t in (-0.5, 0.5)]
        for dx, dy in ((h, 0.0), (0.0, h))
    ]
    # Their vectors along x and y, before and after: [n, 2, 3].
    before, after = (np.stack([s[i] - s[2 + i] for s in sides], axis=1) for i in (0, 1))
    metric = [v @ v.transpose(0, 2, 1) for v in (before, after)]
    area = np.sqrt(np.linalg.det(metric[1]) / np.linalg.det(metric[0]))
    np.testing.assert_allclose(maps["growth_rate"][y, x], 100.0 * (area - 1.0), atol=1e-5)
    # Stretches are the roots of the generalised eigenvalues of both metrics; Lagrangian strain is (stretch² - 1)/2.
    values = np.linalg.eigvals(np.linalg.solve(metric[0], metric[1]))
    principal = 50.0 * (np.sort(values.real, axis=-1) - 1.0)
    s11, s22, s12 = maps["surface_strain"][y, x].T
    found = np.linalg.eigvalsh(np.stack([np.stack([s11, s12], -1), np.stack([s12, s22], -1)], -1))
    np.testing.assert_allclose(found, principal, atol=1e-5)
    # To first order it is the strain rate.
    np.testing.assert_allclose(maps["surface_strain"], maps["strain_rate"], atol=0.1)


def test_isotropic_growth_is_the_same_on_any_curvature() -> None:
    maps = truth(replace(SCENE, growth=isotropic(0.1)))
    leaf = maps["region"] == 1
    np.testing.assert_allclose(maps["growth_rate"][leaf], 0.1, rtol=1e-9)
    np.testing.assert_allclose(maps["surface_strain"][leaf] - [0.05, 0.05, 0.0], 0.0, atol=1e-4)
    np.testing.assert_allclose(maps["omega"][leaf], np.broadcast_to(SCENE.omega, (leaf.sum(), 3)), atol=1e-12)


def test_a_flat_leaf_is_a_plane() -> None:
    rigid = ("f_px", "baseline_mm", "n_cols", "n_rows", "n_frames", "size", "centre", "velocity", "omega")
    shared = {name: getattr(SCENE, name) for name in (*rigid, "rotation_centre", "acceleration", "zx", "zy")}
    flat = replace(SCENE, curvature=(0.0, 0.0, 0.0), turn=0.0, growth=(0.03, 0.01, 0.0))
    plane = truth_of_plane(PlaneScene(strain=(0.03, 0.01, 0.0), **shared))
    maps = truth(flat)
    leaf = maps["region"] == 1
    assert 300 < leaf.sum() < leaf.size
    for name, values in plane.items():
        if name == "omega":
            np.testing.assert_allclose(maps[name][leaf], np.broadcast_to(values, (leaf.sum(), 3)), atol=1e-12)
        else:
            np.testing.assert_allclose(maps[name][leaf], values[leaf], atol=1e-9, err_msg=name)
            assert np.isnan(maps[name][~leaf]).all()


def test_light_and_background() -> None:
    lit = replace(SCENE, brightness=(BrightnessTerm("t", 1, 0.05, 0.01, -0.02),))
    bright, dark = (render(scene, [3], ([1], [1]))[0, 0, 0] for scene in (lit, SCENE))
    inside = dark != SCENE.background
    y, x = np.argwhere(inside)[400]
    dx, dy, _ = SCENE.material(SCENE.seen(x, y, 1.0), 1.0)
    assert np.log(bright[y, x] / dark[y, x]) == pytest.approx(0.05 + 0.01 * dx - 0.02 * dy, abs=1e-12)
    assert (bright[~inside] == SCENE.background).all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"half_mm": (1.0, 0.0)}, "half length and width"),
        ({"wavelengths_mm": (2.0, 1.0)}, "shortest, then the longest"),
        ({"supersampling": 0}, "supersampling = 0"),
        ({"texture_seed": -1}, "texture_seed = -1"),
        ({"growth": (0.0, -0.6, 0.0)}, "strain rates of .*vanish within the 5 frames"),
        ({"curvature": (0.0, float("nan"), 0.0)}, "curvature = nan"),
    ],
)
def test_scene_refuses(change: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        replace(SCENE, **change)
