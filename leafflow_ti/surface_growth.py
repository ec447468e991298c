"""Growth from the motion of a finished run: maps of surface strain and area rate, added to its results store.

They are a second measure beside ``growth_rate``, which the run finds within each window: here the motions of different
windows are compared (see ``deformation``). Where both are right they agree within their errors. The refinement's own
rates are the more precise ones; these need no refinement, and no unknown for growth.

Averaging over frames is of the strain at a pixel, frame by frame: material that moves by less than the window of the
strain in that time is averaged over itself. The errors of near frames are correlated, those of frames some way apart
negatively, and what is left of them follows from the correlation that the run states. Maps of the run itself are left
as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.correlation import KEY, NoiseCorrelation, velocity_covariance
from leafflow_ti.deformation import Gauge, MovingSurface, Strain, measure_strain
from leafflow_ti.errors import InputError, UsageError
from leafflow_ti.field import CORRELATIONS, MOTION_NAMES, SURFACE_NAMES, Field, with_std
from leafflow_ti.mesh import Neighbours, surface_points, viewing_rays
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

Array = NDArray[np.float64]

ATTRIBUTE = "growth"
"""Attribute of the store: the settings."""
VELOCITY = MOTION_NAMES[:3]
_NEEDED = ("depth", *with_std(VELOCITY), *CORRELATIONS)
_WANTED = ("slope_x", "slope_y", "growth_rate", "growth_rate_std")


@dataclass(frozen=True)
class MapSummary:
    """Of a map: ``median`` and ``median_std`` over pixels, and of these over frames; ``share`` [0..1] of the measured
    pixels that have a value."""

    median: float
    median_std: float
    share: float


@dataclass(frozen=True)
class Agreement:
    """``growth_rate - area_rate`` by their combined standard error: ``mean`` and ``std`` over ``pixels``."""

    pixels: int
    mean: float
    std: float


@dataclass(frozen=True)
class GrowthSummary:
    """What ``measure_growth`` has written. ``window_px``: side of the strain window; ``frames``: how many; ``average``:
    over how many of them each result is; ``agreement``: None where the run has no growth rate."""

    path: str
    window_px: int
    average: int
    frames: int
    interval_s: float | None
    maps: dict[str, MapSummary]
    agreement: Agreement | None

    def to_json(self) -> dict[str, Any]:
        """The same as JSON values."""
        return asdict(self)


def measure_growth(
    store: ResultStore | str | Path,
    strain_window: int | None = None,
    average: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> GrowthSummary:
    """Add maps of area rate and surface strain, ``field.SURFACE_NAMES``, to a finished store, in place.

    ``strain_window``: side of the window in px; None: such that it holds nine estimates, three by three, whose errors
    are independent. ``average``: frames around each that its results are the mean of, odd; fewer at the ends.
    ``progress(done, frames)`` is called after every frame. Maps of an earlier call are replaced.

    Raises InputError for a store without motion in space or its correlations, UsageError for a window or an average
    that does not fit, RunError for a run that is not finished, or a store that somebody else writes.
    """
    store = store if isinstance(store, ResultStore) else ResultStore.open(store)
    noise = _correlation(store)
    gauge = _gauge(store, noise, strain_window)
    _check_average(average, len(store.frames))
    summary = _Summary()
    with store.alone():
        store = store.add_maps(with_std(SURFACE_NAMES))
        for t_index, (strain, rate, std) in enumerate(_averaged(store, gauge, noise, average)):
            maps = strain.maps()
            store.write_maps(t_index, {name: values.astype(np.float32) for name, values in maps.items()})
            summary.add(maps, rate, std)
            if progress:
                progress(t_index + 1, len(store.frames))
        store.finish_maps({ATTRIBUTE: {"strain_window_px": gauge.side, "average_frames": average}})
    found = summary.maps(), summary.agreement()
    return GrowthSummary(str(store.path), gauge.side, average, len(store.frames), store.interval_s, *found)


def _correlation(store: ResultStore) -> NoiseCorrelation:
    """What the run states; InputError where the store does not hold what is needed."""
    missing = [name for name in ("depth", *VELOCITY) if name not in store.names]
    if missing:
        raise InputError(
            f"{store.path}: has no '{missing[0]}', so no motion in space: measure a camera grid over several frames"
        )
    noise = NoiseCorrelation.of(store)
    missing = [name for name in _NEEDED if name not in store.names]
    if missing or not noise.stated:
        lacking = f"map '{missing[0]}'" if missing else f"attribute '{KEY}'"
        raise InputError(
            f"{store.path}: has no {lacking}, without which errors of the strain are not known: run again with "
            "--overwrite, and with all arrays"
        )
    return noise


def default_window(noise: NoiseCorrelation, pitch: int) -> int:
    """Side [px] of the window that holds three by three estimates whose errors are independent."""
    return 2 * max(noise.independent("x"), noise.independent("y")) * pitch + 1


def _gauge(store: ResultStore, noise: NoiseCorrelation, window: int | None) -> Gauge:
    sizes = [int(axis[-1] - axis[0]) + 1 for axis in (store.x, store.y)]
    pitch = int(store.x[1] - store.x[0]) if store.x.size > 1 else 1
    least = 2 * pitch + 1
    if min(sizes) < least:
        raise InputError(
            f"{store.path}: covers {sizes[0]} x {sizes[1]} px, pixel by {pitch}th pixel: strain needs three along each "
            "axis: measure a larger region, or with a smaller --stride"
        )
    if window is None:
        window = min(default_window(noise, pitch), *sizes)
    if window < least:
        raise UsageError(
            f"strain window {window} px: the results are {pitch} px apart, so a window of less than {least} px holds "
            f"no neighbours: choose --strain-window {least} at least, or run with a smaller --stride"
        )
    if window > min(sizes):
        raise UsageError(
            f"strain window {window} px: the results cover {sizes[0]} x {sizes[1]} px: choose --strain-window "
            f"{min(sizes)} at most"
        )
    return Gauge.of(window, pitch)


def _check_average(average: int, frames: int) -> None:
    if average < 1 or average % 2 == 0:
        raise UsageError(f"average {average}: choose an odd number of frames, each with as many before as behind")
    if average > 1 and average > frames:
        most = frames - (frames + 1) % 2
        raise UsageError(f"average {average}: the results hold {frames} frames: choose --average {most} at most")


def _averaged(
    store: ResultStore, gauge: Gauge, noise: NoiseCorrelation, average: int
) -> Iterator[tuple[Strain, Array, Array]]:
    """Strain of each frame, and the run's growth rate with its standard error, as means over the frames around it."""
    half, end = average // 2, len(store.frames)
    attrs = store.attrs
    kept: dict[int, tuple[Strain, Array, Array]] = {}
    for t in range(end):
        around = range(max(0, t - half), min(end, t + half + 1))
        kept = {s: kept[s] if s in kept else _frame(store, s, attrs, gauge, noise) for s in around}
        strains, rates, errors = zip(*(kept[s] for s in around), strict=True)
        correlation, centre = noise.between("t", [store.frames[s] for s in around]), t - around.start
        rate, variance = mean_over_frames(rates, [std**2 for std in errors], correlation, centre)
        yield _mean_strain(strains, correlation, centre), rate, np.sqrt(variance)


