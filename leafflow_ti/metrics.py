"""How far a measurement is from the truth: angular errors, robust summaries, coverage of the error bars.

Arrays in, numbers out. Maps are ``[H, W]`` or ``[H, W, 2 or 3]`` in the units of the results store (mm, px, frames,
rad) and carry its names; NaN means no estimate, or no truth, and is left out.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from leafflow_ti.errors import InputError
from leafflow_ti.field import PRINCIPAL_NAMES, STRAIN_NAMES, SURFACE_PRINCIPAL_NAMES, SURFACE_STRAIN_NAMES

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Maps = Mapping[str, NDArray[Any]]

TRUTH_MAPS: dict[str, int | None] = {
    "depth": None,
    "zx": None,
    "zy": None,
    "velocity": 3,
    "omega": 3,
    "acceleration": 3,
    "flow": 2,
    "growth_rate": None,
    "strain_rate": 3,
    "surface_strain": 3,
}
"""Key of ``truth.npz`` -> components per pixel; None: a plain map."""

LABELS = ("face", "region")
"""Keys of ``truth.npz`` with integer labels per pixel."""
INTERIOR = ", interior"
"""How the names of regions without their borders end."""

SCALARS = {
    "depth": "depth",
    "slope_x": "zx",
    "slope_y": "zy",
    "growth_rate": "growth_rate",
    "area_rate": "growth_rate",
}
VECTORS = {"velocity": "velocity", "rotation": "omega", "acceleration": "acceleration", "flow": "flow"}
"""Map, or stem of the maps ``_x, _y[, _z]``, of the results -> key of the truth."""

TENSORS = {
    "strain_rate": (STRAIN_NAMES, PRINCIPAL_NAMES),
    "surface_strain": (SURFACE_STRAIN_NAMES, SURFACE_PRINCIPAL_NAMES),
}
"""Key of the truth -> maps of its components 11, 22, 12, and of its principal values and their direction."""

ISOTROPIC = 1e-6
"""Difference of principal strains [%/frame] below which the truth has no principal direction."""

ENDPOINT_UNITS = {"velocity": "mm", "flow": "px"}
"""Vectors whose distance to the truth is reported too, and its unit (per frame)."""


@dataclass(frozen=True)
class Summary:
    """Of ``n`` errors: mean, standard deviation, median, and median and 95 % quantile of the absolute values."""

    n: int
    mean: float
    std: float
    median: float
    median_abs: float
    p95_abs: float


@dataclass(frozen=True)
class Coverage:
    """Of ``n`` values (estimate - truth) / standard error: mean and standard deviation (ideally 0 and 1), and the
    shares within one and two standard errors (68.3 % and 95.4 % of normal errors)."""

    n: int
    mean: float
    std: float
    within_1: float
    within_2: float


@dataclass(frozen=True)
class RegionReport:
    """One region: its pixels with truth, and by name the errors (unit at the end of the name) and the coverage."""

    pixels: int
    errors: dict[str, Summary]
    coverage: dict[str, Coverage]


def aae(v: ArrayLike, w: ArrayLike) -> Array:
    """Angle [...] in degrees between ``(v, 1)`` and ``(w, 1)``, v and w [..., n] (Schuchert 2010, Eq. (A.2)).

    The mean over pixels is the average angular error, of optical flow (n = 2) and of 3D motion (n = 3).
    """
    return angle(_with_one(v), _with_one(w))


def angle(a: ArrayLike, b: ArrayLike) -> Array:
    """Angle [...] in degrees between vectors [..., n]; exact for small angles, where the arc cosine is not."""
    p, q = _unit(a), _unit(b)
    half = np.arctan2(np.linalg.norm(p - q, axis=-1), np.linalg.norm(p + q, axis=-1))
    return np.asarray(np.degrees(2.0 * half))


def endpoint_error(v: ArrayLike, w: ArrayLike) -> Array:
    """Distance [...] between vectors [..., n], in their unit."""
    return np.asarray(np.linalg.norm(np.asarray(v, np.float64) - np.asarray(w, np.float64), axis=-1))


def normal_error(zx: ArrayLike, zy: ArrayLike, zx_true: ArrayLike, zy_true: ArrayLike) -> Array:
    """Angle [...] in degrees between the surface normals ``(-ZX, -ZY, 1)``."""
    return aae(np.stack([zx, zy], axis=-1), np.stack([zx_true, zy_true], axis=-1))


def principal(strain: ArrayLike) -> Array:
    """Largest and smallest value and direction [..., 3] of symmetric tensors (11, 22, 12) [..., 3].

    The direction of the largest is an angle in rad, -π/2 to π/2, from axis 1 towards axis 2; NaN if both are alike.
    """
    s11, s22, s12 = np.moveaxis(np.asarray(strain, np.float64), -1, 0)
    mean, half, angle = 0.5 * (s11 + s22), np.hypot(0.5 * (s11 - s22), s12), 0.5 * np.arctan2(2.0 * s12, s11 - s22)
    return np.stack([mean + half, mean - half, np.where(2.0 * half < ISOTROPIC, np.nan, angle)], axis=-1)


def _nearest_turn(angles: Array, to: Array) -> Array:
    """Directions ``angles`` [rad], which are the same after half a turn, as they are nearest to those of ``to``."""
    return np.asarray(to + (angles - to + 0.5 * np.pi) % np.pi - 0.5 * np.pi)


def summarise(errors: ArrayLike) -> Summary | None:
    """Summary of the finite values; None if there is none."""
    e = np.asarray(errors, np.float64)
    e = e[np.isfinite(e)]
    if e.size == 0:
        return None
    size = np.abs(e)
    numbers = (e.mean(), e.std(), np.median(e), np.median(size), np.quantile(size, 0.95))
    return Summary(int(e.size), *(float(number) for number in numbers))


def coverage(estimate: ArrayLike, truth: ArrayLike, std: ArrayLike) -> Coverage | None:
    """How well ``std`` describes the errors; None where nothing has an estimate, a truth and a positive error bar."""
    estimate, truth, std = np.broadcast_arrays(*(np.asarray(u, np.float64) for u in (estimate, truth, std)))
    valid = std > 0.0
    z = (estimate[valid] - truth[valid]) / std[valid]
    z = z[np.isfinite(z)]
    if z.size == 0:
        return None
    within = (float(np.mean(np.abs(z) <= k)) for k in (1.0, 2.0))
    return Coverage(int(z.size), float(z.mean()), float(z.std()), *within)


def evaluate(estimate: Maps, truth: Maps, regions: Mapping[str, Mask]) -> dict[str, RegionReport]:
    """Errors of the maps ``estimate`` against ``truth`` on the same pixels, in every region that has truth.

    ``estimate``: maps [h, w] named as in the results store (``depth``, ``velocity_x``, ..., standard errors as
    ``NAME_std``). ``truth``: as from ``read_truth``, at the same pixels. ``regions``: name -> mask [h, w].
    Slopes are compared as angles of inclination, principal directions modulo half a turn. Raises InputError if they
    have no quantity, or no pixel, in common.
    """
    pairs = list(_pairs(estimate, truth))
    if not pairs:
        held = ", ".join(estimate) or "no maps"
        raise InputError(f"nothing to compare: the results hold {held}; the truth holds {', '.join(truth)}")
    errors = dict(_errors(estimate, truth))
    known = np.logical_or.reduce([np.isfinite(true) for _, _, true in pairs])
    reports = {}
    for region, mask in regions.items():
        inside = mask & known
        if not inside.any():
            continue
        summaries = {name: summarise(values[inside]) for name, values in errors.items()}
        coverages = {
            name: coverage(found[inside], true[inside], estimate[f"{name}_std"][inside])
            for name, found, true in pairs
            if f"{name}_std" in estimate
        }
        reports[region] = RegionReport(
            int(np.count_nonzero(inside)),
            {name: value for name, value in summaries.items() if value is not None},
            {name: value for name, value in coverages.items() if value is not None},
        )
    if not reports:
        raise InputError(
            f"no pixel of {', '.join(regions) or 'no region'} has truth: compare the frame and area it covers"
        )
    return reports


def label_regions(truth: Maps, margin: int) -> dict[str, Mask]:
    """Masks [H, W]: ``all``, and for every label but 0 its pixels, whole and those ``margin`` px inside it.

    Windows near a border of two surfaces see both; ``face 1, interior`` leaves them out.
    """
    shape = map_shape(truth)
    regions = {"all": np.ones(shape, np.bool_)}
    for key in LABELS:
        if key not in truth:
            continue
        for label in np.unique(truth[key]):
            if label != 0:
                mask = np.asarray(truth[key] == label)
                regions[f"{key} {label}"] = mask
                if margin > 0:
                    regions[f"{key} {label}{INTERIOR}"] = erode(mask, margin)
    return regions


def erode(mask: Mask, margin: int) -> Mask:
    """Pixels of ``mask`` [H, W] without a pixel of the complement within ``margin`` px along x and y."""
    missing = np.pad(~mask, margin).astype(np.int64)
    for axis in (0, 1):
        total = np.insert(np.cumsum(missing, axis=axis), 0, 0, axis=axis)
        high = np.take(total, range(2 * margin + 1, total.shape[axis]), axis=axis)
        missing = high - np.take(total, range(high.shape[axis]), axis=axis)
    return np.asarray(missing == 0)


def read_truth(path: str | Path) -> dict[str, NDArray[Any]]:
    """The arrays of a ``truth.npz``; an ``omega`` [3] is spread over the pixels that have another truth.

    Raises InputError if the file cannot be read, holds nothing to compare with, or shapes disagree.
    """
    path = Path(path)
    try:
        # Opened as what it must be: np.load would also take a lone array or try a pickle.
        with path.open("rb") as stream, np.lib.npyio.NpzFile(stream, allow_pickle=False) as archive:
            truth = {key: archive[key] for key in archive.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: no readable truth.npz ({' '.join(str(error).split())})") from error
    if not any(key in truth for key in TRUTH_MAPS):
        raise InputError(f"{path}: holds {', '.join(truth) or 'nothing'}, but none of {', '.join(TRUTH_MAPS)}")
    shape = map_shape(truth, path)
    if "omega" in truth and truth["omega"].shape == (3,):
        truth["omega"] = np.where(_has_truth(truth, shape)[..., None], truth["omega"], np.nan)
    for key, components in (*TRUTH_MAPS.items(), *dict.fromkeys(LABELS).items()):
        wanted = shape if components is None else (*shape, components)
        if key in truth and truth[key].shape != wanted:
            raise InputError(f"{path}: {key} has the shape {truth[key].shape}, {wanted} is needed")
    for key in LABELS:
        if key in truth and not np.issubdtype(truth[key].dtype, np.integer):
            raise InputError(f"{path}: {key} holds {truth[key].dtype} numbers, labels are integers")
    return truth


def map_shape(truth: Maps, path: Path | None = None) -> tuple[int, int]:
    """Height and width of the truth's maps; InputError (naming ``path``) if it has no map."""
    for key in (*TRUTH_MAPS, *LABELS):
        if key in truth and truth[key].ndim >= 2:
            height, width = truth[key].shape[:2]
            return height, width
    raise InputError(f"{path or 'truth'}: has no map per pixel: add depth or velocity")


