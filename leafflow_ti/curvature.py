"""Curvature of the surface around each output pixel, from the slopes that a model has measured there.

The refinement takes the surface in a window for

    Z0 / Z(δ) = 1 - η δ - ½ δ^T K δ        δ [px] from the pixel

and has Z0 and η among its unknowns, but not K: that is known well enough beforehand. ``g = η / Z = -∂(1/Z)/∂(x, y)`` is
constant on a plane, so ``K = Z0 ∂g/∂(x, y)`` vanishes there, however it is tilted. A plane is fitted to g over pixels
around, somewhat beyond the refinement's window, weighted by their standard errors; pixels of another surface, beyond a
jump of depth, do not count. What does not stand out from noise is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Geometry
from leafflow_ti.mesh import Neighbours
from leafflow_ti.status import Status

Array = NDArray[np.float64]

SLOPES = ("slope_x", "slope_y")
INPUTS = ("depth", *SLOPES, *(f"{name}_std" for name in SLOPES))
"""Maps that it follows from."""
REACH = 2.5
"""Farthest pixel along an axis, in σ of the refinement's window. A curvature is noisier by the square of what this is
smaller, and that of a leaf changes over larger distances."""
ACROSS = 9
"""Pixels along a side of what is fitted, at most: their windows overlap much."""
INFLATION = 17.0
"""Variance that is taken for noise, beside that of independent pixels: at least twice what simulated planes show, 2 to
8 times, the more the windows of neighbours overlap. A curvature counts as far as it stands out: on planes hardly."""
LEAST_SPREAD = 0.1
"""Smaller principal moment of the pixels around, in squared distances of neighbours: less is a line."""


@dataclass(frozen=True)
class Around:
    """Which pixels a curvature is fitted to: ``offsets`` along each axis, in output pixels ``pitch`` px apart."""

    offsets: tuple[int, ...]
    pitch: int

    @classmethod
    def of(cls, sigma: float, pitch: int) -> Around:
        """For a refinement whose window has ``sigma`` px."""
        reach = max(1, round(REACH * sigma / pitch))
        half = min(reach, ACROSS // 2)
        return cls(tuple(round(reach * k / half) for k in range(-half, half + 1)), pitch)

    @property
    def reach(self) -> int:
        """Output pixels to the farthest one along an axis."""
        return self.offsets[-1]


def surface_curvature(
    maps: Mapping[str, NDArray[Any]], status: NDArray[np.uint8], y: range, x: range, geometry: Geometry, around: Around
) -> Array:
    """K (xx, xy, yy) [h, w, 3] in 1/px² of the surface of the maps ``INPUTS`` [h, w] at the pixels ``y``, ``x``.

    0, as of a plane, where pixels without status ok, or beyond a jump of depth, leave too little around.
    """
    depth, zx, zy, *std = (np.asarray(maps[name], np.float64) for name in INPUTS)
    f, (px, py) = geometry.f_px, geometry.principal_px
    rx, ry = np.meshgrid((np.array(x) - px) / f, (np.array(y) - py) / f)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        steep = f * depth * (1 - zx * rx - zy * ry)
        values = np.stack([zx / steep, zy / steep])
        weight = 2 * steep**2 / (std[0] ** 2 + std[1] ** 2)
    known = (status == Status.OK) & np.isfinite(values).all(axis=0) & np.isfinite(weight) & (weight > 0)
    values, weight = np.where(known, values, 0.0), np.where(known, weight, 0.0)
    points = np.where(known, depth, np.nan)[..., None] * np.stack([rx, ry, np.ones_like(rx)], axis=-1)
    gradient, variance = _fitted(values, weight, Neighbours(points, (zx, zy)), around)
    K = np.stack([gradient[0, 0], 0.5 * (gradient[0, 1] + gradient[1, 0]), gradient[1, 1]], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        noise = INFLATION * variance / (K[..., 0] ** 2 + 2 * K[..., 1] ** 2 + K[..., 2] ** 2)
    kept = np.where(noise < 1, 1 - noise, 0.0)
    return np.where(known[..., None], (kept * depth)[..., None] * K, 0.0)


def _fitted(values: Array, weight: Array, neighbours: Neighbours, around: Around) -> tuple[Array, Array]:
    """Gradients [2, 2 (x, y), h, w] per px of planes fitted to ``values`` [2, h, w] around each pixel, 0 where they are
    not determined; and the mean [h, w] of ``xx² + 2 xy² + yy²`` of their symmetric part from independent noise."""
    h, w = weight.shape
    total = np.zeros((6, h, w))  # of 1, x, y, xx, xy, yy
    moments = np.zeros((3, 2, h, w))  # of the values, times 1, x, y
    for dy, dx in product(around.offsets, repeat=2):
        here, there = _overlap(h, w, dy, dx)
        counted = weight[there] * neighbours.joined(here, there)
        u, v = dx * around.pitch, dy * around.pitch
        for k, factor in enumerate((1, u, v, u * u, u * v, v * v)):
            total[k][here] += factor * counted
        for k, factor in enumerate((1, u, v)):
            moments[k][(slice(None), *here)] += factor * counted * values[(slice(None), *there)]
    with np.errstate(divide="ignore", invalid="ignore"):
        n = total[0]
        mx, my, xx, xy, yy = total[1:] / n
        xx, xy, yy = xx - mx * mx, xy - mx * my, yy - my * my
        x, y = ((moments[k] - m * moments[0]) / n for k, m in ((1, mx), (2, my)))
        det = xx * yy - xy * xy
        found = np.stack([(yy * x - xy * y) / det, (xx * y - xy * x) / det], axis=1)
        determined = det > LEAST_SPREAD * around.pitch**2 * (xx + yy)
        variance = 1.5 * (xx + yy) / (n * det)
    return np.where(determined, found, 0.0), np.where(determined, variance, np.inf)


def _overlap(h: int, w: int, dy: int, dx: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Pixels of a map that have one (dy, dx) farther, and these."""
    here = tuple(slice(max(0, -d), max(0, -d) + max(0, n - abs(d))) for n, d in ((h, dy), (w, dx)))
    there = tuple(slice(s.start + d, s.stop + d) for s, d in zip(here, (dy, dx), strict=True))
    return (here[0], here[1]), (there[0], there[1])
