"""The plan of range flow: where its range comes from, how it is weighted, and what is estimated from both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from leafflow_ti.capture import Capture
from leafflow_ti.config import RunConfig
from leafflow_ti.errors import ConfigError, InputError
from leafflow_ti.model_plan import weighing
from leafflow_ti.models import TensorLayout
from leafflow_ti.range_flow import columns, images, smoothed_samples, window_radius
from leafflow_ti.range_source import GivenRange, open_range
from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.problem import Problem


@dataclass(frozen=True, eq=False)
class RangePlan:
    """``given`` range maps, or our own: the static ``depth`` problem with its ``layout``.

    ``working_mm``: distance at which the unknowns are counted in px; ``image_noise``: of the reference camera, in grey
    values.
    """

    constraint: str
    beta: float
    working_mm: float
    image_noise: float
    given: GivenRange | None
    depth: Problem | None
    layout: TensorLayout | None

    @property
    def gradients(self) -> bool:
        """Whether derivative images are needed."""
        return len(images(self.constraint)) > 2

    @property
    def quantities(self) -> tuple[str, ...]:
        """Maps of the range."""
        return ("depth",) if self.depth is None else ("disparity", "depth", "slope_x", "slope_y")

    @property
    def samples(self) -> float:
        """White samples behind each value of the range."""
        if self.depth is not None:
            return smoothed_samples(self.depth.sampling.x, self.depth.sampling.y)
        return self.given.smoothing if self.given else 1.0

    def reach(self, sampling: Sampling, axis: str) -> int:
        """Pixels beyond range flow's own window that its images need along an image axis."""
        own = self.depth.sampling.axis(axis).radius if self.depth else 0
        return max(own, sampling.axis(axis).filter_radius if self.gradients else 0)

    def describe(self) -> str:
        """One line of the plan."""
        source = f"given by {self.given.path}" if self.given else "depth of every frame from the cameras"
        if self.depth:
            source += f" (window of {self.depth.sampling.x.size} px before that of range flow)"
        return (
            f"range       {source}; constraint {self.constraint}, beta {self.beta:g}, noise of the images "
            f"{self.image_noise:.3g}, working distance {self.working_mm:.4g} mm"
        )


def range_problem(
    capture: Capture,
    config: RunConfig,
    sampling: Sampling,
    frames: tuple[int, ...],
    depth: Problem | None,
    preshift: tuple[int, int],
    noise: float,
) -> tuple[Problem, RangePlan]:
    """Range flow on ``frames`` with one camera's ``sampling``; ``depth``: our own range, None where it is given;
    ``noise`` of the images, in grey values.

    Reads one given range map. Raises ConfigError for choices that exclude each other,
    InputError for range maps that do not fit.
    """
    chosen, model = config.range_flow, config.model
    noise = noise or 1.0  # without any, the range is weighted as if the images had some
    if model.rows != "auto":
        raise ConfigError(f"rows '{model.rows}': model 'range-flow' has no rows to choose from, leave it out")
    if chosen.constraint != "taylor" and model.brightness_terms != "none":
        raise ConfigError(
            f"brightness_terms '{model.brightness_terms}': constraint '{chosen.constraint}' takes the brightness for "
            "constant, choose constraint taylor"
        )
    if depth is None and model.brightness != "none":
        raise ConfigError(
            f"brightness '{model.brightness}' is that of depth from the cameras, and depth is given: leave it out"
        )
    geometry = capture.geometry
    if geometry is None:
        raise ConfigError("model 'range-flow' needs the focal length: add [camera] focal_length_px to the capture.toml")
    given = None
    if depth is None:
        assert chosen.depth is not None
        t = sampling.t
        given = open_range(chosen.depth, capture, range(frames[0] - t.before, frames[-1] + t.after + 1))
        seen = given.frame(given.middle)[0]
        if not np.isfinite(seen).any():
            raise InputError(f"{given.path}: no depth at all in frame {given.middle}: give maps that have some")
        working = float(np.nanmedian(seen))
    else:
        along = 0 if depth.camera_axes[0] == "sx" else 1
        step = preshift[along] + geometry.disparity_offset_px[along]
        working = geometry.f_px * abs(geometry.baseline_mm[along]) / max(abs(step), 1.0)
    layout = TensorLayout.of(depth.columns) if depth else None
    plan = RangePlan(chosen.constraint, chosen.beta, working, noise, given, depth, layout)
    # A range that was smoothed over windows has next to no noise of its own from pixel to pixel.
    share = 1 / (chosen.beta**2 * plan.samples)
    scale = (working / geometry.f_px, working / window_radius(sampling))
    found = columns(chosen.constraint, sampling, model.brightness_terms, share)
    problem = Problem(found, sampling, model.estimator, model.solver, fitted=3, range_scale=scale, **weighing(config))
    return problem, plan
