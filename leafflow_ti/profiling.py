"""What a run of a capture costs on this device, stage by stage, what limits it, and how long the whole will take."""

from __future__ import annotations

import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.background import Behind
from leafflow_ti.bands import WRITE_BEHIND
from leafflow_ti.capture import Capture
from leafflow_ti.ceilings import measure_ceilings
from leafflow_ti.config import RunConfig
from leafflow_ti.errors import ConfigError
from leafflow_ti.pipeline import Pipeline
from leafflow_ti.plan import Plan, Unit, make_plan
from leafflow_ti.profile_report import Prediction, Profile, StageCost
from leafflow_ti.refine_work import count_refinement
from leafflow_ti.results import ResultStore
from leafflow_ti.run_store import create_store
from leafflow_ti.runtime import Device
from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.tensor import Band
from leafflow_ti.stays import Maps
from leafflow_ti.trace import BACKGROUND_STAGES, STAGES, Event, Trace, active, span
from leafflow_ti.work import Rate, Work, count_work, rate
from leafflow_ti.worker import start_device

ALONE_FRAMES = 3
"""Frames read, and times a unit is written, to see what that costs by itself."""
WAITING_SHARE = 0.2
"""Share of the time that computing waits above which reading or writing is what limits."""
LAUNCH_SHARE = 0.5
"""Share of a stage's time that it takes for a single pixel, too, above which launches are what limits."""

_BESIDE = {"read": "disk", "write": "disk", "decode": "decoding", "prefilter": "compute"}
"""What limits a stage whose work is not counted."""

Result = tuple[Unit, Maps, NDArray[np.uint8]]


@dataclass(frozen=True)
class _Steps:
    """The computing thread in the frames of a sequence: seconds until the first unit (``fill``), of each unit, and of
    each stage and kind of waiting per unit."""

    fill: float
    units: tuple[float, ...]
    stages: dict[str, float]
    waits: dict[str, float]

    @classmethod
    def of(cls, events: list[Event], fill: int) -> _Steps:
        """From the spans of a traced sequence whose first ``fill`` frames only fill the windows."""
        steps = sorted((e for e in events if e.stage == "host"), key=lambda e: e.start)
        full = steps[fill:]
        first, end = full[0].start, full[-1].start + full[-1].duration
        stages: dict[str, float] = {}
        waits: dict[str, float] = {}
        for e in events:
            if e.thread == full[0].thread and first <= e.start < end:
                into, key = (waits, e.label) if e.stage == "wait" else (stages, e.stage)
                into[key] = into.get(key, 0.0) + e.own / 1e9 / len(full)
        starts = [e.start for e in full] + [end]
        units = tuple((b - a) / 1e9 for a, b in itertools.pairwise(starts))
        return cls((first - steps[0].start) / 1e9, units, stages, waits)