def _mean_strain(strains: Sequence[Strain], correlation: Array, centre: int) -> Strain:
    tensor, covariance = mean_over_frames(
        [s.tensor for s in strains], [s.covariance for s in strains], correlation, centre
    )
    area, variance = mean_over_frames([s.area for s in strains], [s.area_std**2 for s in strains], correlation, centre)
    return Strain(tensor, covariance, area, np.sqrt(variance))


def mean_over_frames(
    values: Sequence[Array], variances: Sequence[Array], correlation: Array, centre: int
) -> tuple[Array, Array]:
    """Mean over frames [T] of ``values`` [h, w, ...], and its variance from ``variances`` [h, w, ...] (of more axes for
    covariances) and the ``correlation`` [T, T] of their errors.

    Frames without a value at a pixel are left out there; where the frame ``centre`` itself has none, so has the mean,
    with that frame's errors.
    """
    h, w = values[0].shape[:2]
    there = np.stack([np.isfinite(v).reshape(h, w, -1).all(axis=-1) for v in variances])
    n = there.sum(axis=0)
    known = there[centre]
    weights = np.where(known, there / np.maximum(n, 1), 0.0)
    share = np.einsum("thw,tu,uhw->hw", weights, correlation, weights, optimize=True)

    def mean(maps: Sequence[Array]) -> Array:
        total = np.zeros_like(maps[0])
        for one, weight in zip(maps, weights, strict=True):
            axes = (..., *[None] * (one.ndim - 2))
            total += np.where(weight[axes] > 0, one, 0.0) * weight[axes]
        return total

    def chosen(found: Array, centre_map: Array) -> Array:
        return np.where(known[(..., *[None] * (found.ndim - 2))], found, centre_map)

    value, variance = mean(values), mean(variances)
    variance = variance * np.maximum(share, 0.0)[(..., *[None] * (variance.ndim - 2))]
    return chosen(value, values[centre]), chosen(variance, variances[centre])


