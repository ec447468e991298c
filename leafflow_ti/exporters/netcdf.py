"""NetCDF-4 by the CF conventions, with the dimensions and names of the results store: ``t, y, x``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from leafflow_ti.errors import MissingExtra
from leafflow_ti.exporters.selection import Selection
from leafflow_ti.field import empty_map, map_attributes
from leafflow_ti.results import TIME
from leafflow_ti.store_arrays import COORDINATES

_COMPRESSION = {"compression": "gzip", "compression_opts": 4, "shuffle": True}


def write_netcdf(selection: Selection, path: Path) -> list[Path]:
    """All maps into one file, frame by frame, compressed, NaN where there is no value.

    ``t`` counts frames; the coordinate ``time`` [s] stands beside it where the interval or the stamps are known.
    Raises MissingExtra where h5netcdf, or h5py that it writes with, is not installed.
    """
    try:
        import h5netcdf
        import h5py  # noqa: F401
    except ImportError as error:
        raise MissingExtra(str(error.name).partition(".")[0], "netcdf", "writing NetCDF") from None
    store = selection.store
    coordinates = {"t": np.asarray(selection.frames, np.int64), "y": store.y, "x": store.x}
    with h5netcdf.File(path, "w") as file:
        file.attrs.update(_global_attributes(selection))
        for axis, values in coordinates.items():
            file.dimensions[axis] = values.size
            file.create_variable(axis, (axis,), values.dtype, data=values).attrs.update(COORDINATES[axis])
        times = selection.times_s
        if times is not None:
            file.create_variable("time", ("t",), times.dtype, data=times).attrs.update(TIME)
        for name in selection.all_names:
            empty = empty_map(name, ())
            fill = {"fillvalue": np.float32(np.nan)} if empty.dtype.kind == "f" else {}
            chunks = (1, *selection.shape)
            variable = file.create_variable(name, ("t", "y", "x"), empty.dtype, chunks=chunks, **fill, **_COMPRESSION)
            variable.attrs.update(_attributes(selection, name, times is not None))
            for t, index in enumerate(selection.indices):
                variable[t] = selection.values(name, index)
    return [path]


def _attributes(selection: Selection, name: str, timed: bool) -> dict[str, Any]:
    attributes = {key: _plain(value, name) for key, value in map_attributes(name).items()}
    beside = [n for n in (f"{name}_std", "status") if n in selection.all_names and n != name]
    if beside:
        attributes["ancillary_variables"] = " ".join(beside)
    if timed:
        attributes["coordinates"] = "time"
    return attributes


def _plain(value: Any, name: str) -> Any:
    """Flags have the type of their variable (CF, section 3.5)."""
    return np.asarray(value, empty_map(name, ()).dtype) if isinstance(value, list) else value


def _global_attributes(selection: Selection) -> dict[str, Any]:
    """What the store says of itself; what is not text, as JSON."""
    attrs = {"Conventions": "CF-1.11", "title": f"leafflow-ti results {selection.store.path.name}"}
    for key, value in selection.store.attrs.items():
        attrs.setdefault(key, value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))
    if selection.store.interval_s is not None:
        attrs["interval_s"] = f"{selection.store.interval_s:g}"
    return attrs
