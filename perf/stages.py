"""Microseconds per output pixel of each stage of the 4D affine model, steady state, beside SciPy/NumPy; peak memory.

A: filters, products and sums over cameras of one new frame. B: sums over the frames of the window, moment windows
along y and x. C: null space, covariances, 3D fit, maps. In a sequence every new frame costs A + B + C; a single frame
alone costs A for each of the frames of its window. The kernels are compiled before; medians over repetitions.
SciPy/NumPy runs in the same process on a small crop; its times are divided by the pixels that each stage worked on
there, so that the halo of the small crop does not count.
"""

from __future__ import annotations

import resource
import statistics
import sys
import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.config import load_config
from leafflow_ti.kernels.maps import Output
from leafflow_ti.pipeline import Pipeline
from leafflow_ti.plan import Plan, make_plan
from leafflow_ti.runtime import Device, start
from leafflow_ti.stages.estimate import EstimateStage, View
from leafflow_ti.stages.tensor import Band, TensorStage
from leafflow_ti.synthetic.plane import render, sinusoid_scene
from perf import scipy_twin
from perf.cases import Options
from perf.figures import Figure, Outcome

Array = NDArray[Any]
SAME_PX = 1e-4
"""Disparity [px/step] within which the comparison must agree: single against double precision."""


@dataclass(frozen=True)
class Settings:
    """``out_px``: side of the output; ``crop_px``: side of the comparison's output; ``strides``: 1 among them."""

    out_px: int = 300
    window: int = 65
    sigma: float = 19.0
    strides: tuple[int, ...] = (1, 4)
    repeats: int = 5
    crop_px: int = 48
    preshift_px: int = -14


@dataclass(frozen=True)
class Timed:
    """Seconds for the whole output."""

    a: float
    b: float
    c: float
    warm_up: float
    window_frames: int

    @property
    def sequence(self) -> float:
        """For one more frame of a sequence."""
        return self.a + self.b + self.c

    @property
    def single(self) -> float:
        """For one frame alone."""
        return self.window_frames * self.a + self.b + self.c


