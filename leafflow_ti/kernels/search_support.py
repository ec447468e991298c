"""Costs of labels over the *support* of a pixel: the pixels around, weighted by how much they look like it.

What is occluded on one side is mostly seen from the other: the better half of the arms decides, and it decides for the
support as a whole. Labels lie in the lanes. See ``kernels.search`` for labels, tiles and arms.
"""

import functools

from leafflow_ti.kernels.engine import lane_kernel, lane_type, ti
from leafflow_ti.kernels.search import NEAR
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec


@functools.cache
def support_kernel(spec: KernelSpec):
    """``cost[pixel, slot]``: over the pixel's support the mean cost, of the better half of the arms; 0 without mask."""
    real, lanes = spec.real, spec.lanes
    vector = lane_type(real, lanes)

    @ti.func
    def gather(
        pixel: ti.i32, task: ti.i32, rows: ti.i32, cols: ti.i32, radius: ti.i32, tile: ti.i32, scale: real,
        guide: ti.template(), mask: ti.template(), place: ti.template(), weight: ti.template(),
    ):  # fmt: skip
        """Pixels of the support with their weights; how many, and the sum of the weights."""
        y = pixel // cols
        x = pixel - y * cols
        row, col = y // tile, x // tile
        most = (2 * radius + 1) * (2 * radius + 1)
        n = 0
        mass = ti.cast(0.0, real)
        for j in range(ti.max(y - radius, 0), ti.min(y + radius + 1, rows)):
            for i in range(ti.max(x - radius, 0), ti.min(x + radius + 1, cols)):
                if mask[j * cols + i] > 0:
                    w = ti.exp(-ti.abs(guide[j * cols + i] - guide[pixel]) / scale)
                    place[(task * most + n) * 2] = j * cols + i
                    place[(task * most + n) * 2 + 1] = 4 + 3 * (j // tile - row) + i // tile - col
                    weight[task * most + n] = w
                    mass += w
                    n += 1
        return n, mass

    @ti.func
    def support(
        pixel: ti.i32, task: ti.i32, rows: ti.i32, cols: ti.i32, n_arms: ti.i32, radius: ti.i32, tile: ti.i32,
        tiles_x: ti.i32, slots: ti.i32, scale: real, near: ti.template(), guide: ti.template(), mask: ti.template(),
        arm_cost: ti.template(), arm_vector: ti.template(), place: ti.template(), weight: ti.template(),
        cost: ti.template(),
    ):  # fmt: skip
        n, mass = gather(pixel, task, rows, cols, radius, tile, scale, guide, mask, place, weight)
        y = pixel // cols
        here = (y // tile) * tiles_x + (pixel - y * cols) // tile
        begin = task * (2 * radius + 1) * (2 * radius + 1)
        groups = slots // lanes
        zero = arm_vector[0] * ti.cast(0.0, real)
        for g in range(groups):
            best, second = zero + ti.cast(1e30, real), zero + ti.cast(1e30, real)
            for a in range(n_arms):
                total, found = zero, zero + mass
                for m in range(begin, begin + n):
                    at, relation, w = a * rows * cols + place[2 * m], place[2 * m + 1], weight[m]
                    if relation == 4:
                        total = total + w * arm_vector[at * groups + g]
                    else:
                        for i in ti.static(range(lanes)):
                            slot = near[((here * NEAR + relation) * slots + g * lanes + i) * NEAR]
                            value, share = ti.cast(0.0, real), ti.cast(0.0, real)
                            if slot >= 0:
                                value, share = w * arm_cost[at * slots + slot], w
                            if ti.static(lanes == 1):
                                total = total + value
                                found = found + share - w
                            else:
                                total[i] = total[i] + value
                                found[i] = found[i] + share - w
                mean = total / ti.max(found, zero + ti.cast(1e-6, real))
                second = ti.min(second, ti.max(mean, best))
                best = ti.min(best, mean)
            if n_arms > 2:
                best = (best + second) * ti.cast(0.5, real)
            if mask[pixel] == 0:
                best = zero
            cost[pixel * groups + g] = best

    @lane_kernel(lanes)
    def support_costs(
        rows: ti.i32,
        cols: ti.i32,
        n_arms: ti.i32,
        radius: ti.i32,
        tile: ti.i32,
        tiles_x: ti.i32,
        slots: ti.i32,  # a multiple of the lanes
        scale: real,
        n_tasks: ti.i32,
        near_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [tiles, NEAR, slots, NEAR]
        guide_in: ti.types.ndarray(dtype=real, ndim=1),  # [rows, cols]
        mask_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [rows, cols]
        arm_cost_in: ti.types.ndarray(dtype=real, ndim=1),  # [n_arms, rows, cols, slots]
        arm_vector_in: ti.types.ndarray(dtype=vector, ndim=1),  # [n_arms, rows, cols, slots / lanes], the same
        place_tmp: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [tasks, (2 radius + 1)², 2], tasks = pixels on a GPU
        weight_tmp: ti.types.ndarray(dtype=real, ndim=1),  # [tasks, (2 radius + 1)²]
        cost_out: ti.types.ndarray(dtype=vector, ndim=1),  # [rows, cols, slots / lanes]
    ):
        size = rows * cols
        if ti.static(spec.gpu):
            for p in range(size):
                support(
                    p, p, rows, cols, n_arms, radius, tile, tiles_x, slots, scale, near_in, guide_in, mask_in,
                    arm_cost_in, arm_vector_in, place_tmp, weight_tmp, cost_out,
                )  # fmt: skip
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for p in range(task * size // n_tasks, (task + 1) * size // n_tasks):
                        support(
                            p, task, rows, cols, n_arms, radius, tile, tiles_x, slots, scale, near_in, guide_in,
                            mask_in, arm_cost_in, arm_vector_in, place_tmp, weight_tmp, cost_out,
                        )  # fmt: skip

    return support_costs
