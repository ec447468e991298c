"""Strain of a surface from the motion around a pixel: a virtual strain gauge on the curved surface.

In a square window of pixels a plane is fitted, by least squares in the pixel coordinates, to the positions ``s(x, y)``
and with the same weights to the velocities ``f(x, y)``. The fits' slopes ``a, b = ∂s/∂x, ∂s/∂y`` and ``p, q = ∂f/∂x,
∂f/∂y`` span the surface element; within a frame it goes from ``a - p/2, b - q/2`` to ``a + p/2, b + q/2``. As the
operator is one and the same, rigid motion is no strain at all, and homogeneous growth is its own rate, however the
surface is curved and whatever is cut from the window.

With orthonormal tangents ``T`` of the element (axis 1 in the plane of X and Z, axis 2 at right angles), the derivatives
``D = (∂f/∂1, ∂f/∂2)`` along them and ``H = T^T D``, the metric before is ``L = 1 - (H + H^T)/2 + D^T D/4`` and that
after ``L + H + H^T``. The Lagrangian strain, in the axes that the symmetric root makes orthonormal, is

    E = L^(-1/2) (H + H^T)/2 L^(-1/2),        area rate = √(det(L + H + H^T) / det L) - 1

A window holds the pixels that are connected to its own within it, without a jump of depth or a gap.

Standard errors. What the images show of a motion is the displacement across the line of sight and the approach:
``m = M^-1 N``, ``M = (1 0 X/Z; 0 1 Y/Z; 0 0 1)``. Its covariance is taken for the same throughout the window (the
mean), and M as it varies, which is linear in x and y. Slopes with the weights c have the covariances ``(c u)^T R
(c v)`` for u, v among 1, Δx, Δy, R the correlation between pixels. What follows from p and q is taken to first order,
at vanishing strain. Noise of the positions is left out: it enters times the rotation and growth per frame only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.field import SURFACE_NAMES
from leafflow_ti.principal import principal_axes

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MOST_ACROSS = 17
"""Points across a window at most: of more, those between are left out, whose errors are nearly the same."""
LEAST_POINTS, LEAST_SPREAD = 3, 0.1
"""Points of a plane, and their smaller principal moment in squared distances of neighbours: less is a line."""
BATCH = 2048
"""Windows that are gathered at once."""
_PACKED = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True)
class Gauge:
    """A window of (2 ``half`` + 1)² points, ``thin`` output pixels apart, which are ``pitch`` px apart."""

    half: int
    thin: int
    pitch: int

    @classmethod
    def of(cls, window: int, pitch: int) -> Gauge:
        """The largest one within ``window`` px; without a neighbour (``half`` 0) where that is below 2 pitch + 1."""
        reach = window // 2 // pitch
        thin = max(1, -(-reach // (MOST_ACROSS // 2)))
        return cls(reach // thin, thin, pitch)

    @property
    def across(self) -> int:
        """Points along a side."""
        return 2 * self.half + 1

    @property
    def reach(self) -> int:
        """Output pixels from the centre to the last point."""
        return self.half * self.thin

    @property
    def side(self) -> int:
        """Pixels along a side."""
        return 2 * self.reach * self.pitch + 1

    @property
    def offsets(self) -> Array:
        """Of the points from the centre, px."""
        return np.asarray(np.arange(-self.half, self.half + 1) * (self.thin * self.pitch), np.float64)


@dataclass(frozen=True, eq=False)
class MovingSurface:
    """Positions [h, w, 3] mm and velocities [h, w, 3] mm/frame at output pixels, the ``covariance`` [h, w, 3, 3] of the
    latter, and the viewing ``rays`` [h, w, 3] (X/Z, Y/Z, 1).

    ``below`` [h - 1, w], ``beside`` [h, w - 1]: whether pixels lie on one surface with the one below, to the right.
    Pixels whose numbers are not finite have no motion.
    """

    points: Array
    velocity: Array
    covariance: Array
    rays: Array
    below: Mask
    beside: Mask
    f_px: float

    @cached_property
    def known(self) -> Mask:
        """Where there is a motion, [h, w]."""
        finite = np.isfinite(self.points).all(axis=-1) & np.isfinite(self.velocity).all(axis=-1)
        return np.asarray(finite & np.isfinite(self.covariance).all(axis=(-2, -1)))

    @cached_property
    def values(self) -> Array:
        """Positions, velocities and the packed covariance of m, [h, w, 12]; 0 where there is no motion."""
        inverse = np.zeros((*self.known.shape, 3, 3))
        inverse[..., range(3), range(3)] = 1.0
        inverse[..., :2, 2] = -self.rays[..., :2]
        known = self.known[..., None]
        covariance = np.where(known[..., None], self.covariance, 0.0)
        across = inverse @ covariance @ np.swapaxes(inverse, -1, -2)
        packed = np.stack([across[..., i, j] for i, j in _PACKED], axis=-1)
        both = np.where(known, np.concatenate([self.points, self.velocity], axis=-1), 0.0)
        return np.concatenate([both, packed], axis=-1)


@dataclass(frozen=True, eq=False)
class Strain:
    """Strain E (11, 22, 12) [..., 3] in %/frame and its covariance [..., 3, 3], ``area`` rate [...] and standard error.

    NaN, and NaN the errors, where there is no motion; NaN and infinite errors where the motion around says nothing.
    """

    tensor: Array
    covariance: Array
    area: Array
    area_std: Array

    def maps(self) -> dict[str, Array]:
        """Named maps of ``field.SURFACE_NAMES``, each with ``_std``."""
        with np.errstate(invalid="ignore"):  # infinite variances
            axes, axes_std = principal_axes(self.tensor, self.covariance)
            std = np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))
        values = np.concatenate([self.area[..., None], self.tensor, axes], axis=-1)
        errors = np.concatenate([self.area_std[..., None], std, axes_std], axis=-1)
        lost, none = np.isinf(self.area_std)[..., None], np.isnan(self.area_std)[..., None]
        errors = np.where(none, np.nan, np.where(lost, np.inf, errors))
        found: dict[str, Array] = {}
        for k, name in enumerate(SURFACE_NAMES):
            found[name], found[f"{name}_std"] = values[..., k], errors[..., k]
        return found


def measure_strain(surface: MovingSurface, gauge: Gauge, along_y: Array, along_x: Array) -> Strain:
    """The strain at every output pixel.

    ``along_y``, ``along_x`` [across, across]: correlations of the errors between the points of a window's column, row.
    """
    known, shape = surface.known, surface.known.shape
    tensor, covariance = np.full((*shape, 3), np.nan), np.full((*shape, 3, 3), np.nan)
    area, area_std = np.full(shape, np.nan), np.full(shape, np.nan)
    covariance[known], area_std[known] = np.inf, np.inf
    whole = _whole(surface, gauge)
    uncut, cut = _WholeWindows(surface, gauge, along_y, along_x), _CutWindows(surface, gauge, along_y, along_x)
    for windows, where in ((uncut, whole), (cut, known & ~whole)):
        rows, cols = np.nonzero(where)
        for first in range(0, rows.size, BATCH):
            at = rows[first : first + BATCH], cols[first : first + BATCH]
            slopes = windows(*at)
            values, spread, rate, std = _strain(slopes, surface.rays[at], surface.f_px)
            at = at[0][slopes.determined], at[1][slopes.determined]
            tensor[at], covariance[at], area[at], area_std[at] = values, spread, rate, std
    return Strain(tensor, covariance, area, area_std)


@dataclass(frozen=True, eq=False)
class _Slopes:
    """Of n windows: slopes a, b, p, q ``[n, 4, 3]``, the packed covariance [n, 6] of m, and the forms [n or 1, 6, 6] of
    the weights c_x, c_x Δx, c_x Δy, c_y, c_y Δx, c_y Δy. ``determined`` [n]: where the points span a plane."""

    vectors: Array
    covariance: Array
    forms: Array
    determined: Mask


def _forms(c: Array, gauge: Gauge, along_y: Array, along_x: Array) -> Array:
    """``(c_i u)^T R (c_j v)`` [n, 6, 6] of the weights ``c`` [n, 2, across, across] (of x and y; rows first)."""
    d = gauge.offsets
    u = np.stack([c, c * d, c * d[:, None]], axis=2).reshape(len(c), 6, gauge.across, gauge.across)
    spread = along_y @ u @ along_x
    return np.asarray(np.einsum("naij,nbij->nab", u, spread, optimize=True))


class _WholeWindows:
    """Slopes of windows that nothing is cut from: fixed weights, one axis after the other."""

    def __init__(self, surface: MovingSurface, gauge: Gauge, along_y: Array, along_x: Array):
        d, n, step = gauge.offsets, gauge.across, gauge.thin
        slope, mean = d / max(np.sum(d * d), 1.0), np.full(n, 1.0 / n)
        moving, covariance = surface.values[..., :6], surface.values[..., 6:]
        self._x, self._y = (
            _filtered(_filtered(moving, one, 0, step), two, 1, step) for one, two in ((mean, slope), (slope, mean))
        )
        self._covariance = _filtered(_filtered(covariance, mean, 0, step), mean, 1, step)
        weights = np.stack([np.outer(mean, slope), np.outer(slope, mean)])
        self._forms = _forms(weights[None], gauge, along_y, along_x)

    def __call__(self, rows: NDArray[np.intp], cols: NDArray[np.intp]) -> _Slopes:
        x, y = self._x[rows, cols], self._y[rows, cols]
        vectors = np.stack([x[:, :3], y[:, :3], x[:, 3:], y[:, 3:]], axis=1)
        return _Slopes(vectors, self._covariance[rows, cols], self._forms, np.ones(rows.size, bool))


class _CutWindows:
    """Slopes of any windows, from the points in them that are connected to the centre."""

    def __init__(self, surface: MovingSurface, gauge: Gauge, along_y: Array, along_x: Array):
        self._gauge, self._along = gauge, (along_y, along_x)
        self._values = surface.values
        self._links = [np.pad(_links(surface, axis, gauge.thin), gauge.reach) for axis in (0, 1)]

    def __call__(self, rows: NDArray[np.intp], cols: NDArray[np.intp]) -> _Slopes:
        gauge, d = self._gauge, self._gauge.offsets
        steps = gauge.thin * np.arange(gauge.across)
        at = (rows[:, None] + steps)[:, :, None], (cols[:, None] + steps)[:, None, :]
        w = _connected(*(links[at] for links in self._links)).astype(float)
        h, width = self._values.shape[:2]
        # Beyond the map nothing is connected: whatever stands for it has no weight.
        values = self._values[np.clip(at[0] - gauge.reach, 0, h - 1), np.clip(at[1] - gauge.reach, 0, width - 1)]
        n = w.sum(axis=(1, 2))
        x, y = (d - np.sum(w * d, axis=(1, 2), keepdims=True) / n[:, None, None] for d in (d, d[:, None]))
        xx, yy, xy = (np.sum(w * u * v, axis=(1, 2), keepdims=True) for u, v in ((x, x), (y, y), (x, y)))
        det = xx * yy - xy * xy
        # On a line the smaller principal moment vanishes, a point beside it adds some half of a step squared.
        step = gauge.thin * gauge.pitch
        determined = (n >= LEAST_POINTS) & (det > LEAST_SPREAD * step**2 * (xx + yy))[:, 0, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            c = np.stack([w * (yy * x - xy * y) / det, w * (xx * y - xy * x) / det], axis=1)
        c, w, values, n = c[determined], w[determined], values[determined], n[determined]
        slopes = np.einsum("ncij,nijk->nck", c, values[..., :6], optimize=True)
        vectors = np.stack([slopes[:, 0, :3], slopes[:, 1, :3], slopes[:, 0, 3:], slopes[:, 1, 3:]], axis=1)
        covariance = np.einsum("nij,nijk->nk", w, values[..., 6:]) / n[:, None]
        return _Slopes(vectors, covariance, _forms(c, gauge, *self._along), determined)


def _filtered(values: Array, weights: Array, axis: int, step: int) -> Array:
    """``Σ_k weights[k] values[i + (k - half) step]`` along an axis; what is beyond the ends is 0."""
    reach, n = len(weights) // 2 * step, values.shape[axis]
    padded = np.pad(values, [(reach, reach) if k == axis else (0, 0) for k in range(values.ndim)])
    total = np.zeros_like(values)
    for k, weight in enumerate(weights):
        total += weight * padded[(slice(None),) * axis + (slice(k * step, k * step + n),)]
    return total


def _broken(surface: MovingSurface) -> tuple[Mask, Mask]:
    """Pixels [h, w] that are not joined with the next one below, and to the right; the last have none."""
    known = surface.known
    below, beside = np.zeros_like(known), np.zeros_like(known)
    below[:-1] = known[:-1] & known[1:] & surface.below
    beside[:, :-1] = known[:, :-1] & known[:, 1:] & surface.beside
    return ~below, ~beside


def _counted(marks: Mask, axis: int, n: int) -> NDArray[np.intp]:
    """Marks in each run of ``n`` pixels along an axis that begins at a pixel; beyond the end all are marked."""
    padded = np.pad(marks, [(0, n - 1) if k == axis else (0, 0) for k in range(2)], constant_values=True)
    total = np.cumsum(np.pad(padded, [(1, 0) if k == axis else (0, 0) for k in range(2)]), axis=axis)
    length = marks.shape[axis]
    return np.asarray(np.take(total, range(n, n + length), axis) - np.take(total, range(length), axis))


def _links(surface: MovingSurface, axis: int, thin: int) -> Mask:
    """Whether each pixel is joined, without a break, with the one ``thin`` pixels below (axis 0) or to the right."""
    return np.asarray(_counted(_broken(surface)[axis], axis, thin) == 0)


def _whole(surface: MovingSurface, gauge: Gauge) -> Mask:
    """Pixels in whose window all pixels are joined with their neighbours, [h, w]."""
    n, reach = 2 * gauge.reach, gauge.reach
    if n == 0:
        return np.zeros_like(surface.known)
    below, beside = _broken(surface)
    breaks = _counted(_counted(below, 0, n) > 0, 1, n + 1) + _counted(_counted(beside, 1, n) > 0, 0, n + 1)
    found = np.zeros_like(surface.known)
    h, w = found.shape
    if h > n and w > n:
        found[reach : h - reach, reach : w - reach] = breaks[: h - n, : w - n] == 0
    return found


def _connected(below: Mask, beside: Mask) -> Mask:
    """Points [n, across, across] that a chain of links joins with the centre, which has a motion.

    ``below``, ``beside`` [n, across, across]: links to the next point in the column, in the row.
    """
    across = below.shape[1]
    member = np.zeros_like(below)
    member[:, across // 2, across // 2] = True
    while True:
        before = int(member.sum())
        for k in range(across - 1):
            member[:, k + 1] |= member[:, k] & below[:, k]
            member[:, :, k + 1] |= member[:, :, k] & beside[:, :, k]
        for k in reversed(range(across - 1)):
            member[:, k] |= member[:, k + 1] & below[:, k]
            member[:, :, k] |= member[:, :, k + 1] & beside[:, :, k]
        if int(member.sum()) == before:
            return member


def _strain(slopes: _Slopes, rays: Array, f_px: float) -> tuple[Array, Array, Array, Array]:
    """Of the determined windows: strain [n, 3], its covariance [n, 3, 3], area rate and its error [n]; %/frame."""
    element = slopes.vectors[:, :2]
    normal = np.cross(element[:, 0], element[:, 1])
    one = np.stack([normal[:, 2], np.zeros(len(normal)), -normal[:, 0]], axis=-1)
    tangents = np.stack([one, np.cross(normal, one)], axis=1)
    tangents /= np.linalg.norm(tangents, axis=-1, keepdims=True)
    # Pixels per mm along the tangents: [n, pixel axis, tangent].
    inverse = np.linalg.inv(np.einsum("nti,nki->ntk", tangents, element))
    D = np.einsum("nki,nkt->nit", slopes.vectors[:, 2:], inverse)
    H = tangents @ D
    both = H + np.swapaxes(H, 1, 2)
    before = np.eye(2) - 0.5 * both + 0.25 * np.swapaxes(D, 1, 2) @ D
    ratio = np.sqrt(np.linalg.det(before + both) / np.linalg.det(before))
    root = _inverse_root(before)
    E = 0.5 * root @ both @ root
    tensor = 100 * np.stack([E[:, 0, 0], E[:, 1, 1], E[:, 0, 1]], axis=-1)
    covariance = 1e4 * _covariance(slopes, tangents, inverse, rays[slopes.determined], f_px)
    trace = covariance[:, 0, 0] + covariance[:, 1, 1] + 2 * covariance[:, 0, 1]
    return tensor, covariance, 100 * (ratio - 1), ratio * np.sqrt(np.maximum(trace, 0))


def _inverse_root(L: Array) -> Array:
    """Inverse symmetric square roots of symmetric matrices [n, 2, 2]."""
    root_det = np.sqrt(np.linalg.det(L))[:, None, None]
    trace = np.trace(L, axis1=1, axis2=2)[:, None, None]
    return np.asarray(np.linalg.inv((L + root_det * np.eye(2)) / np.sqrt(trace + 2 * root_det)))


def _covariance(slopes: _Slopes, tangents: Array, inverse: Array, rays: Array, f_px: float) -> Array:
    """Covariance [n, 3, 3] of the small strains 11, 22, 12 from that of the slopes p, q of the velocity."""
    n = len(rays)
    # Gradients of the strains by p and q, [n, strain, slope, 3].
    gradient = np.empty((n, 3, 2, 3))
    for k, (i, j) in enumerate(((0, 0), (1, 1), (0, 1))):
        for slope in range(2):
            by = inverse[:, slope, j, None] * tangents[:, i] + inverse[:, slope, i, None] * tangents[:, j]
            gradient[:, k, slope] = 0.5 * by
    # By m: M of the centre, and how it changes with x and y; [n, strain, slope and 1 | Δx | Δy, 3].
    parts = np.zeros((n, 3, 2, 3, 3))
    parts[..., 0, :] = gradient
    parts[..., 0, 2] = np.einsum("nksi,ni->nks", gradient, rays)
    parts[..., 1, 2], parts[..., 2, 2] = gradient[..., 0] / f_px, gradient[..., 1] / f_px
    by_m = parts.reshape(n, 3, 6, 3)
    covariance = np.empty((n, 3, 3))
    for k, (i, j) in enumerate(_PACKED):
        covariance[:, i, j] = covariance[:, j, i] = slopes.covariance[:, k]
    spread = slopes.forms[:, None] @ by_m @ covariance[:, None]
    return np.asarray(np.einsum("nkai,nlai->nkl", by_m, spread, optimize=True))
