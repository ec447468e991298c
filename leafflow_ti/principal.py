"""Principal values and direction of symmetric 2 x 2 tensors, with standard errors.

With ``m = (e11 + e22)/2``, ``d = (e11 - e22)/2`` and ``r = √(d² + e12²)`` the principal values are m ± r, and the
first one's direction is half the angle of (d, e12). Noise in d and e12 always adds to r. Where r is less than
``TOLD_APART`` times their standard error, the tensor may as well be isotropic: there is no direction then (NaN, with an
infinite standard error), and that of the values takes the mean square by which noise lifts r.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

TOLD_APART = 3.0
"""Standard errors of the difference that tell the principal values apart: of pure noise 1 % exceeds that."""


def principal_axes(tensor: Array, covariance: Array) -> tuple[Array, Array]:
    """Values and standard errors [..., 3] of the larger and the smaller principal value and the first one's angle.

    ``tensor`` [..., 3]: components 11, 22, 12; ``covariance`` [..., 3, 3] of these. The angle, in rad, counts from axis
    1 towards axis 2 and lies in [-π/2, π/2).
    """
    e11, e22, e12 = np.moveaxis(tensor, -1, 0)
    mean, half = 0.5 * (e11 + e22), 0.5 * (e11 - e22)
    radius = np.hypot(half, e12)
    # Of mean, half difference and shear.
    A = np.array([[0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [0.0, 0.0, 1.0]])
    C = A @ covariance @ A.T
    noise = C[..., 1, 1] + C[..., 2, 2]
    apart = radius**2 > TOLD_APART**2 * 0.5 * noise
    with np.errstate(divide="ignore", invalid="ignore"):
        cos, sin = half / radius, e12 / radius
        along = cos**2 * C[..., 1, 1] + sin**2 * C[..., 2, 2] + 2 * sin * cos * C[..., 1, 2]
        across = sin**2 * C[..., 1, 1] + cos**2 * C[..., 2, 2] - 2 * sin * cos * C[..., 1, 2]
        shared = 2 * (cos * C[..., 0, 1] + sin * C[..., 0, 2])
        turn = 0.5 * np.sqrt(np.maximum(across, 0)) / radius
    shared, spread = np.where(apart, shared, 0.0), np.where(apart, along, noise)
    errors = [np.sqrt(np.maximum(C[..., 0, 0] + spread + sign * shared, 0)) for sign in (1, -1)]
    angle = 0.5 * np.arctan2(e12, half)
    angle = np.where(angle >= 0.5 * np.pi, angle - np.pi, angle)
    values = np.stack([mean + radius, mean - radius, np.where(apart, angle, np.nan)], axis=-1)
    return values, np.stack([*errors, np.where(apart, turn, np.inf)], axis=-1)
