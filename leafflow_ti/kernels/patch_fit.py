"""Motion of the surface patch: least squares of (N, Ω, A) from the motion rows and the range constraint.

Schuchert 2010, Eqs. (5.8), (5.18), (5.23) with the errata of the model contract: the time column uses ``∂X/∂t -
N``, and preshifted data measure ``b a_s + nu0 a_x`` along a camera axis.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import MAX_UNKNOWNS, Number, Region, Value, batch_kernel


@functools.cache
def patch_functions(spec: KernelSpec) -> SimpleNamespace:
    """Formulas of one patch, for one pixel: ``pixel_ray``, ``surface`` and ``motion_row``."""
    precise = spec.precise
    vec3 = ti.types.vector(3, precise)
    vec9 = ti.types.vector(MAX_UNKNOWNS, precise)

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
        """Coefficients of (N, Ω, A) in ``a_k,m`` (5.18); codes 0 = the motion itself, 1.. = x, y, sx, sy, t."""
        Z0, ZX, ZY, c = s[0], s[1], s[2], s[3]
        x, y = ray[0], ray[1]
        nu = -f / Z0
        e = vec3(1, 0, -x)
        if k == 1:
            e = vec3(0, 1, -y)
        row = vec9(0)
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
            if code == k + 1:
                row[2] += nu / f
        return row

    @ti.func
    def motion_row(
        k: ti.i32, code: ti.i32, ray: ti.template(), s: ti.template(), N: ti.template(), value: ti.template()
    ):
        """The row as the preshifted data measure it, per camera step along s."""
        along_s = code == 3 or code == 4
        row = vec9(0)
        for part in range(ti.select(along_s, 2, 1)):
            factor = precise(1.0)
            if along_s:
                factor = value[ti.select(part == 0, Value.BASELINE, Value.SHIFT) + code - 3]
            row += factor * bare_row(k, ti.select(part == 0, code, code - 2), ray, value[Value.F], s, N)
        return row

    @ti.func
    def range_row(f: precise, s: ti.template()):
        """Coefficients of the range constraint ``b_t`` (5.23)."""
        row = vec9(0)
        scale = f / (s[0] * s[0] * s[3])
        row[0] = -scale * s[1]
        row[1] = -scale * s[2]
        row[2] = scale
        return row

    return SimpleNamespace(pixel_ray=pixel_ray, surface=surface, motion_row=motion_row, range_row=range_row)


@functools.cache
def patch_fit_kernel(spec: KernelSpec):
    """The stage that solves for the motion and its covariance."""
    precise, lanes = spec.precise, spec.lanes
    small, patch = dense(spec), patch_functions(spec)

    @ti.func
    def any_row(
        r: ti.i32, ray: ti.template(), s: ti.template(), N: ti.template(), number: ti.template(), value: ti.template()
    ):
        offsets = number[Number.OFFSETS]
        row = patch.range_row(value[Value.F], s)
        if r < 2 * offsets:
            k = r // offsets
            row = patch.motion_row(k, number[Number.OFFSET_CODES + r - k * offsets], ray, s, N, value)
        return row

    @ti.func
    def design(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_rows: ti.i32,
        number: ti.template(), value: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """Rows of the system, linearised about the present motion, their measured values, and their sensitivity.

        The sensitivity is the derivative of the rows' residual by the geometry, by central differences: variant 0 of
        the loop is the geometry itself, two more for each of its terms are displaced.
        """
        flow, terms, offsets = number[Number.FLOW], number[Number.TERMS], number[Number.OFFSETS]
        target = base + number[Region.DESIGN] * stride
        measured = base + number[Region.VALUE] * stride
        derivative = base + number[Region.DERIVATIVE] * stride
        g = base + number[Region.GEOMETRY] * stride
        q = base + number[Region.MOTION] * stride
        parameters = base + (number[Region.PARAMETERS] + number[Number.MOTION_SOLUTION] * flow) * stride
        for r in range(n_rows):
            for term in range(terms):
                own = ti.cast(r == 2 * offsets and term == number[Number.RANGE_TERM], precise)
                for i in range(lanes):
                    ws[derivative + (r * terms + term) * stride + i] = own
        for i in range(lanes):
            ray = patch.pixel_ray(pixel + i, number, value)
            motion = ti.Vector.zero(precise, MAX_UNKNOWNS)
            for j in ti.static(range(MAX_UNKNOWNS)):
                motion[j] = ws[q + j * stride + i]
            N = ti.Vector([motion[0], motion[1], motion[2]], dt=precise)
            for variant in range(1 + 2 * ti.min(terms, 3)):
                term = (variant - 1) // 2
                nu = ws[g + i]
                h = value[Value.STEP_SIZE] * ti.abs(nu) * (1.0 - 2.0 * ti.cast(variant % 2, precise))
                if term > 0:
                    h /= value[Value.F]
                b = ti.Vector.zero(precise, 2)
                if terms > 1:
                    b[0] = ws[g + stride + i] + ti.select(term == 1, h, precise(0.0))
                    b[1] = ws[g + 2 * stride + i] + ti.select(term == 2, h, precise(0.0))
                if variant > 0 and term == 0:
                    nu += h
                s = patch.surface(ray, value[Value.F], nu, b[0], b[1])
                for r in range(n_rows):
                    row = any_row(r, ray, s, N, number, value)
                    if variant == 0:
                        for j in ti.static(range(MAX_UNKNOWNS)):
                            ws[target + (r * MAX_UNKNOWNS + j) * stride + i] = row[j]
                    else:
                        ws[derivative + (r * terms + term) * stride + i] -= row.dot(motion) / (2 * h)
            for r in range(n_rows):
                at = g + number[Number.RANGE_TERM] * stride
                if r < 2 * offsets:
                    at = parameters + number[Number.MOTION_ROWS + r] * stride
                ws[measured + r * stride + i] = ws[at + i]

    @ti.func
    def row_spread(
        base: ti.i32, stride: ti.i32, n_rows: ti.i32, number: ti.template(), value: ti.template(), ws: ti.template()
    ):
        """Covariance of the rows: for the weights without, for the error bars with what motion and geometry share."""
        terms, rows_t, used = number[Number.TERMS], number[Number.ROWS_T], 2 * number[Number.OFFSETS]
        cov_t = base + number[Region.COV_T] * stride
        cov_g = base + number[Region.GEOMETRY_COV] * stride
        cross = base + number[Region.GEOMETRY_CROSS] * stride
        d = base + number[Region.DERIVATIVE] * stride
        for r in range(n_rows):
            for c in range(r + 1):
                spread = ti.Vector.zero(precise, lanes)
                shared = ti.Vector.zero(precise, lanes)
                if r < used:
                    own = cov_t + tri(r, c) * stride
                    for i in range(lanes):
                        spread[i] = ws[own + i]
                for a in range(terms):
                    da = d + (r * terms + a) * stride
                    db = d + (c * terms + a) * stride
                    for b in range(terms):
                        dc = d + (c * terms + b) * stride
                        own = cov_g + (a * terms + b) * stride
                        for i in range(lanes):
                            spread[i] += ws[da + i] * ws[own + i] * ws[dc + i]
                    if c < used:
                        own = cross + (a * rows_t + c) * stride
                        for i in range(lanes):
                            shared[i] += ws[da + i] * ws[own + i]
                    if r < used:
                        own = cross + (a * rows_t + r) * stride
                        for i in range(lanes):
                            shared[i] += ws[db + i] * ws[own + i]
                for i in range(lanes):
                    shared[i] += spread[i]
                small.store(ws, base + (number[Region.TOTAL] + tri(r, c)) * stride, shared)
                caution = precise(1.0)
                if r == used:
                    caution = value[Value.RANGE_CAUTION] * ti.select(
                        c == used, value[Value.RANGE_CAUTION], precise(1.0)
                    )
                for i in range(lanes):
                    spread[i] *= caution
                small.store(ws, base + (number[Region.SPREAD] + tri(r, c)) * stride, spread)

    @ti.func
    def solve(base: ti.i32, stride: ti.i32, n_rows: ti.i32, number: ti.template(), ws: ti.template()):
        """Weighted normal equations; WEIGHTED becomes ``W A``, NORMAL the factor of ``A^T W A``."""
        n = number[Number.UNKNOWNS]
        a = base + number[Region.DESIGN] * stride
        v = base + number[Region.VALUE] * stride
        factor = base + number[Region.FACTOR] * stride
        weighted = base + number[Region.WEIGHTED] * stride
        normal = base + number[Region.NORMAL] * stride
        q = base + number[Region.MOTION] * stride
        for r in range(n_rows):
            for c in range(n):
                small.copy(ws, a + (r * MAX_UNKNOWNS + c) * stride, weighted + (r * n + c) * stride, 1, stride)
        if number[Number.WEIGHTED] == 1:
            small.copy(ws, base + number[Region.SPREAD] * stride, factor, n_rows * (n_rows + 1) // 2, stride)
            small.cholesky(ws, factor, n_rows, -1, stride)
            small.solve(ws, factor, weighted, n_rows, n, stride)
        for r in range(n):
            for c in range(r + 1):
                element = small.dot(ws, a + r * stride, MAX_UNKNOWNS, weighted + c * stride, n, n_rows, stride)
                small.store(ws, normal + tri(r, c) * stride, element)
            small.store(ws, q + r * stride, small.dot(ws, weighted + r * stride, n, v, 1, n_rows, stride))
        small.cholesky(ws, normal, n, -1, stride)
        small.solve(ws, normal, q, n, 1, stride)

    @ti.func
    def propagate(base: ti.i32, cov: ti.i32, stride: ti.i32, n_rows: ti.i32, number: ti.template(), ws: ti.template()):
        """Covariance [n, n] at ``cov`` of the solution for the covariance of the rows in SPREAD."""
        n = number[Number.UNKNOWNS]
        weighted = base + number[Region.WEIGHTED] * stride
        spread = base + number[Region.SPREAD] * stride
        work = base + number[Region.MOTION_WORK] * stride
        small.symmetric_times(ws, spread, weighted, work, n_rows, n, stride)
        for r in range(n):
            for c in range(n):
                element = small.dot(ws, weighted + r * stride, n, work + c * stride, n, n_rows, stride)
                small.store(ws, cov + (r * n + c) * stride, element)
        small.sandwich(ws, base + number[Region.NORMAL] * stride, cov, n, 2, stride)

    @ti.func
    def difference(axis: ti.i32, r: ti.i32, number: ti.template(), value: ti.template()) -> precise:
        """Error of a row's difference quotient along an axis per error of the row."""
        offsets = number[Number.OFFSETS]
        code = 0  # the range constraint is a mean over the window
        if r < 2 * offsets:
            code = number[Number.OFFSET_CODES + r % offsets]
        return value[Value.DIFFERENCE + 6 * axis + code]

    @ti.func
    def patch_fit(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Motion and covariance; each pass takes Ω × N and the rows' covariance from the one before."""
        n = number[Number.UNKNOWNS]
        n_rows = 2 * number[Number.OFFSETS] + number[Number.USE_RANGE]
        q = base + number[Region.MOTION] * stride
        for j in range(MAX_UNKNOWNS):
            for i in range(lanes):
                ws[q + j * stride + i] = precise(0.0)
        for _ in range(number[Number.PASSES]):
            design(base, pixel, stride, n_rows, number, value, ws)
            row_spread(base, stride, n_rows, number, value, ws)
            solve(base, stride, n_rows, number, ws)
        total = base + number[Region.TOTAL] * stride
        spread = base + number[Region.SPREAD] * stride
        cov = base + number[Region.MOTION_COV] * stride
        small.copy(ws, total, spread, n_rows * (n_rows + 1) // 2, stride)
        propagate(base, cov, stride, n_rows, number, ws)
        # Windows side by side share their noise: what is left of it in a difference depends on the rows' offsets.
        for axis in range(2):
            for r in range(n_rows):
                for c in range(r + 1):
                    factor = difference(axis, r, number, value) * difference(axis, c, number, value)
                    at = tri(r, c) * stride
                    for i in range(lanes):
                        ws[spread + at + i] = factor * ws[total + at + i]
            target = base + (number[Region.DIFFERENCE_COV] + axis * n * n) * stride
            propagate(base, target, stride, n_rows, number, ws)

    return batch_kernel(spec, patch_fit)
