"""Options that name a value of the run configuration, declared once.

They are plain strings and numbers: ``leafflow_ti.config`` checks them, so that a value is refused with the same line
whether it comes from an option, from ``--set`` or from a file. An option that is not given is None: not decided.
"""

from __future__ import annotations

from typing import Annotated, Any

import typer


def _text(name: str, metavar: str, help: str) -> Any:
    return typer.Option(f"--{name}", metavar=metavar, help=help, show_default=False)


Preset = Annotated[str | None, _text("preset", "fast|balanced|accurate", "Stride and precision at once [balanced].")]
Model = Annotated[
    str | None,
    _text(
        "model",
        "auto|flow|flow-affine|flow-quadratic|depth|affine-translation|affine|affine-4d|affine-5d|scene-flow|"
        "affine-scene-flow|range-flow",
        "What is estimated [auto: affine-scene-flow, depth without time, flow-affine for one camera].",
    ),
]
Motion = Annotated[
    str | None,
    _text("motion", "auto|translation|rotation|acceleration", "Unknowns of the 3D motion [auto: rotation, if it can]."),
]
Deformation = Annotated[
    str | None,
    _text("deformation", "auto|none|growth", "Whether the surface may grow [auto: growth with affine-scene-flow]."),
]
Rows = Annotated[
    str | None, _text("rows", "auto|(u|2d)[+b5][+as][+at]", "Flow parameters that enter the 3D fit [auto].")
]
Brightness = Annotated[
    str | None, _text("brightness", "none|temporal|spatial|camera", "Brightness changes that are modelled [none].")
]
BrightnessTerms = Annotated[
    str | None, _text("brightness-terms", "none|time|space|both", "Second-order terms of the brightness [none].")
]
Constraint = Annotated[
    str | None, _text("constraint", "int|grad|intgrad|taylor", "Range flow: constraint on the intensity [taylor].")
]
Beta = Annotated[float | None, _text("beta", "WEIGHT", "Range flow: weight of intensity against range [1].")]
Depth = Annotated[
    str | None,
    _text("depth", "OUT.zarr|STACK|PATTERN", "Range flow: range maps in mm, such as z_{t:03d}.tif [from the cameras]."),
]
Estimator = Annotated[
    str | None, _text("estimator", "ols|tls|tls-equilibrated", "Estimator of the flow parameters [tls-equilibrated].")
]
Solver = Annotated[str | None, _text("solver", "fast|jacobi", "Null-space solver [fast].")]
Weighting = Annotated[str | None, _text("weighting", "wls|ls", "3D fit weighted by covariance, or not [wls].")]
Window = Annotated[int | None, _text("window", "PIXELS", "Side of the window, odd [65].")]
Sigma = Annotated[float | None, _text("sigma", "PIXELS", "Gaussian width of the window [19/65 of its side].")]
Stride = Annotated[int | None, _text("stride", "PIXELS", "Measure every STRIDE-th pixel [1; preset fast: 4].")]
Border = Annotated[
    str | None,
    _text("border", "full|clip", "Where the whole window is inside, or up to the border [full]."),
]
Taps = Annotated[str | None, _text("taps", "3x1x1|3|5|7", "Derivative filters [5].")]
Prefilter = Annotated[
    str | None, _text("prefilter", "none|highpass|homomorphic", "Filter of every image against uneven light [none].")
]
SigmaPre = Annotated[float | None, _text("sigma-pre", "PIXELS", "Gaussian width of the prefilter [8].")]
Frames = Annotated[str | None, _text("frames", "A:B", "Frame indices to measure, B excluded [all].")]
Roi = Annotated[str | None, _text("roi", "x0,y0,x1,y1", "Pixels to measure, x1 and y1 excluded [all].")]
Mask = Annotated[str | None, _text("mask", "FILE", "Image whose zero pixels are left out.")]
Preshift = Annotated[
    str | None, _text("preshift", "auto|X[,Y]", "Disparity per camera step taken out beforehand, whole pixels [auto].")
]
Precision = Annotated[str | None, _text("precision", "f32|f64", "Floating-point numbers of the kernels [f32].")]
Arch = Annotated[str | None, _text("arch", "auto|cpu|cuda|vulkan|metal", "Device [auto].")]
MaxMemory = Annotated[str | None, _text("max-memory", "SIZE", "Limit such as 8G [half of the machine's memory].")]
Threads = Annotated[str | None, _text("threads", "auto|N", "CPU threads [auto].")]
