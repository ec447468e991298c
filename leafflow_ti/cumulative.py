"""Growth and strain of followed points since the frame in which they were given, by two independent measures.

**By the rates**: the logarithm of the area is the integral, along the way, of ``ln(1 + rate)``, rate being the map
``growth_rate`` (an unknown of the refinement) or ``area_rate`` (from the motion around a pixel), by the trapezoid rule.
Its standard error follows from those of the map and their correlation between frames (see ``drift.accumulated``).

**By the places**: where neighbouring points were at the start, and where they are now. Around every point planes are
fitted to both over the image at the start, ``a, b = ∂s/∂x, ∂s/∂y`` then and ``a', b'`` now, from the same points with
the same weights: rigid motion is no strain at all, and homogeneous growth is its own, however the surface is curved.
With the orthonormal tangents T of the start (axis 1 in the plane of X and Z, axis 2 at right angles) and the
deformation gradient ``F = (a' b') (T^T (a b))^-1``

    E = (F^T F - 1)/2,        growth of the area √det(F^T F) - 1

Nothing is added up but the drift of the points; there is no standard error.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.correlation import NoiseCorrelation
from leafflow_ti.drift import accumulated
from leafflow_ti.errors import UsageError
from leafflow_ti.interpolation import Cells, Lattice, Reading, Surface
from leafflow_ti.mesh import STEEPEST
from leafflow_ti.neighbourhood import pairs_within
from leafflow_ti.status import Status
from leafflow_ti.tracking import clock
from leafflow_ti.tracks import Tracks

if TYPE_CHECKING:
    from leafflow_ti.results import ResultStore

Floats = NDArray[np.float64]

RATES = {"growth_rate": "growth", "area_rate": "area_growth"}
"""Map of a rate -> name of what it adds up to."""
STRAINS = ("strain_11", "strain_22", "strain_12", "strain_1", "strain_2", "strain_angle")
LEAST_POINTS, LEAST_SPREAD = 4, 0.02
"""Points of a fit, and the smaller of their principal moments as a part of the larger: less is a line."""


def track_growth(store: ResultStore, tracks: Tracks, gauge: float | None = None) -> Tracks:
    """The tracks with their growth and strain since the start, as variables [T, n] in %.

    ``growth``, ``area_growth``, each with ``_std``, where the store holds such a rate; ``place_growth`` and ``STRAINS``
    where it holds depth, of the points at most ``gauge`` / 2 px apart at the start (None: see ``usual_gauge``).
    Raises UsageError for a gauge that is not positive.
    """
    if gauge is not None and not gauge > 0:
        raise UsageError(f"gauge = {gauge:g} px: must be positive")
    found: dict[str, Floats] = {}
    for rate, name in RATES.items():
        if rate in store.names:
            found |= _from_rates(store, tracks, rate, name)
    if np.isfinite(tracks.position[tracks.start_index]).any():
        found |= strain_since(tracks, usual_gauge(store, tracks) if gauge is None else gauge)
    return tracks.having(found)


def usual_gauge(store: ResultStore, tracks: Tracks) -> float:
    """Diameter [px] that holds three estimates across whose errors are nearly independent, and six points."""
    independent, lattice = NoiseCorrelation.of(store).independent("x"), Lattice.of(store.x, store.y)
    x, y = (at[tracks.start_index][tracks.known[tracks.start_index]] for at in (tracks.x, tracks.y))
    area = float(np.ptp(x) * np.ptp(y)) if x.size > 1 else 0.0
    return float(max(2 * independent * lattice.step[0], 6 * np.sqrt(area / max(x.size, 1)), 2))


def _from_rates(store: ResultStore, tracks: Tracks, rate: str, name: str) -> dict[str, Floats]:
    """Cumulative growth [T, n] in % by a map of rates, and its standard error."""
    logarithm, error = np.full((2, *tracks.x.shape), np.nan)
    lattice = Lattice.of(store.x, store.y)
    for k in range(len(tracks.frames)):
        values, std = (store.read(n, k).astype(np.float64) for n in (rate, f"{rate}_std"))
        known = np.isfinite(values) & np.isfinite(std) & (store.read("status", k) == Status.OK)
        cells = Cells.at(lattice, tracks.x[k], tracks.y[k])
        read = Surface(known).reading(cells) == Reading.OK
        part = 1 + np.where(read, cells.mean(values), np.nan) / 100
        with np.errstate(invalid="ignore"):
            logarithm[k], error[k] = np.log(part), np.where(read, cells.mean(std), np.nan) / (100 * part)
    times, correlation = clock(store), NoiseCorrelation.of(store).t
    total, total_std = np.full((2, *tracks.x.shape), np.nan)
    for order in tracks.ways:
        steps = np.diff(times[order])
        rates = logarithm[order]
        total[order[0]] = np.where(np.isfinite(rates[0]), 0.0, np.nan)
        total[order[1:]] = np.cumsum(steps[:, None] * 0.5 * (rates[1:] + rates[:-1]), axis=0)
        total_std[order] = accumulated(error[order], correlation, steps)
    return {name: 100 * np.expm1(total), f"{name}_std": 100 * np.exp(total) * total_std}


def strain_since(tracks: Tracks, gauge: float) -> dict[str, Floats]:
    """``place_growth`` and ``STRAINS`` [T, n] by the places of the points; %, the angle in rad from axis 1.

    Beside them ``tangents`` [n, 3, 2]: the two axes at the start.
    """
    at, shape = tracks.start_index, tracks.x.shape
    found = {name: np.full(shape, np.nan) for name in ("place_growth", *STRAINS)}
    fit = _Fit(tracks, gauge)
    axes = tangents(fit.slopes(tracks.position[at], tracks.position[at]))
    for k in range(shape[0]):
        before, now = (fit.slopes(tracks.position[i], tracks.position[k]) for i in (at, k))
        gradient = now @ _inverse(np.swapaxes(tangents(before), 1, 2) @ before)
        squared = np.swapaxes(gradient, -1, -2) @ gradient
        with np.errstate(invalid="ignore"):
            determinant = squared[:, 0, 0] * squared[:, 1, 1] - squared[:, 0, 1] ** 2
            found["place_growth"][k] = 100 * (np.sqrt(determinant) - 1)
        for name, values in zip(STRAINS, _components(50 * (squared - np.eye(2))), strict=True):
            found[name][k] = values
    for name in ("place_growth", *STRAINS):  # nothing has happened yet: what is left is rounding
        nothing = np.nan if name == "strain_angle" else 0.0
        found[name][at] = np.where(np.isfinite(found[name][at]), nothing, np.nan)
    return found | {"tangents": axes}


def _components(tensor: Floats) -> tuple[Floats, ...]:
    """Components 11, 22, 12 [n], principal values and angle in [-π/2, π/2) of tensors [n, 2, 2]."""
    one, two, both = tensor[:, 0, 0], tensor[:, 1, 1], tensor[:, 0, 1]
    mean, half = 0.5 * (one + two), 0.5 * (one - two)
    radius, angle = np.hypot(half, both), 0.5 * np.arctan2(both, half)
    return one, two, both, mean + radius, mean - radius, np.where(angle >= np.pi / 2, angle - np.pi, angle)


class _Fit:
    """Planes through the places of the points around each, over the image at the start."""

    def __init__(self, tracks: Tracks, gauge: float):
        x, y, position = (values[tracks.start_index] for values in (tracks.x, tracks.y, tracks.position))
        i, j = pairs_within(np.where(np.isfinite(position[:, 2]), x, np.nan), y, gauge / 2)
        apart = position[j] - position[i]
        same = np.abs(apart[:, 2]) <= STEEPEST * np.hypot(apart[:, 0], apart[:, 1])
        label = tracks.variables.get("label")
        if label is not None:
            same &= label[i] == label[j]
        self._pairs, self._n = (i[same], j[same]), x.size
        self._at = np.stack([x, y], axis=1)

    def slopes(self, places: Floats, now: Floats) -> Floats:
        """Derivatives along x and y [n, 3, 2] of ``places`` [n, 3], by the points that are known ``now`` [n, 3].

        NaN where these are too few, or on a line.
        """
        alive = np.isfinite(now[:, 2])
        i, j = (p[alive[self._pairs[0]] & alive[self._pairs[1]]] for p in self._pairs)
        offset, values = self._at[j] - self._at[i], places[j] - places[i]

        def total(v: Floats) -> Floats:
            return np.bincount(i, v, minlength=self._n).astype(np.float64)

        count = total(np.ones(i.size))
        with np.errstate(divide="ignore", invalid="ignore"):
            d = offset - np.stack([total(offset[:, a]) / count for a in (0, 1)], axis=1)[i]
            xx, yy, xy = total(d[:, 0] ** 2), total(d[:, 1] ** 2), total(d[:, 0] * d[:, 1])
            det = xx * yy - xy**2
            c = np.stack([yy[i] * d[:, 0] - xy[i] * d[:, 1], xx[i] * d[:, 1] - xy[i] * d[:, 0]], axis=1) / det[i, None]
        found = np.stack([np.stack([total(c[:, a] * v) for v in values.T], axis=1) for a in (0, 1)], axis=2)
        found[(count < LEAST_POINTS) | ~(det > LEAST_SPREAD * (0.5 * (xx + yy)) ** 2)] = np.nan
        return np.asarray(found)


def tangents(element: Floats) -> Floats:
    """Orthonormal tangents [n, 3, 2] of the elements [n, 3, 2] that two derivatives span: the first in the plane of X
    and Z, the second at right angles."""
    normal = np.cross(element[..., 0], element[..., 1])
    one = np.stack([normal[:, 2], np.zeros(len(normal)), -normal[:, 0]], axis=-1)
    two = np.cross(normal, one)
    with np.errstate(invalid="ignore"):
        return np.stack([v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (one, two)], axis=-1)


def _inverse(m: Floats) -> Floats:
    """Inverses of [n, 2, 2]; NaN stays."""
    with np.errstate(divide="ignore", invalid="ignore"):
        det = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]
        adjugate = np.stack([m[:, 1, 1], -m[:, 0, 1], -m[:, 1, 0], m[:, 0, 0]], axis=-1)
        return np.asarray(adjugate / det[:, None]).reshape(-1, 2, 2)
