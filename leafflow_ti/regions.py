"""What happens to each region (one leaf, one label) in each frame: area, attitude, motion, growth, with error bars.

Means are over the pixels with the status ``ok``, weighted by the area of the surface that a pixel sees,

    dA = |∂s/∂x × ∂s/∂y|,   s = Z r   (r the viewing ray)

or, without a depth, alike. ``area`` is the sum over these pixels divided by their share of the region's pixels (the
valid share): what was not measured counts as like the rest; ``area_measured`` is the sum itself. Standard errors
(``_se``) are those of the mean, from the pixels' own and the correlation between them (``region_noise``): noise of the
images, not how a label is drawn; ``_sd`` is the standard deviation between the pixels of the region. Rates come per
frame and, where the time between frames is known, per hour. Axes: X right, Y down, Z away from the camera; ``tilt`` is
the angle between the normal and the camera's axis.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from leafflow_ti.errors import InputError, UsageError
from leafflow_ti.field import Field, quantity
from leafflow_ti.following import Followed
from leafflow_ti.labels import Coverage, Labels, covered
from leafflow_ti.mesh import slope_normals, viewing_rays
from leafflow_ti.rates import per_hour
from leafflow_ti.region_noise import RegionNoise, mean_variance
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status
from leafflow_ti.tables import Columns, column_name, to_pandas, write_table

if TYPE_CHECKING:
    import pandas

Floats = NDArray[np.float64]

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
_SHAPE = ("depth", "slope_x", "slope_y")


@dataclass(frozen=True, eq=False)
class RegionTable:
    """One row for each region in each frame, by frame, then by region.

    ``columns``: name -> values [n], units in the names; NaN where a value is missing. ``notes``: what must be said of
    them. ``correlation``: of a region's errors at 0, 1, 2, ... frames. ``table["growth_percent_per_h"]`` is a column.
    """

    columns: Columns
    notes: tuple[str, ...] = ()
    correlation: tuple[float, ...] = (1.0,)

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

    def summary(self) -> list[str]:
        """A line per region: pixels, valid share and area of its last frame, mean growth over the frames."""
        growth = next((n for n in ("growth_percent_per_h", "growth_percent_per_frame") if n in self.columns), None)
        unit = "%/h" if growth == "growth_percent_per_h" else "%/frame"
        lines = [f"{'region':>7}{'frames':>8}{'pixels':>9}{'valid':>8}{'area [mm²]':>13}{f'growth [{unit}]':>22}"]
        for region in self.regions:
            rows = self.of(region)
            seen = rows["pixels"] > 0
            area = _last(rows["area_mm2"], seen) if "area_mm2" in rows else np.nan
            text = "-"
            if growth is not None:
                mean, se = over_frames(rows[growth], rows[growth.replace("_percent", "_se_percent")], self.correlation)
                text = f"{mean:.4g} ± {se:.2g}" if np.isfinite(mean) else "-"
            lines.append(
                f"{region:>7}{int(seen.sum()):>8}{_last(rows['pixels'], seen):>9.0f}"
                f"{_last(rows['valid_share'], seen):>8.0%}{area:>13.5g}{text:>22}"
            )
        return lines

    def __repr__(self) -> str:
        frames = np.unique(self.columns["frame"])
        head = f"<RegionTable: {len(self.regions)} regions, frames {frames[0]}..{frames[-1]}>"
        return "\n".join([head, *self.summary()])

    def _repr_html_(self) -> str:
        cells = [line.replace(" ± ", "±").split() for line in self.summary()[1:]]
        unit = "%/h" if "growth_percent_per_h" in self.columns else "%/frame"
        head = ("region", "frames", "pixels", "valid", "area [mm²]", f"growth [{unit}]")
        rows = "".join("<tr>" + "".join(f"<td>{c.replace('±', ' ± ')}</td>" for c in row) + "</tr>" for row in cells)
        return f"<table><thead><tr>{''.join(f'<th>{h}</th>' for h in head)}</tr></thead><tbody>{rows}</tbody></table>"


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
        field = _measured(store, t, names)
        area = surface_area(field) if "depth" in field else np.ones(field.shape)
        for region, (place, about) in regions.items():
            row = {"region": float(region), "frame": float(field.frame), **about}
            rows.append(row | _row(field, area, place, names, noise))
    columns = _columns(rows, store)
    return RegionTable(_with_time(columns, store, clock), _notes(store, noise), tuple(noise.frames.tolist()))


def surface_area(field: Field) -> Floats:
    """Area dA [y, x] of the surface that each pixel of the maps stands for, mm²; NaN where there is no depth.

    From the slopes, in closed form; without them, from differences of the depth between neighbouring pixels.
    """
    pitch = [float(p[1] - p[0]) if p.size > 1 else 1.0 for p in (field.y, field.x)]
    rays, focal = viewing_rays(field), float(field.attrs["plan"]["f_px"])
    depth = field["depth"].astype(np.float64)
    if "slope_x" in field and "slope_y" in field:
        normals = np.stack([field["slope_x"], field["slope_y"], -np.ones(field.shape)], axis=-1).astype(np.float64)
        foreshortened = np.abs((normals * rays).sum(axis=-1))
        with np.errstate(divide="ignore", invalid="ignore"):
            per_pixel = (depth / focal) ** 2 * np.linalg.norm(normals, axis=-1) / foreshortened
    else:
        if min(field.shape) < 2:
            raise InputError("a map of one row or column has no area: measure a larger region")
        down, across = (np.gradient(depth[..., None] * rays, p, axis=k) for k, p in enumerate(pitch))
        per_pixel = np.linalg.norm(np.cross(down, across), axis=-1)
    return np.asarray(per_pixel * pitch[0] * pitch[1])


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


def _measured(store: ResultStore, t: int, names: tuple[str, ...]) -> Field:
    """The maps that are needed of a frame, with their standard errors; NaN but for pixels with the status ok."""
    status = store.read("status", t)
    ok = status == Status.OK
    wanted = [n for base in dict.fromkeys((*names, *_SHAPE)) for n in (base, f"{base}_std") if n in store.names]
    maps = {name: np.where(ok, store.read(name, t), np.float32(np.nan)) for name in wanted}
    return Field(maps, status, store.y, store.x, store.frames[t], store.attrs)


def _row(
    field: Field, area: Floats, place: Coverage | None, names: tuple[str, ...], noise: RegionNoise
) -> dict[str, float]:
    """What is measured of one region in one frame."""
    if place is None or not place.pixels:
        return {"pixels": 0.0, "valid_share": np.nan}
    cut, covered_share = place.cut, place.share
    valid = (covered_share > 0) & (field.status[cut] == Status.OK) & np.isfinite(area[cut])
    row = {"pixels": float(place.pixels), "valid_share": float(covered_share[valid].sum() / covered_share.sum())}
    if not valid.any():
        return row
    weights = np.where(valid, covered_share * area[cut], 0.0)
    part = {name: field[name][cut].astype(np.float64) for name in field}
    if "depth" in part:
        row |= _area(part, weights, row["valid_share"], noise) | _attitude(part, weights, noise)
    for name in names:
        row |= _mean(name, part, weights, noise)
    return row


def _area(part: Mapping[str, Floats], weights: Floats, share: float, noise: RegionNoise) -> dict[str, float]:
    """Area of a region, and its error from that of the depth."""
    measured = float(weights.sum())
    found = {"area_mm2": measured / share, "area_se_mm2": np.nan, "area_measured_mm2": measured}
    std = part.get("depth_std")
    if std is not None and np.isfinite(std[weights > 0]).all():
        with np.errstate(divide="ignore", invalid="ignore"):
            change = np.where(weights > 0, 2 * weights / part["depth"], 0.0)
        found["area_se_mm2"] = np.sqrt(mean_variance(change, std, noise.terms("depth"))) / share
    return found


def _attitude(part: Mapping[str, Floats], weights: Floats, noise: RegionNoise) -> dict[str, float]:
    """Unit normal of the mean surface towards the camera, and its tilt with the error from that of the slopes."""
    if "slope_x" not in part or "slope_y" not in part:
        return {}
    normals = slope_normals(part["slope_x"], part["slope_y"])
    known = (weights > 0) & np.isfinite(normals).all(axis=-1)
    total = (np.where(known, weights, 0.0)[..., None] * np.where(known[..., None], normals, 0.0)).sum(axis=(0, 1))
    length = float(np.linalg.norm(total))
    if not length:
        return {}
    x, y, z = (float(v) for v in total / length)
    across = float(np.hypot(x, y))
    found = {"normal_x": x, "normal_y": y, "normal_z": z, "tilt_deg": float(np.degrees(np.arctan2(across, -z)))}
    errors = [_error("slope_x", part, weights, noise), _error("slope_y", part, weights, noise)]
    # tan(tilt) = |(ZX, ZY)|: errors of the slopes along that direction.
    direction = (x / across, y / across) if across > 0 else (np.sqrt(0.5), np.sqrt(0.5))
    spread = float(np.hypot(direction[0] * errors[0], direction[1] * errors[1]))
    found["tilt_se_deg"] = float(np.degrees(spread * z**2))
    return found


def _error(name: str, part: Mapping[str, Floats], weights: Floats, noise: RegionNoise, near: float = 0.0) -> float:
    """Standard error of the mean of the map ``name``; NaN where pixels have none."""
    std = part.get(f"{name}_std")
    if std is None or not np.isfinite(std[weights > 0]).all():
        return np.nan
    return float(np.sqrt(mean_variance(weights / weights.sum(), std, noise.terms(name, near))))


def _mean(name: str, part: Mapping[str, Floats], weights: Floats, noise: RegionNoise) -> dict[str, float]:
    """Mean, its standard error and the standard deviation of one map over a region, in the map's own unit."""
    known = np.isfinite(part[name])
    if f"{name}_std" in part:
        known &= np.isfinite(part[f"{name}_std"])
    weights = np.where(known, weights, 0.0)
    if not weights.any():
        return {}
    share = weights / weights.sum()
    values = np.where(known, part[name], 0.0)
    mean = float((share * values).sum())
    spread = float(np.sqrt((share * (values - mean) ** 2).sum()))
    return {name: mean, f"{name}_se": _error(name, part, weights, noise, _near(name, part)), f"{name}_sd": spread}


def _near(name: str, part: Mapping[str, Floats]) -> float:
    """Variance of ``2 N_z / Z`` in (%/frame)² over that of the growth ``name``, over the pixels of ``part``."""
    if name not in ("growth_rate", "area_rate") or "velocity_z_std" not in part or f"{name}_std" not in part:
        return 0.0
    approach, own = 200 * part["velocity_z_std"] / part["depth"], part[f"{name}_std"]
    known = np.isfinite(approach) & np.isfinite(own)
    return float((approach[known] ** 2).mean() / (own[known] ** 2).mean()) if known.any() else 0.0


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


def _notes(store: ResultStore, noise: RegionNoise) -> tuple[str, ...]:
    notes = []
    if noise.gradient is None:
        notes.append(
            f"{store.path} does not state how errors hang together: standard errors count them as the same throughout "
            "a window, too long rather than too short"
        )
    if store.interval_s is None:
        notes.append("the time between frames is unknown: rates are per frame (set interval_s in capture.toml)")
    return tuple(notes)


def _last(values: NDArray[Any], seen: NDArray[np.bool_]) -> float:
    """The value of the last frame in which a region is seen."""
    return float(values[seen][-1]) if seen.any() else np.nan
