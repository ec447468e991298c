"""What a report says of a results store in numbers: what is done, what became of the pixels, growth over the frames.

Works frame by frame, on finished stores and on those that a run is still filling.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.display import Medians
from leafflow_ti.field import WITHOUT_STD
from leafflow_ti.labels import Coverage
from leafflow_ti.panels import quantity_title, shown_in
from leafflow_ti.region_noise import RegionNoise
from leafflow_ti.region_rows import measured, region_row, surface_area
from leafflow_ti.region_table import over_frames
from leafflow_ti.results import ResultStore
from leafflow_ti.status import HAS_VALUE, Status

GROWTH = ("growth_rate", "area_rate")
"""Measures of growth whose course is shown: by the refinement, and from the motion."""
MEASURED = tuple(code for code in HAS_VALUE if code != Status.COARSE)
"""Codes of pixels whose values have standard errors."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Series:
    """A quantity over frames: ``x`` [n] as the axis counts them, ``mean`` and ``error`` [n], NaN where there is none.

    ``spread``: the 16th and 84th percentile of the pixels [2, n]; None where they are not known. ``correlation``: of
    the errors at 0, 1, 2, ... frames.
    """

    name: str
    x: Floats
    mean: Floats
    error: Floats
    spread: Floats | None = None
    correlation: tuple[float, ...] = (1.0,)

    def overall(self) -> tuple[float, float] | None:
        """Mean over the frames and its standard error; None without any value."""
        mean, error = over_frames(self.mean, self.error, self.correlation)
        return (mean, error) if np.isfinite(mean) else None


@dataclass(frozen=True)
class Precision:
    """A map in the frames shown, in ``unit``."""

    name: str
    unit: str
    medians: Medians


@dataclass(frozen=True, eq=False)
class Facts:
    """``done`` [frames]: share of each frame's units that are done; ``measured`` [frames]: share of its pixels that
    have values with standard errors, NaN where nothing is done; ``statuses``: pixels per status of all that is done;
    ``growth``: the course of each measure of growth in ``growth_unit``.
    """

    done: Floats
    measured: Floats
    statuses: dict[Status, int]
    growth: tuple[Series, ...]
    growth_unit: str

    @classmethod
    def of(cls, store: ResultStore) -> Facts:
        """Of all frames of a store."""
        n = len(store.frames)
        units = store.done()
        done = np.array([sum(t * store.bands + b in units for b in range(store.bands)) for t in range(n)]) / store.bands
        measured = np.full(n, np.nan)
        statuses: dict[Status, int] = {}
        for t in np.flatnonzero(done):
            codes, counts = np.unique(store.read("status", int(t)), return_counts=True)
            found = {Status(int(code)): int(count) for code, count in zip(codes, counts, strict=True)}
            measured[t] = sum(found.get(code, 0) for code in MEASURED) / (store.y.size * store.x.size)
            for code, count in found.items():
                statuses[code] = statuses.get(code, 0) + count
        unit, _ = shown_in(GROWTH[0], store.interval_s)
        begun = [int(t) for t in np.flatnonzero(done)]
        growth = tuple(_course(store, name, begun) for name in GROWTH if name in store.names)
        return cls(done, measured, statuses, tuple(s for s in growth if np.isfinite(s.mean).any()), unit)

    @property
    def begun(self) -> list[int]:
        """Indices of the frames of which something is done."""
        return [int(t) for t in np.flatnonzero(self.done)]


def spread_evenly(frames: Sequence[int], most: int) -> list[int]:
    """At most ``most`` of the frames, the first and the last among them, at even distances."""
    if len(frames) <= most:
        return list(frames)
    picked = np.rint(np.linspace(0, len(frames) - 1, most)).astype(int)
    return [frames[i] for i in picked]


def precision_of(store: ResultStore, frames: Sequence[int]) -> list[Precision]:
    """Medians of every map over these frames (indices along t), maps without any value left out."""
    found = []
    shown = (n for n in store.names if not n.endswith("_std") and (n not in WITHOUT_STD or n == "confidence"))
    for name in shown:
        values = np.concatenate([store.read(name, t) for t in frames])
        if not np.isfinite(values).any():
            continue
        std = f"{name}_std"
        errors = np.concatenate([store.read(std, t) for t in frames]) if std in store.names else None
        unit, factor = shown_in(name, store.interval_s)
        found.append(Precision(name, unit, Medians.of(values * factor, None if errors is None else errors * factor)))
    return found


def _course(store: ResultStore, name: str, begun: Sequence[int]) -> Series:
    """Growth of all pixels that are ok, as of one region."""
    _, factor = shown_in(name, store.interval_s)
    noise = RegionNoise.of(store)
    n = len(store.frames)
    mean, error, spread = np.full(n, np.nan), np.full(n, np.nan), np.full((2, n), np.nan)
    for t in begun:
        field = measured(store, t, (name,))
        area = surface_area(field)
        found = region_row(field, area, Coverage.everywhere(field.shape), (name,), noise, t, n)
        if name in found:
            mean[t], error[t] = found[name], found[f"{name}_se"]
            known = np.isfinite(area) & np.isfinite(field[name]) & np.isfinite(field[f"{name}_std"])
            spread[:, t] = np.percentile(field[name][known], (16, 84))
    frames = tuple(noise.over_time(name).tolist())
    return Series(
        quantity_title(name), np.array(store.frames, float), mean * factor, error * factor, spread * factor, frames
    )
