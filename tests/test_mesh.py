"""The surface as triangles: positions, orientation, holes, no faces across jumps of depth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from leafflow_ti.errors import InputError
from leafflow_ti.field import Field
from leafflow_ti.mesh import SurfaceMesh, slope_normals, surface_mesh, surface_points, viewing_rays

F_PX, PRINCIPAL = 1000.0, (40.0, 30.0)
Y, X = np.arange(0, 60, 4), np.arange(2, 82, 4)
PLAN = {"plan": {"f_px": F_PX, "principal_px": list(PRINCIPAL)}}


def plane(slopes: tuple[float, float] = (0.5, -0.3), depth: float = 400.0) -> dict[str, NDArray[Any]]:
    """Depth and slopes of the plane through (0, 0, depth)."""
    rx, ry = np.meshgrid((X - PRINCIPAL[0]) / F_PX, (Y - PRINCIPAL[1]) / F_PX)
    z = depth / (1 - slopes[0] * rx - slopes[1] * ry)
    return {"depth": z, "slope_x": np.full_like(z, slopes[0]), "slope_y": np.full_like(z, slopes[1])}


def field(maps: dict[str, NDArray[Any]], attrs: dict[str, Any] = PLAN) -> Field:
    as_f4 = {name: values.astype(np.float32) for name, values in maps.items()}
    return Field(as_f4, np.zeros((Y.size, X.size), np.uint8), Y, X, 0, attrs)


def area_vectors(mesh: SurfaceMesh) -> NDArray[np.float64]:
    one, two, three = (mesh.vertices[mesh.triangles[:, k]].astype(np.float64) for k in range(3))
    return np.cross(two - one, three - one) / 2


def test_points_are_depth_times_ray() -> None:
    f = field(plane())
    points = surface_points(f)
    np.testing.assert_allclose(points[3, 7, 0], f["depth"][3, 7] * (X[7] - 40) / F_PX)
    np.testing.assert_allclose(points[3, 7, 1], f["depth"][3, 7] * (Y[3] - 30) / F_PX)
    np.testing.assert_array_equal(viewing_rays(f)[..., 2], 1)


@pytest.mark.parametrize("slopes", [True, False])
def test_a_plane_is_meshed_whole_and_faces_the_camera(slopes: bool) -> None:
    maps = plane()
    mesh = surface_mesh(field(maps if slopes else {"depth": maps["depth"]}))
    assert len(mesh.vertices) == Y.size * X.size
    assert len(mesh.triangles) == 2 * (Y.size - 1) * (X.size - 1)
    normal = slope_normals(np.array(0.5), np.array(-0.3))
    np.testing.assert_allclose(normal @ [0.5, -0.3, -1], np.sqrt(1 + 0.34))
    np.testing.assert_allclose(mesh.normals, np.broadcast_to(normal, mesh.normals.shape), atol=2e-4)
    areas = area_vectors(mesh)
    assert (areas @ normal > 0).all()
    corners = surface_points(field(maps))[[0, 0, -1, -1], [0, -1, 0, -1]]  # of a planar quadrangle
    whole = (np.cross(corners[2] - corners[0], corners[1] - corners[0]) +
             np.cross(corners[1] - corners[3], corners[2] - corners[3])) / 2  # fmt: skip
    np.testing.assert_allclose(areas.sum(axis=0), whole, rtol=1e-4)


def test_values_go_to_their_vertices() -> None:
    maps = plane()
    maps["depth"][2:5, 3] = np.nan
    f = field(maps)
    mesh = surface_mesh(f)
    assert len(mesh.vertices) == Y.size * X.size - 3
    np.testing.assert_array_equal(mesh.at(f["depth"]), mesh.vertices[:, 2])
    assert mesh.triangles.max() < len(mesh.vertices)
    # Squares at a hole of three pixels: eight of them touch it; of its four corner squares one triangle each is left.
    assert len(mesh.triangles) == 2 * (Y.size - 1) * (X.size - 1) - 2 * 8 + 4


@pytest.mark.parametrize("slopes", [True, False])
def test_no_face_crosses_a_jump(slopes: bool) -> None:
    near, far = plane((0.0, 0.0), 390.0), plane((0.0, 0.0), 400.0)
    right = np.arange(X.size) >= 9
    maps = {name: np.where(right, near[name], far[name]) for name in (near if slopes else ("depth",))}
    mesh = surface_mesh(field(maps))
    sides = right[mesh.pixels % X.size][mesh.triangles]
    assert (sides.all(axis=1) | ~sides.any(axis=1)).all()
    assert len(mesh.triangles) == 2 * (Y.size - 1) * (X.size - 2)


def test_a_steep_surface_is_one_by_its_slopes() -> None:
    """Steeper than what could be told from a jump by depths alone."""
    maps = plane((6.0, 0.0))
    assert len(surface_mesh(field(maps)).triangles) == 2 * (Y.size - 1) * (X.size - 1)
    assert len(surface_mesh(field({"depth": maps["depth"]})).triangles) == 0


def test_a_lone_pixel_is_a_vertex_without_a_normal() -> None:
    depth = np.full((Y.size, X.size), np.nan)
    depth[4, 4] = 300
    mesh = surface_mesh(field({"depth": depth}))
    assert mesh.triangles.shape == (0, 3)
    assert np.isnan(mesh.normals).all()
    np.testing.assert_array_equal(mesh.pixels, [4 * X.size + 4])


def test_nothing_measured_gives_an_empty_mesh() -> None:
    mesh = surface_mesh(field({"depth": np.full((Y.size, X.size), np.nan)}))
    assert (mesh.vertices.shape, mesh.triangles.shape) == ((0, 3), (0, 3))


def test_what_has_no_surface_is_refused() -> None:
    with pytest.raises(InputError, match="no depth"):
        surface_mesh(field({"flow_x": plane()["depth"]}))
    with pytest.raises(InputError, match="geometry"):
        surface_mesh(field(plane(), {}))
