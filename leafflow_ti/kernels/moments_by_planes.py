"""Filters, products and windows over whole planes, one launch each: see ``kernels.moments`` for the formulas; for GPUs.

Neighbouring threads are neighbouring columns.
"""

import functools

from leafflow_ti.kernels.engine import Kernel, ti
from leafflow_ti.kernels.moments import POWERS, formulas
from leafflow_ti.kernels.spec import KernelSpec


@functools.cache
def linear_kernel(spec: KernelSpec):
    """One linear pass over whole planes, ``dst[to + o plane + row pitch + x]``; for GPUs."""
    linear, _, _ = formulas(spec)

    @Kernel
    def linear_planes(
        n_planes: ti.i32,
        begin: ti.i32,  # first output in the tables
        rows: ti.i32,
        cols: ti.i32,
        row_step: ti.i32,  # source rows per row
        col_step: ti.i32,
        at: ti.i32,
        at_row: ti.i32,  # distance of source rows that are no ring
        turn: ti.i32,  # 1: the ring runs along rows, 0: it begins at slot ``oldest``
        oldest: ti.i32,
        slots: ti.i32,
        hop: ti.i32,
        to: ti.i32,
        plane: ti.i32,
        pitch: ti.i32,
        first_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_outputs + 1]
        offset_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        ring_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        weight_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_terms]
        src_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [any]
        dst_out: ti.types.ndarray(dtype=spec.real, ndim=1),  # [any]
    ):
        for g in range(n_planes * rows * cols):
            line = g // cols
            x = g - line * cols
            o = line // rows
            row = line - o * rows
            linear(
                begin + o, at + row * at_row + x * col_step, 1, oldest + turn * row * row_step, slots, hop,
                to + o * plane + row * pitch + x, first_in, offset_in, ring_in, weight_in, src_in, dst_out,
            )  # fmt: skip

    return linear_planes


@functools.cache
def products_kernel(spec: KernelSpec):
    """Groups of products over whole planes; for GPUs."""
    _, products, _ = formulas(spec)

    @Kernel
    def multiply_planes(
        n_groups: ti.i32,
        begin: ti.i32,
        rows: ti.i32,
        pitch: ti.i32,
        to: ti.i32,
        plane: ti.i32,
        group_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_groups + 1]
        one_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_pairs]
        two_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_pairs]
        factor_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_pairs, POWERS]
        constant_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_groups]
        invalid_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_groups]
        scratch_tmp: ti.types.ndarray(dtype=spec.real, ndim=1),  # [any]
    ):
        for h in range(n_groups * rows * pitch):
            g = h // (rows * pitch)
            pixel = h - g * (rows * pitch)
            products(
                begin + g, pixel, to + g * POWERS * plane + pixel, plane,
                group_in, one_in, two_in, factor_in, constant_in, invalid_in, scratch_tmp, scratch_tmp,
            )  # fmt: skip

    return multiply_planes


@functools.cache
def window_kernel(spec: KernelSpec):
    """Windows along rows or columns of whole planes, ``dst[o, row, pitch]``; for GPUs."""
    _, _, window = formulas(spec)

    @Kernel
    def window_planes(
        n_planes: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        row_step: ti.i32,  # distance of the sources of neighbouring rows and columns
        col_step: ti.i32,
        hop: ti.i32,
        taps: ti.i32,
        pitch: ti.i32,
        to: ti.i32,  # where the first plane of ``dst`` begins
        first_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_outputs + 1]
        offset_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        table_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_windows]
        tap_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [any]
        src_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [any]
        dst_out: ti.types.ndarray(dtype=spec.real, ndim=1),  # [any]
    ):
        for g in range(n_planes * rows * cols):
            line = g // cols
            x = g - line * cols
            o = line // rows
            row = line - o * rows
            window(
                o, row * row_step + x * col_step, 1, hop, taps, to + (o * rows + row) * pitch + x, 1, 1,
                first_in, offset_in, table_in, tap_in, src_in, dst_out,
            )  # fmt: skip

    return window_planes
