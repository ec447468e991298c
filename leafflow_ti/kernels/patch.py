"""A moving surface patch: its geometry, and the coefficients of its motion in what the images show.

Schuchert 2010, Eqs. (5.8), (5.18), (5.23) with the errata of the model contract: the time column uses ``∂X/∂t - N``,
and preshifted data measure ``b a_s + nu0 a_x`` along a camera axis. The patch moves as ``U = N + Ω × P + ε P``. The
window's affine fit sees the mean of what it leaves out: on a plane the flow is quadratic in x, y, and its second-order
part times the window's second moment belongs to the row of the flow itself.
"""

import functools
from enum import IntEnum
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import MAX_UNKNOWNS, PATCH_SIZE, Number, Region, Value

RANGE_CODE = 6
"""Code of the range constraint, behind those of the motion rows' offsets."""
GROWTH = 9
"""Place of ε among the components (N, Ω, A, ε) of the motion."""


class Patch(IntEnum):
    """Elements of ``Region.PATCH``: the ray ``(x/f, y/f)`` of a camera to the patch, and the surface there."""

    X = 0
    Y = 1
    DEPTH = 2
    SLOPE_X = 3
    SLOPE_Y = 4
    INVERSE_C = 5  # 1 / (1 - ZX x/f - ZY y/f)
    INVERSE_DEPTH = 6
    SEEN_X = 7  # the reference camera's ray
    SEEN_Y = 8


assert len(Patch) <= PATCH_SIZE


