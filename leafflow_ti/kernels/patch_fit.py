"""Motion of the surface patch: least squares of (N, Ω, A) from motion rows of one or of all cameras (6.15).

With all cameras the patch may also grow in its plane: the flow's derivatives along x and y cannot tell growth from
approach, the flow of several cameras can. A set of rows (the reference model's, or one camera's own flow) is added to
sums from which the motion is solved at the end, so the number of cameras does not matter to memory. The rows themselves
are formulas of ``patch``.
"""

import functools

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.patch import RANGE_CODE, patch_functions
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.texture import texture_function
from leafflow_ti.kernels.workspace import MAX_UNKNOWNS, Number, Region, Value, batch_kernel

START, CLEAR, FINISH, DIFFERENCES = 1, 2, 4, 8
"""What a launch does besides adding its rows: forget the motion, forget the sums (both before), solve (after), find the
covariances of difference quotients (in every launch of a fit, or in none)."""


@functools.cache
def patch_fit_kernel(spec: KernelSpec):
    """The stage that adds a set of rows to the sums, and solves for the motion and its covariance with the last one.

    Its ``which`` is a sum of ``START``, ``CLEAR``, ``DIFFERENCES`` and ``FINISH``.
    """
    precise, lanes = spec.precise, spec.lanes
    small, patch, smoothness = dense(spec), patch_functions(spec), texture_function(spec)

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
    def equation_error(
        r: ti.i32, row: ti.template(), motion: ti.template(), s: ti.template(),
        number: ti.template(), value: ti.template(),
    ):  # fmt: skip
        """What an equation leaves out: a share of the sizes of its terms; mixed derivatives also one of the turning."""
        offsets = number[Number.OFFSETS]
        code = RANGE_CODE
        if r < 2 * offsets:
            code = number[Number.OFFSET_CODES + r % offsets]
        size = precise(0.0)
        for j in ti.static(range(MAX_UNKNOWNS)):
            size += ti.abs(row[j] * motion[j])
        turning = precise(0.0)
        if code == 3 or code == 4 or code == RANGE_CODE:
            turn = ti.Vector([motion[3], motion[4], motion[5]], dt=precise).norm()
            turning = value[Value.F] / ti.abs(s[0]) * turn * ti.sqrt(1 + s[1] * s[1] + s[2] * s[2])
            if code != RANGE_CODE:
                turning *= ti.abs(value[Value.BASELINE + code - 3])
        return value[Value.MODEL_ERROR + code] * size + value[Value.TURNING_ERROR] * turning

    @ti.func
    def design(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_rows: ti.i32,
        number: ti.template(), value: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """Rows of the system, linearised about the present motion, their measured values, and their sensitivity.

        An own flow is measured at the reference's preshifted pixel and moved to where the patch point projects by the
        flow's own derivatives. The sensitivity is the derivative of the rows' residual by the geometry, by central
        differences: variant 0 of the loop is the geometry itself, two more for each of its terms are displaced.
        """
        flow, terms, offsets = number[Number.FLOW], number[Number.TERMS], number[Number.OFFSETS]
        target = base + number[Region.DESIGN] * stride
        measured = base + number[Region.VALUE] * stride
        left_out = base + number[Region.LEFT_OUT] * stride
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
            seen = patch.pixel_ray(pixel + i, number, value)
            ray = seen
            for k in ti.static(range(2)):
                ray[k] += ws[g + i] * value[Value.BASELINE + k] * value[Value.CAMERA_STEP + k] / value[Value.F]
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
                s = patch.surface(seen, value[Value.F], nu, b[0], b[1])
                s[3] = 1 - s[1] * ray[0] - s[2] * ray[1]
                for r in range(n_rows):
                    row = any_row(r, ray, s, N, number, value)
                    if variant == 0:
                        for j in ti.static(range(MAX_UNKNOWNS)):
                            place = number[Number.PLACE + j]
                            if place >= 0:
                                ws[target + (r * MAX_UNKNOWNS + place) * stride + i] = row[j]
                        ws[left_out + r * stride + i] = equation_error(r, row, motion, s, number, value)
                    else:
                        ws[derivative + (r * terms + term) * stride + i] -= row.dot(motion) / (2 * h)
            for r in range(n_rows):
                at = g + number[Number.RANGE_TERM] * stride
                if r < 2 * offsets:
                    at = parameters + number[Number.MOTION_ROWS + r] * stride
                found = ws[at + i]
                if number[Number.OWN_FLOW] == 1 and r % offsets == 0:
                    for k in range(2):
                        column = number[Number.MOVE + 2 * (r // offsets) + k]
                        found += own_shift(k, ws[g + i], value) * ws[parameters + column * stride + i]
                ws[measured + r * stride + i] = found

    @ti.func
    def own_shift(k: ti.i32, nu: precise, value: ti.template()):
        """Pixels from the preshifted pixel to where the patch point projects into an own flow's camera."""
        return value[Value.CAMERA_STEP + k] * (nu * value[Value.BASELINE + k] - value[Value.SHIFT + k])

    @ti.func
    def row_spread(
        base: ti.i32, stride: ti.i32, n_rows: ti.i32, number: ti.template(), value: ti.template(), ws: ti.template()
    ):
        """OWN: noise of the rows. FACTOR, for the weights: that, the geometry's noise in them, what they leave out."""
        terms, offsets = number[Number.TERMS], number[Number.OFFSETS]
        cov_t = base + number[Region.COV_T] * stride
        cov_g = base + number[Region.GEOMETRY_COV] * stride
        d = base + number[Region.DERIVATIVE] * stride
        for r in range(n_rows):
            for c in range(r + 1):
                spread = ti.Vector.zero(precise, lanes)
                if r < 2 * offsets:
                    own = cov_t + tri(r, c) * stride
                    for i in range(lanes):
                        spread[i] = ws[own + i]
                small.store(ws, base + (number[Region.OWN] + tri(r, c)) * stride, spread)
                if r == c:
                    left_out = base + (number[Region.LEFT_OUT] + r) * stride
                    for i in range(lanes):
                        spread[i] += ws[left_out + i] * ws[left_out + i]
                for one in range(terms):
                    da = d + (r * terms + one) * stride
                    for two in range(terms):
                        dc = d + (c * terms + two) * stride
                        own = cov_g + (one * terms + two) * stride
                        for i in range(lanes):
                            spread[i] += ws[da + i] * ws[own + i] * ws[dc + i]
                small.store(ws, base + (number[Region.FACTOR] + tri(r, c)) * stride, spread)

    @ti.func
    def leave_out(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, n_rows: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """Rows of an own flow whose window has left the image or that follows nothing get zero values and design."""
        mass = number[Number.EXTRA] * n_pixels + pixel
        p = base + number[Region.PARAMETERS] * stride
        used = ti.Vector.zero(precise, lanes)
        for i in range(lanes):
            shift = precise(0.0)
            for k in ti.static(range(2)):
                shift += ws[p + number[Number.FLOW_ROWS + k] * stride + i] ** 2
            good = shift < value[Value.MAX_SHIFT] ** 2 and ti.cast(J[mass + i], precise) > value[Value.MIN_MASS]
            used[i] = ti.cast(good, precise)
        for r in range(n_rows):
            for c in range(r + 1):
                # Also where the covariance is no number: a unit matrix in its place.
                for region in range(2):
                    at = base + (number[ti.select(region == 0, Region.OWN, Region.FACTOR)] + tri(r, c)) * stride
                    element = ti.Vector.zero(precise, lanes)
                    for i in range(lanes):
                        element[i] = ti.select(used[i] > 0, ws[at + i], ti.cast(r == c, precise))
                    small.store(ws, at, element)
            for j in range(MAX_UNKNOWNS + 1):
                at = base + (number[Region.DESIGN] + r * MAX_UNKNOWNS + j) * stride
                if j == MAX_UNKNOWNS:
                    at = base + (number[Region.VALUE] + r) * stride
                element = ti.Vector.zero(precise, lanes)
                for i in range(lanes):
                    element[i] = ti.select(used[i] > 0, ws[at + i], precise(0.0))
                small.store(ws, at, element)

    @ti.func
    def weigh(base: ti.i32, stride: ti.i32, n_rows: ti.i32, number: ti.template(), ws: ti.template()):
        """WEIGHTED becomes ``W A``, with plain least squares A itself."""
        n = number[Number.UNKNOWNS]
        factor = base + number[Region.FACTOR] * stride
        weighted = base + number[Region.WEIGHTED] * stride
        for r in range(n_rows):
            a = base + (number[Region.DESIGN] + r * MAX_UNKNOWNS) * stride
            small.copy(ws, a, weighted + r * n * stride, n, stride)
        if number[Number.WEIGHTED] == 1:
            small.cholesky(ws, factor, n_rows, -1, stride)
            small.solve(ws, factor, weighted, n_rows, n, stride)

    @ti.func
    def add(ws: ti.template(), at: ti.i32, term: ti.template()):
        """Add a vector over the lanes to one element."""
        total = ti.Vector.zero(precise, lanes)
        for i in range(lanes):
            total[i] = ws[at + i] + term[i]
        small.store(ws, at, total)

    @ti.func
    def difference(
        base: ti.i32, stride: ti.i32, n_rows: ti.i32, axis: ti.i32,
        number: ti.template(), value: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """Scale the rows of WEIGHTED by what of their errors a difference quotient along an axis is left with.

        Windows side by side share most of their noise; how much, depends on the offset of the row.
        """
        n, offsets = number[Number.UNKNOWNS], number[Number.OFFSETS]
        for r in range(n_rows):
            code = RANGE_CODE
            if r < 2 * offsets:
                code = number[Number.OFFSET_CODES + r % offsets]
            factor = value[Value.DIFFERENCE + code]
            if axis == 1:  # the rows are scaled for x
                factor = value[Value.DIFFERENCE + RANGE_CODE + 1 + code] / factor
            at = base + (number[Region.WEIGHTED] + r * n) * stride
            for e in range(n):
                for i in range(lanes):
                    ws[at + e * stride + i] *= factor

    @ti.func
    def accumulate(
        base: ti.i32, stride: ti.i32, n_rows: ti.i32, variant: ti.i32, number: ti.template(), ws: ti.template()
    ):
        """Add the rows to the normal equations (variant 0) and to what the covariance of a variant is made of."""
        n, terms = number[Number.UNKNOWNS], number[Number.TERMS]
        spread = number[Region.NORMAL_SPREAD] + variant * n * n
        left = number[Region.LEFT] + variant * (terms + number[Number.CORRELATED]) * n
        weighted = base + number[Region.WEIGHTED] * stride
        work = base + number[Region.MOTION_WORK] * stride
        small.symmetric_times(ws, base + number[Region.OWN] * stride, weighted, work, n_rows, n, stride)
        for part in range(ti.select(variant == 0, 4, 2)):
            x, step, rows, target = number[Region.MOTION_WORK], n, n, spread
            if part == 1:
                x, step, rows, target = number[Region.DERIVATIVE], terms, terms, left
            elif part == 2:
                x, step, rows, target = number[Region.DESIGN], MAX_UNKNOWNS, n, number[Region.NORMAL]
            elif part == 3:
                x, step, rows, target = number[Region.VALUE], 1, 1, number[Region.NORMAL_RHS]
            for r in range(rows):
                for c in range(n):
                    one = base + (x + r) * stride
                    element = small.dot(ws, one, step, weighted + c * stride, n, n_rows, stride)
                    add(ws, base + (target + r * n + c) * stride, element)

    @ti.func
    def correlate(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, variant: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """What the reference's rows share with the geometry, and an own flow's with the reference's rows."""
        n, terms, rows_t = number[Number.UNKNOWNS], number[Number.TERMS], number[Number.ROWS_T]
        used = 2 * number[Number.OFFSETS]
        weighted = base + number[Region.WEIGHTED] * stride
        first = variant * (terms + number[Number.CORRELATED])
        kept = base + number[Region.REFERENCE_VARIANCE] * stride
        variance = base + (number[Region.VARIANCE] + number[Number.MOTION_SOLUTION]) * stride
        if number[Number.OWN_FLOW] == 0:
            small.copy(ws, variance, kept, 1, stride)
            for c in range(n):
                for a in range(terms + number[Number.CORRELATED]):
                    # Geometry times motion rows, then the response of the motion rows to the normal equations.
                    x = base + (number[Region.GEOMETRY_CROSS] + a * rows_t) * stride
                    at = base + (number[Region.RIGHT] + (first + a) * n + c) * stride
                    if a >= terms:
                        x = base + (number[Region.RESPONSE_T] + (a - terms) * rows_t) * stride
                        at = base + (number[Region.LEFT] + (first + a) * n + c) * stride
                    add(ws, at, small.dot(ws, x, 1, weighted + c * stride, n, used, stride))
        else:
            factor = ti.Vector.zero(precise, lanes)
            rho = smoothness(pixel, n_pixels, number, J)
            for i in range(lanes):
                common = ws[kept + i] * ws[variance + i]
                factor[i] = ti.select(common > 0, rho[i] * ti.sqrt(common), precise(0.0))
            for a in range(number[Number.CORRELATED]):
                partner = number[Number.PARTNER + a]
                if partner >= 0:
                    x = base + (number[Region.PRODUCT] + partner * rows_t) * stride
                    for c in range(n):
                        term = small.dot(ws, x, 1, weighted + c * stride, n, used, stride)
                        for i in range(lanes):
                            term[i] *= factor[i] * value[Value.PARTNER + a]
                        add(ws, base + (number[Region.RIGHT] + (first + terms + a) * n + c) * stride, term)

    @ti.func
    def finish(base: ti.i32, stride: ti.i32, variants: ti.i32, number: ti.template(), ws: ti.template()):
        """Motion from the sums, its covariance and, with three variants, those of its difference quotients."""
        n, terms = number[Number.UNKNOWNS], number[Number.TERMS]
        normal = base + number[Region.MOTION_WORK] * stride
        q = base + number[Region.NORMAL_RHS] * stride
        for r in range(n):
            small.copy(ws, base + (number[Region.NORMAL] + r * n) * stride, normal + tri(r, 0) * stride, r + 1, stride)
        small.cholesky(ws, normal, n, -1, stride)
        small.solve(ws, normal, q, n, 1, stride)
        for j in range(MAX_UNKNOWNS):
            if number[Number.PLACE + j] >= 0:
                place = base + (number[Region.MOTION] + j) * stride
                small.copy(ws, q + number[Number.PLACE + j] * stride, place, 1, stride)
        count = terms + number[Number.CORRELATED]
        for variant in range(variants):
            cov = base + number[Region.MOTION_COV] * stride
            if variant > 0:
                cov = base + (number[Region.DIFFERENCE_COV] + (variant - 1) * n * n) * stride
            left = base + (number[Region.LEFT] + variant * count * n) * stride
            right = base + (number[Region.RIGHT] + variant * count * n) * stride
            for a in range(terms):
                # LEFT^T cov LEFT as two transposed halves.
                x = base + (number[Region.GEOMETRY_COV] + a * terms) * stride
                for c in range(n):
                    half = small.dot(ws, x, 1, left + c * stride, n, terms, stride)
                    for i in range(lanes):
                        half[i] *= precise(0.5)
                    add(ws, right + (a * n + c) * stride, half)
            for r in range(n):
                for c in range(n):
                    element = ti.Vector.zero(precise, lanes)
                    own = base + (number[Region.NORMAL_SPREAD] + (variant * n + r) * n + c) * stride
                    for i in range(lanes):
                        element[i] = ws[own + i]
                    for side in range(2):
                        one = ti.select(side == 0, r, c)
                        two = ti.select(side == 0, c, r)
                        part = small.dot(ws, left + one * stride, n, right + two * stride, n, count, stride)
                        for i in range(lanes):
                            element[i] += part[i]
                    small.store(ws, cov + (r * n + c) * stride, element)
            small.sandwich(ws, normal, cov, n, 2, stride)

    @ti.func
    def patch_fit(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Add the rows of one set; Ω × N and the geometry's noise in the rows are taken at the present motion."""
        n_rows = 2 * number[Number.OFFSETS] + number[Number.USE_RANGE]
        first = ti.select(which & START, number[Region.MOTION], number[Region.NORMAL])
        if which & (START | CLEAR) != 0:
            for e in range(number[Region.REFERENCE_VARIANCE] - first):
                for i in range(lanes):
                    ws[base + (first + e) * stride + i] = precise(0.0)
        design(base, pixel, stride, n_rows, number, value, ws)
        row_spread(base, stride, n_rows, number, value, ws)
        if number[Number.OWN_FLOW] == 1:
            leave_out(base, pixel, stride, n_pixels, n_rows, number, value, J, ws)
        weigh(base, stride, n_rows, number, ws)
        variants = ti.select(which & DIFFERENCES != 0, 3, 1)
        for variant in range(variants):
            if variant > 0:
                difference(base, stride, n_rows, variant - 1, number, value, ws)
            accumulate(base, stride, n_rows, variant, number, ws)
            correlate(base, pixel, stride, n_pixels, variant, number, value, J, ws)
        if which & FINISH != 0:
            finish(base, stride, variants, number, ws)

    return batch_kernel(spec, patch_fit)
