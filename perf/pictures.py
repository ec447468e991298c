"""Pictures of the cases; matplotlib is imported when one is drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.colours import STATUS_COLOURS
from leafflow_ti.errors import MissingExtra
from leafflow_ti.status import Status

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Panel:
    """One image [y, x], or colours [y, x, 3]. ``limits`` of the colours; ``arrows`` [y, x, 2] drawn on it, NaN where
    none, one every ``arrow_step`` pixels; those three times as long as most are left out."""

    title: str
    image: Array
    limits: tuple[float, float] | None = None
    colours: str = "viridis"
    arrows: Array | None = None
    arrow_step: int | None = None


def normal_colours(normals: Array) -> Array:
    """Colours [y, x, 3] of normals [y, x, 3]; white where there is none."""
    unit = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.asarray(np.where(np.isfinite(unit), (unit + 1) / 2, 1.0))


def status_colours(status: NDArray[np.uint8]) -> Array:
    """Colours [y, x, 3] of status codes, those of the quick looks."""
    result = np.ones((*status.shape, 3))
    for code in Status:
        value = STATUS_COLOURS[code].lstrip("#")
        result[status == code] = [int(value[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    return result


def draw(path: Path, panels: Sequence[Panel], columns: int, panel_inches: float = 4.0) -> Path:
    """Write the panels row by row into one PNG; returns its path. Raises MissingExtra without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("matplotlib", "plot", "drawing pictures") from None
    rows = -(-len(panels) // columns)
    height, width = panels[0].image.shape[:2]
    figure = Figure(
        figsize=(columns * panel_inches, rows * (panel_inches * 0.85 * height / width + 0.3)), layout="constrained"
    )
    for axes, panel in zip(np.ravel(figure.subplots(rows, columns)), panels, strict=False):
        _draw_panel(figure, axes, panel)
    for axes in figure.axes[len(panels) : rows * columns]:
        axes.set_axis_off()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    return path


def _draw_panel(figure: Any, axes: Any, panel: Panel) -> None:
    low, high = panel.limits or (None, None)
    shown = axes.imshow(panel.image, vmin=low, vmax=high, cmap=panel.colours, interpolation="nearest")
    axes.set_title(panel.title, fontsize=10)
    axes.set_xticks([])
    axes.set_yticks([])
    if panel.image.ndim == 2:
        figure.colorbar(shown, ax=axes, shrink=0.85)
    if panel.arrows is not None:
        usual = max(1, max(panel.image.shape[:2]) // 40)
        step = panel.arrow_step or usual
        y, x = np.mgrid[step // 2 : panel.image.shape[0] : step, step // 2 : panel.image.shape[1] : step]
        u, v = panel.arrows[y, x, 0], panel.arrows[y, x, 1]
        length = np.hypot(u, v)
        typical = np.nanpercentile(length, 90)
        kept = length < 3 * typical  # one wild arrow would hide the others
        axes.quiver(
            x[kept], y[kept], u[kept], v[kept],
            color="#e4442b", angles="xy", scale_units="xy", scale=typical / (2.0 * usual), width=0.004,
        )  # fmt: skip
