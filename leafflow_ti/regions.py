"""What happens to each region (one leaf, one label) in each frame: area, attitude, motion, growth, with error bars.

Means are over the pixels with the status ``ok``, weighted by the area of the surface that a pixel sees; pixels less
certain than most count less. ``area`` is the sum over these pixels divided by their share of the region's pixels (the
valid share): what was not measured counts as like the rest; ``area_measured`` is the sum itself.

Standard errors (``_se``) are those of the mean, from the pixels' own and the correlation between them
(``region_noise``): noise of the images, not how a label is drawn; ``_sd`` is the standard deviation between the pixels
of the region. Rates come per frame and, where the time between frames is known, per hour. Axes: X right, Y down, Z away
from the camera; ``tilt`` is the angle between the normal and the camera's axis.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from leafflow_ti.errors import InputError, UsageError
from leafflow_ti.field import quantity
from leafflow_ti.following import Followed
from leafflow_ti.labels import Coverage, Labels, covered
from leafflow_ti.rates import per_hour
from leafflow_ti.region_noise import RegionNoise
from leafflow_ti.region_rows import measured, region_row, surface_area
from leafflow_ti.region_table import RegionTable
from leafflow_ti.results import ResultStore
from leafflow_ti.tables import column_name

__all__ = ["MEANS", "RegionTable", "measure_regions"]

MEANS: dict[str, str] = {
    "depth": "depth",
    **{f"velocity_{axis}": f"velocity_{axis}" for axis in "xyz"},
    **{f"rotation_{axis}": f"rotation_{axis}" for axis in "xyz"},
    "growth_rate": "growth",
    "area_rate": "area_rate",
    **{name: name for name in ("flow_x", "flow_y", "strain_xx", "strain_yy", "strain_xy")},
}
"""Map -> name of its columns: what is averaged over a region, as far as the store has it."""
_OF_CAMERAS = ("flow_x", "flow_y")
"""Maps that matter for a single camera alone, where there is no velocity."""


def measure_regions(
    store: ResultStore | str | Path,
    labels: str | Path | ArrayLike,
    *,
    labels_frame: int | None = None,
    still: bool = False,
    start_time: str | datetime | None = None,
) -> RegionTable:
    """Measure each region of a label image in each frame of a store.

    ``labels``: a TIFF or PNG, or an array, of the size of the images, 0 where there is no region: one image [H, W], or
    one page per frame of the store [T, H, W]. ``labels_frame``: index of the frame that one image shows, None: the
    middle one of the store. Its regions are followed through the other frames, unless they keep ``still``.
    ``start_time``: date and time of day of frame 0, ISO 8601, for the column ``clock``.
    Raises InputError for labels that do not fit, UsageError for arguments that make no sense.
    """
    store = store if isinstance(store, ResultStore) else ResultStore.open(store)
    clock = _clock(store, start_time)
    given = Labels.of(labels, store, labels_frame)
    names = _averaged_names(store)
    noise = RegionNoise.of(store)
    rows: list[dict[str, float]] = []
    for t, regions in enumerate(_places(store, given, still)):
        field = measured(store, t, names)
        area = surface_area(field) if "depth" in field else np.ones(field.shape)
        for region, (place, about) in regions.items():
            row = {"region": float(region), "frame": float(field.frame), **about}
            rows.append(row | region_row(field, area, place, names, noise, t, len(store.frames)))
    columns = _columns(rows, store)
    correlation = {MEANS[name]: tuple(noise.over_time(name).tolist()) for name in ("growth_rate", "area_rate")}
    return RegionTable(_with_time(columns, store, clock), _notes(store, noise, columns), correlation)


def _averaged_names(store: ResultStore) -> tuple[str, ...]:
    spatial = "velocity_x" in store.names
    names = tuple(name for name in MEANS if name in store.names and not (spatial and name in _OF_CAMERAS))
    if not names:
        raise InputError(f"{store.path}: has none of {', '.join(MEANS)}: nothing to average over a region")
    return names


def _places(
    store: ResultStore, labels: Labels, still: bool
) -> Iterator[dict[int, tuple[Coverage | None, dict[str, float]]]]:
    """Label -> where its region is, and what else there is to say, for each frame."""
    if labels.index is None:
        for t in range(len(store.frames)):
            image = labels.image(t)
            values = [int(v) for v in np.unique(image) if v > 0]
            yield {value: (covered(store, image, value), {}) for value in values}
        return
    image = labels.image(0)
    if still or len(store.frames) == 1:
        fixed: dict[int, tuple[Coverage | None, dict[str, float]]]
        fixed = {value: (covered(store, image, value), {}) for value in labels.values}
        yield from (fixed for _ in store.frames)
        return
    followed = Followed(store, image, labels.index, labels.values)
    for t in range(len(store.frames)):
        seen = followed.coverage(t)
        yield {value: (seen.get(value), {"followed_share": followed.share(value, t)}) for value in labels.values}


def _columns(rows: list[dict[str, float]], store: ResultStore) -> dict[str, NDArray[Any]]:
    """Rows as columns, with units in their names, rates per frame and per hour, rotations in degrees."""
    keys = dict.fromkeys(key for row in rows for key in row)
    found: dict[str, NDArray[Any]] = {}
    for key in keys:
        values = np.array([row.get(key, np.nan) for row in rows])
        base, suffix = (key[:-3], key[-3:]) if key[-3:] in ("_se", "_sd") else (key, "")
        if base not in MEANS:
            found[key] = values.astype(np.int64) if key in ("region", "frame", "pixels") else values
            continue
        unit = quantity(base)[0]
        if unit.startswith("rad"):
            unit, values = unit.replace("rad", "°"), np.degrees(values)
        hourly, factor = per_hour(unit, store.interval_s)
        found[column_name(MEANS[base] + suffix, unit)] = values
        if hourly != unit:
            found[column_name(MEANS[base] + suffix, hourly)] = values * factor
    return found


def _clock(store: ResultStore, start: str | datetime | None) -> NDArray[np.datetime64] | None:
    """Date and time of day of each frame; an offset from UTC is left out: local time is what plants know."""
    if start is None:
        return None
    if isinstance(start, str):
        try:
            start = datetime.fromisoformat(start)
        except ValueError:
            raise UsageError(f"start time {start!r}: give date and time as 2024-05-31T08:00") from None
    times = store.times_s
    if times is None:
        raise UsageError(f"{store.path}: the time between frames is unknown: set interval_s in capture.toml, run again")
    return np.datetime64(start.replace(tzinfo=None), "ms") + np.rint(1000 * times).astype("timedelta64[ms]")


def _with_time(
    columns: dict[str, NDArray[Any]], store: ResultStore, clock: NDArray[np.datetime64] | None
) -> dict[str, NDArray[Any]]:
    index = np.searchsorted(store.frames, columns["frame"])
    found = {name: columns[name] for name in ("region", "frame")}
    if store.times_s is not None:
        found["time_s"] = store.times_s[index]
    if clock is not None:
        found["clock"] = clock[index]
    return found | columns


def _notes(store: ResultStore, noise: RegionNoise, columns: dict[str, NDArray[Any]]) -> tuple[str, ...]:
    notes = [*store.remarks]
    if noise.gradient is None:
        notes.append(
            f"{store.path} does not state how errors hang together: standard errors count them as the same throughout "
            "a window, too long rather than too short"
        )
    for region in np.unique(columns["region"]):
        if not (columns["valid_share"][columns["region"] == region] > 0).any():
            notes.append(f"nothing of region {region} is measured in any frame: see the status map")
    if store.interval_s is None and any("_per_frame" in name for name in columns):
        notes.append("the time between frames is unknown: rates are per frame (set interval_s in capture.toml)")
    return tuple(notes)
