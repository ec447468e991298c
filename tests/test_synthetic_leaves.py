"""The plant-like scene: its truth against what moves, occlusion, light, layout."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.leaves import LeavesScene, render, render_image, truth
from leafflow_ti.synthetic.rig import rays_of

SCENE = LeavesScene(size=(161, 121), n_rows=3, bits=None, supersampling=1)
DARK = replace(SCENE, light_change=(0.0, 0.0, 0.0))
"""The same without changes of the light: a material point has one grey value."""


def grey_of_point(scene: LeavesScene, point: np.ndarray, frame: int, row: int, col: int) -> float:
    """What the camera sees in the direction of a world point: the scene as it is, looked at by one ray."""
    relative = point - scene.camera_position(row, col)
    label, points = scene.trace(relative[None, None] / relative[2], scene.camera_position(row, col), scene.time(frame))
    surface = scene.surfaces[label[0, 0]]
    return float(surface.albedo(surface.material(points, scene.time(frame)))[0, 0])


def some_pixels(face: np.ndarray, label: int) -> list[tuple[int, int]]:
    """A few pixels inside a surface, away from its outline."""
    inside = np.pad(face == label, 4)
    for axis in (0, 1):
        inside = inside & np.roll(inside, 4, axis) & np.roll(inside, -4, axis)
    places = np.argwhere(inside[4:-4, 4:-4])
    return [(int(y), int(x)) for y, x in places[:: max(1, len(places) // 5)]]


def test_truth_is_what_moves() -> None:
    """Velocity, acceleration and flow of points by finite differences of their exact positions, on every surface."""
    maps = truth(SCENE)
    rays = SCENE.rays()
    for label, surface in enumerate(SCENE.surfaces):
        for y, x in some_pixels(maps["face"], label):
            point = maps["depth"][y, x] * rays[y, x]
            offsets = surface.material(point, 0.0)
            before, now, after = (surface.place(offsets, t) for t in (-0.1, 0.0, 0.1))
            np.testing.assert_allclose(now, point, atol=1e-9)
            np.testing.assert_allclose(maps["velocity"][y, x], (after - before) / 0.2, atol=1e-5)
            np.testing.assert_allclose(maps["acceleration"][y, x], (after - 2 * now + before) / 0.01, atol=1e-6)
            pixels = [SCENE.f_px * p[:2] / p[2] for p in (before, after)]
            np.testing.assert_allclose(maps["flow"][y, x], (pixels[1] - pixels[0]) / 0.2, atol=1e-4)


def test_truth_of_depth_and_slopes() -> None:
    maps = truth(SCENE)
    rays = SCENE.rays()
    points = maps["depth"][..., None] * rays
    for label in range(len(SCENE.surfaces)):
        for y, x in some_pixels(maps["face"], label):
            for other in ((y, x - 3), (y - 3, x)):
                step = points[other] - points[y, x]
                assert step[2] == pytest.approx(maps["zx"][y, x] * step[0] + maps["zy"][y, x] * step[1], abs=1e-9)
                np.testing.assert_array_equal(maps["omega"][other], maps["omega"][y, x])


def test_rendered_points_correspond() -> None:
    """A material point has the same grey value in every image that sees it, where the truth's motion takes it."""
    maps = truth(DARK)
    rays = DARK.rays()
    image = render_image(DARK, 4, 1, 4)
    compared = 0
    for label, surface in enumerate(DARK.surfaces):
        for y, x in some_pixels(maps["face"], label):
            point = maps["depth"][y, x] * rays[y, x]
            offsets = surface.material(point, 0.0)
            here = image[y, x]
            for frame, row, col in ((3, 1, 4), (5, 0, 5), (6, 2, 3)):
                t, camera = DARK.time(frame), DARK.camera_position(row, col)
                moved = surface.place(offsets, t)
                ray = (moved - camera) / (moved - camera)[2]
                seen, _ = DARK.trace(ray[None, None], camera, t)
                if seen[0, 0] == label:
                    assert grey_of_point(DARK, moved, frame, row, col) == pytest.approx(here, rel=1e-9)
                    compared += 1
    assert compared > 40


def test_the_nearest_surface_is_seen() -> None:
    camera, t = SCENE.camera_position(0, 7), 2.0
    rays = rays_of(*SCENE.ray_axes())
    label, points = SCENE.trace(rays, camera, t)
    assert set(np.unique(label)) == set(range(SCENE.leaves + 1))
    hidden = 0
    for number, leaf in enumerate(SCENE.plants, start=1):
        meets = leaf.surface.intersect(rays, camera, t)
        inside = leaf.inside(leaf.surface.material(meets, t))
        assert (points[..., 2][inside] <= meets[..., 2][inside]).all()
        np.testing.assert_allclose(points[label == number], meets[label == number])
        assert inside[label == number].all()
        hidden += np.count_nonzero(inside & (label != number))
    assert hidden > 100  # leaves lie over each other


def test_disparities_and_motions_span_what_is_asked_for() -> None:
    scene = replace(SCENE, disparity_px=(4.0, 20.0), motion_px=6.0, leaves=4)
    disparity = [scene.f_px * scene.baseline_mm[0] / s.centre[2] for s in scene.surfaces]
    np.testing.assert_allclose(disparity, 4.0 * 5.0 ** (np.arange(5) / 4), rtol=1e-12)
    speed = []
    for surface in scene.surfaces:
        flow = surface.image_motion(np.array(surface.centre), np.array(surface.velocity))
        speed.append(float(np.hypot(*flow)))
    assert speed[0] == 0.0
    assert max(speed) == pytest.approx(6.0)
    assert min(speed[1:]) > 0.5


def test_light_changes_with_time_and_place_alike_for_all_cameras() -> None:
    rays = SCENE.rays()
    point = truth(SCENE)["depth"][20, 30] * rays[20, 30]
    g, gx, gy = SCENE.light_change
    assert SCENE.log_light(point, 3.0) == pytest.approx(3.0 * (g + gx * rays[20, 30, 0] + gy * rays[20, 30, 1]))
    bright, dark = (render_image(scene, 6, 1, 4) for scene in (SCENE, DARK))
    _, points = SCENE.trace(rays, np.zeros(3), 2.0)
    np.testing.assert_allclose(bright, dark * np.exp(SCENE.log_light(points, 2.0)), rtol=1e-12)


def test_seeds_decide_alone() -> None:
    np.testing.assert_array_equal(render(SCENE, [2], ([0], [8])), render(replace(SCENE), [2], ([0], [8])))
    other = replace(SCENE, layout_seed=2)
    assert not np.array_equal(truth(other)["face"], truth(SCENE)["face"])
    noisy, again, different = (replace(SCENE, noise=2.0, seed=seed) for seed in (1, 1, 2))
    image = render_image(noisy, 0, 0, 0)
    np.testing.assert_array_equal(image, render_image(again, 0, 0, 0))
    assert not np.array_equal(image, render_image(different, 0, 0, 0))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"leaves": 0}, "leaves = 0"),
        ({"leaves": 21}, "1 to 20"),
        ({"disparity_px": (30.0, 3.0)}, "nearest leaf"),
        ({"motion_px": -1.0}, "motion"),
        ({"wavelengths_px": (8.0, 4.0)}, "wavelengths"),
        ({"layout_seed": -1}, "layout_seed"),
        ({"supersampling": 0}, "supersampling"),
    ],
)
def test_scene_refuses(change: dict[str, Any], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        replace(SCENE, **change)
