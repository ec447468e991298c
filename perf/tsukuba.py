"""The "head and lamp" of the University of Tsukuba: five real cameras in a row, 5 to 14 px of disparity per step.

The truth ``d`` is stated in whole px per step and counts the other way: a point of the middle view at x appears at
``x - d k`` in camera k. Half a pixel is its own rounding.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from leafflow_ti.capture import FileCapture
from leafflow_ti.field import Field
from leafflow_ti.status import HAS_VALUE, Status
from perf.cases import Options
from perf.fields import Array
from perf.figures import Figure, Outcome
from perf.inputs import absent, data_folder, described
from perf.pictures import Panel, draw, status_colours

NAME = "tsukuba_row"
GRAINS = 16.0
"""Grey values of the truth's picture per px/step; 0: unknown."""
CLOSE_PX = 0.5
"""1 px per two steps."""
GOAL = 85.0
"""Of the known pixels [%]."""


@dataclass(frozen=True)
class Settings:
    """Options of ``estimate``; ``refined``: those of a second measurement, beside the first ones."""

    window: int = 35
    stride: int = 1
    refined: tuple[tuple[str, Any], ...] = (("window", 11), ("refine", 5), ("refine_window", 11), ("thin", 1))


def open_tsukuba(folder: Path) -> FileCapture:
    """The row through a ``capture.toml`` written into ``folder``. Focal length and baseline are not known."""
    return described(
        folder,
        {
            "images": {"pattern": str(data_folder(NAME) / "scene1.row3.col{sx}.ppm")},
            "camera": {"focal_length_mm": 10.0, "pixel_pitch_mm": 0.02},
            "grid": {"baseline_mm": [10.0, 0.0]},
        },
    )


def read_truth() -> Array:
    """Disparity [y, x] as it is seen, px/step; NaN where it is not known."""
    grey = np.asarray(Image.open(data_folder(NAME) / "truedisp.row3.col3.pgm"), np.float64)
    return np.where(grey > 0, -grey / GRAINS, np.nan)


def figures_of(label: str, field: Field, truth: Array) -> tuple[Figure, ...]:
    """The figures of one measurement."""
    known = np.isfinite(truth)
    close = np.abs(field["disparity"] - truth) <= CLOSE_PX

    def share(close: Array, of: Array) -> float:
        return 100 * float(close[of].mean())

    measured = known & (field.status == Status.OK)
    valued = known & np.isin(field.status, HAS_VALUE)
    return (
        Figure(
            f"known pixels within {CLOSE_PX:g} px per step, {label}", share(close, known), "%", low=GOAL,
            note="those without a value count as outside",
        ),
        Figure(f"the same of those with a value, {label}", share(close, valued), "%"),
        Figure(f"the same of those with status ok, {label}", share(close, measured), "%"),
        Figure(f"known pixels with a value, {label}", share(valued, known), "%"),
        Figure(f"known pixels with status ok, {label}", share(measured, known), "%"),
    )  # fmt: skip


def measure(settings: Settings, out: Path) -> Outcome:
    """Windows alone, and the refinement."""
    from leafflow_ti.api import estimate

    capture, truth = open_tsukuba(out / "tsukuba"), read_truth()
    common = {
        "model": "depth", "preshift": "adaptive", "border": "clip", "window": settings.window,
        "stride": settings.stride, "refine": 0,
    }  # fmt: skip
    fields = {"windows": estimate(capture, **common), "refined": estimate(capture, **common | dict(settings.refined))}
    truths = {label: truth[np.ix_(field.y, field.x)] for label, field in fields.items()}
    figures = [figure for label, field in fields.items() for figure in figures_of(label, field, truths[label])]
    limits = (-15.0, -4.0)
    panels = [
        panel
        for label, field in fields.items()
        for panel in (
            Panel(f"disparity [px/step], {label}", field["disparity"], limits),
            Panel("truth", truths[label], limits),
            Panel("error [px/step]", field["disparity"] - truths[label], (-1, 1), "RdBu"),
            Panel("status", status_colours(field.status)),
        )
    ]
    return Outcome(tuple(figures), {**common, **asdict(settings)}, (), (draw(out / "tsukuba.png", panels, 4),))


def run(options: Options) -> Outcome:
    """The case; quick: every fourth pixel."""
    reason = absent(NAME)
    if reason:
        return Outcome(skipped=reason)
    return measure(Settings(stride=4) if options.quick else Settings(), options.out)
