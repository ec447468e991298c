"""Standard error of a region's mean growth, where growth follows from the motions of different windows.

Its rate is the divergence of the velocity N in the surface, ``g_x · ∂N/∂x + g_y · ∂N/∂y``, g being reciprocal to the
tangents ``a, b = ∂s/∂x, ∂s/∂y``. The derivatives are linear in the velocities around a pixel, and so the mean over a
region is a weighted sum ``Σ c · N`` of the velocities in it and around it: most of them cancel, and what is left are
those along its border, or along the border of what is measured. Its variance is

    Σ_ij c_i · C_ij c_j,   C_ij = R(i - j) times the covariance of the velocities

with R that of values. What the images show of N is the displacement across the line of sight and the approach,
``m = M^-1 N``, whose errors hang together so; the columns of M vary with the ray.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.correlation import velocity_covariance
from leafflow_ti.errors import InputError
from leafflow_ti.region_noise import correlated

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Adjoint = Callable[[Floats, Floats, Mask], Floats]
"""(weights of ∂/∂x, of ∂/∂y, pixels that count; all [y, x]) -> weights of the values [y, x]."""


def divergence_variance(
    weights: Floats, part: Mapping[str, Floats], rays: Floats, focal: float, adjoint: Adjoint,
    value: tuple[Floats, Floats],
) -> float | None:  # fmt: skip
    """Variance of the mean growth ``Σ w rate`` in (%/frame)².

    ``weights`` [y, x]; ``part``: maps [y, x] of the region and of what its derivatives reach; ``rays`` [y, x, 3];
    ``focal``: focal length in output pixels; ``adjoint``: of the derivatives by output pixels; ``value``: correlation
    (y, x) of values. None where the maps do not say how the errors of the velocity hang together.
    """
    if "slope_x" not in part or "slope_y" not in part:
        return None
    try:
        covariance = velocity_covariance(part)
    except InputError:
        return None
    approach = np.broadcast_to(np.eye(3), covariance.shape).copy()
    approach[..., :2, 2] = -rays[..., :2]
    covariance = approach @ covariance @ np.swapaxes(approach, -1, -2)
    known = np.isfinite(part["depth"]) & np.isfinite(covariance).all(axis=(-1, -2))
    along_x, along_y = _reciprocal(part, rays, focal)
    counts = (weights != 0) & known
    c = np.zeros(rays.shape)
    for k in range(3):
        by_x, by_y = (np.where(counts, 100 * weights * g[..., k], 0.0) for g in (along_x, along_y))
        c[..., k] = adjoint(by_x, by_y, known)
    c[..., 2] += (c[..., :2] * rays[..., :2]).sum(axis=-1)
    std = np.sqrt(np.einsum("...ii->...i", np.where(known[..., None, None], covariance, 0.0)))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = (covariance / (std[..., :, None] * std[..., None, :]))[known].mean(axis=0)
    error = c * std
    return sum(
        float(correlation[i, j]) * correlated(error[..., i], error[..., j], *value) for i in range(3) for j in range(3)
    )


def fitted(reach: tuple[int, int]) -> Adjoint:
    """Of the slopes of planes fitted to the pixels that count within ``reach`` rows and columns on each side."""

    def adjoint(along_x: Floats, along_y: Floats, known: Mask) -> Floats:
        y, x = (np.broadcast_to(axis, known.shape).astype(float) for axis in np.indices(known.shape))
        n, sx, sy, sxx, sxy, syy = (
            _box(np.where(known, v, 0.0), reach) for v in (1 + 0 * x, x, y, x * x, x * y, y * y)
        )
        used = (along_x != 0) | (along_y != 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            mx, my = sx / n, sy / n
            xx, xy, yy = sxx - n * mx * mx, sxy - n * mx * my, syy - n * my * my
            det = xx * yy - xy * xy
            # Slopes are Σ (A (x - mx) + B (y - my)) v, each with its own A, B.
            by_x, by_y = (along_x * yy - along_y * xy) / det, (along_y * xx - along_x * xy) / det
        usable = used & (det > 1e-9 * np.maximum(xx, yy) ** 2)
        by_x, by_y = np.where(usable, by_x, 0.0), np.where(usable, by_y, 0.0)
        constant = np.where(usable, -by_x * mx - by_y * my, 0.0)
        total = _box(constant, reach) + x * _box(by_x, reach) + y * _box(by_y, reach)
        return np.where(known, total, 0.0)

    return adjoint


def differenced(along_x: Floats, along_y: Floats, known: Mask) -> Floats:
    """Of differences between the two neighbours that count, one-sided where one is missing: an ``Adjoint``."""
    total = np.zeros(known.shape)
    for axis, along in ((0, along_y), (1, along_x)):
        ahead, behind = (known & _moved(known, by, axis) for by in (1, -1))
        span = ahead.astype(float) + behind
        step = np.where(span > 0, along / np.maximum(span, 1.0), 0.0)
        total += _moved(np.where(ahead, step, 0.0), -1, axis) - _moved(np.where(behind, step, 0.0), 1, axis)
        total += np.where(ahead, 0.0, step) - np.where(behind, 0.0, step)
    return np.where(known, total, 0.0)


def _reciprocal(part: Mapping[str, Floats], rays: Floats, focal: float) -> tuple[Floats, Floats]:
    """``g_x``, ``g_y`` [y, x, 3] by output pixels, 1/mm: a change of N along x is the growth ``g_x · ∂N/∂x``."""
    normal = np.stack([part["slope_x"], part["slope_y"], -np.ones(rays.shape[:2])], axis=-1)
    toward = (normal * rays).sum(axis=-1)
    scale = (part["depth"] / focal)[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (scale * (np.eye(3)[k] - (normal[..., k] / toward)[..., None] * rays) for k in (0, 1))
        across = np.cross(a, b)
        across = across / (across**2).sum(axis=-1)[..., None]
    return np.cross(b, across), np.cross(across, a)


def _box(values: Floats, reach: tuple[int, int]) -> Floats:
    """Sums over the entries within ``reach`` rows and columns on each side."""
    for axis, half in enumerate(reach):
        total = np.cumsum(np.concatenate([np.zeros_like(values.take([0], axis)), values], axis=axis), axis=axis)
        at = np.arange(values.shape[axis])
        high, low = np.minimum(at + half + 1, at.size), np.maximum(at - half, 0)
        values = total.take(high, axis) - total.take(low, axis)
    return values


def _moved(values: NDArray[Any], by: int, axis: int) -> NDArray[Any]:
    """``values[i + by]`` along an axis, by one; 0 where that is outside."""
    found = np.roll(values, -by, axis)
    edge: list[slice | int] = [slice(None), slice(None)]
    edge[axis] = -1 if by > 0 else 0
    found[tuple(edge)] = 0
    return found
