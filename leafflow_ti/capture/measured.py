"""Measured camera positions and time stamps of a capture: checked, and brought to steps of its nominal sampling."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.description import STAMPS_WAY_OUT, Description, read_stamps
from leafflow_ti.capture.files import Reach
from leafflow_ti.capture.layout import Layout
from leafflow_ti.errors import ConfigError

Array = npt.NDArray[np.float64]
_Key = TypeVar("_Key", int, tuple[int, int])

TAPS = 14
"""Of the interpolation of images that are read at fractions of a pixel."""
REACH = TAPS // 2
"""Pixels that it looks at on each side, at most."""
_BAND = 0.65 * np.pi
"""Frequency [rad/px] up to which it is exact (to 2e-4): what lies above, the derivative filters suppress."""
LEAST_FRACTION = 1e-6
"""Fraction of a pixel below which nothing is interpolated."""
FRACTION_DIGITS = 9
"""Decimals of a fraction: its last bits depend on the whole pixels that it stands beside."""


def camera_positions(
    values: npt.ArrayLike, shape: tuple[int, int], baseline_mm: tuple[float, float] | None, name: str
) -> Array:
    """Positions [rows, columns, 2] relative to the reference camera, mm, from one [x, y] per camera of a grid of
    ``shape``, rows one after the other.

    Raises ConfigError (``name`` says where they stand) for another number of them, or where neighbours are not half to
    one and a half nominal steps apart.
    """
    n = shape[0] * shape[1]
    if baseline_mm is None or n == 1:
        raise ConfigError(f"{name}: the capture has one camera: leave them out")
    found = np.asarray(values, np.float64)
    if found.shape not in ((n, 2), (*shape, 2)) or not np.isfinite(found).all():
        raise ConfigError(
            f"{name}: {len(found) if found.ndim else 0} entries for {n} cameras ({shape[0]} x {shape[1]}): give one "
            "[x, y] in mm for each, rows one after the other"
        )
    found = found.reshape(*shape, 2)
    _check_steps(found, baseline_mm, name)
    return np.asarray(found - found[shape[0] // 2, shape[1] // 2])


def _check_steps(positions: Array, baseline_mm: tuple[float, float], name: str) -> None:
    for axis, k in (("x", 1), ("y", 0)):
        pair = 0 if axis == "x" else 1
        if positions.shape[k] == 1:
            continue
        steps = np.diff(positions[..., pair], axis=k) / baseline_mm[pair]
        if np.abs(steps - 1).max() > 0.5:
            row, col = (int(i) for i in np.argwhere(np.abs(steps - 1) > 0.5)[0])
            raise ConfigError(
                f"{name}: the step along {axis} behind camera row {row}, column {col} is "
                f"{steps[row, col] * baseline_mm[pair]:g} mm, baseline_mm is {baseline_mm[pair]:g}: give measured "
                "positions in the order of the cameras, and as baseline_mm about their mean step"
            )


def time_stamps(values: Sequence[float], n_frames: int, name: str) -> tuple[float, ...]:
    """The stamps [s] of ``n_frames`` frames; ConfigError (``name`` says where they stand) unless they increase."""
    stamps = tuple(float(v) for v in values)
    if len(stamps) != n_frames:
        raise ConfigError(f"{name}: {len(stamps)} stamps for {n_frames} frames: give one for each frame")
    for i, stamp in enumerate(stamps):
        if not math.isfinite(stamp) or (i and stamp <= stamps[i - 1]):
            raise ConfigError(
                f"{name}: stamp {i} is {stamp:g} s"
                + (f" after {stamps[i - 1]:g} s" if i else "")
                + ": stamps must be finite and increase from frame to frame: correct it, or leave the frame out"
            )
    return stamps


def _selected(n: int, found: Sequence[_Key], used: Sequence[_Key]) -> list[int]:
    """Which of ``n`` values belong to what is ``used``, where there may be one for everything that was ``found``."""
    if n == len(found) != len(used):
        return [found.index(key) for key in used]
    return list(range(n))


def stated_positions(
    path: Path, description: Description, layout: Layout, baseline_mm: tuple[float, float] | None
) -> Array | None:
    """Measured positions of the cameras that are used, see ``camera_positions``; None where not stated."""
    if description.grid is None or description.grid.positions_mm is None:
        return None
    values = description.grid.positions_mm
    found, used = (list(product(axes["sy"], axes["sx"])) for axes in (layout.found, layout.values))
    kept = [values[i] for i in _selected(len(values), found, used)]
    shape = (len(layout.values["sy"]), len(layout.values["sx"]))
    return camera_positions(kept, shape, baseline_mm, f"{path}: [grid] positions_mm")


def stated_stamps(
    path: Path, description: Description, layout: Layout, reach: Reach
) -> tuple[tuple[float, ...] | None, float | None]:
    """Measured time of the frames that are used, see ``time_stamps``, and the nominal interval between them [s], by
    default the median step; None where not stated."""
    time = description.time
    if time is None or (time.stamps_s is None and time.stamps is None):
        return None, time.interval_s if time else None
    name, values = f"{path}: [time] stamps_s", time.stamps_s
    if values is None:
        file = reach.root / str(time.stamps)
        reach.file(file, STAMPS_WAY_OUT)
        name, values = str(file), read_stamps(file)
    used = layout.values["t"]
    stamps = time_stamps([values[i] for i in _selected(len(values), layout.found["t"], used)], len(used), name)
    return stamps, time.interval_s or nominal_interval(stamps)


def nominal_interval(stamps: Sequence[float]) -> float | None:
    """The median step between stamps; None for a single one."""
    return float(np.median(np.diff(stamps))) if len(stamps) > 1 else None


@cache
def interpolation(fraction: float) -> Array:
    """Taps [TAPS] at the pixels 1 - TAPS/2 .. TAPS/2 that give the value ``fraction`` (0 to 1) behind pixel 0.

    Least squares over all frequencies up to ``_BAND``; constants are exact.
    """
    at = np.arange(1 - REACH, REACH + 1, dtype=np.float64)

    def overlap(distance: Array) -> Array:
        return np.asarray(np.sinc(_BAND * distance / np.pi))

    A = overlap(at[:, None] - at) + 1e-9 * np.eye(TAPS)
    right = overlap(at - fraction)
    solved = np.linalg.solve(A, np.stack([right, np.ones(TAPS)], axis=1))
    taps = solved[:, 0] + solved[:, 1] * (1 - solved[:, 0].sum()) / solved[:, 1].sum()
    taps.flags.writeable = False  # shared by all who ask
    return np.asarray(taps)


def interpolated(image: npt.NDArray[np.floating], fraction: tuple[float, float]) -> npt.NDArray[np.floating]:
    """An image at ``fraction`` (y, x) of a pixel behind its own; ``REACH`` pixels less on every side."""
    for axis, part in enumerate(fraction):
        n = image.shape[axis] - 2 * REACH
        along = np.moveaxis(image, axis, 0)
        if part < LEAST_FRACTION:
            image = np.moveaxis(along[REACH : REACH + n], 0, axis)
            continue
        taps = interpolation(part).astype(image.dtype)
        total = taps[0] * along[1 : 1 + n]
        for k in range(1, TAPS):
            total += taps[k] * along[1 + k : 1 + k + n]
        image = np.moveaxis(total, 0, axis)
    return image
