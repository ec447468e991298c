"""Maps of a field as arrays of vectors."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def vectors(field: Mapping[str, ArrayLike], name: str, axes: str = "xyz") -> Array:
    """The maps ``name_x``, ``name_y``, ... of a field as one array [y, x, n]."""
    return np.stack([np.asarray(field[f"{name}_{axis}"], np.float64) for axis in axes], axis=-1)


def normals(zx: ArrayLike, zy: ArrayLike) -> Array:
    """Unit normals [..., 3] of surfaces with slopes zx, zy [...], the third component positive."""
    zx, zy = np.asarray(zx, np.float64), np.asarray(zy, np.float64)
    n = np.stack([-zx, -zy, np.ones_like(zx)], axis=-1)
    return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))


def normals_of_depth(depth: Array, f_px: float, principal_px: tuple[float, float]) -> Array:
    """Unit normals [y, x, 3] of a depth map [y, x], by central differences of its back-projected points."""
    height, width = depth.shape
    x = (np.arange(width) - principal_px[0]) / f_px
    y = (np.arange(height) - principal_px[1])[:, None] / f_px
    points = depth[..., None] * np.stack(np.broadcast_arrays(x, y, 1.0), axis=-1)
    n = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    return np.asarray(n / np.linalg.norm(n, axis=-1, keepdims=True))
