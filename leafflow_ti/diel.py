"""Growth over the day: the curve of each region folded on 24 hours.

In each bin of the time of day the growth rates of one day are averaged, weighted by 1/se², then those of all days,
alike: days differ by more than noise. The band around the mean over the days is its standard error, as the errors of
the measurement say, and the spread is the standard deviation between the days.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import InputError, MissingExtra, UsageError
from leafflow_ti.number_text import duration
from leafflow_ti.region_table import RegionTable, over_frames
from leafflow_ti.tables import write_table
from leafflow_ti.whole import appearing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

DAY_H = 24.0
GROWTH = ("growth", "area_rate")
"""Quantities that can be folded, the preferred one first: growth of the run, and that of the motion in a window."""
UNDATED: dict[str, dict[str, None]] = {
    ".png": {"Software": None}, ".pdf": {"CreationDate": None}, ".svg": {"Date": None},
}  # fmt: skip
"""Suffix of a figure -> what is left out of it, so that the same curves give the same file."""


@dataclass(frozen=True, eq=False)
class DielCurves:
    """Growth [%/h] by the time of day. One row per region and bin, by region, then by time.

    ``columns``: ``region``; ``hour_start``, ``hour_end``: of the bin; ``growth_percent_per_h``: mean over the days,
    ``_se``: its standard error, ``_days_sd``: standard deviation between days (NaN for one); ``days``: how many days
    have values in the bin; ``frames``: how many values. ``clock``: whether hours are those of the day, or count from
    frame 0; ``covered_h``: from the first to the last frame.
    """

    columns: dict[str, NDArray[Any]]
    clock: bool
    covered_h: float

    def of(self, region: int) -> dict[str, NDArray[Any]]:
        """The rows of one region."""
        rows = self.columns["region"] == region
        return {name: values[rows] for name, values in self.columns.items()}

    def to_csv(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write as CSV or Parquet; raises like ``tables.write_table``."""
        return write_table(self.columns, path, overwrite)

    def describe(self) -> str:
        """What is shown, in a line."""
        bins = np.unique(self.columns["hour_start"]).size
        days = int(self.columns["days"].max(initial=0))
        what = "time of day" if self.clock else "time since frame 0 (no start time is known)"
        short = " (less than a day: every hour is seen once at most)" if self.covered_h < DAY_H else ""
        return (
            f"growth by {what}: {bins} bin{'s' * (bins != 1)} from {duration(3600 * self.covered_h)}{short}, "
            f"at most {days} day{'s' * (days != 1)} in a bin"
        )


def fold(table: RegionTable, bin_h: float = 1.0, quantity: str | None = None) -> DielCurves:
    """The growth of each region by the time of day, in bins of ``bin_h`` hours that divide the day.

    ``quantity``: one of ``GROWTH``, None: the first that the table has. Hours are those of the column ``clock`` where
    the table has it, else they count from frame 0.
    Raises InputError for a table without growth per hour, UsageError for bins that do not divide the day.
    """
    n_bins = round(DAY_H / bin_h) if bin_h > 0 else 0
    if n_bins < 1 or abs(n_bins * bin_h - DAY_H) > 1e-9 * DAY_H:
        raise UsageError(f"bins of {bin_h:g} h do not divide a day: choose one of .25, .5, 1, 2, 3, 4, 6 h")
    wanted = GROWTH if quantity is None else (quantity,)
    found_quantity = next((one for one in wanted if f"{one}_percent_per_h" in table.columns), None)
    if found_quantity is None:
        raise InputError(
            f"the regions have no {' or '.join(wanted)} per hour: a diel curve needs a growth rate and the time "
            "between frames (interval_s)"
        )
    quantity = found_quantity
    name, error = f"{quantity}_percent_per_h", f"{quantity}_se_percent_per_h"
    hours, days = _hours(table)
    rows = []
    for region in table.regions:
        own = table.columns["region"] == region
        values = _Series(
            table[name][own], table[error][own], np.floor(hours[own] / bin_h).astype(int) % n_bins, days[own]
        )
        for at in range(n_bins):
            found = values.bin(at, table.correlation[quantity])
            if found is not None:
                rows.append((region, at * bin_h, (at + 1) * bin_h, *found))
    names = ("region", "hour_start", "hour_end", name, error, f"{quantity}_days_sd_percent_per_h", "days", "frames")
    whole = ("region", "days", "frames")
    columns = {
        column: np.array([row[k] for row in rows], np.int64 if column in whole else np.float64)
        for k, column in enumerate(names)
    }
    return DielCurves(columns, "clock" in table.columns, float(np.ptp(table["time_s"])) / 3600)


