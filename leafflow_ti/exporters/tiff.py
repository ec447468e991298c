"""TIFF: ImageJ hyperstacks, one per map, and one OME-TIFF with the maps as channels.

Both keep the maps' own values: float32, NaN where there is none. Lengths in the picture are pixels of the reference
image, not mm: a millimetre has not the same size everywhere.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from leafflow_ti.errors import UsageError
from leafflow_ti.exporters.selection import Selection
from leafflow_ti.field import map_attributes

_CLASSIC_BYTES = 2**32 - 2**25
"""Largest ImageJ file: it knows no BigTIFF."""


def write_imagej_file(selection: Selection, path: Path) -> list[Path]:
    """The hyperstack of the one chosen map, as ``write_imagej_folder`` writes it."""
    (name,) = selection.all_names
    return [_write_stack(selection, name, path)]


def write_imagej_folder(selection: Selection, folder: Path) -> list[Path]:
    """One float32 (flags: uint8) hyperstack ``NAME.tif`` per map into ``folder``, a slider for the frames.

    ImageJ and Fiji show the unit of the values, the frame and its time in the title of a slice, the time between
    frames, positions in pixels of the image, and a contrast from the 2nd to the 98th percentile of the middle frame.
    Raises UsageError where a stack would exceed 4 GiB.
    """
    return [_write_stack(selection, name, folder / f"{name}.tif") for name in selection.all_names]


def _write_stack(selection: Selection, name: str, path: Path) -> Path:
    first = selection.values(name, selection.indices[0])
    shape = (len(selection.indices), *selection.shape)
    if first.itemsize * np.prod(shape, dtype=np.int64) > _CLASSIC_BYTES:
        raise UsageError(
            f"{path}: {shape[0]} frames of {shape[2]} x {shape[1]} are more than ImageJ's 4 GiB: give --frames A:B, "
            "or take ome-tiff"
        )
    pitch_y, pitch_x = selection.pitch
    unit = _ascii(map_attributes(name).get("units", ""))
    metadata: dict[str, Any] = {
        "axes": "TYX",
        "unit": "pixel",
        "xorigin": -selection.store.x[0] / pitch_x,
        "yorigin": -selection.store.y[0] / pitch_y,
        "vunit": unit,
        "Labels": [f"{label} [{unit}]" if unit else label for label in _labels(selection)],
    }
    interval = selection.store.interval_s
    metadata |= {"finterval": 1.0, "tunit": "frame"} if interval is None else {"finterval": interval, "tunit": "s"}
    middle = selection.values(name, selection.indices[len(selection.indices) // 2])
    finite = middle[np.isfinite(middle)]
    if finite.size:
        low, high = np.percentile(finite, (2, 98))
        metadata |= {"min": float(low), "max": float(high)}
    tifffile.imwrite(
        path,
        (selection.values(name, index) for index in selection.indices),
        shape=shape,
        dtype=first.dtype,
        imagej=True,
        resolution=(1 / pitch_x, 1 / pitch_y),
        metadata=metadata,
    )
    return path


def write_ome(selection: Selection, path: Path) -> list[Path]:
    """One OME-TIFF: the maps as named channels of a float32 image ``T, C, Y, X``, flags as a second image of uint8.

    Units stand in the channels' names and in a map annotation; planes have the time of their frame.
    """
    flags = [name for name in selection.all_names if name in ("status", "identified")]
    maps = [name for name in selection.all_names if name not in flags]
    with tifffile.TiffWriter(path, ome=True, bigtiff=_bytes(selection) > _CLASSIC_BYTES) as file:
        for title, names, dtype in (("maps", maps, np.float32), ("flags", flags, np.uint8)):
            if names:
                file.write(
                    _planes(selection, names),
                    shape=(len(selection.indices), len(names), *selection.shape),
                    dtype=dtype,
                    compression="zlib",
                    predictor=False,
                    photometric="minisblack",
                    metadata=_ome_metadata(selection, f"{selection.store.path.name} {title}", names),
                )
    return [path]


def _bytes(selection: Selection) -> int:
    return int(4 * len(selection.all_names) * len(selection.indices) * np.prod(selection.shape, dtype=np.int64))


def _planes(selection: Selection, names: list[str]) -> Iterator[NDArray[Any]]:
    for index in selection.indices:
        for name in names:
            yield selection.values(name, index)


def _ome_metadata(selection: Selection, title: str, names: list[str]) -> dict[str, Any]:
    pitch_y, pitch_x = selection.pitch
    units = {name: map_attributes(name).get("units", "") for name in names}
    metadata: dict[str, Any] = {
        "axes": "TCYX",
        "Name": title,
        "Channel": {"Name": [f"{name} [{unit}]" if unit else name for name, unit in units.items()]},
        "PhysicalSizeX": pitch_x,
        "PhysicalSizeXUnit": "pixel",
        "PhysicalSizeY": pitch_y,
        "PhysicalSizeYUnit": "pixel",
        "MapAnnotation": {
            "Namespace": "leafflow-ti/units",
            **{name: unit or "flags" for name, unit in units.items()},
            "x of the first column [px]": str(selection.store.x[0]),
            "y of the first row [px]": str(selection.store.y[0]),
            "frames": " ".join(map(str, selection.frames)),
        },
    }
    if selection.store.interval_s is not None:
        metadata |= {"TimeIncrement": selection.store.interval_s, "TimeIncrementUnit": "s"}
    times = selection.times_s
    if times is not None:
        per_plane = np.repeat(times, len(names)).tolist()
        metadata["Plane"] = {"DeltaT": per_plane, "DeltaTUnit": ["s"] * len(per_plane)}
    return metadata


def _labels(selection: Selection) -> list[str]:
    """``frame 4``, with its time where that is known."""
    times = selection.times_s
    if times is None:
        return [f"frame {frame}" for frame in selection.frames]
    return [f"frame {frame}, {time:g} s" for frame, time in zip(selection.frames, times, strict=True)]


def _ascii(unit: str) -> str:
    return unit.replace("²", "^2").replace("°", "deg")
