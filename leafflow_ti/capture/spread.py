"""Whether one whole-pixel preshift, and images that are not shifted in time, serve all that a capture shows.

Windows of the band-passed reference image are looked for in neighbouring cameras and frames. Where nearly all that are
found lie within a pixel of the preshift, disparities and motions stay within the reach of the filters. What is found
nowhere, such as noise, does not count.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.capture import Capture

_Image = npt.NDArray[np.float64]
_Key = tuple[int, int, int]  # t, sy, sx
_Lag = tuple[int, int]

_BAND = (2, 12)  # half lengths of the box filters whose difference is the band pass [px]
_HALF = 8  # of the windows in which texture is rated [px]
_TEXTURE = 0.1  # least standard deviation of a window that counts, relative to that of the image
_MOST_PIXELS = 1 << 21  # of an image's middle that are compared
_SAMPLES = 96  # windows that are looked for
_LEAST_SHARE = 0.95  # of those that are found must lie near
_FEWEST = 0.05  # share of the windows that must be found, for the others to mean anything
_FOUND = 0.6  # least correlation of one that is found, mean over both sides
_BETTER = 0.05  # by how much more it must correlate far away than near
_NEAR = 1.25  # px from the preshift
_MOTION, _DISPARITY = 24, 0.25  # how far is looked: px per frame, share of the image per step
_ACROSS = 2  # pixels across the line of cameras
_WIDE = {True: 12, False: 24}  # half of a window that is looked for, along a line or all around: fewer coincidences


@dataclass(frozen=True)
class _Comparison:
    """Neighbours of the reference image on both sides with their signs, the shift (x, y) towards one; ``line``: they
    differ by disparity along ``axis``, else by motion."""

    neighbours: list[tuple[_Key, int]]
    shift: _Lag
    line: bool
    axis: int = 0

    def reach(self, shape: tuple[int, ...]) -> _Lag:
        """Lags (y, x) that are looked at."""
        if not self.line:
            return _MOTION, _MOTION
        along = int(_DISPARITY * shape[1 - self.axis])
        return (_ACROSS, along) if self.axis == 0 else (along, _ACROSS)


def one_preshift_serves(capture: Capture, preshift: tuple[int, int], moving: bool) -> bool:
    """Whether ``preshift`` [px/step], give or take a pixel, fits nearly all texture of the middle frame that anything
    fits; with ``moving`` also whether frames beside it show it within a pixel."""
    for found, far in _looked_for(capture, preshift, moving):
        known = int(np.count_nonzero(found))
        if known > _FEWEST * found.size and np.count_nonzero(far) > (1 - _LEAST_SHARE) * known:
            return False
    return True


def anything_fits(capture: Capture) -> bool:
    """Whether neighbouring cameras show some of the middle frame's texture again, wherever that is."""
    return all(np.count_nonzero(found) > _FEWEST * found.size for found, _ in _looked_for(capture, (0, 0), False))


def _looked_for(
    capture: Capture, preshift: tuple[int, int], moving: bool
) -> Iterator[tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]]:
    """For each comparison of some windows [n]: which are found, and which of these not near the preshift."""
    t = capture.n_frames // 2
    image = _band_pass(_read(capture, (t, *capture.reference)))
    textured = np.sqrt(np.maximum(_mean(image**2, _HALF), 0.0)) > _TEXTURE * max(float(image.std()), 1e-12)
    for one in _comparisons(capture, t, preshift, moving):
        others = [(_band_pass(_read(capture, key)), sign) for key, sign in one.neighbours]
        half, reach = _WIDE[one.line], one.reach(image.shape)
        rows, cols = np.nonzero(textured[half:-half, half:-half])
        some = np.linspace(0, max(rows.size - 1, 0), min(rows.size, _SAMPLES)).astype(int)
        near, best = np.zeros(some.size), np.zeros(some.size)
        lag_y, lag_x = np.ogrid[-reach[0] : reach[0] + 1, -reach[1] : reach[1] + 1]
        close = np.maximum(np.abs(lag_y - one.shift[1]), np.abs(lag_x - one.shift[0])) <= _NEAR
        for k, n in enumerate(some):
            values = _correlation(image, others, int(rows[n]) + half, int(cols[n]) + half, half, reach)
            near[k], best[k] = values[close].max(initial=-1.0), values.max()
        found = best > _FOUND
        yield found, found & (best > near + _BETTER)


