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

from leafflow_ti.errors import UsageError
from leafflow_ti.runtime import Device
from leafflow_ti.stages.candidates import CANDIDATE_TILE, SLOTS, proposals, tiled, votes
from leafflow_ti.stages.search import Costs, Found, Image, Labels, Views, box_mean, features, search

Key = tuple[int, int, int]
"""Frame, camera row, camera column."""
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
"""Costs per array at most; larger images are searched at reduced resolution. There is an array for each side of the
reference on which cameras stand, and two more: .6 GB."""
MOST_LABELS = 80
"""Disparities at most between the limits."""
ROUGH_SIZE, ROUGH_LABELS = 300, 128
"""Pixels along the shorter side of the images in which limits are looked for, and disparities then."""
STRAY = 0.003
"""Share of the pixels beyond each limit that may be errors."""
REFINING = ((16, 0.5), (16, 0.25))
"""Of later rounds of motions: tiles [px] in which candidates are gathered, and distance [px] of candidates."""
LEAST_TEXTURE = 0.02
"""Standard deviation, in units of that of the whole image, below which texture counts as noise."""
FADED = 0.2
"""Mean square of features below which there is no texture: of noise alone it is .5."""
FARTHEST = 1.5
"""How much later or earlier than the nearer frame beside it, relatively, the other one may be to be compared, too."""
SETTLING = 4
"""Rounds in which it is found where a pixel has come from."""
COSTS = Costs()


@dataclass(frozen=True)
class Extent:
    """Size of a capture, and how its grid sees depth.

    ``baseline`` (bx, by): camera step [mm]; ``offset`` (ox, oy) [px/step]: total disparity less the seen one;
    ``times`` of the frames in nominal intervals, () if they are even.
    """

    n_frames: int
    n_rows: int
    n_cols: int
    height: int
    width: int
    baseline: tuple[float, float] = (1.0, 1.0)
    offset: tuple[float, float] = (0.0, 0.0)
    times: tuple[float, ...] = ()

    def neighbours(self, frame: int) -> dict[int, float]:
        """Frames before and behind one, and how much later they were taken [nominal intervals]; one that is far more
        than the other is left out: what it shows has changed the more."""
        times = self.times or tuple(float(t) for t in range(self.n_frames))
        later = {t: times[t] - times[frame] for t in (frame + 1, frame - 1) if 0 <= t < self.n_frames}
        nearest = min(map(abs, later.values()))
        return {t: by for t, by in later.items() if abs(by) <= FARTHEST * nearest}

    @property
    def axis(self) -> int:
        """The main axis, 0 for x, 1 for y: x if the grid has columns."""
        return 0 if self.n_cols > 1 or self.n_rows == 1 else 1

    @property
    def toward(self) -> float:
        """Sign of the disparities of what is near."""
        return -float(np.sign(self.baseline[self.axis])) or 1.0

    def per_step(self, disparity: NDArray[Any]) -> NDArray[np.float64]:
        """[n, 2]: displacement (x, y) per camera step along x and along y, of disparities [n] along the main axis."""
        total = disparity + self.offset[self.axis]
        along = [total * self.baseline[k] / self.baseline[self.axis] - self.offset[k] for k in range(2)]
        return np.stack(along, axis=1)


