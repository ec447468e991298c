"""Host side of the exact refinement: spline coefficients of the frames in the window, tables, launches."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.refine_plan import Effort, Refinement
from leafflow_ti.runtime import Device
from leafflow_ti.splines import filter_radius, filter_taps
from leafflow_ti.stages.planes import Filtering, round_up
from leafflow_ti.stages.refine_tables import RefineTables, Workspaces
from leafflow_ti.stages.view import View
from leafflow_ti.trace import span

Array = NDArray[Any]

LAUNCH_SECONDS = 0.3
"""Of a launch on the CPU, about: an interrupt is noticed only between two."""
SAMPLES_PER_SECOND = 5e7
"""Warped samples that a thread makes at least."""
SPOILT = 4
"""Pixels around an invalid one whose coefficients it spoils: what it adds further away is below 1 %."""


@dataclass(frozen=True)
class Refined:
    """What became of some pixels [n]; see ``kernels.refine_tables.Code``.

    ``parameters`` [n, 15]: Z0, ZX, ZY, N, Ω, A, growth rates (0 where not estimated); ``covariance`` [n, 15, 15], 0
    where not estimated, -1 where the data do not determine an unknown. ``passes``: evaluations of the residual;
    ``samplings``: those for which the images were interpolated anew; ``start`` and ``cost``: mean squared residual
    before and after.
    """

    code: NDArray[np.int64]
    passes: NDArray[np.int64]
    samplings: NDArray[np.int64]
    start: Array
    cost: Array
    parameters: Array
    covariance: Array

    @property
    def effort(self) -> Effort:
        """What it took."""
        return Effort(len(self.passes), int(self.passes.sum()), int(self.samplings.sum()))

    @property
    def converged(self) -> NDArray[np.bool_]:
        """Where there is a refined result."""
        from leafflow_ti.kernels.refine_tables import Code

        return np.asarray((self.code == Code.REFINED) & np.isfinite(self.parameters).all(axis=1))


class RefineStage:
    """Refines pixels of bands of one size: blocks [rows, cols] of every camera, frame after frame.

    ``view``: camera and shifts, as of ``EstimateStage``; its position in the image does not matter.
    """

    def __init__(self, device: Device, plan: Refinement, view: View, rows: int, cols: int):
        self.device, self.plan, self.rows, self.cols = device, plan, rows, cols
        self.pitch = round_up(cols, 64)
        self._plane = rows * self.pitch
        n, n_frames = len(plan.cameras), len(plan.frames)
        self._coefficients = device.zeros(n * n_frames * self._plane)
        self._slots: deque[int] = deque(maxlen=n_frames)
        self._next = 0
        self._filters = _filters(device, rows, self.pitch, plan.degree)
        self._mask: Any = None
        self._gaps: list[Gaps | None] = [None] * n
        lanes = device.dense.lanes
        self._times = plan.frames
        self.set_view(view)
        storage, algebra = (np.dtype(device.real(kind)).itemsize for kind in ("storage", "algebra"))
        space = Workspaces.of(plan, lanes, (storage, algebra), device.gpu, device.threads)
        self._batch = self._slots_n = space.slots
        if not device.gpu:
            samples = n * n_frames * plan.across**2 * (plan.steps + 1)
            self._batch = max(space.slots, int(LAUNCH_SECONDS * device.threads * SAMPLES_PER_SECOND / samples))
        self._real = device.zeros(space.slots * space.real * lanes)
        self._precise = device.zeros(space.slots * space.precise * lanes, "algebra")

    def set_view(self, view: View) -> None:
        """Take images that are shifted in another way, or another camera."""
        device, lanes = self.device, self.device.dense.lanes
        self._view = view
        tables = RefineTables.of(replace(self.plan, frames=self._times), view, lanes, self.pitch, device.gpu)
        self.size = tables.size
        self._tables = (
            device.array(tables.size, "int"), device.array(tables.value, "algebra"),
            device.vectors(device.array(tables.image, "algebra"), lanes),
        )  # fmt: skip
        self._samples = device.vectors(device.array(tables.sample), lanes)

    def reset(self) -> None:
        """Forget all frames."""
        self._slots.clear()
        self._next = 0

    def set_frames(self, offsets: tuple[float, ...]) -> None:
        """Enter the frames' offsets from where the results lie, as many as the plan has."""
        if offsets == self._times:
            return
        assert len(offsets) == len(self._times)
        self._times = offsets
        self.set_view(self._view)

    def push(self, block: Array, finite: NDArray[np.bool_], hidden: NDArray[np.bool_] | None = None) -> None:
        """Take the next frame: images [sy, sx, rows, cols], where each is a grey value of an image, and where it shows
        something else than the surface (None: nowhere)."""
        from leafflow_ti.kernels.refine_tables import NOTHING

        n = len(self.plan.cameras)
        slot = self._next % len(self.plan.frames)
        self._next += 1
        self._slots.append(slot)
        images, valid = (a.reshape(n, self.rows, self.cols) for a in (block, finite))
        with span("splines"):
            for k in range(n):
                gaps = self._gaps[k]
                if gaps is None or not np.array_equal(gaps.valid, valid[k]):
                    self._gaps[k] = gaps = Gaps.of(valid[k], self.pitch, filter_radius(self.plan.degree))
                at = (slot * n + k) * self._plane
                self._filter(images[k], gaps, at, NOTHING)
                if hidden is not None and (beside := hidden.reshape(images.shape)[k]).any():
                    self._take_out(beside, at, NOTHING)

    def _take_out(self, hidden: NDArray[np.bool_], at: int, nothing: float) -> None:
        """Let nothing be sampled from where the image shows something else."""
        if self.device.gpu:
            plane = self.device.host(self._coefficients)[at : at + self._plane].copy()
            plane.reshape(self.rows, self.pitch)[:, : self.cols][hidden] = nothing
            self.device.write(self._coefficients, at, plane)
        else:
            plane = self._coefficients[at : at + self._plane].reshape(self.rows, self.pitch)
            plane[:, : self.cols][hidden] = nothing

    def _filter(self, image: Array, gaps: Gaps, to: int, nothing: float) -> None:
        """Spline coefficients of one image; those without a meaning are ``nothing``."""
        along_y, along_x, padded, tall = self._filters
        r = filter_radius(self.plan.degree)
        wide = np.zeros((self.rows + 2 * r, self.pitch), image.dtype)
        wide[r:-r, : self.cols] = image
        wide.ravel()[gaps.filled] = image.ravel()[gaps.source]
        self.device.write(padded, 0, wide)
        along_y(padded, tall, r)
        along_x(tall, self._coefficients, to)
        if self.device.gpu:
            plane = self.device.host(self._coefficients)[to : to + self._plane].copy()
            plane[gaps.spoilt] = nothing
            self.device.write(self._coefficients, to, plane)
        else:
            self._coefficients[to : to + self._plane][gaps.spoilt] = nothing

    def set_mask(self, mask: NDArray[np.bool_] | None) -> None:
        """Pixels [rows, cols] of the block that belong to the surface; None: all."""
        self._mask = None
        if mask is not None and not mask.all():
            plane = np.zeros((self.rows, self.pitch), self.device.real("storage"))
            plane[:, : self.cols] = mask
            self._mask = self.device.array(plane)

    def __call__(
        self, y: NDArray[np.int64], x: NDArray[np.int64], rays: Array, start: Array, steps: int | None = None,
        curvature: Array | None = None,
    ) -> Refined:  # fmt: skip
        """Refine the pixels in rows ``y`` and columns ``x`` of the block [n].

        ``rays`` [n, 2]: their positions from the principal point, px; ``start`` [n, 15]: parameters. ``steps``: at most
        so many; None: as planned. ``curvature`` [n, 3]: that of the surface, K (xx, xy, yy) in 1/px², see
        ``kernels.refine_warp``; None: planes.
        All frames of the window have been pushed.
        """
        from leafflow_ti.kernels.refine_tables import Out, Size

        device, n = self.device, len(y)
        with span("refine"):
            frames = np.array(list(self._slots))
            cameras = len(self.plan.cameras)
            origin = ((frames[:, None] * cameras + np.arange(cameras)) * self._plane).ravel()
            size, most = self.size.copy(), steps or self.plan.steps
            bent = np.zeros((n, 3)) if curvature is None else curvature
            size[Size.STEPS] = most
            size[Size.MASKED] = int(self._mask is not None)
            out = device.zeros(n * Out.N, "algebra")
            device_size = device.array(size, "int")
            arguments = (
                device_size, *self._tables[1:], device.array(origin, "int"), self._samples, self._coefficients,
                self._mask if self._mask is not None else device.zeros(1), device.array(y * self.pitch + x, "int"),
                device.array(np.concatenate([rays, start, bent], axis=1), "algebra"), *self._workspaces(), out,
            )  # fmt: skip
            for first in range(0, n, self._batch):
                self._launch(first, min(self._batch, n - first), most, arguments)
            found = np.asarray(device.host(out), float).reshape(n, Out.N)
        code, passes, samplings = (found[:, k].astype(np.int64) for k in (Out.CODE, Out.PASSES, Out.SAMPLINGS))
        return Refined(
            code, passes, samplings, found[:, Out.START], found[:, Out.COST], found[:, Out.Q : Out.COVARIANCE],
            found[:, Out.COVARIANCE :].reshape(n, Out.COVARIANCE - Out.Q, Out.COVARIANCE - Out.Q),
        )  # fmt: skip

    def _workspaces(self) -> tuple[Any, ...]:
        lanes, device = self.device.dense.lanes, self.device
        return (
            device.vectors(self._real, lanes), self._real, device.vectors(self._precise, lanes), self._precise,
        )  # fmt: skip

    def _launch(self, first: int, pixels: int, steps: int, arguments: tuple[Any, ...]) -> None:
        from leafflow_ti.kernels.refine import Stage, refine_kernel
        from leafflow_ti.kernels.refine_tables import FUNCTIONS, SHIFTS, Size

        spec, taps = self.device.dense, self.plan.degree + 1
        if not self.device.gpu:
            refine_kernel(spec, taps)(first, pixels, 1, min(pixels, self._slots_n), *arguments)
            return
        size = self.size
        parts = {
            Stage.WINDOW: size[Size.SAMPLE_GROUPS], Stage.PREPARE: size[Size.IMAGE_GROUPS],
            Stage.HAND_OVER: size[Size.IMAGES], Stage.WARP: size[Size.SAMPLE_GROUPS],
            Stage.TEXTURE: size[Size.SAMPLE_GROUPS], Stage.GRAM: FUNCTIONS,
            Stage.SUMS: size[Size.IMAGES], Stage.HALVES: size[Size.IMAGES], Stage.SPREAD: SHIFTS, Stage.NOISE: SHIFTS,
        }  # fmt: skip

        def launch(stages: range) -> None:
            for stage in map(Stage, stages):
                refine_kernel(spec, taps, stage)(first, pixels, int(parts.get(stage, 1)), 1, *arguments)

        launch(range(Stage.BEGIN, Stage.AIM))
        for _ in range(steps):
            launch(range(Stage.AIM, Stage.HALVES))
        launch(range(Stage.HALVES, Stage.FINISH + 1))


