"""From raw frames to structure tensors: linear passes, products of channels, moment windows.

What is filtered, multiplied and summed is data (see ``stages.tensor_tables``), never code: a *linear pass* makes every
output plane as a weighted sum of shifted source planes, whichever axis the shift is along; *products* are sums of
products of two planes with three weights each, for three powers of an offset. One compilation serves every model.

On the CPU a vector holds ``lanes`` pixels of one column, the same distance apart: lane l of vector row j is row
``l * segment + j``. A shift along either image axis is then a shift by whole vectors, and nothing has to be
rearranged but the raw frames, once, and the planes between the windows along x and those along y. A task works on a
tile of columns, row by row, through all passes: what lies between them stays in its scratch and in the cache. On a GPU
there is one lane, a segment is the whole image, every pass is a launch over whole planes, and neighbouring threads are
neighbouring columns.
"""

import functools
from enum import IntEnum, auto

from leafflow_ti.kernels.engine import Kernel, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec

BLOCK = 4
"""Neighbouring outputs that a CPU makes from one look at the tables; loads of windows are shared by as many."""
TILES = 4
"""Neighbouring tiles that raw rows are handed out to at a time."""
POWERS = 3
"""Weights of a term of products, hence sums that a group of products makes."""


class Step(IntEnum):
    """Fields of one row of the table of steps; places and distances count vectors of scratch."""

    PRODUCTS = 0  # 1: products, 0: a linear pass
    FIRST = auto()  # outputs (or groups of products) FIRST to LAST - 1
    LAST = auto()
    SLOTS = auto()  # rows that the source keeps: row r lies in slot r modulo SLOTS
    HOP = auto()  # distance of the source's slots
    COLUMN_STEP = auto()  # source columns per output column
    TARGET = auto()  # place of the first output
    TARGET_PLANE = auto()  # distance of the outputs
    TARGET_SLOTS = auto()
    TARGET_HOP = auto()
    BLOCKS = auto()  # times BLOCK columns: of the widest output
    N = auto()


