"""Covariances of the flow parameters, and the geometry that the camera solutions agree on.

``Cov(p_i) = σ_i² ρ J_ff^-1 (J_ff ∘ K_i) J_ff^-1`` for the rows that a fit uses; K_i and the cross terms between two
solutions are tables (see ``leafflow_ti.sampling``), ρ is the share of the texture's gradient energy that survives
one more smoothing.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.texture import texture_function
from leafflow_ti.kernels.workspace import MAX_ROWS, Number, Region, Value, batch_kernel


@functools.cache
def covariance_kernels(spec: KernelSpec) -> SimpleNamespace:
    """The stages ``row_covariance`` and ``add_camera``, per solution, and ``geometry``."""
    precise, lanes = spec.precise, spec.lanes
    small, smoothness = dense(spec), texture_function(spec)

    @ti.func
    def row_covariance(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Packed covariance of the rows of solution ``which``; keeps ``J_ff^-1 E``.

        Most of the gradients' own noise is taken out of J_ff first: where there is nothing else, the variances must
        grow instead of looking certain.
        """
        flow = number[Number.FLOW]
        n_rows = number[Number.ROWS_S]
        rows_at = Number.CAMERA_ROWS + which * MAX_ROWS
        response_at = base + number[Region.RESPONSE_S] * stride
        cov_at = base + number[Region.COV_S] * stride
        if which == number[Number.MOTION_SOLUTION]:
            n_rows = number[Number.ROWS_T]
            rows_at = Number.MOTION_ROWS
            response_at = base + number[Region.RESPONSE_T] * stride
            cov_at = base + number[Region.COV_T] * stride
        clean = base + number[Region.CLEAN] * stride
        noise = base + number[Region.NOISE] * stride
        product = base + number[Region.PRODUCT] * stride
        variance = base + (number[Region.VARIANCE] + which) * stride
        floor = base + number[Region.FLOOR] * stride
        quietest = ti.Vector.zero(precise, lanes)
        for j in range(number[Number.SOLUTIONS]):
            at = base + (number[Region.VARIANCE] + j) * stride
            for i in range(lanes):
                quietest[i] = ti.select(j == 0, ws[at + i], ti.min(ws[at + i], quietest[i]))
        for i in range(lanes):
            ws[floor + i] = precise(0.0)
        table = Value.RATIO + which * (flow * (flow + 1) // 2)
        for r in range(flow):
            for c in range(r + 1):
                begin = number[Number.LOWER + tri(r, c)] * n_pixels + pixel
                s = value[Value.SCALE + r] * value[Value.SCALE + c]
                ratio = value[table + tri(r, c)]
                element = ti.Vector.zero(precise, lanes)
                scaled = ti.Vector.zero(precise, lanes)
                for i in range(lanes):
                    element[i] = ti.cast(J[begin + i], precise) * s
                for i in range(lanes):
                    scaled[i] = element[i] * ratio
                small.store(ws, noise + tri(r, c) * stride, scaled)
                if r == c:
                    own = value[Value.DENOISE] * value[Value.NOISE + r] * s
                    for i in range(lanes):
                        scaled[i] = ws[floor + i] + value[Value.RIDGE] * element[i]
                    small.store(ws, floor, scaled)
                    for i in range(lanes):
                        element[i] -= own * quietest[i]
                small.store(ws, clean + tri(r, c) * stride, element)
        terms = number[Number.NOISE_TERMS]
        extra = Value.RATIO + number[Number.SOLUTIONS] * (flow * (flow + 1) // 2) + which * terms
        for term in range(terms):
            at = Number.LOWER + tri(number[Number.N], 0) + 2 * term
            begin = number[at + 1] * n_pixels + pixel
            own = noise + number[at] * stride
            for i in range(lanes):
                ws[own + i] += value[extra + term] * ti.cast(J[begin + i], precise)
        least = ti.Vector.zero(precise, lanes)
        for i in range(lanes):
            least[i] = ti.max(ws[floor + i] + precise(1e-3) * quietest[i], precise(1e-30))
        small.store(ws, floor, least)
        for r in range(flow):
            for c in range(n_rows):
                # p = s p~: the column of the inverse, in the parameter's own units.
                unit = ti.select(number[rows_at + c] == r, value[Value.SCALE + r], precise(0.0))
                at = response_at + (r * n_rows + c) * stride
                for i in range(lanes):
                    ws[at + i] = unit
        if number[Number.OWN_FLOW] == 1:
            # The flow itself is moved to another pixel by its derivatives there.
            offsets = number[Number.OFFSETS]
            for k in range(2):
                step = value[Value.CAMERA_STEP + k]
                for c in range(2):
                    column = number[Number.MOVE + 2 * c + k]
                    at = response_at + (column * n_rows + c * offsets) * stride
                    for i in range(lanes):
                        shift = step * (
                            ws[base + number[Region.GEOMETRY] * stride + i] * value[Value.BASELINE + k]
                            - value[Value.SHIFT + k]
                        )
                        ws[at + i] += value[Value.SCALE + column] * shift
        for term in range(number[Number.CENTRE_TERMS]):
            constant, square = number[Number.CENTRE + 2 * term], number[Number.CENTRE + 2 * term + 1]
            share = value[Value.CENTRE + term] * value[Value.SCALE + square]
            for c in range(n_rows):
                if number[rows_at + c] == constant:
                    at = response_at + (square * n_rows + c) * stride
                    for i in range(lanes):
                        ws[at + i] = share
        small.cholesky(ws, clean, flow, floor, stride)
        small.solve(ws, clean, response_at, flow, n_rows, stride)
        small.symmetric_times(ws, noise, response_at, product, flow, n_rows, stride)
        factor_of = smoothness(pixel, n_pixels, number, J)
        for i in range(lanes):
            factor_of[i] *= ws[variance + i]
        for r in range(n_rows):
            for c in range(r + 1):
                element = small.dot(ws, response_at + r * stride, n_rows, product + c * stride, n_rows, flow, stride)
                for i in range(lanes):
                    element[i] *= factor_of[i]
                small.store(ws, cov_at + tri(r, c) * stride, element)

    @ti.func
    def cross_covariance(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, camera: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """Covariance of the rows of one camera solution with those of the motion."""
        rows_s, rows_t = number[Number.ROWS_S], number[Number.ROWS_T]
        cross = base + number[Region.CROSS] * stride
        one_at = base + number[Region.RESPONSE_S] * stride
        two_at = base + number[Region.RESPONSE_T] * stride
        factor_of = smoothness(pixel, n_pixels, number, J)
        first = base + (number[Region.VARIANCE] + camera) * stride
        second = base + (number[Region.VARIANCE] + number[Number.MOTION_SOLUTION]) * stride
        for i in range(lanes):
            factor_of[i] *= ti.sqrt(ti.max(ws[first + i] * ws[second + i], precise(0.0)))
        for r in range(rows_s):
            for c in range(rows_t):
                element = ti.Vector.zero(precise, lanes)
                for term in range(number[Number.CROSS_TERMS]):
                    entry = Number.CROSS_AB + (camera * 9 + term) * 3
                    a, b = number[entry], number[entry + 1]
                    begin = number[entry + 2] * n_pixels + pixel
                    s = value[Value.CROSS + camera * 9 + term] * value[Value.SCALE + a] * value[Value.SCALE + b]
                    one = one_at + (a * rows_s + r) * stride
                    two = two_at + (b * rows_t + c) * stride
                    for i in range(lanes):
                        element[i] += s * ti.cast(J[begin + i], precise) * ws[one + i] * ws[two + i]
                for i in range(lanes):
                    element[i] *= factor_of[i]
                small.store(ws, cross + (r * rows_t + c) * stride, element)

    @ti.func
    def accumulate(
        base: ti.i32, stride: ti.i32, camera: ti.i32, number: ti.template(), value: ti.template(), ws: ti.template()
    ):
        """Add one camera solution, whose cross disparity is known to be 0, to the normal equations of the geometry."""
        terms, rows_t, flow = number[Number.TERMS], number[Number.ROWS_T], number[Number.FLOW]
        cov = base + number[Region.COV_S] * stride
        work = base + number[Region.GEOMETRY_WORK] * stride
        axis = number[Number.CAMERA_AXIS + camera]
        step = value[Value.BASELINE + axis]
        n_used = 2 * terms
        for r in range(n_used):
            for c in range(terms):
                unit = ti.select(r == c, step, precise(0.0))
                at = work + (r * terms + c) * stride
                for i in range(lanes):
                    ws[at + i] = unit
        if number[Number.WEIGHTED] == 1:
            small.cholesky(ws, cov, n_used, -1, stride)
            small.solve(ws, cov, work, n_used, terms, stride)
        else:
            spread = base + number[Region.GEOMETRY_SPREAD] * stride
            for r in range(terms):
                for c in range(r + 1):
                    at = spread + tri(r, c) * stride
                    own = cov + tri(r, c) * stride
                    element = ti.Vector.zero(precise, lanes)
                    for i in range(lanes):
                        element[i] = ws[at + i] + step * step * ws[own + i]
                    small.store(ws, at, element)
        normal = base + number[Region.GEOMETRY_NORMAL] * stride
        rhs = base + number[Region.GEOMETRY_RHS] * stride
        for r in range(terms):
            for c in range(r + 1):
                at = normal + tri(r, c) * stride
                own = work + (r * terms + c) * stride
                element = ti.Vector.zero(precise, lanes)
                for i in range(lanes):
                    element[i] = ws[at + i] + step * ws[own + i]
                small.store(ws, at, element)
            element = ti.Vector.zero(precise, lanes)
            at = rhs + r * stride
            for i in range(lanes):
                element[i] = ws[at + i]
            for m in range(n_used):
                row = number[Number.CAMERA_ROWS + camera * MAX_ROWS + m]
                parameter = base + (number[Region.PARAMETERS] + camera * flow + row) * stride
                weight = work + (m * terms + r) * stride
                constant = ti.select(m == 0, value[Value.SHIFT + axis], precise(0.0))
                for i in range(lanes):
                    element[i] += ws[weight + i] * (ws[parameter + i] + constant)
            small.store(ws, at, element)
        if number[Number.MOTION_SOLUTION] >= 0:
            cross = base + number[Region.CROSS] * stride
            target = base + number[Region.GEOMETRY_CROSS] * stride
            for r in range(terms):
                for c in range(rows_t):
                    at = target + (r * rows_t + c) * stride
                    element = small.dot(ws, work + r * stride, terms, cross + c * stride, rows_t, n_used, stride)
                    for i in range(lanes):
                        element[i] += ws[at + i]
                    small.store(ws, at, element)

    @ti.func
    def add_camera(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Add camera solution ``which`` to the normal equations of the geometry; the first one clears them."""
        terms, rows_s, rows_t = number[Number.TERMS], number[Number.ROWS_S], number[Number.ROWS_T]
        if which == 0:
            for e in range(number[Region.GEOMETRY_COV] - number[Region.GEOMETRY_NORMAL]):
                for i in range(lanes):
                    ws[base + (number[Region.GEOMETRY_NORMAL] + e) * stride + i] = precise(0.0)
            for e in range(terms * rows_t):
                for i in range(lanes):
                    ws[base + (number[Region.GEOMETRY_CROSS] + e) * stride + i] = precise(0.0)
        if number[Number.MOTION_SOLUTION] >= 0:
            cross_covariance(base, pixel, stride, n_pixels, which, number, value, J, ws)
        if rows_s > 2 * terms:
            # The variance of the brightness row, which the next camera solution would overwrite.
            small.copy(
                ws, base + (number[Region.COV_S] + tri(rows_s - 1, rows_s - 1)) * stride,
                base + (number[Region.BRIGHTNESS_VARIANCE] + which) * stride, 1, stride,
            )  # fmt: skip
        accumulate(base, stride, which, number, value, ws)

    @ti.func
    def geometry(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Least squares of (nu, b_x, b_y, b_t) per mm over all camera solutions: (3.40), with normals."""
        terms = number[Number.TERMS]
        normal = base + number[Region.GEOMETRY_NORMAL] * stride
        result = base + number[Region.GEOMETRY] * stride
        cross = base + number[Region.GEOMETRY_CROSS] * stride
        cov = base + number[Region.GEOMETRY_COV] * stride
        small.cholesky(ws, normal, terms, -1, stride)
        small.copy(ws, base + number[Region.GEOMETRY_RHS] * stride, result, terms, stride)
        for part in range(2):
            target = ti.select(part == 0, result, cross)
            small.solve(ws, normal, target, terms, ti.select(part == 0, 1, number[Number.ROWS_T]), stride)
        if number[Number.WEIGHTED] == 1:
            small.set_identity(ws, cov, terms, stride)
        else:
            small.unpack(ws, base + number[Region.GEOMETRY_SPREAD] * stride, cov, terms, stride)
        small.sandwich(ws, normal, cov, terms, 2 - number[Number.WEIGHTED], stride)

    return SimpleNamespace(**{f.__name__: batch_kernel(spec, f) for f in (row_covariance, add_camera, geometry)})
