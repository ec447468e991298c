"""Images as an ideal pinhole camera would have taken them: distortion and rotation taken out while reading.

A pixel (u, v) of the rectified image is the ray ``R⁻¹ ((u - cx)/f, (v - cy)/f, 1)`` of the real camera, and the lens
shows that ray (x, y, 1) at (OpenCV's model, r² = x² + y²)

    (x, y) (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
        + (2 p1 x y + p2 (r² + 2 x²) + s1 r² + s2 r⁴,  p1 (r² + 2 y²) + 2 p2 x y + s3 r² + s4 r⁴)

then tilted by (tx, ty) and scaled to pixels by the camera matrix. There the image is read by a quintic spline through
its grey values, which are mirrored at the border. What a pixel gets depends on its place and the file alone, not on the
window that is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.calibration import Calibration
from leafflow_ti.capture.channels import Array
from leafflow_ti.splines import filter_radius, filter_taps, spline_pieces, support

Floats = npt.NDArray[np.float64]
ReadWindow = Callable[[int, int, int, int], Array]
"""Window (y0, y1, x0, x1) inside the stored image."""

DEGREE = 5
SMOOTHING = 0.0
"""Gaussian before the interpolation [px]: none, texture and noise stay what they are."""
CHUNK = 1 << 14
"""Pixels that are interpolated at once: their arrays stay in the processor's cache."""
EDGE = 1e-6
"""By how much a pixel may lie outside the stored image [px]: rounding."""
FILL = 4
"""Pixels around one that is not finite whose mean takes its place before the spline is made."""
UNSURE = 2
"""Pixels beside the spline's own neighbours within which one that is not finite makes the result so."""
_STEEPEST = 8.0
"""Largest tangent of a ray's angle to the axis that is considered."""