@dataclass(frozen=True, eq=False)
class Coarse:
    """What the reference camera sees at one frame.

    ``disparity`` [H, W] px per camera step along the main axis, as seen in the images; 0 for one camera. ``motion``
    [2, H, W] px per nominal interval (x, y); 0 for one frame. ``known`` [H, W]: where both could be decided.
    """

    disparity: Image
    motion: Image
    known: Mask

    def later(self, by: float, toward: float) -> Coarse:
        """What the camera sees ``by`` intervals later, if all goes on moving; ``toward``: sign of nearer disparities.

        Every pixel goes where its motion leads, the nearest one wins. What comes to light then is not known.
        """
        shape = self.known.shape
        there = np.indices(shape)
        size = np.array(shape)[:, None, None]

        def moved(source: NDArray[np.intp]) -> NDArray[np.intp]:
            """Where the pixels ``source`` [2, H, W] (y, x) are then."""
            motion = self.motion[::-1, source[0], source[1]]
            return np.asarray(np.rint(source + np.float32(by) * motion), np.intp)

        # Pixels that none goes to: gaps in what spreads, and what comes to light.
        source = there
        for _ in range(SETTLING):
            source = np.clip(there - (moved(source) - source), 0, size - 1)
        lit = np.abs(moved(source) - there).max(axis=0) > 1
        order = np.argsort(np.where(self.known, toward * self.disparity, -np.inf), axis=None, kind="stable")
        begin = there.reshape(2, -1)[:, order]
        end = moved(there).reshape(2, -1)[:, order]
        inside = ((end >= 0) & (end < size[:, 0])).all(axis=0)
        to = tuple(end[:, inside])
        source[:, to[0], to[1]] = begin[:, inside]  # of several the last one, the nearest
        lit[to] = False
        at = tuple(source)
        return Coarse(self.disparity[at], self.motion[:, at[0], at[1]], self.known[at] & ~lit)


def coarse_search(
    device: Device, images: ReadImage, extent: Extent, *, reference: tuple[int, int], frame: int, moving: bool = True,
    disparity_range: Range | None = None, motion_range: float | None = None, mask: Mask | None = None,
) -> Coarse:  # fmt: skip
    """Disparity and motion of every pixel of the camera ``reference`` (row, column) at ``frame``.

    ``images(t, sy, sx)`` reads a whole image [H, W]. ``moving``: whether motion is searched for.
    ``disparity_range`` (lowest, highest) [px/step] as seen along the main axis, None finds it; ``motion_range`` largest
    motion along x or y [px/frame], None for 24; ``mask`` [H, W]: pixels that count. Raises UsageError for limits in
    the wrong order.
    """
    if disparity_range is not None and not disparity_range[0] <= disparity_range[1]:
        raise UsageError(f"disparities {disparity_range} px per step: give the lowest, then the highest")
    if motion_range is not None and not motion_range >= 0.0:
        raise UsageError(f"motion range {motion_range:g} px/frame: cannot be negative")
    shape = (extent.height, extent.width)
    finite = np.isfinite(images(frame, *reference))
    known = finite if mask is None else mask & finite
    task = (device, images, extent, reference, frame, known)
    disparity, motion = np.zeros(shape, np.float32), np.zeros((2, *shape), np.float32)
    if extent.n_cols > 1 or extent.n_rows > 1:
        stereo = _Stereo(*task)
        disparity, seen = stereo.search(stereo.limits() if disparity_range is None else disparity_range)
        known = known & seen
    if moving and extent.n_frames > 1:
        most = min(MOST_MOTION, WIDEST * extent.width) if motion_range is None else motion_range
        motion, seen = _Flow(*task).search(most)
        known = known & seen
    return Coarse(disparity, motion, known)


def warm_up(device: Device) -> None:
    """Compile the kernels of a search, of any capture, with tiny images."""
    noise = np.random.default_rng(0).standard_normal((24, 40)).astype(np.float32)
    coarse_search(
        device, lambda *key: noise, Extent(2, 1, 2, 24, 40), reference=(0, 1), frame=0, disparity_range=(-2.0, 0.0),
        motion_range=1.0,
    )  # fmt: skip


def peak_bytes(image: tuple[int, int]) -> int:
    """Memory of a search in images [rows, cols], at most: two volumes, features of all views, and the images."""
    reduction = max(1.0, image[0] * image[1] * SLOTS / VOLUME)
    pixels = int(image[0] * image[1])
    views = (4 * REACH + 1) * 2 * 4 * pixels / reduction
    return int(2 * 4 * min(VOLUME, pixels * MOST_LABELS) + 2 * views + 40 * pixels)


