"""Per-pixel stages run group by group: the kernel that takes a group of pixels through a list of steps.

A *step* is a stage, an argument, and the tables that it works with. On the CPU one launch takes every group through
all steps: its workspace stays in the processor's cache, and a launch costs as much as some hundred pixels. On a GPU
every step is a launch of its own and every thread a pixel.
"""

import functools

from leafflow_ti.kernels.dense import dense
from leafflow_ti.kernels.engine import lane_kernel, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec
from leafflow_ti.kernels.workspace import Region

STEP = 5
"""Entries of a step: stage, argument, first entry of its table ``number``, and of its table ``value``; 1 if it is only
for groups with a pixel whose window is weighted anew."""


@ti.dataclass
class Place:
    """Where a stage works."""

    base: ti.i32  # the group's first element of the workspace
    stride: ti.i32  # distance of workspace elements
    pixel: ti.i32  # the group's first pixel
    n_pixels: ti.i32  # of a plane
    which: ti.i32  # the step's argument
    n: ti.i32  # first entry of the step's table ``number``
    v: ti.i32  # first entry of its table ``value``


@ti.func
def region(p: ti.template(), number: ti.template(), name: ti.template()) -> ti.i32:
    """First element of a region of the workspace."""
    return p.base + number[p.n + name] * p.stride


@functools.cache
def planes_loader(spec: KernelSpec):
    """A function: so many planes of the tensors, from the ``first`` on, of the group's pixels into the workspace at
    ``target``, in the precision of the algebra."""
    precise, lanes, V = spec.precise, spec.lanes, spec.element

    @ti.func
    def load_planes(
        first: ti.i32, count: ti.i32, target: ti.i32, p: ti.template(), ws: ti.template(), J: ti.template()
    ):
        for k in range(count):
            begin = (first + k) * p.n_pixels + p.pixel
            element = V(0.0)
            if ti.static(lanes == 1):
                element = ti.cast(J[begin], precise)
            else:
                for i in ti.static(range(lanes)):
                    element[i] = ti.cast(J[begin + i], precise)
            ws[target + k * p.stride] = element

    return load_planes


@functools.cache
def group_kernel(spec: KernelSpec, stages: tuple):
    """A kernel: the stages ``(p, number, value, ws, J, out)`` that the steps name, for every group of a batch.

    ``row_groups`` groups cover a row of the output, ``pitch`` pixels are stored of it. A step's stage counts in
    ``stages``; with a single stage it does not matter. Group g of a task works at ``task task_step + g group_step`` of
    the workspace.
    """
    real, precise, lanes, element = spec.real, spec.precise, spec.lanes, spec.element
    any_lane = dense(spec).any_lane

    @ti.func
    def run_steps(
        base: ti.i32, stride: ti.i32, pixel: ti.i32, n_pixels: ti.i32, first_step: ti.i32, last_step: ti.i32,
        steps: ti.template(), number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        for s in range(first_step, last_step):
            p = Place(
                base=base, stride=stride, pixel=pixel, n_pixels=n_pixels, which=steps[STEP * s + 1],
                n=steps[STEP * s + 2], v=steps[STEP * s + 3],
            )  # fmt: skip
            code = steps[STEP * s]
            if steps[STEP * s + 4] == 1 and any_lane(ws[region(p, number, Region.ACTIVE)] > element(0.5)) == 0:
                code = -1
            if ti.static(len(stages) == 1):
                if code >= 0:
                    stages[0](p, number, value, ws, J, out)
            else:
                for index in ti.static(range(len(stages))):
                    if code == index:
                        stages[index](p, number, value, ws, J, out)

    @ti.func
    def pixel_of(group: ti.i32, row_groups: ti.i32, pitch: ti.i32) -> ti.i32:
        """First pixel of a group: groups lie side by side in the rows of the output."""
        row = group // row_groups
        return row * pitch + (group - row * row_groups) * lanes

    @lane_kernel(lanes, long=True)
    def groups(
        first_group: ti.i32,
        n_groups: ti.i32,
        task_step: ti.i32,
        group_step: ti.i32,
        row_groups: ti.i32,
        pitch: ti.i32,
        n_pixels: ti.i32,
        first_step: ti.i32,
        last_step: ti.i32,
        n_tasks: ti.i32,
        steps_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_steps * STEP]
        number_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # all tables, one after the other
        value_in: ti.types.ndarray(dtype=precise, ndim=1),
        J_in: ti.types.ndarray(dtype=real, ndim=1),  # [n_planes * n_pixels]
        ws_io: ti.types.ndarray(dtype=element, ndim=1),
        map_out: ti.types.ndarray(dtype=real, ndim=1),  # [n_maps * n_pixels]
    ):
        if ti.static(spec.gpu):
            for g in range(n_groups):
                run_steps(
                    g, n_groups, pixel_of(first_group + g, row_groups, pitch), n_pixels, first_step, last_step,
                    steps_in, number_in, value_in, J_in, ws_io, map_out,
                )  # fmt: skip
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for g in range(task * n_groups // n_tasks, (task + 1) * n_groups // n_tasks):
                        run_steps(
                            task * task_step + g * group_step, 1, pixel_of(first_group + g, row_groups, pitch),
                            n_pixels, first_step, last_step, steps_in, number_in, value_in, J_in, ws_io, map_out,
                        )  # fmt: skip

    return groups
