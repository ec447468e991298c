"""Which groups of parameters the texture determines: from standard errors to values that are there or are not.

A parameter is determined where its standard error stays below the size at which the linearised model stops to mean
anything: a displacement of 1 px, in the image or, for what grows with the distance from the pixel, at the window's rms
radius; a slope, an angle or a relative brightness of 1; half of a depth, which is an inverse. What is not determined
has no value (NaN) and an infinite standard error; other parameters of the pixel stay. Without a depth there is no
motion in space.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.field import (
    CORRELATIONS,
    FLOW_GRADIENT_NAMES,
    IDENTIFIED,
    MOTION_NAMES,
    PLANE_STRAIN_NAMES,
    QUANTITIES,
)
from leafflow_ti.status import HAS_VALUE, Status

Array = NDArray[Any]

GROUPS: dict[str, tuple[str, ...]] = {
    "depth": ("disparity", "depth"),
    "normals": ("slope_x", "slope_y"),
    "translation": MOTION_NAMES[:3],
    "rotation": MOTION_NAMES[3:6],
    "acceleration": MOTION_NAMES[6:],
    "brightness": tuple(name for name in QUANTITIES if name.startswith("brightness_")),
    "flow": ("flow_x", "flow_y"),
    "flow_gradient": (*FLOW_GRADIENT_NAMES, *PLANE_STRAIN_NAMES),
}
"""Group -> its maps."""
_NORMAL_FLOW = ("normal_flow_x", "normal_flow_y")


@dataclass(frozen=True)
class Limits:
    """Largest standard errors that leave a value. ``radius_px``: rms radius of the window; ``lever``: f times the
    baseline per camera step [px mm], 0 without cameras."""

    f_px: float
    radius_px: float
    lever: float

    def of(self, name: str, depth: Array | float) -> Array | float:
        """Limit of the map ``name`` at points of this ``depth`` [mm], in the map's unit."""
        stem, _, axis = name.rpartition("_")
        distance = np.abs(depth)
        if name == "depth":
            return np.minimum(distance / 2, distance**2 / self.lever) if self.lever else distance / 2
        if stem in ("velocity", "acceleration"):
            return distance / (self.radius_px if axis == "z" else self.f_px)
        if name in FLOW_GRADIENT_NAMES:
            return 1 / self.radius_px
        if name in PLANE_STRAIN_NAMES:  # the shear is half a sum of derivatives: not known better than either
            return (50 if name == "strain_xy" else 100) / self.radius_px
        if name in ("brightness_world_x", "brightness_world_y"):
            with np.errstate(divide="ignore"):  # no depth yet: no limit
                return self.f_px / (self.radius_px * distance)
        if stem == "rotation":
            return np.where(np.isfinite(distance), 1 / self.radius_px if axis == "z" else 1.0, np.nan)
        return 1 / self.radius_px if name in ("brightness_tx", "brightness_ty") else 1.0


def settle(maps: MutableMapping[str, Array], status: NDArray[np.uint8], limits: Limits) -> NDArray[np.uint8]:
    """Take the values away that the texture does not determine, in place; return ``field.IDENTIFIED`` bits [h, w].

    ``maps``: name -> [h, w], standard errors as ``NAME_std``. Pixels whose ``status`` [h, w] has no value are left
    alone and identify nothing. A group's bit is set where each of its maps is determined. The normal flow is for
    pixels with status aperture, others have none and no error.
    """
    measured = np.isin(status, HAS_VALUE)
    identified = np.zeros(measured.shape, np.uint8)
    depth: Array | float = np.array(maps["depth"], np.float32) if "depth" in maps else 1.0
    for group, members in GROUPS.items():
        names = [name for name in members if name in maps]
        if not names:
            continue
        whole = measured.copy()
        for name in names:
            whole &= _determined(maps, name, measured, limits.of(name, depth))
            if name == "depth":
                depth = maps["depth"]  # NaN, which no standard error is below, where it is not determined
        identified[whole] |= IDENTIFIED[group]
        for name in CORRELATIONS if group == "translation" else ():
            if name in maps:
                maps[name][measured & ~whole] = np.nan
    aperture = status == Status.APERTURE
    for name in _NORMAL_FLOW:
        if name in maps:
            _determined(maps, name, aperture, limits.of(name, depth))
            maps[name][~aperture] = maps[f"{name}_std"][~aperture] = np.nan
    return identified


def _determined(
    maps: MutableMapping[str, Array], name: str, measured: NDArray[np.bool_], limit: Array | float
) -> NDArray[np.bool_]:
    """Where a map is determined; elsewhere its value goes."""
    values, std = maps[name], maps[f"{name}_std"]
    known: NDArray[np.bool_] = np.asarray((std < limit) & np.isfinite(values))
    lost = measured & ~known
    values[lost] = np.nan
    std[lost] = np.inf
    return known