@dataclass(frozen=True)
class _Series:
    """Growth [n] of one region with its errors; the bin and the day of each value."""

    growth: Floats
    error: Floats
    bins: NDArray[np.int64]
    days: NDArray[np.int64]

    def bin(self, at: int, correlation: tuple[float, ...]) -> tuple[float, float, float, int, int] | None:
        """Mean, standard error, deviation between days, days and values of one bin; None where it is empty."""
        means, errors, count = [], [], 0
        for day in np.unique(self.days):
            rows = (self.bins == at) & (self.days == day)
            mean, error = over_frames(self.growth[rows], self.error[rows], correlation)
            if np.isfinite(mean):
                means.append(mean)
                errors.append(error)
                count += int((rows & np.isfinite(self.growth)).sum())
        if not means:
            return None
        n = len(means)
        spread = float(np.std(means, ddof=1)) if n > 1 else np.nan
        return float(np.mean(means)), float(np.linalg.norm(errors)) / n, spread, n, count


def _hours(table: RegionTable) -> tuple[Floats, NDArray[np.int64]]:
    """Hour of the day, and number of the day, of each row."""
    if "clock" in table.columns:
        clock = table["clock"]
        start = clock.astype("datetime64[D]")
        return (clock - start) / np.timedelta64(1, "h"), start.astype(np.int64)
    hours = table["time_s"] / 3600
    return hours % DAY_H, np.floor(hours / DAY_H).astype(np.int64)


def parse_light(text: str) -> tuple[float, float]:
    """``8-22``: the hours of the day at which the light goes on and off; UsageError for anything else."""
    try:
        on, off = (float(part) for part in text.split("-"))
    except ValueError:
        on = off = -1.0
    if not (0 <= on <= DAY_H and 0 <= off <= DAY_H and on != off):
        raise UsageError(f"light {text!r}: give the hours at which it goes on and off, such as 8-22")
    return on, off


def check_figure_path(path: str | Path, overwrite: bool = False) -> Path:
    """The path of a figure that can be drawn.

    Raises UsageError for another suffix than those of ``UNDATED``, or where ``path`` exists and may not be replaced;
    MissingExtra where matplotlib is not installed.
    """
    path = Path(path)
    if path.suffix.lower() not in UNDATED:
        raise UsageError(f"{path}: the figure's format is not clear: let the name end in one of {', '.join(UNDATED)}")
    if path.is_dir() or (path.exists() and not overwrite):
        raise UsageError(f"{path} exists: {'' if path.is_dir() else 'give --overwrite to replace it, or '}another name")
    _figure_class()
    return path


def _figure_class() -> type[Figure]:
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("matplotlib", "plot", "a diel figure") from None
    return Figure


def write_diel_figure(
    curves: DielCurves, path: str | Path, light: tuple[float, float] | None = None, overwrite: bool = False
) -> Path:
    """Draw the curves with their bands, and the night shaded where the hours of ``light`` are given.

    The file appears when it is whole. Raises like ``check_figure_path``, and RunError when it cannot be written.
    """
    path = check_figure_path(path, overwrite)
    figure = _figure_class()(figsize=(7.2, 4.0), layout="constrained")
    axes = figure.add_subplot()
    _draw(axes, curves, light)
    with appearing(path) as scratch:
        figure.savefig(scratch, dpi=150, facecolor="white", metadata=UNDATED[path.suffix.lower()])
    return path


def _draw(axes: Axes, curves: DielCurves, light: tuple[float, float] | None) -> None:
    for begin, end in _nights(light):
        axes.axvspan(begin, end, color="#dfe3ea", lw=0, zorder=0)
    growth, error = list(curves.columns)[3:5]
    spread = list(curves.columns)[5]
    for k, region in enumerate(np.unique(curves.columns["region"])):
        rows = curves.of(int(region))
        hour, mean = 0.5 * (rows["hour_start"] + rows["hour_end"]), rows[growth]
        colour = f"C{k % 10}"
        gaps = np.flatnonzero(np.diff(hour) > 1.5 * (rows["hour_end"] - rows["hour_start"])[1:]) + 1
        for part in np.split(np.arange(hour.size), gaps):
            low, high = mean[part] - rows[error][part], mean[part] + rows[error][part]
            axes.fill_between(hour[part], low, high, color=colour, alpha=0.35, lw=0)
            wide = np.fmax(rows[error][part], rows[spread][part])
            axes.fill_between(hour[part], mean[part] - wide, mean[part] + wide, color=colour, alpha=0.12, lw=0)
            axes.plot(hour[part], mean[part], "o-", ms=3, color=colour, label=None if part[0] else f"region {region}")
    axes.axhline(0, color="#8a8f98", lw=0.8, zorder=1)
    axes.set_xlim(0, DAY_H)
    axes.set_xticks(range(0, 25, 3))
    axes.set_xlabel("time of day [h]" if curves.clock else "time since frame 0, modulo a day [h]")
    axes.set_ylabel("growth of the area [%/h]")
    days = int(curves.columns["days"].max(initial=0))
    bands = "dark band: standard error, light band: between days" if days > 1 else "band: standard error"
    axes.set_title(f"{days} day{'s' * (days != 1)}; {bands}", fontsize=9)
    if curves.columns["region"].size:
        axes.legend(fontsize=8, frameon=False)


def _nights(light: tuple[float, float] | None) -> list[tuple[float, float]]:
    """Hours without light within a day."""
    if light is None:
        return []
    on, off = light
    return [(off, on)] if off < on else [(0.0, on), (off, DAY_H)]
