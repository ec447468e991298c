"""Where the cameras of a grid really stand, from the places at which they show many points.

Camera k at s_k shows point i at ``x_ki = c_i - q_i s_k``, q_i = f / Z_i; turned about its axis by θ_k it shows it
``θ_k (-y, x)`` beside that. Neither the points' depths nor their places are known: of the positions, a common shift and
one common scale cannot be told. They are set such that most cameras stand where they should; then the others are off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

ROUNDS = 40
CUT = 4.7
"""Scales beyond which an observation does not count (Tukey's biweight)."""
LEAST_POINTS = 12
"""Points that a camera must share with the others."""
FLOOR_PX = 0.002
"""What interpolation and curved surfaces leave of a mean displacement, whatever the number of points."""
_MAD = 1.4826
"""Standard deviation of normal numbers per median of their sizes."""


@dataclass(frozen=True, eq=False)
class Positions:
    """Of the cameras in the order given; those that share too few points are NaN.

    ``measured_mm`` [K, 2]: in the scale of the stated ones. ``off_mm`` [K, 2]: their distance from these, once a turn
    and unequal scales of the whole grid are taken out, with its standard error ``error_mm``. ``roll`` [K] rad against
    the reference, with ``roll_error``. ``linear`` [2, 2]: the grid's axes as measured, per stated one, with
    ``linear_error`` of its elements. ``px_per_mm``: of the points in the middle of the depth range; ``residual_px``:
    scatter of single places; ``seen`` [K]: points.
    """

    measured_mm: Floats
    off_mm: Floats
    error_mm: Floats
    roll: Floats
    roll_error: Floats
    linear: Floats
    linear_error: Floats
    px_per_mm: float
    residual_px: float
    seen: NDArray[np.intp]


def fit_positions(
    places: Floats, ok: Mask, points: Floats, nominal_mm: Floats, reference: int, stated_mm: Floats | None = None
) -> Positions | None:
    """Positions from the total displacements ``places`` [K, n, 2] px of points against the reference camera.

    ``ok`` [K, n]; ``points`` [n, 2] px from the principal point; ``nominal_mm`` [K, 2] of an even grid; ``stated_mm``
    [K, 2]: where the cameras are said to stand, if not there. None: too few points, or cameras.
    """
    enough = ok.sum(axis=1) >= LEAST_POINTS
    used = ok & enough[:, None]
    shared = used.sum(axis=0) >= 3
    if enough.sum() < 3 or shared.sum() < LEAST_POINTS or not used[reference].any():
        return None
    places, points, weights = places[:, shared], points[shared], used[:, shared].astype(float)
    turned = np.stack([-points[:, 1], points[:, 0]], axis=-1)
    stated_mm = nominal_mm if stated_mm is None else stated_mm
    s, roll, scale = stated_mm.copy(), np.zeros(len(nominal_mm)), 0.0
    given = weights
    for _ in range(ROUNDS):
        rest = places - roll[:, None, None] * turned
        q, c = _points(rest, s, weights)
        s, roll, covariance = _cameras(places - c, q, turned, weights)
        roll = roll - roll[reference]
        residual = places - c + q[:, None] * s[:, None] - roll[:, None, None] * turned
        size = np.sqrt(np.sum(residual**2, axis=-1) / 2)
        scale = float(_MAD * np.sqrt(0.72) * np.median(size[given > 0])) or 1e-12  # a pair's size is larger: Rayleigh
        weights = given * np.clip(1 - (size / (CUT * scale)) ** 2, 0, None) ** 2
        s = _regauged(s, stated_mm, enough, reference)
    # Each point spends three of its numbers on its own place and depth.
    counted = float(weights.sum())
    spent = (3 * shared.sum() + 3 * enough.sum()) / max(2 * counted, 1.0)
    variance = float(np.sum(weights[..., None] * residual**2) / (2 * counted)) / max(1 - spent, 0.1)
    middle = float(np.median(q))
    error = np.sqrt(variance * np.einsum("kii->ki", covariance)[:, :2] + (FLOOR_PX / middle) ** 2)
    linear, linear_error, off = _grid(s, nominal_mm, stated_mm, enough, error)
    lost = ~enough
    for values in (s, off, error, roll):
        values[lost] = np.nan
    own = variance * covariance[:, 2, 2] + (FLOOR_PX / float(np.sqrt(np.mean(points**2)))) ** 2
    roll_error = np.sqrt(own + own[reference])
    roll_error[reference] = 0.0
    seen = np.asarray(used.sum(axis=1))
    return Positions(s, off, error, roll, roll_error, linear, linear_error, middle, variance**0.5, seen)


def _points(places: Floats, s: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """q [n] and c [n, 2] of every point, given the cameras."""
    total = np.maximum(weights.sum(axis=0), 1e-12)
    mean_s = np.einsum("kn,kj->nj", weights, s) / total[:, None]
    mean_x = np.einsum("kn,knj->nj", weights, places) / total[:, None]
    ds, dx = s[:, None] - mean_s, places - mean_x
    q = -np.einsum("kn,knj,knj->n", weights, ds, dx) / np.maximum(np.einsum("kn,knj,knj->n", weights, ds, ds), 1e-30)
    return q, mean_x + q[:, None] * mean_s


def _cameras(places: Floats, q: Floats, turned: Floats, weights: Floats) -> tuple[Floats, Floats, Floats]:
    """s [K, 2], roll [K] of every camera, given the points, and their covariance [K, 3, 3] per variance of a place."""
    n = len(q)
    rows = np.zeros((n, 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = -q
    rows[:, :, 2] = turned
    normal = np.einsum("kn,nij,nil->kjl", weights, rows, rows)
    right = np.einsum("kn,nij,kni->kj", weights, rows, places)
    size = np.sqrt(np.maximum(np.einsum("kii->ki", normal), 1e-30))
    inverse = np.linalg.inv(normal / (size[:, :, None] * size[:, None, :]) + 1e-12 * np.eye(3))
    covariance = inverse / (size[:, :, None] * size[:, None, :])
    found = np.einsum("kij,kj->ki", covariance, right)
    return found[:, :2], found[:, 2], covariance


def _regauged(s: Floats, nominal: Floats, enough: Mask, reference: int) -> Floats:
    """Shifted and scaled to the nominal positions of most cameras."""
    wanted, found = nominal[enough].reshape(-1), s[enough]
    columns = np.zeros((len(found), 2, 3))
    columns[:, :, 0], columns[:, 0, 1], columns[:, 1, 2] = found, 1.0, 1.0
    scale, x, y = robust_solution(columns.reshape(-1, 3), wanted, 0.0)[0]
    return np.asarray(scale * s + np.array([x, y]))


def _grid(s: Floats, nominal: Floats, stated: Floats, enough: Mask, error: Floats) -> tuple[Floats, Floats, Floats]:
    """The linear map [2, 2] from stated to measured positions of most cameras, its errors, and what is left.

    It is told along the axes of the nominal grid: measured positions across them differ by chance.
    """
    varied = np.ptp(nominal[enough], axis=0) > 0
    columns = np.column_stack([np.ones(len(nominal)), nominal[:, varied]])
    linear: Floats = np.eye(2)
    errors, off = np.zeros((2, 2)), np.zeros_like(s)
    for k in range(2):
        found, inverse = robust_solution(columns[enough], (s - stated)[enough, k], float(np.median(error[enough, k])))
        linear[k, varied] += found[1:]
        errors[k, varied] = np.sqrt(np.diag(inverse)[1:]) * float(np.median(error[enough, k]))
        off[:, k] = (s - stated)[:, k] - columns @ found
    return linear, errors, off


def robust_solution(columns: Floats, wanted: Floats, error: float) -> tuple[Floats, Floats]:
    """x with ``columns`` [m, n] x = ``wanted`` [m] for most rows, and ``(AᵀWA)^-1``; ``error``: known scatter.

    Least sums of residuals first, then Tukey's biweight.
    """
    weights, found = np.ones(len(wanted)), np.zeros(columns.shape[1])
    inverse: Floats = np.eye(columns.shape[1])
    tiny = 1e-9 * float(np.abs(wanted).max(initial=0.0)) + 1e-15
    for step in range(60):
        weighted = columns * weights[:, None]
        inverse = np.asarray(np.linalg.pinv(columns.T @ weighted), np.float64)
        found = inverse @ (weighted.T @ wanted)
        size = np.abs(wanted - columns @ found)
        if step < 40:
            weights = 1.0 / np.maximum(size, max(tiny, 1e-3 * error))
            weights = weights / weights.max()
        else:
            scale = max(_MAD * float(np.median(size)), error, tiny)
            weights = np.clip(1 - (size / (CUT * scale)) ** 2, 0, None) ** 2
    return found, inverse
