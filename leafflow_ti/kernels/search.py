"""Displacements from a list of candidates: costs per pixel and candidate, and their semi-global aggregation.

*Labels* are candidate displacements ``(x, y)``; every square *tile* of the image has its own list of at most ``slots``
of them. *Views* are images that see a label as the displacement ``(x fx, y fy)``, each with its factors ``f``; views
on one side of the reference form an *arm*. The cost of a label in an arm is the mean over its views of the truncated
difference of features; ``search_support`` takes the better arms' mean over the pixels around that look alike.

The aggregation is that of Hirschmüller (semi-global matching, 2008): along straight paths the least sum of costs, and
of penalties ``p1`` between neighbouring labels and ``p2`` between any others; lower where the image has an edge.
"""

import functools

from leafflow_ti.kernels.engine import Kernel, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec

NEAR = 9
"""A label itself, the labels one step before and behind it along x, then along y, and those across."""


@functools.cache
def _formulas(spec: KernelSpec):
    """Functions of one pixel: ``costs`` and ``winner``; of one path: ``path``."""
    real = spec.real

    @ti.func
    def difference(
        pixel: ti.i32, view: ti.i32, sx: real, sy: real, rows: ti.i32, cols: ti.i32, channels: ti.i32, most: real,
        feature: ti.template(),
    ):  # fmt: skip
        """Truncated difference of the reference at ``pixel`` from a view at (sx, sy), mean over channels."""
        x0 = ti.min(ti.cast(ti.floor(sx), ti.i32), cols - 2)
        y0 = ti.min(ti.cast(ti.floor(sy), ti.i32), rows - 2)
        wx, wy = sx - ti.cast(x0, real), sy - ti.cast(y0, real)
        plane = rows * cols
        total = ti.cast(0.0, real)
        for c in range(channels):
            at = ((view + 1) * channels + c) * plane + y0 * cols + x0
            upper = feature[at] + wx * (feature[at + 1] - feature[at])
            value = upper
            if wy > 0.0:
                lower = feature[at + cols] + wx * (feature[at + cols + 1] - feature[at + cols])
                value = upper + wy * (lower - upper)
            total += ti.min(ti.abs(value - feature[c * plane + pixel]), most)
        return total / ti.cast(channels, real)

    @ti.func
    def costs(
        pixel: ti.i32, rows: ti.i32, cols: ti.i32, channels: ti.i32, n_arms: ti.i32, tile: ti.i32, tiles_x: ti.i32,
        slots: ti.i32, most: real, count: ti.template(), label: ti.template(), arm: ti.template(),
        factor: ti.template(), feature: ti.template(), cost: ti.template(),
    ):  # fmt: skip
        """Costs of the labels in every arm; ``most`` where no view of the arm shows the place, and without label."""
        y = pixel // cols
        x = pixel - y * cols
        here = (y // tile) * tiles_x + x // tile
        for a in range(n_arms):
            for k in range(count[here]):
                lx, ly = label[(here * slots + k) * 2], label[(here * slots + k) * 2 + 1]
                total = ti.cast(0.0, real)
                seen = ti.cast(0.0, real)
                for v in range(arm[a], arm[a + 1]):
                    sx = ti.cast(x, real) + lx * factor[2 * v]
                    sy = ti.cast(y, real) + ly * factor[2 * v + 1]
                    if sx >= 0.0 and sx <= ti.cast(cols - 1, real) and sy >= 0.0 and sy <= ti.cast(rows - 1, real):
                        total += difference(pixel, v, sx, sy, rows, cols, channels, most, feature)
                        seen += 1.0
                cost[(a * rows * cols + pixel) * slots + k] = ti.select(seen > 0.0, total / ti.max(seen, 1.0), most)
            for k in range(count[here], slots):
                cost[(a * rows * cols + pixel) * slots + k] = most

    @ti.func
    def start_of(line: ti.i32, rows: ti.i32, cols: ti.i32, step_y: ti.i32, step_x: ti.i32):
        """First pixel (y, x) of a path: on the image's side where paths of this direction enter."""
        first_y, first_x = ti.select(step_y < 0, rows - 1, 0), ti.select(step_x < 0, cols - 1, 0)
        y, x = first_y, first_x
        if step_y == 0 or (step_x != 0 and line >= cols):
            rest = line - ti.select(step_y == 0, 0, cols - 1)
            y = ti.select(first_y == 0, rest, rows - 1 - rest)
        else:
            x = line
        return y, x

    @ti.func
    def path(
        line: ti.i32, rows: ti.i32, cols: ti.i32, step_y: ti.i32, step_x: ti.i32, tile: ti.i32, tiles_x: ti.i32,
        slots: ti.i32, ordered: ti.i32, p1: real, p2: real, scale: real, count: ti.template(), near: ti.template(),
        guide: ti.template(), cost: ti.template(), behind: ti.template(), total: ti.template(),
    ):  # fmt: skip
        """Follow one path through the image; ``total`` grows by its sums of costs."""
        y, x = start_of(line, rows, cols, step_y, step_x)
        now, before = 2 * line * slots, (2 * line + 1) * slots
        least = ti.cast(0.0, real)
        tile_before = -1
        grey_before = ti.cast(0.0, real)
        while y >= 0 and y < rows and x >= 0 and x < cols:
            pixel = y * cols + x
            row, col = y // tile, x // tile
            here = row * tiles_x + col
            grey = guide[pixel]
            jump = ti.max(p2 / (ti.cast(1.0, real) + ti.abs(grey - grey_before) / scale), p1)
            shift = ti.cast(1e30, real)
            if tile_before < 0:
                for k in range(count[here]):
                    value = cost[pixel * slots + k]
                    behind[now + k] = value
                    total[pixel * slots + k] = total[pixel * slots + k] + value  # += would be atomic
                    shift = ti.min(shift, value)
            else:
                relation = (
                    4 + 3 * (tile_before // tiles_x - row) + tile_before - (tile_before // tiles_x) * tiles_x - col
                )
                for k in range(count[here]):
                    best = least + jump
                    if ordered > 0:
                        best = ti.min(best, behind[before + k])
                        best = ti.min(best, behind[before + ti.max(k - 1, 0)] + p1)
                        best = ti.min(best, behind[before + ti.min(k + 1, count[here] - 1)] + p1)
                    else:
                        table = ((here * NEAR + relation) * slots + k) * NEAR
                        own = near[table]
                        if own >= 0:
                            best = ti.min(best, behind[before + own])
                        for n in range(1, NEAR):
                            other = near[table + n]
                            if other >= 0:
                                best = ti.min(best, behind[before + other] + p1)
                    value = cost[pixel * slots + k] + best - least
                    behind[now + k] = value
                    total[pixel * slots + k] = total[pixel * slots + k] + value  # += would be atomic
                    shift = ti.min(shift, value)
            least, tile_before, grey_before = shift, here, grey
            now, before = before, now
            y, x = y + step_y, x + step_x

    @ti.func
    def winner(
        pixel: ti.i32, rows: ti.i32, cols: ti.i32, tile: ti.i32, tiles_x: ti.i32, slots: ti.i32, ordered: ti.i32,
        count: ti.template(), label: ti.template(), near: ti.template(), cost: ti.template(), total: ti.template(),
        chosen: ti.template(), found: ti.template(), price: ti.template(),
    ):  # fmt: skip
        """The label of least total cost; per axis the vertex of the parabola through it and the labels beside it."""
        y = pixel // cols
        here = (y // tile) * tiles_x + (pixel - y * cols) // tile
        best = 0
        for k in range(1, count[here]):
            if total[pixel * slots + k] < total[pixel * slots + best]:
                best = k
        chosen[pixel] = best
        price[pixel] = cost[pixel * slots + best]
        at = here * slots
        middle = total[pixel * slots + best]
        for axis in range(2):
            value = label[(at + best) * 2 + axis]
            one, two = best - 1, ti.select(best + 1 < count[here], best + 1, -1)
            if ordered == 0:
                table = ((here * NEAR + 4) * slots + best) * NEAR + 1 + 2 * axis
                one, two = near[table], near[table + 1]
            if one >= 0 and two >= 0:
                low, high = total[pixel * slots + one], total[pixel * slots + two]
                bend = low - ti.cast(2.0, real) * middle + high
                if bend > 0.0:
                    off = ti.min(ti.max((low - high) / (ti.cast(2.0, real) * bend), -0.5), 0.5)
                    value += off * (label[(at + two) * 2 + axis] - label[(at + one) * 2 + axis]) / ti.cast(2.0, real)
            found[axis * rows * cols + pixel] = value

    return costs, path, winner


@functools.cache
def costs_kernel(spec: KernelSpec):
    """Costs in every arm of every label of the pixel's tile."""
    costs, _, _ = _formulas(spec)
    real = spec.real

    @Kernel
    def arm_costs(
        rows: ti.i32,
        cols: ti.i32,
        channels: ti.i32,
        n_arms: ti.i32,
        tile: ti.i32,
        tiles_x: ti.i32,
        slots: ti.i32,
        most: real,
        n_tasks: ti.i32,
        count_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [tiles]
        label_in: ti.types.ndarray(dtype=real, ndim=1),  # [tiles, slots, 2]
        arm_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_arms + 1]
        factor_in: ti.types.ndarray(dtype=real, ndim=1),  # [views, 2]
        feature_in: ti.types.ndarray(dtype=real, ndim=1),  # [1 + views, channels, rows, cols]
        arm_cost_out: ti.types.ndarray(dtype=real, ndim=1),  # [n_arms, rows, cols, slots]
    ):
        size = rows * cols
        if ti.static(spec.gpu):
            for p in range(size):
                costs(
                    p, rows, cols, channels, n_arms, tile, tiles_x, slots, most, count_in, label_in, arm_in, factor_in,
                    feature_in, arm_cost_out,
                )  # fmt: skip
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for p in range(task * size // n_tasks, (task + 1) * size // n_tasks):
                        costs(
                            p, rows, cols, channels, n_arms, tile, tiles_x, slots, most, count_in, label_in, arm_in,
                            factor_in, feature_in, arm_cost_out,
                        )  # fmt: skip

    return arm_costs


@functools.cache
def paths_kernel(spec: KernelSpec):
    """Adds the sums of costs along all paths of one direction to ``total``."""
    _, path, _ = _formulas(spec)
    real = spec.real

    @Kernel
    def add_paths(
        n_lines: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        step_y: ti.i32,
        step_x: ti.i32,
        tile: ti.i32,
        tiles_x: ti.i32,
        slots: ti.i32,
        ordered: ti.i32,  # 1: one list of labels, each a neighbour of the next; ``near`` is not read
        p1: real,
        p2: real,
        scale: real,
        n_tasks: ti.i32,
        count_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [tiles]
        near_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [tiles, NEAR, slots, NEAR]
        guide_in: ti.types.ndarray(dtype=real, ndim=1),  # [rows, cols]
        cost_in: ti.types.ndarray(dtype=real, ndim=1),  # [rows, cols, slots]
        behind_tmp: ti.types.ndarray(dtype=real, ndim=1),  # [n_lines, 2, slots]
        total_io: ti.types.ndarray(dtype=real, ndim=1),  # [rows, cols, slots]
    ):
        if ti.static(spec.gpu):
            for line in range(n_lines):
                path(
                    line, rows, cols, step_y, step_x, tile, tiles_x, slots, ordered, p1, p2, scale, count_in, near_in,
                    guide_in, cost_in, behind_tmp, total_io,
                )  # fmt: skip
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for line in range(task * n_lines // n_tasks, (task + 1) * n_lines // n_tasks):
                        path(
                            line, rows, cols, step_y, step_x, tile, tiles_x, slots, ordered, p1, p2, scale, count_in,
                            near_in, guide_in, cost_in, behind_tmp, total_io,
                        )  # fmt: skip

    return add_paths


@functools.cache
def winners_kernel(spec: KernelSpec):
    """Per pixel the best label's slot, its displacement with fraction, and its own cost."""
    _, _, winner = _formulas(spec)
    real = spec.real

    @Kernel
    def choose(
        rows: ti.i32,
        cols: ti.i32,
        tile: ti.i32,
        tiles_x: ti.i32,
        slots: ti.i32,
        ordered: ti.i32,
        n_tasks: ti.i32,
        count_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [tiles]
        label_in: ti.types.ndarray(dtype=real, ndim=1),  # [tiles, slots, 2]
        near_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [tiles, NEAR, slots, NEAR]
        cost_in: ti.types.ndarray(dtype=real, ndim=1),  # [rows, cols, slots]
        total_in: ti.types.ndarray(dtype=real, ndim=1),  # [rows, cols, slots]
        chosen_out: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [rows, cols]
        found_out: ti.types.ndarray(dtype=real, ndim=1),  # [2, rows, cols]
        price_out: ti.types.ndarray(dtype=real, ndim=1),  # [rows, cols]
    ):
        size = rows * cols
        if ti.static(spec.gpu):
            for p in range(size):
                winner(
                    p, rows, cols, tile, tiles_x, slots, ordered, count_in, label_in, near_in, cost_in, total_in,
                    chosen_out, found_out, price_out,
                )  # fmt: skip
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for p in range(task * size // n_tasks, (task + 1) * size // n_tasks):
                        winner(
                            p, rows, cols, tile, tiles_x, slots, ordered, count_in, label_in, near_in, cost_in,
                            total_in, chosen_out, found_out, price_out,
                        )  # fmt: skip

    return choose