def _capture(settings: Settings) -> Capture:
    """The sinusoid in images large enough for the output, its halo, and the preshift."""
    scene = sinusoid_scene()
    side = settings.out_px + 2 * _reach(settings)
    scene = replace(scene, size=(side + 2 * scene.n_cols // 2 * abs(settings.preshift_px), side))
    images = render(scene).astype(np.float32)
    return capture_from_array(images, Geometry(scene.f_px, scene.principal, (scene.baseline_mm[0], 0.0)))


def _reach(settings: Settings) -> int:
    """Half the window, and room for the filters."""
    return settings.window // 2 + 8


def _plan(capture: Capture, settings: Settings, stride: int) -> Plan:
    """The plan for the output of ``out_px`` squared in the middle of the images, one band."""
    x0, y0 = (capture.width - settings.out_px) // 2, _reach(settings)
    config = load_config(
        overrides={
            "model": "affine-4d",
            "motion": "rotation",
            "preshift": (settings.preshift_px, 0),
            "window": settings.window,
            "sigma": settings.sigma,
            "stride": stride,
            "frames": "4:5",
            "tile": settings.out_px,
            "roi": (x0, y0, x0 + settings.out_px, y0 + settings.out_px),
        }
    )
    return make_plan(capture, config)


def _time(plan: Plan, capture: Capture, device: Device, repeats: int) -> tuple[Timed, Array]:
    """Median seconds of the stages on one band that holds the whole output, and the disparity [rows, cols]."""
    warm_up = Pipeline(plan, capture, device).warm_up()
    problem, geometry = plan.problem, plan.geometry
    band = Band.of(problem.sampling, len(plan.y), len(plan.x), plan.config.window.stride)
    tensor_stage = TensorStage(device, problem.columns, plan.layout, problem.sampling, band)
    view = View(
        geometry.f_px,
        geometry.principal_px,
        geometry.baseline_mm,
        plan.preshift,
        plan.x.start,
        plan.y.start,
        plan.x.step,
        band.rows,
        band.cols,
        tensor_stage.out_pitch,
    )
    estimate_stage = EstimateStage(device, problem, plan.layout, view)
    y0, x0 = plan.y.start - band.halo_y, plan.x.start - band.halo_x
    blocks = [
        capture.block(
            [t], *plan.cameras, y0, y0 + band.in_rows, x0, x0 + band.in_cols, plan.preshift, device.real("storage")
        )[0]
        for t in range(capture.n_frames)
    ]
    valid = np.ones(blocks[0].shape[2:], bool)
    filling, full, last = [], [], []
    for _ in range(repeats):
        tensor_stage.reset()
        for n, block in enumerate(blocks):
            began = time.perf_counter()
            tensor = tensor_stage.push(block, valid)
            device.synchronize()
            seconds = time.perf_counter() - began
            if tensor is not None:
                full.append(seconds)
            elif n >= tensor_stage.n_taps - 1:
                filling.append(seconds)
        began = time.perf_counter()
        disparity = np.array(estimate_stage(tensor)[Output.DISPARITY])
        last.append(time.perf_counter() - began)
    a = statistics.median(filling)
    b = statistics.median(full) - a
    timed = Timed(a, b, statistics.median(last), warm_up, problem.sampling.t.size)
    return timed, disparity


def _peak_mib() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def _twin(plan: Plan, capture: Capture, settings: Settings) -> scipy_twin.TwinResult:
    sampling = plan.problem.sampling
    reach = sampling.x.radius
    y0, x0 = plan.y.start - reach, plan.x.start - reach
    side = settings.crop_px + 2 * reach
    images = capture.block(
        range(capture.n_frames), *plan.cameras, y0, y0 + side, x0, x0 + side, plan.preshift, np.float32
    )  # fmt: skip
    return scipy_twin.estimate(images, plan.problem.columns, plan.layout, sampling)


def _stage_figures(stride: int, timed: Timed, pixels: int, twin: scipy_twin.TwinResult) -> list[Figure]:
    """Of one stride. SciPy filters every pixel before it leaves some out: its A and B cost the same at every stride."""
    us = 1e6 / pixels
    scipy = 1e6 * (stride**2 * (twin.products + twin.windows_y) + stride * twin.windows_x + twin.null_space)
    parts = {
        "A filters and products, one frame": timed.a,
        "B windows": timed.b,
        "C null space, covariances, 3D fit": timed.c,
        "one more frame of a sequence": timed.sequence,
        "a single frame": timed.single,
    }
    return [
        *(Figure(f"{name}, stride {stride}", seconds * us, "us/px") for name, seconds in parts.items()),
        Figure(f"SciPy/NumPy, a single frame, stride {stride}", scipy, "us/px", note="scaled from the crop"),
        Figure(f"SciPy/NumPy over a single frame, stride {stride}", scipy / (timed.single * us), "x"),
        Figure(f"SciPy/NumPy over one more frame, stride {stride}", scipy / (timed.sequence * us), "x"),
        Figure(f"compiling or loading the kernels, stride {stride}", timed.warm_up, "s"),
    ]


def measure(settings: Settings) -> Outcome:
    """All strides, then the comparison."""
    device = start()
    capture = _capture(settings)
    plans = {stride: _plan(capture, settings, stride) for stride in settings.strides}
    before = _peak_mib()
    measured = {stride: _time(plan, capture, device, settings.repeats) for stride, plan in plans.items()}
    after = _peak_mib()
    twin = _twin(plans[1], capture, settings)
    figures = []
    for stride, (timed, _) in measured.items():
        figures += _stage_figures(stride, timed, len(plans[stride].y) * len(plans[stride].x), twin)
    crop = measured[1][1][: settings.crop_px, : settings.crop_px]
    expected = twin.parameters[..., 0, plans[1].problem.columns.index("x")] + settings.preshift_px
    planned = max(plan.bytes for plan in plans.values()) / 2**20
    figures += [
        Figure("SciPy/NumPy A, all frames of the window", 1e6 * twin.products, "us/px"),
        Figure("SciPy/NumPy B, along y and x", 1e6 * (twin.windows_y + twin.windows_x), "us/px"),
        Figure("SciPy/NumPy C, null space alone", 1e6 * twin.null_space, "us/px"),
        Figure("largest difference of the disparities", float(np.abs(crop - expected).max()), "px", SAME_PX),
        Figure("memory planned for the largest output", planned, "MiB"),
        Figure("peak memory of the process", after, "MiB", note=f"{before:.0f} MiB before: images and interpreter"),
    ]
    return Outcome(tuple(figures), asdict(settings), (f"device: {device}; SciPy/NumPy: filters on one thread",))


def run(options: Options) -> Outcome:
    """The case; quick: a smaller output, two repetitions."""
    return measure(Settings(out_px=96, repeats=2, crop_px=16) if options.quick else Settings())
