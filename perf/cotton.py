"""The light field "cotton" of the HCI 4D light field benchmark: a real-sized static 9x9 grid with its truth.

The images were shifted so that the disparity seen is 0 at 4.25 m: the capture states the offset ``-f b / 4.25 m`` px
per step. The truth ``d`` counts the other way: a point of the middle view at x appears at ``x - d k`` in camera k, so
that the disparity seen is ``-d``. What is seen reaches ±1.5 px per step, more than the derivative filters of the fine
texture allow; the second measurement runs with the preshifts -1, 0 and 1 and keeps, per pixel, the result with the
smallest standard error among those that leave less than a pixel. The adaptive preshift does that by itself, and keeps
surfaces apart: with it and the refinement, errors are told with and without the pixels beside discontinuities, which
are those where the truth of neighbouring pixels differs by more than ``JUMP_PX``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from leafflow_ti.capture import FileCapture
from leafflow_ti.field import Field
from leafflow_ti.metrics import angle
from perf.cases import Options
from perf.fields import Array, normals, normals_of_depth
from perf.figures import Figure, Outcome
from perf.inputs import absent, data_folder, described, read_pfm
from perf.pictures import Panel, draw, normal_colours, status_colours

NAME = "hci_cotton"
SIZE_PX = 512
FOCAL_PX = 100.0 / (35.0 / SIZE_PX)
BASELINE_MM, FOCUS_MM = 25.0, 4250.0
OFFSET_PX = -FOCAL_PX * BASELINE_MM / FOCUS_MM
BAD_PX = 0.07
LARGEST_RESIDUAL_PX = 1.0
JUMP_PX = 0.1
"""Difference of neighbouring true disparities that makes a discontinuity."""
BESIDE_PX = (2, 4, 8)
"""Pixels from one that are left out."""
GOAL_BAD = 3.0
"""BadPix without discontinuities [%]."""


@dataclass(frozen=True)
class Settings:
    """Options of ``run``: the best of windows of 9 to 21 pixels, filters of 3, 5 and 7 taps, one to five camera samples
    of equal and unequal weight, and the estimators."""

    window: int = 15
    sigma_camera: float = 2.0
    estimator: str = "tls-equilibrated"
    border: str = "clip"
    stride: int = 1
    roi: tuple[int, int, int, int] = (0, 0, SIZE_PX, SIZE_PX)
    preshifts_px: tuple[int, ...] = (-1, 0, 1)
    adaptive_stride: int = 4
    refine: int = 5


@dataclass(frozen=True, eq=False)
class Truth:
    """Disparity ``d`` [px/step], depth [mm] and unit normals [y, x, 3] of the middle view."""

    disparity: Array
    depth: Array
    normals: Array

    @classmethod
    def read(cls) -> Truth:
        """From the files of the data set."""
        depth = 1000.0 * read_pfm(data_folder(NAME) / "gt_depth_lowres.pfm")
        middle = (SIZE_PX - 1) / 2
        n = normals_of_depth(depth, FOCAL_PX, (middle, middle))
        return cls(read_pfm(data_folder(NAME) / "gt_disp_lowres.pfm"), depth, n * np.sign(n[..., 2:]))


def open_cotton(folder: Path) -> FileCapture:
    """The light field through a ``capture.toml`` written into ``folder``."""
    return described(
        folder,
        {
            "images": {
                "pattern": str(data_folder(NAME) / "input_Cam{i:03d}.png"),
                "order": "sy sx",
                "shape": {"sy": 9, "sx": 9},
            },
            "camera": {"focal_length_mm": 100.0, "pixel_pitch_mm": 35.0 / SIZE_PX},
            "grid": {"baseline_mm": [BASELINE_MM, BASELINE_MM], "disparity_offset_px": [OFFSET_PX, OFFSET_PX]},
        },
    )


def estimate_cotton(capture: FileCapture, settings: Settings, **options: Any) -> Field:
    """The field with the settings, changed by ``options`` of ``estimate``."""
    from leafflow_ti.api import estimate

    chosen = {
        "model": "depth", "preshift": (0, 0), "window": settings.window, "stride": settings.stride,
        "sigma_camera": settings.sigma_camera, "estimator": settings.estimator, "border": settings.border,
        "roi": settings.roi,
    }  # fmt: skip
    return estimate(capture, frame=0, **chosen | options)


def merge(fields: Sequence[Field], preshifts_px: Sequence[int], offset_px: float) -> Field:
    """Per pixel the field with the smallest standard error among those whose residual disparity is below a pixel.

    Where none is, the one with the smallest residual.
    """
    residuals = np.stack([np.abs(f["disparity"] - offset_px - p) for f, p in zip(fields, preshifts_px, strict=True)])
    errors = np.stack([f["disparity_std"] for f in fields])
    far = 1e6 + residuals
    cost = np.nan_to_num(np.where(residuals < LARGEST_RESIDUAL_PX, errors, far), nan=np.inf)
    best = np.argmin(cost, axis=0)

    def chosen(maps: Sequence[NDArray[Any]]) -> NDArray[Any]:
        kept: NDArray[Any] = np.take_along_axis(np.stack(maps), best[None], axis=0)[0]
        return kept

    first = fields[0]
    merged = {name: chosen([f[name] for f in fields]) for name in first}
    return Field(merged, chosen([f.status for f in fields]), first.y, first.x, first.frame)


def errors_of(field: Field, truth: Truth) -> tuple[Array, Array]:
    """Disparity errors [px] and angles between the normals [deg], [y, x]; NaN where there is no value."""
    there = np.ix_(field.y, field.x)
    disparity = -(field["disparity"] - OFFSET_PX) - truth.disparity[there]
    return disparity, angle(normals(field["slope_x"], field["slope_y"]), truth.normals[there])


def discontinuities(disparity: Array, beside_px: int) -> NDArray[np.bool_]:
    """[y, x]: pixels within ``beside_px`` rows and columns of two neighbours whose true disparities jump."""
    jump = maximum_filter(disparity, 3) - minimum_filter(disparity, 3) > JUMP_PX
    return np.asarray(maximum_filter(jump, 2 * beside_px + 1))


def bad_figures(label: str, field: Field, truth: Truth) -> tuple[Figure, ...]:
    """Shares of bad pixels without those beside discontinuities."""
    disparity, _ = errors_of(field, truth)
    known, figures = np.isfinite(disparity), []
    for beside in BESIDE_PX:
        smooth = ~discontinuities(truth.disparity, beside)[np.ix_(field.y, field.x)]
        share, bad = float(smooth.mean()), np.abs(disparity) > BAD_PX
        name = f"BadPix({BAD_PX}) more than {beside} px from discontinuities, {label}"
        goal = GOAL_BAD if beside == 4 and "refined" in label else None
        lost = 100 * float(np.mean((bad | ~known)[smooth]))
        note = f"{100 * share:.0f} % of the pixels; those without a value among the bad ones: {lost:.1f} %"
        figures.append(Figure(name, 100 * float(bad[known & smooth].mean()), "%", goal, note=note))
    return tuple(figures)


def figures_of(label: str, field: Field, truth: Truth) -> tuple[Figure, ...]:
    """The figures of one measurement."""
    disparity, tilt = errors_of(field, truth)
    known = np.isfinite(disparity)
    size = np.abs(disparity[known])
    return (
        Figure(f"median disparity error, {label}", float(np.median(size)), "px", 0.01),
        Figure(
            f"BadPix({BAD_PX}), {label}", 100 * float(np.mean(size > BAD_PX)), "%", note="of the pixels with a value"
        ),
        Figure(f"RMS disparity error, {label}", float(np.sqrt(np.mean(size**2))), "px"),
        Figure(
            f"RMS of the smallest 99 %, {label}",
            float(np.sqrt(np.mean(np.sort(size)[: int(0.99 * size.size)] ** 2))),
            "px",
        ),
        Figure(
            f"median normal error, {label}",
            float(np.nanmedian(tilt[known])),
            "deg",
            note="truth: differences of the depth map",
        ),
        Figure(f"pixels with a value, {label}", 100 * float(known.mean()), "%"),
    )


def measure(settings: Settings, out: Path) -> Outcome:
    """One pass, and the merged preshifts."""
    truth = Truth.read()
    capture = open_cotton(out / "hci-cotton")
    fields = [estimate_cotton(capture, settings, preshift=(p, p)) for p in settings.preshifts_px]
    one = fields[settings.preshifts_px.index(0)]
    merged = merge(fields, settings.preshifts_px, OFFSET_PX)
    difference = np.abs(FOCAL_PX * BASELINE_MM / (truth.disparity - OFFSET_PX) - truth.depth)
    label = "preshifts " + ", ".join(map(str, settings.preshifts_px))
    figures = figures_of("one pass", one, truth) + figures_of(label, merged, truth)
    shown = {"one-pass": one, "merged": merged}
    for name, steps in (("adaptive", 0), ("adaptive, refined", settings.refine)):
        stride = max(settings.stride, settings.adaptive_stride)
        found = estimate_cotton(capture, settings, preshift="adaptive", refine=steps, stride=stride)
        figures += figures_of(name, found, truth) + bad_figures(name, found, truth)
        shown[name.replace(", ", "-")] = found
    notes = (
        f"f b / (d + {-OFFSET_PX:.3f}) agrees with the true depth: median difference {np.median(difference):.2g} mm",
    )
    pictures = tuple(_picture(out / f"hci-cotton-{name}.png", field, truth) for name, field in shown.items())
    return Outcome(figures, asdict(settings), notes, pictures)


def _picture(path: Path, field: Field, truth: Truth) -> Path:
    there = np.ix_(field.y, field.x)
    disparity, tilt = errors_of(field, truth)
    limits = (-1.5, 1.4)
    panels = [
        Panel("disparity d [px/step]", -(field["disparity"] - OFFSET_PX), limits),
        Panel("truth", truth.disparity[there], limits),
        Panel("error [px/step]", disparity, (-0.05, 0.05), "RdBu"),
        Panel("status", status_colours(field.status)),
        Panel("normals", normal_colours(normals(field["slope_x"], field["slope_y"]))),
        Panel("truth", normal_colours(truth.normals[there])),
        Panel("angle between the normals [deg]", tilt, (0, 45), "magma"),
        Panel("standard error of d [px/step]", field["disparity_std"], (0, 0.05), "magma"),
    ]
    return draw(path, panels, 4)


def run(options: Options) -> Outcome:
    """The case; quick: every fourth pixel."""
    reason = absent(NAME)
    if reason:
        return Outcome(skipped=reason)
    return measure(Settings(stride=4) if options.quick else Settings(), options.out)
