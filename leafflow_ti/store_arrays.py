"""The Zarr side of a results store: its group and arrays, made and opened; damage is told from absence."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from leafflow_ti import unit_marks
from leafflow_ti.chunk_files import COMPRESSOR, UNREADABLE, reading
from leafflow_ti.field import empty_map, map_attributes

MEASURED = "measured_maps"
"""Attribute: maps that the run fills; others were added later."""
METADATA = "zarr.json"
"""The group's metadata file, attributes included (Zarr v3)."""

COORDINATES: dict[str, dict[str, Any]] = {
    "t": {"long_name": "index of the reference frame", "units": "frame"},
    "y": {"long_name": "row in the reference image, downwards", "units": "px"},
    "x": {"long_name": "column in the reference image, to the right", "units": "px"},
}


def create_map(group: zarr.Group, name: str, has_std: bool, shape: tuple[int, ...], chunk: tuple[int, ...]) -> None:
    """An empty map, or the status; ``has_std``: there is a map of its standard errors."""
    attributes = map_attributes(name) | ({"ancillary_variables": f"{name}_std status"} if has_std else {})
    group.create_array(
        name,
        shape=shape,
        chunks=chunk,
        dtype=empty_map(name, ()).dtype,
        fill_value=empty_map(name, ()).item(),
        dimension_names=list(COORDINATES),
        attributes=attributes,
        compressors=COMPRESSOR,
        filters=None,
    )


def open_group(path: Path) -> zarr.Group | None:
    """The group of a results store, None for anything else; InputError where its metadata cannot be read any more."""
    with reading(path) if is_ours(path) else contextlib.suppress(*UNREADABLE):
        group = zarr.open_group(path, mode="r+", zarr_format=3)
        if "leafflow_ti_format" in group.attrs:
            return group
    return None


def is_ours(path: Path) -> bool:
    """Whether this was made as a results store, whatever has become of it since."""
    return (path / unit_marks.FOLDER).is_dir()


def arrays_of(path: Path, group: zarr.Group) -> dict[str, zarr.Array[Any]]:
    """All arrays by name, other entries are left alone; LookupError or ValueError where one is not as it was made."""
    found = {folder.name: group[folder.name] for folder in path.iterdir() if (folder / METADATA).is_file()}
    arrays = {name: array for name, array in found.items() if isinstance(array, zarr.Array)}
    measured: Any = group.attrs.get(MEASURED, [])
    if not is_ours(path):
        raise LookupError(f"its folder {unit_marks.FOLDER} is missing")
    missing = {*COORDINATES, "status", *measured} - arrays.keys()
    if missing:
        raise LookupError(f"its array {min(missing)} is missing")
    frames, form = arrays["t"].shape[0], (arrays["status"].shape[1:], arrays["status"].chunks)
    for name in (*measured, "status"):  # one that is just growing has more frames than t names
        if (arrays[name].shape[1:], arrays[name].chunks) != form or arrays[name].shape[0] < frames:
            raise ValueError(f"its array {name} has another form than its status or t")
    return arrays


def coordinate(arrays: Mapping[str, zarr.Array[Any]], axis: str) -> NDArray[np.int64]:
    """The positions along an axis, which increase; ValueError where they do not."""
    values = np.asarray(arrays[axis][...], np.int64)
    length = arrays["status"].shape[list(COORDINATES).index(axis)]
    if np.any(np.diff(values) <= 0) or (axis != "t" and values.size != length):
        raise ValueError(f"its coordinate {axis} does not increase, or has not the length of the maps")
    return values