def _filters(device: Device, rows: int, pitch: int, degree: int) -> tuple[Filtering, Filtering, Any, Any]:
    """Filters along y and x, and the arrays between them: [rows + 2 radius, pitch], and [rows, pitch] behind radius."""
    taps, r = filter_taps(degree).tolist(), filter_radius(degree)
    along_y = Filtering(device, [[(i * pitch, w) for i, w in enumerate(taps)]], rows, pitch, pitch)
    along_x = Filtering(device, [list(enumerate(taps))], rows, pitch, pitch)
    padded = device.zeros((rows + 2 * r) * pitch)
    return along_y, along_x, padded, device.zeros(rows * pitch + 2 * r + pitch)


@dataclass(frozen=True, eq=False)
class Gaps:
    """Pixels of an image block that hold no grey value: beyond the image, or not finite. Mostly the same ones in every
    frame.

    ``valid`` [rows, cols]. ``filled``: their elements in the padded image, which take the values of the elements
    ``source`` of the image. ``spoilt``: elements of the plane of coefficients that have no meaning.
    """

    valid: NDArray[np.bool_]
    filled: NDArray[np.intp]
    source: NDArray[np.intp]
    spoilt: NDArray[np.bool_]

    @classmethod
    def of(cls, valid: NDArray[np.bool_], pitch: int, radius: int) -> Gaps:
        """For planes of ``pitch``, and filters of ``radius``: that much at the edges lacks neighbours."""
        rows, cols = valid.shape
        spoilt = np.ones((rows, pitch), bool)
        inner = slice(radius, rows - radius), slice(radius, cols - radius)
        spoilt[inner] = _dilated(~valid, SPOILT)[inner]
        y, x = np.nonzero(~valid) if valid.any() else (np.empty(0, np.intp), np.empty(0, np.intp))
        return cls(valid.copy(), (y + radius) * pitch + x, _nearest(valid)[y, x], spoilt.ravel())


