"""What is measured of one region in one frame: area, attitude, and the means of maps with their standard errors.

Means are over the pixels with the status ``ok``, weighted by the area of the surface that a pixel sees,

    dA = |∂s/∂x × ∂s/∂y|,   s = Z r   (r the viewing ray)

or, without a depth, alike; pixels less certain than most count less (``certain``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import InputError
from leafflow_ti.field import CORRELATIONS, MOTION_NAMES, Field, with_std
from leafflow_ti.labels import Coverage
from leafflow_ti.mesh import slope_normals, viewing_rays
from leafflow_ti.region_divergence import differenced, divergence_variance, fitted
from leafflow_ti.region_noise import RegionNoise, mean_variance
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

Floats = NDArray[np.float64]


_ALWAYS = (*with_std(("depth", "slope_x", "slope_y", *MOTION_NAMES[:3])), *CORRELATIONS)
"""Maps that areas, and the standard errors of mean growth, follow from."""


def measured(store: ResultStore, t: int, names: Sequence[str]) -> Field:
    """The maps ``names`` of the frame with index ``t``, as far as the store has them, with their standard errors and
    what ``region_row`` needs beside them; NaN but for pixels with the status ok."""
    status = store.read("status", t)
    wanted = [name for name in dict.fromkeys((*with_std(names), *_ALWAYS)) if name in store.names]
    maps = {name: np.where(status == Status.OK, store.read(name, t), np.float32(np.nan)) for name in wanted}
    return Field(maps, status, store.y, store.x, store.frames[t], store.attrs)


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


@dataclass(frozen=True, eq=False)
class _Part:
    """A region and what is around it in one frame: ``maps`` [y, x] in float64, ``rays`` [y, x, 3] (None without a
    geometry), ``weights`` [y, x], 0 beyond the region and where nothing is measured; index ``t`` of so many frames."""

    maps: Mapping[str, Floats]
    rays: Floats | None
    weights: Floats
    t: int
    frames: int
    focal: float
    noise: RegionNoise

    def error(self, name: str, weights: Floats) -> float:
        """Standard error of the mean of the map ``name`` with the ``weights``; NaN where pixels have none."""
        std = self.maps.get(f"{name}_std")
        if std is None or not np.isfinite(std[weights > 0]).all():
            return np.nan
        share = weights / weights.sum()
        variance = self._divergence(name, share)
        if variance is None:
            variance = mean_variance(share, std, self.noise.terms(name, self.maps))
        return float(np.sqrt(variance))

    def _divergence(self, name: str, share: Floats) -> float | None:
        """Variance of a growth that follows from the motions of different windows; None for anything else."""
        noise = self.noise
        from_motion = name == "area_rate" or (name == "growth_rate" and not noise.refined)
        if not from_motion or noise.gradient is None or self.rays is None:
            return None
        adjoint = fitted(noise.reach) if name == "area_rate" else differenced
        found = divergence_variance(share, self.maps, self.rays, self.focal, adjoint, noise.value)
        return found if found is None or name != "area_rate" else found * noise.averaging(self.t, self.frames)


def region_row(
    field: Field, area: Floats, place: Coverage | None, names: tuple[str, ...], noise: RegionNoise, t: int, frames: int
) -> dict[str, float]:
    """What is measured of one region in one frame."""
    if place is None or not place.pixels:
        return {"pixels": 0.0, "valid_share": np.nan}
    cut, share = _around(place, noise.margin, field.shape)
    valid = (share > 0) & (field.status[cut] == Status.OK) & np.isfinite(area[cut])
    row = {"pixels": float(place.pixels), "valid_share": float(share[valid].sum() / share.sum())}
    if not valid.any():
        return row
    rays, focal = None, 1.0
    if "depth" in field:
        pitch = field.x[1] - field.x[0] if field.x.size > 1 else 1
        rays, focal = viewing_rays(field)[cut], float(field.attrs["plan"]["f_px"]) / float(pitch)
    maps = {name: field[name][cut].astype(np.float64) for name in field}
    part = _Part(maps, rays, np.where(valid, share * area[cut], 0.0), t, frames, focal, noise)
    if "depth" in field:
        row |= _area(part, row["valid_share"]) | _attitude(part)
    for name in names:
        row |= _mean(name, part)
    return row


def _around(place: Coverage, margin: int, shape: tuple[int, int]) -> tuple[tuple[slice, slice], Floats]:
    """The cut of a region and so many rows and columns around it, and the region's share there."""
    wide = [slice(max(0, c.start - margin), min(n, c.stop + margin)) for c, n in zip(place.cut, shape, strict=True)]
    pad = [(c.start - w.start, w.stop - c.stop) for c, w in zip(place.cut, wide, strict=True)]
    return (wide[0], wide[1]), np.pad(place.share, pad)


