"""Coarse search: disparity and motion of every pixel of the reference image, to a fraction of a pixel.

Disparities are rated at all steps between two limits; motions among candidates, which local correlations of the
images propose and which the winners of each round refine. Both are chosen by semi-global matching of locally
normalised images (``stages.search``), so that light may change slowly over the image, from camera to camera and from
frame to frame. Large images are searched at reduced resolution.

Signs as in model section 1: a camera k steps to +x shows a point at ``x + disparity k``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.runtime import Device
from leafflow_ti.stages.search import Costs, Found, Image, Labels, Views, features, search

ReadImage = Callable[[int, int, int], Image]
Mask = NDArray[np.bool_]
Range = tuple[float, float]

REACH = 4
"""Cameras on each side of the reference that are compared at most."""
WIDEST = 0.25
"""Of the image's width: the largest displacement that is searched for."""
MOST_MOTION = 24.0
"""Pixels per frame that are searched for unless a range is given."""
VOLUME = 24e6
"""Costs that are held at most, per array; larger images are searched at reduced resolution."""
MOST_LABELS = 128
"""Disparities at most between the limits."""

SLOTS = 64
"""Motions at most among which a pixel chooses."""
CANDIDATE_TILE, CORRELATED, PEAKS = 32, 64, 6
"""Correlations: distance and size [px] of their windows, peaks of each."""
REFINING = ((32, 1.0), (16, 0.5), (16, 0.25))
"""Of later rounds: tiles [px] in which candidates are gathered, and distance [px] of candidates."""
OWN, OTHERS = 12, 4
"""Candidates that a tile takes from itself and from each tile around it."""


@dataclass(frozen=True)
class Extent:
    """Size of a capture, and how its grid sees depth.

    ``baseline`` (bx, by): camera step [mm]; ``offset`` (ox, oy) [px/step]: total disparity less the seen one.
    """

    n_frames: int
    n_rows: int
    n_cols: int
    height: int
    width: int
    baseline: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)

    @property
    def axis(self) -> int:
        """The main axis, 0 for x, 1 for y: x if the grid has columns."""
        return 0 if self.n_cols > 1 or self.n_rows == 1 else 1

    def per_step(self, disparity: NDArray[Any]) -> NDArray[np.float64]:
        """[n, 2]: displacement (x, y) per camera step along x and along y, of disparities [n] along the main axis."""
        total = disparity + self.offset[self.axis]
        along = [total * self.baseline[k] / self.baseline[self.axis] - self.offset[k] for k in range(2)]
        return np.stack(along, axis=1)


@dataclass(frozen=True, eq=False)
class Coarse:
    """What the reference camera sees at one frame.

    ``disparity`` [H, W] px per camera step along the main axis, as seen in the images; 0 for one camera. ``motion``
    [2, H, W] px per frame (x, y); 0 for one frame. ``known`` [H, W]: where both could be decided.
    """

    disparity: Image
    motion: Image
    known: Mask


def coarse_search(
    device: Device, images: ReadImage, extent: Extent, *, reference: tuple[int, int], frame: int, moving: bool = True,
    disparity_range: Range | None = None, motion_range: float | None = None, mask: Mask | None = None,
) -> Coarse:  # fmt: skip
    """Disparity and motion of every pixel of the camera ``reference`` (row, column) at ``frame``.

    ``images(t, sy, sx)`` reads a whole image [H, W]. ``moving``: whether motion is searched for.
    ``disparity_range`` (lowest, highest) [px/step] as seen along the main axis, None finds it; ``motion_range`` largest
    motion along x or y [px/frame], None for 24; ``mask`` [H, W]: pixels that count.
    """
    shape = (extent.height, extent.width)
    chosen = np.ones(shape, np.bool_) if mask is None else mask
    middle = images(frame, *reference)
    chosen = chosen & np.isfinite(middle)
    floor = noise_floor(middle)
    disparity, motion, known = np.zeros(shape, np.float32), np.zeros((2, *shape), np.float32), chosen
    if extent.n_cols > 1 or extent.n_rows > 1:
        stereo = _Stereo(device, images, extent, reference, frame, chosen, floor)
        limits = disparity_range or stereo.limits()
        disparity, seen = stereo.search(limits)
        known = known & seen
    if moving and extent.n_frames > 1:
        most = min(MOST_MOTION, WIDEST * extent.width) if motion_range is None else motion_range
        motion, seen = _Flow(device, images, extent, reference, frame, chosen, floor).search(most)
        known = known & seen
    return Coarse(disparity, motion, known)


