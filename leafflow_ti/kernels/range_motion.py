"""Velocity of the surface point at the pixel from the parameters of range flow."""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.patch import patch_functions
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import Number, Region, Value


@functools.cache
def range_motion_stages(spec: KernelSpec) -> SimpleNamespace:
    """The stage ``range_motion``: (U', V', W), in px/frame, become (U, V, W) and their covariance."""
    V = spec.element
    patch = patch_functions(spec)

    @ti.func
    def range_motion(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """``U = U' + x0/f W``, ``V = V' + y0/f W``, from px to mm; and the covariance of the velocity's difference
        quotients, its errors taken for those of window means."""
        found = region(p, number, Region.PARAMETERS)
        found += number[p.n + Number.MOTION_SOLUTION] * number[p.n + Number.FLOW] * p.stride
        rows, motion = region(p, number, Region.COV_T), region(p, number, Region.MOTION)
        spread, quotients = region(p, number, Region.MOTION_COV), region(p, number, Region.DIFFERENCE_COV)
        x, y = patch.pixel_ray(p, number, value)
        side, depth = value[p.v + Value.MOTION_SCALE], value[p.v + Value.MOTION_SCALE + 1]
        for r in range(3):
            # Row r of the transformation has `one` in its own column and `past` in that of W.
            one, past = ti.select(r == 2, depth, side), along(r, x, y, depth)
            own = ws[found + number[p.n + Number.MOTION_ROWS + r] * p.stride]
            ws[motion + r * p.stride] = own * one + past * ws[found + number[p.n + Number.MOTION_ROWS + 2] * p.stride]
            for c in range(3):
                other, beyond = ti.select(c == 2, depth, side), along(c, x, y, depth)
                cov = ws[rows + tri(ti.max(r, c), ti.min(r, c)) * p.stride] * (one * other)
                cov = cov + ws[rows + tri(2, r) * p.stride] * beyond * one
                cov = cov + ws[rows + tri(2, c) * p.stride] * past * other
                cov = cov + ws[rows + tri(2, 2) * p.stride] * past * beyond
                ws[spread + (3 * r + c) * p.stride] = cov
                for axis in range(2):
                    factor = value[p.v + Value.DIFFERENCE + 7 * axis]
                    ws[quotients + (9 * axis + 3 * r + c) * p.stride] = cov * (factor * factor)

    @ti.func
    def along(r: ti.i32, x: ti.template(), y: ti.template(), depth: spec.precise):
        """What W adds to a component: x/f or y/f times it; nothing to itself."""
        result = V(0.0)
        if r == 0:
            result = x * depth
        elif r == 1:
            result = y * depth
        return result

    return SimpleNamespace(range_motion=range_motion)
