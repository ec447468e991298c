"""Curvature of the surface around a pixel from measured slopes: planes, exact curved surfaces, jumps, noise."""

from __future__ import annotations

import numpy as np
import pytest

from leafflow_ti.capture import Geometry
from leafflow_ti.curvature import ACROSS, Around, surface_curvature
from leafflow_ti.status import Status

F_PX, PRINCIPAL, PITCH = 900.0, (60.0, 45.0), 3
Y, X = range(0, 90, PITCH), range(0, 120, PITCH)
AROUND = Around.of(6.0, PITCH)
Maps = dict[str, np.ndarray]


def maps_of(inverse: np.ndarray, along_x: np.ndarray, along_y: np.ndarray, std: float = 1e-6) -> Maps:
    """Maps of a surface from 1/Z and its derivatives by x and y [1/(mm px)], all [h, w]."""
    x, y = np.meshgrid(np.array(X) - PRINCIPAL[0], np.array(Y) - PRINCIPAL[1])
    # 1/Z = (1 - ZX X/Z - ZY Y/Z) / (distance of the plane): its slopes are those of the tangent plane.
    distance = inverse - x * along_x - y * along_y
    maps = {"depth": 1 / inverse, "slope_x": -F_PX * along_x / distance, "slope_y": -F_PX * along_y / distance}
    return maps | {f"{name}_std": np.full(inverse.shape, std) for name in ("slope_x", "slope_y")}


def surface(K: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """1/Z = (1 - η δ - ½ δ^T K δ) / 80 mm around the principal point, and its derivatives."""
    x, y = np.meshgrid(np.array(X) - PRINCIPAL[0], np.array(Y) - PRINCIPAL[1])
    eta = (4e-4, -3e-4)
    xx, xy, yy = K
    inverse = 1 - eta[0] * x - eta[1] * y - 0.5 * (xx * x * x + 2 * xy * x * y + yy * y * y)
    return inverse / 80, (-eta[0] - xx * x - xy * y) / 80, (-eta[1] - xy * x - yy * y) / 80


def curvature(maps: Maps, status: np.ndarray | None = None) -> np.ndarray:
    status = np.full(maps["depth"].shape, Status.OK, np.uint8) if status is None else status
    return surface_curvature(maps, status, Y, X, Geometry(F_PX, PRINCIPAL), AROUND)


@pytest.mark.parametrize("K", [(0.0, 0.0, 0.0), (2e-5, -1e-5, -3e-5)])
def test_curvature_is_that_of_the_surface(K: tuple[float, float, float]) -> None:
    """Relative to the depth at the pixel, at the border of the map, too; nothing stands out on a tilted plane."""
    inverse, along_x, along_y = surface(K)
    found = curvature(maps_of(inverse, along_x, along_y))
    wanted = np.array(K) / (80 * inverse)[..., None]
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-12)


def test_other_surfaces_do_not_count() -> None:
    """Half of the image lies 10 mm farther and is bent the other way; single pixels have no value."""
    near, far = maps_of(*surface((2e-5, 0.0, 1e-5))), maps_of(*(0.88 * s for s in surface((-4e-5, 0.0, 0.0))))
    left = np.arange(len(X)) < 17
    both = {name: np.where(left, near[name], far[name]) for name in near}
    status = np.full(both["depth"].shape, Status.OK, np.uint8)
    status[5, 4:9] = Status.INCOHERENT
    both["slope_x"][5, 4:9] = 30.0
    found = curvature(both, status)
    ok = status == Status.OK
    np.testing.assert_allclose(found[ok & left], curvature(near)[ok & left], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found[:, ~left], curvature(far)[:, ~left], rtol=1e-6, atol=1e-12)
    assert not found[~ok].any()


def test_pixels_on_a_line_have_none() -> None:
    maps, status = maps_of(*surface((2e-5, 0.0, 1e-5))), np.full((len(Y), len(X)), Status.BORDER, np.uint8)
    status[12] = Status.OK
    assert not curvature(maps, status).any()


def test_noise_is_no_curvature() -> None:
    """Of slopes whose errors are independent nothing is left; what stands out far is hardly less."""
    rng, std = np.random.default_rng(0), 2e-3
    bent = (8e-5, 0.0, 6e-5)
    for K in ((0.0, 0.0, 0.0), bent):
        maps = maps_of(*surface(K), std)
        for name in ("slope_x", "slope_y"):
            maps[name] = maps[name] + rng.normal(0, std, maps[name].shape)
        found = curvature(maps)
        if bent == K:
            np.testing.assert_allclose(np.median(found, axis=(0, 1)), K, atol=0.15 * K[0])
        else:
            assert np.mean(found.any(axis=-1)) < 0.01


@pytest.mark.parametrize(("sigma", "pitch"), [(19.0, 1), (19.0, 4), (9.5, 4), (19.0, 64)])
def test_pixels_around_reach_beyond_the_window(sigma: float, pitch: int) -> None:
    around = Around.of(sigma, pitch)
    assert around.offsets == tuple(-o for o in reversed(around.offsets))
    assert len(set(around.offsets)) == len(around.offsets) <= ACROSS
    assert around.reach >= 1
    assert around.reach * pitch == pytest.approx(max(2.5 * sigma, pitch), abs=0.51 * pitch)