def _correlation(image: _Image, others: list[tuple[_Image, int]], y: int, x: int, half: int, reach: _Lag) -> _Image:
    """Mean correlation of a window with the others, at opposite lags up to ``reach`` (y, x) on opposite sides."""
    size = 2 * half + 1
    here = image[y - half : y + half + 1, x - half : x + half + 1]
    here = here - here.mean()
    shape = (size + 2 * reach[0], size + 2 * reach[1])
    total = np.zeros((2 * reach[0] + 1, 2 * reach[1] + 1))
    for other, sign in others:
        pad = [(half + r, half + r) for r in reach]
        there = np.pad(other, pad)[y : y + shape[0], x : x + shape[1]]
        wide = (shape[0] + size, shape[1] + size)
        product_ = np.fft.irfft2(np.conj(np.fft.rfft2(here, wide)) * np.fft.rfft2(there, wide), wide)
        cross = product_[: total.shape[0], : total.shape[1]]
        sums, squares = (_windows(values, size) for values in (there, there**2))
        energy = np.maximum(squares - sums**2 / size**2, 0.0) * float(np.sum(here**2))
        ratio = np.where(energy > 0, cross / np.sqrt(np.maximum(energy, 1e-30)), 0.0)
        total += ratio if sign > 0 else ratio[::-1, ::-1]
    return total / len(others)


def _windows(values: _Image, size: int) -> _Image:
    """Sums over all windows of ``size`` px inside."""
    total = np.pad(values.cumsum(axis=0).cumsum(axis=1), [(1, 0), (1, 0)])
    return np.asarray(total[size:, size:] - total[size:, :-size] - total[:-size, size:] + total[:-size, :-size])


def _comparisons(capture: Capture, t: int, preshift: tuple[int, int], moving: bool) -> Iterator[_Comparison]:
    row, col = capture.reference
    counts, place = (capture.n_cols, capture.n_rows), (col, row)
    for axis in range(2):
        sides: list[tuple[_Key, int]] = [
            ((t, row + sign * axis, col + sign * (1 - axis)), sign)
            for sign in (-1, 1)
            if 0 <= place[axis] + sign < counts[axis]
        ]
        if sides:
            yield _Comparison(sides, (preshift[0] * (1 - axis), preshift[1] * axis), True, axis)
    frames: list[tuple[_Key, int]] = [
        ((t + sign, row, col), sign) for sign in (-1, 1) if moving and 0 <= t + sign < capture.n_frames
    ]
    if frames:
        yield _Comparison(frames, (0, 0), False)


def _read(capture: Capture, key: _Key) -> _Image:
    """The middle of an image; its mean in place of what is not finite."""
    width = min(capture.width, _MOST_PIXELS // min(capture.height, int(_MOST_PIXELS**0.5)))
    height = min(capture.height, _MOST_PIXELS // width)
    y, x = (capture.height - height) // 2, (capture.width - width) // 2
    image = capture.read(*key, y, y + height, x, x + width, dtype=np.float64)
    finite = np.isfinite(image)
    return np.where(finite, image, image[finite].mean() if finite.any() else 0.0)


def _band_pass(image: _Image) -> _Image:
    fine, coarse = (_mean(image, half) for half in _BAND)
    return np.asarray(fine - coarse)


def _mean(values: _Image, half: int) -> _Image:
    """Means over windows of ``2 half + 1`` px, the border's values beyond it."""
    for axis in range(2):
        size = 2 * half + 1
        padded = np.pad(values, [(half + 1, half) if a == axis else (0, 0) for a in range(2)], mode="edge")
        total = np.cumsum(padded, axis=axis)
        ends, starts = ([slice(None), slice(None)] for _ in range(2))
        ends[axis], starts[axis] = slice(size, None), slice(None, -size)
        values = (total[tuple(ends)] - total[tuple(starts)]) / size
    return values
