"""Growth of the surface: relative change of the area of its elements (Schuchert 2010, Eq. (4.32)).

An element is spanned by the positions ``s(x, y) = Z r`` (r the viewing ray) of neighbouring output pixels; within a
frame it moves with the velocity ``f(x, y)`` from ``s - f/2`` to ``s + f/2``:

    growth_rate = (|∂x(s + f/2) × ∂y(s + f/2)| / |∂x(s - f/2) × ∂y(s - f/2)| - 1) 100 %/frame

The printed forward step, from s to s + f, takes a rotation by ω about an axis in the surface for a growth of ω²/2; the
centred one is exactly zero for every rigid motion.

It is as good as the velocity: a motion fit to the flow's derivatives along x and y (rows ``2d``) takes an image that
grows for a rigid patch that comes nearer, which hides growth; the flows of all cameras (``scene-flow``) or the flow
itself with the range constraint (rows ``u+b5``) do not.

Derivatives are central differences over the neighbouring output pixels, one-sided where one of the two has no value.
Where both are missing along x or along y there is no growth rate: NaN, and NaN its standard error.

Standard errors follow from the covariances of the velocity's central differences (see ``sampling.difference_variance``
and ``kernels.patch_fit``). Differences along x and y are uncorrelated unless both are one-sided. The noise of the
positions is left out: it enters times the rotation and growth per frame only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.sampling import AxisSampling, Sampling, difference_variance

Array = NDArray[np.float64]

VELOCITY = ("velocity_x", "velocity_y", "velocity_z")
DIFFERENCES = tuple(f"difference_{axis}_{pair}" for axis in "xy" for pair in ("xx", "xy", "yy", "xz", "yz", "zz"))
"""Covariances of the velocity's central differences along x and y [mm²/(frame px)²], packed; no maps of results."""
INPUTS = ("depth", *VELOCITY, *DIFFERENCES)


@dataclass(frozen=True)
class Differences:
    """Difference quotients over neighbouring output pixels along one array axis of maps [h, w].

    ``span``: 2 central, 1 one-sided, 0 none. ``side``: of one-sided ones, 1 forward, -1 backward; 0 otherwise.
    """

    axis: int
    step: int
    forward: NDArray[np.bool_]
    backward: NDArray[np.bool_]

    @classmethod
    def over(
        cls, known: NDArray[np.bool_], axis: int, step: int, joined: NDArray[np.bool_] | None = None
    ) -> Differences:
        """Differences between pixels that are ``known``, ``step`` pixels apart.

        ``joined`` [h - 1, w] or [h, w - 1]: which neighbours lie on one surface; None: all.
        """
        forward, backward = (_moved(known, axis, by, False) & known for by in (1, -1))
        if joined is not None:
            forward &= np.pad(joined, [(0, int(a == axis)) for a in (0, 1)])
            backward &= np.pad(joined, [(int(a == axis), 0) for a in (0, 1)])
        return cls(axis, step, forward, backward)

    @property
    def span(self) -> NDArray[np.intp]:
        """Steps between the two pixels of each difference."""
        return self.forward.astype(np.intp) + self.backward

    @property
    def side(self) -> NDArray[np.intp]:
        """Direction of one-sided differences."""
        return self.forward.astype(np.intp) - self.backward

    def of(self, values: Array) -> Array:
        """The quotients [h, w], per pixel; NaN where there is none."""
        high = np.where(self.forward, _moved(values, self.axis, 1, np.nan), values)
        low = np.where(self.backward, _moved(values, self.axis, -1, np.nan), values)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray((high - low) / (self.span * self.step))

    def variance(self, window: AxisSampling) -> Array:
        """Variance of the quotients per variance of a central one, [h, w]."""
        one, two = (difference_variance(window, n * self.step) for n in (1, 2))
        return np.array([np.nan, one / two, 1.0])[self.span]


