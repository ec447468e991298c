"""The package's own code, in NumPy."""

from __future__ import annotations

import numpy as np


def structure_tensor_2d(image: np.ndarray, sigma: float, rho: float) -> np.ndarray:
    """[3, y, x]: products of the derivatives along the first axis, along the second, and of both, averaged."""
    smooth, slope = _gaussian(sigma), _gaussian_slope(sigma)
    first = _filtered(image, slope, smooth)
    second = _filtered(image, smooth, slope)
    window = _gaussian(rho)
    return np.stack([_filtered(p, window, window) for p in (first * first, second * second, first * second)])


def eig_special_2d(tensors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues [2, y, x], ascending, and the eigenvector [2, y, x] of the first, of tensors [3, y, x]."""
    first, second, both = tensors
    matrices = np.stack([np.stack([first, both], -1), np.stack([both, second], -1)], -1)
    values, vectors = np.linalg.eigh(matrices)
    return np.moveaxis(values, -1, 0), np.moveaxis(vectors[..., 0], -1, 0)


def _gaussian(sigma: float) -> np.ndarray:
    radius = int(4 * sigma + 0.5)
    weights = np.exp(-0.5 * (np.arange(-radius, radius + 1) / sigma) ** 2)
    return weights / weights.sum()


def _gaussian_slope(sigma: float) -> np.ndarray:
    weights = _gaussian(sigma)
    radius = weights.size // 2
    return np.arange(-radius, radius + 1) * weights / sigma**2


def _filtered(image: np.ndarray, along_first: np.ndarray, along_second: np.ndarray) -> np.ndarray:
    """Correlation with a separable mask; at borders the nearest pixel is repeated."""
    for axis, taps in enumerate((along_first, along_second)):
        radius = taps.size // 2
        width = [(radius, radius) if a == axis else (0, 0) for a in range(2)]
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(image, width, "edge"), taps.size, axis)
        image = windows @ taps
    return image
