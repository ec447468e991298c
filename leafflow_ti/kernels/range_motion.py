"""Velocity of the surface point at the pixel from the parameters of range flow."""

import functools

from leafflow_ti.kernels.dense import tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.patch import patch_functions
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import Number, Region, Value, batch_kernel


@functools.cache
def range_motion_kernel(spec: KernelSpec):
    """The stage that turns (U', V', W), in px/frame, into (U, V, W) and their covariance."""
    precise, lanes = spec.precise, spec.lanes
    patch = patch_functions(spec)

    @ti.func
    def range_motion(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """``U = U' + x0/f W``, ``V = V' + y0/f W``, from px to mm; and the covariance of the velocity's difference
        quotients, its errors taken for those of window means."""
        parameters = base + (number[Region.PARAMETERS] + number[Number.MOTION_SOLUTION] * number[Number.FLOW]) * stride
        rows = base + number[Region.COV_T] * stride
        motion = base + number[Region.MOTION] * stride
        spread = base + number[Region.MOTION_COV] * stride
        quotients = base + number[Region.DIFFERENCE_COV] * stride
        for i in range(lanes):
            ray = patch.pixel_ray(pixel + i, number, value)
            turn = ti.Matrix.identity(precise, 3) * value[Value.MOTION_SCALE]
            depth = value[Value.MOTION_SCALE + 1]
            turn[0, 2], turn[1, 2], turn[2, 2] = ray[0] * depth, ray[1] * depth, depth
            q = ti.Vector.zero(precise, 3)
            cov = ti.Matrix.zero(precise, 3, 3)
            for r in ti.static(range(3)):
                q[r] = ws[parameters + number[Number.MOTION_ROWS + r] * stride + i]
                for c in ti.static(range(3)):
                    cov[r, c] = ws[rows + tri(ti.max(r, c), ti.min(r, c)) * stride + i]
            q = turn @ q
            cov = turn @ cov @ turn.transpose()
            for r in ti.static(range(3)):
                ws[motion + r * stride + i] = q[r]
                for c in ti.static(range(3)):
                    ws[spread + (3 * r + c) * stride + i] = cov[r, c]
                    for axis in ti.static(range(2)):
                        factor = value[Value.DIFFERENCE + 7 * axis]
                        ws[quotients + (9 * axis + 3 * r + c) * stride + i] = factor * factor * cov[r, c]

    return batch_kernel(spec, range_motion)
