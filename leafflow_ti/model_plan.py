"""What a model estimates on a capture: its columns and rows, filters and windows, and the cameras that it reads."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from leafflow_ti.capture import Capture
from leafflow_ti.config import RunConfig
from leafflow_ti.errors import ConfigError, InputError
from leafflow_ti.filters import choose_filter_set, filter_set
from leafflow_ti.models import MODELS, OWN_FLOW, Model, column_set, flow_offsets, parse_rows
from leafflow_ti.sampling import AxisSampling, Sampling
from leafflow_ti.stages.problem import OwnFlows, Problem, unknowns_of


def check_model(name: str, capture: Capture) -> None:
    model = MODELS[name]
    cameras = capture.n_rows * capture.n_cols
    if model.ranges and cameras == 1:
        raise ConfigError(
            "model 'range-flow' needs a camera grid or range maps, the capture has one camera: give --depth"
        )
    if model.cameras != "reference" and cameras == 1:
        raise ConfigError(f"model '{name}' needs a camera grid, the capture has one camera: choose flow or flow-affine")
    if model.time and capture.n_frames < 3:
        raise ConfigError(f"model '{name}' needs at least 3 frames, the capture has {capture.n_frames}: choose depth")
    if name == "affine-5d" and min(capture.n_rows, capture.n_cols) == 1:
        grid = f"{capture.n_rows} x {capture.n_cols}"
        raise ConfigError(f"model 'affine-5d' needs a 2D camera grid, the capture has {grid}: choose affine-4d")


def model_problem(capture: Capture, config: RunConfig, name: str, motion: str | None) -> Problem:
    """What a model (but range flow) estimates."""
    model = MODELS[name]
    row, col = capture.reference
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
            own = _own_flows(config, model, motion, offsets, sampling, (capture.n_rows, capture.n_cols), (row, col))
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
    config: RunConfig, model: Model, motion: str, offsets: tuple[str, ...], sampling: Sampling,
    counts: tuple[int, int], reference: tuple[int, int],
) -> OwnFlows:  # fmt: skip
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
    steps = [(i - reference[1], j - reference[0]) for j in range(counts[0]) for i in range(counts[1])]
    if model.reference_rows:
        steps.remove((0, 0))
    unknowns = unknowns_of(motion, columns, all_cameras=True)
    kept = tuple(o for o in offsets if o == "1" or columns.index("x", o) is not None)
    if config.model.deformation == "growth" and not config.refine.steps and "x" not in kept:
        raise ConfigError("deformation 'growth' is seen in the flow's derivatives: choose rows that begin with 2d")
    growth = config.model.deformation != "none" and "x" in kept
    return OwnFlows(columns, alone, tuple(steps), kept, unknowns, model.reference_rows, growth)


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
    row, col = capture.reference
    use_x = capture.n_cols > 1 and cameras != "reference"
    use_y = capture.n_rows > 1 and (cameras == "grid" or (cameras == "line" and not use_x))
    w = config.window
    camera = ("cameras", config.filters.taps_camera, w.size_camera, w.sigma_camera, config.filters.taps)
    frames = ("frames", config.filters.taps_time, w.size_time, w.sigma_time, config.filters.taps)
    filters = filter_set(config.filters.taps).blurred(config.filters.blur)
    pixel = AxisSampling.gaussian(filters, w.size, w.sigma, int(w.stride))
    return Sampling(
        pixel,
        pixel,
        _series(capture.n_cols, col, *camera) if use_x else AxisSampling(),
        _series(capture.n_rows, row, *camera) if use_y else AxisSampling(),
        _series(capture.n_frames, capture.n_frames // 2, *frames, sequence=True) if time else AxisSampling(),
    )


def _series(
    n: int, centre: int, what: str, taps: str, size: int | str, sigma: float, largest: str, sequence: bool = False
) -> AxisSampling:
    """Filters and window along a camera or time axis of ``n`` samples."""
    usable = n if sequence else 2 * min(centre, n - 1 - centre) + 1
    usable -= 1 - usable % 2
    chosen = choose_filter_set(usable, largest) if taps == "auto" else filter_set(taps)
    if chosen is None or 2 * chosen.radius + 1 > usable:
        needed = 3 if chosen is None else 2 * chosen.radius + 1
        raise InputError(
            f"{n} {what} are too few: {needed} around the middle one are needed: record more, or use 3 taps"
        )
    longest = usable - 2 * chosen.radius
    if size == "auto":
        size = min(5, longest)
    if int(size) > longest:
        raise ConfigError(
            f"a window of {size} {what} with {2 * chosen.radius + 1} taps is too long, {usable} lie around the middle: "
            f"choose a window of at most {longest}, or fewer taps"
        )
    return AxisSampling.gaussian(chosen, int(size), sigma)
