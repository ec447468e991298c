"""B-splines of odd degree n: their pieces, and the filter from grey values to coefficients of the smoothed image.

The basis function reaches ±(n + 1)/2 far; between two pixels a point ``u`` behind the left one has n + 1 neighbours.
A texture of frequency ω [rad/px] is misplaced by up to ``a/ω`` px, ``a = (ω / (2π - ω))^(n + 1)``, as a sine of the
fraction of a pixel.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

Array = NDArray[np.float64]

PREFILTER_SIGMA = 0.7
"""Gaussian of the images [px]: below, interpolation errs; above, texture is lost."""
LEAST_TAP = 1e-7
"""Taps below this share of the largest are left out: the rounding of single precision."""
_PERIOD = 1024


def support(degree: int) -> int:
    """Reach of the basis function [px]."""
    return (degree + 1) // 2


@functools.cache
def spline_pieces(degree: int) -> Array:
    """Weights of the neighbours as polynomials of u: [derivative 0..2, neighbour 0..degree, power 0..degree].

    Neighbour m lies ``m + 1 - support`` pixels behind the pixel left of the point.
    """
    # Cardinal splines of support 0..n+1, piece by piece: n β_n(x) = x β_(n-1)(x) + (n + 1 - x) β_(n-1)(x - 1).
    pieces = [Polynomial([1.0])]
    for n in range(1, degree + 1):
        padded = [Polynomial([0.0]), *pieces, Polynomial([0.0])]
        pieces = [
            (Polynomial([j, 1]) * padded[j + 1] + Polynomial([n + 1 - j, -1]) * padded[j]) / n for j in range(n + 1)
        ]
    found = np.zeros((3, degree + 1, degree + 1))
    for m, piece in enumerate(reversed(pieces)):
        for d in range(3):
            coefficients = piece.deriv(d).coef if d else piece.coef
            found[d, m, : len(coefficients)] = coefficients
    found.flags.writeable = False  # shared by all who ask
    return found


def spline(u: NDArray[Any], degree: int) -> Array:
    """The basis function at ``u`` px from its centre."""
    reach = support(degree)
    inside = (u > -reach) & (u < reach)
    left = np.floor(u)
    neighbour = np.where(inside, reach - 1 - left, 0).astype(int)
    powers = np.power.outer(u - left, np.arange(degree + 1))
    return np.asarray(np.where(inside, np.sum(spline_pieces(degree)[0][neighbour] * powers, axis=-1), 0.0))


@functools.cache
def filter_taps(degree: int, sigma: float = PREFILTER_SIGMA) -> Array:
    """Symmetric kernel from grey values to spline coefficients of the smoothed image, float64 [2 radius + 1].

    A Gaussian of ``sigma`` px (0: none) and the inverse of the sampled spline, along one axis; the sum is 1.
    """
    offset = np.fft.fftfreq(_PERIOD, 1 / _PERIOD)
    gaussian = np.exp(-0.5 * (offset / sigma) ** 2) if sigma else (offset == 0).astype(float)
    taps = np.fft.fftshift(np.fft.ifft(np.fft.fft(gaussian) / np.fft.fft(spline(offset, degree)).real).real)
    radius = int(np.abs(np.flatnonzero(np.abs(taps) >= LEAST_TAP * taps.max()) - _PERIOD // 2).max())
    taps = taps[_PERIOD // 2 - radius : _PERIOD // 2 + radius + 1]
    taps = np.asarray((taps + taps[::-1]) / (2 * taps.sum()))
    taps.flags.writeable = False
    return taps


def filter_radius(degree: int, sigma: float = PREFILTER_SIGMA) -> int:
    """Pixels that a coefficient needs on each side."""
    return len(filter_taps(degree, sigma)) // 2
