"""CSV: one line per measured pixel and frame, for R, pandas and spreadsheets."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.exporters.selection import Selection
from leafflow_ti.field import Field, quantity
from leafflow_ti.mesh import surface_points
from leafflow_ti.status import Status
from leafflow_ti.tables import column_name, write_rows


def write_csv_file(selection: Selection, path: Path) -> list[Path]:
    """All frames into one table."""
    with path.open("w", newline="", encoding="utf-8") as file:
        for n, columns in enumerate(_tables(selection)):
            write_rows(file, columns, header=n == 0)
    return [path]


def write_csv_folder(selection: Selection, folder: Path) -> list[Path]:
    """One table ``frame_0004.csv`` per frame into ``folder``."""
    written = []
    for frame, columns in zip(selection.frames, _tables(selection), strict=True):
        written.append(folder / f"frame_{frame:04d}.csv")
        with written[-1].open("w", newline="", encoding="utf-8") as file:
            write_rows(file, columns)
    return written


def _tables(selection: Selection) -> Any:
    times = selection.times_s
    for n, field in enumerate(selection.fields(surface="depth" in selection.store.names)):
        yield pixel_columns(field, selection.names, selection.status, None if times is None else float(times[n]))


def pixel_columns(
    field: Field, names: tuple[str, ...], status: bool = True, time_s: float | None = None
) -> dict[str, NDArray[Any]]:
    """Columns of the pixels where one of the maps ``names`` has a value, row by row of the image.

    ``frame``, ``time_s`` if given, position ``x_px, y_px`` and, with a depth, ``X_mm, Y_mm, Z_mm`` in the camera's
    frame, the maps with their units, the name of the status.
    """
    known = np.zeros(field.shape, np.bool_)
    for name in names:
        if field[name].dtype.kind == "f":
            known |= np.isfinite(field[name])
    rows, columns = np.nonzero(known)
    found: dict[str, NDArray[Any]] = {"frame": np.full(rows.size, field.frame)}
    if time_s is not None:
        found["time_s"] = np.full(rows.size, time_s)
    found |= {"x_px": field.x[columns], "y_px": field.y[rows]}
    if "depth" in field:
        points = surface_points(field)[known].astype(np.float32)
        found |= {f"{axis}_mm": points[:, k] for k, axis in enumerate("XYZ")}
    for name in names:
        found[column_name(name, quantity(name)[0])] = field[name][known]
    if status:
        meanings = np.array([Status(code).name.lower() if code in set(Status) else "" for code in range(256)])
        found["status"] = meanings[field.status[known]]
    return found
