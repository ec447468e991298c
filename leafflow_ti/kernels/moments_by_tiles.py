"""Filters, products and windows, tile by tile of columns: see ``kernels.moments`` for the formulas; for CPUs.

A task does all steps for one row of a tile before it turns to the next one: what lies between the steps stays in its
scratch, and that in the cache.
"""

import functools

from leafflow_ti.kernels.engine import lane_kernel, lane_type, ti
from leafflow_ti.kernels.moments import BLOCK, POWERS, Step, formulas
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec


@functools.cache
def tile_kernel(spec: KernelSpec):
    """All steps from raw frames to the maps of one frame, tile by tile of columns; for CPUs.

    ``steps`` [n_steps, Step.N]: the first ``n_raw`` read raw frames, the last one writes maps. Those before ``n_early``
    run ``2 halo`` rows ahead of the others; the last one runs when the ``length`` rows of a block of maps are there.
    """
    linear, products, _ = formulas(spec)
    V = lane_type(spec.real, spec.lanes)

    @ti.func
    def linear_step(
        at: ti.i32,  # of the step in ``steps``
        early: ti.i32,  # rows before this one and behind it that are worked on; less than 0: all outputs are wanted
        late: ti.i32,
        stretch: ti.i32,  # blocks of one output that are made before those of the next
        source: ti.i32,
        top: ti.i32,
        target: ti.i32,
        steps: ti.template(),
        first: ti.template(),
        column: ti.template(),
        n_blocks: ti.template(),
        trim: ti.template(),
        offset: ti.template(),
        ring: ti.template(),
        weight: ti.template(),
        src: ti.template(),
        dst: ti.template(),
    ):
        gap = steps[at + Step.COLUMN_STEP]
        for part in range((steps[at + Step.BLOCKS] + stretch - 1) // stretch):
            for o in range(steps[at + Step.FIRST], steps[at + Step.LAST]):
                if early < 0 or (early >= trim[o] and late >= trim[o]):
                    to = target + (o - steps[at + Step.FIRST]) * steps[at + Step.TARGET_PLANE]
                    for c in range(part * stretch, ti.min((part + 1) * stretch, n_blocks[o])):
                        x = column[o] + BLOCK * c
                        linear(
                            o, source + x * gap, gap, top, steps[at + Step.SLOTS], steps[at + Step.HOP], to + x,
                            first, offset, ring, weight, src, dst,
                        )  # fmt: skip

    @ti.func
    def product_step(
        at: ti.i32,
        home: ti.i32,
        inner: ti.i32,
        inner_blocks: ti.i32,
        steps: ti.template(),
        group: ti.template(),
        one: ti.template(),
        two: ti.template(),
        factor: ti.template(),
        constant: ti.template(),
        invalid: ti.template(),
        scratch: ti.template(),
    ):
        plane = steps[at + Step.TARGET_PLANE]
        for c in range(inner_blocks):
            x = inner + BLOCK * c
            for g in range(steps[at + Step.FIRST], steps[at + Step.LAST]):
                to = home + steps[at + Step.TARGET] + (g - steps[at + Step.FIRST]) * POWERS * plane + x
                products(g, home + x, to, plane, group, one, two, factor, constant, invalid, scratch, scratch)

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
        inner: ti.i32,  # first column of products in a row of scratch
        inner_blocks: ti.i32,
        steps_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_steps, Step.N]
        first_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_outputs + 1]
        column_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_outputs], of a row of scratch
        n_blocks_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_outputs], times BLOCK columns
        trim_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_outputs], rows that are not needed at both ends
        offset_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        ring_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        weight_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_terms]
        group_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_groups + 1]
        one_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_pairs]
        two_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_pairs]
        factor_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_pairs, POWERS]
        constant_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_groups]
        invalid_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_groups], where invalid pixels are counted
        raw_in: ti.types.ndarray(dtype=V, ndim=1),  # [frames, tiles, rows, images, columns]
        scratch_tmp: ti.types.ndarray(dtype=V, ndim=1),  # [any]
        maps_out: ti.types.ndarray(dtype=V, ndim=1),  # [frames, maps, segment, pitch]
    ):
        for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
            if part == 0:
                home = task * scratch_size
                last = (n_steps - 1) * Step.N
                tall = n_rows + 2 * halo
                for t in range(task * n_tiles // n_tasks, (task + 1) * n_tiles // n_tasks):
                    for i in range(tall):
                        for s in range(n_raw):
                            at = s * Step.N
                            to = home + steps_in[at + Step.TARGET]
                            to += (i % steps_in[at + Step.TARGET_SLOTS]) * steps_in[at + Step.TARGET_HOP]
                            # Raw frames come from far away, in long stretches; scratch from a near cache, where a few
                            # columns of all sources stay in the nearest one while all outputs are made of them.
                            linear_step(
                                at, i, tall - 1 - i, steps_in[at + Step.BLOCKS], (t * tall + i) * raw_row, oldest, to,
                                steps_in, first_in, column_in, n_blocks_in, trim_in, offset_in, ring_in, weight_in,
                                raw_in, scratch_tmp,
                            )  # fmt: skip
                        until = n_early
                        if i >= 2 * halo:
                            until = n_steps - 1
                        for s in range(n_raw, until):
                            at = s * Step.N
                            # Steps behind the early ones work on the row that all they look at is there for.
                            row, early = i, i
                            if s >= n_early:
                                row, early = i - 2 * halo, -1
                            if steps_in[at + Step.PRODUCTS] == 1:
                                product_step(
                                    at, home, inner, inner_blocks, steps_in,
                                    group_in, one_in, two_in, factor_in, constant_in, invalid_in, scratch_tmp,
                                )  # fmt: skip
                            else:
                                to = home + steps_in[at + Step.TARGET]
                                to += (row % steps_in[at + Step.TARGET_SLOTS]) * steps_in[at + Step.TARGET_HOP]
                                linear_step(
                                    at, early, tall - 1 - i, 1, home, row % steps_in[at + Step.SLOTS], to,
                                    steps_in, first_in, column_in, n_blocks_in, trim_in, offset_in, ring_in, weight_in,
                                    scratch_tmp, scratch_tmp,
                                )  # fmt: skip
                        begin = i - 2 * halo - (length - 1)
                        if begin >= 0 and begin % block == 0:
                            to = maps_at + t * map_tile + begin // block * steps_in[last + Step.TARGET_HOP]
                            linear_step(
                                last, -1, 0, 1, home, begin % steps_in[last + Step.SLOTS], to,
                                steps_in, first_in, column_in, n_blocks_in, trim_in, offset_in, ring_in, weight_in,
                                scratch_tmp, maps_out,
                            )  # fmt: skip

    return filter_tiles


@functools.cache
def across_kernel(spec: KernelSpec):
    """Sums over the frames of the window, then windows along x; for CPUs.

    A *set* is the maps that the same wide planes are made of: ``sums[set]`` to ``sums[set + 1] - 1`` are its sums over
    frames, ``wides[set]`` to ``wides[set + 1] - 1`` its planes. ``wide`` [plane, strip, row, lanes]: strips of
    ``lanes`` columns, so that the lanes of the windows along y are neighbours in x.
    """
    linear, _, window = formulas(spec)
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
        sums_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_sets + 1]
        wides_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_sets + 1]
        first_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_outputs + 1]
        offset_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        ring_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        weight_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_terms]
        wide_first_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_wides + 1]
        wide_offset_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_windows]
        table_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_windows]
        tap_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [any]
        maps_in: ti.types.ndarray(dtype=V, ndim=1),  # [frames, maps, segment, pitch]
        scratch_tmp: ti.types.ndarray(dtype=V, ndim=1),  # [any]
        numbers_tmp: ti.types.ndarray(dtype=spec.real, ndim=1),  # [any], scratch once more
        wide_out: ti.types.ndarray(dtype=spec.real, ndim=1),  # [n_wides, strips, rows, lanes]
    ):
        for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
            if part == 0:
                n_items = segment * n_sets
                result = (task + 1) * scratch_size - strips * lanes
                for item in range(task * n_items // n_tasks, (task + 1) * n_items // n_tasks):
                    j = item // n_sets
                    g = item - j * n_sets
                    for s in range(sums_in[g], sums_in[g + 1]):
                        to = task * scratch_size + (s - sums_in[g]) * source_pitch
                        for c in range(((cols - 1) * step + taps + BLOCK - 1) // BLOCK):
                            linear(
                                s, j * pitch + BLOCK * c, 1, oldest, n_slots, slot_size, to + BLOCK * c,
                                first_in, offset_in, ring_in, weight_in, maps_in, scratch_tmp,
                            )  # fmt: skip
                    for w in range(wides_in[g], wides_in[g + 1]):
                        for c in range((cols + BLOCK - 1) // BLOCK):
                            window(
                                w, task * scratch_size + BLOCK * c * step, step, 1, taps, result + BLOCK * c, 1, BLOCK,
                                wide_first_in, wide_offset_in, table_in, tap_in, scratch_tmp, scratch_tmp,
                            )  # fmt: skip
                        for strip in range(strips):
                            begin = (result + strip * lanes) * lanes
                            for lane in range(lanes):
                                row = lane * segment + j
                                if row < rows:
                                    to = ((w * strips + strip) * rows + row) * lanes
                                    for x in range(lanes):
                                        wide_out[to + x] = numbers_tmp[begin + x * lanes + lane]

    return across


@functools.cache
def down_kernel(spec: KernelSpec):
    """Windows along y: ``wide`` [plane, strip, row, lanes] to a tensor [plane, row, pitch]; for CPUs."""
    _, _, window = formulas(spec)
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
        first_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_outputs + 1]
        offset_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_terms]
        table_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_windows]
        tap_in: ti.types.ndarray(dtype=spec.real, ndim=1),  # [any]
        wide_in: ti.types.ndarray(dtype=V, ndim=1),  # [n_wides, strips, rows, lanes]
        tensor_out: ti.types.ndarray(dtype=V, ndim=1),  # [n_planes, rows, pitch]
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
                            rows - row, first_in, offset_in, table_in, tap_in, wide_in, tensor_out,
                        )  # fmt: skip

    return down
