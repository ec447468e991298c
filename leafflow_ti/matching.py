"""Well-textured points of one image found again in others, to a few thousandths of a pixel.

A window around each point is fitted with an affine warp, a gain and an offset (Lucas and Kanade's least squares, with
the gradient of the template for that of the image). Warps are about 1: the fixed point is that of the exact gradient.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture.resampling import resample

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

HALF = 12
"""Half the side of a window [px]."""
SIGMA = 6.0
"""Its Gaussian weights [px]."""
CELL = 24
"""Least side of the squares [px] of which each gives one point."""
MOST_POINTS = 400
MOST_ERROR = 0.05
"""Error by the noise [px], in the direction of least texture, above which a point is not taken."""
STEPS = 12
SETTLED = 3e-3
"""Last step [px] of a fit that has converged."""
MOST_WAY = 1.5
"""How far the fit may go from where it started [px]."""
LEAST_EXPLAINED = 0.8
"""Share of the template's variance that the fit must explain."""


def structure(image: Floats, half: int) -> Floats:
    """Least eigenvalue [H, W] of the gradient's tensor summed over squares of ``2 half + 1`` px; 0 near the border."""
    gy, gx = np.gradient(image)
    xx, xy, yy = (_box_sums(np.asarray(product), half) for product in (gx * gx, gx * gy, gy * gy))
    return np.asarray(np.maximum(0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2), 0.0))


def _box_sums(values: Floats, half: int) -> Floats:
    """Sums over squares around every pixel, 0 where the square is not inside."""
    total = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    np.cumsum(np.cumsum(values, axis=0), axis=1, out=total[1:, 1:])
    side, found = 2 * half + 1, np.zeros_like(values)
    if min(values.shape) >= side:
        inner = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
        found[half : values.shape[0] - half, half : values.shape[1] - half] = inner
    return found


def choose_points(image: Floats, noise: float, allowed: Mask) -> NDArray[np.intp]:
    """Rows and columns [n, 2] of the best point in every square of the image, where there is texture enough.

    ``noise``: standard deviation of the image's; ``allowed`` [H, W]: where points may lie.
    """
    margin = HALF + 3
    finite = np.isfinite(image)
    known = _box_sums((~finite).astype(np.float64), HALF + 1) == 0  # with the neighbours that gradients take
    least = np.where(allowed & known, structure(np.where(finite, image, 0.0), HALF), 0.0)
    least[:margin], least[-margin:], least[:, :margin], least[:, -margin:] = 0.0, 0.0, 0.0, 0.0
    cell = max(CELL, int(np.ceil(np.sqrt(image.size / MOST_POINTS))))
    found = []
    for top in range(0, image.shape[0], cell):
        for left in range(0, image.shape[1], cell):
            part = least[top : top + cell, left : left + cell]
            row, col = np.unravel_index(int(np.argmax(part)), part.shape)
            if part[row, col] > (noise / MOST_ERROR) ** 2:
                found.append((top + int(row), left + int(col)))
    return np.array(found, np.intp).reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class Matches:
    """Where another image shows points: ``shift`` [n, 2] px (x, y) from the reference, ``gain`` and ``grey`` [n] of the
    windows there against those of the reference (ratio of contrasts, mean grey value), ``ok`` [n]: those that count."""

    shift: Floats
    gain: Floats
    grey: Floats
    ok: Mask


class Templates:
    """Windows of a reference image around points [n, 2] (row, column), ready to be found in others.

    ``noise``: standard deviation of the image's; it makes contrasts seem larger, and gains smaller.
    """

    def __init__(self, image: Floats, points: NDArray[np.intp], noise: float):
        self.points = points
        steps = np.arange(-HALF, HALF + 1)
        dy, dx = (grid.reshape(-1) for grid in np.meshgrid(steps, steps, indexing="ij"))
        self._dx, self._dy = dx.astype(float), dy.astype(float)
        weights = np.exp(-0.5 * (dx**2 + dy**2) / SIGMA**2)
        self._weights = weights / weights.sum()
        gradient_y, gradient_x = np.gradient(image)
        rows, cols = points[:, :1] + dy, points[:, 1:] + dx
        self._grey, gx, gy = (np.asarray(values)[rows, cols] for values in (image, gradient_x, gradient_y))
        self.grey: Floats = np.asarray(self._grey @ self._weights)
        variance = np.maximum((self._grey - self.grey[:, None]) ** 2 @ self._weights, 1e-30)
        self._spread = np.sqrt(variance)
        self._reliability = np.maximum(1.0 - noise**2 / variance, 0.1)
        u, v = self._dx / HALF, self._dy / HALF
        one = np.ones_like(gx)
        self._jacobian = np.stack([gx, gy, gx * u, gx * v, gy * u, gy * v, self._grey, one], axis=-1)
        weighted = self._jacobian * self._weights[:, None]
        normal = np.swapaxes(weighted, 1, 2) @ self._jacobian
        scale: Floats = np.asarray(np.maximum(np.einsum("nii->ni", normal), 1e-30) ** -0.5)
        scaled = normal * scale[:, :, None] * scale[:, None, :] + 1e-9 * np.eye(8)
        self._solve = scale[:, :, None] * (np.linalg.inv(scaled) @ (scale[:, :, None] * np.swapaxes(weighted, 1, 2)))

    def find(self, image: Floats, start: Floats) -> Matches:
        """The windows in another image; ``start`` [n, 2]: shifts (x, y) to begin with, right to about a pixel."""
        n, (height, width) = len(self.points), image.shape
        warp = np.concatenate([start, np.zeros((n, 4))], axis=1)
        inside, change, residual, step = np.ones(n, bool), np.zeros(n), self._grey * 0.0, np.zeros((n, 8))
        for _ in range(STEPS if n else 0):
            x = self.points[:, 1:] + self._dx + self._moved(warp, 0)
            y = self.points[:, :1] + self._dy + self._moved(warp, 1)
            inside = ((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)).all(axis=1)
            x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
            values, sure = resample(lambda y0, y1, x0, x1: image[y0:y1, x0:x1], image.shape, y, x, np.float64)
            inside &= sure.all(axis=1)
            residual = np.where(sure, values - self._grey, 0.0)  # a window with unknown pixels does not count
            step = np.einsum("nks,ns->nk", self._solve, residual)
            warp[:, :6] -= step[:, :6]
            change = np.abs(step[:, :2]).max(axis=1)
            residual = residual - np.einsum("nsk,nk->ns", self._jacobian, step)
        left = np.sqrt(residual**2 @ self._weights)
        gain, grey = (1.0 + step[:, 6]) / self._reliability, self.grey * (1.0 + step[:, 6]) + step[:, 7]
        settled = (change < SETTLED) & (np.abs(warp[:, :2] - start).max(axis=1, initial=0.0) < MOST_WAY)
        ok = inside & settled & (left**2 < (1 - LEAST_EXPLAINED) * (np.abs(gain) * self._spread) ** 2)
        return Matches(warp[:, :2], gain, grey, ok)

    def _moved(self, warp: Floats, k: int) -> Floats:
        """What the warp adds along x (0) or y (1) to the pixels of the windows, [n, S]."""
        along = warp[:, [2 + 2 * k]] * self._dx + warp[:, [3 + 2 * k]] * self._dy
        return np.asarray(warp[:, [k]] + along / HALF)
