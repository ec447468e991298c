"""The plan of the exact refinement: which samples of which images, which unknowns.

A pure value; stages and kernels read it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from leafflow_ti.config import RunConfig
from leafflow_ti.errors import ConfigError
from leafflow_ti.field import (
    CORRELATIONS,
    FLOW_GRADIENT_NAMES,
    MOTION_NAMES,
    PLANE_STRAIN_NAMES,
    PRINCIPAL_NAMES,
    STRAIN_NAMES,
)
from leafflow_ti.models import MODELS
from leafflow_ti.presets import REFINED_WINDOW
from leafflow_ti.sampling import AxisSampling
from leafflow_ti.splines import filter_radius, support

PIXEL_VARIANCE = 1 / 12
"""Variance of a pixel's area [px²], over which the sensor has averaged already."""
_TERMS = {"none": 0, "temporal": 1, "spatial": 3, "camera": 6}
"""Brightness model -> photometric terms of an image: gain; its slopes; its curvatures."""
_RIGID = 3 + len(MOTION_NAMES)
"""Parameters of a patch that does not deform: Z0, ZX, ZY, N, Ω, A; behind them stand growth rates."""
_IN_PLANE = (3, 4, 8, 9, 10)
"""Parameters that move a plane within itself where it faces the camera: N_X, N_Y, Ω_Z, A_X, A_Y."""
_FLAT_NAMES = ("flow_x", "flow_y", *FLOW_GRADIENT_NAMES, *PLANE_STRAIN_NAMES)


