"""Loops that do nothing but what a processor can do best: what every other kernel is measured against.

Each task owns its part of the arrays; on a GPU a task is a thread and its lanes are one.
"""

import functools

from leafflow_ti.kernels.engine import lane_kernel, lane_type, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec

CHAINS = 8
"""Independent sums: two multiply-adds are begun in every cycle, and each takes about four."""


@functools.cache
def fma_kernel(spec: KernelSpec):
    """``n_steps`` times ``v = v f + d`` for ``CHAINS`` vectors of every task: 2 CHAINS lanes n_steps flops each.

    The factor and the summand come from memory, so that nothing can be worked out beforehand.
    """
    lanes = spec.lanes
    V = lane_type(spec.real, lanes)

    @ti.func
    def chains(task: ti.i32, n_steps: ti.i32, start: ti.template(), result: ti.template()):
        f, d = start[0], start[1]
        v0, v1, v2, v3, v4, v5, v6, v7 = f, d, f + f, f + d, d + d, f * f, f * d, d * d
        for _ in range(n_steps):
            v0 = v0 * f + d
            v1 = v1 * f + d
            v2 = v2 * f + d
            v3 = v3 * f + d
            v4 = v4 * f + d
            v5 = v5 * f + d
            v6 = v6 * f + d
            v7 = v7 * f + d
        result[task] = v0 + v1 + v2 + v3 + v4 + v5 + v6 + v7

    @lane_kernel(lanes)
    def fma(
        n_tasks: ti.i32,
        n_steps: ti.i32,
        start_in: ti.types.ndarray(dtype=V, ndim=1),  # [2]
        result_out: ti.types.ndarray(dtype=V, ndim=1),  # [n_tasks]
    ):
        if ti.static(spec.gpu):
            for task in range(n_tasks):
                chains(task, n_steps, start_in, result_out)
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    chains(task, n_steps, start_in, result_out)

    return fma


@functools.cache
def triad_kernel(spec: KernelSpec):
    """``n_steps`` times ``a = b + f c`` over every task's ``size`` vectors: two reads and a write of each.

    On a GPU a vector is one number and a thread has one of them, for one step: neighbours read neighbouring words.
    """
    lanes = spec.lanes
    V = lane_type(spec.real, lanes)

    @lane_kernel(lanes)
    def triad(
        n_tasks: ti.i32,
        size: ti.i32,
        n_steps: ti.i32,  # 1 on a GPU
        b_in: ti.types.ndarray(dtype=V, ndim=1),  # [n_tasks * size]
        c_in: ti.types.ndarray(dtype=V, ndim=1),  # [n_tasks * size]
        a_out: ti.types.ndarray(dtype=V, ndim=1),  # [n_tasks * size]
    ):
        f = ti.cast(n_steps, spec.real)
        if ti.static(spec.gpu):
            for i in range(n_tasks * size):
                a_out[i] = b_in[i] + f * c_in[i]
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for _ in range(n_steps):
                        for i in range(task * size, (task + 1) * size):
                            a_out[i] = b_in[i] + f * c_in[i]

    return triad