def sample_maps(truth: Maps, y: NDArray[np.integer], x: NDArray[np.integer]) -> dict[str, NDArray[Any]]:
    """The truth's maps at the rows ``y`` and columns ``x`` of a result; other keys are left out.

    Raises InputError if a position lies outside.
    """
    height, width = map_shape(truth)
    if y.size and x.size and (min(y.min(), x.min()) < 0 or y.max() >= height or x.max() >= width):
        raise InputError(
            f"results reach pixel ({x.max()}, {y.max()}), the truth has {width} x {height}: not the same images"
        )
    return {key: np.asarray(truth[key])[np.ix_(y, x)] for key in (*TRUTH_MAPS, *LABELS) if key in truth}


def _pairs(estimate: Maps, truth: Maps) -> Iterator[tuple[str, Array, Array]]:
    """(name, estimate, truth) [h, w] of every map that both have."""
    for name, key in SCALARS.items():
        if name in estimate and key in truth:
            yield name, np.asarray(estimate[name], np.float64), np.asarray(truth[key], np.float64)
    for stem, key in VECTORS.items():
        for k, axis in enumerate("xyz"[: TRUTH_MAPS[key]]):
            name = f"{stem}_{axis}"
            if name in estimate and key in truth:
                yield name, np.asarray(estimate[name], np.float64), np.asarray(truth[key][..., k], np.float64)
    for key, (components, (*values, direction)) in TENSORS.items():
        if key not in truth:
            continue
        true = np.asarray(truth[key], np.float64)
        known = np.concatenate([true, principal(true)], axis=-1)
        for k, name in enumerate((*components, *values, direction)):
            if name in estimate:
                found = np.asarray(estimate[name], np.float64)
                yield name, _nearest_turn(found, known[..., k]) if name == direction else found, known[..., k]


