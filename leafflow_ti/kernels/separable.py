"""Correlation along one axis of an array ``[outer, n, inner]`` in C order, whatever lies behind its ends.

Output ``i`` is ``Σ_k weight[k] src[index[i + k]]``: what continues the axis beyond its ends is a table of indices, in
which -1 stands for a constant. On the CPU neighbouring outputs are worked on together, ``lanes`` at a time: along
``inner`` where it is long enough, else along the axis itself, which is continued in a line of scratch. The last
``lanes`` outputs of a line overlap those before, so that lines may have any length.
"""

import functools

from leafflow_ti.kernels.engine import lane_kernel, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec


@functools.cache
def correlate_rows_kernel(spec: KernelSpec):
    """Along an axis that is not the last one: ``dst[o, i, x] = Σ_k weight[k] src[o, index[i + k], x]``."""
    real, lanes = spec.real, spec.lanes

    @ti.func
    def strip(
        i: ti.i32, at: ti.i32, to: ti.i32, inner: ti.i32, taps: ti.i32, constant: real,
        index: ti.template(), weight: ti.template(), src: ti.template(), dst: ti.template(),
    ):  # fmt: skip
        total = ti.Vector.zero(real, lanes)
        for k in range(taps):
            row, w = index[i + k], weight[k]
            if row >= 0:
                begin = at + row * inner
                for l in range(lanes):
                    total[l] += w * src[begin + l]
            else:
                for l in range(lanes):
                    total[l] += w * constant
        for l in range(lanes):
            dst[to + l] = total[l]

    @ti.func
    def single(
        i: ti.i32, at: ti.i32, to: ti.i32, inner: ti.i32, taps: ti.i32, constant: real,
        index: ti.template(), weight: ti.template(), src: ti.template(), dst: ti.template(),
    ):  # fmt: skip
        total = ti.cast(0, real)
        for k in range(taps):
            row = index[i + k]
            value = constant
            if row >= 0:
                value = src[at + row * inner]
            total += weight[k] * value
        dst[to] = total

    @lane_kernel(1 if spec.gpu else lanes, numbers=True)
    def correlate_rows(
        outer: ti.i32,
        n: ti.i32,
        inner: ti.i32,
        taps: ti.i32,
        n_tasks: ti.i32,
        constant: real,
        index_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n + taps - 1]
        weight_in: ti.types.ndarray(dtype=real, ndim=1),  # [taps]
        src_in: ti.types.ndarray(dtype=real, ndim=1),  # [outer * n * inner]
        dst_out: ti.types.ndarray(dtype=real, ndim=1),  # [outer * n * inner]
    ):
        if ti.static(spec.gpu):
            for g in range(outer * n * inner):
                line = g // inner
                o = line // n
                at = o * n * inner + g - line * inner
                single(line - o * n, at, g, inner, taps, constant, index_in, weight_in, src_in, dst_out)
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for line in range(task * outer * n // n_tasks, (task + 1) * outer * n // n_tasks):
                        o = line // n
                        i, at, to = line - o * n, o * n * inner, line * inner
                        if inner >= lanes:
                            for s in range((inner + lanes - 1) // lanes):
                                x = ti.min(s * lanes, inner - lanes)
                                strip(i, at + x, to + x, inner, taps, constant, index_in, weight_in, src_in, dst_out)
                        else:
                            for x in range(inner):
                                single(i, at + x, to + x, inner, taps, constant, index_in, weight_in, src_in, dst_out)

    return correlate_rows


@functools.cache
def correlate_lines_kernel(spec: KernelSpec):
    """Along the last axis: ``dst[o, i] = Σ_k weight[k] src[o, index[i + k]]``; for CPUs."""
    real, lanes = spec.real, spec.lanes

    @lane_kernel(lanes, numbers=True)
    def correlate_lines(
        outer: ti.i32,
        n: ti.i32,
        taps: ti.i32,
        n_tasks: ti.i32,
        length: ti.i32,  # of a task's line in scratch: at least ``lanes`` outputs
        constant: real,
        index_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n + taps - 1]
        weight_in: ti.types.ndarray(dtype=real, ndim=1),  # [taps]
        src_in: ti.types.ndarray(dtype=real, ndim=1),  # [outer * n]
        line_tmp: ti.types.ndarray(dtype=real, ndim=1),  # [n_tasks * length]
        dst_out: ti.types.ndarray(dtype=real, ndim=1),  # [outer * n]
    ):
        for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
            if part == 0:
                home = task * length
                for o in range(task * outer // n_tasks, (task + 1) * outer // n_tasks):
                    for j in range(n + taps - 1):
                        column = index_in[j]
                        value = constant
                        if column >= 0:
                            value = src_in[o * n + column]
                        line_tmp[home + j] = value
                    for s in range((n + lanes - 1) // lanes):
                        x = ti.max(ti.min(s * lanes, n - lanes), 0)
                        total = ti.Vector.zero(real, lanes)
                        for k in range(taps):
                            begin, w = home + x + k, weight_in[k]
                            for l in range(lanes):
                                total[l] += w * line_tmp[begin + l]
                        to = o * n + x
                        if n >= lanes:
                            for l in range(lanes):
                                dst_out[to + l] = total[l]
                        else:
                            for l in range(n):
                                dst_out[to + l] = total[l]

    return correlate_lines
