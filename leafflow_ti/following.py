"""Regions that move with their leaves: the labels of one frame carried to all others.

Points spread over each region are followed (``tracking``). In another frame the region lies where its pixels have come
to: an affine motion fitted to the points that are still followed, plus what they deviate from it, interpolated between
them. So pixels without a value move along, and what is measured of a region is told by its valid share. Where regions
come to overlap, the nearer one is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.labels import Coverage, LabelImage, cover, covered, looked_up
from leafflow_ti.results import ResultStore
from leafflow_ti.tracking import Tracks, track

Floats = NDArray[np.float64]

POINTS = 400
"""Points that are followed in a region, at most: 20 x 20. Motion varies slowly, over a window's width."""
LEAST = 0.25
"""Share of a region's points that must still be followed, else the region is lost."""
_STEPS = 20
_CLOSE = 0.01  # px


class Followed:
    """The regions of the label image [H, W] of the frame with index ``index`` along t, in all frames of a store."""

    def __init__(self, store: ResultStore, image: LabelImage, index: int, values: tuple[int, ...]):
        self._store, self._image, self._index = store, image, index
        coarse = image[store.y][:, store.x]
        lattices = [_Lattice.over(store, coarse == value) for value in values]
        x, y = (np.concatenate([getattr(lattice, name) for lattice in lattices]) for name in "xy")
        self._tracks = track(store, x, y, store.frames[index])
        ends = np.cumsum([0, *(lattice.y.size for lattice in lattices)])
        self._regions = {
            value: (lattice, slice(ends[k], ends[k + 1]))
            for k, (value, lattice) in enumerate(zip(values, lattices, strict=True))
        }

    def coverage(self, t: int) -> dict[int, Coverage]:
        """Label -> where its region is in the frame with index ``t``; a region that is lost is not among them."""
        taken = np.zeros((self._store.y.size, self._store.x.size))
        found = {}
        for value in sorted(self._regions, key=lambda value: self._distance(value, t)):
            region = self._moved(value, t)
            if region is not None:
                free = np.maximum(0.0, 1 - taken[region.cut])  # nearer regions are seen
                found[value] = Coverage(region.cut, np.minimum(region.share, free), region.block)
                taken[region.cut] += found[value].share
        return found

    def share(self, value: int, t: int) -> float:
        """Share [0..1] of a region's points that are still followed in the frame with index ``t``."""
        return _share(self._tracks.known[[self._index, t]][:, self._regions[value][1]])

    def _moved(self, value: int, t: int) -> Coverage | None:
        """Where a region has come to; None if it is lost or out of sight."""
        if t == self._index:
            return covered(self._store, self._image, value)
        lattice, part = self._regions[value]
        motion = _motion(self._tracks, lattice, part, self._index, t)
        if motion is None:
            return None
        x, y = motion.ahead(lattice.corners)
        span = (y.min() - motion.reach, y.max() + motion.reach, x.min() - motion.reach, x.max() + motion.reach)
        return cover(self._store, span, lambda points: looked_up(self._image, motion.back(points)) == value)

    def _distance(self, value: int, t: int) -> float:
        """Median depth [mm] of a region's points; a region without any counts as far away."""
        depth = self._tracks.position[t, self._regions[value][1], 2]
        depth = depth[np.isfinite(depth)]
        return float(np.median(depth)) if depth.size else np.inf


@dataclass(frozen=True, eq=False)
class _Lattice:
    """Points of a region on a regular lattice of ``rows`` and ``columns`` px; ``at``: row and column of each [2, n]."""

    rows: Floats
    columns: Floats
    at: NDArray[np.intp]

    @classmethod
    def over(cls, store: ResultStore, mask: NDArray[np.bool_]) -> _Lattice:
        """Of the pixels in ``mask`` [y, x], thinned to about ``POINTS``; a region that has no pixel there has none."""
        rows, columns = np.nonzero(mask)
        if not rows.size:
            return cls(np.zeros(0), np.zeros(0), np.zeros((2, 0), np.intp))
        step = max(1, int(np.ceil(np.sqrt(rows.size / POINTS))))
        chosen = np.arange(rows.min(), rows.max() + 1, step), np.arange(columns.min(), columns.max() + 1, step)
        at = np.array(np.nonzero(mask[np.ix_(*chosen)]))
        return cls(store.y[chosen[0]].astype(float), store.x[chosen[1]].astype(float), at)

    @property
    def x(self) -> Floats:
        """Columns of the points [n], px."""
        return np.asarray(self.columns[self.at[1]])

    @property
    def y(self) -> Floats:
        """Rows of the points [n], px."""
        return np.asarray(self.rows[self.at[0]])

    @property
    def corners(self) -> Floats:
        """Those of the lattice, one spacing farther out, (x, y) [2, 4] px."""
        (left, right), (top, bottom) = (_widened(line) for line in (self.columns, self.rows))
        return np.array([[left, right, left, right], [top, top, bottom, bottom]])


