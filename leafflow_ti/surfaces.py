"""The surfaces that a frame shows, told apart by a coarse search: whole-pixel shifts, masks, and what hides what.

Every pixel of the reference image has a *label*, the whole-pixel disparity and motion nearest to its own. A pass over
the images that are shifted by one label sees small residuals where its surface is; the pixels of other surfaces, whose
residuals are larger than ``REACH``, are masked out of its windows, and so are those of single cameras and frames in
which another surface lies before it. A pass's result does not depend on where tiles begin, nor on other passes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.aim import Aim
from leafflow_ti.reading import Box, Mask
from leafflow_ti.runtime import Device
from leafflow_ti.search import Coarse, Extent
from leafflow_ti.stages.search import box_mean

Floats = NDArray[np.float32]

REACH = 1.5
"""Residual [px per step or frame] up to which a pixel belongs to the surface of a pass: what the filters still follow
around the half pixel that rounding leaves, and a slope of the surface within its window."""
EDGE = 2
"""Pixels within which the search may have drawn an edge between surfaces, or between labels of one, wrongly."""
FEWEST = 24
"""Pixels of a label in the image below which the nearest other label takes them."""


class Surfaces:
    """What one frame shows. ``cameras``: rows and columns that are read, ``reference`` among them (row, column)."""

    def __init__(
        self, device: Device, coarse: Coarse, extent: Extent, cameras: tuple[Sequence[int], Sequence[int]],
        reference: tuple[int, int],
    ):  # fmt: skip
        self.device, self.known = device, coarse.known
        shape = coarse.disparity.shape
        per_step = np.zeros((2, *shape))
        several = [extent.n_cols > 1, extent.n_rows > 1]
        if any(several):
            per_step[several] = extent.per_step(coarse.disparity.ravel()).T.reshape(2, *shape)[several]
        self.shown: Floats = np.concatenate([per_step, coarse.motion]).astype(np.float32)
        """[4, H, W]: disparity along x and y [px/step], motion along x and y [px/frame]."""
        self.aims, self.number = _labels(self.shown)
        """Labels, and the number [H, W] of each pixel's."""
        axis = extent.axis
        self._many = extent.n_cols * extent.n_rows > 1
        toward = extent.toward
        self._nearness = np.where(coarse.known, self.shown[axis] * np.float32(toward), np.float32(-1e9))
        self.axis, self._toward = axis, toward
        """The main axis of the grid, 0 for x."""
        self._steps = [[n - r for n in some] for some, r in zip(cameras, reference, strict=True)]

    def near_edges(self, reach: int = EDGE) -> Mask:
        """[H, W]: pixels within ``reach`` of one whose surface is another."""
        shape = self.number.shape
        found = np.zeros(shape, np.bool_)
        for axis in (1, 2):
            step = np.abs(np.diff(self.shown, axis=axis)).max(axis=0) > REACH
            for side in (slice(None, -1), slice(1, None)):
                at: list[Any] = [slice(None), slice(None)]
                at[axis - 1] = side
                found[tuple(at)] |= step
        return dilated(found, reach - 1)

    def offered(self, y: range, x: range) -> Iterator[tuple[int, Mask]]:
        """Labels in the order of their numbers, and which pixels [rows, cols] at rows and columns ``y``, ``x`` may be
        of them: those within ``EDGE`` px of one that is. Says the same of a pixel whatever the others are."""
        rows, cols = (slice(max(0, n[0] - EDGE), n[-1] + EDGE + 1) for n in (y, x))
        number, here = self.number[rows, cols], np.ix_(np.array(y) - rows.start, np.array(x) - cols.start)
        for label in np.unique(number).tolist():
            yield label, dilated(number == label, EDGE)[here]

    def layer(self, aims: Sequence[Aim], box: Box) -> Mask:
        """Where the surface of some labels is, in a block of the reference image; False beyond the image.

        The outermost pixel of it is left out, where filters and the search see both surfaces.
        """
        wide = box.widened(1)
        out = np.zeros((wide.rows, wide.cols), np.bool_)
        rows, cols, inner = _overlap(wide, self.number.shape)
        shown, other = self.shown[:, rows, cols], ~self.known[rows, cols]
        within = [np.abs(shown - vector(aim)[:, None, None]).max(axis=0) <= REACH for aim in aims]
        other = other | ~np.logical_or.reduce(within)
        out[inner] = ~dilated(other, 1)
        return out[1:-1, 1:-1]

    def planes(self, aims: Sequence[Aim], at: tuple[range, range], radius: int) -> tuple[Floats, Floats, Floats]:
        """Values, and slopes along x and y, [4, rows, cols] each, of the planes through what the surface of some labels
        shows within ``radius`` px of the pixels at rows and columns ``at``; NaN where there is nothing of it."""
        rows, cols = (slice(max(0, n[0] - radius), n[-1] + radius + 1) for n in at)
        shown, belongs = self.shown[:, rows, cols].astype(float), self.known[rows, cols]
        belongs = belongs & np.logical_or.reduce(
            [np.abs(shown - vector(aim)[:, None, None]).max(axis=0) <= REACH for aim in aims]
        )
        here = np.ix_(np.array(at[0]) - rows.start, np.array(at[1]) - cols.start)
        y, x = (np.arange(n, dtype=float) - (n - 1) / 2 for n in belongs.shape)
        x, y = np.broadcast_arrays(x, y[:, None])

        def mean(values: NDArray[Any]) -> NDArray[np.float64]:
            return np.asarray(box_mean(values * belongs, radius)[here] / share)

        share = box_mean(belongs, radius)[here]
        with np.errstate(divide="ignore", invalid="ignore"):
            mx, my = mean(x), mean(y)
            # A pixel's own width keeps slopes finite where a single row or column is left.
            xx, yy, xy = mean(x * x) - mx * mx + 1 / 12, mean(y * y) - my * my + 1 / 12, mean(x * y) - mx * my
            found = []
            for values in shown:
                m = mean(values)
                vx, vy = mean(values * x) - m * mx, mean(values * y) - m * my
                det = xx * yy - xy * xy
                slope_x, slope_y = (yy * vx - xy * vy) / det, (xx * vy - xy * vx) / det
                found.append((m + slope_x * (x[here] - mx) + slope_y * (y[here] - my), slope_x, slope_y))
        value, along_x, along_y = (np.array(part, np.float32) for part in zip(*found, strict=True))
        return value, along_x, along_y

    def hidden(self, aim: Aim, elapsed: float, box: Box) -> Mask | None:
        """Where another surface hides a label's, ``elapsed`` frames from the results: [sy, sx, rows, cols], or None.

        What is nearer hides; with one camera, which knows no depth, everything else that moves otherwise may.
        """
        from leafflow_ti.kernels.hiding import hiding_kernel

        least = REACH if not self._many else REACH + self._toward * aim.shift[self.axis]
        nearness = self._nearness if self._many else self._otherwise(aim)
        views = np.array([(kx, ky, elapsed) for ky in self._steps[0] for kx in self._steps[1]], float).T
        regions = self._regions(aim, views, box, nearness > least)
        if not (np.diff(regions[:, :2]) > 0).any():
            return None
        device, n = self.device, views.shape[1]
        shape = (len(self._steps[0]), len(self._steps[1]), box.rows, box.cols)
        marks = device.zeros(int(np.prod(shape)), "int")
        hiding_kernel(device.dense)(
            n, min(n, device.tasks(n)), *self.number.shape, box.y, box.x, box.rows, box.cols, least,
            device.array(regions.ravel(), "int"), device.array(views.ravel()), device.array(vector(aim)),
            device.array(nearness.ravel()), self._on_device, marks,
        )  # fmt: skip
        found: Mask = device.host(marks).reshape(shape) != 0
        return found

    @cached_property
    def _on_device(self) -> Any:
        return self.device.array(self.shown.ravel())

    def _otherwise(self, aim: Aim) -> Floats:
        """How much pixels move otherwise than a label says."""
        away = np.abs(self.shown[2:] - vector(aim)[2:, None, None]).max(axis=0)
        return np.where(self.known, away, np.float32(-1e9)).astype(np.float32)

    def _regions(self, aim: Aim, views: NDArray[np.float64], box: Box, hides: Mask) -> NDArray[np.int64]:
        """[images, 4]: rows and columns of the reference image from which a hiding pixel can come into the block."""
        regions = np.zeros((views.shape[1], 4), np.int64)
        rows, cols = np.flatnonzero(hides.any(axis=1)), np.flatnonzero(hides.any(axis=0))
        if not rows.size:
            return regions
        of = self.shown[:, hides]
        low, high = (f(of, axis=1) - vector(aim) for f in (np.min, np.max))
        for k, (kx, ky, n) in enumerate(views.T):
            for axis, (step, first, size, at) in enumerate(((ky, box.y, box.rows, rows), (kx, box.x, box.cols, cols))):
                d, m = 1 - axis, 3 - axis
                moves = [a * step + b * n for a in (low[d], high[d]) for b in (low[m], high[m])]
                begin = max(int(np.floor(first - max(moves))) - 2, int(at[0]))
                end = min(int(np.ceil(first + size - min(moves))) + 2, int(at[-1]) + 1)
                regions[k, 2 * axis : 2 * axis + 2] = begin, max(begin, end)
            if regions[k, 2] == regions[k, 3]:
                regions[k, 1] = regions[k, 0]
        return regions


