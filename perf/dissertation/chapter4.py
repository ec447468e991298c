"""Chapter 4: brightness models, prefilters, range-flow constraints, on sinusoids and on a cube under a fixed spot."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.plane import PlaneScene
from perf.dissertation.experiment import Diagram, Experiment, Panel, Point, Printed, Table, Variant, diagrams
from perf.dissertation.scenes import middle, sinusoid

SIZE = (601, 321)
CUBE_VIEW: dict[str, Any] = {"preshift": (-14, 0), "roi": (140, 20, 560, 300), "stride": 4}
SPOT = CubeScene(size=SIZE, light="spot", omega=(0.0, 0.0, 0.0))
"""The translating cube under a spot fixed in the world."""

BRIGHTNESS_MODELS = tuple(
    Variant(label, {"model": "affine", "motion": "translation", "brightness": brightness, "brightness_terms": terms})
    for label, brightness, terms in (
        ("constancy", "none", "none"),
        ("temporal", "temporal", "none"),
        ("temporal, 2nd order", "temporal", "time"),
        ("spatial", "spatial", "none"),
        ("spatial, 2nd order in time", "spatial", "time"),
        ("spatial, 2nd order in both", "spatial", "both"),
    )
)


def lit(*terms: BrightnessTerm, windows: int = 1, noise: float = 0.0) -> PlaneScene:
    """The translating sinusoid with changing brightness."""
    return sinusoid(windows=windows, omega=(0.0, 0.0, 0.0), brightness=terms, noise=noise)


CHANGES: dict[str, tuple[str, tuple[float, ...]]] = {
    "temporal": ("g [1/frame]", (0.003, 0.01, 0.03, 0.1)),
    "spatially varying": ("slope of g along X [1/(frame mm)]", (0.003, 0.01, 0.03, 0.1)),
    "quadratic": ("g2 [1/frame²]", (0.0003, 0.001, 0.003, 0.01)),
    "quadratic and spatially varying": ("slope of g2 along X [1/(frame² mm)]", (0.0003, 0.001, 0.003, 0.01)),
}
"""Kind of brightness change -> the abscissa and its values."""


def change(kind: str, size: float) -> tuple[BrightnessTerm, ...]:
    """The terms of one kind of change; all but the first on top of a constant g of .02 per frame."""
    base = BrightnessTerm("t", 1, 0.02)
    return {
        "temporal": (BrightnessTerm("t", 1, size),),
        "spatially varying": (replace(base, gx=size),),
        "quadratic": (base, BrightnessTerm("t", 2, size)),
        "quadratic and spatially varying": (base, BrightnessTerm("t", 2, 0.001, size)),
    }[kind]


NOISES = (0.25, 0.5, 1.0, 2.5, 5.0, 10.0)
POINTS_44 = {
    kind: tuple(Point(size, lit(*change(kind, size))) for size in sizes) for kind, (_, sizes) in CHANGES.items()
}
POINTS_44["noise"] = tuple(Point(n, lit(*change("spatially varying", 0.03), noise=n)) for n in NOISES)
PANELS_44 = {
    kind: Panel(kind, points, BRIGHTNESS_MODELS, (-14, 0), middle(points[0].scene), 8, seeds=2)
    for kind, points in POINTS_44.items()
}
MEASURED_G = {
    "temporal": "g", "spatially varying": "gx", "quadratic": "g2", "quadratic and spatially varying": "g2",
    "noise": "gx",
}  # fmt: skip
"""Kind of change -> which brightness parameter is drawn beside the motion."""


def _brightness_diagrams(kind: str) -> tuple[Diagram, ...]:
    x_label = CHANGES[kind][0] if kind in CHANGES else "noise [grey values]"
    (motion,) = diagrams(PANELS_44[kind], x_label, ("N",))
    # All curves in both, for one legend; models without the parameter have no points.
    return motion, replace(motion, quantity=MEASURED_G[kind], statistic="rms")


FIGURE_44 = Experiment(
    "figure-4.4",
    "Figures 4.4 to 4.7: brightness models",
    "Translating sinusoid (section 5.3 without rotation) whose brightness changes as exp(h): h = g t, with a slope of "
    "g along X, with g2 t², and with a slope of g2; without noise, and g = .02 with a slope of .03 against the noise, "
    "2 sequences. Affine Model with each brightness model; 2nd order: with the optional terms. Errors of g are root "
    "mean squares.",
    "Of the print only the topic is known here; no numbers are compared, and which kind of change is which figure is "
    "our choice.",
    tuple(PANELS_44.values()),
    diagrams=tuple(diagram for kind in PANELS_44 for diagram in _brightness_diagrams(kind)),
    notes=(
        "A slope of g2 biases N in proportion, whatever the model: the derivative filters also smooth along time, and "
        "the smoothed product of I and a brightness change that grows with t is not I Δt but I Δt + m It, m the "
        "variance of the filter. The error looks like a divergence of the flow: m times the slope of 2 g2 times the "
        "flow.",
    ),
)  # fmt: skip

PREFILTERS = ("none", "highpass", "homomorphic")
CONSTRAINTS = ("int", "grad", "intgrad", "taylor")


def range_flow(constraint: str, prefilter: str, label: str) -> Variant:
    """Range Flow with a constraint and a prefilter."""
    return Variant(label, {"model": "range-flow", "constraint": constraint, "prefilter": prefilter})


SWEEPS_410: dict[str, tuple[str, tuple[Point, ...]]] = {
    "temporal change": ("g [1/frame]", tuple(
        Point(g, lit(BrightnessTerm("t", 1, g), windows=2, noise=1.0)) for g in (0.003, 0.01, 0.03, 0.1)
    )),
    "spatially varying change": ("slope of g along X [1/(frame mm)]", tuple(
        Point(g, lit(BrightnessTerm("t", 1, 0.02, g), windows=2, noise=1.0)) for g in (0.003, 0.01, 0.03, 0.1)
    )),
    "noise": ("noise [grey values]", tuple(
        Point(n, lit(BrightnessTerm("t", 1, 0.02), windows=2, noise=n)) for n in NOISES[1::2]
    )),
}  # fmt: skip
PANELS_410 = {
    (sweep, prefilter): Panel(
        f"{sweep}, prefilter {prefilter}", points, tuple(range_flow(c, prefilter, c.upper()) for c in CONSTRAINTS),
        (-14, 0), middle(points[0].scene), 8,
    )
    for (sweep, (_, points)), prefilter in product(SWEEPS_410.items(), PREFILTERS)
}  # fmt: skip
FIGURE_410 = Experiment(
    "figure-4.10",
    "Figures 4.10 to 4.13: prefilters and constraints of range flow",
    "Translating sinusoid with changing brightness; Range Flow with our own depth maps, four constraints (INT, GRAD, "
    "INTGRAD, TAYLOR) after three prefilters; noise 1 grey value where it is not on the axis, g = .02 per frame "
    "against the noise; one sequence.",
    "Of the print only the topic is known here; no numbers are compared.",
    tuple(PANELS_410.values()),
    diagrams=tuple(
        diagram
        for (sweep, _), panel in PANELS_410.items()
        for diagram in diagrams(panel, SWEEPS_410[sweep][0], ("N",))
    ),
)  # fmt: skip

SPATIAL = {"brightness": "spatial", "brightness_terms": "both"}
COMBINED = (
    Variant("Scene Flow, spatial", {"model": "scene-flow", **SPATIAL}),
    Variant("Affine Scene Flow, spatial", {"model": "affine-scene-flow", "motion": "translation", **SPATIAL}),
)
RANGE_FLOW = tuple(range_flow(c, p, f"{c.upper()}, {p}") for p, c in product(PREFILTERS, CONSTRAINTS))

FACE_COLUMNS = {
    "AAE of N [deg], left": {"region": "left", "quantity": "N"},
    "AAE of N [deg], right": {"region": "right", "quantity": "N"},
    "growth [%/frame], left": {"region": "left", "quantity": "RGR", "statistic": "rms"},
    "growth [%/frame], right": {"region": "right", "quantity": "RGR", "statistic": "rms"},
}
"""Columns of the cube tables; growth is judged by the root mean square of its mean and its spread."""

N_LEFT, N_RIGHT, RGR_LEFT, RGR_RIGHT = FACE_COLUMNS

CUBE_41 = Panel("translating cube, fixed spot", (Point(0.0, SPOT),), RANGE_FLOW + COMBINED, **CUBE_VIEW)
TABLE_41 = Experiment(
    "table-4.1",
    "Table 4.1: cube under a fixed spot",
    "Box of 100 mm, 970 mm away, faces inclined 60° (left) and 30° (right), moving (-.2, 0, -1) mm/frame through the "
    "light of a fixed spot; f = 2800 px, 9 cameras 5 mm apart, 9 frames, 8 bit, no further noise; every fourth pixel "
    "whose window sees one face. Mean ± standard deviation over the face.",
    "Printed: the cells with a value. Texture, light and evaluated region are not printed: ours differ. Our spot "
    "changes the brightness less: brightness constancy (INT) errs by hundredths of a degree, the printed one by 4.3°.",
    (CUBE_41,),
    (
        Table(
            "angular error of N and relative growth rate (no growth in truth)",
            {v.label: {"panel": CUBE_41.name, "variant": v.label} for v in CUBE_41.variants},
            FACE_COLUMNS,
            {
                ("INT, none", N_RIGHT): Printed(4.311),
                ("INT, homomorphic", N_RIGHT): Printed(0.061),
                ("TAYLOR, none", N_RIGHT): Printed(0.056, 0.014),
                ("TAYLOR, none", N_LEFT): Printed(0.148, 0.074),
                ("TAYLOR, none", RGR_RIGHT): Printed(-0.009, 0.052),
                ("TAYLOR, none", RGR_LEFT): Printed(0.090, 0.094),
                ("TAYLOR, highpass", N_RIGHT): Printed(0.046, 0.015),
            },
            {
                **{(COMBINED[0].label, column): 0.045 for column in (N_LEFT, N_RIGHT)},
                **{(COMBINED[1].label, column): 0.1 for column in (N_LEFT, N_RIGHT)},
            },
        ),
    ),
)

WINDOWS = (17, 33, 49, 65, 81, 97)
CUBE_416 = Panel(
    "window size",
    tuple(Point(n, SPOT, {"window": n, "sigma": n * 19.0 / 65.0}) for n in WINDOWS),
    (range_flow("taylor", "none", "Range Flow TAYLOR"), *COMBINED),
    **CUBE_VIEW,
)
FIGURE_416 = Experiment(
    "figure-4.16",
    "Figure 4.16: window size",
    "The cube of Table 4.1, windows of 17 to 97 pixel with σ = 19/65 of the size; pixels whose window sees one face.",
    "Of the print only the topic is known here; no numbers are compared.",
    (CUBE_416,),
    diagrams=tuple(
        replace(diagram, title=f"{side} face", region=side, x_log=False)
        for side in ("left", "right")
        for diagram in diagrams(CUBE_416, "window [px]", ("N",))
        + diagrams(CUBE_416, "window [px]", ("RGR",), statistic="rms")
    ),
)

CUBE_417 = Panel(
    "brightness models on the cube", (Point(0.0, SPOT),), tuple(BRIGHTNESS_MODELS[i] for i in (0, 1, 3, 5)),
    **CUBE_VIEW, keep_maps=True,
)  # fmt: skip
FIGURE_417 = Experiment(
    "figure-4.17",
    "Figures 4.17 and 4.18: error maps and motion under a fixed spot",
    "The cube of Table 4.1, Affine Model without rotation and with four brightness models: angular error of N at every "
    "pixel, and the motion (arrows along X and Y, colours along Z). At the rim the windows see the background.",
    "Of the print only the topic is known here; no numbers are compared.",
    (CUBE_417,),
    (
        Table(
            "angular error of N [deg]",
            {v.label: {"panel": CUBE_417.name, "variant": v.label} for v in CUBE_417.variants},
            {k: v for k, v in FACE_COLUMNS.items() if v["quantity"] == "N"},
        ),
    ),
)
EXPERIMENTS = (TABLE_41, FIGURE_44, FIGURE_410, FIGURE_416, FIGURE_417)