def _area(part: _Part, share: float) -> dict[str, float]:
    """Area of a region, and its error from that of the depth."""
    measured = float(part.weights.sum())
    found = {"area_mm2": measured / share, "area_se_mm2": np.nan, "area_measured_mm2": measured}
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.where(part.weights > 0, 2 * part.weights / part.maps["depth"], 0.0)
    found["area_se_mm2"] = part.error("depth", change) * float(change.sum()) / share
    return found


def _attitude(part: _Part) -> dict[str, float]:
    """Unit normal of the mean surface towards the camera, and its tilt with the error from that of the slopes."""
    if "slope_x" not in part.maps or "slope_y" not in part.maps:
        return {}
    normals = slope_normals(part.maps["slope_x"], part.maps["slope_y"])
    weights = np.where(np.isfinite(normals).all(axis=-1), part.weights, 0.0)
    total = (weights[..., None] * np.where(weights[..., None] > 0, normals, 0.0)).sum(axis=(0, 1))
    length = float(np.linalg.norm(total))
    if not length:
        return {}
    x, y, z = (float(v) for v in total / length)
    across = float(np.hypot(x, y))
    # tan(tilt) = |(ZX, ZY)|: errors of the slopes along that direction.
    direction = (x / across, y / across) if across > 0 else (np.sqrt(0.5), np.sqrt(0.5))
    errors = [d * part.error(name, weights) for d, name in zip(direction, ("slope_x", "slope_y"), strict=True)]
    return {
        "normal_x": x, "normal_y": y, "normal_z": z, "tilt_deg": float(np.degrees(np.arctan2(across, -z))),
        "tilt_se_deg": float(np.degrees(np.hypot(*errors) * z**2)),
    }  # fmt: skip


def certain(std: Floats) -> Floats:
    """Weights of pixels with these standard errors [y, x], 0 where they are not finite.

    All that are as good as the median count alike, so that a mean is one over the surface, not over its sharpest
    texture; worse ones count less, as 1/std², so that a few bad ones cannot spoil it.
    """
    known = np.isfinite(std) & (std > 0)
    if not known.any():
        return np.zeros(std.shape)
    return np.where(known, np.minimum(1.0, np.median(std[known]) / np.where(known, std, 1.0)) ** 2, 0.0)


def _mean(name: str, part: _Part) -> dict[str, float]:
    """Mean, its standard error and the standard deviation of one map over a region, in the map's own unit."""
    known = np.isfinite(part.maps[name])
    weights = np.where(known, part.weights, 0.0)
    if f"{name}_std" in part.maps:
        weights *= certain(np.where(known & (weights > 0), part.maps[f"{name}_std"], np.nan))
    if not weights.any():
        return {}
    share, values = weights / weights.sum(), np.where(known, part.maps[name], 0.0)
    mean = float((share * values).sum())
    spread = float(np.sqrt((share * (values - mean) ** 2).sum()))
    return {name: mean, f"{name}_se": part.error(name, weights), f"{name}_sd": spread}
