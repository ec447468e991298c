"""``plan-rig``: standard errors that a camera rig will have, and which change of it would gain most."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

import typer

from leafflow_ti.cli import options
from leafflow_ti.errors import UsageError

if TYPE_CHECKING:
    from leafflow_ti.rig import Prediction
    from leafflow_ti.rig_choices import Choice

SHOWN = 5
"""Changes of the rig in the table."""


def _number(name: str, metavar: str, help: str) -> Any:
    return typer.Option(name, metavar=metavar, help=help, show_default=False)


@options.with_settings(without=("noise", "frames", "roi", "mask", "depth", "max_memory", "threads", "workers"))
def plan_rig(
    settings: Callable[..., Any],
    distance: Annotated[float, _number("--distance", "MM", "Distance of the surface.")],
    baseline: Annotated[str, _number("--baseline", "MM[,MM]", "Step between cameras along x [and y].")],
    f_px: Annotated[float | None, _number("--f-px", "PX", "Focal length in pixels, or:")] = None,
    f_mm: Annotated[float | None, _number("--f-mm", "MM", "Focal length, with --pitch.")] = None,
    pitch: Annotated[float | None, _number("--pitch", "MM", "Pixel pitch.")] = None,
    cameras: Annotated[str, _number("--cameras", "N|COLSxROWS", "Cameras of the grid [9].")] = "9",
    size: Annotated[str, _number("--size", "WxH", "Pixels of an image [1600x1200].")] = "1600x1200",
    frames: Annotated[int, _number("--frames", "N", "Frames of the sequence; 1: static [9].")] = 9,
    interval: Annotated[float | None, _number("--interval", "S", "Time between frames.")] = None,
    noise: Annotated[float, _number("--noise", "GREYS", "Standard deviation of the images' noise [1].")] = 1.0,
    contrast: Annotated[float, _number("--contrast", "GREYS", "Standard deviation of the texture [20].")] = 20.0,
    wavelengths: Annotated[
        str, _number("--wavelengths", "PX,PX", "Shortest and longest wavelength of the texture in the image [4,32].")
    ] = "4,32",
    exponent: Annotated[
        float, _number("--exponent", "P", "Its power falls as frequency^-P; 2: alike in every octave [2].")
    ] = 2.0,
    slopes: Annotated[str, _number("--slopes", "ZX,ZY", "Slopes of the surface [0.3,0.3].")] = "0.3,0.3",
    at: Annotated[
        str | None, _number("--at", "X,Y", "Pixel, from the image's middle [half way to the right border].")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Predict the standard errors of depth, normals, velocity, rotation and growth that a camera rig will have.

    Takes the options of run. Nothing is measured: textures are random with the given spectrum, and what windows of them
    hold goes through the program's own estimators. Errors are those of the images' noise.
    """
    from leafflow_ti.rig import Rig
    from leafflow_ti.rig import plan_rig as predict
    from leafflow_ti.rig_choices import improvements

    cols, rows = (int(n) for n in _pair("--cameras", cameras if "x" in cameras else f"{cameras}x1", "x"))
    width, height = (int(n) for n in _pair("--size", size, "x"))
    x, y = _pair("--baseline", baseline if "," in baseline else f"{baseline},{baseline}", ",")
    rig = Rig(
        f_px=_focal_length(f_px, f_mm, pitch), baseline_mm=(x, y), distance_mm=distance, cols=cols, rows=rows,
        size=(width, height), frames=frames, interval_s=interval, noise=noise, contrast=contrast,
        wavelengths_px=_pair("--wavelengths", wavelengths, ","), exponent=exponent,
        slopes=_pair("--slopes", slopes, ","), at=_pair("--at", at, ",") if at else (width / 4, 0.0),
    )  # fmt: skip
    config = settings()
    found = predict(rig, config)
    choices = improvements(found, config)
    typer.echo(
        json.dumps(to_json(found, choices), indent=2) if as_json else "\n".join(format_prediction(found, choices))
    )


def _focal_length(f_px: float | None, f_mm: float | None, pitch: float | None) -> float:
    if f_px is not None and f_mm is None and pitch is None:
        return f_px
    if f_px is None and f_mm is not None and pitch is not None and pitch > 0:
        return f_mm / pitch
    raise UsageError("the focal length is given once: --f-px, or --f-mm and --pitch (above 0)")


def _pair(name: str, text: str, separator: str) -> tuple[float, float]:
    parts = text.split(separator)
    try:
        one, two = (float(part) for part in parts)
    except ValueError:
        raise UsageError(f"{name} {text}: give two numbers, separated by '{separator}'") from None
    return one, two


def to_json(found: Prediction, choices: tuple[Choice, ...]) -> dict[str, Any]:
    """All numbers, in the units of their names; what is not determined is null."""
    rig = found.rig
    low, high = rig.depth_range_mm
    return {
        "standard_errors": {name: _finite(value) for name, value in found.errors.items()},
        "before_refinement": {name: _finite(value) for name, value in found.start.items()},
        "groups": {name: _finite(value) for name, value in found.groups.items()},
        "model": found.plan.model,
        "window_px": found.plan.config.window.size,
        "disparity_px_per_step": list(rig.disparity),
        "preshift_px": list(found.plan.preshift),
        "depth_range_mm": [low, _finite(high)],
        "field_of_view_mm": [n * rig.mm_per_px for n in rig.size],
        "mm_per_px": rig.mm_per_px,
        "choices": [{"change": c.name, "better": {k: _finite(v) for k, v in c.better.items()}} for c in choices],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def format_prediction(found: Prediction, choices: tuple[Choice, ...]) -> list[str]:
    """The rig, the errors and the choices as tables."""
    from leafflow_ti.field import quantity

    rig, plan = found.rig, found.plan
    low, high = rig.depth_range_mm
    x, y = rig.disparity
    refined = f", refined in {plan.refine.steps} steps" if plan.refine else ""
    lines = [
        f"rig          {rig.cols} x {rig.rows} cameras (columns x rows), focal length {rig.f_px:g} px, "
        f"{rig.distance_mm:g} mm away",
        f"scale        {rig.mm_per_px:.4g} mm per pixel, field of view {rig.size[0] * rig.mm_per_px:.4g} x "
        f"{rig.size[1] * rig.mm_per_px:.4g} mm",
        f"disparity    {x:.4g}, {y:.4g} px per step (x, y); {plan.preshift[0]}, {plan.preshift[1]} are taken out: "
        f"depths of {low:.5g} to {high:.5g} mm lie within 1 px",
        f"model        {plan.model}, window of {plan.config.window.size} px{refined}; pixel {rig.at[0]:g}, "
        f"{rig.at[1]:g} px from the middle",
        "",
        "standard errors per pixel of output",
    ]
    for name, error in found.errors.items():
        unit = quantity(name)[0]
        per_second = ""
        if rig.interval_s and unit.endswith("/frame") and math.isfinite(error):
            per_second = f"  {error / rig.interval_s * 3600:10.3g} {unit.removesuffix('/frame')}/h"
        shown = f"{error:10.3g}" if math.isfinite(error) else "not determined"
        lines.append(f"  {name:<16} {shown} {unit}{per_second}".rstrip())
    if choices:
        groups = list(found.groups)
        lines += ["", f"{'what would gain most (times better)':<62}" + "".join(f"{g:>10}" for g in groups)]
        for choice in choices[:SHOWN]:
            lines.append(f"  {choice.name:<60}" + "".join(f"{choice.better.get(g, math.nan):>10.2f}" for g in groups))
    return lines
