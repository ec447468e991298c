"""Covariances of the flow parameters, and the geometry that the camera solutions agree on.

``Cov(p_i) = σ_i² ρ J_ff^-1 (J_ff ∘ K_i) J_ff^-1`` for the rows that a fit uses; K_i and the cross terms between two
solutions are tables (see ``leafflow_ti.sampling``), ρ is the share of the texture's gradient energy that survives
one more smoothing.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.cut import cut_stages
from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.identify import identify_functions
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.texture import texture_functions
from leafflow_ti.kernels.workspace import MAX_ROWS, Number, Region, Value


@functools.cache
def covariance_stages(spec: KernelSpec) -> SimpleNamespace:
    """The stages ``clean``, then ``row_covariance`` and ``add_camera`` per solution, and ``geometry``."""
    precise, V = spec.precise, spec.element
    small, texture, identify = dense(spec), texture_functions(spec), identify_functions(spec)
    windows = cut_stages(spec)

    @ti.func
    def clean(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Factor J_ff without most of the gradients' own noise: where there is nothing else, the variances must grow
        instead of looking certain."""
        flow = number[p.n + Number.FLOW]
        moments, packed = region(p, number, Region.MOMENTS), region(p, number, Region.CLEAN)
        quietest = identify.quietest(p, number, ws)
        floor = V(0.0)
        for r in range(flow):
            for c in range(r + 1):
                s = value[p.v + Value.SCALE + r] * value[p.v + Value.SCALE + c]
                element = ws[moments + number[p.n + Number.LOWER + tri(r, c)] * p.stride] * s
                noise = V(ti.select(r == c, value[p.v + Value.NOISE + r], precise(0.0)))
                own = region(p, number, Region.WEIGHT_NOISE) + tri(r, c) * p.stride
                if ti.static(spec.cut):
                    noise = ti.select(ws[region(p, number, Region.CUT)] > V(0.5), ws[own], noise)
                elif number[p.n + Number.REWEIGHTED] == 1:
                    noise = ws[own]
                if r == c:
                    floor = floor + element * value[p.v + Value.RIDGE]
                element = element - quietest * noise * (value[p.v + Value.DENOISE] * s)
                ws[packed + tri(r, c) * p.stride] = element
        least = region(p, number, Region.FLOOR)
        ws[least] = ti.max(floor + quietest * precise(1e-3), V(1e-30))
        small.cholesky(ws, packed, flow, least, p.stride)

    @ti.func
    def response(
        target: ti.i32, rows_at: ti.i32, n_rows: ti.i32, p: ti.template(), number: ti.template(),
        value: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """``J_ff^-1 E`` at ``target`` [F, n_rows]: by what normal equations each row is made."""
        flow = number[p.n + Number.FLOW]
        small.clear(ws, target, flow * n_rows, p.stride)
        for c in range(n_rows):
            # p = s p~: the column of the inverse, in the parameter's own units.
            r = number[p.n + rows_at + c]
            ws[target + (r * n_rows + c) * p.stride] = V(value[p.v + Value.SCALE + r])
        if number[p.n + Number.OWN_FLOW] == 1:
            # The flow itself is moved to another pixel by its derivatives there.
            nu, offsets = ws[region(p, number, Region.GEOMETRY)], number[p.n + Number.OFFSETS]
            for k in range(2):
                step = value[p.v + Value.CAMERA_STEP + k]
                shift = (nu * value[p.v + Value.BASELINE + k] - value[p.v + Value.SHIFT + k]) * step
                for c in range(2):
                    column = number[p.n + Number.MOVE + 2 * c + k]
                    at = target + (column * n_rows + c * offsets) * p.stride
                    ws[at] = ws[at] + shift * value[p.v + Value.SCALE + column]
        for term in range(number[p.n + Number.CENTRE_TERMS]):
            column, other = number[p.n + Number.CENTRE + 2 * term], number[p.n + Number.CENTRE + 2 * term + 1]
            share = value[p.v + Value.CENTRE + term] * value[p.v + Value.SCALE + other]
            for c in range(n_rows):
                if number[p.n + rows_at + c] == column:
                    ws[target + (other * n_rows + c) * p.stride] = V(share)
        small.solve(ws, region(p, number, Region.CLEAN), target, flow, n_rows, p.stride)

    @ti.func
    def row_covariance(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Packed covariance of the rows of solution ``which``; keeps ``J_ff^-1 E``. Where the texture does not
        determine all of them, it says so, and the solution is made anew (see ``identify``)."""
        flow = number[p.n + Number.FLOW]
        n_rows, rows_at = number[p.n + Number.ROWS_S], Number.CAMERA_ROWS + p.which * MAX_ROWS
        target, cov = region(p, number, Region.RESPONSE_S), region(p, number, Region.COV_S)
        if p.which == number[p.n + Number.MOTION_SOLUTION]:
            n_rows, rows_at = number[p.n + Number.ROWS_T], ti.cast(Number.MOTION_ROWS, ti.i32)
            target, cov = region(p, number, Region.RESPONSE_T), region(p, number, Region.COV_T)
        moments = region(p, number, Region.MOMENTS)
        noise, product = region(p, number, Region.NOISE), region(p, number, Region.PRODUCT)
        size = flow * (flow + 1) // 2
        for r in range(flow):
            for c in range(r + 1):
                s = value[p.v + Value.SCALE + r] * value[p.v + Value.SCALE + c]
                ratio = value[p.v + Value.RATIO + p.which * size + tri(r, c)]
                element = ws[moments + number[p.n + Number.LOWER + tri(r, c)] * p.stride]
                ws[noise + tri(r, c) * p.stride] = element * (s * ratio)
        if ti.static(spec.cut):  # noqa: SIM102 - the engine decides the one before it compiles the other
            if texture.any_cut(p, number, ws) == 1:
                windows.equation_noise(noise, p, number, value, ws)
        terms = number[p.n + Number.NOISE_TERMS]
        extra = Value.RATIO + number[p.n + Number.SOLUTIONS] * size + p.which * terms
        for term in range(terms):
            at = p.n + Number.LOWER + tri(number[p.n + Number.N], 0) + 2 * term
            own = noise + number[at] * p.stride
            share = ws[moments + number[at + 1] * p.stride] * value[p.v + extra + term]
            if ti.static(spec.cut):  # noqa: SIM102 - likewise
                if windows.of_image_square(term, p, number) == 1:
                    share = ti.select(ws[region(p, number, Region.CUT)] > V(0.5), V(0.0), share)
            ws[own] = ws[own] + share
        response(target, rows_at, n_rows, p, number, value, ws)
        small.symmetric_times(ws, noise, target, product, flow, n_rows, p.stride)
        factor = texture.smoothness(p, number, ws) * ws[region(p, number, Region.VARIANCE) + p.which * p.stride]
        for r in range(n_rows):
            for c in range(r + 1):
                one, two = target + r * p.stride, product + c * p.stride
                ws[cov + tri(r, c) * p.stride] = small.dot(ws, one, n_rows, two, n_rows, flow, p.stride) * factor
        if number[p.n + Number.BIASED] == 1:
            bias, work = region(p, number, Region.BIAS) + p.which * flow * p.stride, region(p, number, Region.VECTORS)
            for r in range(n_rows):
                one = small.dot(ws, target + r * p.stride, n_rows, bias, 1, flow, p.stride)
                ws[work + r * p.stride] = one
                for c in range(r + 1):
                    ws[cov + tri(r, c) * p.stride] = ws[cov + tri(r, c) * p.stride] + one * ws[work + c * p.stride]
        identify.admit(target, rows_at, n_rows, cov, p, number, value, ws)

    @ti.func
    def cross_covariance(p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Covariance of the rows of camera solution ``which`` with those of the motion."""
        rows_s, rows_t = number[p.n + Number.ROWS_S], number[p.n + Number.ROWS_T]
        cross, moments = region(p, number, Region.CROSS), region(p, number, Region.MOMENTS)
        one_at, two_at = region(p, number, Region.RESPONSE_S), region(p, number, Region.RESPONSE_T)
        variance = region(p, number, Region.VARIANCE)
        common = ws[variance + p.which * p.stride] * ws[variance + number[p.n + Number.MOTION_SOLUTION] * p.stride]
        factor = texture.smoothness(p, number, ws) * ti.sqrt(ti.max(common, V(0.0)))
        small.clear(ws, cross, rows_s * rows_t, p.stride)
        for term in range(number[p.n + Number.CROSS_TERMS]):
            entry = p.n + Number.CROSS_AB + (p.which * 9 + term) * 3
            a, b = number[entry], number[entry + 1]
            s = value[p.v + Value.CROSS + p.which * 9 + term]
            s *= value[p.v + Value.SCALE + a] * value[p.v + Value.SCALE + b]
            share = ws[moments + number[entry + 2] * p.stride] * factor * s
            for r in range(rows_s):
                weighted = ws[one_at + (a * rows_s + r) * p.stride] * share
                for c in range(rows_t):
                    at = cross + (r * rows_t + c) * p.stride
                    ws[at] = ws[at] + weighted * ws[two_at + (b * rows_t + c) * p.stride]

    @ti.func
    def accumulate(p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Add one camera solution, whose cross disparity is known to be 0, to the normal equations of the geometry."""
        terms, rows_t = number[p.n + Number.TERMS], number[p.n + Number.ROWS_T]
        cov, work = region(p, number, Region.COV_S), region(p, number, Region.GEOMETRY_WORK)
        axis = number[p.n + Number.CAMERA_AXIS + p.which]
        step = value[p.v + Value.BASELINE + axis]
        n_used = 2 * terms
        for r in range(n_used):
            for c in range(terms):
                ws[work + (r * terms + c) * p.stride] = V(ti.select(r == c, step, precise(0.0)))
        if number[p.n + Number.WEIGHTED] == 1:
            small.cholesky(ws, cov, n_used, -1, p.stride)
            small.solve(ws, cov, work, n_used, terms, p.stride)
        else:
            spread = region(p, number, Region.GEOMETRY_SPREAD)
            for e in range(tri(terms, 0)):
                ws[spread + e * p.stride] = ws[spread + e * p.stride] + ws[cov + e * p.stride] * (step * step)
        normal, rhs = region(p, number, Region.GEOMETRY_NORMAL), region(p, number, Region.GEOMETRY_RHS)
        found = region(p, number, Region.PARAMETERS) + p.which * number[p.n + Number.FLOW] * p.stride
        for r in range(terms):
            for c in range(r + 1):
                at = normal + tri(r, c) * p.stride
                ws[at] = ws[at] + ws[work + (r * terms + c) * p.stride] * step
            total = ws[rhs + r * p.stride]
            for m in range(n_used):
                row = number[p.n + Number.CAMERA_ROWS + p.which * MAX_ROWS + m]
                constant = ti.select(m == 0, value[p.v + Value.SHIFT + axis], precise(0.0))
                total = total + ws[work + (m * terms + r) * p.stride] * (ws[found + row * p.stride] + constant)
            ws[rhs + r * p.stride] = total
        if number[p.n + Number.MOTION_SOLUTION] >= 0:
            cross, target = region(p, number, Region.CROSS), region(p, number, Region.GEOMETRY_CROSS)
            for r in range(terms):
                for c in range(rows_t):
                    at = target + (r * rows_t + c) * p.stride
                    one, two = work + r * p.stride, cross + c * p.stride
                    ws[at] = ws[at] + small.dot(ws, one, terms, two, rows_t, n_used, p.stride)

    @ti.func
    def add_camera(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Add camera solution ``which`` to the normal equations of the geometry; the first one clears them."""
        terms, rows_s, rows_t = number[p.n + Number.TERMS], number[p.n + Number.ROWS_S], number[p.n + Number.ROWS_T]
        if p.which == 0:
            normal = region(p, number, Region.GEOMETRY_NORMAL)
            sums = number[p.n + Region.GEOMETRY_COV] - number[p.n + Region.GEOMETRY_NORMAL]
            small.clear(ws, normal, sums, p.stride)
            small.clear(ws, region(p, number, Region.GEOMETRY_CROSS), terms * rows_t, p.stride)
        if number[p.n + Number.MOTION_SOLUTION] >= 0:
            cross_covariance(p, number, value, ws)
        if rows_s > 2 * terms:
            # The variance of the brightness row, which the next camera solution would overwrite.
            kept = region(p, number, Region.BRIGHTNESS_VARIANCE) + p.which * p.stride
            ws[kept] = ws[region(p, number, Region.COV_S) + tri(rows_s - 1, rows_s - 1) * p.stride]
        accumulate(p, number, value, ws)

    @ti.func
    def geometry(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Least squares of (nu, b_x, b_y, b_t) per mm over all camera solutions: (3.40), with normals."""
        terms, weighted = number[p.n + Number.TERMS], number[p.n + Number.WEIGHTED]
        normal, result = region(p, number, Region.GEOMETRY_NORMAL), region(p, number, Region.GEOMETRY)
        cross, cov = region(p, number, Region.GEOMETRY_CROSS), region(p, number, Region.GEOMETRY_COV)
        small.cholesky(ws, normal, terms, -1, p.stride)
        small.copy(ws, region(p, number, Region.GEOMETRY_RHS), result, terms, p.stride)
        for part in range(2):
            target = ti.select(part == 0, result, cross)
            small.solve(ws, normal, target, terms, ti.select(part == 0, 1, number[p.n + Number.ROWS_T]), p.stride)
        if weighted == 1:
            small.set_identity(ws, cov, terms, p.stride)
        else:
            small.unpack(ws, region(p, number, Region.GEOMETRY_SPREAD), cov, terms, p.stride)
        small.sandwich(ws, normal, cov, terms, 2 - weighted, p.stride)

    return SimpleNamespace(clean=clean, row_covariance=row_covariance, add_camera=add_camera, geometry=geometry)
