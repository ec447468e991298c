"""Naive float64 twin of the growth rate: one pixel at a time, its error propagated by differencing everything."""

import numpy as np


def correlation(axis, distance):
    """Correlation of the errors of two windows along one axis, their noise smoothed by the filters."""
    v = np.convolve(axis.weights, axis.kernel(False))
    return sum(v[i] * v[i + distance] for i in range(max(v.size - distance, 0))) / sum(v**2)


def shared(distance, step, sampling):
    """Correlation of the errors at two output pixels."""
    return np.prod([correlation(a, step * abs(n)) for a, n in zip((sampling.y, sampling.x), distance, strict=True)])


def pair(known, row, col, axis):
    """The two pixels over which one derivative is taken, low one first; None if there is no pair."""
    step = np.eye(2, dtype=int)[axis]
    there = [
        tuple(np.array([row, col]) + s * step)
        for s in (-1, 0, 1)
        if all(0 <= n < size for n, size in zip(np.array([row, col]) + s * step, known.shape, strict=True))
    ]
    there = [p for p in there if known[p]]
    return (there[0], there[-1]) if len(there) > 1 else None


def rate(s, f, pairs, step):
    """%/frame from positions and displacements, dicts of pixel -> [3]."""
    (left, right), (top, bottom) = pairs

    def area(half):
        across = (s[right] + half * f[right] - s[left] - half * f[left]) / step
        down = (s[bottom] + half * f[bottom] - s[top] - half * f[top]) / step
        return np.linalg.norm(np.cross(across, down))

    return 100 * (area(0.5) / area(-0.5) - 1)


def growth(s, f, covariance, known, step, sampling):
    """Growth rate and its standard error [h, w] from positions and velocities [h, w, 3].

    ``covariance`` [3, 3] of the velocity, the same everywhere; errors correlated like those of the windows.
    """
    values, errors = np.full(known.shape, np.nan), np.full(known.shape, np.nan)
    for pixel in np.argwhere(known):
        pairs = pair(known, *pixel, 1), pair(known, *pixel, 0)
        if None in pairs:
            continue
        pixels = sorted({p for two in pairs for p in two})
        S, F = ({p: field[p] for p in pixels} for field in (s, f))
        value = rate(S, F, pairs, step)
        gradient = np.zeros((len(pixels), 3))
        for i, p in enumerate(pixels):
            for k in range(3):
                d = 1e-4 * np.eye(3)[k]
                gradient[i, k] = (
                    rate(S, {**F, p: F[p] + d}, pairs, step) - rate(S, {**F, p: F[p] - d}, pairs, step)
                ) / 2e-4
        R = np.array([[shared(np.subtract(p, q), step, sampling) for q in pixels] for p in pixels])
        values[tuple(pixel)] = value
        errors[tuple(pixel)] = np.sqrt(np.einsum("ik,ij,kl,jl", gradient, R, covariance, gradient))
    return values, errors
