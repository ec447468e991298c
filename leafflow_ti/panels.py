"""Which panels show a field, and what each of them draws: quick looks and reports take theirs from here.

A panel is an image of one map, of the surface normals, of the statuses, or of a motion's length with arrows on it. A
page is a group of panels that belong together.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.colours import Scale, normal_image, rgba_png, status_png
from leafflow_ti.field import (
    PLANE_STRAIN_NAMES,
    PRINCIPAL_NAMES,
    STRAIN_NAMES,
    SURFACE_PRINCIPAL_NAMES,
    SURFACE_STRAIN_NAMES,
    Field,
    quantity,
)
from leafflow_ti.rates import per_hour

SIGNED = (
    "growth_rate",
    "area_rate",
    *STRAIN_NAMES,
    *SURFACE_STRAIN_NAMES,
    *PRINCIPAL_NAMES[:2],
    *SURFACE_PRINCIPAL_NAMES[:2],
)
"""Maps whose colours diverge about zero even where all values have one sign."""
ANGLES = (PRINCIPAL_NAMES[2], SURFACE_PRINCIPAL_NAMES[2])
"""Maps of directions of axes, which repeat after half a turn, and so do their colours."""
ARROWS = 18
"""Arrows along the longer side of a motion map."""

PAGES: dict[str, tuple[str, tuple[str, ...]]] = {
    "growth": (
        "Growth",
        ("growth_rate", "growth_rate_std", *STRAIN_NAMES, *PRINCIPAL_NAMES),
    ),
    "surface": (
        "Strain from the motion",
        ("area_rate", "area_rate_std", *SURFACE_STRAIN_NAMES, *SURFACE_PRINCIPAL_NAMES),
    ),
    "strain": ("Strain in the image plane", PLANE_STRAIN_NAMES),
    "depth": ("Depth", ("depth", "depth_std", "disparity", "disparity_std")),
    "normals": ("Surface normals", ("normals", "slope_x", "slope_y")),
    "motion": ("Motion", ("velocity_x", "velocity_y", "velocity_z", "velocity")),
    "rotation": ("Rotation", ("rotation_x", "rotation_y", "rotation_z")),
    "flow": ("Optical flow", ("flow_x", "flow_y", "flow")),
    "status": ("Status and residual", ("status", "confidence")),
}
"""Page -> its title and its panels: maps, or ``normals``, ``status``, ``velocity`` and ``flow`` (with arrows)."""
OVERVIEW = (
    "depth", "disparity", "normals", "status", "velocity_x", "velocity_y", "velocity_z", "rotation_x", "rotation_y",
    "rotation_z", "flow_x", "flow_y", *PLANE_STRAIN_NAMES, "growth_rate", "area_rate",
)  # fmt: skip
"""The panels of the overview."""


@dataclass(frozen=True)
class Panel:
    """``key``: its name, that of its map where it shows one. ``interval_s``: time between frames, None if unknown."""

    key: str
    interval_s: float | None = None

    @property
    def kind(self) -> Literal["map", "arrows", "normals", "status"]:
        """What it draws."""
        match self.key:
            case "velocity" | "flow":
                return "arrows"
            case "normals":
                return "normals"
            case "status":
                return "status"
        return "map"

    @property
    def needs(self) -> tuple[str, ...]:
        """Maps that it is drawn from."""
        match self.kind:
            case "map":
                return (self.key,)
            case "arrows":
                return (f"{self.key}_x", f"{self.key}_y")
            case "normals":
                return ("slope_x", "slope_y")
            case _:
                return ()

    @property
    def title(self) -> str:
        """One line above it."""
        match self.kind:
            case "arrows":
                return f"{self.key} in the image plane"
            case "normals":
                return "surface normals"
        return quantity_title(self.key)

    @property
    def long_name(self) -> str:
        """What it shows in words; of normals and statuses, how they are coded."""
        match self.kind:
            case "map":
                return quantity(self.key)[1]
            case "arrows":
                return f"length and direction of the components of the {self.key} along x and y"
            case "normals":
                return "direction that the surface faces, as in the disc beside it"
            case _:
                return "what became of each pixel"

    @property
    def unit(self) -> str:
        """Unit of the values shown, growth and strain per hour where the time between frames is known; else empty."""
        return shown_in(self.needs[0], self.interval_s)[0] if self.kind in ("map", "arrows") else ""

    def values(self, field: Field) -> NDArray[np.floating]:
        """Values [y, x] in ``unit`` that the colours show; ValueError for normals and statuses, which have no scale."""
        match self.kind:
            case "map":
                return np.asarray(field[self.key] * shown_in(self.key, self.interval_s)[1])
            case "arrows":
                return np.asarray(np.hypot(*(field[name] for name in self.needs)))
        raise ValueError(f"{self.key} has no scale of colours")

    def scale(self, fields: Iterable[Field]) -> Scale:
        """One scale of colours for all these frames."""
        if self.key in ANGLES:
            return Scale(-np.pi / 2, np.pi / 2, "twilight")
        values = np.concatenate([self.values(field).ravel() for field in fields])
        return Scale.of(values, signed=self.key in SIGNED, error=self.key.endswith("_std"))

    def image(self, field: Field, scale: Scale | None) -> bytes:
        """The panel of one frame as a PNG file, one pixel per output pixel, transparent where there is no value.

        ``scale``: as of ``scale``; normals and statuses need none.
        """
        if self.kind == "status":
            return status_png(field.status)
        if self.kind == "normals":
            return rgba_png(normal_image(field["slope_x"], field["slope_y"]))
        assert scale is not None
        return scale.image(self.values(field))


@dataclass(frozen=True)
class Arrows:
    """Arrows on an image: their tails ``x``, ``y`` [n] in px of the image, what they span ``u``, ``v`` [n] in px."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    u: NDArray[np.float64]
    v: NDArray[np.float64]


