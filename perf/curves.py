"""Diagrams of curves in panels with one legend; matplotlib is imported when one is drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from leafflow_ti.errors import MissingExtra
from perf.dissertation.plots import COLOURS, MARKERS, STYLE


@dataclass(frozen=True)
class Curves:
    """One panel: by label the values over the abscissa ``x``. ``limits``: of the ordinate."""

    title: str
    x_label: str
    y_label: str
    x: Sequence[float]
    y: Mapping[str, Sequence[float]]
    x_log: bool = False
    y_log: bool = False
    limits: tuple[float, float] | None = None


def draw_curves(path: Path, panels: Sequence[Curves], columns: int = 2) -> Path:
    """Write the panels row by row into one picture, its kind as the name says; returns its path.

    A label has the same colour in all panels. Raises MissingExtra without matplotlib.
    """
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("matplotlib", "plot", "drawing diagrams") from None
    labels = list(dict.fromkeys(label for panel in panels for label in panel.y))
    rows = -(-len(panels) // columns)
    with matplotlib.rc_context({**STYLE, "svg.fonttype": "none"}):
        figure = Figure(figsize=(5.2 * columns, 3.4 * rows + 0.5), layout="constrained")
        handles: dict[str, Any] = {}
        grid = np.ravel(figure.subplots(rows, columns))
        for axes, panel in zip(grid, panels, strict=False):
            _draw(axes, panel, labels, handles)
        for axes in grid[len(panels) :]:
            axes.set_axis_off()
        figure.legend(
            list(handles.values()), list(handles), loc="outside lower center", ncols=2 * columns, frameon=False
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110, metadata={"Date": None, "Creator": None} if path.suffix == ".svg" else None)
    return path


def _draw(axes: Any, panel: Curves, labels: Sequence[str], handles: dict[str, Any]) -> None:
    for label, values in panel.y.items():
        k = labels.index(label)
        (line,) = axes.plot(
            panel.x, values, color=COLOURS[k % len(COLOURS)], marker=MARKERS[k % len(MARKERS)],
            markersize=max(3.5, 8.0 - 0.7 * k), markerfacecolor="none", linewidth=1.3,
            linestyle="-" if k < len(COLOURS) else "--", markevery=max(1, len(panel.x) // 15),
        )  # fmt: skip
        handles.setdefault(label, line)
    if panel.x_log:
        axes.set_xscale("log")
    if panel.y_log:
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        if high < 10.0 * low:  # small changes should look small
            axes.set_ylim(math.sqrt(low * high / 10.0), math.sqrt(low * high * 10.0))
    if panel.limits:
        axes.set_ylim(*panel.limits)
    axes.set_xlabel(panel.x_label)
    axes.set_ylabel(panel.y_label)
    axes.set_title(panel.title)
    axes.grid(which="major", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
