"""What a report says of a results store in numbers: what is done, what became of the pixels, growth over the frames.

Works frame by frame, on finished stores and on those that a run is still filling.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.correlation import NoiseCorrelation
from leafflow_ti.display import Medians
from leafflow_ti.field import WITHOUT_STD
from leafflow_ti.panels import shown_in
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

    ``spread``: the 16th and 84th percentile of the pixels [2, n]; None where they are not known.
    """

    name: str
    x: Floats
    mean: Floats
    error: Floats
    spread: Floats | None = None

    def overall(self) -> tuple[float, float] | None:
        """Mean over the frames and its standard error; None without any value.

        Neighbouring frames share images, so their errors are taken as the same, which is safe: the error of the mean
        is the mean of the errors.
        """
        known = np.isfinite(self.mean) & np.isfinite(self.error)
        return (float(self.mean[known].mean()), float(self.error[known].mean())) if known.any() else None


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
        growth = tuple(_course(store, name, done) for name in GROWTH if name in store.names)
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
    for name in (n for n in store.names if not n.endswith("_std") and n not in WITHOUT_STD):
        values = np.concatenate([store.read(name, t) for t in frames])
        if not np.isfinite(values).any():
            continue
        std = f"{name}_std"
        errors = np.concatenate([store.read(std, t) for t in frames]) if std in store.names else None
        unit, factor = shown_in(name, store.interval_s)
        found.append(Precision(name, unit, Medians.of(values * factor, None if errors is None else errors * factor)))
    return found


def mean_and_error(values: Floats, std: Floats, correlation: NoiseCorrelation) -> tuple[float, float]:
    """Mean of a map [y, x] over the pixels that have a value and a finite standard error, and the error of that mean.

    The variance is Σ_ij σ_i σ_j R_ij / n², R the product of ``correlation`` along y and x. NaN, NaN without a pixel.
    """
    known = np.isfinite(values) & np.isfinite(std)
    n = int(known.sum())
    if not n:
        return np.nan, np.nan
    sigma = np.where(known, std, 0.0)
    rows, columns = (correlation.between(axis, size) for axis, size in zip("yx", sigma.shape, strict=True))
    variance = float((sigma * (rows @ sigma @ columns)).sum()) / n**2
    return float(values[known].mean()), float(np.sqrt(max(variance, 0.0)))


def _course(store: ResultStore, name: str, done: Floats) -> Series:
    _, factor = shown_in(name, store.interval_s)
    correlation = NoiseCorrelation.of(store)
    n = len(store.frames)
    mean, error, spread = np.full(n, np.nan), np.full(n, np.nan), np.full((2, n), np.nan)
    for t in np.flatnonzero(done):
        values, std = (store.read(key, int(t)).astype(np.float64) for key in (name, f"{name}_std"))
        values[store.read("status", int(t)) != Status.OK] = np.nan  # others have errors of another kind
        mean[t], error[t] = mean_and_error(values, std, correlation)
        known = values[np.isfinite(values) & np.isfinite(std)]
        if known.size:
            spread[:, t] = np.percentile(known, (16, 84))
    return Series(name.replace("_", " "), np.array(store.frames, float), mean * factor, error * factor, spread * factor)
