"""Naive float64 twin of the prefilters: whole images, scipy's correlation, normalised over the valid pixels."""

import numpy as np
from scipy.ndimage import correlate1d


def gaussian(values, sigma):
    """Gaussian cut off at four sigmas, zeros outside the image; not normalised."""
    offset = np.arange(-np.ceil(4 * sigma), np.ceil(4 * sigma) + 1)
    weights = np.exp(-0.5 * (offset / sigma) ** 2)
    for axis in (0, 1):
        values = correlate1d(values, weights, axis=axis, mode="constant")
    return values


def prefilter(image, kind, sigma):
    """One image [y, x], NaN where a pixel is not valid: ``I - G * I`` (4.1), or the same of its logarithm."""
    valid = np.isfinite(image)
    values = np.where(valid, np.log(image) if kind == "homomorphic" else image, 0.0)
    with np.errstate(invalid="ignore"):  # far from every valid pixel
        high = values - gaussian(values, sigma) / gaussian(valid.astype(float), sigma)
    return np.where(valid, np.exp(high) if kind == "homomorphic" else high, np.nan)
