"""From raw frames to structure tensors: linear passes, products of channels, moment windows.

What is filtered, multiplied and summed is data (see ``stages.moment_tables``), never code: a *linear pass* makes every
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

from leafflow_ti.kernels.engine import lane_kernel, lane_type, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec

BLOCK = 4
"""Neighbouring outputs that a CPU makes from one look at the tables; loads of windows are shared by as many."""
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


def _funcs(spec: KernelSpec):
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
        invalid: ti.i32,
        to: ti.i32,
        plane: ti.i32,
        first: ti.template(),
        one: ti.template(),
        two: ti.template(),
        weight: ti.template(),
        constant: ti.template(),
        src: ti.template(),
        dst: ti.template(),
    ):
        """``dst[p] = constant + Σ_k weight[k, p] src[one[k]] src[two[k]]``, 0 where ``src[invalid]`` is not."""
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
            seen = ti.select(src[here + invalid] > half, zero(), full)
            place = to + 2 * pair
            dst[place] = seen * s0
            dst[place + plane] = seen * s1
            dst[place + 2 * plane] = seen * s2
            if ti.static(block > 1):
                seen = ti.select(src[here + 1 + invalid] > half, zero(), full)
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

    @ti.func
    def one_row(
        begin: ti.i32,  # of the image in src
        j: ti.i32,
        first: ti.i32,
        last: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        segment: ti.i32,
        to: ti.i32,
        src: ti.template(),
        dst: ti.template(),
    ):
        for lane in range(lanes):
            at = begin + ti.min(lane * segment + j, rows - 1) * cols + first
            place = to * lanes + lane
            for x in range(last - first):
                dst[place + x * lanes] = src[at + x]

    @ti.kernel
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
        dst_out: ti.types.ndarray(dtype=spec.real, ndim=1),  # vectors [to + n_tiles * tall * images * width]
    ):
        if ti.static(spec.gpu):
            for g in range(n_images * tall * cols):
                line = g // cols
                x = g - line * cols
                j = line // n_images
                n = line - j * n_images
                one_row(
                    n * rows * cols, j, x, x + 1, rows, cols, segment, to + (j * images + n) * width + x, src_in, dst_out
                )
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    n_lines = n_images * tall
                    for line in range(task * n_lines // n_tasks, (task + 1) * n_lines // n_tasks):
                        n = line // tall
                        j = line - n * tall
                        for tile in range(n_tiles):
                            one_row(
                                n * rows * cols, j, tile * step, ti.min(tile * step + width, cols), rows, cols, segment,
                                to + ((tile * tall + j) * images + n) * width, src_in, dst_out,
                            )  # fmt: skip

    return arrange


@functools.cache
def tile_kernel(spec: KernelSpec):
    """All steps from raw frames to the maps of one frame, tile by tile of columns; for CPUs.

    ``steps`` [n_steps, Step.N]: the first ``n_raw`` read raw frames, the last one writes maps. Those before ``n_early`` run
    ``2 halo`` rows ahead of those behind it; the last one runs when the ``length`` rows of a block of maps are there.
    """
    linear, products, _ = _funcs(spec)
    V = lane_type(spec.real, spec.lanes)

    @lane_kernel(spec.lanes)
    def filter_tiles(
        n_steps: ti.i32,
        n_raw: ti.i32,
        n_early: ti.i32,
        n_tiles: ti.i32,
        n_tasks: ti.i32,
        raw_row: ti.i32,  # distance of the rows of raw frames
        n_rows: ti.i32,  # rows of maps before they are summed over blocks
        halo: ti.i32,
        oldest: ti.i32,  # slot of the oldest raw frame
        block: ti.i32,
        length: ti.i32,
        map_tile: ti.i32,  # columns of maps that a tile makes
        maps_at: ti.i32,
        scratch_size: ti.i32,
        invalid: ti.i32,  # place of the count of invalid pixels
        steps: ti.types.ndarray(dtype=ti.i32, ndim=1),
        first: ti.types.ndarray(dtype=ti.i32, ndim=1),  # of linear passes, [n_outputs + 1]
        column: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_outputs], of a row of scratch
        n_blocks: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_outputs], times BLOCK columns
        trim: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_outputs], rows that are not needed at both ends
        offset: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        ring: ti.types.ndarray(dtype=ti.i32, ndim=1),
        weight: ti.types.ndarray(dtype=spec.real, ndim=1),
        group: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_groups + 1]
        one: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_pairs]
        two: ti.types.ndarray(dtype=ti.i32, ndim=1),
        factor: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_pairs, POWERS]
        constant: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_groups]
        inner: ti.i32,  # first column of products in a row of scratch
        inner_blocks: ti.i32,
        raw: ti.types.ndarray(dtype=V, ndim=1),
        scratch: ti.types.ndarray(dtype=V, ndim=1),
        maps: ti.types.ndarray(dtype=V, ndim=1),
    ):
        for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
            if part == 0:
                home = task * scratch_size
                for t in range(task * n_tiles // n_tasks, (task + 1) * n_tiles // n_tasks):
                    for i in range(n_rows + 2 * halo):
                        last = n_steps - 1
                        raw_at = (t * (n_rows + 2 * halo) + i) * raw_row
                        for s in range(n_raw):
                            at = s * Step.N
                            place = home + steps[at + Step.TARGET]
                            place += (i % steps[at + Step.TARGET_SLOTS]) * steps[at + Step.TARGET_HOP]
                            for o in range(steps[at + Step.FIRST], steps[at + Step.LAST]):
                                if i >= trim[o] and i < n_rows + 2 * halo - trim[o]:
                                    to = place + (o - steps[at + Step.FIRST]) * steps[at + Step.TARGET_PLANE]
                                    for c in range(n_blocks[o]):
                                        x = column[o] + BLOCK * c
                                        linear(
                                            o, raw_at + x, 1, oldest, steps[at + Step.SLOTS], steps[at + Step.HOP],
                                            to + x, first, offset, ring, weight, raw, scratch,
                                        )  # fmt: skip
                        until = n_early
                        if i >= 2 * halo:
                            until = last
                        for s in range(n_raw, until):
                            at = s * Step.N
                            # Steps behind the early ones work on the row that all their rows are there for.
                            row = i
                            if s >= n_early:
                                row = i - 2 * halo
                            if steps[at + Step.PRODUCTS] == 1:
                                plane = steps[at + Step.TARGET_PLANE]
                                place = home + steps[at + Step.TARGET] + inner
                                for c in range(inner_blocks):
                                    for g in range(steps[at + Step.FIRST], steps[at + Step.LAST]):
                                        products(
                                            g, home + inner + BLOCK * c, invalid,
                                            place + (g - steps[at + Step.FIRST]) * POWERS * plane + BLOCK * c, plane,
                                            group, one, two, factor, constant, scratch, scratch,
                                        )  # fmt: skip
                            else:
                                top = row % steps[at + Step.SLOTS]
                                gap = steps[at + Step.COLUMN_STEP]
                                place = home + steps[at + Step.TARGET]
                                place += (row % steps[at + Step.TARGET_SLOTS]) * steps[at + Step.TARGET_HOP]
                                # Few columns of all outputs at a time: their sources are then in the nearest cache.
                                for c in range(steps[at + Step.BLOCKS]):
                                    for o in range(steps[at + Step.FIRST], steps[at + Step.LAST]):
                                        seen = s >= n_early or (i >= trim[o] and i < n_rows + 2 * halo - trim[o])
                                        if seen and c < n_blocks[o]:
                                            x = column[o] + BLOCK * c
                                            linear(
                                                o, home + x * gap, gap, top, steps[at + Step.SLOTS],
                                                steps[at + Step.HOP],
                                                place + (o - steps[at + Step.FIRST]) * steps[at + Step.TARGET_PLANE] + x,
                                                first, offset, ring, weight, scratch, scratch,
                                            )  # fmt: skip
                        begin = i - 2 * halo - (length - 1)
                        if begin >= 0 and begin % block == 0:
                            at = last * Step.N
                            place = maps_at + t * map_tile + begin // block * steps[at + Step.TARGET_HOP]
                            for o in range(steps[at + Step.FIRST], steps[at + Step.LAST]):
                                to = place + (o - steps[at + Step.FIRST]) * steps[at + Step.TARGET_PLANE]
                                for c in range(n_blocks[o]):
                                    x = BLOCK * c
                                    linear(
                                        o, home + x, 1, begin % steps[at + Step.SLOTS], steps[at + Step.SLOTS],
                                        steps[at + Step.HOP], to + x,
                                        first, offset, ring, weight, scratch, maps,
                                    )  # fmt: skip

    return filter_tiles


@functools.cache
def across_kernel(spec: KernelSpec):
    """Sums over the frames of the window, then windows along x; for CPUs.

    A *set* is the maps that the same wide planes are made of: ``sums[set]`` to ``sums[set + 1] - 1`` are its sums over
    frames, ``wides[set]`` to ``wides[set + 1] - 1`` its planes. ``wide`` [plane, strip, row, lanes]: strips of ``lanes``
    columns, so that the lanes of the windows along y are neighbours in x.
    """
    linear, _, window = _funcs(spec)
    V = lane_type(spec.real, spec.lanes)
    lanes = spec.lanes

    @lane_kernel(lanes)
    def across(
        n_sets: ti.i32,
        n_tasks: ti.i32,
        segment: ti.i32,  # rows of maps per lane
        rows: ti.i32,
        pitch: ti.i32,  # of maps
        cols: ti.i32,  # output columns
        step: ti.i32,  # columns of maps per output column
        taps: ti.i32,
        strips: ti.i32,
        oldest: ti.i32,
        n_slots: ti.i32,
        slot_size: ti.i32,
        source_pitch: ti.i32,
        scratch_size: ti.i32,
        sums: ti.types.ndarray(dtype=ti.i32, ndim=1),
        wides: ti.types.ndarray(dtype=ti.i32, ndim=1),
        first: ti.types.ndarray(dtype=ti.i32, ndim=1),
        offset: ti.types.ndarray(dtype=ti.i32, ndim=1),
        ring: ti.types.ndarray(dtype=ti.i32, ndim=1),
        weight: ti.types.ndarray(dtype=spec.real, ndim=1),
        wide_first: ti.types.ndarray(dtype=ti.i32, ndim=1),
        wide_offset: ti.types.ndarray(dtype=ti.i32, ndim=1),
        table: ti.types.ndarray(dtype=ti.i32, ndim=1),
        tap: ti.types.ndarray(dtype=spec.real, ndim=1),
        maps: ti.types.ndarray(dtype=V, ndim=1),
        scratch: ti.types.ndarray(dtype=V, ndim=1),
        numbers: ti.types.ndarray(dtype=spec.real, ndim=1),  # scratch once more
        wide: ti.types.ndarray(dtype=spec.real, ndim=1),
    ):
        for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
            if part == 0:
                n_items = segment * n_sets
                result = (task + 1) * scratch_size - strips * lanes
                for item in range(task * n_items // n_tasks, (task + 1) * n_items // n_tasks):
                    j = item // n_sets
                    g = item - j * n_sets
                    for s in range(sums[g], sums[g + 1]):
                        to = task * scratch_size + (s - sums[g]) * source_pitch
                        for c in range(((cols - 1) * step + taps + BLOCK - 1) // BLOCK):
                            linear(
                                s, j * pitch + BLOCK * c, 1, oldest, n_slots, slot_size, to + BLOCK * c,
                                first, offset, ring, weight, maps, scratch,
                            )  # fmt: skip
                    for w in range(wides[g], wides[g + 1]):
                        for c in range((cols + BLOCK - 1) // BLOCK):
                            window(
                                w, task * scratch_size + BLOCK * c * step, step, 1, taps, result + BLOCK * c, 1, BLOCK,
                                wide_first, wide_offset, table, tap, scratch, scratch,
                            )  # fmt: skip
                        for strip in range(strips):
                            begin = (result + strip * lanes) * lanes
                            for lane in range(lanes):
                                row = lane * segment + j
                                if row < rows:
                                    to = ((w * strips + strip) * rows + row) * lanes
                                    for x in range(lanes):
                                        wide[to + x] = numbers[begin + x * lanes + lane]

    return across


@functools.cache
def down_kernel(spec: KernelSpec):
    """Windows along y: ``wide`` [plane, strip, row, lanes] to a tensor [plane, row, pitch]; for CPUs."""
    _, _, window = _funcs(spec)
    V = lane_type(spec.real, spec.lanes)

    @lane_kernel(spec.lanes)
    def down(
        n_planes: ti.i32,
        n_tasks: ti.i32,
        rows_in: ti.i32,
        rows: ti.i32,
        step: ti.i32,
        taps: ti.i32,
        strips: ti.i32,
        pitch: ti.i32,  # of the tensor, in vectors
        first: ti.types.ndarray(dtype=ti.i32, ndim=1),
        offset: ti.types.ndarray(dtype=ti.i32, ndim=1),
        table: ti.types.ndarray(dtype=ti.i32, ndim=1),
        tap: ti.types.ndarray(dtype=spec.real, ndim=1),
        wide: ti.types.ndarray(dtype=V, ndim=1),
        tensor: ti.types.ndarray(dtype=V, ndim=1),
    ):
        for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
            if part == 0:
                n_items = n_planes * strips
                for item in range(task * n_items // n_tasks, (task + 1) * n_items // n_tasks):
                    o = item // strips
                    strip = item - o * strips
                    for c in range((rows + BLOCK - 1) // BLOCK):
                        row = BLOCK * c
                        window(
                            o, strip * rows_in + row * step, step, 1, taps, (o * rows + row) * pitch + strip, pitch,
                            rows - row, first, offset, table, tap, wide, tensor,
                        )  # fmt: skip

    return down


@functools.cache
def linear_kernel(spec: KernelSpec):
    """One linear pass over whole planes, ``dst[to + o plane + row pitch + x]``; for GPUs."""
    linear, _, _ = _funcs(spec)

    @ti.kernel
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
        first: ti.types.ndarray(dtype=ti.i32, ndim=1),
        offset: ti.types.ndarray(dtype=ti.i32, ndim=1),
        ring: ti.types.ndarray(dtype=ti.i32, ndim=1),
        weight: ti.types.ndarray(dtype=spec.real, ndim=1),
        src: ti.types.ndarray(dtype=spec.real, ndim=1),
        dst: ti.types.ndarray(dtype=spec.real, ndim=1),
    ):
        for g in range(n_planes * rows * cols):
            line = g // cols
            x = g - line * cols
            o = line // rows
            row = line - o * rows
            linear(
                begin + o, at + row * at_row + x * col_step, 1, oldest + turn * row * row_step, slots, hop,
                to + o * plane + row * pitch + x, first, offset, ring, weight, src, dst,
            )  # fmt: skip

    return linear_planes


@functools.cache
def products_kernel(spec: KernelSpec):
    """Groups of products over whole planes; for GPUs."""
    _, products, _ = _funcs(spec)

    @ti.kernel
    def multiply_planes(
        n_groups: ti.i32,
        begin: ti.i32,
        rows: ti.i32,
        pitch: ti.i32,
        invalid: ti.i32,
        to: ti.i32,
        plane: ti.i32,
        group: ti.types.ndarray(dtype=ti.i32, ndim=1),
        one: ti.types.ndarray(dtype=ti.i32, ndim=1),
        two: ti.types.ndarray(dtype=ti.i32, ndim=1),
        factor: ti.types.ndarray(dtype=spec.real, ndim=1),
        constant: ti.types.ndarray(dtype=spec.real, ndim=1),
        scratch: ti.types.ndarray(dtype=spec.real, ndim=1),
    ):
        for h in range(n_groups * rows * pitch):
            g = h // (rows * pitch)
            pixel = h - g * (rows * pitch)
            products(
                begin + g, pixel, invalid, to + g * POWERS * plane + pixel, plane,
                group, one, two, factor, constant, scratch, scratch,
            )  # fmt: skip

    return multiply_planes


@functools.cache
def window_kernel(spec: KernelSpec):
    """Windows along rows or columns of whole planes, ``dst[o, row, pitch]``; for GPUs."""
    _, _, window = _funcs(spec)

    @ti.kernel
    def window_planes(
        n_planes: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        row_step: ti.i32,  # distance of the sources of neighbouring rows and columns
        col_step: ti.i32,
        hop: ti.i32,
        taps: ti.i32,
        pitch: ti.i32,
        first: ti.types.ndarray(dtype=ti.i32, ndim=1),
        offset: ti.types.ndarray(dtype=ti.i32, ndim=1),
        table: ti.types.ndarray(dtype=ti.i32, ndim=1),
        tap: ti.types.ndarray(dtype=spec.real, ndim=1),
        src: ti.types.ndarray(dtype=spec.real, ndim=1),
        dst: ti.types.ndarray(dtype=spec.real, ndim=1),
    ):
        for g in range(n_planes * rows * cols):
            line = g // cols
            x = g - line * cols
            o = line // rows
            row = line - o * rows
            window(
                o, row * row_step + x * col_step, 1, hop, taps, (o * rows + row) * pitch + x, 1, 1,
                first, offset, table, tap, src, dst,
            )  # fmt: skip

    return window_planes
