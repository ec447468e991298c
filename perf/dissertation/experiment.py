"""What an experiment is: scenes along an abscissa, ways to measure them, and the tables and diagrams of the records."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.plane import PlaneScene

Scene = PlaneScene | CubeScene
Statistic = Literal["mean", "std", "rms"]
Pair = tuple[str, str]

STANDARD: dict[str, Any] = {"window": 65, "sigma": 19.0, "refine": 0}
"""Windows of the dissertation: 65 pixels, sigma 19; along cameras and time its 5 samples, sigma 1, are the default. Its
models are not refined."""


class Quantity(NamedTuple):
    """What is recorded: ``key`` of ``metrics.evaluate``, or the name of a map whose signed error is taken."""

    key: str
    label: str
    unit: str


QUANTITIES: dict[str, Quantity] = {
    "N": Quantity("velocity_aae_deg", "AAE of N", "deg"),
    "Omega": Quantity("rotation_aae_deg", "AAE of Ω", "deg"),
    "A": Quantity("acceleration_aae_deg", "AAE of A", "deg"),
    "normal": Quantity("normal_deg", "angle between normals", "deg"),
    "Z0": Quantity("depth_mm", "error of depth", "mm"),
    "ZY": Quantity("slope_y_deg", "error of slope along Y", "deg"),
    "RGR": Quantity("growth_rate", "relative growth rate", "%/frame"),
    "g": Quantity("brightness_t", "error of g", "1/frame"),
    "gx": Quantity("brightness_world_x", "error of dg/dX", "1/(frame mm)"),
    "g2": Quantity("brightness_world_tt", "error of 2 g2", "1/frame²"),
}
"""Short name -> what is recorded. Angular errors are those of (A.2); the others are signed."""


@dataclass(frozen=True)
class Variant:
    """One way to measure: the options of ``estimate``, those of the view left out."""

    label: str
    options: Mapping[str, Any]


@dataclass(frozen=True)
class Point:
    """One scene at abscissa ``x``; ``options`` belong to the point (a window size, say)."""

    x: float
    scene: Scene
    options: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Panel:
    """Scenes measured in several ways.

    ``roi`` x0, y0, x1, y1; ``margin_px``: pixels of a cube's face this near to its border are left out (None: half
    the window and 13, for filters, disparity and motion). ``seeds``: independent sequences where there is noise.
    """

    name: str
    points: tuple[Point, ...]
    variants: tuple[Variant, ...]
    preshift: tuple[int, int]
    roi: tuple[int, int, int, int]
    stride: int
    seeds: int = 1
    margin_px: int | None = None
    keep_maps: bool = False

    def quick(self) -> Panel:
        """A small version: the ends of the abscissa, about four variants, one sequence, few pixels."""
        points = tuple(self.points[i] for i in sorted({0, len(self.points) - 1}))
        small = replace(
            self, points=points, variants=self.variants[:: -(-len(self.variants) // 4)], seeds=1, stride=2 * self.stride
        )
        if not isinstance(points[0].scene, CubeScene):
            return small
        x0, y0, x1, y1 = self.roi
        third = (y1 - y0) // 3
        cubes = tuple(replace(point, scene=replace(point.scene, supersampling=2)) for point in points)
        return replace(small, points=cubes, roi=(x0, y0 + third, x1, y1 - third))


@dataclass(frozen=True)
class Diagram:
    """A quantity over the abscissa; ``curves``: label -> (panel, variant).

    ``printed``: range of the printed curves for noise-free images, drawn as a band; ``best``: the curve that is held
    against its upper end, by its worst point. ``reason``: why it lies above.
    """

    title: str
    quantity: str
    x_label: str
    curves: Mapping[str, Pair]
    x_log: bool = True
    statistic: Statistic = "mean"
    region: str = "all"
    printed: tuple[float, float] | None = None
    best: str | None = None
    reason: str = ""


def diagrams(panel: Panel, x_label: str, quantities: Iterable[str], **options: Any) -> tuple[Diagram, ...]:
    """One diagram per quantity with all variants of a panel."""
    curves = {variant.label: (panel.name, variant.label) for variant in panel.variants}
    named = {"title": panel.name, **options}
    return tuple(Diagram(quantity=quantity, x_label=x_label, curves=curves, **named) for quantity in quantities)


class Printed(NamedTuple):
    """A printed value, with its standard deviation over the region where that is printed."""

    value: float
    std: float | None = None


Selection = Mapping[str, Any]
"""Fields of the records that a row or a column of a table chooses: panel, variant, region, x, quantity, statistic."""


@dataclass(frozen=True)
class Table:
    """A printed table: rows and columns, each the selection of records that it stands for; a cell joins both.

    ``printed`` and ``goals`` by (row, column). ``reasons``: why a cell is worse than printed, by (row, column) or
    by row.
    """

    title: str
    rows: Mapping[str, Selection]
    columns: Mapping[str, Selection]
    printed: Mapping[Pair, Printed] = field(default_factory=dict)
    goals: Mapping[Pair, float] = field(default_factory=dict)
    reasons: Mapping[Pair | str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Experiment:
    """One table or group of figures. ``text``: scene and settings in words; ``known``: what of the print is known."""

    name: str
    title: str
    text: str
    known: str
    panels: tuple[Panel, ...]
    tables: tuple[Table, ...] = ()
    diagrams: tuple[Diagram, ...] = ()
    notes: tuple[str, ...] = ()
