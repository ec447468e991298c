"""Chapter 3: depth and normals of static planes from 1D and 2D grids, and the motion models compared."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from typing import Any

from leafflow_ti.synthetic.plane import PlaneScene
from perf.dissertation.experiment import Diagram, Experiment, Panel, Point, Printed, Table, Variant, diagrams
from perf.dissertation.scenes import middle, sinusoid

F_PX, DEPTH_MM, RANGE = 10.0 / 0.0074, 100.0, 100.0
ALPHAS = (0, 30, 60, 90)
GRIDS = {"1D": 1, "2D": 9}
DEPTH = (Variant("depth", {"model": "depth"}),)

PRINTED = {
    (0.0, "1D", "Z0"): (0.104, 0.119, 0.140, 0.128),
    (0.0, "2D", "Z0"): (0.104, 0.108, 0.108, 0.104),
    (0.0, "1D", "ZY"): (0.35, 5.40, 5.37, 0.001),
    (0.0, "2D", "ZY"): (0.29, 0.23, 0.11, 0.01),
    (2.5, "1D", "Z0"): (0.44, 2.07, 2.80, 3.71),
    (2.5, "2D", "Z0"): (0.43, 0.41, 0.31, 0.32),
    (2.5, "2D", "ZY"): (26.9, 24.9, 17.9, 19.1),
}
"""(noise in % of the grey range, grid, quantity) -> standard deviation for each α [mm, deg]."""


def tilted(rows: int, alpha: int, noise: float) -> PlaneScene:
    """The plane of Table 3.1 before a static grid."""
    side, pixel_mm = 33 + 2 * (65 // 2 + 4 + 4 * 7), DEPTH_MM / F_PX
    return PlaneScene(
        f_px=F_PX, baseline_mm=(0.5, 0.5), n_rows=rows, n_frames=1, size=(side, side), noise=noise / 100.0 * RANGE,
        centre=(0.0, 0.0, DEPTH_MM), zy=1.0, offset=RANGE, amplitude=RANGE / 2,
        wavelengths_mm=(8.0 * pixel_mm, 80.0 * pixel_mm), alpha=math.radians(alpha),
    )  # fmt: skip


# Where the Gaussian is cut at 1.7 sigma, the step at its rim meets the 8-pixel wave: sigma 10 instead of 19.
TABLE_31 = Experiment(
    "table-3.1",
    "Table 3.1: depth and slope of a sinusoidal plane",
    "Static plane at 100 mm, slope ZY = 45°, f = 10 mm at 7.4 µm pitch, wavelengths 8 and 80 pixel, pattern turned by "
    "α; 9 or 9 x 9 cameras 0.5 mm apart, window 65 pixel with σ = 10, region of 33 x 33 pixel; with noise 8 sequences. "
    "Standard deviations of the error.",
    "Printed: scene, noise and all values but 1D ZY with noise. Not printed: camera step, number of cameras, window, "
    "region. The printed errors are so much larger that window and grid must have been far smaller.",
    tuple(
        Panel(
            f"noise {noise:g} %, {grid}",
            tuple(Point(alpha, tilted(rows, alpha, noise), {"sigma": 10.0}) for alpha in ALPHAS),
            DEPTH, (-7, -7 if rows > 1 else 0), middle(tilted(rows, 0, 0.0)), 4, seeds=8,
        )
        for noise, (grid, rows) in product((0.0, 2.5), GRIDS.items())
    ),
    (
        Table(
            "standard deviation of the error [mm, deg]",
            {
                f"{name} [{unit}], noise {noise:g} %, {grid}": {"panel": f"noise {noise:g} %, {grid}", "quantity": name}
                for noise, (name, unit), grid in product((0.0, 2.5), (("Z0", "mm"), ("ZY", "deg")), GRIDS)
            },
            {f"α = {alpha}°": {"x": alpha, "statistic": "std"} for alpha in ALPHAS},
            {
                (f"{name} [{'mm' if name == 'Z0' else 'deg'}], noise {noise:g} %, {grid}", f"α = {alpha}°"): Printed(v)
                for (noise, grid, name), values in PRINTED.items()
                for alpha, v in zip(ALPHAS, values, strict=True)
            },
        ),
    ),
)  # fmt: skip


def _static(rows: int, angle: float, along: str, noise: float) -> PlaneScene:
    slope = {"x": (math.tan(math.radians(angle)), 0.0), "y": (0.0, math.tan(math.radians(angle)))}[along]
    return sinusoid(rows=rows, n_frames=1, zx=slope[0], zy=slope[1], noise=noise)


SLOPES, NOISES = (0, 15, 30, 45, 60, 70), (0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
CURVES = {f"{grid}, slope along {axis.upper()}": (rows, axis) for (grid, rows), axis in product(GRIDS.items(), "xy")}


def _normals(panel: str, rows: int, points: tuple[Point, ...]) -> Panel:
    return Panel(panel, points, DEPTH, (-14, -14 if rows > 1 else 0), middle(points[0].scene), 4, seeds=6)


FIGURE_35 = Experiment(
    "figure-3.5",
    "Figures 3.5 and 3.6: surface normals from 1D and 2D grids",
    "Static sinusoid at 100 mm, f = 12 mm at 4.4 µm pitch, 9 or 9 x 9 cameras 0.5 mm apart, wavelengths 0.3 mm, grey "
    "values 100 ± 50; noise 2.5 grey values against the slope, slope 45° against the noise; 6 sequences.",
    "Of the print only the topic is known here; no numbers are compared.",
    tuple(
        _normals(f"slopes, {label}", rows, tuple(Point(angle, _static(rows, angle, axis, 2.5)) for angle in SLOPES))
        for label, (rows, axis) in CURVES.items()
    )
    + tuple(
        _normals(f"noise, {label}", rows, tuple(Point(noise, _static(rows, 45, axis, noise)) for noise in NOISES))
        for label, (rows, axis) in CURVES.items()
    ),
    diagrams=(
        Diagram(
            "noise 2.5", "normal", "inclination [deg]",
            {label: (f"slopes, {label}", "depth") for label in CURVES}, x_log=False,
        ),
        Diagram(
            "slope 45°", "normal", "noise [grey values]", {label: (f"noise, {label}", "depth") for label in CURVES}
        ),
    ),
)  # fmt: skip

MOTION_MODELS = (
    Variant("Scene Flow", {"model": "scene-flow"}),
    Variant("Range Flow", {"model": "range-flow", "constraint": "int"}),
    Variant("Affine Model", {"model": "affine", "motion": "translation"}),
    Variant("Affine Scene Flow", {"model": "affine-scene-flow", "motion": "translation"}),
)
BASELINES = {"near": (0.04, 1), "wide": (0.5, 14)}
"""Baseline -> camera step [mm], preshift [px per step]: 1.1 and 13.6 px of disparity per step."""

MOTION = {"velocity": (0.0073, -0.0037, 0.06), "omega": (0.0, 0.0, 0.0), "zy": 0.0}


def _moving(baseline: str, **changes: Any) -> PlaneScene:
    step, shift = BASELINES[baseline]
    return sinusoid(windows=2, shift_px=shift, baseline_mm=(step, step), **{**MOTION, **changes})


SWEEPS_38 = {
    "velocity U_Z [mm/frame]": lambda b: tuple(
        Point(u, _moving(b, velocity=(0.0073, -0.0037, u), noise=1.0)) for u in (0.003, 0.01, 0.03, 0.1, 0.3)
    ),
    "slope Z_X": lambda b: tuple(Point(z, _moving(b, zx=z, noise=1.0)) for z in (0.0, 0.3, 0.6, 1.0, 1.5, 2.0)),
    "noise [grey values]": lambda b: tuple(Point(n, _moving(b, noise=n)) for n in (0.25, 0.5, 1.0, 2.5, 5.0, 10.0)),
}
PANELS_38 = {
    (sweep, baseline): Panel(
        f"{baseline} baseline, {sweep}", points(baseline), MOTION_MODELS, (-BASELINES[baseline][1], 0),
        middle(points(baseline)[0].scene), 8, seeds=2,
    )
    for (sweep, points), baseline in product(SWEEPS_38.items(), BASELINES)
}  # fmt: skip
FIGURE_38 = Experiment(
    "figure-3.8",
    "Figure 3.8: motion models with near and wide baseline",
    "Translating sinusoid (U_X = .0073, U_Y = -.0037, U_Z = .06 mm/frame, Z_X = .6 where not on the axis) at 100 mm; "
    "9 frames, 9 cameras 0.04 mm (near, 1.1 px of disparity per step) or 0.5 mm (wide, 13.6 px) apart; noise 1 grey "
    "value where it is not on the axis; 2 sequences. All models without rotation; Range Flow with brightness constancy "
    "and our own depth maps.",
    "Of the print only the topic is known here; no numbers are compared. The Affine Scene Flow Model is of chapter 6.",
    tuple(PANELS_38.values()),
    diagrams=tuple(
        replace(diagram, title=f"{baseline} baseline", x_log=sweep != "slope Z_X")
        for (sweep, baseline), panel in PANELS_38.items()
        for diagram in diagrams(panel, sweep, ("N",))
    ),
)
EXPERIMENTS = (TABLE_31, FIGURE_35, FIGURE_38)
