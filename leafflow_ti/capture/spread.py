"""Whether one whole-pixel preshift, and images that are not shifted in time, serve all that a capture shows.

Band-passed images of neighbouring cameras and frames are correlated window by window at the preshift and the lags next
to it. Where most of the texture is found again there, disparities and motions stay within the reach of the filters.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.capture import Capture

_Image = npt.NDArray[np.float64]
_Key = tuple[int, int, int]  # t, sy, sx

_BAND = (2, 12)  # half lengths of the box filters whose difference is the band pass [px]
_HALF = 8  # of the windows [px]
_AGREES = 0.5  # least correlation of a window that was found again; other places of a broad texture stay below .4
_LEAST_SHARE = 0.95  # of the texture that must be
_TEXTURE = 0.1  # least standard deviation of a window that counts, relative to that of the image
_MOST_PIXELS = 1 << 21  # of an image's middle that are compared


def one_preshift_serves(capture: Capture, preshift: tuple[int, int], moving: bool) -> bool:
    """Whether ``preshift`` [px/step], give or take a pixel, fits nearly all texture of the middle frame; with
    ``moving`` also whether frames beside it show it within a pixel."""
    t, (row, col) = capture.n_frames // 2, capture.reference
    image = _band_pass(_read(capture, (t, row, col)))
    deviation = np.sqrt(np.maximum(_mean(image**2, _HALF), 0.0))
    textured = deviation > _TEXTURE * max(float(image.std()), 1e-12)
    for neighbours, shift, lags in _comparisons(capture, t, preshift, moving):
        found = np.full(image.shape, -1.0)
        for key, sign in neighbours:
            other = _band_pass(_read(capture, key))
            energy = np.sqrt(np.maximum(_mean(other**2, _HALF), 0.0))
            for lag in lags:
                by = (sign * shift[1] + lag[1], sign * shift[0] + lag[0])
                there, spread = (_moved(values, by) for values in (other, energy))
                both = deviation * spread
                found = np.maximum(found, np.where(both > 0, _mean(image * there, _HALF) / np.maximum(both, 1e-30), -1))
        if np.count_nonzero(found[textured] > _AGREES) < _LEAST_SHARE * np.count_nonzero(textured):
            return False
    return True


def _comparisons(
    capture: Capture, t: int, preshift: tuple[int, int], moving: bool
) -> Iterator[tuple[list[tuple[_Key, int]], tuple[int, int], list[tuple[int, int]]]]:
    """Neighbours of the reference on both sides with their signs, the shift towards one, and lags (x, y) around it."""
    row, col = capture.reference
    counts, place = (capture.n_cols, capture.n_rows), (col, row)
    for axis in range(2):
        sides: list[tuple[_Key, int]] = [
            ((t, row + sign * axis, col + sign * (1 - axis)), sign)
            for sign in (-1, 1)
            if 0 <= place[axis] + sign < counts[axis]
        ]
        if sides:
            shift = (preshift[0] * (1 - axis), preshift[1] * axis)
            yield sides, shift, [(n * (1 - axis), n * axis) for n in (-1, 0, 1)]
    if moving:
        frames: list[tuple[_Key, int]] = [
            ((t + sign, row, col), sign) for sign in (-1, 1) if 0 <= t + sign < capture.n_frames
        ]
        if frames:
            yield frames, (0, 0), [(x, y) for x, y in product((-1, 0, 1), repeat=2)]


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


def _moved(values: _Image, by: tuple[int, int]) -> _Image:
    """``values[y + by[0], x + by[1]]``, 0 beyond the border."""
    out = np.zeros_like(values)
    to, source = [], []
    for n, d in zip(values.shape, by, strict=True):
        d = max(-n, min(n, d))
        to.append(slice(max(0, -d), n - max(0, d)))
        source.append(slice(max(0, d), n + min(0, d)))
    out[tuple(to)] = values[tuple(source)]
    return out