def peak_bytes(image: tuple[int, int]) -> int:
    """Memory of a search in images [rows, cols], at most: two volumes, features of all views, and the images."""
    reduction = max(1.0, image[0] * image[1] * SLOTS / VOLUME)
    pixels = int(image[0] * image[1])
    views = (4 * REACH + 1) * 2 * 4 * pixels / reduction
    return int(2 * 4 * min(VOLUME, pixels * MOST_LABELS) + 2 * views + 40 * pixels)


def noise_floor(image: Image) -> float:
    """Standard deviation [grey] below which texture counts as noise: from the finest differences of the image."""
    values = np.where(np.isfinite(image), image, np.nanmean(image)).astype(np.float64)
    fine = np.diff(np.diff(values, axis=0), axis=1)  # of white noise: twice its standard deviation
    noise = 1.4826 * np.median(np.abs(fine)) / 2.0
    return float(max(noise, 0.02 * values.std(), 1e-6 * np.abs(values).max(), 1e-12))


def reduced(image: NDArray[np.float32], scale: int) -> Image:
    """[H // scale, W // scale]: means over squares of ``scale`` px."""
    rows, cols = image.shape[0] // scale, image.shape[1] // scale
    blocks = image[: rows * scale, : cols * scale].reshape(rows, scale, cols, scale)
    return np.asarray(blocks.mean(axis=(1, 3)), np.float32)