def _frame(
    store: ResultStore, t_index: int, attrs: dict[str, Any], gauge: Gauge, noise: NoiseCorrelation
) -> tuple[Strain, Array, Array]:
    """Strain of one frame, and the run's growth rate and its standard error (NaN where there is none)."""
    names = (*_NEEDED, *(name for name in _WANTED if name in store.names))
    maps = {name: store.read(name, t_index) for name in names}
    field = Field(maps, store.read("status", t_index), store.y, store.x, store.frames[t_index], attrs)
    strain = strain_of(field, gauge, noise)
    if "growth_rate_std" not in field or "growth_rate" not in field:
        nothing = np.full(field.shape, np.nan)
        return strain, nothing, nothing
    return strain, field["growth_rate"].astype(np.float64), field["growth_rate_std"].astype(np.float64)


def strain_of(field: Field, gauge: Gauge, noise: NoiseCorrelation) -> Strain:
    """The strain of one frame [y, x]; ``field`` holds the depth and the velocity with its errors and correlations."""
    points = surface_points(field)
    slopes = None
    if "slope_x" in field and "slope_y" in field:
        slopes = field["slope_x"].astype(np.float64), field["slope_y"].astype(np.float64)
    neighbours, every, low, high = Neighbours(points, slopes), slice(None), slice(None, -1), slice(1, None)
    velocity = np.stack([field[name] for name in VELOCITY], axis=-1).astype(np.float64)
    # Errors of other pixels (not refined, between surfaces) have another size and correlation.
    velocity[field.status != Status.OK] = np.nan
    surface = MovingSurface(
        points, velocity, velocity_covariance(field), viewing_rays(field),
        neighbours.joined((low, every), (high, every)), neighbours.joined((every, low), (every, high)),
        float(field.attrs["plan"]["f_px"]),
    )  # fmt: skip
    steps = np.arange(gauge.across) * gauge.thin
    return measure_strain(surface, gauge, noise.between("y", steps), noise.between("x", steps))


class _Summary:
    """Gathers frame by frame what a ``GrowthSummary`` says."""

    def __init__(self) -> None:
        self._frames: list[dict[str, tuple[float, float, float]]] = []
        self._deviations: list[tuple[int, float, float]] = []

    def add(self, maps: dict[str, Array], rate: Array, std: Array) -> None:
        """The maps of a frame, and the run's growth rate."""
        measured = max(int(np.sum(~np.isnan(maps["area_rate_std"]))), 1)
        found = {}
        for name in SURFACE_NAMES:
            known = np.isfinite(maps[name]) & np.isfinite(maps[f"{name}_std"])
            if known.any():
                value, std_of = (float(np.median(maps[n][known])) for n in (name, f"{name}_std"))
                found[name] = value, std_of, float(known.sum()) / measured
        self._frames.append(found)
        with np.errstate(invalid="ignore"):
            deviation = (rate - maps["area_rate"]) / np.hypot(std, maps["area_rate_std"])
        deviation = deviation[np.isfinite(deviation)]
        self._deviations.append((deviation.size, float(deviation.sum()), float(np.sum(deviation**2))))

    def maps(self) -> dict[str, MapSummary]:
        """Medians over frames, of the maps that have a value anywhere."""
        found = {}
        for name in SURFACE_NAMES:
            of = [frame[name] for frame in self._frames if name in frame]
            if of:
                median, std, share = np.median(np.array(of), axis=0)
                found[name] = MapSummary(float(median), float(std), float(share))
        return found

    def agreement(self) -> Agreement | None:
        """Of all pixels and frames; None where nothing can be compared."""
        n, one, two = np.sum(np.array(self._deviations), axis=0).tolist()
        if n < 2:
            return None
        mean = one / n
        return Agreement(int(n), mean, float(np.sqrt(max(two / n - mean**2, 0.0))))
