"""Which points lie near each other in the plane, for any number of them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]


def pairs_within(x: Floats, y: Floats, radius: float) -> tuple[Indices, Indices]:
    """Indices of all pairs (i, j) of the points [n] that are at most ``radius`` apart, each with itself and in both
    orders, sorted by i. Points that are not finite are near none."""
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if not known.size:
        return known, known
    col, row = (np.floor((at[known] - at[known].min()) / radius).astype(np.int64) for at in (x, y))
    width = int(col.max()) + 3  # a free column on either side keeps the rows apart
    cell = row * width + col
    order = np.argsort(cell, kind="stable")
    ordered = cell[order]
    found = []
    for around in (-width - 1, -width, -width + 1, -1, 0, 1, width - 1, width, width + 1):
        first, last = (np.searchsorted(ordered, cell + around, side) for side in ("left", "right"))
        count = last - first
        i = np.repeat(np.arange(known.size), count)
        j = order[np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)]
        near = (x[known[i]] - x[known[j]]) ** 2 + (y[known[i]] - y[known[j]]) ** 2 <= radius**2
        found.append((known[i[near]], known[j[near]]))
    one, two = (np.concatenate(part) for part in zip(*found, strict=True))
    order = np.lexsort((two, one))
    return one[order], two[order]
