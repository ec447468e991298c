"""The plan of a run, a pure value: what is computed, from which windows, in which units, with how much memory.

It is what ``--dry-run`` prints and what the pipeline executes. Making it reads grey values only to find a preshift, and
for range flow the noise of one image.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from leafflow_ti.capture import Capture, Geometry, find_preshift
from leafflow_ti.config import RunConfig, resolve_model
from leafflow_ti.errors import ConfigError, InputError
from leafflow_ti.filters import choose_filter_set, filter_set
from leafflow_ti.models import MODELS, OWN_FLOW, Model, TensorLayout, column_set, parse_rows
from leafflow_ti.range_plan import RangePlan, range_problem
from leafflow_ti.sampling import AxisSampling, Sampling
from leafflow_ti.stages.prefilter import prefilter_bytes
from leafflow_ti.stages.problem import BRIGHTNESS_MAPS, WORLD_MAPS, OwnFlows, Problem, unknowns_of
from leafflow_ti.stages.tensor import Band, band_bytes

BAND_PIXELS = 1 << 17
"""Output pixels of a unit where memory allows: large enough to amortise halos, small enough to answer an interrupt."""
INDEXED = 2**31 - 1
"""Numbers of a unit's arrays: kernels count them in 32 bits."""
MOTION_NAMES = tuple(f"{q}_{a}" for q in ("velocity", "rotation", "acceleration") for a in "xyz")


@dataclass(frozen=True)
class Unit:
    """One band of output rows of one frame: the smallest piece that is written and resumed."""

    index: int
    t_index: int
    band: int
    rows: slice


