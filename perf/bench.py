"""What the timed cases have in common: the capture, its plan, and the library's stages on one band, timed apart.

A: filters, products and sums over cameras of one new frame. B: sums over the frames of the window, moment windows
along y and x. C: null space, covariances, 3D fit, maps. In a sequence every new frame costs A + B + C; a single frame
alone costs A for each of the frames of its window. Kernels are compiled before; medians over repetitions.
"""

from __future__ import annotations

import itertools
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.config import load_config
from leafflow_ti.models import TensorLayout
from leafflow_ti.pipeline import Pipeline
from leafflow_ti.plan import Plan, make_plan
from leafflow_ti.runtime import Device
from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.estimate import EstimateStage, View
from leafflow_ti.stages.tensor import Band, TensorStage
from leafflow_ti.synthetic.plane import render, sinusoid_scene

Array = NDArray[Any]
SETTLE_S = 1.5
"""Seconds of work before times count: a processor that was idle takes so long to reach its clock (measured: the first
second is 1.6 times slower). A quick look, of one or two repetitions, does without."""
REACH = 10
"""Pixels around the output that the filters need beyond half the window."""


@dataclass(frozen=True)
class Scene:
    """The sinusoid of section 5.3 behind ``out_px`` squared output pixels, seen by 9 cameras in 9 frames.

    ``noise``: standard deviation in grey values of a range of 100, so that error bars mean something.
    """

    out_px: int = 300
    window: int = 65
    sigma: float = 19.0
    cameras: int = 9
    frames: int = 9
    preshift_px: int = -14
    noise: float = 2.5

    @property
    def margin(self) -> int:
        """Pixels around the output in the reference image."""
        return self.window // 2 + REACH

    def capture(self) -> Capture:
        """The images, large enough for the output, its halo, and the preshift."""
        scene = sinusoid_scene()
        side = self.out_px + 2 * self.margin
        scene = replace(
            scene, size=(side + 2 * (self.cameras // 2) * abs(self.preshift_px), side), n_cols=self.cameras,
            n_frames=self.frames, noise=self.noise,
        )  # fmt: skip
        images = render(scene).astype(np.float32)
        return capture_from_array(images, Geometry(scene.f_px, scene.principal, (scene.baseline_mm[0], 0.0)))

    def options(self, capture: Capture, **further: Any) -> dict[str, Any]:
        """Options of ``estimate`` for the middle frame, the output in the middle of the images, not refined."""
        x0, y0 = (capture.width - self.out_px) // 2, self.margin
        return {
            "model": "affine-4d", "refine": 0, "preshift": (self.preshift_px, 0), "window": self.window,
            "sigma": self.sigma,
            "frames": f"{self.frames // 2}:{self.frames // 2 + 1}", "tile": self.out_px,
            "roi": (x0, y0, x0 + self.out_px, y0 + self.out_px), **further,
        }  # fmt: skip

    def plan(self, capture: Capture, **further: Any) -> Plan:
        """The plan of these options: one band."""
        return make_plan(capture, load_config(overrides=self.options(capture, **further)))


@dataclass(frozen=True)
class Timed:
    """Seconds for the whole output, the null space alone being a part of ``c``; ``warm_up``: compiling, loading."""

    a: float
    b: float
    c: float
    null_space: float
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

    @property
    def stages(self) -> float:
        """For one frame alone up to the flow parameters: filters, windows, null space."""
        return self.window_frames * self.a + self.b + self.null_space


@dataclass
class Stages:
    """The stages of a plan whose one band is the whole output, and the blocks of its frames."""

    device: Device
    plan: Plan
    tensor: TensorStage
    estimate: EstimateStage
    null_space: EstimateStage
    blocks: list[Array]

    @classmethod
    def of(cls, plan: Plan, capture: Capture, device: Device) -> Stages:
        """Builds the stages; compiles nothing."""
        problem = plan.problem
        band = Band.of(problem.sampling, len(plan.y), len(plan.x), plan.x.step)
        tensor = TensorStage(
            device, problem.columns, plan.layout, problem.sampling, band, mask=problem.mask_moments(plan.layout)
        )
        view = _view(plan, band, tensor.out_pitch)
        estimate = EstimateStage(device, problem, plan.layout, view, bool(plan.margin))
        y0, x0 = plan.y.start - band.halo_y, plan.x.start - band.halo_x
        blocks = [
            capture.block(
                [t], *plan.cameras, y0, y0 + band.in_rows, x0, x0 + band.in_cols, plan.preshift, device.real("storage")
            )[0]
            for t in range(capture.n_frames)
        ]
        return cls(device, plan, tensor, estimate, _up_to_parameters(device, plan, view), blocks)

    def push(self, frames: Iterable[Array]) -> tuple[list[float], Any]:
        """Seconds of every frame pushed into an empty window, and the last tensor."""
        valid = np.ones(self.blocks[0].shape[2:], bool)
        seconds, tensor = [], None
        self.tensor.reset()
        for block in frames:
            began = time.perf_counter()
            tensor = self.tensor.push(block, valid)
            self.device.synchronize()
            seconds.append(time.perf_counter() - began)
        return seconds, tensor

    def time(self, repeats: int, warm_up: float) -> Timed:
        """Medians of ``repeats`` runs through the frames of one window."""
        sampling, window_frames = self.plan.problem.sampling, self.plan.problem.sampling.t.size
        first = 2 * sampling.t.filter_radius  # frames before this one only fill the filters
        filling, full, estimating, solving = [], [], [], []
        settle(lambda: self.estimate(self.push(self.blocks)[1]), repeats)
        for _ in range(repeats):
            seconds, tensor = self.push(self.blocks)
            filling += seconds[first : first + window_frames - 1]
            full += seconds[first + window_frames - 1 :]
            estimating.append(_seconds(lambda tensor=tensor: self.estimate(tensor)))
            solving.append(_seconds(lambda tensor=tensor: self.null_space(tensor)))
        a = statistics.median(filling)
        return Timed(
            a, statistics.median(full) - a, statistics.median(estimating), statistics.median(solving), warm_up,
            window_frames,
        )  # fmt: skip


def _up_to_parameters(device: Device, plan: Plan, view: View) -> EstimateStage:
    """The part of the estimate up to the flow parameters and their residuals; it writes no maps."""
    from leafflow_ti.kernels.numbers import Stage

    stage = EstimateStage(device, plan.problem, plan.layout, view)
    stage._steps = list(itertools.takewhile(lambda step: step.stage != Stage.CLEAN, stage._steps))
    stage.set_view(view)
    return stage


def _view(plan: Plan, band: Band, pitch: int) -> View:
    geometry, offset = plan.geometry, plan.geometry.disparity_offset_px
    shift = (plan.preshift[0] + offset[0], plan.preshift[1] + offset[1])
    return View(
        geometry.f_px, geometry.principal_px, geometry.baseline_mm, shift, plan.x.start, plan.y.start, plan.x.step,
        band.rows, band.cols, pitch,
    )  # fmt: skip


def _seconds(work: Callable[[], Any]) -> float:
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def settle(work: Callable[[], Any], repeats: int) -> None:
    """Work until times of so many repetitions may count: at least once."""
    began = time.perf_counter()
    work()
    while repeats > 2 and time.perf_counter() - began < SETTLE_S:
        work()


def median_seconds(work: Callable[[], Any], repeats: int) -> float:
    """Median of ``repeats`` calls, after some that are not counted."""
    settle(work, repeats)
    return statistics.median(_seconds(work) for _ in range(repeats))


def time_stages(plan: Plan, capture: Capture, device: Device, repeats: int) -> Timed:
    """Compile what the plan needs, then time its stages on one band."""
    warm_up = Pipeline(plan, capture, device).warm_up()
    return Stages.of(plan, capture, device).time(repeats, warm_up)


def plain_tensor(
    device: Device, columns: Any, sampling: Sampling, images: Array, rows: int, cols: int
) -> tuple[float, Array]:
    """Structure tensors of one camera's ``images`` [t, y, x]: median seconds of a frame once the window is full, and
    the packed entries [entries, rows, cols] of the last one."""
    layout = TensorLayout.of(columns)
    stage = TensorStage(device, columns, layout, sampling, Band.of(sampling, rows, cols, 1))
    valid = np.ones(images.shape[1:], bool)
    seconds, tensor = [], None
    for image in images:
        began = time.perf_counter()
        tensor = stage.push(image[None, None], valid)
        device.synchronize()
        if tensor is not None:
            seconds.append(time.perf_counter() - began)
    planes = np.array(device.host(tensor))[: len(layout.entries) * rows * stage.out_pitch]
    return statistics.median(seconds), planes.reshape(-1, rows, stage.out_pitch)[:, :, :cols]