def arrows_of(field: Field, key: str, longest: float) -> Arrows:
    """The components of ``key`` along x and y, thinned to about ``ARROWS`` along the longer side.

    An arrow of the length ``longest`` (in the map's unit) spans nine tenths of the distance between two arrows.
    """
    u, v = (np.asarray(field[f"{key}_{axis}"], np.float64) for axis in "xy")
    step = max(1, round(max(field.shape) / ARROWS))
    thin = (slice(step // 2, None, step), slice(step // 2, None, step))
    columns, rows = np.meshgrid(field.x[thin[1]], field.y[thin[0]])
    u, v = u[thin], v[thin]
    shown = np.isfinite(u) & np.isfinite(v)
    spacing = float(step * ((field.x[-1] - field.x[0]) / max(field.x.size - 1, 1) or 1.0))
    stretch = 0.9 * spacing / max(longest, 1e-12)
    return Arrows(columns[shown].astype(float), rows[shown].astype(float), u[shown] * stretch, v[shown] * stretch)


def extent(positions: NDArray[np.int64]) -> tuple[float, float]:
    """Outer edges [px] of the first and last pixel of an axis, or block of a stride."""
    step = float(positions[1] - positions[0]) if positions.size > 1 else 1.0
    return (float(positions[0]) - step / 2, float(positions[-1]) + step / 2)


def quantity_title(name: str) -> str:
    """Name of a map in words: ``depth, standard error``."""
    return name.removesuffix("_std").replace("_", " ") + ", standard error" * name.endswith("_std")


def shown_in(name: str, interval_s: float | None) -> tuple[str, float]:
    """Unit that people read the map ``name`` in, and the factor to it: growth and strain per hour where possible."""
    unit = quantity(name)[0]
    return per_hour(unit, interval_s) if unit.startswith("%") else (unit, 1.0)


def panels_of(names: Collection[str], interval_s: float | None = None) -> dict[str, list[Panel]]:
    """Page -> its panels, for results with the maps ``names``; ``overview``, of all that matters most, comes last."""
    hidden = ("disparity", "disparity_std") if "depth" in names else ()  # the same once more

    def drawable(keys: Sequence[str]) -> list[Panel]:
        panels = [Panel(key, interval_s) for key in keys]
        return [f for f in panels if all(name in names for name in f.needs) and f.key not in hidden]

    pages = {page: drawable(keys) for page, (_, keys) in PAGES.items()}
    return {**{page: found for page, found in pages.items() if found}, "overview": drawable(OVERVIEW)}
