"""From a description, or from an array and what is known about it, to a capture: checked, with its geometry."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.cache import ImageCache
from leafflow_ti.capture.capture import Geometry
from leafflow_ti.capture.description import FILE_NAME, Description, read_description
from leafflow_ti.capture.files import Reach
from leafflow_ti.capture.flaws import find_flaws
from leafflow_ti.capture.layout import Layout, find_layout
from leafflow_ti.capture.measured import (
    camera_positions,
    nominal_interval,
    stated_positions,
    stated_stamps,
    time_stamps,
)
from leafflow_ti.capture.rectification import Rectification, find_rectification
from leafflow_ti.capture.sources import ArrayCapture, FileCapture
from leafflow_ti.errors import ConfigError, InputError

DEFAULT_CACHE_BYTES = 512 * 2**20


def open_capture(path: str | Path, cache_bytes: int = DEFAULT_CACHE_BYTES, *, outside: bool = False) -> FileCapture:
    """Open a ``capture.toml``, or the folder that holds one; reads headers only.

    ``cache_bytes`` bounds the decoded images that are kept. ``outside``: whether the description may name files outside
    its own folder, directly or by links. Raises ConfigError for an invalid description, InputError, naming files, for
    missing, doubled, unreadable or unequal images, and for those outside.
    """
    path = description_path(path)
    return open_described(path, read_description(path), Reach(path.parent, outside), ImageCache(cache_bytes))


def description_path(path: str | Path) -> Path:
    """The ``capture.toml`` of a folder, or the path itself."""
    folder = os.path.isdir(path)  # noqa: PTH112 - Path.is_dir raises for names that are too long
    return Path(path) / FILE_NAME if folder else Path(path)


def open_described(
    path: Path, description: Description, reach: Reach, cache: ImageCache, known: Layout | None = None
) -> FileCapture:
    """The capture of a description that was read from ``path``; see ``open_capture``, ``known``: ``find_layout``."""
    time = description.time
    gaps = time is not None and bool(time.stamps_s or time.stamps)
    layout = find_layout(description.images, reach, gaps, known)
    info = layout.info
    n_frames, n_rows, n_cols = layout.file.shape
    bits = description.images.bit_depth or info.bits
    rectified = find_rectification(path, description.camera, layout, reach)
    geometry = _geometry(path, description, rectified, n_rows, n_cols, info.height, info.width)
    stamps, interval = stated_stamps(path, description, layout, reach)
    return FileCapture(
        n_frames=n_frames,
        n_rows=n_rows,
        n_cols=n_cols,
        height=info.height,
        width=info.width,
        dtype=info.dtype,
        bits=bits,
        geometry=geometry,
        frame_interval_s=interval,
        frames=layout.values["t"],
        description=description,
        path=path,
        positions_mm=stated_positions(path, description, layout, geometry.baseline_mm if geometry else None),
        stamps_s=stamps,
        layout=layout,
        channel=description.images.channel,
        lenses=rectified.lenses if rectified else None,
        outside=reach.outside,
        flaws=find_flaws(path, description.images, layout, reach, info.dtype, bits),
        _cache=cache,
    )


def capture_from_array(
    images: npt.ArrayLike,
    geometry: Geometry | None = None,
    frame_interval_s: float | None = None,
    bits: int | None = None,
    positions_mm: npt.ArrayLike | None = None,
    stamps_s: Sequence[float] | None = None,
) -> ArrayCapture:
    """A capture from grey images ``[t, sy, sx, y, x]``; the array is not copied.

    ``bits`` defaults to those of its type. ``positions_mm`` [sy, sx, 2] or [sy sx, 2]: measured (x, y) of the cameras;
    ``stamps_s`` [t]: measured time of the frames, of which ``frame_interval_s`` defaults to the median step. Raises
    InputError for another number of axes, an empty array, a type that is not real, or several cameras without geometry,
    ConfigError for positions or stamps that do not fit.
    """
    array = np.asarray(images)
    if array.ndim != 5 or array.size == 0:
        raise InputError(f"images of shape {array.shape}: five axes t, sy, sx, y, x are needed, none empty")
    if array.dtype.kind not in "buif":
        raise InputError(f"images of type {array.dtype}: give integers or floats")
    n_frames, n_rows, n_cols, height, width = array.shape
    if geometry is None and n_rows * n_cols > 1:
        raise InputError(f"{n_rows} x {n_cols} cameras need a geometry: pass Geometry(f_px, principal_px, baseline_mm)")
    positions = None
    if positions_mm is not None:
        positions = camera_positions(
            positions_mm, (n_rows, n_cols), geometry.baseline_mm if geometry else None, "positions_mm"
        )
    stamps = None if stamps_s is None else time_stamps(stamps_s, n_frames, "stamps_s")
    if stamps is not None:
        frame_interval_s = frame_interval_s or nominal_interval(stamps)
    return ArrayCapture(
        n_frames=n_frames,
        n_rows=n_rows,
        n_cols=n_cols,
        height=height,
        width=width,
        dtype=array.dtype,
        bits=bits or (1 if array.dtype.kind == "b" else 8 * array.dtype.itemsize),
        geometry=geometry,
        frame_interval_s=frame_interval_s,
        frames=tuple(range(n_frames)),
        description=None,
        path=None,
        positions_mm=positions,
        stamps_s=stamps,
        images=array,
    )


def _geometry(
    path: Path, description: Description, rectified: Rectification | None,
    n_rows: int, n_cols: int, height: int, width: int,
) -> Geometry | None:  # fmt: skip
    """Geometry of a description for a grid of this size; raises ConfigError for what is missing or does not fit."""
    camera, grid = description.camera, description.grid
    if n_rows * n_cols > 1 and (camera is None or grid is None):
        missing = "[camera] focal_length_px" if camera is None else "[grid] baseline_mm"
        raise ConfigError(f"{path}: a grid of {n_rows} x {n_cols} cameras (rows x columns) needs {missing}: add it")
    if camera is None:
        return None
    baseline = _per_axis(path, "baseline_mm", grid.baseline_mm, n_rows, n_cols) if grid else (0.0, 0.0)
    offset = _per_axis(path, "disparity_offset_px", grid.disparity_offset_px, n_rows, n_cols) if grid else (0.0, 0.0)
    for axis, count, step in (("x", n_cols, baseline[0]), ("y", n_rows, baseline[1])):
        if count > 1 and step == 0:
            raise ConfigError(f"{path}: [grid] baseline_mm along {axis} is 0 for {count} cameras: give the camera step")
    f_px, principal = camera.f_px, camera.principal_point_px or ((width - 1) / 2, (height - 1) / 2)
    if rectified:
        f_px, principal = rectified.f_px, rectified.principal_px
    assert f_px is not None  # a description has one or the other
    return Geometry(
        f_px=f_px,
        principal_px=principal,
        baseline_mm=(baseline[0] if n_cols > 1 else 0.0, baseline[1] if n_rows > 1 else 0.0),
        disparity_offset_px=(offset[0] if n_cols > 1 else 0.0, offset[1] if n_rows > 1 else 0.0),
    )


def _per_axis(path: Path, key: str, values: tuple[float, ...], n_rows: int, n_cols: int) -> tuple[float, float]:
    if len(values) == 2:
        return values[0], values[1]
    if n_rows > 1 and n_cols > 1:
        raise ConfigError(f"{path}: [grid] {key} = {values[0]} for {n_rows} x {n_cols} cameras: give [x, y]")
    return (0.0, values[0]) if n_rows > 1 else (values[0], 0.0)
