"""Whether the cameras stand in the order of their files, and all show one scene.

Neighbours are compared along each row and column of the grid, in one frame: what they show moves by the same disparity
from each camera to the next. Two cameras that were exchanged, and one whose images are of another scene, do not fit in.
Nothing can be told where the disparity is below ``LEAST_PX``, or where the texture repeats itself.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.capture import Capture
from leafflow_ti.capture.preshift import CLEAR, Loader, correlation
from leafflow_ti.errors import InputError

LEAST_PX = 2.0
"""Disparity between neighbours from which their order shows."""
FAR = 0.6
"""Deviation from it, relative, that neither depth nor a measured position explains."""
SURE = 1.2
"""Factor by which a correlation elsewhere exceeds that at the disparity of the others."""
HEIGHT = 160
"""Rows of the images that are compared."""


def order_doubts(capture: Capture) -> list[str]:
    """One line for each row or column of cameras that has some in another order than their files."""
    if capture.geometry is None:
        return []
    return [*_along(capture, "x"), *_along(capture, "y")]


def _along(capture: Capture, axis: str) -> Iterator[str]:
    n, lines = (capture.n_cols, capture.n_rows) if axis == "x" else (capture.n_rows, capture.n_cols)
    if n < 3:  # of two cameras none is the odd one
        return
    load, t = Loader(capture, axis, HEIGHT), capture.n_frames // 2
    for line in range(lines):
        cameras = [(t, line, k) if axis == "x" else (t, k, line) for k in range(n)]
        try:
            curves = [correlation(load, [pair]) for pair in itertools.pairwise(cameras)]
        except InputError:
            continue  # an image that cannot be read, or is too small: whoever needs it says so
        lags = [int(np.argmax(curve)) - len(curve) // 2 for curve in curves if curve.max() >= CLEAR]
        nu = float(np.median(lags)) if lags else 0.0
        odd = [k for k, curve in enumerate(curves) if _odd(curve, nu)]
        if odd and abs(nu) >= LEAST_PX and 2 * len(lags) >= len(curves):
            where = f"{'row' if axis == 'x' else 'column'} {line}"
            pairs = ", ".join(f"{k} and {k + 1}" for k in odd)
            yield (
                f"cameras {pairs} of {where} do not show the disparity of about {nu:+.0f} px that most do in frame "
                f"{t} ({capture.image_name(*cameras[odd[0]])}): were cameras exchanged, or "
                "images of another scene mixed in?"
            )


def _odd(curve: npt.NDArray[np.float64], nu: float) -> bool:
    """Whether a correlation over lags, 0 in the middle, has no peak near ``nu``, or a far better one elsewhere."""
    zero = len(curve) // 2
    around = max(LEAST_PX, FAR * abs(nu))
    low, high = (int(np.clip(zero + nu + side * around, 0, len(curve) - 1)) for side in (-1, 1))
    near = float(curve[low : high + 1].max())
    return near < CLEAR / 2 or float(curve.max()) > SURE * near
