"""The plan of a run, a pure value: what is computed, from which windows, in which units, with how much memory.

It is what ``--dry-run`` prints and what the pipeline executes. Making it reads grey values only to find a preshift, and
of one image for its noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from leafflow_ti.bands import READ_AHEAD, TILE_PIXELS, Demand, choose_bands, usable_memory
from leafflow_ti.capture import (
    DEFAULT_CACHE_BYTES,
    ArrayCapture,
    Capture,
    Geometry,
    UnclearDisparity,
    anything_fits,
    find_preshift,
    one_preshift_serves,
)
from leafflow_ti.config import RunConfig, resolve
from leafflow_ti.curvature import SLOPES, Around
from leafflow_ti.errors import ConfigError
from leafflow_ti.field import CORRELATIONS, FLOW_GRADIENT_NAMES, MOTION_NAMES, PLANE_STRAIN_NAMES, QUANTITIES, with_std
from leafflow_ti.identify import Limits
from leafflow_ti.model_plan import cameras_read, check_model, fitted_motion, model_problem, sampling_of, static
from leafflow_ti.models import MODELS, TensorLayout
from leafflow_ti.noise import noise_level
from leafflow_ti.range_plan import RangePlan, range_problem
from leafflow_ti.refine_plan import Refinement, frames_around, plan_refinement
from leafflow_ti.sampling import AxisSampling
from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.stages.problem import BRIGHTNESS_MAPS, WORLD_MAPS, Problem


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
    """Resolved: nothing in it that the capture or a preset decides is left open."""
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
    """Memory of the largest unit's arrays, of the frames read ahead, and of the units that wait to be written."""
    read_ahead: int
    """Frames that are read before they are needed, while the device computes."""
    cache_bytes: int
    """Of these bytes, those of decoded images: kept where several bands need them and all of them fit, else 0."""
    noise: float = 0.0
    """Standard deviation of the noise of the (prefiltered) images of the reference camera."""
    ranges: RangePlan | None = None
    refine: Refinement | None = None
    tile_cols: int = 0
    """Output columns of a tile where every frame is searched for what whole-pixel shift each pixel needs; 0: one
    ``preshift`` serves all."""
    around: tuple[int, int] = (0, 0)
    """Frames before and behind a reference frame that its results need."""

    @property
    def adaptive(self) -> bool:
        """Whether the images are shifted by what a search of every frame finds; ``preshift`` then means nothing."""
        return self.tile_cols > 0

    def reach(self, axis: str) -> int:
        """Pixels that a measurement needs on each side along an image axis."""
        sampling = self.problem.sampling
        return sampling.axis(axis).radius + (self.ranges.reach(sampling, axis) if self.ranges else 0)

    @property
    def time_offset(self) -> float:
        """Where results lie between their frame and the next one, as a share of the step: 0, or half way."""
        return 0.0 if self.problem.sampling.t.taps % 2 else 0.5

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
        available = with_std(self.quantities)
        if kept is None:
            return available
        for name in kept:
            if name not in available:
                known = ", ".join(self.quantities)
                raise ConfigError(f"output.arrays: model '{self.model}' gives no '{name}' here; it gives {known}")
        return tuple(n for n in available if n in kept)

    @property
    def quantities(self) -> tuple[str, ...]:
        """Names of the maps: those that the model measures, and those that the refinement adds."""
        if self.refine is None:
            return self.measured
        names = {*self.measured, *self.refine.names} - self.refine.excluded
        return tuple(n for n in QUANTITIES if n in names)

    @property
    def measured(self) -> tuple[str, ...]:
        """Names of the maps that the model itself measures."""
        problem = self.problem
        names: list[str] = []
        if problem.terms:
            names += ["disparity", "depth"]
        if "x" in problem.terms:
            names += ["slope_x", "slope_y"]
        names += self.ranges.quantities if self.ranges else ()
        names += MOTION_NAMES[: problem.unknowns]
        if "t" in problem.columns.solutions and not self.ranges:
            names += ["flow_x", "flow_y", "normal_flow_x", "normal_flow_y"]
            if not problem.unknowns and len(problem.offsets) > 1:
                names += [*FLOW_GRADIENT_NAMES, *PLANE_STRAIN_NAMES]
        if problem.columns.index("i") is not None:
            names += [f"brightness_{a}" for a in problem.camera_axes]
        names += [BRIGHTNESS_MAPS[o] for o in problem.brightness]
        names += [WORLD_MAPS[o] for o in problem.world_brightness]
        if "depth" in names and problem.unknowns >= 3:
            names.append("growth_rate")
        if problem.unknowns >= 2:
            names += CORRELATIONS if problem.unknowns >= 3 else CORRELATIONS[:1]
        names.append("confidence")
        names += ["support"] if ESTIMATORS[problem.estimator].robust else []
        return (*names, "identified")

    @property
    def limits(self) -> Limits:
        """Standard errors above which a parameter has no value."""
        sampling, axes = self.problem.sampling, (self.ranges.depth if self.ranges else self.problem)
        along = axes.camera_axes[:1] if axes else ()
        baseline = self.geometry.baseline_mm[0 if along == ("sx",) else 1] if along else 0.0
        radius = (sampling.x.moment(2) + sampling.y.moment(2)) ** 0.5
        return Limits(self.geometry.f_px, radius, abs(self.geometry.f_px * baseline))

    @property
    def differences(self) -> bool:
        """Whether growth is told from differences between the velocities of neighbouring output pixels."""
        return "growth_rate" in self.measured and any(name.startswith("growth") for name in self.names)

    @property
    def margin(self) -> int:
        """Output pixels around a band, and around the region, that are computed for the sake of those inside.

        A pixel's growth is seen in its neighbours' velocities, and its refinement may start from theirs; the curvature
        of the surface is seen in the slopes around either.
        """
        near = int(self.differences or self.refine is not None)
        return near + self.around_curved.reach if self.around_curved else near

    @property
    def around_curved(self) -> Around | None:
        """Where the refinement's curvature comes from; None: it takes planes, as the model measures no slopes."""
        if self.refine is None or self.refine.flat or not set(SLOPES) <= set(self.measured):
            return None
        return Around.of(self.refine.sigma, self.x.step)

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

    def _shifts(self) -> str:
        if self.adaptive:
            across = self.tile_cols * self.x.step
            return f"shifted as each pixel's disparity and motion need it, tiles of {across} px"
        return f"preshift {self.preshift[0]},{self.preshift[1]} px per step"

    def describe(self) -> str:
        """The plan in words, one fact a line."""
        problem, sampling = self.problem, self.problem.sampling

        def axis(name: str) -> str:
            plan = sampling.axis(name)
            taps = f"{plan.taps} taps" if plan.filters else "no filter"
            taps += ", at measured places" if plan.uneven or (name in ("sx", "sy") and sampling.grid) else ""
            blocks = f" in {len(plan.blocks.weights)} blocks of {plan.blocks.step}" if plan.blocks else ""
            return f"{name}: {taps}, window of {plan.size}{blocks}"

        lines = [
            f"model       {self.model}: {MODELS[self.model].summary}, {problem.columns.n} columns, "
            f"{len(self.layout.entries)} distinct moments, {problem.columns.n_time_like} solutions",
            f"estimator   {problem.estimator}{_weighing(problem)}, solver {problem.solver}, "
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
        if self.refine:
            lines.append(self.refine.describe())
        pixels = len(self.frames) * len(self.y) * len(self.x)
        limit = self.config.plan.limit_in_words
        filters, known = self.config.filters, self.config.model.noise != "auto"
        unit = "of the grey value" if filters.prefilter == "homomorphic" else "grey values"
        if filters.prefilter != "none":
            lines.append(f"prefilter   {filters.prefilter}, sigma {filters.sigma_pre:g} px")
        lines += [
            f"noise       {self.noise:.3g} {unit}, {'given' if known else 'estimated'}",
            f"windows     {'; '.join(axis(a) for a in ('x', 'y', 'sx', 'sy', 't'))}",
            f"cameras     {len(self.cameras[0])} rows x {len(self.cameras[1])} columns, {self._shifts()}",
            f"frames      {self.frames[0]}..{self.frames[-1]} ({len(self.frames)})"
            + (", results half way to the next frame" if self.time_offset else ""),
            f"output      {len(self.y)} x {len(self.x)} pixels per frame, stride {self.x.step}: "
            f"{', '.join(self.names)}",
            f"units       {self.n_units}: {self.bands} bands of up to {self.band_rows} rows per frame",
            f"memory      {self.bytes / 2**20:.0f} MiB for one unit, {self.read_ahead} frames read ahead, "
            f"{self.cache_bytes / 2**20:.0f} MiB of them decoded images; limit {limit}",
            f"disk        at most {pixels * (4 * len(self.names) + 1) / 2**20:.0f} MiB",
        ]
        return "\n".join(lines)


def _weighing(problem: Problem) -> str:
    """In words how a robust estimator weighs, and where."""
    if not ESTIMATORS[problem.estimator].robust:
        return ""
    return f" ({problem.penalty}, {'all pixels' if problem.robust == 'all' else 'where the plain fit failed'})"


def make_plan(capture: Capture, config: RunConfig) -> Plan:
    """The plan for a capture and a configuration.

    Raises ConfigError where the two do not fit, InputError where the capture is too small.
    """
    config = resolve(config, capture.n_frames, capture.n_rows, capture.n_cols)
    name, stride = str(config.model.name), int(config.window.stride)
    model = MODELS[name]
    if not (model.ranges and config.range_flow.depth):
        check_model(name, capture)
    if config.filters.prefilter == "highpass" and config.model.brightness != "none":
        raise ConfigError(
            f"brightness '{config.model.brightness}' is relative to the grey value, which prefilter 'highpass' takes "
            "away: choose prefilter homomorphic, or brightness none"
        )
    flat = model.cameras == "reference"
    if config.model.deformation == "growth" and not (flat or model.own_flows or config.refine.steps):
        raise ConfigError(
            f"deformation 'growth': model '{name}' cannot tell it from approach: choose affine-scene-flow, or a "
            "refinement (--refine 3)"
        )
    motion = fitted_motion(config, name)
    preshift, ranges, noise, around = (0, 0), None, noise_level(capture, config), (0, 0)
    adaptive = False
    if model.ranges and config.preshift == "adaptive":
        raise ConfigError(
            f"preshift 'adaptive': model '{name}' takes one preshift and no motion out: choose --preshift uniform, or "
            "another model"
        )
    if model.ranges:
        depth = None if config.range_flow.depth else model_problem(capture, static(config), "depth", None)
        own = replace(depth, noise=noise, cut=True) if depth else None
        preshift = _uniform(capture, config) if own else (0, 0)
        alone = sampling_of(capture, config, "reference", True)
        around = frames_around(config, alone.t)
        frames = _frames(capture, config, around)
        problem, ranges = range_problem(capture, config, alone, frames, own, preshift, noise)
    else:
        problem = model_problem(capture, config, name, motion)
        around = frames_around(config, problem.sampling.t) if model.time else (0, 0)
        frames = _frames(capture, config, around)
        preshift, adaptive = _preshift(capture, config, bool(problem.camera_axes), model.time)
    # Ranges are invalid here and there.
    cut = model.ranges or adaptive or _cut(capture, config)
    problem = replace(problem, noise=noise, cut=cut)
    layout = TensorLayout.of(problem.columns)
    x0, y0, x1, y1 = config.output.roi or (0, 0, capture.width, capture.height)
    if x1 > capture.width or y1 > capture.height:
        size = f"{capture.width} x {capture.height}"
        raise ConfigError(
            f"output.roi = {x0},{y0},{x1},{y1} reaches beyond the images of {size} pixels: make it smaller"
        )
    x, y = range(x0, x1, stride), range(y0, y1, stride)
    grid = (ranges.depth if ranges and ranges.depth else problem).sampling
    cameras = cameras_read(grid, problem.own_flows, *capture.reference)
    steps_x, steps_y = capture.camera_steps
    refine = plan_refinement(
        config,
        _farthest(problem.sampling.t, around, frames) if model.time else None,
        [(float(steps_x[sy, sx]), float(steps_y[sy, sx])) for sy in cameras[0] for sx in cameras[1]],
        (capture.height, capture.width),
    )
    plan = Plan(
        config, name, problem, layout, _geometry(capture),
        cameras, preshift, frames, y, x, len(y), 0, 0, 0, noise, ranges, refine,
        around=around,
    )  # fmt: skip
    depths = (0,) if isinstance(capture, ArrayCapture) else range(READ_AHEAD, -1, -1)
    demand = Demand(
        config, problem, layout, ranges, refine, len(cameras[0]) * len(cameras[1]), len(plan.names), len(x), plan.margin
    )
    demand = replace(demand, waiting=around[1] - problem.sampling.t.after, reading=capture.reading_bytes)
    if adaptive:
        demand = replace(
            demand, tile_cols=min(len(x), -(-TILE_PIXELS // stride)), image=(capture.height, capture.width)
        )
    band_rows, memory, ahead = choose_bands(demand, len(y), depths)
    plan = replace(plan, band_rows=band_rows, bytes=memory, read_ahead=ahead, tile_cols=demand.tile_cols)
    cache = capture.cacheable_bytes if plan.bands > 1 or adaptive else 0
    if adaptive:  # of the frames that one measurement needs: they come again for every tile and label
        cache = cache * min(capture.n_frames, sum(around) + 2) // capture.n_frames
    if cache > min(DEFAULT_CACHE_BYTES, usable_memory(config) - memory):
        cache = 0
    return replace(plan, bytes=memory + cache, cache_bytes=cache)


def _frames(capture: Capture, config: RunConfig, around: tuple[int, int]) -> tuple[int, ...]:
    """Frames that are measured: those wanted that have so many before and behind them."""
    wanted = config.output.frame_range(capture.n_frames)
    first, end = around[0], capture.n_frames - around[1]
    frames = tuple(t for t in wanted if first <= t < end)
    if not frames:
        raise ConfigError(
            f"output.frames = {config.output.frames!r}: the temporal window reaches from {around[0]} frames before "
            f"to {around[1]} behind, so frames {first}:{end} can be measured"
        )
    return frames


def _farthest(time: AxisSampling, around: tuple[int, int], frames: tuple[int, ...]) -> tuple[float, ...]:
    """Offsets of the frames around a reference; where they differ from one to the next, the farthest."""
    if not time.uneven:
        return tuple(time.around(*around).tolist())
    found = (tuple(time.about(t).around(*around).tolist()) for t in frames)
    return max(found, key=lambda offsets: max(map(abs, offsets)))


def _cut(capture: Capture, config: RunConfig) -> bool:
    """Whether windows may hold pixels that do not count: masked ones, ones beyond the image, invalid ones."""
    return config.output.mask is not None or config.window.border == "clip" or not capture.finite


def _geometry(capture: Capture) -> Geometry:
    centre = ((capture.width - 1) / 2, (capture.height - 1) / 2)
    return capture.geometry or Geometry(1.0, centre)


def _uniform(capture: Capture, config: RunConfig) -> tuple[int, int]:
    """The whole-pixel disparity that all images are shifted by."""
    found = find_preshift(capture) if isinstance(config.preshift, str) else config.preshift
    return (found[0] if capture.n_cols > 1 else 0, found[1] if capture.n_rows > 1 else 0)


def _preshift(capture: Capture, config: RunConfig, cameras: bool, time: bool) -> tuple[tuple[int, int], bool]:
    """The whole-pixel disparity that all images are shifted by; or that each pixel needs its own, and its motion."""
    if config.preshift == "adaptive":
        return (0, 0), True
    try:
        found = _uniform(capture, config) if cameras else (0, 0)
    except UnclearDisparity:
        if config.preshift != "auto" or not anything_fits(capture):
            raise
        return (0, 0), True
    return found, config.preshift == "auto" and not one_preshift_serves(capture, found, time)
