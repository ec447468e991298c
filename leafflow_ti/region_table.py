"""The table of regions: a row for each region in each frame, columns with their units."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.tables import Columns, to_pandas, write_table

if TYPE_CHECKING:
    import pandas

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RegionTable:
    """One row for each region in each frame, by frame, then by region.

    ``columns``: name -> values [n], units in the names; NaN where a value is missing. ``notes``: what must be said of
    them. ``correlation``: of the errors of ``growth`` and ``area_rate`` at 0, 1, 2, ... frames.
    ``table["growth_percent_per_h"]`` is a column.
    """

    columns: Columns
    notes: tuple[str, ...] = ()
    correlation: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def __getitem__(self, name: str) -> NDArray[Any]:
        try:
            return self.columns[name]
        except KeyError:
            raise KeyError(f"no column {name!r}; there are: {', '.join(self.columns)}") from None

    def __len__(self) -> int:
        return int(self.columns["region"].size)

    @property
    def regions(self) -> tuple[int, ...]:
        """Labels of the regions."""
        return tuple(int(v) for v in np.unique(self.columns["region"]))

    def of(self, region: int) -> dict[str, NDArray[Any]]:
        """The rows of one region."""
        rows = self.columns["region"] == region
        return {name: values[rows] for name, values in self.columns.items()}

    def to_csv(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write as CSV, or as Parquet where the name ends in ``.parquet``; raises like ``tables.write_table``."""
        return write_table(self.columns, path, overwrite)

    def to_pandas(self) -> pandas.DataFrame:
        """As a DataFrame; MissingExtra where pandas is not installed."""
        return to_pandas(self.columns)

    @property
    def growths(self) -> tuple[tuple[str, str], ...]:
        """The measures of growth that the table has, ``growth`` (of the run) and ``area_rate`` (from the motion), each
        with its rate: ``per_h`` where that is known, else ``per_frame``."""
        found: dict[str, str] = {}
        for name in ("growth", "area_rate"):
            for rate in ("per_frame", "per_h"):
                if f"{name}_percent_{rate}" in self.columns:
                    found[name] = rate
        return tuple(found.items())

    def summary(self) -> list[str]:
        """A line per region: pixels, valid share and area of its last frame, mean growth over the frames."""
        widths = (7, 8, 9, 8, 13, *(22 for _ in self.growths))
        rows = (self._titles(), *self._rows())
        return ["".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)) for row in rows]

    def _titles(self) -> tuple[str, ...]:
        """The heads of the summary's columns."""
        growths = (f"{name.replace('_', ' ')} [%/{rate.removeprefix('per_')}]" for name, rate in self.growths)
        return ("region", "frames", "pixels", "valid", "area [mm²]", *growths)

    def _rows(self) -> Iterator[tuple[str, ...]]:
        """The cells of each region in the summary."""
        for region in self.regions:
            rows = self.of(region)
            seen = rows["pixels"] > 0
            area = _last(rows["area_mm2"], seen) if "area_mm2" in rows else np.nan
            growths = []
            for name, rate in self.growths:
                values, errors = rows[f"{name}_percent_{rate}"], rows[f"{name}_se_percent_{rate}"]
                mean, error = over_frames(values, errors, self.correlation.get(name, (1.0,)))
                growths.append(f"{mean:.4g} ± {error:.2g}" if np.isfinite(mean) else "-")
            numbers = (f"{_last(rows['pixels'], seen):.0f}", f"{_last(rows['valid_share'], seen):.0%}", f"{area:.5g}")
            yield (str(region), str(int(seen.sum())), *("-" if "nan" in one else one for one in numbers), *growths)

    def __repr__(self) -> str:
        frames = np.unique(self.columns["frame"])
        head = f"<RegionTable: {len(self.regions)} regions, frames {frames[0]}..{frames[-1]}>"
        return "\n".join([head, *self.summary()])

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{name}</th>" for name in self._titles())
        rows = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in self._rows())
        return f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"


def over_frames(values: Floats, errors: Floats, correlation: tuple[float, ...]) -> tuple[float, float]:
    """Mean [unit of the values] over frames in a row, weighted by 1/se², and its standard error.

    ``correlation``: of the errors at 0, 1, 2, ... frames. NaN where no value has an error.
    """
    known = np.isfinite(values) & np.isfinite(errors) & (errors > 0)
    if not known.any():
        return np.nan, np.nan
    weights = np.where(known, 1 / np.where(known, errors, 1.0) ** 2, 0.0)
    weights /= weights.sum()
    error = (weights * np.where(known, errors, 0.0))[None]
    variance = sum(
        (1 if lag == 0 else 2) * r * float((error[:, : error.size - lag] * error[:, lag:]).sum())
        for lag, r in enumerate(correlation[: error.size])
    )
    return float(weights[known] @ values[known]), float(np.sqrt(max(variance, 0.0)))


def _last(values: NDArray[Any], seen: NDArray[np.bool_]) -> float:
    """The value of the last frame in which a region is seen."""
    return float(values[seen][-1]) if seen.any() else np.nan