def growth_maps(
    maps: Mapping[str, NDArray[Any]],
    y: range,
    x: range,
    f_px: float,
    principal_px: tuple[float, float],
    sampling: Sampling,
    joined: tuple[NDArray[np.bool_], NDArray[np.bool_]] | None = None,
) -> dict[str, Array]:
    """``growth_rate`` and ``growth_rate_std`` [h, w] in %/frame.

    ``maps``: those of ``INPUTS`` [h, w] at the pixels ``y``, ``x``, NaN where there is no value. ``sampling`` holds
    the windows along y and x. ``joined``: which pixels lie on one surface with the one below, and to the right.
    """
    depth, *given = (np.asarray(maps[name], np.float64) for name in INPUTS)
    velocity, packed = given[:3], (given[3:9], given[9:])
    known = np.isfinite(depth) & np.isfinite(velocity).all(axis=0)
    ray = ((np.array(x) - principal_px[0]) / f_px, ((np.array(y) - principal_px[1]) / f_px)[:, None], 1.0)
    below, beside = joined or (None, None)
    across, down = Differences.over(known, 1, x.step, beside), Differences.over(known, 0, y.step, below)
    a, b = ([d.of(depth * r) for r in ray] for d in (across, down))
    p, q = ([d.of(v) for v in velocity] for d in (across, down))
    ends = [_element(a, b, p, q, half) for half in (0.5, -0.5)]
    ratio = ends[0].area / ends[1].area
    gradient = [
        [0.5 * (one + two) for one, two in zip(*sides, strict=True)]
        for sides in zip(*(e.by for e in ends), strict=True)
    ]
    variance = _both_one_sided(across, down, sampling, packed, gradient)
    for d, window, cov, g in zip((across, down), (sampling.x, sampling.y), packed, gradient, strict=True):
        variance = variance + d.variance(window) * _form(cov, g, g)
    return {"growth_rate": 100 * (ratio - 1), "growth_rate_std": 100 * ratio * np.sqrt(np.maximum(variance, 0))}


@dataclass(frozen=True)
class _Element:
    """Area of the surface elements [h, w], and the derivatives of half its logarithm by ``p`` and ``q``."""

    area: Array
    by: tuple[list[Array], list[Array]]


def _element(a: list[Array], b: list[Array], p: list[Array], q: list[Array], step: float) -> _Element:
    """The element spanned by ``a + step p`` and ``b + step q``; derivatives with the sign of a step forward."""
    one = [u + step * v for u, v in zip(a, p, strict=True)]
    two = [u + step * v for u, v in zip(b, q, strict=True)]
    normal = _cross(one, two)
    square = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
    return _Element(
        np.sqrt(square), ([u / square for u in _cross(two, normal)], [u / square for u in _cross(normal, one)])
    )


def _cross(u: list[Array], v: list[Array]) -> list[Array]:
    return [u[(i + 1) % 3] * v[(i + 2) % 3] - u[(i + 2) % 3] * v[(i + 1) % 3] for i in range(3)]


def _form(packed: list[Array], u: list[Array], v: list[Array]) -> Array:
    """``u^T C v`` for the packed symmetric C."""
    # C v first: every element of C is used once or twice.
    xx, yx, yy, zx, zy, zz = packed
    rows = (xx * v[0] + yx * v[1] + zx * v[2], yx * v[0] + yy * v[1] + zy * v[2], zx * v[0] + zy * v[1] + zz * v[2])
    total: Array = u[0] * rows[0] + u[1] * rows[1] + u[2] * rows[2]
    return total


def _both_one_sided(
    across: Differences,
    down: Differences,
    sampling: Sampling,
    packed: tuple[list[Array], ...],
    gradient: list[list[Array]],
) -> Array:
    """What the covariance between differences along x and y adds to the variance, [h, w].

    One-sided ones share the pixel itself: ``± (1 - R(dx)) (1 - R(dy)) / (dx dy)`` times the covariance of the velocity.
    """
    result: Array = np.asarray(across.side * down.side, float)
    at = np.nonzero(result)  # few: the corners of what is known
    factor, total = 1.0, [np.zeros(at[0].size) for _ in packed[0]]
    for d, window, cov in zip((across, down), (sampling.x, sampling.y), packed, strict=True):
        factor *= 0.5 * difference_variance(window, d.step) * d.step
        central = difference_variance(window, 2 * d.step)
        total = [t + 0.5 * u[at] / central for t, u in zip(total, cov, strict=True)]
    result[at] *= factor * 2 * _form(total, *([u[at] for u in g] for g in gradient))
    return result


def _moved(values: NDArray[Any], axis: int, by: int, empty: object) -> NDArray[Any]:
    """``values[i + by]`` along an axis, ``empty`` where that is outside."""
    out = np.full_like(values, empty)
    to, source = [slice(None)] * 2, [slice(None)] * 2
    to[axis], source[axis] = (slice(None, -1), slice(1, None)) if by > 0 else (slice(1, None), slice(None, -1))
    out[tuple(to)] = values[tuple(source)]
    return out
