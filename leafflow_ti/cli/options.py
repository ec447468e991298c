"""Options that name a value of the run configuration, declared once.

They are plain strings and numbers: ``leafflow_ti.config`` checks them, so that a value is refused with the same line
whether it comes from an option, from ``--set`` or from a file. An option that is not given is None: not decided.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from leafflow_ti.models import MODELS


def _text(name: str, metavar: str, help: str) -> Any:
    return typer.Option(f"--{name}", metavar=metavar, help=help, show_default=False)


Preset = Annotated[
    str | None, _text("preset", "fast|balanced|accurate", "Stride, precision and refinement at once [balanced].")
]
Model = Annotated[
    str | None,
    _text(
        "model",
        "|".join(("auto", *MODELS)),
        "What is estimated [auto: affine-scene-flow, depth without time, flow-affine for one camera].",
    ),
]
Motion = Annotated[
    str | None,
    _text("motion", "auto|translation|rotation|acceleration", "Unknowns of the 3D motion [auto: rotation, if it can]."),
]
Deformation = Annotated[
    str | None,
    _text(
        "deformation",
        "auto|none|growth|strain",
        "Whether the surface may grow or, refined, stretch [auto: growth with affine-scene-flow or refinement].",
    ),
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
    str | None,
    _text(
        "estimator", "ols|tls|tls-equilibrated|sampson|fns|for3|robust-ols|robust-ols-sor|robust-tls",
        "Estimator of the flow parameters [tls-equilibrated].",
    ),
]  # fmt: skip
Scale = Annotated[float | None, _text("scale", "K", "Scale of the coordinates for tls, sampson, fns [1].")]
Penalty = Annotated[
    str | None,
    _text("penalty", "lorentzian|geman-mcclure|truncated", "Robust estimators: how residuals count [geman-mcclure]."),
]
Robust = Annotated[
    str | None, _text("robust", "failed|all", "Robust estimators: pixels whose plain fit failed, or all [failed].")
]
Solver = Annotated[str | None, _text("solver", "fast|jacobi", "Null-space solver [fast].")]
Weighting = Annotated[str | None, _text("weighting", "wls|ls", "3D fit weighted by covariance, or not [wls].")]
Noise = Annotated[
    str | None,
    _text("noise", "auto|GREYS", "Standard deviation of the images' noise [auto: estimated from the middle image]."),
]
Window = Annotated[int | None, _text("window", "PIXELS", "Side of the window, odd [65].")]
Sigma = Annotated[float | None, _text("sigma", "PIXELS", "Gaussian width of the window [19/65 of its side].")]
Stride = Annotated[
    str | None,
    _text("stride", "auto|PIXELS", "Measure every PIXELS-th pixel [auto: 4 where refined, else 1; fast: 4]."),
]
Border = Annotated[
    str | None,
    _text("border", "full|clip", "Where the whole window is inside, or up to the border [full]."),
]
Refine = Annotated[
    str | None,
    _text(
        "refine",
        "auto|STEPS",
        "Steps of the exact refinement, 0 for none [auto: 3 with affine-scene-flow, else 0; accurate: 8; fast: 0].",
    ),
]
RefineWindow = Annotated[
    str | None, _text("refine-window", "auto|PIXELS", "Side of the refinement's window, odd [auto: that of --window].")
]
Thin = Annotated[
    str | None,
    _text(
        "thin",
        "auto|PIXELS",
        "The refinement takes every PIXELS-th pixel [auto: a 21st of it, 2 at most for one camera; accurate: 1].",
    ),
]
RefineFrames = Annotated[
    str | None,
    _text(
        "refine-frames",
        "auto|N|BEFORE,BEHIND",
        "Frames around the reference frame that the refinement takes [auto: those of the model].",
    ),
]
Taps = Annotated[str | None, _text("taps", "3x1x1|3|5|7", "Derivative filters [5].")]
Blur = Annotated[float | None, _text("blur", "PX", "Gaussian that widens the filters along x, y: for fast motion [0].")]
BlurTime = Annotated[
    float | None, _text("blur-time", "FRAMES", "Gaussian that widens the filters along time: for slow motion [0].")
]
Prefilter = Annotated[
    str | None, _text("prefilter", "none|highpass|homomorphic", "Filter of every image against uneven light [none].")
]
SigmaPre = Annotated[float | None, _text("sigma-pre", "PIXELS", "Gaussian width of the prefilter [8].")]
Frames = Annotated[str | None, _text("frames", "A:B", "Frame indices to measure, B excluded [all].")]
Roi = Annotated[str | None, _text("roi", "x0,y0,x1,y1", "Pixels to measure, x1 and y1 excluded [all].")]
Mask = Annotated[str | None, _text("mask", "FILE", "Image whose zero pixels are left out.")]
Preshift = Annotated[
    str | None,
    _text(
        "preshift",
        "auto|uniform|adaptive|X[,Y]",
        "Disparity per camera step taken out beforehand, whole pixels: given, found, or for every pixel (with motion) "
        "[auto].",
    ),
]
DisparityRange = Annotated[
    str | None,
    _text("disparity-range", "auto|A,B", "Disparities that the search looks at, px per step [auto]."),
]
MotionRange = Annotated[
    str | None, _text("motion-range", "auto|PX", "Largest motion that the search looks at, px/frame [auto: 24].")
]
Precision = Annotated[str | None, _text("precision", "f32|f64", "Floating-point numbers of the kernels [f32].")]
Arch = Annotated[str | None, _text("arch", "auto|cpu|cuda|vulkan|metal", "Device [auto].")]
MaxMemory = Annotated[str | None, _text("max-memory", "SIZE", "Limit such as 8G [half of the machine's memory].")]
Threads = Annotated[str | None, _text("threads", "auto|N", "CPU threads of a process [auto].")]
Workers = Annotated[str | None, _text("workers", "N", "Processes that share the work [1].")]

Outside = Annotated[
    bool, typer.Option("--outside", help="Allow a capture.toml that names files outside its own folder.")
]

Config = Annotated[Path | None, _text("config", "run.toml", "Configuration file.")]
Sets = Annotated[
    list[str] | None, _text("set", "KEY=VALUE", "One value of the configuration, e.g. filters.taps=7.")
]  # fmt: skip

SETTINGS: dict[str, Any] = {
    "preset": Preset, "model": Model, "motion": Motion, "deformation": Deformation, "rows": Rows,
    "brightness": Brightness, "brightness_terms": BrightnessTerms, "constraint": Constraint, "beta": Beta,
    "depth": Depth, "estimator": Estimator, "scale": Scale, "penalty": Penalty, "robust": Robust, "solver": Solver,
    "weighting": Weighting, "noise": Noise, "window": Window, "sigma": Sigma, "stride": Stride, "border": Border,
    "refine": Refine, "refine_window": RefineWindow, "thin": Thin, "refine_frames": RefineFrames, "taps": Taps,
    "blur": Blur, "blur_time": BlurTime, "prefilter": Prefilter,
    "sigma_pre": SigmaPre, "frames": Frames, "roi": Roi, "mask": Mask, "preshift": Preshift,
    "disparity_range": DisparityRange, "motion_range": MotionRange,
    "precision": Precision, "arch": Arch, "max_memory": MaxMemory, "threads": Threads, "workers": Workers,
}  # fmt: skip
"""Keyword of the configuration -> its option."""


def with_settings(without: tuple[str, ...] = ()) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator: gives a command ``--config``, ``--set`` and the options of ``SETTINGS``, but those in ``without``.

    The command's parameter ``settings`` is a function that returns the checked configuration; its arguments are
    further ``"a.b=v"``, over which options and ``--set`` win. It raises ConfigError.
    """
    kinds = {"config": Config, "sets": Sets} | {name: kind for name, kind in SETTINGS.items() if name not in without}

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(command)
        def wrapper(**values: Any) -> None:
            given = {name: values.pop(name) for name in kinds}
            file, sets = given.pop("config"), given.pop("sets") or ()

            def settings(*defaults: str) -> Any:
                from leafflow_ti.config import load_config

                return load_config(file, (*defaults, *sets), given)

            command(**values, settings=settings)

        own = (p for p in inspect.signature(command, eval_str=True).parameters.values() if p.name != "settings")
        return with_parameters(wrapper, own, kinds)

    return decorate


def with_parameters(
    wrapper: Callable[..., None], own: Iterable[inspect.Parameter], added: Mapping[str, Any]
) -> Callable[..., None]:
    """The wrapper of a command, called with the command's ``own`` parameters and the ``added`` ones: name -> option.

    The command line is made from the signature.
    """
    keyword = inspect.Parameter.KEYWORD_ONLY
    parameters = [
        *(p.replace(kind=keyword) for p in own),
        *(inspect.Parameter(name, keyword, default=None, annotation=kind) for name, kind in added.items()),
    ]
    del wrapper.__wrapped__  # type: ignore[attr-defined]
    wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {p.name: p.annotation for p in parameters}
    return wrapper
