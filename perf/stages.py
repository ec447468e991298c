"""Microseconds per output pixel of each stage of the 4D affine model, and of the refinement of the default model, and
what of the machine's ceilings they reach.

Ceilings are measured in the same run, with vector instructions of all threads: multiply-adds on registers, and
``a = b + f c`` in memory. What a stage must compute and move is counted from the plan (``work`` and ``refine_work`` of
the library); what an implementation does beyond it, halos and conversions, lowers its share.
"""

from __future__ import annotations

import statistics
from dataclasses import asdict, dataclass, field

from leafflow_ti.capture import Capture
from leafflow_ti.ceilings import Ceilings, measure_ceilings
from leafflow_ti.pipeline import Pipeline
from leafflow_ti.refine_work import count_refinement
from leafflow_ti.runtime import Device, start
from leafflow_ti.trace import Trace
from leafflow_ti.work import Rate, Work, count_work, rate
from perf.bench import Scene, Timed, time_stages
from perf.cases import Options
from perf.figures import Figure, Outcome
from perf.fresh import peak_mib

GOALS = {"A": 0.15, "B": 0.30, "C": 0.10}
"""Share of the measured multiply-add peak that each stage should reach."""


@dataclass(frozen=True)
class Settings:
    """``strides``, and the ``brightness`` models: without and with intensity columns (12 and 17 of them).

    ``steps``: of the refinement, at every ``refined``-th pixel.
    """

    scene: Scene = field(default_factory=Scene)
    strides: tuple[int, ...] = (1, 4)
    brightness: tuple[str, ...] = ("none", "camera")
    steps: int = 3
    refined: int = 16
    repeats: int = 9


def _stage_figures(label: str, timed: Timed, work: dict[str, Work], pixels: int, machine: Machine) -> list[Figure]:
    """Time, rates and share of each stage."""
    parts = {
        "A filters and products, one frame": (timed.a, work["filter"], "filter", "A"),
        "B windows": (timed.b, work["tensor"], "tensor", "B"),
        "C null space, covariances, 3D fit": (timed.c, work["solve"] + work["fit"], "solve", "C"),
    }
    figures = []
    for name, (seconds, per_pixel, stage, letter) in parts.items():
        found = machine.rate(stage, per_pixel * pixels, seconds)
        note = f"{per_pixel.flops:.0f} flops, {per_pixel.bytes:.0f} bytes per pixel: {_words(found)}"
        figures += [
            Figure(f"{name}, {label}", 1e6 * seconds / pixels, "us/px", note=note),
            Figure(f"{letter}, share of the multiply-add peak, {label}", found.compute, low=GOALS[letter]),
        ]
    return [
        *figures,
        Figure(f"null space alone, {label}", 1e6 * timed.null_space / pixels, "us/px"),
        Figure(f"one more frame of a sequence, {label}", 1e6 * timed.sequence / pixels, "us/px"),
        Figure(f"a single frame, {label}", 1e6 * timed.single / pixels, "us/px"),
        Figure(f"compiling or loading, {label}", timed.warm_up, "s"),
    ]


def _words(found: Rate) -> str:
    return (
        f"{found.gflops:.1f} GFLOP/s, {found.gbytes:.1f} GB/s, {found.memory:.0%} of the memory's; "
        f"nearest ceiling: {found.limit}"
    )


@dataclass(frozen=True)
class Machine:
    """A device and its ceilings."""

    device: Device
    ceilings: Ceilings

    def rate(self, stage: str, work: Work, seconds: float) -> Rate:
        """What a stage reached."""
        return rate(stage, work, seconds, self.ceilings, self.device.storage, self.device.algebra)

    def figures(self) -> tuple[Figure, ...]:
        """The ceilings."""
        c = self.ceilings
        return (
            Figure("multiply-adds, single precision", c.gflops_f32, "GFLOP/s"),
            Figure("multiply-adds, double precision", c.gflops_f64, "GFLOP/s"),
            Figure("a = b + f c, in memory", c.gbytes, "GB/s"),
            Figure("a = b + f c, in the second-level cache", c.gbytes_cache, "GB/s"),
        )


def _of_scene(settings: Settings, capture: Capture, machine: Machine) -> tuple[list[Figure], int]:
    """Figures of every stride and brightness model; bytes that the largest plan asks for."""
    figures, planned = [], 0
    for brightness in settings.brightness:
        for stride in settings.strides:
            plan = settings.scene.plan(capture, stride=stride, brightness=brightness)
            planned = max(planned, plan.bytes)
            timed = time_stages(plan, capture, machine.device, settings.repeats)
            label = f"{plan.problem.columns.n} columns, stride {stride}"
            figures += _stage_figures(label, timed, count_work(plan), len(plan.y) * len(plan.x), machine)
    return figures, planned


def _of_refinement(settings: Settings, capture: Capture, machine: Machine) -> list[Figure]:
    """Splines of one frame, and the refinement of the pixels of one."""
    plan = settings.scene.plan(
        capture, model="affine-scene-flow", refine=settings.steps, thin=None, stride=settings.refined
    )
    trace = Trace(barrier=machine.device.synchronize)
    pipeline = Pipeline(plan, capture, machine.device, trace)
    warm_up = pipeline.warm_up()
    seconds: dict[str, list[float]] = {"splines": [], "refine": []}
    for _ in range(settings.repeats):
        before = trace.seconds
        pipeline.run(lambda *_: None)
        for stage, found in seconds.items():
            found.append(trace.seconds[stage] - before.get(stage, 0.0))
    pixels = len(plan.y) * len(plan.x)
    effort = pipeline.effort.per(pixels * settings.repeats)
    frames = {"splines": capture.n_frames, "refine": 1}
    figures = []
    for stage, per_pixel in count_refinement(plan, effort).items():
        one = statistics.median(seconds[stage]) / frames[stage]
        found = machine.rate(stage, per_pixel * pixels, one)
        note = f"{per_pixel.flops:.3g} flops per pixel: {_words(found)}"
        figures += [
            Figure(f"{stage}, stride {settings.refined}", 1e6 * one / pixels, "us/px", note=note),
            Figure(f"{stage}, share of the multiply-add peak", found.compute),
        ]
    return [
        *figures,
        Figure("refinement: steps of a pixel", effort.passes, note=f"{effort.samplings:.2f} of them interpolate"),
        Figure("compiling or loading, refined", warm_up, "s"),
    ]


def measure(settings: Settings) -> Outcome:
    """Ceilings, then the stages."""
    capture = settings.scene.capture()
    device = start()
    machine = Machine(device, measure_ceilings(device))
    before = peak_mib()
    figures, planned = _of_scene(settings, capture, machine)
    figures += _of_refinement(settings, capture, machine)
    memory = (
        Figure("memory planned for the largest output", planned / 2**20, "MiB"),
        Figure("peak memory of the process", peak_mib(), "MiB", note=f"{before:.0f} MiB before: images, interpreter"),
    )
    return Outcome((*machine.figures(), *figures, *memory), asdict(settings), (f"device: {device}",))


def run(options: Options) -> Outcome:
    """The case; quick: a smaller output, one model, two repetitions."""
    return measure(Settings(Scene(out_px=96), brightness=("none",), repeats=2) if options.quick else Settings())
