"""Growth of regions, read from the table that ``leafflow-ti regions`` writes as CSV."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from leafflow_ti.errors import InputError
from leafflow_ti.report.charts import COLOURS
from leafflow_ti.report.facts import Series

REGION, FRAME, PIXELS = "region", "frame", "pixels"
GROWTH: tuple[tuple[str, str, str], ...] = tuple(
    (f"{name}_percent_per_{time}", f"{name}_se_percent_per_{time}", f"%/{time}")
    for name in ("growth", "area_rate")
    for time in ("h", "frame")
)
"""Columns of growth and of its standard error, and their unit, what is best first."""


@dataclass(frozen=True, eq=False)
class RegionCurves:
    """Growth of the regions over the frames, the largest first, at most as many as there are colours."""

    series: tuple[Series, ...]
    unit: str


def read_region_curves(path: Path) -> RegionCurves:
    """The growth in a table of regions; InputError, naming what is missing, where the file is none."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"{path}: cannot be read as a table ({reason}): give a CSV of 'leafflow-ti regions'"
        ) from error
    names = rows[0].keys() if rows else ()
    growth = next((columns for columns in GROWTH if set(columns[:2]) <= set(names)), None)
    if growth is None or REGION not in names or FRAME not in names:
        wanted = f"{REGION}, {FRAME}, {GROWTH[0][0]}, {GROWTH[0][1]}"
        raise InputError(f"{path}: no table of growth of regions; it needs the columns {wanted}")
    value, error_column, unit = growth
    regions: dict[str, list[Mapping[str, str]]] = {}
    for row in rows:
        regions.setdefault(row[REGION], []).append(row)

    def numbers(of: list[Mapping[str, str]], column: str) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        return np.array([_number(row.get(column, ""), column, path) for row in of])

    series = []
    for name, of in regions.items():
        ordered = sorted(of, key=lambda row: _number(row[FRAME], FRAME, path))
        size = float(np.nan_to_num(numbers(ordered, PIXELS)).mean())
        curve = Series(
            f"region {name}", numbers(ordered, FRAME), numbers(ordered, value), numbers(ordered, error_column)
        )
        series.append((size, curve))
    largest = sorted(series, key=lambda item: -item[0])[:COLOURS]
    return RegionCurves(tuple(curve for _, curve in largest), unit)


def _number(text: str | None, column: str, path: Path) -> float:
    if not text:
        return float("nan")
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{path}: {column} holds {text!r}, which is no number") from None
