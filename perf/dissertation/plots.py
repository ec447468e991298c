"""The diagrams of an experiment as SVG, and its error maps as PNG; matplotlib is imported when one is drawn."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from leafflow_ti.errors import MissingExtra
from perf.dissertation.cells import curve
from perf.dissertation.experiment import QUANTITIES, Diagram, Experiment
from perf.dissertation.measure import Result
from perf.pictures import Panel, draw

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000", "#8a6d3b")
"""Colours of Okabe and Ito that the colour-blind can tell apart (yellow, too pale for lines, replaced)."""

MARKERS = "osD^vP*X"
COLUMNS = 3
STYLE = {"font.size": 9, "axes.titlesize": 9.5, "svg.fonttype": "path", "svg.hashsalt": "leafflow-ti"}


def draw_diagrams(experiment: Experiment, result: Result) -> list[str]:
    """SVG texts; diagrams with the same curves share a picture and its legend. Those without a point are left out."""
    shown = [d for d in experiment.diagrams if any(curve(d, label, result) for label in d.curves)]
    groups = [list(group) for _, group in groupby(shown, key=lambda d: tuple(d.curves))]
    return [_svg(group[i : i + 2 * COLUMNS], result) for group in groups for i in range(0, len(group), 2 * COLUMNS)]


def _svg(group: Sequence[Diagram], result: Result) -> str:
    matplotlib, figure_class = _matplotlib()
    columns = min(COLUMNS, len(group))
    rows = -(-len(group) // columns)
    with matplotlib.rc_context(STYLE):
        figure = figure_class(figsize=(3.9 * columns, 2.9 * rows + 0.5), layout="constrained")
        grid = np.ravel(figure.subplots(rows, columns))
        handles: dict[str, Any] = {}
        for axes, diagram in zip(grid, group, strict=False):
            _draw(axes, diagram, result, handles)
        for axes in grid[len(group) :]:
            axes.set_axis_off()
        figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=4, frameon=False)
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return text.getvalue()


def _draw(axes: Any, diagram: Diagram, result: Result, handles: dict[str, Any]) -> None:
    from matplotlib.ticker import LogLocator

    quantity = QUANTITIES[diagram.quantity]
    if diagram.printed:
        handles.setdefault(
            "printed range, noise free", axes.axhspan(*diagram.printed, color="#000000", alpha=0.12, lw=0)
        )
    for k, label in enumerate(diagram.curves):
        points = np.array(curve(diagram, label, result)).reshape(-1, 2)
        (line,) = axes.plot(
            *points.T, color=COLOURS[k % len(COLOURS)], marker=MARKERS[k % len(MARKERS)], markersize=8.0 - 0.7 * k,
            linestyle="--" if "acc." in label or "2nd" in label else "-", linewidth=1.3, markerfacecolor="none",
        )  # fmt: skip
        if len(points):
            handles.setdefault(label, line)
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    if high < 10.0 * low:  # small changes should look small
        axes.set_ylim(math.sqrt(low * high / 10.0), math.sqrt(low * high * 10.0))
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 100.0 * low else (1.0,)))
    axes.yaxis.set_major_formatter("{x:.3g}")
    axes.yaxis.set_minor_formatter("")
    if diagram.x_log:
        axes.set_xscale("log")
    axes.set_xlabel(diagram.x_label)
    axes.set_ylabel(f"{quantity.label} [{quantity.unit}]")
    axes.set_title(diagram.title)
    axes.grid(which="major", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)


def draw_maps(path: Path, result: Result) -> Path | None:
    """Error of N and motion of every variant that keeps its maps, as one PNG; None if none does."""
    if not result.maps:
        return None
    panels = []
    for (_, label), maps in result.maps.items():
        panels += [
            Panel(f"{label}: angular error of N [deg]", maps["error"], (0.0, 0.5), "magma"),
            Panel(
                f"{label}: N (colour: Z [mm/frame])", maps["velocity"][..., 2], (-1.05, -0.95),
                arrows=maps["velocity"][..., :2], arrow_step=8,
            ),
        ]  # fmt: skip
    return draw(path, panels, 2, 5.0)


def _matplotlib() -> tuple[Any, Any]:
    try:
        import matplotlib
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("matplotlib", "plot", "drawing diagrams") from None
    return matplotlib, Figure


def pictures(folder: Path, experiment: Experiment, result: Result) -> list[tuple[str, bytes]]:
    """Everything drawn of an experiment: media type and bytes."""
    found = [("image/svg+xml", text.encode()) for text in draw_diagrams(experiment, result)]
    maps = draw_maps(folder / f"{experiment.name}.png", result)
    return [*found, ("image/png", maps.read_bytes())] if maps else found