def formulas(spec: KernelSpec):
    """The formulas, for vectors or for single numbers."""
    block = 1 if spec.gpu else BLOCK

    if spec.lanes > 1:

        @ti.func
        def zero():
            return ti.Vector.zero(spec.real, spec.lanes)
    else:

        @ti.func
        def zero():
            return ti.cast(0, spec.real)

    @ti.func
    def linear(
        o: ti.i32,
        at: ti.i32,
        gap: ti.i32,
        top: ti.i32,
        slots: ti.i32,
        hop: ti.i32,
        to: ti.i32,
        first: ti.template(),
        offset: ti.template(),
        ring: ti.template(),
        weight: ti.template(),
        src: ti.template(),
        dst: ti.template(),
    ):
        """``dst[to + i] = Σ_k weight[k] src[at + i gap + offset[k] + slot hop]``, slot ``top + ring[k]`` of a ring."""
        t0, t1, t2, t3 = zero(), zero(), zero(), zero()
        for k in range(first[o], first[o + 1]):
            slot = top + ring[k]
            if slot >= slots:
                slot -= slots
            x = at + offset[k] + slot * hop
            w = weight[k]
            t0 += w * src[x]
            if ti.static(block > 1):
                t1 += w * src[x + gap]
                t2 += w * src[x + 2 * gap]
                t3 += w * src[x + 3 * gap]
        dst[to] = t0
        if ti.static(block > 1):
            dst[to + 1] = t1
            dst[to + 2] = t2
            dst[to + 3] = t3

    @ti.func
    def products(
        g: ti.i32,
        at: ti.i32,
        to: ti.i32,
        plane: ti.i32,
        first: ti.template(),
        one: ti.template(),
        two: ti.template(),
        weight: ti.template(),
        constant: ti.template(),
        invalid: ti.template(),
        src: ti.template(),
        dst: ti.template(),
    ):
        """``dst[p] = constant + Σ_k weight[k, p] src[one[k]] src[two[k]]``, 0 where ``src[invalid[g]]`` is not."""
        half = ti.cast(0.5, spec.real)
        full = zero() + ti.cast(1, spec.real)
        for pair in range(1 if ti.static(block == 1) else block // 2):
            here = at + 2 * pair
            s0, s1, s2, u0, u1, u2 = zero(), zero(), zero(), zero(), zero(), zero()
            s0 += constant[g]
            u0 += constant[g]
            for k in range(first[g], first[g + 1]):
                a, b = here + one[k], here + two[k]
                w0, w1, w2 = weight[POWERS * k], weight[POWERS * k + 1], weight[POWERS * k + 2]
                p = src[a] * src[b]
                s0 += w0 * p
                s1 += w1 * p
                s2 += w2 * p
                if ti.static(block > 1):
                    q = src[a + 1] * src[b + 1]
                    u0 += w0 * q
                    u1 += w1 * q
                    u2 += w2 * q
            seen = ti.select(src[here + invalid[g]] > half, zero(), full)
            place = to + 2 * pair
            dst[place] = seen * s0
            dst[place + plane] = seen * s1
            dst[place + 2 * plane] = seen * s2
            if ti.static(block > 1):
                seen = ti.select(src[here + 1 + invalid[g]] > half, zero(), full)
                dst[place + 1] = seen * u0
                dst[place + 1 + plane] = seen * u1
                dst[place + 1 + 2 * plane] = seen * u2

    @ti.func
    def window(
        o: ti.i32,
        at: ti.i32,
        step: ti.i32,
        hop: ti.i32,
        taps: ti.i32,
        to: ti.i32,
        put: ti.i32,
        room: ti.i32,
        first: ti.template(),
        offset: ti.template(),
        table: ti.template(),
        weight: ti.template(),
        src: ti.template(),
        dst: ti.template(),
    ):
        """``dst[to + i put] = Σ_k Σ_r weight[table[k] + r] src[offset[k] + at + (i step + r) hop]``, i below ``room``.

        Behind and before the ``taps`` weights of a table stand ``(BLOCK - 1) step`` zeros.
        """
        t0, t1, t2, t3 = zero(), zero(), zero(), zero()
        for k in range(first[o], first[o + 1]):
            x = at + offset[k]
            w = table[k]
            for r in range(taps + (block - 1) * step):
                v = src[x + r * hop]
                t0 += weight[w + r] * v
                if ti.static(block > 1):
                    t1 += weight[w + r - step] * v
                    t2 += weight[w + r - 2 * step] * v
                    t3 += weight[w + r - 3 * step] * v
        dst[to] = t0
        if ti.static(block > 1):
            if room > 1:
                dst[to + put] = t1
            if room > 2:
                dst[to + 2 * put] = t2
            if room > 3:
                dst[to + 3 * put] = t3

    return linear, products, window


@functools.cache
def arrange_kernel(spec: KernelSpec):
    """Images [n, rows, cols] into vectors [tile, j, image, x], lane l being row ``l * segment + j``.

    A tile's columns x begin at ``tile * step``: neighbouring tiles overlap. So a tile reads one stretch of memory per
    frame. Rows beyond the last one repeat it; columns beyond the last one are left as they are.
    """
    lanes = spec.lanes

    @Kernel
    def arrange(
        n_images: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        segment: ti.i32,
        tall: ti.i32,
        n_tiles: ti.i32,
        step: ti.i32,
        width: ti.i32,
        images: ti.i32,  # of a row of a tile
        to: ti.i32,
        n_tasks: ti.i32,
        src_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_images * rows * cols]
        dst_out: ti.types.ndarray(dtype=spec.real, ndim=1),  # [to + n_tiles * tall * images * width, lanes]
    ):
        if ti.static(spec.gpu):
            for g in range(n_images * rows * cols):
                line = g // cols
                n = line // rows
                row = line - n * rows
                if row < tall:
                    dst_out[to + (row * images + n) * width + g - line * cols] = src_in[g]
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    n_lines = n_images * tall
                    for line in range(task * n_lines // n_tasks, (task + 1) * n_lines // n_tasks):
                        n = line // tall
                        j = line - n * tall
                        # Some tiles at a time: vectors are in the cache while their lanes are written one by one.
                        for some in range((n_tiles + TILES - 1) // TILES):
                            for lane in range(lanes):
                                begin = (n * rows + ti.min(lane * segment + j, rows - 1)) * cols
                                for tile in range(some * TILES, ti.min((some + 1) * TILES, n_tiles)):
                                    at = begin + tile * step
                                    place = (to + ((tile * tall + j) * images + n) * width) * lanes + lane
                                    for x in range(ti.min(width, cols - tile * step)):
                                        dst_out[place + x * lanes] = src_in[at + x]

    return arrange
