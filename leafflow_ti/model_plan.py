"""What a model estimates on a capture: its columns and rows, filters and windows, and the cameras that it reads."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Capture
from leafflow_ti.config import RunConfig
from leafflow_ti.errors import ConfigError, InputError
from leafflow_ti.filters import FilterSet, blur_radius, choose_filter_set, filter_set
from leafflow_ti.models import MODELS, OWN_FLOW, Model, column_set, flow_offsets, parse_rows
from leafflow_ti.sampling import AxisSampling, Sampling
from leafflow_ti.stages.problem import OwnFlows, Problem, unknowns_of
from leafflow_ti.uneven import SAME, UnevenGrid, UnevenSampling, is_even


def check_model(name: str, capture: Capture) -> None:
    model = MODELS[name]
    cameras = capture.n_rows * capture.n_cols
    if model.ranges and cameras == 1:
        raise ConfigError(
            "model 'range-flow' needs a camera grid or range maps, the capture has one camera: give --depth"
        )
    if model.cameras != "reference" and cameras == 1:
        raise ConfigError(f"model '{name}' needs a camera grid, the capture has one camera: choose flow or flow-affine")
    if model.time and capture.n_frames < 2:
        raise ConfigError(f"model '{name}' needs at least 2 frames, the capture has {capture.n_frames}: choose depth")
    if name == "affine-5d" and min(capture.n_rows, capture.n_cols) == 1:
        grid = f"{capture.n_rows} x {capture.n_cols}"
        raise ConfigError(f"model 'affine-5d' needs a 2D camera grid, the capture has {grid}: choose affine-4d")


def model_problem(capture: Capture, config: RunConfig, name: str, motion: str | None) -> Problem:
    """What a model (but range flow) estimates."""
    model = MODELS[name]
    sampling = sampling_of(capture, config, model.cameras, model.time)
    columns = column_set(
        model, config.model.brightness, sampling.camera_axes, sampling.sampled, config.model.brightness_terms
    )
    offsets = flow_offsets(columns)
    use_range, fitted, own = False, 0, None
    if motion:
        rows = config.model.rows if model.reference_rows else "2d"
        offsets, use_range = parse_rows(rows, name, motion, columns)
        fitted = unknowns_of(motion, columns)
        n_rows = 2 * len(offsets) + use_range
        if model.own_flows:
            own = _own_flows(config, model, motion, offsets, sampling, capture)
            if motion == "translation":
                fitted = min(fitted, n_rows)
        if fitted > n_rows:
            raise ConfigError(
                f"motion '{motion}' has {fitted} unknowns, rows '{config.model.rows}' give {n_rows} equations: choose "
                "more rows, a simpler motion, or more frames and cameras"
            )
    return Problem(
        columns, sampling, config.model.estimator, config.model.solver, config.model.weighting == "wls",
        offsets, use_range, fitted, own, **weighing(config),
    )  # fmt: skip


def weighing(config: RunConfig) -> dict[str, Any]:
    """What estimators that weigh windows anew, or work in raw units, are told."""
    model = config.model
    return {"scale": model.scale, "penalty": model.penalty, "robust": model.robust}


def fitted_motion(config: RunConfig, name: str) -> str | None:
    """The motion that is fitted; None for a model without a 3D fit."""
    wanted, motions = config.model.motion, MODELS[name].motions
    if MODELS[name].cameras == "reference" and config.refine.steps:
        return None  # the choice is the refinement's
    if wanted != "auto" and wanted not in motions:
        can = f"it measures {', '.join(motions)}" if motions else "it measures no 3D motion"
        raise ConfigError(
            f"motion '{wanted}': model '{name}' does not have it, {can}: choose --motion auto or another model"
        )
    return (motions[0] if wanted == "auto" else wanted) if motions else None


def _own_flows(
    config: RunConfig, model: Model, motion: str, offsets: tuple[str, ...], sampling: Sampling, capture: Capture
) -> OwnFlows:
    """The flow of every camera but the one whose rows the reference model gives."""
    if not model.reference_rows:
        if config.model.rows not in ("auto", "u"):
            raise ConfigError(
                f"rows '{config.model.rows}': model 'scene-flow' takes the flow alone: choose rows u, or "
                "affine-scene-flow"
            )
        offsets = ("1",)
    alone = Sampling(sampling.x, sampling.y, t=sampling.t)
    columns = column_set(OWN_FLOW, config.model.brightness, (), alone.sampled, config.model.brightness_terms)
    (row, col), (x, y) = capture.reference, capture.camera_steps
    steps = [(i - col, j - row) for j in range(capture.n_rows) for i in range(capture.n_cols)]
    if model.reference_rows:
        steps.remove((0, 0))
    places = [(float(x[row + j, col + i]), float(y[row + j, col + i])) for i, j in steps]
    unknowns = unknowns_of(motion, columns, all_cameras=True)
    kept = tuple(o for o in offsets if o == "1" or columns.index("x", o) is not None)
    if config.model.deformation == "growth" and not config.refine.steps and "x" not in kept:
        raise ConfigError("deformation 'growth' is seen in the flow's derivatives: choose rows that begin with 2d")
    growth = config.model.deformation != "none" and "x" in kept
    return OwnFlows(columns, alone, tuple(steps), kept, unknowns, model.reference_rows, growth, tuple(places))


def cameras_read(
    sampling: Sampling, own: OwnFlows | None, row: int, col: int
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Rows and columns of the cameras that are read: those under filters and window, or every one."""

    def reached(centre: int, radius: int, steps: Iterable[int]) -> tuple[int, ...]:
        return tuple(range(centre + min(-radius, *steps), centre + max(radius, *steps) + 1))

    steps = own.steps if own else ()
    return (
        reached(row, sampling.sy.radius, (0, *(s[1] for s in steps))),
        reached(col, sampling.sx.radius, (0, *(s[0] for s in steps))),
    )


