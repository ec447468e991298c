"""Maps of one frame read at points between their pixels.

A value is the bilinear mean of the four output pixels around a point. All of them that count must have a value and lie
on one surface, else the point has none: across an edge the mean of two surfaces is the value of neither.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import InputError

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Joined = Callable[[tuple[slice, slice], tuple[slice, slice]], Mask]
"""Whether the pixels of two equal cuts through the maps lie on one surface, one by one (see ``mesh.Neighbours``)."""

ON_PIXEL = 1e-9
"""Weight of a pixel below which it does not count: a point on a pixel's centre needs no other, rounding aside."""


class Reading(IntEnum):
    """Why a point has a value, or none."""

    OK = 0
    OUTSIDE = 1
    UNMEASURED = 2
    EDGE = 3


@dataclass(frozen=True)
class Lattice:
    """Positions of output pixels: ``first`` (x, y) [px], ``step`` [px], ``size`` (columns, rows)."""

    first: tuple[int, int]
    step: tuple[int, int]
    size: tuple[int, int]

    @classmethod
    def of(cls, x: NDArray[np.int64], y: NDArray[np.int64]) -> Lattice:
        """The lattice of a store's coordinates.

        Raises InputError where it is less than two rows and columns, or not regular.
        """
        for name, at in (("columns", x), ("rows", y)):
            if at.size < 2:
                raise InputError(f"the results hold {at.size} of their {name}: points need at least 2 to move between")
            if np.ptp(np.diff(at)) != 0:
                raise InputError(f"the {name} of the results are not evenly spaced: run again with a fixed --stride")
        return cls((int(x[0]), int(y[0])), (int(x[1] - x[0]), int(y[1] - y[0])), (x.size, y.size))


@dataclass(frozen=True, eq=False)
class Cells:
    """Where points [n] lie: ``col``, ``row`` of the pixel up and left, ``right``, ``down`` the parts of a step beyond
    it (0 to 1), ``inside`` the region of the maps; cells of points outside are some others, to be ignored."""

    col: NDArray[np.intp]
    row: NDArray[np.intp]
    right: Floats
    down: Floats
    inside: Mask

    @classmethod
    def at(cls, lattice: Lattice, x: Floats, y: Floats) -> Cells:
        """The cells of the image positions ``x``, ``y`` [n] px; NaN is outside."""
        parts = []
        inside = np.ones(x.shape, np.bool_)
        for at, first, step, size in zip((x, y), lattice.first, lattice.step, lattice.size, strict=True):
            place = (at - first) / step
            with np.errstate(invalid="ignore"):
                inside &= (place >= -ON_PIXEL) & (place <= size - 1 + ON_PIXEL)
            place = np.clip(np.nan_to_num(place), 0.0, size - 1.0)
            cell = np.minimum(place.astype(np.intp), size - 2)
            parts.append((cell, place - cell))
        (col, right), (row, down) = parts
        return cls(col, row, right, down, inside)

    @property
    def corners(self) -> list[tuple[NDArray[np.intp], NDArray[np.intp], Floats]]:
        """Rows, columns and weights [n] of the four pixels around each point."""
        return [
            (self.row + j, self.col + i, (self.down if j else 1 - self.down) * (self.right if i else 1 - self.right))
            for j in (0, 1)
            for i in (0, 1)
        ]

    def mean(self, values: NDArray[Any]) -> Floats:
        """Bilinear means [..., n] of maps [..., y, x]; pixels without weight do not count."""
        total = np.zeros((*values.shape[:-2], self.col.size))
        for row, col, weight in self.corners:
            with np.errstate(invalid="ignore"):  # infinite, without weight
                total += np.where(weight > ON_PIXEL, weight * values[..., row, col], 0.0)
        return total


class Surface:
    """Which points of a frame can be read: ``known`` [y, x] pixels with values, ``joined`` which of them lie on one
    surface; None: all.

    ``parted``: whether a pixel lies on another surface than the one "beside" it [y, x - 1], or "below" [y - 1, x].
    """

    def __init__(self, known: Mask, joined: Joined | None = None):
        self._known = known
        whole = slice(None)
        before, behind = slice(None, -1), slice(1, None)
        cuts = {"beside": ((whole, before), (whole, behind)), "below": ((before, whole), (behind, whole))}
        self.parted = {
            side: np.zeros(known[first].shape, np.bool_) if joined is None else ~joined(first, second)
            for side, (first, second) in cuts.items()
        }

    def reading(self, cells: Cells) -> NDArray[np.uint8]:
        """Code of ``Reading`` for every point [n]."""
        missing = np.zeros(cells.col.shape, np.bool_)
        for row, col, weight in cells.corners:
            missing |= (weight > ON_PIXEL) & ~self._known[row, col]
        # Of each axis: whether the pixel before, and the one behind, has a weight.
        across, along = ((part < 1 - ON_PIXEL, part > ON_PIXEL) for part in (cells.right, cells.down))
        parted = np.zeros(cells.col.shape, np.bool_)
        for one in (0, 1):
            parted |= across[0] & across[1] & along[one] & self.parted["beside"][cells.row + one, cells.col]
            parted |= along[0] & along[1] & across[one] & self.parted["below"][cells.row, cells.col + one]
        return np.select(
            [~cells.inside, missing, parted], [Reading.OUTSIDE, Reading.UNMEASURED, Reading.EDGE], Reading.OK
        ).astype(np.uint8)


def finite(maps: Sequence[NDArray[Any]]) -> Mask:
    """Pixels [y, x] at which all maps are finite."""
    return np.asarray(np.all([np.isfinite(values) for values in maps], axis=0))


def second_differences(values: Floats, surface: Surface) -> tuple[Floats, Floats]:
    """``v[i - 1] - 2 v[i] + v[i + 1]`` of maps [..., y, x] along x and along y.

    0 at the ends, and where one of the three has no value or lies on another surface.
    """
    found = []
    for axis, side in ((-1, "beside"), (-2, "below")):
        moved = np.moveaxis(values, axis, -1)
        parted = np.moveaxis(surface.parted[side], axis, -1)
        bend = np.zeros(moved.shape)
        with np.errstate(invalid="ignore"):
            inner = moved[..., :-2] - 2 * moved[..., 1:-1] + moved[..., 2:]
        bend[..., 1:-1] = np.where(np.isfinite(inner) & ~(parted[..., :-1] | parted[..., 1:]), inner, 0.0)
        found.append(np.moveaxis(bend, -1, axis))
    return found[0], found[1]
