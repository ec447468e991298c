"""Images between their pixels, by quintic splines through the grey values, which are mirrored at the border.

What a place gets depends on it and the image alone, not on the window that is asked for: sums run tap by tap.

This is for places of any distribution. An image that is read at one and the same fraction of a pixel throughout goes
through the longer filters of ``measured.interpolated``: they keep a texture of 4 px wavelength to 3e-6 of its contrast
(splines 2.5e-3; of 6 px 7e-5 and 1.4e-4) at a tenth of the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.channels import Array
from leafflow_ti.splines import filter_radius, filter_taps, spline_pieces, support

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
ReadWindow = Callable[[int, int, int, int], Array]
"""Window (y0, y1, x0, x1) inside the image."""

DEGREE = 5
SMOOTHING = 0.0
"""Gaussian before the interpolation [px]: none, texture and noise stay what they are."""
CHUNK = 1 << 14
"""Pixels that are interpolated at once: their arrays stay in the processor's cache."""
FILL = 4
"""Pixels around one that is not finite whose mean takes its place before the spline is made."""
UNSURE = 2
"""Pixels beside the spline's own neighbours within which one that is not finite makes the result so."""


def resample(read: ReadWindow, size: tuple[int, int], y: Floats, x: Floats, dtype: npt.DTypeLike) -> tuple[Array, Mask]:
    """Grey values at the places ``y``, ``x`` (one shape, inside the image), and which of them rest on numbers alone.

    ``size``: (height, width) of the image, of which ``read`` gives windows.
    """
    spans = tuple((math.floor(p.min()), math.floor(p.max()) + 1) for p in (y, x))
    found, unsure = _coefficients(read, size, spans, dtype)
    reach = support(DEGREE)
    first = tuple(span[0] + 1 - reach for span in spans)  # where the first coefficient stands
    values = np.empty(y.size, found.dtype)
    flat = (y.reshape(-1), x.reshape(-1))
    for start in range(0, y.size, CHUNK):
        part = slice(start, start + CHUNK)
        values[part] = _interpolate(found, flat[0][part], flat[1][part], first)
    nearest = (np.rint(p).astype(np.intp) - n for p, n in zip((y, x), first, strict=True))
    sure = np.ones(y.shape, bool) if unsure is None else ~unsure[tuple(nearest)]
    return values.reshape(y.shape), sure


def _coefficients(
    read: ReadWindow, size: tuple[int, int], spans: tuple[tuple[int, int], ...], dtype: npt.DTypeLike
) -> tuple[Array, Mask | None]:
    """Spline coefficients of the stored image around the pixels ``spans`` (first, last) along y and x.

    The first one lies ``support - 1`` pixels before the span. Beside them where a value is not to be trusted, None if
    all are finite.
    """
    reach, taps = support(DEGREE), filter_taps(DEGREE, SMOOTHING)
    # One margin for all files, so that grey values do not depend on whether others in the window are finite.
    margin = reach - 1 + max(filter_radius(DEGREE, SMOOTHING), reach + UNSURE) + FILL
    y, x = (_mirrored(first - margin, last + margin + 1, n) for (first, last), n in zip(spans, size, strict=True))
    stored = read(int(y.min()), int(y.max()) + 1, int(x.min()), int(x.max()) + 1)
    image = stored[np.ix_(y - y.min(), x - x.min())].astype(dtype)
    finite = np.isfinite(image)
    unsure = None
    if not finite.all():
        image = _filled(image, finite)
        lost = _box_sum((~finite).astype(np.float64), reach + UNSURE) > 0
        unsure = _trimmed(lost, margin - (reach - 1) - (reach + UNSURE))
    for axis in (0, 1):
        image = _convolved(image, taps, axis)
    return np.ascontiguousarray(_trimmed(image, margin - (reach - 1) - len(taps) // 2)), unsure


def _mirrored(first: int, end: int, count: int) -> npt.NDArray[np.intp]:
    """Pixels that stand for ``first`` to ``end - 1`` of a line of ``count``, mirrored about its first and last one."""
    if count == 1:
        return np.zeros(end - first, np.intp)
    k = np.arange(first, end) % (2 * count - 2)
    return np.asarray(np.minimum(k, 2 * count - 2 - k), np.intp)


def _trimmed(values: Array, margin: int) -> Array:
    return values[margin : values.shape[0] - margin, margin : values.shape[1] - margin]


def _filled(image: Array, finite: Mask) -> Array:
    """What is not finite as the mean of what is around it, 0 where nothing is; the outer ``FILL`` pixels as 0."""
    known = np.where(finite, image, 0)
    inner = (slice(FILL, -FILL),) * 2
    count = _box_sum(finite.astype(np.float64), FILL)
    mean = _box_sum(known.astype(np.float64), FILL) / np.maximum(count, 1)
    known[inner] = np.where(finite[inner], known[inner], mean)
    return known


def _box_sum(values: Floats, radius: int) -> Floats:
    """Sums over squares of ``2 radius + 1``, where they are whole."""
    for _ in range(2):
        n = values.shape[0] - 2 * radius
        values = np.add.reduce([values[k : k + n] for k in range(2 * radius + 1)]).T
    return values


def _convolved(image: Array, taps: Floats, axis: int) -> Array:
    """Convolution with symmetric taps along one axis, where it is whole; tap by tap, so that all windows agree."""
    radius = len(taps) // 2
    n = image.shape[axis] - 2 * radius

    def shifted(k: int) -> Array:
        part = slice(radius + k, radius + k + n)
        return image[part] if axis == 0 else image[:, part]

    total: Array = shifted(0) * image.dtype.type(taps[radius])
    pair = np.empty_like(total)
    for k in range(1, radius + 1):
        np.add(shifted(-k), shifted(k), out=pair)
        pair *= image.dtype.type(taps[radius + k])
        total += pair
    return total


def _interpolate(coefficients: Array, y: Floats, x: Floats, first: tuple[int, ...]) -> Array:
    """The spline at positions [n]; ``first``: row and column of the first coefficient, ``support - 1`` or more before
    these."""
    before = 1 - support(DEGREE)
    # Fractions are those of the positions in the image, whatever part of it is at hand.
    whole_y, whole_x = np.floor(y), np.floor(x)
    wy, wx = (_weights(p, coefficients.dtype) for p in (y - whole_y, x - whole_x))
    width, flat = coefficients.shape[1], coefficients.reshape(-1)
    row, col = (p.astype(np.intp) - n + before for p, n in zip((whole_y, whole_x), first, strict=True))
    at = row * width + col
    total = np.zeros(len(x), coefficients.dtype)
    line, value = np.empty_like(total), np.empty_like(total)
    for j in range(DEGREE + 1):
        line[:] = 0
        for i in range(DEGREE + 1):
            np.take(flat[j * width + i :], at, out=value, mode="clip")
            value *= wx[i]
            line += value
        line *= wy[j]
        total += line
    return total


def _weights(u: Floats, dtype: npt.DTypeLike) -> list[Array]:
    """Weights of the neighbours for fractions ``u`` [n] of a pixel."""
    u = u.astype(dtype)
    weights = []
    for piece in spline_pieces(DEGREE)[0]:
        w = np.full_like(u, piece[-1])
        for c in piece[-2::-1]:
            w *= u
            w += u.dtype.type(c)
        weights.append(w)
    return weights