def _errors(estimate: Maps, truth: Maps) -> Iterator[tuple[str, Array]]:
    """(name with unit, error map [h, w]) of every quantity that both have whole."""
    found = {name: (value, true) for name, value, true in _pairs(estimate, truth)}
    for stem, key in VECTORS.items():
        names = [f"{stem}_{axis}" for axis in "xyz"[: TRUTH_MAPS[key]]]
        if all(name in found for name in names):
            v, w = (np.stack([found[name][side] for name in names], axis=-1) for side in (0, 1))
            yield f"{stem}_aae_deg", aae(v, w)
            if stem in ENDPOINT_UNITS:
                yield f"{stem}_endpoint_{ENDPOINT_UNITS[stem]}", endpoint_error(v, w)
    if "depth" in found:
        yield "depth_mm", found["depth"][0] - found["depth"][1]
    for name in ("slope_x", "slope_y"):
        if name in found:
            yield f"{name}_deg", np.degrees(np.arctan(found[name][0]) - np.arctan(found[name][1]))
    if "slope_x" in found and "slope_y" in found:
        (zx, zx_true), (zy, zy_true) = found["slope_x"], found["slope_y"]
        yield "normal_deg", normal_error(zx, zy, zx_true, zy_true)
    strains = (name for components, (*values, _) in TENSORS.values() for name in (*components, *values))
    for name in ("growth_rate", "area_rate", *strains):
        if name in found:
            yield f"{name}_percent", found[name][0] - found[name][1]
    for _, (*_, direction) in TENSORS.values():
        if direction in found:
            yield f"{direction}_deg", np.degrees(found[direction][0] - found[direction][1])


def _has_truth(truth: Maps, shape: tuple[int, int]) -> Mask:
    """Pixels [H, W] where some map is finite; all of them if omega is all there is."""
    maps = [truth[key] for key in TRUTH_MAPS if key in truth and key != "omega" and truth[key].shape[:2] == shape]
    if not maps:
        return np.ones(shape, np.bool_)
    return np.asarray(np.logical_or.reduce([np.isfinite(m).reshape(*shape, -1).any(axis=-1) for m in maps]))


def _unit(v: ArrayLike) -> Array:
    v = np.asarray(v, np.float64)
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def _with_one(v: ArrayLike) -> Array:
    v = np.asarray(v, np.float64)
    return np.concatenate([v, np.ones((*v.shape[:-1], 1))], axis=-1)