@dataclass(frozen=True, eq=False)
class Plan:
    """What a run does; see the fields. Pixel positions of output row r and column c are ``y[r]``, ``x[c]``."""

    config: RunConfig
    model: str
    problem: Problem
    layout: TensorLayout
    geometry: Geometry
    cameras: tuple[tuple[int, ...], tuple[int, ...]]
    """Rows and columns of the cameras that are read."""
    preshift: tuple[int, int]
    frames: tuple[int, ...]
    y: range
    x: range
    band_rows: int
    bytes: int
    """Memory of the largest unit's arrays."""
    ranges: RangePlan | None = None

    def reach(self, axis: str) -> int:
        """Pixels that a measurement needs on each side along an image axis."""
        sampling = self.problem.sampling
        return sampling.axis(axis).radius + (self.ranges.reach(sampling, axis) if self.ranges else 0)

    @property
    def bands(self) -> int:
        """Units per frame."""
        return -(-len(self.y) // self.band_rows)

    @property
    def n_units(self) -> int:
        """Units of the run."""
        return self.bands * len(self.frames)

    @property
    def names(self) -> tuple[str, ...]:
        """Maps that the run writes, standard errors included."""
        kept = self.config.output.arrays
        available = tuple(n for base in self.quantities for n in (base, f"{base}_std"))
        if kept is None:
            return available
        for name in kept:
            if name not in available:
                known = ", ".join(self.quantities)
                raise ConfigError(f"output.arrays: model '{self.model}' gives no '{name}' here; it gives {known}")
        return tuple(n for n in available if n in kept)

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the measured maps."""
        problem = self.problem
        names: list[str] = []
        if problem.terms:
            names += ["disparity", "depth"]
        if "x" in problem.terms:
            names += ["slope_x", "slope_y"]
        names += self.ranges.quantities if self.ranges else ()
        names += MOTION_NAMES[: problem.unknowns]
        if "t" in problem.columns.solutions and not self.ranges:
            names += ["flow_x", "flow_y"]
        if problem.columns.index("i") is not None:
            names += [f"brightness_{a}" for a in problem.camera_axes]
        names += [BRIGHTNESS_MAPS[o] for o in problem.brightness]
        names += [WORLD_MAPS[o] for o in problem.world_brightness]
        if "depth" in names and problem.unknowns >= 3:
            names.append("growth_rate")
        return tuple(names)

    @property
    def margin(self) -> int:
        """Output pixels around a band, and around the region, that are computed for the sake of those inside."""
        return int(any(name.startswith("growth") for name in self.names))

    def band(self, index: int) -> slice:
        """Output rows of one band."""
        return slice(index * self.band_rows, min((index + 1) * self.band_rows, len(self.y)))

    def unit(self, t_index: int, band: int) -> Unit:
        """The unit of one frame and band."""
        return Unit(t_index * self.bands + band, t_index, band, self.band(band))

    def units(self) -> Iterator[Unit]:
        """All units in the order in which they are computed: band by band, through the sequence."""
        for band in range(self.bands):
            for t_index in range(len(self.frames)):
                yield self.unit(t_index, band)

    def describe(self) -> str:
        """The plan in words, one fact a line."""
        problem, sampling = self.problem, self.problem.sampling

        def axis(name: str) -> str:
            plan = sampling.axis(name)
            taps = f"{len(plan.filters.smooth)} taps" if plan.filters else "no filter"
            blocks = f" in {len(plan.blocks.weights)} blocks of {plan.blocks.step}" if plan.blocks else ""
            return f"{name}: {taps}, window of {plan.size}{blocks}"

        lines = [
            f"model       {self.model}: {MODELS[self.model].summary}, {problem.columns.n} columns, "
            f"{len(self.layout.entries)} distinct moments, {problem.columns.n_time_like} solutions",
            f"estimator   {problem.estimator}, solver {problem.solver}, "
            f"{'weighted' if problem.weighted else 'plain'} least squares",
        ]
        if self.ranges:
            lines.append(self.ranges.describe())
        elif problem.unknowns:
            rows = "+".join(problem.offsets) + ("+b5" if problem.use_range else "")
            n_rows = 2 * len(problem.offsets) + problem.use_range
            own = problem.own_flows
            taken = [f"{n_rows} rows ({rows})"] if own is None or own.reference_rows else []
            if own:
                taken.append(
                    f"{2 * len(own.offsets)} rows ({'+'.join(own.offsets)}) of each of {len(own.steps)} cameras' own "
                    f"flow, {own.columns.n} columns"
                )
            growing = " and growth" if own and own.growth else ""
            lines.append(f"motion      {problem.unknowns} unknowns{growing} from {' and '.join(taken)}")
        pixels = len(self.frames) * len(self.y) * len(self.x)
        limit = self.config.plan.max_memory
        filters = self.config.filters
        if filters.prefilter != "none":
            lines.append(f"prefilter   {filters.prefilter}, sigma {filters.sigma_pre:g} px")
        lines += [
            f"windows     {'; '.join(axis(a) for a in ('x', 'y', 'sx', 'sy', 't'))}",
            f"cameras     {len(self.cameras[0])} rows x {len(self.cameras[1])} columns, preshift "
            f"{self.preshift[0]},{self.preshift[1]} px per step",
            f"frames      {self.frames[0]}..{self.frames[-1]} ({len(self.frames)})",
            f"output      {len(self.y)} x {len(self.x)} pixels per frame, stride {self.config.window.stride}: "
            f"{', '.join(self.names)}",
            f"units       {self.n_units}: {self.bands} bands of up to {self.band_rows} rows per frame",
            f"memory      {self.bytes / 2**20:.0f} MiB for one unit, limit {limit / 2**20:.0f} MiB",
            f"disk        at most {pixels * (4 * len(self.names) + 1) / 2**20:.0f} MiB",
        ]
        return "\n".join(lines)


def make_plan(capture: Capture, config: RunConfig) -> Plan:
    """The plan for a capture and a configuration.

    Raises ConfigError where the two do not fit, InputError where the capture is too small.
    """
    name = resolve_model(config.model.name, capture.n_frames, capture.n_rows, capture.n_cols)
    model = MODELS[name]
    if not (model.ranges and config.range_flow.depth):
        _check_model(name, capture)
    if config.filters.prefilter == "highpass" and config.model.brightness != "none":
        raise ConfigError(
            f"brightness '{config.model.brightness}' is relative to the grey value, which prefilter 'highpass' takes "
            "away: choose prefilter homomorphic, or brightness none"
        )
    if config.model.deformation == "growth" and not model.own_flows:
        raise ConfigError(
            f"deformation 'growth': model '{name}' cannot tell it from approach: choose affine-scene-flow"
        )
    motion = _motion(config, name)
    preshift, ranges = (0, 0), None
    if model.ranges:
        own = None if config.range_flow.depth else _problem(capture, _static(config), "depth", None)
        preshift = _preshift(capture, config) if own else (0, 0)
        alone = _sampling(capture, config, "reference", True)
        frames = _frames(capture, config, alone.t.radius, True)
        problem, ranges = range_problem(capture, config, alone, frames, own, preshift)
    else:
        problem = _problem(capture, config, name, motion)
        frames = _frames(capture, config, problem.sampling.t.radius, model.time)
        preshift = _preshift(capture, config) if problem.camera_axes else (0, 0)
    layout = TensorLayout.of(problem.columns)
    x0, y0, x1, y1 = config.output.roi or (0, 0, capture.width, capture.height)
    if x1 > capture.width or y1 > capture.height:
        size = f"{capture.width} x {capture.height}"
        raise ConfigError(
            f"output.roi = {x0},{y0},{x1},{y1} reaches beyond the images of {size} pixels: make it smaller"
        )
    x, y = range(x0, x1, config.window.stride), range(y0, y1, config.window.stride)
    grid = (ranges.depth if ranges and ranges.depth else problem).sampling
    cameras = _cameras(grid, problem.own_flows, *capture.reference)
    n_cameras = len(cameras[0]) * len(cameras[1])
    band_rows, memory = _band_rows(config, problem, layout, ranges, n_cameras, len(y), len(x))
    return Plan(
        config, name, problem, layout, _geometry(capture),
        cameras, preshift, frames, y, x, band_rows, memory, ranges,
    )  # fmt: skip


def _sampling(capture: Capture, config: RunConfig, cameras: str, time: bool) -> Sampling:
    """Filters and windows for ``cameras`` as ``models.Model`` has them, with or without a temporal axis."""
    row, col = capture.reference
    use_x = capture.n_cols > 1 and cameras != "reference"
    use_y = capture.n_rows > 1 and (cameras == "grid" or (cameras == "line" and not use_x))
    w = config.window
    camera = ("cameras", config.filters.taps_camera, w.size_camera, w.sigma_camera, config.filters.taps)
    frames = ("frames", config.filters.taps_time, w.size_time, w.sigma_time, config.filters.taps)
    pixel = AxisSampling.gaussian(filter_set(config.filters.taps), w.size, w.sigma, w.stride)
    return Sampling(
        pixel,
        pixel,
        _series(capture.n_cols, col, *camera) if use_x else AxisSampling(),
        _series(capture.n_rows, row, *camera) if use_y else AxisSampling(),
        _series(capture.n_frames, capture.n_frames // 2, *frames, sequence=True) if time else AxisSampling(),
    )


def _static(config: RunConfig) -> RunConfig:
    """The configuration for the depth of single frames, of every pixel: the motion's own choices do not concern it."""
    model = config.model.model_copy(update={"brightness_terms": "none"})
    window = config.window.model_copy(update={"stride": 1})
    return config.model_copy(update={"model": model, "window": window})


def _problem(capture: Capture, config: RunConfig, name: str, motion: str | None) -> Problem:
    """What a model (but range flow) estimates."""
    model = MODELS[name]
    row, col = capture.reference
    sampling = _sampling(capture, config, model.cameras, model.time)
    columns = column_set(
        model, config.model.brightness, sampling.camera_axes, sampling.sampled, config.model.brightness_terms
    )
    offsets: tuple[str, ...] = ("1",)
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
        offsets, use_range, fitted, own,
    )  # fmt: skip