def noise_floor(image: Image) -> float:
    """Standard deviation [grey] below which texture counts as noise: from the finest differences of the image."""
    values = image.astype(np.float64)
    fine = np.diff(np.diff(values, axis=0), axis=1)  # of white noise: twice its standard deviation
    noise = 1.4826 * np.median(np.abs(fine)) / 2.0
    return float(max(noise, LEAST_TEXTURE * values.std(), 1e-6 * np.abs(values).max(), 1e-12))


def reduced(image: NDArray[np.float32], scale: int) -> Image:
    """[H // scale, W // scale]: means over squares of ``scale`` px."""
    rows, cols = image.shape[0] // scale, image.shape[1] // scale
    blocks = image[: rows * scale, : cols * scale].reshape(rows, scale, cols, scale)
    return np.asarray(blocks.mean(axis=(1, 3)), np.float32)


def enlarged(values: NDArray[Any], scale: int, shape: tuple[int, int]) -> NDArray[Any]:
    """[H, W]: every value repeated over the square that ``reduced`` took it from; the last ones up to the border."""
    y, x = (np.minimum(np.arange(n) // scale, m - 1) for n, m in zip(shape, values.shape, strict=True))
    return np.asarray(values[np.ix_(y, x)])


@dataclass(frozen=True, eq=False)
class _Prepared:
    """Images at reduced resolution.

    ``stack`` [1 + others, 2, rows, cols] features, the reference first; ``guide`` [rows, cols] the reference in units
    of a typical difference of its neighbours; ``mask`` [rows, cols]: pixels that count.
    """

    stack: Image
    guide: Image
    mask: Mask


@dataclass(frozen=True, eq=False)
class _Search:
    """What both searches read and prepare."""

    device: Device
    images: ReadImage
    extent: Extent
    reference: tuple[int, int]
    frame: int
    mask: Mask

    def grey(self, t: int, row: int, col: int, scale: int) -> Image:
        """One image at reduced resolution, its mean in place of values that are not finite."""
        image = self.images(t, row, col)
        finite = np.isfinite(image)
        if not finite.all():
            image = np.where(finite, image, image[finite].mean() if finite.any() else 0.0).astype(np.float32)
        return reduced(image, scale) if scale > 1 else image

    def prepared(self, others: list[Key], scale: int) -> _Prepared:
        """The reference and ``others`` at reduced resolution."""
        middle = self.grey(self.frame, *self.reference, scale)
        floor = noise_floor(middle)
        greys = [middle, *(self.grey(*key, scale) for key in others)]
        typical = np.mean(np.abs(np.diff(middle, axis=1))) + np.mean(np.abs(np.diff(middle, axis=0)))
        stack = np.stack([features(image, COSTS.radius, floor) for image in greys])
        mask = reduced(self.mask.astype(np.float32), scale) > 0.0
        return _Prepared(stack, middle / np.float32(max(float(typical), 1e-12)), mask)

    def choose(self, seen: _Prepared, views: Views, labels: Labels) -> tuple[Found, Mask]:
        """The best labels [rows, cols], and where they explain what there is to see."""
        found = search(self.device, seen.stack, seen.guide, seen.mask, views, labels, COSTS)
        textured = box_mean(np.sum(seen.stack[0] ** 2, axis=0) / 2.0, COSTS.radius) > FADED
        return found, (found.cost < COSTS.likely) & textured

    def scale_for(self, slots: int) -> int:
        """Least reduction at which the volume of ``slots`` labels per pixel is small enough."""
        return max(1, int(np.ceil(np.sqrt(self.extent.height * self.extent.width * slots / VOLUME))))


class _Stereo(_Search):
    """Disparities, one list of them for all pixels."""

    def arms(self, reach: int) -> tuple[list[list[tuple[float, float]]], list[Key]]:
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

    def labelled(self, limits: Range, step: float, reach: int, scale: int) -> tuple[Found, Mask]:
        """The best of disparities ``step`` apart between the limits [px/step], and where it explains the images."""
        count = max(2, int(np.ceil((limits[1] - limits[0]) / step)) + 1)
        values = self.extent.per_step(limits[0] + step * np.arange(count)) / scale
        width = -(-self.extent.width // scale)
        side = max(width, self.extent.height)
        apart = float(np.abs(values[1] - values[0]).max())
        labels = Labels(side, 1, np.array([count], np.int32), values[None], apart, line=True)
        arms, keys = self.arms(reach)
        return self.choose(self.prepared(keys, scale), Views.of(arms), labels)

    def limits(self) -> Range:
        """Limits [px/step] between which the disparities of nearly all pixels lie, from the nearest cameras alone."""
        axis = self.extent.axis
        size = self.extent.width if axis == 0 else self.extent.height
        widest = WIDEST * size
        toward, far = self.extent.toward, -self.extent.offset[axis]
        low, high = sorted((far - 2.0 * toward, far + widest * toward))
        rough = int(np.ceil(min(self.extent.height, self.extent.width) / ROUGH_SIZE))
        scale = max(self.scale_for(ROUGH_LABELS), rough)
        step = max(float(scale), (high - low) / ROUGH_LABELS)
        found, explained = self.labelled((low, high), step, 1, scale)
        if not explained.any():
            return low, high
        share = np.cumsum(np.bincount(found.slot[explained])) / np.count_nonzero(explained)
        first, last = np.searchsorted(share, (STRAY, 1.0 - STRAY))
        return float(low + step * (first - 1.5)), float(low + step * (last + 1.5))

    def search(self, limits: Range) -> tuple[Image, Mask]:
        """Disparity [H, W] px/step and where it is known."""
        axis = self.extent.axis
        count, size = (self.extent.n_cols, self.extent.width) if axis == 0 else (self.extent.n_rows, self.extent.height)
        place = self.reference[1 - axis]
        widest, span = max(abs(limits[0]), abs(limits[1]), 1.0), max(limits[1] - limits[0], 1.0)
        # The outermost camera sees labels a pixel apart; the wider the range, the fewer cameras are needed.
        within = (REACH, max(place, count - 1 - place), int(MOST_LABELS / span), int(WIDEST * size / widest))
        reach = max(1, min(within))
        step = max(1.0 / reach, span / MOST_LABELS)
        scale = self.scale_for(int(span / step) + 2)
        found, explained = self.labelled(limits, step, reach, scale)
        shape = (self.extent.height, self.extent.width)
        return enlarged(found.displacement[axis], scale, shape) * np.float32(scale), enlarged(explained, scale, shape)


class _Flow(_Search):
    """Motions among candidates, tile by tile: peaks of local correlations first, then what the pixels around chose."""

    def search(self, most: float) -> tuple[Image, Mask]:
        """Motion [2, H, W] px per nominal interval, ``most`` at most, and where it is known."""
        scale = self.scale_for(SLOTS)
        # Searched in pixels from the frame to the nearer one beside it.
        later = self.extent.neighbours(self.frame)
        interval = min(map(abs, later.values()))
        factors = [by / interval for by in later.values()]
        views = Views.of([[(factor, factor)] for factor in factors])
        reach = max(1, int(np.ceil(most * interval / scale)))
        seen = self.prepared([(t, *self.reference) for t in later], scale)
        # Correlations are added up where lags mean the same in both.
        alike = [k for k, factor in enumerate(factors) if (abs(factor) - 1.0) * reach <= 0.5]
        first = proposals(seen.stack[[0, *(k + 1 for k in alike)]], [int(np.sign(factors[k])) for k in alike], reach)
        labels = tiled(first, CANDIDATE_TILE, seen.guide.shape, reach)
        for tile, unit in REFINING:
            found, _ = self.choose(seen, views, labels)
            labels = tiled(votes(found.displacement / unit, tile), tile, seen.guide.shape, reach, unit)
        found, explained = self.choose(seen, views, labels)
        shape = (self.extent.height, self.extent.width)
        motion = np.stack([enlarged(m, scale, shape) for m in found.displacement]) * np.float32(scale / interval)
        return motion, enlarged(explained, scale, shape)