def profile(capture: Capture, config: RunConfig, frames: int = 5, trace_file: Path | None = None) -> Profile:
    """Measure the first ``frames`` units of the highest band of a run, after compiling; whole frames where each is
    searched.

    ``trace_file``: where the spans of that go (see ``Trace.write``). Nothing else is left behind: units are written to
    a temporary folder. Raises as ``run`` does, ConfigError where no pixel can be measured, RunError where
    ``trace_file`` cannot be written.
    """
    plan = make_plan(capture, config)
    device = start_device(config)
    trace = Trace(keep=True, barrier=device.synchronize)
    if trace_file is not None:
        trace.write(trace_file)  # better refused now than after the work
    capture.keep_decoded(plan.cache_bytes)
    pipeline = Pipeline(plan, capture, device, trace)
    if plan.adaptive:
        return _profile_frames(pipeline, frames, trace_file)
    band = max(range(plan.bands), key=lambda b: _height(pipeline.extent(b)))
    rows, cols = pipeline.extent(band)
    if not _height((rows, cols)):
        raise ConfigError("no pixel can be measured: the window reaches beyond the images everywhere: make it smaller")
    compiling = pipeline.warm_up()
    least = pipeline.least_seconds()
    last = plan.frames[-1] + plan.around[1] + 1
    alone = range(max(plan.frames[0] - plan.around[0], last - ALONE_FRAMES), last)
    background = {s: n / len(alone) for s, n in pipeline.read_alone(band, alone).items()}
    measured = min(frames, len(plan.frames))
    background["write"] = _run_units(pipeline, {plan.unit(t, band).index for t in range(measured)})
    if trace_file is not None:
        trace.write(trace_file)
    steps = _Steps.of(trace.events or [], sum(plan.around))
    seconds = statistics.median(steps.units)
    pixels = (plan.band(band).stop - plan.band(band).start) * len(plan.x)
    ceilings = measure_ceilings(device)
    computed = (rows.stop - rows.start) * (cols.stop - cols.start)
    effort = pipeline.effort.per(measured * computed) if plan.refine else None
    work = {**count_work(plan), **count_refinement(plan, effort)}
    spent = {**steps.stages, **background}
    if "estimate" in spent:
        pipeline.release()  # the memory that is planned is enough for one
        solving = _share_of_solving(plan, capture, device, band)
        for times in (spent, least):
            whole = times.pop("estimate")
            times |= {"solve": solving * whole, "fit": (1.0 - solving) * whole}
    stages = []
    for s in (s for s in STAGES if s in spent):
        cost = StageCost(s, spent[s], spent[s] / pixels * 1e6, spent[s] / seconds, _BESIDE.get(s, ""))
        if s in work and spent[s] > 0.0:
            reached = rate(s, work[s] * computed, spent[s], ceilings, device.storage, device.algebra)
            cost = _rated(cost, work[s], reached, least.get(s, 0.0))
        stages.append(cost)
    return Profile(
        plan.model, str(device), (pixels // len(plan.x), len(plan.x)), measured, compiling, seconds, pixels / seconds,
        steps.fill, tuple(stages), _limit(stages, steps.waits, seconds), _overlap(background, steps.waits), plan.bytes,
        _peak_bytes(), ceilings, predict(pipeline, band, steps.fill, seconds, steps.stages, compiling),
        effort,
    )  # fmt: skip


def _profile_frames(pipeline: Pipeline, frames: int, trace_file: Path | None) -> Profile:
    """Of a plan that searches every frame: the first ``frames`` whole ones. What they cost depends on how many surfaces
    they show, so that the work is not counted, and reading is what it was beside the computing."""
    plan, trace, device = pipeline.plan, pipeline.trace, pipeline.device
    compiling = pipeline.warm_up()
    measured = min(frames, len(plan.frames))
    writing = plan.bands * _run_units(pipeline, {unit.index for unit in plan.units() if unit.t_index < measured})
    if trace_file is not None:
        trace.write(trace_file)
    events = [e for e in trace.events or [] if e.stage != "compile"]
    begun = sorted(e.start for e in events if e.stage == "search")
    thread = next(e.thread for e in events if e.stage == "search")
    begun.append(max(e.start + e.duration for e in events if e.thread == thread))
    seconds = statistics.median((b - a) / 1e9 for a, b in itertools.pairwise(begun))
    spent, waits = {"write": writing}, dict[str, float]()
    for e in events:
        into, key = (waits, e.label) if e.stage == "wait" else (spent, e.stage)
        if e.stage != "write":
            into[key] = into.get(key, 0.0) + e.own / 1e9 / measured
    pixels = len(plan.y) * len(plan.x)
    stages = tuple(
        StageCost(s, spent[s], spent[s] / pixels * 1e6, spent[s] / seconds, _BESIDE.get(s, ""))
        for s in STAGES if s in spent
    )  # fmt: skip
    longest = max((c for c in stages if c.stage not in BACKGROUND_STAGES), key=lambda c: c.seconds).stage
    background = {s: spent[s] for s in BACKGROUND_STAGES if s in spent}
    blocks = sum(e.stage == "decode" for e in events) // (len(plan.cameras[0]) * len(plan.cameras[1]))
    n = len(plan.frames)
    whole = Prediction(n, plan.bands, plan.n_units, round(blocks / measured * n), compiling + n * seconds)
    return Profile(
        plan.model, str(device), (len(plan.y), len(plan.x)), measured, compiling, seconds, pixels / seconds, 0.0,
        stages, _waited_for(stages, waits, seconds) or longest, _overlap(background, waits), plan.bytes,
        _peak_bytes(), measure_ceilings(device), whole,
        pipeline.effort.per(measured * pixels) if plan.refine else None, searched=True,
    )  # fmt: skip


def _share_of_solving(plan: Plan, capture: Capture, device: Device, band: int) -> float:
    """The part of ``solve`` in the stage ``estimate``, from a unit for which the two are launched apart.

    The second time counts: at the first, memory is fetched from the system.
    """
    trace = Trace(barrier=device.synchronize)
    pipeline = Pipeline(replace(plan, refine=None), capture, device, trace, apart=True)
    wanted = {plan.unit(0, band).index}
    pipeline.run(lambda *_: None, wanted)
    before = trace.seconds
    pipeline.run(lambda *_: None, wanted)
    solve, fit = (trace.seconds[stage] - before[stage] for stage in ("solve", "fit"))
    return solve / (solve + fit)


def predict(
    pipeline: Pipeline, band: int, fill: float, unit: float, stages: Mapping[str, float], compiling: float
) -> Prediction:
    """The whole run from one band: every band fills its windows once, then gives a unit per frame.

    ``fill``, ``unit``: seconds of the two, waiting included; ``stages``: of a unit. Filling and filters grow with the
    rows of images, the rest with the rows of output that are computed; a band that is all border costs nothing.
    """
    plan = pipeline.plan
    filters = sum(stages.get(s, 0.0) for s in ("prefilter", "filter", "splines"))
    n = len(plan.frames)
    seconds, read = compiling, 0
    high = _height(pipeline.extent(band))
    for b in range(plan.bands):
        rows = _height(pipeline.extent(b))
        if rows:
            wide = _image_rows(plan.problem.sampling, rows, plan) / _image_rows(plan.problem.sampling, high, plan)
            seconds += wide * (fill + n * filters) + n * (unit - filters) * rows / high
            read += n + sum(plan.around)
    return Prediction(n, plan.bands, plan.n_units, read, seconds)


def _height(extent: tuple[slice, slice]) -> int:
    """Rows of a rectangle, 0 if it has no columns."""
    rows, cols = extent
    return rows.stop - rows.start if cols.stop > cols.start else 0


def _image_rows(sampling: Sampling, rows: int, plan: Plan) -> int:
    """Rows of images that so many rows of output need."""
    return Band.of(sampling, rows, 1, plan.x.step).in_rows


def _run_units(pipeline: Pipeline, wanted: set[int]) -> float:
    """Compute and write the units ``wanted``; seconds of writing one while nothing else goes on."""
    plan = pipeline.plan
    last: list[Result] = []
    with tempfile.TemporaryDirectory(prefix="leafflow-ti-profile-") as folder:
        store = create_store(Path(folder) / "out.zarr", plan, {}, pipeline.capture)

        def write(result: Result) -> None:
            last[:] = [result]
            with span("write", f"unit {result[0].index}"):
                _write(store, result)

        with active(pipeline.trace), Behind(write, WRITE_BEHIND) as writer:
            pipeline.run(lambda *result: writer.put(result), wanted)
        return statistics.median(_seconds_of_writing(store, last[0]))


def _seconds_of_writing(store: ResultStore, result: Result) -> Iterator[float]:
    for _ in range(ALONE_FRAMES):
        began = time.perf_counter()
        _write(store, result)
        yield time.perf_counter() - began


def _write(store: ResultStore, result: Result) -> None:
    unit, maps, status = result
    store.write_unit(unit.index, unit.t_index, unit.rows, maps, status)


def _rated(cost: StageCost, work: Work, reached: Rate, least: float) -> StageCost:
    """With what the stage reached. ``work`` per pixel; ``least``: seconds that it takes for a single one."""
    return replace(
        cost, limit="launches" if least > LAUNCH_SHARE * cost.seconds else reached.limit, flops_per_pixel=work.flops,
        gflops=reached.gflops, gbytes=reached.gbytes, share_of_flops=reached.compute, share_of_bytes=reached.memory,
    )  # fmt: skip


def _limit(stages: Sequence[StageCost], waits: Mapping[str, float], clock: float) -> str:
    """What limits the whole: reading or writing where computing waits for it, else what limits the longest stage."""
    computing = (c for c in stages if c.stage not in BACKGROUND_STAGES and c.limit)
    return _waited_for(stages, waits, clock) or max(computing, key=lambda c: c.seconds).limit


def _waited_for(stages: Sequence[StageCost], waits: Mapping[str, float], clock: float) -> str:
    """What computing waits for, "disk" or "decoding"; "" if it does not wait for long."""
    if sum(waits.values()) <= WAITING_SHARE * clock:
        return ""
    by_name = {cost.stage: cost.seconds for cost in stages}
    label = max(waits, key=lambda name: waits[name])
    slow = label == "wait for images" and by_name["decode"] > by_name.get("read", 0.0)
    return "decoding" if slow else "disk"


def _overlap(background: Mapping[str, float], waits: Mapping[str, float]) -> float | None:
    total = sum(background.values())
    return max(0.0, 1.0 - sum(waits.values()) / total) if total > 0.0 else None


def _peak_bytes() -> int | None:
    """Largest memory of this process so far."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