def _motion(config: RunConfig, name: str) -> str | None:
    """The motion that is fitted; None for a model without a 3D fit."""
    wanted, motions = config.model.motion, MODELS[name].motions
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
    growth = "x" in kept if config.model.deformation == "auto" else config.model.deformation == "growth"
    if growth and "x" not in kept:
        raise ConfigError("deformation 'growth' is seen in the flow's derivatives: choose rows that begin with 2d")
    return OwnFlows(columns, alone, tuple(steps), kept, unknowns, model.reference_rows, growth)


def _cameras(sampling: Sampling, own: OwnFlows | None, row: int, col: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Rows and columns of the cameras that are read: those under filters and window, or every one."""

    def reached(centre: int, radius: int, steps: Iterable[int]) -> tuple[int, ...]:
        return tuple(range(centre + min(-radius, *steps), centre + max(radius, *steps) + 1))

    steps = own.steps if own else ()
    return (
        reached(row, sampling.sy.radius, (0, *(s[1] for s in steps))),
        reached(col, sampling.sx.radius, (0, *(s[0] for s in steps))),
    )


def _check_model(name: str, capture: Capture) -> None:
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


def _frames(capture: Capture, config: RunConfig, radius: int, has_time: bool) -> tuple[int, ...]:
    wanted = config.output.frame_range(capture.n_frames)
    if not has_time:
        return tuple(wanted)
    frames = tuple(t for t in wanted if radius <= t < capture.n_frames - radius)
    if not frames:
        raise ConfigError(
            f"output.frames = {config.output.frames!r}: the temporal window reaches {radius} frames to each side, "
            f"so frames {radius}:{capture.n_frames - radius} can be measured"
        )
    return frames


def _geometry(capture: Capture) -> Geometry:
    centre = ((capture.width - 1) / 2, (capture.height - 1) / 2)
    return capture.geometry or Geometry(1.0, centre)


def _preshift(capture: Capture, config: RunConfig) -> tuple[int, int]:
    found = find_preshift(capture) if config.preshift == "auto" else config.preshift
    return (found[0] if capture.n_cols > 1 else 0, found[1] if capture.n_rows > 1 else 0)


def _band_rows(
    config: RunConfig,
    problem: Problem,
    layout: TensorLayout,
    ranges: RangePlan | None,
    n_cameras: int,
    rows: int,
    cols: int,
) -> tuple[int, int]:
    """Rows of a unit, and the memory that it takes."""
    itemsize = 4 if config.precision == "f32" else 8

    def size(n: int) -> int:
        # Two more rows and columns for the growth at the edges.
        band = Band.of(problem.sampling, n + 2, cols + 2, config.window.stride)
        own = problem.own_flows.requests if problem.own_flows else ()
        gpu = config.arch not in ("auto", "cpu")
        total = band_bytes(problem.columns, layout, problem.sampling, band, itemsize, own, gpu)
        read = band
        if ranges and ranges.depth and ranges.layout:
            depth = ranges.depth
            read = Band.of(depth.sampling, band.in_rows, band.in_cols, 1)
            total += band_bytes(depth.columns, ranges.layout, depth.sampling, read, itemsize, gpu=gpu)
        if config.filters.prefilter != "none":
            total += prefilter_bytes(config.filters.sigma_pre, n_cameras, read.in_rows, read.in_cols, itemsize)
        return total

    limit = int(0.8 * config.plan.max_memory)
    if config.plan.tile != "auto":
        chosen = min(int(config.plan.tile), rows)
    else:
        chosen = int(np.clip(BAND_PIXELS // cols, 16, rows)) if rows > 16 else rows
        while chosen > 1 and size(chosen) > min(limit, INDEXED * itemsize):
            chosen = max(1, chosen * 3 // 4)
        # Bands of equal height: the last one should not be a sliver.
        chosen = -(-rows // -(-rows // chosen))
    if limit >= size(chosen) > INDEXED * itemsize:
        raise ConfigError(
            f"a unit of {chosen} rows needs {size(chosen) / 2**20:.0f} MiB, and kernels can address "
            f"{INDEXED * itemsize / 2**20:.0f} MiB: lower plan.tile, or use a roi, a smaller window"
        )
    if size(chosen) > limit:
        raise ConfigError(
            f"a unit of {chosen} rows needs {size(chosen) / 2**20:.0f} MiB, 80 % of plan.max_memory are "
            f"{limit / 2**20:.0f} MiB: raise it, lower plan.tile, or use a stride, a roi, a smaller window"
        )
    return chosen, size(chosen)
