"""A moving surface patch: its geometry, and the coefficients of its motion in what the images show.

Schuchert 2010, Eqs. (5.8), (5.18), (5.23) with the errata of the model contract: the time column uses ``∂X/∂t - N``,
and preshifted data measure ``b a_s + nu0 a_x`` along a camera axis. The patch moves as ``U = N + Ω × P + ε P``. The
window's affine fit sees the mean of what it leaves out: on a plane the flow is quadratic in x, y, and its second-order
part times the window's second moment belongs to the row of the flow itself.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import MAX_UNKNOWNS, Number, Value

RANGE_CODE = 6
"""Code of the range constraint, behind those of the motion rows' offsets."""
GROWTH = 9
"""Place of ε among the components (N, Ω, A, ε) of the motion."""


@functools.cache
def patch_functions(spec: KernelSpec) -> SimpleNamespace:
    """Formulas of one patch, for one pixel: ``pixel_ray``, ``surface``, ``motion_row`` and ``range_row``."""
    precise = spec.precise
    vec3 = ti.types.vector(3, precise)
    vec_q = ti.types.vector(MAX_UNKNOWNS, precise)

    @ti.func
    def pixel_ray(pixel: ti.i32, number: ti.template(), value: ti.template()):
        """``(x0/f, y0/f)`` of an output pixel."""
        row = pixel // number[Number.PITCH]
        col = pixel - row * number[Number.PITCH]
        x = ti.cast(number[Number.OUT_X] + number[Number.STEP] * col, precise) - value[Value.PX]
        y = ti.cast(number[Number.OUT_Y] + number[Number.STEP] * row, precise) - value[Value.PY]
        return ti.Vector([x / value[Value.F], y / value[Value.F]], dt=precise)

    @ti.func
    def surface(ray: ti.template(), f: precise, nu: precise, b1: precise, b2: precise):
        """``(Z0, ZX, ZY, c)`` of Eqs. (6.13), (6.14)."""
        Z0 = -f / nu
        P = b1 * Z0
        Q = b2 * Z0
        c = 1 / (1 + P * ray[0] + Q * ray[1])
        return ti.Vector([Z0, c * P, c * Q, c], dt=precise)

    @ti.func
    def bare_row(k: ti.i32, code: ti.i32, ray: ti.template(), f: precise, s: ti.template(), N: ti.template()):
        """Coefficients of (N, Ω, A, ε) in ``a_k,m`` (5.18); codes 0 = the motion itself, 1.. = x, y, sx, sy, t."""
        Z0, ZX, ZY, c = s[0], s[1], s[2], s[3]
        x, y = ray[0], ray[1]
        nu = -f / Z0
        e = vec3(1, 0, -x)
        if k == 1:
            e = vec3(0, 1, -y)
        row = vec_q(0)
        if code == 0:
            for j in ti.static(range(3)):
                row[j] = -nu * e[j]
        else:
            Zt = N[2] - ZX * N[0] - ZY * N[1]
            delta = vec3(0)
            b = precise(0.0)
            if code == 1:
                delta = Z0 / (f * c) * vec3(1 - ZY * y, ZX * y, ZX)
                b = ZX / (Z0 * c)
            elif code == 2:
                delta = Z0 / (f * c) * vec3(ZY * x, 1 - ZX * x, ZY)
                b = ZY / (Z0 * c)
            elif code == 3:
                delta = vec3(c + ZX * x, ZX * y, ZX) / c
                b = f * ZX / (Z0 * Z0 * c)
            elif code == 4:
                delta = vec3(ZY * x, c + ZY * y, ZY) / c
                b = f * ZY / (Z0 * Z0 * c)
            else:
                delta = Zt / c * vec3(x, y, 1) - vec3(N[0], N[1], N[2])
                b = f * Zt / (Z0 * Z0 * c)
            turn = delta.cross(e)
            for j in ti.static(range(3)):
                row[j] = -b * e[j]
                row[3 + j] = -nu * turn[j]
                if code == 5:
                    row[6 + j] = -nu * e[j]
            row[GROWTH] = -nu * delta.dot(e)
            if code == k + 1:
                row[2] += nu / f
        return row

    @ti.func
    def motion_row(
        k: ti.i32, code: ti.i32, ray: ti.template(), s: ti.template(), N: ti.template(), value: ti.template()
    ):
        """The row as the window and the preshifted data measure it, per camera step along s."""
        f = value[Value.F]
        along_s = code == 3 or code == 4
        row = vec_q(0)
        for part in range(ti.select(along_s, 2, 1)):
            factor = precise(1.0)
            if along_s:
                factor = value[ti.select(part == 0, Value.BASELINE, Value.SHIFT) + code - 3]
            row += factor * bare_row(k, ti.select(part == 0, code, code - 2), ray, f, s, N)
        if code == 0:
            # Half the second derivative of u_k along its own axis: -T_Z d(1/Z) + (Ω × e_Z)_k / f, where T = N - Ω × X0
            # - ε X0 is the velocity that the patch's motion has at the camera; along the other axis it vanishes.
            moment = value[Value.SECOND_MOMENT + k]
            bend = moment * s[1 + k] / (f * s[0] * s[3])
            row[2] += bend
            row[3] -= bend * s[0] * ray[1] + ti.select(k == 1, moment / f, precise(0.0))
            row[4] += bend * s[0] * ray[0] + ti.select(k == 0, moment / f, precise(0.0))
            row[GROWTH] -= bend * s[0]
        return row

    @ti.func
    def range_row(f: precise, s: ti.template()):
        """Coefficients of the range constraint ``b_t`` (5.23)."""
        row = vec_q(0)
        scale = f / (s[0] * s[0] * s[3])
        row[0] = -scale * s[1]
        row[1] = -scale * s[2]
        row[2] = scale
        return row

    return SimpleNamespace(pixel_ray=pixel_ray, surface=surface, motion_row=motion_row, range_row=range_row)
