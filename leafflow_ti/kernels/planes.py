"""Correlations of whole planes of images.

A plane is ``[rows, pitch]``, ``pitch`` a multiple of the lanes; a stack of planes is one flat array. Which planes,
shifts and weights make up which output is data (tables of terms), not code.
"""

import functools

from leafflow_ti.kernels.engine import Kernel, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec


@functools.cache
def filter_planes_kernel(spec: KernelSpec, col_step: int):
    """``dst[o, y, x] = Σ_k weight[k] src[offset[k] + y row_step + x col_step]``, k from first[o] to first[o + 1].

    ``to``: where in ``dst`` the first plane begins.
    """
    real, lanes = spec.real, spec.lanes

    @ti.func
    def one_group(
        g: ti.i32,
        rows: ti.i32,
        pitch: ti.i32,
        row_step: ti.i32,
        to: ti.i32,
        first: ti.template(),
        offset: ti.template(),
        weight: ti.template(),
        src: ti.template(),
        dst: ti.template(),
    ):
        strips = pitch // lanes
        plane = g // (rows * strips)
        y = g // strips - plane * rows
        x = (g % strips) * lanes
        start = y * row_step + x * col_step
        total = ti.Vector.zero(real, lanes)
        for k in range(first[plane], first[plane + 1]):
            begin = start + offset[k]
            w = weight[k]
            for i in range(lanes):
                total[i] += w * src[begin + i * col_step]
        at = to + (plane * rows + y) * pitch + x
        for i in range(lanes):
            dst[at + i] = total[i]

    @Kernel
    def filter_planes(
        n_planes: ti.i32,
        rows: ti.i32,
        pitch: ti.i32,
        row_step: ti.i32,
        to: ti.i32,
        n_tasks: ti.i32,
        first_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_planes + 1]
        offset_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        weight_in: ti.types.ndarray(dtype=real, ndim=1),  # [n_terms]
        src_in: ti.types.ndarray(dtype=real, ndim=1),  # [any]
        dst_out: ti.types.ndarray(dtype=real, ndim=1),  # [to + n_planes * rows * pitch]
    ):
        n_groups = n_planes * rows * (pitch // lanes)
        if ti.static(spec.gpu):
            for g in range(n_groups):
                one_group(g, rows, pitch, row_step, to, first_in, offset_in, weight_in, src_in, dst_out)
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for g in range(task * n_groups // n_tasks, (task + 1) * n_groups // n_tasks):
                        one_group(g, rows, pitch, row_step, to, first_in, offset_in, weight_in, src_in, dst_out)

    return filter_planes


@functools.cache
def copy_kernel(spec: KernelSpec):
    """``dst[to + i] = src[i]``: a host block into its place on a GPU."""

    @Kernel
    def copy(
        n: ti.i32,
        to: ti.i32,
        src_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n]
        dst_out: ti.types.ndarray(dtype=spec.real, ndim=1),  # [to + n]
    ):
        for i in range(n):
            dst_out[to + i] = src_in[i]

    return copy
