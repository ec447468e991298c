"""Motion of the surface patch: least squares of (N, Ω, A) from motion rows of one or of all cameras (6.15).

With all cameras the patch may also grow in its plane: the flow's derivatives along x and y cannot tell growth from
approach, the flow of several cameras can. A set of rows (the reference model's, or one camera's own flow) is added to
sums from which the motion is solved at the end, so the number of cameras does not matter to memory. The rows themselves
are formulas of ``patch``.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.cut_rows import cut_row_functions
from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.maps import Output
from leafflow_ti.kernels.patch import GROWTH, RANGE_CODE, Patch, patch_functions
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.texture import texture_functions
from leafflow_ti.kernels.workspace import MAX_UNKNOWNS, Number, Region, Value

START, CLEAR, FINISH, COVARIANCE, DIFFERENCES = 1, 2, 4, 8, 16
"""What a step does besides adding its rows: forget the motion, forget the sums (both before), solve (after), find the
covariance, and those of difference quotients (these in every step of a fit, or in none)."""
HELD = 1e8
"""Times as certain: an unknown that is held at 0."""


@functools.cache
def patch_fit_stages(spec: KernelSpec) -> SimpleNamespace:
    """The stage ``patch_fit``: adds a set of rows to the sums, and solves for the motion and its covariance with the
    last one. Its ``which`` is a sum of the above."""
    precise, V = spec.precise, spec.element
    small, patch, texture = dense(spec), patch_functions(spec), texture_functions(spec)
    cut = cut_row_functions(spec)

    @ti.func
    def code_of(r: ti.i32, p: ti.template(), number: ti.template()) -> ti.i32:
        """Offset of an equation: those of the motion rows, then the range constraint."""
        offsets = number[p.n + Number.OFFSETS]
        code = RANGE_CODE
        if r < 2 * offsets:
            code = number[p.n + Number.OFFSET_CODES + r % offsets]
        return code

    @ti.func
    def make_row(r: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Leave the coefficients of equation ``r`` in ROW; what they give for the present motion."""
        code, offsets = code_of(r, p, number), number[p.n + Number.OFFSETS]
        result = V(0.0)
        if ti.static(spec.cut):
            cut.before(code, p, number, value, ws)
        if code == RANGE_CODE:
            result = patch.range_row(p, number, value, ws)
        else:
            result = patch.motion_row(r // offsets, code, p, number, value, ws)
        if ti.static(spec.cut):
            result = cut.behind(r // offsets, code, result, p, number, value, ws)
        return result

    @ti.func
    def equation_error(r: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """What an equation leaves out: a share of the sizes of its terms; mixed derivatives also one of the turning."""
        row, motion = region(p, number, Region.ROW), region(p, number, Region.MOTION)
        at = region(p, number, Region.PATCH)
        code = code_of(r, p, number)
        size = V(0.0)
        for j in range(MAX_UNKNOWNS):
            size = size + small.magnitude(ws[row + j * p.stride] * ws[motion + j * p.stride])
        result = size * value[p.v + Value.MODEL_ERROR + code]
        if code == 3 or code == 4 or code == RANGE_CODE:
            factor = value[p.v + Value.TURNING_ERROR] * value[p.v + Value.F]
            if code != RANGE_CODE:
                factor *= ti.abs(value[p.v + Value.BASELINE + code - 3])
            turn = motion + 3 * p.stride
            ZX, ZY = ws[at + Patch.SLOPE_X * p.stride], ws[at + Patch.SLOPE_Y * p.stride]
            turning = ti.sqrt(small.dot(ws, turn, 1, turn, 1, 3, p.stride) * (ZX * ZX + ZY * ZY + 1.0))
            result = result + turning * small.magnitude(ws[at + Patch.INVERSE_DEPTH * p.stride]) * factor
        return result

    @ti.func
    def design(n_rows: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Rows of the system, linearised about the present motion, their measured values, and their sensitivity.

        An own flow is measured at the reference's preshifted pixel and moved to where the patch point projects by the
        flow's own derivatives. The sensitivity is the derivative of the rows' residual by the geometry, by differences:
        variant 0 of the loop is the geometry itself, in the others one of its terms is displaced.
        """
        n, terms, offsets = number[p.n + Number.UNKNOWNS], number[p.n + Number.TERMS], number[p.n + Number.OFFSETS]
        derivative, found = region(p, number, Region.DERIVATIVE), region(p, number, Region.MOTION_WORK)
        at, g = region(p, number, Region.PATCH), region(p, number, Region.GEOMETRY)
        nu, b1, b2 = ws[g], V(0.0), V(0.0)
        if terms > 1:
            b1, b2 = ws[g + p.stride], ws[g + 2 * p.stride]
        x, y = patch.pixel_ray(p, number, value)
        ws[at + Patch.SEEN_X * p.stride], ws[at + Patch.SEEN_Y * p.stride] = x, y
        for k in range(2):
            step = value[p.v + Value.BASELINE + k] * value[p.v + Value.CAMERA_STEP + k] / value[p.v + Value.F]
            ws[at + (Patch.X + k) * p.stride] = ws[at + (Patch.SEEN_X + k) * p.stride] + nu * step
        small.clear(ws, derivative, n_rows * terms, p.stride)
        if number[p.n + Number.RANGE_TERM] >= 0 and n_rows > 2 * offsets:
            ws[derivative + (2 * offsets * terms + number[p.n + Number.RANGE_TERM]) * p.stride] = V(1.0)
        for variant in range(1 + ti.min(terms, 3)):
            # Like a derivative of the disparity, b counts per pixel.
            step = value[p.v + Value.STEP_SIZE]
            if variant > 1:
                step /= value[p.v + Value.F]
            h = small.magnitude(nu) * step
            inverse = 1.0 / h
            patch.place_patch(
                nu + h * ti.cast(variant == 1, precise), b1 + h * ti.cast(variant == 2, precise),
                b2 + h * ti.cast(variant == 3, precise), p, number, value, ws,
            )  # fmt: skip
            for r in range(n_rows):
                result = make_row(r, p, number, value, ws)
                if variant == 0:
                    for j in range(MAX_UNKNOWNS):
                        place = number[p.n + Number.PLACE + j]
                        if place >= 0:
                            target = region(p, number, Region.DESIGN) + (r * n + place) * p.stride
                            ws[target] = ws[region(p, number, Region.ROW) + j * p.stride]
                    error = equation_error(r, p, number, value, ws)
                    ws[region(p, number, Region.LEFT_OUT) + r * p.stride] = error
                    ws[found + r * p.stride] = result
                else:
                    here = derivative + (r * terms + variant - 1) * p.stride
                    ws[here] = ws[here] - (result - ws[found + r * p.stride]) * inverse
        measure(n_rows, p, number, value, ws)

    @ti.func
    def measure(n_rows: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """VALUE: the measured values of the rows."""
        offsets, g = number[p.n + Number.OFFSETS], region(p, number, Region.GEOMETRY)
        parameters = region(p, number, Region.PARAMETERS)
        parameters += number[p.n + Number.MOTION_SOLUTION] * number[p.n + Number.FLOW] * p.stride
        for r in range(n_rows):
            at = g + number[p.n + Number.RANGE_TERM] * p.stride
            if r < 2 * offsets:
                at = parameters + number[p.n + Number.MOTION_ROWS + r] * p.stride
            found = ws[at]
            if r < 2 * offsets and r % offsets == 0:
                found = found + value[p.v + Value.MOTION_SHIFT + r // offsets]
            if number[p.n + Number.OWN_FLOW] == 1 and r % offsets == 0:
                for k in range(2):
                    # Pixels from the preshifted pixel to where the patch point projects.
                    moved = ws[g] * value[p.v + Value.BASELINE + k] - value[p.v + Value.SHIFT + k]
                    column = number[p.n + Number.MOVE + 2 * (r // offsets) + k]
                    slope = ws[parameters + column * p.stride] * value[p.v + Value.CAMERA_STEP + k]
                    found = found + moved * slope
            ws[region(p, number, Region.VALUE) + r * p.stride] = found

    @ti.func
    def row_spread(n_rows: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """OWN: noise of the rows. FACTOR, for the weights: that, the geometry's noise in them, what they leave out."""
        terms, offsets = number[p.n + Number.TERMS], number[p.n + Number.OFFSETS]
        cov_t, cov_g = region(p, number, Region.COV_T), region(p, number, Region.GEOMETRY_COV)
        derivative, half = region(p, number, Region.DERIVATIVE), region(p, number, Region.MOTION_WORK)
        own_at, factor_at = region(p, number, Region.OWN), region(p, number, Region.FACTOR)
        for r in range(n_rows):
            for a in range(terms):
                one, two = derivative + r * terms * p.stride, cov_g + a * terms * p.stride
                ws[half + (r * terms + a) * p.stride] = small.dot(ws, one, 1, two, 1, terms, p.stride)
        for r in range(n_rows):
            for c in range(r + 1):
                spread = V(0.0)
                if r < 2 * offsets:
                    spread = ws[cov_t + tri(r, c) * p.stride]
                ws[own_at + tri(r, c) * p.stride] = spread
                if r == c:
                    left_out = ws[region(p, number, Region.LEFT_OUT) + r * p.stride]
                    spread = spread + left_out * left_out
                one, two = half + r * terms * p.stride, derivative + c * terms * p.stride
                spread = spread + small.dot(ws, one, 1, two, 1, terms, p.stride)
                ws[factor_at + tri(r, c) * p.stride] = spread

    @ti.func
    def contradicts(n_rows: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Mean squared difference of the rows from what the present motion gives, by their own errors.

        Where two surfaces meet, a robust estimate may have chosen the other one in this camera.
        """
        n, total = number[p.n + Number.UNKNOWNS], V(0.0)
        for r in range(n_rows):
            rest = ws[region(p, number, Region.VALUE) + r * p.stride]
            for j in range(MAX_UNKNOWNS):
                place = number[p.n + Number.PLACE + j]
                if place >= 0:
                    element = ws[region(p, number, Region.DESIGN) + (r * n + place) * p.stride]
                    rest = rest - element * ws[region(p, number, Region.MOTION) + j * p.stride]
            spread = ws[region(p, number, Region.FACTOR) + tri(r, r) * p.stride]
            total = total + rest * rest / ti.max(spread, V(1e-30))
        return total * (precise(1.0) / ti.cast(n_rows, precise))

    @ti.func
    def chosen(p: ti.template(), number: ti.template(), ws: ti.template()):
        """Where a robust estimate had to choose what of the reference's window belongs to the pixel."""
        return ws[region(p, number, Region.OUT) + Output.SUPPORT * p.stride] < V(1.0)

    @ti.func
    def leave_out(n_rows: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Rows of an own flow whose window has left the image or that follows nothing get zero values and design.

        So do those of a robust estimate that contradict the motion of the reference's rows.
        """
        n, parameters = number[p.n + Number.UNKNOWNS], region(p, number, Region.PARAMETERS)
        mass = ws[region(p, number, Region.MOMENTS) + number[p.n + Number.EXTRA] * p.stride]
        shift = V(0.0)
        for k in range(2):
            u = ws[parameters + number[p.n + Number.FLOW_ROWS + k] * p.stride]
            shift = shift + u * u
        limit = value[p.v + Value.MAX_SHIFT]
        used = (shift < V(limit * limit)) & (mass > V(value[p.v + Value.MIN_MASS]))
        if number[p.n + Number.ROBUST] == 1:
            other = contradicts(n_rows, p, number, value, ws) > V(value[p.v + Value.MAX_CONTRADICTION])
            used = used & (not (other & chosen(p, number, ws)))
        for r in range(n_rows):
            for c in range(r + 1):
                # Also where the covariance is no number: a unit matrix in its place.
                unit = V(ti.cast(r == c, precise))
                for name in range(2):
                    at = ti.select(name == 0, region(p, number, Region.OWN), region(p, number, Region.FACTOR))
                    at += tri(r, c) * p.stride
                    ws[at] = ti.select(used, ws[at], unit)
            for j in range(n + 1):
                at = region(p, number, Region.DESIGN) + (r * n + j) * p.stride
                if j == n:
                    at = region(p, number, Region.VALUE) + r * p.stride
                ws[at] = ti.select(used, ws[at], V(0.0))

    @ti.func
    def weigh(n_rows: ti.i32, p: ti.template(), number: ti.template(), ws: ti.template()):
        """WEIGHTED becomes ``W A``, with plain least squares A itself."""
        n = number[p.n + Number.UNKNOWNS]
        factor, weighted = region(p, number, Region.FACTOR), region(p, number, Region.WEIGHTED)
        small.copy(ws, region(p, number, Region.DESIGN), weighted, n_rows * n, p.stride)
        if number[p.n + Number.WEIGHTED] == 1:
            small.cholesky(ws, factor, n_rows, -1, p.stride)
            small.solve(ws, factor, weighted, n_rows, n, p.stride)

    @ti.func
    def difference(
        n_rows: ti.i32, axis: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()
    ):
        """Scale the rows of WEIGHTED by what of their errors a difference quotient along an axis is left with.

        Windows side by side share most of their noise; how much, depends on the offset of the row.
        """
        n = number[p.n + Number.UNKNOWNS]
        for r in range(n_rows):
            code = code_of(r, p, number)
            factor = value[p.v + Value.DIFFERENCE + code]
            if axis == 1:  # the rows are scaled for x
                factor = value[p.v + Value.DIFFERENCE + RANGE_CODE + 1 + code] / factor
            at = region(p, number, Region.WEIGHTED) + r * n * p.stride
            for e in range(n):
                ws[at + e * p.stride] = ws[at + e * p.stride] * factor

    @ti.func
    def accumulate(
        n_rows: ti.i32, first: ti.i32, last: ti.i32, variant: ti.i32, p: ti.template(), number: ti.template(),
        ws: ti.template(),
    ):  # fmt: skip
        """Add the rows to the normal equations (parts 0, 1) and to what the covariance of a variant is made of (2, 3).

        Of symmetric sums the lower triangle.
        """
        n, terms = number[p.n + Number.UNKNOWNS], number[p.n + Number.TERMS]
        weighted, work = region(p, number, Region.WEIGHTED), region(p, number, Region.MOTION_WORK)
        if last > 2:
            small.symmetric_times(ws, region(p, number, Region.OWN), weighted, work, n_rows, n, p.stride)
        for part in range(first, last):
            x, rows, target = region(p, number, Region.DESIGN), n, region(p, number, Region.NORMAL)
            if part == 1:
                x, rows, target = region(p, number, Region.VALUE), 1, region(p, number, Region.NORMAL_RHS)
            elif part == 2:
                x, target = work, region(p, number, Region.NORMAL_SPREAD) + variant * n * n * p.stride
            elif part == 3:
                x, rows = region(p, number, Region.DERIVATIVE), terms
                target = region(p, number, Region.LEFT)
                target += variant * (terms + number[p.n + Number.CORRELATED]) * n * p.stride
            lower = ti.cast(part % 2 == 0, ti.i32)
            small.add_product(ws, x, rows, weighted, n, n_rows, lower, target, V(1.0), p.stride)

    @ti.func
    def correlate(variant: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """What the reference's rows share with the geometry, and an own flow's with the reference's rows."""
        n, terms, rows_t = number[p.n + Number.UNKNOWNS], number[p.n + Number.TERMS], number[p.n + Number.ROWS_T]
        used, correlated = 2 * number[p.n + Number.OFFSETS], number[p.n + Number.CORRELATED]
        weighted = region(p, number, Region.WEIGHTED)
        first = variant * (terms + correlated)
        kept = region(p, number, Region.REFERENCE_VARIANCE)
        left, right = region(p, number, Region.LEFT), region(p, number, Region.RIGHT)
        variance = region(p, number, Region.VARIANCE) + number[p.n + Number.MOTION_SOLUTION] * p.stride
        own = number[p.n + Number.OWN_FLOW] == 1
        factor = V(1.0)
        if own:
            common = ws[kept] * ws[variance]
            root = texture.smoothness(p, number, ws) * ti.sqrt(ti.max(common, V(0.0)))
            factor = ti.select(common > V(0.0), root, V(0.0))
        else:
            ws[kept] = ws[variance]
        for a in range(terms + correlated):
            # Geometry times motion rows, then the response of the motion rows to the normal equations.
            x = region(p, number, Region.GEOMETRY_CROSS) + a * rows_t * p.stride
            at, scale, shared = right + (first + a) * n * p.stride, V(1.0), not own
            if a >= terms and not own:
                x = region(p, number, Region.RESPONSE_T) + (a - terms) * rows_t * p.stride
                at = left + (first + a) * n * p.stride
            elif a >= terms:
                partner = number[p.n + Number.PARTNER + a - terms]
                shared = partner >= 0
                x = region(p, number, Region.PRODUCT) + ti.max(partner, 0) * rows_t * p.stride
                scale = factor * value[p.v + Value.PARTNER + a - terms]
            if shared:
                small.add_product(ws, x, 1, weighted, n, used, 0, at, scale, p.stride)

    @ti.func
    def finish(variants: ti.i32, p: ti.template(), number: ti.template(), ws: ti.template()):
        """Motion from the sums, its covariance and, with three variants, those of its difference quotients."""
        n, terms = number[p.n + Number.UNKNOWNS], number[p.n + Number.TERMS]
        normal, q = region(p, number, Region.MOTION_WORK), region(p, number, Region.NORMAL_RHS)
        cov_g = region(p, number, Region.GEOMETRY_COV)
        for r in range(n):
            for c in range(r + 1):
                ws[normal + tri(r, c) * p.stride] = ws[region(p, number, Region.NORMAL) + (r * n + c) * p.stride]
        growth = number[p.n + Number.PLACE + GROWTH]
        if number[p.n + Number.ROBUST] == 1 and growth >= 0:
            # The flows of few cameras are left there: too few to tell growth from approach.
            at = normal + tri(growth, growth) * p.stride
            ws[at] = ti.select(chosen(p, number, ws), ws[at] * precise(HELD), ws[at])
        small.cholesky(ws, normal, n, -1, p.stride)
        small.solve(ws, normal, q, n, 1, p.stride)
        for j in range(MAX_UNKNOWNS):
            place = number[p.n + Number.PLACE + j]
            if place >= 0:
                ws[region(p, number, Region.MOTION) + j * p.stride] = ws[q + place * p.stride]
        count = terms + number[p.n + Number.CORRELATED]
        for variant in range(variants):
            cov = region(p, number, Region.MOTION_COV)
            if variant > 0:
                cov = region(p, number, Region.DIFFERENCE_COV) + (variant - 1) * n * n * p.stride
            left = region(p, number, Region.LEFT) + variant * count * n * p.stride
            right = region(p, number, Region.RIGHT) + variant * count * n * p.stride
            spread = region(p, number, Region.NORMAL_SPREAD) + variant * n * n * p.stride
            for a in range(terms):
                # LEFT^T cov LEFT as two transposed halves.
                for c in range(n):
                    at = right + (a * n + c) * p.stride
                    half = small.dot(ws, cov_g + a * terms * p.stride, 1, left + c * p.stride, n, terms, p.stride)
                    ws[at] = ws[at] + half * precise(0.5)
            for r in range(n):
                for c in range(r + 1):
                    total = ws[spread + (r * n + c) * p.stride]
                    for k in range(count):
                        one, two = k * n + r, k * n + c
                        total = total + ws[left + one * p.stride] * ws[right + two * p.stride]
                        total = total + ws[left + two * p.stride] * ws[right + one * p.stride]
                    ws[cov + (r * n + c) * p.stride] = total
                    ws[cov + (c * n + r) * p.stride] = total
            small.sandwich(ws, normal, cov, n, 2, p.stride)

    @ti.func
    def patch_fit(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Add the rows of one set; Ω × N and the geometry's noise in the rows are taken at the present motion."""
        n_rows = 2 * number[p.n + Number.OFFSETS] + number[p.n + Number.USE_RANGE]
        if p.which & START != 0:
            small.clear(ws, region(p, number, Region.MOTION), MAX_UNKNOWNS, p.stride)
        if p.which & (START | CLEAR) != 0:
            sums = number[p.n + Region.REFERENCE_VARIANCE] - number[p.n + Region.NORMAL]
            small.clear(ws, region(p, number, Region.NORMAL), sums, p.stride)
        design(n_rows, p, number, value, ws)
        row_spread(n_rows, p, number, value, ws)
        if number[p.n + Number.OWN_FLOW] == 1:
            leave_out(n_rows, p, number, value, ws)
        weigh(n_rows, p, number, ws)
        variants = ti.select(p.which & DIFFERENCES != 0, 3, ti.select(p.which & COVARIANCE != 0, 1, 0))
        for variant in range(ti.max(variants, 1)):
            if variant > 0:
                difference(n_rows, variant - 1, p, number, value, ws)
            accumulate(n_rows, ti.select(variant == 0, 0, 2), ti.select(variants == 0, 2, 4), variant, p, number, ws)
            if variants > 0:
                correlate(variant, p, number, value, ws)
        if p.which & FINISH != 0:
            finish(variants, p, number, ws)

    return SimpleNamespace(patch_fit=patch_fit)
