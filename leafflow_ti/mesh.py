"""The measured surface of a frame as triangles in space.

Coordinates are those of the reference camera in mm: X right, Y down, Z away from it; normals point to the camera, and
the corners of a triangle follow each other counter-clockwise as the camera sees them, so that its front faces it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import InputError
from leafflow_ti.field import Field

Floats = NDArray[np.float64]

JUMP = 1.0
"""Step of depth beyond what the slopes predict, in units of the distance between the two pixels' points across the line
of sight, that parts surfaces: the slope would have to change by more than this."""
STEEPEST = 4.0
"""The same where no slopes are known: steeper surfaces (76 degrees) are hardly seen."""


@dataclass(frozen=True, eq=False)
class SurfaceMesh:
    """Triangles between the pixels of a field that have a depth.

    ``vertices`` [n, 3] mm and ``normals`` [n, 3], float32 (NaN where neither slopes nor triangles say one);
    ``triangles`` [m, 3] int32, indices of vertices; ``pixels`` [n], position of each vertex in a flattened map.
    """

    vertices: NDArray[np.float32]
    normals: NDArray[np.float32]
    triangles: NDArray[np.int32]
    pixels: NDArray[np.intp]

    def at(self, values: NDArray[Any]) -> NDArray[Any]:
        """A map [y, x] at the vertices, [n]."""
        return np.asarray(values.reshape(-1)[self.pixels])


def surface_mesh(field: Field, jump: float = JUMP) -> SurfaceMesh:
    """The surface of a field: all pixels with a depth, triangles between neighbours on one surface.

    ``jump``: see ``JUMP``. Pass ``field.measured()`` to leave out depths of the coarse search.
    Raises InputError for a field without depth or camera geometry.
    """
    points = surface_points(field)
    slopes = _slopes(field)
    known = np.isfinite(points[..., 2])
    pixels = np.flatnonzero(known)
    number = np.full(known.size, -1, np.int32)
    number[pixels] = np.arange(pixels.size, dtype=np.int32)
    triangles = _triangles(Neighbours(points, slopes, jump), number.reshape(known.shape))
    vertices = points.reshape(-1, 3)[pixels]
    normals = _normals(vertices, triangles)
    if slopes is not None:
        measured = slope_normals(*slopes).reshape(-1, 3)[pixels]
        normals = np.where(np.isfinite(measured), measured, normals)
    return SurfaceMesh(vertices.astype(np.float32), normals.astype(np.float32), triangles, pixels)


def viewing_rays(field: Field) -> Floats:
    """Rays (x/f, y/f, 1) of the field's pixels, [y, x, 3]; a point is its depth times its ray.

    Raises InputError where the field's attributes do not say the camera's geometry.
    """
    try:
        focal, principal = float(field.attrs["plan"]["f_px"]), field.attrs["plan"]["principal_px"]
    except KeyError:
        raise InputError("these results do not say the camera's geometry: they are not from a calibrated run") from None
    rays = np.ones((*field.shape, 3))
    rays[..., 0] = (field.x - principal[0]) / focal
    rays[..., 1] = ((field.y - principal[1]) / focal)[:, None]
    return rays


def surface_points(field: Field) -> Floats:
    """Positions (X, Y, Z) [y, x, 3] of the surface in mm, NaN where there is no depth.

    Raises InputError for a field without depth or camera geometry.
    """
    if "depth" not in field:
        raise InputError("these results have no depth, so no surface: measure with a camera grid and a calibration")
    return np.asarray(viewing_rays(field) * field["depth"].astype(np.float64)[..., None])


def slope_normals(slope_x: NDArray[np.floating], slope_y: NDArray[np.floating]) -> Floats:
    """Unit normals [..., 3] towards the camera of surfaces with the slopes dZ/dX, dZ/dY [...]."""
    normals = np.stack([slope_x, slope_y, -np.ones_like(slope_x)], axis=-1).astype(np.float64)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def _slopes(field: Field) -> tuple[Floats, Floats] | None:
    if "slope_x" not in field or "slope_y" not in field:
        return None
    return field["slope_x"].astype(np.float64), field["slope_y"].astype(np.float64)


class Neighbours:
    """Which pixels lie on one surface with a neighbour.

    ``points`` [y, x, 3]: positions, NaN where there is none; ``slopes``: dZ/dX, dZ/dY [y, x]; ``jump``: see ``JUMP``.
    """

    def __init__(self, points: Floats, slopes: tuple[Floats, Floats] | None, jump: float = JUMP):
        self.depth = points[..., 2]
        self._jump = jump
        with np.errstate(invalid="ignore"):
            self._rays = points[..., :2] / self.depth[..., None]
        self._slopes = slopes

    def joined(self, first: tuple[slice, slice], second: tuple[slice, slice]) -> NDArray[np.bool_]:
        """Whether the pixels of two equal cuts through the map lie on one surface, one by one."""
        one, two = self.depth[first], self.depth[second]
        across = np.linalg.norm(self._rays[first] - self._rays[second], axis=-1) * 0.5 * (one + two)
        step = two - one
        limit = STEEPEST * across
        if self._slopes is not None:
            # Each of the two planes predicts the other depth; a curvature cancels in the mean of both.
            rise = 0.5 * (self._predicted(first, second) - one + two - self._predicted(second, first))
            known = np.isfinite(rise)
            step, limit = np.where(known, step - rise, step), np.where(known, self._jump * across, limit)
        with np.errstate(invalid="ignore"):
            return np.asarray(np.abs(step) <= limit)  # NaN is not

    def _predicted(self, source: tuple[slice, slice], target: tuple[slice, slice]) -> Floats:
        """Depth where the planes at ``source`` meet the rays at ``target``."""
        assert self._slopes is not None
        zx, zy = (s[source] for s in self._slopes)

        def below(cut: tuple[slice, slice]) -> Floats:
            return np.asarray(1 - zx * self._rays[cut][..., 0] - zy * self._rays[cut][..., 1])

        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.depth[source] * below(source) / below(target))


def _triangles(neighbours: Neighbours, number: NDArray[np.int32]) -> NDArray[np.int32]:
    """Triangles [m, 3] of the squares of four neighbouring pixels ``a b / c d``, two, one or none in each.

    ``number`` [y, x]: vertex of each pixel. A square is cut along the diagonal that gives more triangles, then along
    the one whose ends differ less in depth.
    """
    lower, upper = slice(None, -1), slice(1, None)
    a, b, c, d = (lower, lower), (lower, upper), (upper, lower), (upper, upper)
    ab, cd, ac, bd = (neighbours.joined(*pair) for pair in ((a, b), (c, d), (a, c), (b, d)))
    bc, ad = neighbours.joined(b, c), neighbours.joined(a, d)
    along_bc, along_ad = ((a, c, b), (b, c, d)), ((a, c, d), (a, d, b))
    whole_bc, whole_ad = (ab & bc & ac, bc & cd & bd), (ac & cd & ad, ad & bd & ab)
    count_bc, count_ad = (one.astype(int) + two for one, two in (whole_bc, whole_ad))
    z = neighbours.depth
    with np.errstate(invalid="ignore"):
        flatter = np.abs(z[a] - z[d]) < np.abs(z[b] - z[c])
    by_ad = (count_ad > count_bc) | ((count_ad == count_bc) & flatter)
    found = []
    for corners, whole, chosen in (
        *((corners, whole, ~by_ad) for corners, whole in zip(along_bc, whole_bc, strict=True)),
        *((corners, whole, by_ad) for corners, whole in zip(along_ad, whole_ad, strict=True)),
    ):
        take = whole & chosen
        found.append(np.stack([number[corner][take] for corner in corners], axis=-1))
    return np.concatenate(found).astype(np.int32)


def _normals(vertices: Floats, triangles: NDArray[np.int32]) -> Floats:
    """Unit normals [n, 3] at the vertices, means over their triangles weighted by area; NaN without a triangle."""
    one, two, three = (vertices[triangles[:, k]] for k in range(3))
    areas = np.cross(two - one, three - one)
    total = np.stack(
        [np.bincount(triangles.ravel(), np.repeat(areas[:, k], 3), minlength=len(vertices)) for k in range(3)], axis=-1
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(total / np.linalg.norm(total, axis=-1, keepdims=True))