def _nearest(valid: NDArray[np.bool_]) -> NDArray[np.intp]:
    """For each pixel the valid one to take: itself, the nearest to the left, else to the right, else of another row."""
    rows, cols = valid.shape
    x = np.arange(cols)
    left = np.maximum.accumulate(np.where(valid, x, -1), axis=1)
    right = np.minimum.accumulate(np.where(valid, x, cols)[:, ::-1], axis=1)[:, ::-1]
    found = np.where(left >= 0, left, np.where(right < cols, right, 0)) + cols * np.arange(rows)[:, None]
    some: NDArray[np.bool_] = np.asarray(valid.any(axis=1))
    with_some: NDArray[np.intp] = np.flatnonzero(some)
    if with_some.size:
        distance = np.abs(np.subtract.outer(np.arange(rows), with_some))
        found = found[with_some[distance.argmin(axis=1)]]
    return np.asarray(found, np.intp)


def _dilated(spoilt: NDArray[np.bool_], radius: int) -> NDArray[np.bool_]:
    """Pixels within ``radius`` rows and columns of a spoilt one."""
    for axis in range(2):
        along = np.moveaxis(spoilt, axis, 0)
        wide = np.pad(along.astype(np.int32), [(radius + 1, radius), (0, 0)]).cumsum(axis=0)
        spoilt = np.moveaxis(wide[2 * radius + 1 :] > wide[: -2 * radius - 1], 0, axis)
    return spoilt
