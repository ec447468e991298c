"""Per-pixel stages: structure tensors of a band to named maps, group by group of pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.kernels.numbers import Stage
from leafflow_ti.models import TensorLayout
from leafflow_ti.runtime import Device
from leafflow_ti.stages.cells import SourcePlanes
from leafflow_ti.stages.estimate_tables import ProblemTables
from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.stages.problem import Problem
from leafflow_ti.stages.view import View
from leafflow_ti.trace import span

__all__ = ["EstimateStage", "View"]
BATCH_BYTES = 16 << 20
"""Workspace of one batch of pixels on the CPU where the steps are launched apart."""
GPU_GROUPS = 1 << 15
CHUNK_GROUPS = 2048
"""Groups of a launch on the CPU: some tenths of a second, so that an interrupt is noticed."""
TASKS_PER_THREAD = 4


@dataclass(frozen=True)
class _Step:
    """A stage, its argument, and which tables it works with; ``part``: "solve" or "fit"; ``anew``: as of a Move."""

    stage: int
    which: int
    tables: int
    part: str
    anew: bool


class EstimateStage:
    """Maps of ``Output`` planes [rows, pitch] from the packed tensors of ``TensorStage``.

    One tensor of the reference model, and one of each camera's own flow where the problem has them. ``differences``:
    the covariances of the velocity's difference quotients are wanted, too; growth needs them. ``apart``: the steps of
    each part (solve, fit) are launched apart, as always on a GPU, so that their times can be told. ``sources``: of the
    tensor stage, for estimators that weigh windows anew.
    """

    def __init__(
        self, device: Device, problem: Problem, layout: TensorLayout, view: View, differences: bool = True,
        apart: bool = False, sources: Sequence[SourcePlanes] = (),
    ):  # fmt: skip
        from leafflow_ti.kernels.maps import Output

        self.device, self.problem, self.view, self.differences = device, problem, view, differences
        self.apart = apart or device.gpu
        self._tensor_layout, self._sources = layout, sources
        self._tables = ProblemTables(device, problem, layout, sources)
        self.layout = self._tables.layout
        self._steps = self._make_steps()
        self.set_view(view)
        lanes, n_pixels = device.dense.lanes, view.rows * view.pitch
        self._row_groups = -(-view.cols // lanes)
        itemsize = np.dtype(device.real("algebra")).itemsize
        per_group = self.layout.n_elements * lanes * itemsize
        groups = view.rows * self._row_groups
        self._tasks = TASKS_PER_THREAD * device.threads
        if device.gpu:
            self._groups = min(groups, GPU_GROUPS)
        elif self.apart:
            self._groups = max(1, min(groups, BATCH_BYTES // per_group))
        else:
            self._groups = min(groups, CHUNK_GROUPS)
        places = self._groups if self.apart else self._tasks
        self._workspace = device.empty(places * self.layout.n_elements * lanes, "algebra")
        self._maps = device.empty(Output.PLANES * n_pixels)

    def set_noise(self, noise: float) -> None:
        """Go on to images of another noise level [grey values]; takes effect with the next ``set_view``."""
        self.problem = replace(self.problem, noise=noise)
        self._tables.set_noise(noise)

    def set_frame(self, frame: int) -> None:
        """Go on to another reference frame of the sequence: nothing to do unless frames are uneven in time."""
        problem = self.problem.about(frame)
        if problem is not self.problem:
            self.problem = problem
            self._tables = ProblemTables(self.device, problem, self._tensor_layout, self._sources)
            assert self._tables.layout == self.layout
            self.set_view(self.view)

    def set_view(self, view: View) -> None:
        """Move to another band of the same size."""
        self.view = view
        self._tables.aim(view)
        tables = self._tables.tables
        numbers, values = (np.cumsum([0, *map(len, parts)]) for parts in (
            [t.number for t in tables], [t.value for t in tables]
        ))  # fmt: skip
        steps = [n for s in self._steps for n in (s.stage, s.which, numbers[s.tables], values[s.tables], s.anew)]
        self._on_device = (
            self.device.array(steps, "int"), self.device.array(np.concatenate([t.number for t in tables]), "int"),
            self.device.array(np.concatenate([t.value for t in tables]), "algebra"),
        )  # fmt: skip

    def _make_steps(self) -> list[_Step]:
        """What is done to every group of pixels."""
        from leafflow_ti.kernels.patch_fit import CLEAR, COVARIANCE, DIFFERENCES, FINISH, START

        problem, own = self.problem, self.problem.own_flows
        steps: list[_Step] = []

        def add(stage: Stage, which: int = 0, tables: int = 0, anew: bool = False) -> None:
            fits = Stage.ROW_COVARIANCE < stage <= Stage.EMIT
            steps.append(_Step(stage, which, tables, "fit" if fits else "solve", anew))

        def solve(tables: int) -> None:
            for move in ESTIMATORS[problem.estimator].moves(problem.solver, problem.cut):
                add(move.stage, move.which, tables + self._tables.raw if move.raw else tables, move.anew)
            add(Stage.CLEAN, tables=tables)

        errors = COVARIANCE | (DIFFERENCES if self.differences else 0)
        solve(0)
        if "t" in problem.columns.solutions:
            add(Stage.ROW_COVARIANCE, problem.columns.n_time_like - 1)
        for camera in range(len(problem.camera_axes)):
            add(Stage.ROW_COVARIANCE, camera)
            add(Stage.ADD_CAMERA, camera)
        if problem.camera_axes:
            add(Stage.GEOMETRY)
        if problem.range_scale is not None:
            add(Stage.RANGE_MOTION)
        elif problem.fitted:
            for i in range(problem.passes):
                last = i == problem.passes - 1 and not own
                add(Stage.PATCH_FIT, (START if i == 0 else CLEAR) | FINISH | (errors if last else 0))
        add(Stage.MEASURED)
        if own:
            if own.reference_rows:
                add(Stage.PATCH_FIT, CLEAR | errors, ProblemTables.FINAL)
            for i in range(len(own.steps)):
                solve(ProblemTables.OWN + i)
                add(Stage.ROW_COVARIANCE, 0, ProblemTables.OWN + i)
                clear = CLEAR if i == 0 and not own.reference_rows else 0
                finish = FINISH if i == len(own.steps) - 1 else 0
                add(Stage.PATCH_FIT, clear | errors | finish, ProblemTables.OWN + i)
        if problem.unknowns:
            add(Stage.MOTION, tables=ProblemTables.FINAL if own else 0)
        add(Stage.EMIT)
        return steps

    def _launches(self) -> list[tuple[Any, int, int, str]]:
        """Kernel, first step, end, and part of what is launched for a batch."""
        from leafflow_ti.kernels.stages import stage_kernel, stages_kernel

        spec, steps = replace(self.device.dense, cut=self._tables.layout.mask > 0), self._steps
        if self.device.gpu:
            return [(stage_kernel(spec, Stage(s.stage)), i, i + 1, s.part) for i, s in enumerate(steps)]
        kernel = stages_kernel(spec, Stage(max(s.stage for s in steps)))
        if not self.apart:
            return [(kernel, 0, len(steps), "estimate")]
        runs, first = [], 0
        for part, run in groupby(steps, lambda s: s.part):
            end = first + len(list(run))
            runs.append((kernel, first, end, part))
            first = end
        return runs

    def __call__(self, tensors: Any) -> NDArray[Any]:
        """The planes of ``Output`` as a NumPy array [planes, rows, cols]; ``tensors``: what ``TensorStage`` returns."""
        from leafflow_ti.kernels.maps import Output

        device, view, lanes = self.device, self.view, self.device.dense.lanes
        n_pixels = view.rows * view.pitch
        workspace = device.vectors(self._workspace, lanes)
        task_step, group_step = (0, self.layout.n_elements) if self.apart else (self.layout.n_elements, 0)
        n_groups = view.rows * self._row_groups
        for first in range(0, n_groups, self._groups):
            groups = min(self._groups, n_groups - first)
            for kernel, begin, end, part in self._launches():
                with span(part):
                    kernel(
                        first, groups, task_step, group_step, self._row_groups, view.pitch, n_pixels, begin, end,
                        min(groups, self._tasks), *self._on_device, tensors, workspace, self._maps,
                    )  # fmt: skip
        planes = device.host(self._maps).reshape(Output.PLANES, view.rows, view.pitch)
        result: NDArray[Any] = planes[:, :, : view.cols]
        return result
