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
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.calibration import Calibration
from leafflow_ti.capture.channels import Array
from leafflow_ti.capture.resampling import ReadWindow, resample

Floats = npt.NDArray[np.float64]
EDGE = 1e-6
"""By how much a pixel may lie outside the stored image [px]: rounding."""
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

    def rectify(
        self, out: Array, top: int, left: int, size: tuple[int, int], read: ReadWindow,
        fraction: tuple[float, float] = (0.0, 0.0),
    ) -> None:  # fmt: skip
        """Fill ``out`` [rows, columns] with the rectified image from (``top``, ``left``), and ``fraction`` (y, x) of a
        pixel behind it; NaN where it was not seen.

        ``size``: (height, width) of the stored image, of which ``read`` gives windows.
        """
        x, y = self.source(
            np.arange(left, left + out.shape[1], dtype=np.float64) + fraction[1],
            np.arange(top, top + out.shape[0], dtype=np.float64)[:, None] + fraction[0],
        )
        seen = _within(x, size[1]) & _within(y, size[0])
        if not seen.any():
            out[...] = np.nan
            return
        x = np.clip(np.where(seen, x, x[seen][0]), 0, size[1] - 1)
        y = np.clip(np.where(seen, y, y[seen][0]), 0, size[0] - 1)
        values, sure = resample(read, size, y, x, out.dtype)
        out[...] = np.where(seen & sure, values, np.nan)


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
