"""Where other surfaces hide the one that is measured, image by image."""

import functools

from leafflow_ti.kernels.engine import Kernel, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec


@functools.cache
def hiding_kernel(spec: KernelSpec):
    """Marks the pixels of the images of a block on which nearer surfaces lie.

    A pixel of the reference image, displaced by (u, v) px per camera step along x and y and by (p, q) px per frame,
    lies ``(u - u0) kx + (p - p0) n`` from where the block, aimed at (u0, v0, p0, q0), has it: there, and around it by a
    pixel, it hides what lies behind.
    """
    real = spec.real

    @ti.func
    def mark(
        image: ti.i32, n_images: ti.i32, height: ti.i32, width: ti.i32, top: ti.i32, left: ti.i32, rows: ti.i32,
        cols: ti.i32, least: real, region: ti.template(), view: ti.template(), aim: ti.template(),
        nearness: ti.template(), shown: ti.template(), hidden: ti.template(),
    ):  # fmt: skip
        kx, ky, n = view[image], view[n_images + image], view[2 * n_images + image]
        plane = height * width
        for y in range(region[4 * image], region[4 * image + 1]):
            for x in range(region[4 * image + 2], region[4 * image + 3]):
                pixel = y * width + x
                if nearness[pixel] > least:
                    u, v = shown[pixel] - aim[0], shown[plane + pixel] - aim[1]
                    p, q = shown[2 * plane + pixel] - aim[2], shown[3 * plane + pixel] - aim[3]
                    col = x - left + ti.cast(ti.floor(u * kx + p * n + 0.5), ti.i32)
                    row = y - top + ti.cast(ti.floor(v * ky + q * n + 0.5), ti.i32)
                    for j in range(ti.max(row - 1, 0), ti.min(row + 2, rows)):
                        for i in range(ti.max(col - 1, 0), ti.min(col + 2, cols)):
                            hidden[(image * rows + j) * cols + i] = 1

    @Kernel
    def hiding(
        n_images: ti.i32,
        n_tasks: ti.i32,
        height: ti.i32,
        width: ti.i32,
        top: ti.i32,
        left: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        least: real,
        region_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_images, 4]: rows and columns that are looked at
        view_in: ti.types.ndarray(dtype=real, ndim=1),  # [3, n_images]: camera steps along x and y, frames
        aim_in: ti.types.ndarray(dtype=real, ndim=1),  # [4]
        nearness_in: ti.types.ndarray(dtype=real, ndim=1),  # [height, width]
        shown_in: ti.types.ndarray(dtype=real, ndim=1),  # [4, height, width]: u, v, p, q
        hidden_out: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n_images, rows, cols], 0 before
    ):
        for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
            if part == 0:
                for image in range(task * n_images // n_tasks, (task + 1) * n_images // n_tasks):
                    mark(
                        image, n_images, height, width, top, left, rows, cols, least, region_in, view_in, aim_in,
                        nearness_in, shown_in, hidden_out,
                    )  # fmt: skip

    return hiding
