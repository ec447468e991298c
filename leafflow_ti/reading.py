"""The images of a plan, block by block: preshifted windows of every camera, read ahead of the thread that computes."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.aim import Aim
from leafflow_ti.background import prepared
from leafflow_ti.bands import READERS
from leafflow_ti.capture import Capture
from leafflow_ti.capture.images import read_gray
from leafflow_ti.capture.measured import LEAST_FRACTION, REACH
from leafflow_ti.errors import ConfigError, InputError
from leafflow_ti.plan import Plan
from leafflow_ti.trace import span

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Box:
    """A block's place in the reference image: its first row and column, and its size."""

    y: int
    x: int
    rows: int
    cols: int

    def widened(self, margin: int) -> Box:
        """The block with ``margin`` pixels more on every side."""
        return Box(self.y - margin, self.x - margin, self.rows + 2 * margin, self.cols + 2 * margin)


class Reader:
    """Reads the blocks of a plan; ``dtype``: type of their grey values.

    Raises ConfigError for a mask that does not fit the images.
    """

    def __init__(self, plan: Plan, capture: Capture, dtype: type[np.floating[Any]]):
        self.plan, self.capture, self.dtype = plan, capture, dtype
        self.threads = min(len(plan.cameras[0]) * len(plan.cameras[1]), READERS)
        self.mask = _read_mask(plan.config.output.mask, capture)

    def blocks(
        self, frames: range, box: Box, aim: Aim, around: int = 0, ahead: int | None = None
    ) -> Generator[tuple[NDArray[Any], Mask], None, None]:
        """For each frame the block [sy, sx, rows, cols], 0 where not finite, and where it is finite.

        ``around``: the reference frame, from which ``aim`` counts; ``ahead``: how many frames are read before they are
        asked for; default: as planned.
        """
        depth = self.plan.read_ahead if ahead is None else ahead
        return prepared(partial(self._prepare, box, aim, around), frames, depth, self.threads)

    def _prepare(
        self, box: Box, aim: Aim, around: int, t: int
    ) -> tuple[tuple[NDArray[Any], Mask], list[Callable[[], None]]]:
        """An empty block of one frame, and the work that fills it."""
        sy, sx = self.plan.cameras
        x, y = self.offset(aim, t, around)
        block = np.zeros((len(sy), len(sx), box.rows, box.cols), self.dtype)
        finite = np.ones(block.shape, bool)
        fills = self.capture.fills(block[None], [t], sy, sx, box.y + y, box.x + x, aim.shift)
        images = (array.reshape(-1, box.rows, box.cols) for array in (block, finite))
        whole = self.capture.finite
        pieces: list[Callable[[], None]] = [
            partial(_fill, whole, fill, *image) for fill, *image in zip(fills, *images, strict=True)
        ]
        return (block, finite), pieces

    def elapsed(self, t: int, around: int) -> float:
        """Frames from the results of frame ``around`` to frame ``t``."""
        times = self.capture.frame_times
        here = times[around]
        if self.plan.time_offset:
            here += self.plan.time_offset * (times[around + 1] - here)
        return times[t] - here

    def offset(self, aim: Aim, t: int, around: int) -> tuple[float, float]:
        """Pixels (x, y) that ``aim`` moves the images of frame ``t`` by, beside what it does from camera to camera."""
        if aim.motion == (0, 0):
            return 0.0, 0.0
        frames = self.elapsed(t, around)
        return aim.motion[0] * frames, aim.motion[1] * frames

    def seen(self, box: Box, aim: Aim, t: int = 0, around: int = 0) -> tuple[Mask, Mask]:
        """Which rows [cameras along y, rows] and columns [cameras along x, cols] of a block lie inside the images of
        frame ``t``, ``around`` which ``aim`` counts time."""
        capture, found = self.capture, []
        read, moved = capture.pixels_read(aim.shift), self.offset(aim, t, around)
        for axis, (first, count, size) in enumerate(
            ((box.y, box.rows, capture.height), (box.x, box.cols, capture.width))
        ):
            some = list(self.plan.cameras[axis])
            whole, margin = _reached(moved[1 - axis])
            low, high = (n[some][:, None] for n in read[2 * axis : 2 * axis + 2])
            at = first + whole + np.arange(count)
            found.append((at + low - margin >= 0) & (at + high + margin < size))
        return found[0], found[1]

    def inside(self, box: Box, aim: Aim, t: int = 0, around: int = 0) -> Mask:
        """Where every camera sees its image and the mask allows a measurement: [rows, cols]."""
        in_y, in_x = (np.logical_and.reduce(seen) for seen in self.seen(box, aim, t, around))
        inside = in_y[:, None] & in_x
        kept = self.masked(box)
        return np.asarray(inside if kept is None else inside & kept)

    def masked(self, box: Box) -> Mask | None:
        """Where the mask allows a measurement: [rows, cols], continued beyond the image; None without a mask."""
        if self.mask is None:
            return None
        capture, y, x = self.capture, box.y + np.arange(box.rows), box.x + np.arange(box.cols)
        return self.mask[np.clip(y, 0, capture.height - 1)[:, None], np.clip(x, 0, capture.width - 1)]

    def require_positive(self, block: NDArray[Any], valid: Mask, t: int, box: Box, aim: Aim, around: int = 0) -> None:
        """Raise InputError for the first valid grey value of a block that has no logarithm."""
        wrong = valid & (block <= 0)
        if not wrong.any():
            return
        j, k, row, col = (int(n) for n in np.argwhere(wrong)[0])
        sy, sx = self.plan.cameras[0][j], self.plan.cameras[1][k]
        moved, (down, across) = self.offset(aim, t, around), self.capture.shifts(aim.shift)
        x, y = round(box.x + col + moved[0] + across[sy, sx]), round(box.y + row + moved[1] + down[sy, sx])
        raise InputError(
            f"{self.capture.image_name(t, sy, sx)}: grey value {block[j, k, row, col]:g} at pixel x = {x}, y = {y}: "
            "prefilter homomorphic takes logarithms and needs values above 0: choose prefilter highpass, or add an "
            "offset to the images"
        )


def _reached(moved: float) -> tuple[int, int]:
    """The whole pixels of a move, and how far beyond them interpolation reaches."""
    whole = round(moved)
    return whole, REACH if abs(moved - whole) > LEAST_FRACTION else 0


def _fill(whole: bool, fill: Callable[[], None], image: NDArray[Any], finite: Mask) -> None:
    """Fill one image of a block; unless it is known to be ``whole``, say where it is finite, and put 0 elsewhere."""
    with span("decode"):
        fill()
        if whole:
            return
        np.isfinite(image, out=finite)
        if not finite.all():
            image[~finite] = 0


def _read_mask(path: Path | None, capture: Capture) -> Mask | None:
    if path is None:
        return None
    mask: Mask = np.asarray(read_gray(path)) != 0
    if mask.shape != (capture.height, capture.width):
        found, wanted = (f"{shape[1]} x {shape[0]}" for shape in (mask.shape, (capture.height, capture.width)))
        raise ConfigError(f"{path}: a mask of {found} pixels for images of {wanted}: make it the same size")
    return mask