@functools.cache
def patch_functions(spec: KernelSpec) -> SimpleNamespace:
    """``pixel_ray``, ``place_patch``, and ``motion_row``, ``range_row``, which leave an equation in ``Region.ROW``."""
    precise, lanes, V = spec.precise, spec.lanes, spec.element
    small = dense(spec)

    @ti.func
    def pixel_ray(p: ti.template(), number: ti.template(), value: ti.template()):
        """``(x0/f, y0/f)`` of the group's pixels."""
        row = p.pixel // number[p.n + Number.PITCH]
        col = p.pixel - row * number[p.n + Number.PITCH]
        first = ti.cast(number[p.n + Number.OUT_X] + number[p.n + Number.STEP] * col, precise) - value[p.v + Value.PX]
        y = ti.cast(number[p.n + Number.OUT_Y] + number[p.n + Number.STEP] * row, precise) - value[p.v + Value.PY]
        x = V(first)
        if ti.static(lanes > 1):
            for i in ti.static(range(lanes)):
                x[i] = first + ti.cast(number[p.n + Number.STEP] * i, precise)
        return x / value[p.v + Value.F], V(y / value[p.v + Value.F])

    @ti.func
    def place_patch(
        nu: ti.template(), b1: ti.template(), b2: ti.template(), p: ti.template(), number: ti.template(),
        value: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """``(Z0, ZX, ZY)`` of Eqs. (6.13), (6.14) at the reference's ray, and ``c`` at the camera's."""
        patch = region(p, number, Region.PATCH)
        inverse = nu * (precise(-1.0) / value[p.v + Value.F])
        Z0 = 1.0 / inverse
        P = b1 * Z0
        Q = b2 * Z0
        c = 1.0 / (1.0 + P * ws[patch + Patch.SEEN_X * p.stride] + Q * ws[patch + Patch.SEEN_Y * p.stride])
        ZX = c * P
        ZY = c * Q
        ws[patch + Patch.DEPTH * p.stride] = Z0
        ws[patch + Patch.INVERSE_DEPTH * p.stride] = inverse
        ws[patch + Patch.SLOPE_X * p.stride] = ZX
        ws[patch + Patch.SLOPE_Y * p.stride] = ZY
        x, y = ws[patch + Patch.X * p.stride], ws[patch + Patch.Y * p.stride]
        ws[patch + Patch.INVERSE_C * p.stride] = 1.0 / (1.0 - ZX * x - ZY * y)

    @ti.func
    def motion_row(
        k: ti.i32, code: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()
    ):
        """Coefficients of (N, Ω, A, ε) in ``a_k,m`` (5.18), as the window and the preshifted data measure it, per
        camera step along s: to ROW; what they give for the present motion. Codes: 0 the motion itself, 1.. x, y, sx,
        sy, t.

        With h = Z0/f for x, y and 1 for the others, and g the slope (for t: Zt), every world derivative of (5.8) is
        ``h g/c (x, y, f)/f + h (unit vector along its axis)``, and every b is ``h g f / (Z0² c)``.
        """
        patch, motion = region(p, number, Region.PATCH), region(p, number, Region.MOTION)
        f, stride = value[p.v + Value.F], p.stride
        wide = precise(1.0) / f
        x, y = ws[patch + Patch.X * stride], ws[patch + Patch.Y * stride]
        inverse, inverse_c = ws[patch + Patch.INVERSE_DEPTH * stride], ws[patch + Patch.INVERSE_C * stride]
        ZX, ZY = ws[patch + Patch.SLOPE_X * stride], ws[patch + Patch.SLOPE_Y * stride]
        N0, N1, N2 = ws[motion], ws[motion + stride], ws[motion + 2 * stride]
        # e_k = (1, 0, -x) or (0, 1, -y)
        second = ti.cast(k, precise)
        first = 1.0 - second
        along = 0.0 - (x * first + y * second)
        n0, n1, n2, r0, r1, r2, grown = V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0)
        scale = V(0.0)
        along_s = code == 3 or code == 4
        for part in range(ti.select(along_s, 2, 1)):
            axis, factor = code, f
            if along_s:
                factor *= value[p.v + ti.select(part == 0, Value.BASELINE, Value.SHIFT) + code - 3]
                axis = ti.select(part == 0, code, code - 2)
            scale = inverse * factor  # -nu, times what the part counts
            if axis == 0:
                # Half the second derivative of u_k along its own axis: -T_Z d(1/Z) + (Ω × e_Z)_k / f, where
                # T = N - Ω × X0 - ε X0 is the velocity that the patch's motion has at the camera; along the other axis
                # it vanishes.
                turned = value[p.v + Value.SECOND_MOMENT + k] * wide
                bent = (ZX * first + ZY * second) * inverse_c * turned
                n0 = scale * first
                n1 = scale * second
                n2 = scale * along + bent * inverse
                r0 = 0.0 - (bent * y + turned * second)
                r1 = bent * x + turned * first
                grown = 0.0 - bent
            else:
                slope, h = ZX, V(1.0)
                if axis == 2 or axis == 4:
                    slope = ZY
                if axis < 3:
                    h = ws[patch + Patch.DEPTH * stride] * wide
                if axis == 5:
                    slope = N2 - ZX * N0 - ZY * N1
                d2 = h * slope * inverse_c
                d0 = d2 * x
                d1 = d2 * y
                b = d2 * scale * inverse
                if axis == 1 or axis == 3:
                    d0 = d0 + h
                elif axis == 5:
                    d0 = d0 - N0
                    d1 = d1 - N1
                    d2 = d2 - N2
                else:
                    d1 = d1 + h
                n0 = n0 - b * first
                n1 = n1 - b * second
                n2 = n2 - b * along
                if axis == k + 1:
                    n2 = n2 - scale * wide
                # -nu δ × e
                r0 = r0 + scale * (d1 * along - d2 * second)
                r1 = r1 + scale * (d2 * first - d0 * along)
                r2 = r2 + scale * (d0 * second - d1 * first)
                grown = grown + scale * (d0 * first + d1 * second + d2 * along)
        row = region(p, number, Region.ROW)
        ws[row] = n0
        ws[row + stride] = n1
        ws[row + 2 * stride] = n2
        ws[row + 3 * stride] = r0
        ws[row + 4 * stride] = r1
        ws[row + 5 * stride] = r2
        ws[row + GROWTH * stride] = grown
        result = n0 * N0 + n1 * N1 + n2 * N2 + grown * ws[motion + GROWTH * stride]
        result = result + r0 * ws[motion + 3 * stride] + r1 * ws[motion + 4 * stride] + r2 * ws[motion + 5 * stride]
        accelerated = scale * ti.cast(code == 5, precise)
        a0, a1, a2 = ws[motion + 6 * stride], ws[motion + 7 * stride], ws[motion + 8 * stride]
        ws[row + 6 * stride] = accelerated * first
        ws[row + 7 * stride] = accelerated * second
        ws[row + 8 * stride] = accelerated * along
        return result + accelerated * (a0 * first + a1 * second + a2 * along)

    @ti.func
    def range_row(p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Coefficients of the range constraint ``b_t`` (5.23): to ROW; what they give for the present motion."""
        row, patch, stride = region(p, number, Region.ROW), region(p, number, Region.PATCH), p.stride
        small.clear(ws, row, MAX_UNKNOWNS, stride)
        inverse = ws[patch + Patch.INVERSE_DEPTH * stride]
        scale = inverse * inverse * ws[patch + Patch.INVERSE_C * stride] * value[p.v + Value.F]
        ws[row] = 0.0 - scale * ws[patch + Patch.SLOPE_X * stride]
        ws[row + stride] = 0.0 - scale * ws[patch + Patch.SLOPE_Y * stride]
        ws[row + 2 * stride] = scale
        return small.dot(ws, row, 1, region(p, number, Region.MOTION), 1, 3, stride)

    return SimpleNamespace(pixel_ray=pixel_ray, place_patch=place_patch, motion_row=motion_row, range_row=range_row)
