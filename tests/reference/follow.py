"""Naive twin of the dense flow of a sequence: one step, window by window, in double precision."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

Array = np.ndarray


def step(
    images: Array, levers: Array, flow: Array, weights: Array, affine: bool, hold: tuple[float, float]
) -> tuple[Array, Array]:
    """Flow [c, y, x] after one step from ``flow``, and its standard error; ``hold``: of flow and derivatives, relative
    to the mean squared difference of neighbours of the texture times its lever."""
    components, rows, cols = flow.shape
    y, x = np.mgrid[:rows, :cols].astype(float)
    values = np.full((len(images), rows, cols), np.nan)
    for k, lever in enumerate(levers):
        at_x, at_y = x + lever * flow[0], y + (lever * flow[1] if components == 2 else 0)
        inside = (at_x >= 0) & (at_x <= cols - 1) & (at_y >= 0) & (at_y <= rows - 1)
        seen = ndimage.map_coordinates(images[k], [at_y, at_x], order=3, mode="mirror")
        values[k][inside] = seen[inside]
    texture, slope, spread, rest, free = (np.zeros((rows, cols)) for _ in range(5))
    for i in np.ndindex(rows, cols):
        ok = np.isfinite(values[:, *i])
        t, v = levers[ok], values[ok, *i]
        free[i] = max(ok.sum() - 1, 0)
        if ok.any():
            texture[i], rest[i] = v.mean(), np.sum((v - v.mean()) ** 2)
        if ok.sum() > 1:
            spread[i] = np.sum((t - t.mean()) ** 2)
            slope[i] = np.polyfit(t, v, 1)[0]
    mean = sum(np.mean(np.diff(texture, axis=a) ** 2) for a in (1, 0)[:components]) * spread.mean()
    gradient = [_derivative(texture, axis) for axis in (1, 0)[:components]]
    left = slope - sum(g * u for g, u in zip(gradient, flow, strict=True))
    radius = len(weights) // 2
    offset = np.arange(-radius, radius + 1)
    scale = np.sqrt(np.sum(weights * offset**2))
    terms = 3 if affine else 1
    found, std = np.empty_like(flow), np.empty_like(flow)
    damping = mean * np.array([hold[0], hold[1], hold[1]][:terms] * components)
    power = np.sqrt([1, 0.5, 0.5][:terms] * components)
    for i, j in np.ndindex(rows, cols):
        ys = np.arange(max(0, i - radius), min(rows, i + radius + 1))
        xs = np.arange(max(0, j - radius), min(cols, j + radius + 1))
        box = np.ix_(ys, xs)
        w = np.outer(weights[ys - i + radius], weights[xs - j + radius])
        monomials = [
            np.ones_like(w),
            np.tile((xs - j) / scale, (len(ys), 1)),
            np.tile((ys - i) / scale, (len(xs), 1)).T,
        ]
        design = np.stack([g[box] * m for g in gradient for m in monomials[:terms]], axis=-1).reshape(-1, len(damping))
        weight = (w * spread[box]).ravel()
        plain = design.T @ (weight[:, None] * design)
        normal = plain + np.diag(damping)
        right = -design.T @ (weight * left[box].ravel())
        right[::terms] += damping[::terms] * flow[:, i, j]
        found[:, i, j] = np.linalg.solve(normal, right)[::terms]
        noise = np.sum(w * rest[box]) / max(np.sum(w * free[box]), 1e-20)
        inverse = np.linalg.inv(normal)
        covariance = inverse @ (plain * np.outer(power, power)) @ inverse * np.sum(weights**2) ** 2 * noise
        std[:, i, j] = np.sqrt(np.diag(covariance)[::terms])
    return found, std


def _derivative(values: Array, axis: int) -> Array:
    """Fourth order inside, differences of neighbours in the two outermost rows."""
    v = np.moveaxis(values, axis, 0)
    d = np.gradient(v, axis=0)
    d[2:-2] = (8 * (v[3:-1] - v[1:-3]) - (v[4:] - v[:-4])) / 12
    return np.moveaxis(d, 0, axis)