@dataclass(frozen=True, eq=False)
class Lens:
    """A real camera and the rectified pinhole one (``f_px``, ``principal_px``) whose images are wanted."""

    calibration: Calibration
    f_px: float
    principal_px: tuple[float, float]

    def source(self, u: Floats, v: Floats) -> tuple[Floats, Floats]:
        """Where the stored image shows the rectified pixels ``u``, ``v`` (any shapes that broadcast): x, y [px].

        NaN for rays that the lens model does not reach: behind the camera, or where its radius no longer grows.
        """
        (cx, cy), turn, K = self.principal_px, self.calibration.rotation, self.calibration.matrix
        x, y = (u - cx) / self.f_px, (v - cy) / self.f_px
        # The columns of R are the rows of its inverse.
        depth = turn[0, 2] * x + turn[1, 2] * y + turn[2, 2]
        depth = np.where(depth > 0, depth, np.nan)
        x, y = (
            (turn[0, 0] * x + turn[1, 0] * y + turn[2, 0]) / depth,
            (turn[0, 1] * x + turn[1, 1] * y + turn[2, 1]) / depth,
        )
        x, y = self._distorted(x, y)
        return K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]

    def _distorted(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        _, _, p1, p2, _, _, _, _, s1, s2, s3, s4, tx, ty = self.calibration.distortion.tolist()
        xx, yy, xy = x * x, y * y, x * y
        rr = xx + yy
        radial = np.where(rr < self._largest_radius**2, _radial(self.calibration.distortion, rr), np.nan)
        xd = x * radial + 2 * p1 * xy + p2 * (rr + 2 * xx) + (s1 + s2 * rr) * rr
        yd = y * radial + p1 * (rr + 2 * yy) + 2 * p2 * xy + (s3 + s4 * rr) * rr
        if tx == 0 and ty == 0:
            return xd, yd
        tilt = _tilt(tx, ty)
        xt, yt, zt = (row[0] * xd + row[1] * yd + row[2] for row in tilt.tolist())
        return xt / zt, yt / zt

    @cached_property
    def _largest_radius(self) -> float:
        """Tangent from which on the image of a ray would move back to the centre: there the model has no meaning."""
        r = np.linspace(0.0, _STEEPEST, 4001)
        seen = r * _radial(self.calibration.distortion, r * r)
        back = np.flatnonzero(~(np.diff(seen) > 0))
        return float(r[back[0]]) if back.size else math.inf

    def rectify(self, out: Array, top: int, left: int, size: tuple[int, int], read: ReadWindow) -> None:
        """Fill ``out`` [rows, columns] with the rectified image from (``top``, ``left``); NaN where it was not seen.

        ``size``: (height, width) of the stored image, of which ``read`` gives windows.
        """
        x, y = self.source(
            np.arange(left, left + out.shape[1], dtype=np.float64),
            np.arange(top, top + out.shape[0], dtype=np.float64)[:, None],
        )
        seen = _within(x, size[1]) & _within(y, size[0])
        if not seen.any():
            out[...] = np.nan
            return
        x = np.clip(np.where(seen, x, x[seen][0]), 0, size[1] - 1)
        y = np.clip(np.where(seen, y, y[seen][0]), 0, size[0] - 1)
        spans = tuple((math.floor(p.min()), math.floor(p.max()) + 1) for p in (y, x))
        coefficients, unsure = _coefficients(read, size, spans, out.dtype)
        reach = support(DEGREE)
        y, x = y - (spans[0][0] + 1 - reach), x - (spans[1][0] + 1 - reach)  # from the first coefficient
        values = np.empty(out.size, out.dtype)
        flat = (y.reshape(-1), x.reshape(-1))
        for start in range(0, out.size, CHUNK):
            part = slice(start, start + CHUNK)
            values[part] = _interpolate(coefficients, flat[0][part], flat[1][part])
        if unsure is not None:
            seen &= ~unsure[np.rint(y).astype(np.intp), np.rint(x).astype(np.intp)]
        out[...] = np.where(seen, values.reshape(out.shape), np.nan)


def _within(position: Floats, count: int) -> npt.NDArray[np.bool_]:
    return (position >= -EDGE) & (position <= count - 1 + EDGE)


def _radial(distortion: Floats, rr: Floats) -> Floats:
    k1, k2, _, _, k3, k4, k5, k6 = distortion[:8].tolist()
    rising = 1 + rr * (k1 + rr * (k2 + rr * k3))
    return np.asarray(rising / (1 + rr * (k4 + rr * (k5 + rr * k6))) if (k4, k5, k6) != (0, 0, 0) else rising)


def _tilt(tx: float, ty: float) -> Floats:
    """The projection [3, 3] from the image plane to a sensor turned by ``tx`` about x, then ``ty`` about y [rad]."""
    about_x = np.array([[1, 0, 0], [0, math.cos(tx), math.sin(tx)], [0, -math.sin(tx), math.cos(tx)]])
    about_y = np.array([[math.cos(ty), 0, -math.sin(ty)], [0, 1, 0], [math.sin(ty), 0, math.cos(ty)]])
    turn = about_y @ about_x
    onto = np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]])
    return np.asarray(onto @ turn)


def _coefficients(
    read: ReadWindow, size: tuple[int, int], spans: tuple[tuple[int, int], ...], dtype: npt.DTypeLike
) -> tuple[Array, npt.NDArray[np.bool_] | None]:
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


def _filled(image: Array, finite: npt.NDArray[np.bool_]) -> Array:
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


def _interpolate(coefficients: Array, y: Floats, x: Floats) -> Array:
    """The spline at positions [n] counted from the first coefficient, ``support - 1`` or more of them inside."""
    first = 1 - support(DEGREE)
    whole_y, whole_x = np.floor(y), np.floor(x)
    wy, wx = (_weights(p, coefficients.dtype) for p in (y - whole_y, x - whole_x))
    width, flat = coefficients.shape[1], coefficients.reshape(-1)
    at = (whole_y.astype(np.intp) + first) * width + whole_x.astype(np.intp) + first
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