@dataclass(frozen=True)
class Refinement:
    """At most ``steps`` Gauss-Newton steps on the exact moving patch.

    ``size``, ``sigma``: Gaussian window [px], of which every ``thin``-th pixel around the centre is a sample.
    ``frames``: offsets from where the results lie in time, in frames, of any spacing; where frames are uneven, each
    reference frame has its own, and these are the farthest. ``cameras``: (x, y) steps from the reference camera, in
    the order of a block's images (rows, then columns). Unknowns are depth and slopes (Z0, ZX, ZY); ``motion``: how
    many of (N, Ω, A): 0, 3, 6 or 9; ``modes`` of the deformation in the patch's plane: 0, 1 (growth alike in all
    directions), 3 (strain rates). ``terms``: photometric terms of each image, 0, 1, 3 or 6. ``degree``
    of the splines, 5 or 7.

    ``flat``: one camera sees a plane that faces it and moves within itself. Depth and focal length are 1, so that its
    lengths are pixels of the image; slopes, and what would lead out of the plane, are 0.
    """

    steps: int
    size: int
    sigma: float
    thin: int
    frames: tuple[float, ...]
    cameras: tuple[tuple[float, float], ...]
    motion: int
    modes: int
    terms: int
    degree: int = 5
    flat: bool = False

    @property
    def estimated(self) -> tuple[int, ...]:
        """Which of the parameters (Z0, ZX, ZY, N, Ω, A, growth rates) are unknown."""
        rigid = [i for i in range(3 + self.motion) if not self.flat or i in _IN_PLANE]
        return (*rigid, *range(_RIGID, _RIGID + self.modes))

    @property
    def unknowns(self) -> int:
        """Unknowns of a pixel, photometric terms and texture left out."""
        return len(self.estimated)

    @property
    def turns(self) -> bool:
        """Whether the rotation is among the unknowns."""
        return self.motion > 3

    @property
    def across(self) -> int:
        """Samples along one axis of the window."""
        return samples_across(self.size, self.thin)

    @property
    def residuals(self) -> int:
        """Samples of all images."""
        return self.across**2 * len(self.frames) * len(self.cameras)

    @property
    def reach(self) -> int:
        """Pixels that a sample may lie from its place in the preshifted window."""
        steps = max(max(abs(x), abs(y)) for x, y in self.cameras)
        return math.ceil(steps + 2 * max(abs(t) for t in self.frames)) + 4

    @property
    def halo(self) -> int:
        """Pixels of the images that a measurement needs on each side."""
        return self.size // 2 + self.reach + support(self.degree) + filter_radius(self.degree)

    def widening(self, halo_y: int, halo_x: int) -> int:
        """Pixels that it needs on every side around a block of a model with these halos."""
        return max(0, self.halo - min(halo_y, halo_x))

    @property
    def names(self) -> tuple[str, ...]:
        """Maps that are measured, in the order of the unknowns; strain rates and their principal axes stand behind the
        growth they make up, correlations behind all."""
        if self.flat:
            axes = PRINCIPAL_NAMES if self.modes == 3 else ()
            return (*(n for n in _FLAT_NAMES if n not in self.excluded), *axes)
        growth = ("growth_rate",) if self.modes else ()
        strain = (*STRAIN_NAMES, *PRINCIPAL_NAMES) if self.modes == 3 else ()
        correlations = CORRELATIONS if self.motion else ()
        return ("depth", "slope_x", "slope_y", *MOTION_NAMES[: self.motion], *growth, *strain, *correlations)

    @property
    def excluded(self) -> frozenset[str]:
        """Maps that a model may measure, and that are 0 by what the refinement takes as given."""
        if not self.flat:
            return frozenset() if self.modes else frozenset({"growth_rate"})
        if self.modes == 3:
            return frozenset()
        stiff = ("strain_xy",) if self.modes else ("flow_xx", "flow_yy", *PLANE_STRAIN_NAMES)
        return frozenset(stiff if self.turns else (*stiff, "flow_xy", "flow_yx"))

    def describe(self) -> str:
        """One line of the plan."""
        modes = {0: "no deformation", 1: "growth", 3: "strain"}[self.modes]
        rigid = f"depth, slopes, {self.motion} of motion"
        if self.flat:
            rigid = ", ".join(("flow", "rotation", "acceleration")[: self.motion // 3])
        return (
            f"refinement  at most {self.steps} steps, window of {self.size} px thinned by {self.thin} "
            f"({self.across**2} samples), {len(self.frames)} frames of {len(self.cameras)} cameras; {self.unknowns} "
            f"unknowns ({rigid}, {modes}), {self.terms} photometric terms an image, "
            f"splines of degree {self.degree}"
        )


@dataclass(frozen=True)
class Effort:
    """What refining took: ``refined`` pixels, those tried twice twice; ``passes`` over the window, one a step; in how
    many of them all images were sampled (``samplings``): in the first, and where the warps had moved since.

    Fractions: per output pixel.
    """

    refined: float = 0
    passes: float = 0
    samplings: float = 0

    @classmethod
    def most(cls, plan: Refinement) -> Effort:
        """Of one pixel, at most, tried once."""
        return cls(1, plan.steps, plan.steps)

    def __add__(self, other: Effort) -> Effort:
        return Effort(self.refined + other.refined, self.passes + other.passes, self.samplings + other.samplings)

    def per(self, pixels: float) -> Effort:
        """The share of one of so many output pixels."""
        return Effort(self.refined / pixels, self.passes / pixels, self.samplings / pixels)


def samples_across(size: int, thin: int) -> int:
    """Samples along one axis of a window of ``size`` pixels: every ``thin``-th around its centre."""
    return 2 * (size // 2 // thin) + 1


def frames_around(config: RunConfig, time: AxisSampling) -> tuple[int, int]:
    """Frames before and behind a reference frame that its results need, by the model's ``time`` and the refinement.

    Raises ConfigError where the refinement is to take fewer than the model.
    """
    wanted, needed = config.refine.frames, (time.before, time.after)
    if not config.refine.steps or isinstance(wanted, str):
        return needed
    if MODELS[config.model.name].ranges:
        raise ConfigError(
            f"refine.frames = {wanted[0]},{wanted[1]}: model 'range-flow' is refined with the frames of its own "
            "window: leave it out"
        )
    if wanted[0] < needed[0] or wanted[1] < needed[1]:
        raise ConfigError(
            f"refine.frames = {wanted[0]},{wanted[1]}: the model looks at {needed[0]} frames before and {needed[1]} "
            "behind already: choose at least these, or fewer --taps-time or a smaller --size-time"
        )
    return wanted


def plan_refinement(
    config: RunConfig,
    temporal: tuple[float, ...] | None,
    cameras: Iterable[tuple[float, float]],
    image: tuple[int, int],
) -> Refinement | None:
    """The refinement that a resolved configuration asks for; None: none.

    ``temporal``: offsets of the frames around the reference (``frames_around``), None if the model is static;
    ``cameras``: as of ``Refinement``, all that are read; ``image``: rows and columns. Raises ConfigError where they do
    not fit.
    """
    model, window, cameras = config.model, config.window, tuple(cameras)
    steps, size, thin = (int(value) for value in (config.refine.steps, config.refine.window, config.refine.thin))
    flat = MODELS[model.name].cameras == "reference"
    if not steps:
        if flat and model.deformation != "auto":
            raise ConfigError(
                f"deformation '{model.deformation}': of model '{model.name}' only the refinement has a choice: give "
                "--refine 3, or leave deformation out"
            )
        if model.deformation == "strain":
            raise ConfigError(
                "deformation 'strain' is measured by the refinement alone: give --refine 3, or choose growth"
            )
        return None
    if len(cameras) == 1 and not flat:
        raise ConfigError(
            f"refine.steps = {steps}: model '{model.name}' reads one camera, and depth is refined from several: choose "
            "a model of a camera grid, flow-affine for motion in the image, or --refine 0"
        )
    if temporal is None and model.deformation in ("growth", "strain"):
        raise ConfigError(
            f"deformation '{model.deformation}': model '{model.name}' is static: choose deformation none, or a model "
            "with time"
        )
    if temporal is None and config.refine.frames != "auto":
        raise ConfigError(f"refine.frames: model '{model.name}' is static: leave it out, or choose a model with time")
    if size > min(image):
        raise ConfigError(
            f"refine.window = {size}: the images have {image[1]} x {image[0]} pixels: choose a --refine-window of at "
            f"most {min(image) - 1 + min(image) % 2}, or --refine 0"
        )
    if samples_across(size, thin) < REFINED_WINDOW:
        most = size // 2 // (REFINED_WINDOW // 2)
        raise ConfigError(
            f"refine.thin = {thin} leaves {samples_across(size, thin)} samples across a window of {size} px, "
            f"{REFINED_WINDOW} are needed: choose --thin {most} at most, or a larger --refine-window"
        )
    motion, modes = 0, 0
    if temporal is not None:
        # A point that turns accelerates by ω²R: without A among the unknowns it is the velocity that errs.
        # Two frames do not show it, nor does it move their difference.
        motion = 3 if model.motion == "translation" else 6 if len(temporal) == 2 else 9
        modes = {"none": 0, "growth": 1, "strain": 3}.get(model.deformation, 3 if flat else 1)
    curved = model.brightness != "none" and model.brightness_terms in ("space", "both")
    terms = 6 if curved else _TERMS[model.brightness]
    sigma = window.sigma * size / window.size
    frames = temporal or (0.0,)
    return Refinement(
        steps, size, sigma, thin, frames, cameras, motion, modes, terms, int(config.refine.spline), flat
    )  # fmt: skip
