"""How far a followed point may be from the truth: the noise that adds up along its way, and a check ahead and back.

**Noise.** Errors of the motion in neighbouring frames hang together: their windows share images. What two results make
of one image largely cancels in their sum, for a velocity is a difference between late and early images: over many
frames it is mainly the images around the first and the last one that count. With the correlation R of a run (see
``correlation.NoiseCorrelation``) the way ``Σ c_i u_i`` has the variance ``Σ c_i c_j σ_i σ_j R(i - j)``; c are those of
the trapezoid rule. A point lies within twice the root of the variances along x and y with a probability of at
least 95 %, whatever the shape of the error's ellipse.

**Ahead and back.** Each frame says how a point goes on from it, ``u + a/2``, and where it came from, ``u - a/2``, from
its own images. Steps that look ahead alone and steps that look back alone lead apart where the frames contradict each
other: where the motion between them is not what either says, where acceleration or its change is missed, where a point
slides from one surface to another. That distance is the *closure*, what is left after going to the end by the first
steps and returning by the second; the track runs between the two. Half of it is added to the bound. Where no
acceleration is measured, it is the change of the motion since the frame before.

**Curvature.** The motion is a mean over a window, and between output pixels a mean of four. By how much either is off
where the motion changes other than linearly, its second differences say; what that adds up to along the way is the
third part of the bound. A turning leaf is found to move too little or too much by that: the window takes its curved
surface for a plane a little beside it.

A stretch of the image along the way, which stretches an error with it, is not counted, nor is what all frames have in
common: a calibration that is off, light that moves with the leaf.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SURE = 2.0
"""Distances in units of the root-mean-square one: no error's ellipse holds less than 95 % within two."""


def accumulated(std: Floats, correlation: Floats, steps: Floats) -> Floats:
    """Standard errors [S, ...] of the integral, by the trapezoid rule, over a rate with the standard errors ``std``.

    ``correlation`` [L]: of errors 0, 1, 2, ... frames apart, 0 beyond; ``steps`` [S - 1]: between the frames. NaN from
    where the first NaN of ``std`` is.
    """
    forth, back = np.concatenate([steps, [0.0]]) / 2, np.concatenate([[0.0], steps]) / 2
    weighted = (forth + back).reshape(-1, *[1] * (std.ndim - 1)) * std
    with np.errstate(invalid="ignore"):
        inner = np.zeros(std.shape[1:])  # of all frames before, each with both of its halves
        result = np.empty(std.shape)
        for k, error in enumerate(std):
            shared = np.zeros(std.shape[1:])
            for lag in range(1, min(k + 1, len(correlation))):
                shared = shared + correlation[lag] * weighted[k - lag]
            last, whole = back[k] * error, weighted[k]
            result[k] = inner + 2 * last * shared + last**2
            inner = inner + 2 * whole * shared + whole**2
        return np.asarray(np.sqrt(np.maximum(result, 0.0)))


def noise(std: Floats, correlation: Floats, steps: Floats) -> Floats:
    """Distance [S, n] px that the noise of the motion takes a point with 95 % at most; ``std`` [S, 2, n] px/frame."""
    return np.asarray(SURE * np.sqrt((accumulated(std, correlation, steps) ** 2).sum(axis=1)))


def closure(motion: Floats, acceleration: Floats, steps: Floats) -> Floats:
    """Distance [S, n] px between steps that look ahead alone and those that look back alone.

    ``motion`` [S, 2, n] px/frame and ``acceleration`` [S, 2, n] px/frame² (NaN: not measured) at the points;
    ``steps`` [S - 1] in frames.
    """
    h = steps[:, None, None]
    apart = np.zeros(motion.shape)
    if len(steps):
        change = np.diff(motion, axis=0)
        before = np.concatenate([change[:1] / h[:1], change / h])  # since the frame before
        behind = np.concatenate([change / h, change[-1:] / h[-1:]])
        ahead, back = (np.where(np.isnan(acceleration), found, acceleration) for found in (before, behind))
        apart[1:] = np.cumsum(0.5 * h**2 * (ahead[:-1] + back[1:]) - h * change, axis=0)
    return np.asarray(np.hypot(apart[:, 0], apart[:, 1]))


def bent(bend: Floats, steps: Floats) -> Floats:
    """Distance [S, n] px that the curvature of the motion adds up to, by the ``bend`` [S, 2, n] px/frame of samples."""
    total = np.zeros(bend.shape)
    total[1:] = np.cumsum(0.5 * steps[:, None, None] * (bend[1:] + bend[:-1]), axis=0)
    return np.asarray(np.hypot(total[:, 0], total[:, 1]))