def dilated(mask: Mask, radius: int) -> Mask:
    """Pixels within ``radius`` rows and columns of one of the mask."""
    for axis in range(2):
        wide = mask.copy()
        for by in range(1, radius + 1):
            for to, source in ((slice(by, None), slice(None, -by)), (slice(None, -by), slice(by, None))):
                one, two = ([slice(None), slice(None)] for _ in range(2))
                one[axis], two[axis] = to, source
                wide[tuple(one)] |= mask[tuple(two)]
        mask = wide
    return mask


def vector(aim: Aim) -> Floats:
    """Of a label, in the order of ``Surfaces.shown``."""
    return np.array([*aim.shift, *aim.motion], np.float32)


def _labels(shown: Floats) -> tuple[list[Aim], NDArray[np.intp]]:
    """The whole-pixel labels that occur, and the number [H, W] of each pixel's; rare ones join the nearest other."""
    whole = np.rint(shown).astype(np.int64).reshape(4, -1)
    base = int(np.abs(whole).max()) + 1
    key = np.zeros(whole.shape[1], np.int64)
    for row in whole:
        key = key * (2 * base + 1) + (row + base)
    keys, first, number, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    values = whole[:, first].T
    kept = np.flatnonzero(count >= min(FEWEST, int(count.max())))
    nearest = np.arange(len(keys))
    for rare in np.flatnonzero(count < min(FEWEST, int(count.max()))):
        nearest[rare] = kept[np.abs(values[kept] - values[rare]).max(axis=1).argmin()]
    place = np.zeros(len(keys), np.intp)
    place[kept] = np.arange(len(kept))
    aims = [Aim((int(v[0]), int(v[1])), (int(v[2]), int(v[3]))) for v in values[kept]]
    return aims, place[nearest][number.reshape(-1)].reshape(shown.shape[1:])


def _overlap(box: Box, shape: tuple[int, ...]) -> tuple[slice, slice, tuple[slice, slice]]:
    """Rows and columns of the image that a block shows, and where they lie in the block."""
    y0, y1 = np.clip((box.y, box.y + box.rows), 0, shape[0]).tolist()
    x0, x1 = np.clip((box.x, box.x + box.cols), 0, shape[1]).tolist()
    return slice(y0, y1), slice(x0, x1), (slice(y0 - box.y, y1 - box.y), slice(x0 - box.x, x1 - box.x))