def enlarged(values: NDArray[np.float32], scale: int, shape: tuple[int, int]) -> Image:
    """[H, W]: every value repeated over the square that ``reduced`` took it from; the last ones up to the border."""
    y, x = (np.minimum(np.arange(n) // scale, m - 1) for n, m in zip(shape, values.shape, strict=True))
    return np.asarray(values[np.ix_(y, x)])


@dataclass(frozen=True, eq=False)
class _Search:
    """What both searches read and prepare."""

    device: Device
    images: ReadImage
    extent: Extent
    reference: tuple[int, int]
    frame: int
    mask: Mask
    floor: float

    def prepared(self, t: int, row: int, col: int, scale: int, costs: Costs) -> Image:
        """Features [2, rows, cols] of one image at reduced resolution."""
        return features(self.grey(t, row, col, scale), costs.radius, self.floor)

    def grey(self, t: int, row: int, col: int, scale: int) -> Image:
        """One image at reduced resolution, its mean in place of values that are not finite."""
        image = self.images(t, row, col)
        finite = np.isfinite(image)
        if not finite.all():
            image = np.where(finite, image, image[finite].mean() if finite.any() else 0.0).astype(np.float32)
        return reduced(image, scale) if scale > 1 else image

    def choose(
        self, scale: int, others: list[tuple[int, int, int]], views: Views, labels: Labels, costs: Costs
    ) -> Found:
        """The best labels at reduced resolution; ``others`` (t, row, column) of the views."""
        keys = [(self.frame, *self.reference), *others]
        stack = np.stack([self.prepared(*key, scale, costs) for key in keys])
        middle = self.grey(*keys[0], scale)
        typical = np.mean(np.abs(np.diff(middle, axis=1))) + np.mean(np.abs(np.diff(middle, axis=0)))
        guide = middle / np.float32(max(float(typical), 1e-12))
        mask = reduced(self.mask.astype(np.float32), scale) > 0.0
        return search(self.device, stack, guide, mask, views, labels, costs)

    def scale_for(self, slots: int) -> int:
        """Least reduction at which the volume of ``slots`` labels per pixel is small enough."""
        return max(1, int(np.ceil(np.sqrt(self.extent.height * self.extent.width * slots / VOLUME))))


class _Stereo(_Search):
    """Disparities, one list of them for all pixels."""

    def arms(self, reach: int) -> tuple[list[list[tuple[float, float]]], list[tuple[int, int, int]]]:
        """Camera steps (x, y) of the neighbours left, right, above, below; and their keys (t, row, column)."""
        row, col = self.reference
        arms, keys = [], []
        for step_x, step_y in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            steps = [
                (k * step_x, k * step_y)
                for k in range(1, reach + 1)
                if 0 <= col + k * step_x < self.extent.n_cols and 0 <= row + k * step_y < self.extent.n_rows
            ]
            if steps:
                arms.append([(float(i), float(j)) for i, j in steps])
                keys += [(self.frame, row + j, col + i) for i, j in steps]
        return arms, keys

    def labelled(self, limits: Range, step: float, reach: int, scale: int, costs: Costs) -> tuple[Found, Labels]:
        """The best of the disparities between the limits [px/step], ``step`` apart."""
        count = max(2, int(np.ceil((limits[1] - limits[0]) / step)) + 1)
        values = self.extent.per_step(limits[0] + step * np.arange(count)) / scale
        width = -(-self.extent.width // scale)
        side = max(width, self.extent.height)
        apart = float(np.abs(values[1] - values[0]).max())
        labels = Labels(side, 1, np.array([count], np.int32), values[None], apart, line=True)
        arms, keys = self.arms(reach)
        return self.choose(scale, keys, Views.of(arms), labels, costs), labels

    def limits(self) -> Range:
        """Limits [px/step] between which the disparities of nearly all pixels lie, from the nearest cameras alone."""
        axis = self.extent.axis
        size = self.extent.width if axis == 0 else self.extent.height
        widest = WIDEST * size
        toward = -float(np.sign(self.extent.baseline[axis])) or 1.0
        far = -self.extent.offset[axis]
        ends = sorted((far - 2.0 * toward, far + widest * toward))
        step = max(1.0, (ends[1] - ends[0]) / MOST_LABELS)
        scale = max(self.scale_for(MOST_LABELS), int(step))
        found, _ = self.labelled((ends[0], ends[1]), step, 1, scale, Costs())
        weights = np.bincount(found.slot[found.cost < 0.5 * Costs().most], minlength=2).astype(float)
        share = np.cumsum(weights) / max(weights.sum(), 1.0)
        low, high = np.searchsorted(share, (0.003, 0.997))
        return ends[0] + step * (low - 1.5), ends[0] + step * (high + 1.5)

    def search(self, limits: Range) -> tuple[Image, Mask]:
        """Disparity [H, W] px/step and where it is known."""
        axis = self.extent.axis
        count = (self.extent.n_cols, self.extent.n_rows)[axis]
        place = self.reference[1 - axis]
        around = max(place, count - 1 - place)
        widest = max(abs(limits[0]), abs(limits[1]), 1e-6)
        size = self.extent.width if axis == 0 else self.extent.height
        reach = max(1, min(REACH, around, int(WIDEST * size / widest)))
        step = max(1.0 / reach, (limits[1] - limits[0]) / MOST_LABELS)
        scale = self.scale_for(int((limits[1] - limits[0]) / step) + 2)
        costs = Costs()
        found, _ = self.labelled(limits, step, reach, scale, costs)
        shape = (self.extent.height, self.extent.width)
        disparity = enlarged(found.displacement[axis], scale, shape) * np.float32(scale)
        return disparity, enlarged(found.cost, scale, shape) < 0.7 * costs.most


class _Flow(_Search):
    """Motions among candidates, tile by tile: peaks of local correlations first, then what the pixels around chose."""

    def search(self, most: float) -> tuple[Image, Mask]:
        """Motion [2, H, W] px/frame and where it is known."""
        scale, costs = self.scale_for(SLOTS), Costs()
        keys, signs = [], []
        for sign in (1, -1):
            if 0 <= self.frame + sign < self.extent.n_frames:
                keys.append((self.frame + sign, *self.reference))
                signs.append(float(sign))
        views = Views.of([[(sign, sign)] for sign in signs])
        reach = max(1, int(np.ceil(most / scale)))
        middle = self.prepared(self.frame, *self.reference, scale, costs)
        others = [self.prepared(*key, scale, costs) for key in keys]
        labels = tiled(proposals(middle, others, signs, reach), CANDIDATE_TILE, middle.shape[1:], reach)
        for tile, unit in REFINING:
            found = self.choose(scale, keys, views, labels, costs)
            labels = tiled(votes(found.displacement / unit, tile), tile, middle.shape[1:], reach, unit)
        found = self.choose(scale, keys, views, labels, costs)
        shape = (self.extent.height, self.extent.width)
        motion = np.stack([enlarged(m, scale, shape) for m in found.displacement]) * np.float32(scale)
        return motion, enlarged(found.cost, scale, shape) < 0.7 * costs.most


def proposals(middle: Image, others: list[Image], signs: list[float], reach: int) -> list[NDArray[np.int64]]:
    """Candidates [n, 2] (x, y) of each tile of ``CANDIDATE_TILE`` px: highest peaks of the correlation of a window of
    ``CORRELATED`` px around it with the images before (sign -1) and behind (sign 1), up to ``reach`` px."""
    rows, cols = middle.shape[1:]
    half, size = CORRELATED // 2, CORRELATED + 2 * reach
    pad = half + reach
    hann = np.sin(np.pi * (np.arange(CORRELATED) + 0.5) / CORRELATED) ** 2
    window = np.outer(hann, hann)
    # The product of one complex number and another's conjugate holds the products of their gradients.
    here, *there = (np.pad(image[0] + 1j * image[1], pad) for image in (middle, *others))
    found = []
    for y in range(CANDIDATE_TILE // 2, rows + CANDIDATE_TILE // 2, CANDIDATE_TILE):
        for x in range(CANDIDATE_TILE // 2, cols + CANDIDATE_TILE // 2, CANDIDATE_TILE):
            top, left = min(y, rows - 1) + reach, min(x, cols - 1) + reach
            part = np.zeros((size, size), np.complex128)
            part[:CORRELATED, :CORRELATED] = here[top : top + CORRELATED, left : left + CORRELATED] * window
            spectrum = np.conj(np.fft.fft2(part))
            total = np.zeros((2 * reach + 1, 2 * reach + 1))
            for image, sign in zip(there, signs, strict=True):
                block = image[top - reach : top - reach + size, left - reach : left - reach + size]
                # Cyclic, and free of wrapping for the lags up to twice ``reach`` that are kept.
                lags = np.fft.ifft2(spectrum * np.fft.fft2(block)).real[: 2 * reach + 1, : 2 * reach + 1]
                total += lags if sign > 0.0 else lags[::-1, ::-1]
            found.append(_peaks(total, PEAKS) - reach)
    return found


def _peaks(values: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """The highest local maxima, [n, 2] (x, y), highest first."""
    padded = np.pad(values, 1, constant_values=-np.inf)
    rows, cols = values.shape
    around = [padded[j : j + rows, i : i + cols] for j in range(3) for i in range(3) if (j, i) != (1, 1)]
    y, x = np.nonzero(values > np.max(around, axis=0))
    order = np.argsort(-values[y, x], kind="stable")[:most]
    return np.stack([x[order], y[order]], axis=1)


def votes(displacement: Image, tile: int) -> list[NDArray[np.int64]]:
    """Whole-pixel displacements [n, 2] (x, y) that pixels of each tile chose, the most frequent first."""
    whole = np.rint(displacement).astype(np.int64)
    found = []
    for y in range(0, whole.shape[1], tile):
        for x in range(0, whole.shape[2], tile):
            values, counts = np.unique(whole[:, y : y + tile, x : x + tile].reshape(2, -1), axis=1, return_counts=True)
            found.append(values[:, np.argsort(-counts, kind="stable")].T)
    return found


def tiled(
    candidates: list[NDArray[np.int64]], tile: int, shape: tuple[int, ...], reach: int, unit: float = 1.0
) -> Labels:
    """Labels of each tile: its own candidates and those of the tiles around it, in turn, then the neighbours of all of
    them; at most ``SLOTS`` and none longer than ``reach`` px along x or y. Candidates are in units of ``unit`` px."""
    tiles_y, tiles_x = -(-shape[0] // tile), -(-shape[1] // tile)
    count = np.zeros(tiles_y * tiles_x, np.int32)
    values = np.zeros((tiles_y * tiles_x, SLOTS, 2))
    steps = np.array([(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1)])
    for here in range(len(count)):
        row, col = divmod(here, tiles_x)
        around = [
            candidates[j * tiles_x + i]
            for j in range(max(row - 1, 0), min(row + 2, tiles_y))
            for i in range(max(col - 1, 0), min(col + 2, tiles_x))
            if (j, i) != (row, col)
        ]
        near = np.concatenate([candidates[here][:OWN], *(c[:OTHERS] for c in around)])
        wide = (near[:, None] + steps).reshape(-1, 2)
        every = np.concatenate([near, wide[np.abs(wide).max(axis=1) * unit <= reach]])
        _, first = np.unique(every, axis=0, return_index=True)
        chosen = every[np.sort(first)[:SLOTS]]
        count[here] = len(chosen)
        values[here, : len(chosen)] = unit * chosen
    return Labels(tile, tiles_x, count, values, unit)