def static(config: RunConfig) -> RunConfig:
    """The configuration for the depth of single frames, of every pixel: the motion's own choices do not concern it."""
    model = config.model.model_copy(update={"brightness_terms": "none"})
    window = config.window.model_copy(update={"stride": 1})
    return config.model_copy(update={"model": model, "window": window})


def sampling_of(capture: Capture, config: RunConfig, cameras: str, time: bool) -> Sampling:
    """Filters and windows for ``cameras`` as ``models.Model`` has them, with or without a temporal axis."""
    w, taps = config.window, config.filters.taps
    filters = filter_set(taps).blurred(config.filters.blur)
    pixel = AxisSampling.gaussian(filters, w.size, w.sigma, int(w.stride))
    along_t = AxisSampling()
    if time:
        chosen = config.filters
        frames = _Series("frames", chosen.taps_time, w.size_time, w.sigma_time, taps, chosen.blur_time)
        along_t = frames.sequence(capture.n_frames, capture.frame_times)
    cameras_of = _Series("cameras", config.filters.taps_camera, w.size_camera, w.sigma_camera, taps)
    along_x, along_y, grid = _cameras(capture, cameras_of, cameras)
    return Sampling(pixel, pixel, along_x, along_y, along_t, grid)


def _cameras(capture: Capture, series: _Series, cameras: str) -> tuple[AxisSampling, AxisSampling, UnevenGrid | None]:
    """The axes sx and sy, and the kernels of both where cameras do not stand in straight rows and columns."""
    row, col = capture.reference
    use_x = capture.n_cols > 1 and cameras != "reference"
    use_y = capture.n_rows > 1 and (cameras == "grid" or (cameras == "line" and not use_x))
    along_x = series.line(capture.n_cols, col) if use_x else AxisSampling()
    along_y = series.line(capture.n_rows, row) if use_y else AxisSampling()
    if capture.positions_mm is None:
        return along_x, along_y, None
    x, y = capture.camera_steps
    rows = slice(row - along_y.radius, row + along_y.radius + 1)
    cols = slice(col - along_x.radius, col + along_x.radius + 1)
    mean_x, mean_y = x[rows].mean(axis=0), y[:, cols].mean(axis=1)
    along_x = _at_places(along_x, series.sigma, mean_x, col)
    along_y = _at_places(along_y, series.sigma, mean_y, row)
    straight = np.allclose(x[rows], mean_x, 0, SAME) and np.allclose(y[:, cols], mean_y[:, None], 0, SAME)
    if straight or not (use_x and use_y):
        return along_x, along_y, None
    places = [tuple(map(tuple, some.tolist())) for some in (x, y)]
    means = [tuple(mean.tolist()) for mean in (mean_x, mean_y)]
    return along_x, along_y, UnevenGrid(places[0], places[1], along_x, along_y, (row, col), means[0], means[1])


def _at_places(axis: AxisSampling, sigma: float, places: NDArray[np.float64], centre: int) -> AxisSampling:
    """The axis with its samples at ``places`` [nominal steps]; itself where these are even."""
    if axis.filters is None or np.allclose(places, np.arange(len(places)) - centre, 0, SAME):
        return axis
    return UnevenSampling.of(axis.filters, axis.size, sigma, tuple(places.tolist()), centre)


@dataclass(frozen=True)
class _Series:
    """What is asked of the filters and the window along a camera or time axis; ``what``: its samples in words;
    ``blur``: of the filters, in samples."""

    what: str
    taps: str
    size: int | str
    sigma: float
    largest: str
    blur: float = 0.0

    def line(self, n: int, centre: int) -> AxisSampling:
        """For ``n`` cameras with the reference at index ``centre``."""
        return AxisSampling.gaussian(*self._chosen(n, 2 * min(centre, n - 1 - centre) + 1), self.sigma)

    def sequence(self, n: int, times: tuple[float, ...]) -> AxisSampling:
        """For ``n`` frames at ``times`` [nominal intervals]."""
        filters, size = self._chosen(n, n)
        if is_even(np.array(times)):
            return AxisSampling.gaussian(filters, size, self.sigma)
        first = AxisSampling.gaussian(filters, size, self.sigma).before
        return UnevenSampling.of_frames(filters, size, self.sigma, times, first)

    def _chosen(self, n: int, usable: int) -> tuple[FilterSet, int]:
        """Filters and window size where ``usable`` of ``n`` samples lie around the middle one."""
        wider = 2 * blur_radius(self.blur)
        if self.taps != "auto":
            chosen: FilterSet | None = filter_set(self.taps)
        elif usable == 2:
            chosen = filter_set("2")
        else:
            chosen = choose_filter_set(usable - wider, self.largest)
        chosen = chosen and chosen.blurred(self.blur)
        if chosen is None or chosen.taps > usable:
            needed = 3 + wider if chosen is None else chosen.taps
            less = f", or less than blur_time {self.blur:g}" if wider else ""
            raise InputError(
                f"{n} {self.what} are too few: {needed} around the middle one are needed: record more, or use 3 taps"
                + less
            )
        longest = usable - chosen.taps + 1
        longest -= 1 - longest % 2
        size = min(5, longest) if self.size == "auto" else int(self.size)
        if size > longest:
            raise ConfigError(
                f"a window of {size} {self.what} with {chosen.taps} taps is too long, {usable} lie around the middle: "
                f"choose a window of at most {longest}, or fewer taps"
            )
        return chosen, size