class _Motion:
    """Motion of a region from its label image: ``x -> centre + A (x - centre) + shift + residual(x)``."""

    def __init__(self, lattice: _Lattice, start: Floats, now: Floats, alive: NDArray[np.bool_]):
        """``start``, ``now``: points (x, y) [2, n] px at both times; ``alive`` [n]: those that are followed."""
        self._centre, self._shift = start[:, alive].mean(axis=1), now[:, alive].mean(axis=1)
        # Where points do not say how a direction is stretched, the least-norm gradient leaves it as it is.
        moved = now - start - (self._shift - self._centre)[:, None]
        offsets = start - self._centre[:, None]
        gradient = np.linalg.lstsq(offsets[:, alive].T, moved[:, alive].T, rcond=1e-6)[0].T
        self._a = np.eye(2) + gradient
        self._lattice = lattice
        residual = np.full((2, lattice.rows.size, lattice.columns.size), np.nan)
        residual[:, lattice.at[0][alive], lattice.at[1][alive]] = (moved - gradient @ offsets)[:, alive]
        self._residual = spread(residual)
        self.reach = float(np.abs(self._residual).max())
        """Largest deviation from the affine motion [px]."""

    def ahead(self, points: Floats) -> Floats:
        """Where the affine part brings the points (x, y) [2, n]."""
        return np.asarray(self._shift[:, None] + self._a @ (points - self._centre[:, None]))

    def back(self, points: Floats) -> Floats:
        """Where the points (x, y) [2, n] come from."""
        inverse = np.linalg.inv(self._a)
        source: Floats = self._centre[:, None] + inverse @ (points - self._shift[:, None])
        for _ in range(_STEPS):
            step = inverse @ (points - self.ahead(source) - self._deviation(source))
            source = source + step
            if np.abs(step).max(initial=0.0) < _CLOSE:
                break
        return np.asarray(source)

    def _deviation(self, points: Floats) -> Floats:
        """The residual at points (x, y) [2, n], bilinear, beyond the lattice as at its edge."""
        column, row = (
            np.interp(points[k], line, np.arange(line.size))
            for k, line in enumerate((self._lattice.columns, self._lattice.rows))
        )
        low = [
            np.minimum(at.astype(np.intp), n - 1) for at, n in zip((row, column), self._residual.shape[1:], strict=True)
        ]
        high = [np.minimum(at + 1, n - 1) for at, n in zip(low, self._residual.shape[1:], strict=True)]
        v, u = row - low[0], column - low[1]
        r = self._residual
        above = (1 - u) * r[:, low[0], low[1]] + u * r[:, low[0], high[1]]
        below = (1 - u) * r[:, high[0], low[1]] + u * r[:, high[0], high[1]]
        return np.asarray((1 - v) * above + v * below)


def spread(values: Floats) -> Floats:
    """Maps [k, h, w] without gaps: NaN filled from the nearest known neighbours outwards, by their means."""
    values = values.copy()
    while np.isnan(values).any():
        padded = np.pad(values, [(0, 0), (1, 1), (1, 1)], constant_values=np.nan)
        (_, h, w) = values.shape
        around = np.stack([padded[:, i : i + h, j : j + w] for i in range(3) for j in range(3)])
        known = np.isfinite(around)
        count = known.sum(axis=0)
        if not count.any():
            return np.zeros_like(values)
        total = np.where(known, around, 0.0).sum(axis=0)
        gap = np.isnan(values) & (count > 0)
        values[gap] = total[gap] / count[gap]
    return values


def _motion(tracks: Tracks, lattice: _Lattice, part: slice, start: int, t: int) -> _Motion | None:
    """Motion of a region between two frames; None where too few of its points are followed."""
    known = tracks.known[[start, t]][:, part]
    alive = np.asarray(known.all(axis=0))
    if not alive.any() or _share(known) < LEAST:
        return None
    begin, now = (np.stack([tracks.x[i, part], tracks.y[i, part]]) for i in (start, t))
    return _Motion(lattice, begin, now, alive)


def _share(known: NDArray[np.bool_]) -> float:
    """Share of the points known at the start that are known now; ``known`` [2, n]."""
    begun = int(known[0].sum())
    return float(known.all(axis=0).sum() / begun) if begun else 0.0


def _widened(line: Floats) -> tuple[float, float]:
    step = float(line[1] - line[0]) if line.size > 1 else 1.0
    return float(line[0]) - step, float(line[-1]) + step
