"""From the packed structure tensor to the flow parameters of every solution.

All work is on the scaled tensor ``A = S J S``; with S = C^-1/2 its smallest eigenvectors solve the equilibrated
total least-squares problem, with S = 1 the plain one (2.17). One Cholesky factor serves the least-squares solution
(2.15), the inverse iteration that starts from it, and the residuals.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import planes_loader, region
from leafflow_ti.kernels.identify import identify_functions
from leafflow_ti.kernels.spec import EXTRA_PLANES, KernelSpec
from leafflow_ti.kernels.texture import texture_functions
from leafflow_ti.kernels.workspace import Number, Region, Value

JACOBI_SWEEPS = 16
RITZ_SWEEPS = 8
ROUNDS = 6
WHOLE = 0.9999
"""Share of the weights of a window that is seen from which on it counts as whole."""


@functools.cache
def null_space_stages(spec: KernelSpec) -> SimpleNamespace:
    """The stages ``load``, ``scale``, ``least_squares``, ``factorise``, ``accept``, ``inverse_iteration``, ``jacobi``,
    ``parameters``, ``residuals`` and ``centre``; and what stages of weighted windows share with them: ``keep``,
    ``left_out``, ``unsolved``."""
    precise, V, load_planes = spec.precise, spec.element, planes_loader(spec)
    small, identify, texture = dense(spec), identify_functions(spec), texture_functions(spec)

    @ti.func
    def load(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """The tensor's distinct entries and what stands behind them, in the precision of the algebra."""
        moments = region(p, number, Region.MOMENTS)
        load_planes(number[p.n + Number.FIRST_PLANE], number[p.n + Number.EXTRA] + EXTRA_PLANES, moments, p, ws, J)
        ws[region(p, number, Region.CONVERGED)] = V(0.0)
        ws[region(p, number, Region.ACTIVE)] = V(1.0)
        if ti.static(spec.cut):
            mass = ws[moments + number[p.n + Number.EXTRA] * p.stride]
            cut = (mass < V(WHOLE)) & (mass >= V(value[p.v + Value.MIN_MASS]))
            ws[region(p, number, Region.CUT)] = ti.select(cut, V(1.0), V(0.0))

    @ti.func
    def left_out(r: ti.i32, c: ti.i32, p: ti.template(), number: ti.template()) -> ti.i32:
        """Whether a column with an offset is among the two while ``which`` says that these do not count."""
        return ti.cast(
            p.which == 1 and number[p.n + Number.CONSTANT + r] + number[p.n + Number.CONSTANT + c] < 2, ti.i32
        )

    @ti.func
    def scale(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """``A = S J S``, packed, with a ridge; ``which`` = 1: columns with an offset have no part in it."""
        n = number[p.n + Number.N]
        packed, moments = region(p, number, Region.TENSOR), region(p, number, Region.MOMENTS)
        trace = V(0.0)
        for r in range(n):
            for c in range(r + 1):
                factor = value[p.v + Value.SCALE + r] * value[p.v + Value.SCALE + c]
                if r != c and left_out(r, c, p, number) == 1:
                    factor = precise(0.0)
                element = ws[moments + number[p.n + Number.LOWER + tri(r, c)] * p.stride] * factor
                ws[packed + tri(r, c) * p.stride] = element
                if r == c:
                    trace = trace + element
        for r in range(n):
            at = packed + tri(r, r) * p.stride
            ws[at] = ws[at] + trace * value[p.v + Value.RIDGE]
            if left_out(r, r, p, number) == 1:
                ws[at] = ws[at] + trace

    @ti.func
    def factorise(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Factor A, and keep it."""
        n, packed = number[p.n + Number.N], region(p, number, Region.TENSOR)
        small.copy(ws, packed, region(p, number, Region.MATRIX), n * (n + 1) // 2, p.stride)
        small.cholesky(ws, packed, n, -1, p.stride)

    @ti.func
    def least_squares(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """The ordinary least-squares solutions (2.15) become the first vectors, fixed patterns the guards."""
        n, k, flow = number[p.n + Number.N], number[p.n + Number.SOLUTIONS], number[p.n + Number.FLOW]
        block = number[p.n + Number.BLOCK]
        factor, vectors = region(p, number, Region.TENSOR), region(p, number, Region.VECTORS)
        unsolved(p, number, ws)
        for j in range(block):
            for back in range(n):
                r = n - 1 - back
                element = V(0.0)
                if j >= k:
                    element = V(ti.cast((r * (5 + 2 * j) + 3 * j) % 7 - 3, precise) + precise(0.5))
                elif r >= flow:
                    element = V(ti.cast(r - flow == j, precise))
                else:
                    # The rows of the factor below the flow block are -L_ff^T X: one back substitution is left.
                    element = 0.0 - ws[factor + tri(flow + j, r) * p.stride]
                    for m in range(r + 1, flow):
                        one = factor + tri(m, r) * p.stride
                        element = element - ws[one] * ws[vectors + (m * block + j) * p.stride]
                    element = element * ws[factor + tri(r, r) * p.stride]
                ws[vectors + (r * block + j) * p.stride] = element

    @ti.func
    def unsolved(p: ti.template(), number: ti.template(), ws: ti.template()):
        """A new solution is wanted, of the active pixels only."""
        flag = region(p, number, Region.CONVERGED)
        ws[flag] = ti.select(ws[region(p, number, Region.ACTIVE)] > V(0.5), V(0.0), ws[flag])

    @ti.func
    def accept(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Take the vectors as they are: the solution was direct."""
        all_lanes = V(0.0) < V(1.0)
        keep(region(p, number, Region.VECTORS), number[p.n + Number.BLOCK], all_lanes, p, number, ws)

    @ti.func
    def keep(
        source: ti.i32, width: ti.i32, done: ti.template(), p: ti.template(), number: ti.template(), ws: ti.template()
    ):
        """The first vectors [n, width] at ``source`` solve the pixels that are ``done`` and were not before."""
        n, k = number[p.n + Number.N], number[p.n + Number.SOLUTIONS]
        solution, flag = region(p, number, Region.SOLUTION), region(p, number, Region.CONVERGED)
        fresh = done & (ws[flag] < V(0.5))
        for r in range(n):
            for j in range(k):
                at = solution + (r * k + j) * p.stride
                ws[at] = ti.select(fresh, ws[source + (r * width + j) * p.stride], ws[at])
        ws[flag] = ti.select(fresh, V(1.0), ws[flag])

    @ti.func
    def any_left(p: ti.template(), number: ti.template(), ws: ti.template()) -> ti.i32:
        """Whether a pixel of the group has no solution yet."""
        return small.any_lane(ws[region(p, number, Region.CONVERGED)] < V(0.5))

    @ti.func
    def inverse_iteration(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Rounds of block inverse iteration and Rayleigh-Ritz until all have converged.

        A pixel keeps the solution of its first round that is good enough, so it does not depend on its neighbours.
        """
        for _ in range(ROUNDS):
            if any_left(p, number, ws) == 1:
                one_round(p, number, value, ws)

    @ti.func
    def one_round(p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        n, k, block = number[p.n + Number.N], number[p.n + Number.SOLUTIONS], number[p.n + Number.BLOCK]
        stride = p.stride
        factor, vectors = region(p, number, Region.TENSOR), region(p, number, Region.VECTORS)
        images, ritz = region(p, number, Region.IMAGES), region(p, number, Region.RITZ)
        for _ in range(number[p.n + Number.ITERATIONS]):
            small.solve(ws, factor, vectors, n, block, stride)
            for j in range(block):
                own = vectors + j * stride
                for m in range(j + 1):
                    # Minus its share of those before; m = j: to unit length.
                    other = vectors + m * stride
                    overlap = small.dot(ws, other, block, own, block, n, stride)
                    share, length = overlap, V(1.0)
                    if m == j:
                        share, length = V(0.0), 1.0 / ti.sqrt(ti.max(overlap, V(1e-30)))
                    for r in range(n):
                        at = r * block * stride
                        ws[own + at] = (ws[own + at] - share * ws[other + at]) * length
        small.upper_times(ws, factor, vectors, images, n, block, stride)
        for j in range(block):
            for m in range(block):
                product = small.dot(ws, images + j * stride, block, images + m * stride, block, n, stride)
                if j >= n or m >= n:
                    # A block wider than the space: rounding is all that is left for its last vectors.
                    product = V(ti.select(j == m, precise(1e30), precise(0.0)))
                ws[ritz + (j * block + m) * stride] = product
        small.jacobi(ws, ritz, block, RITZ_SWEEPS, stride)
        small.sort_eigen(ws, ritz, block, k, stride)
        turn, work = ritz + block * block * stride, region(p, number, Region.RITZ_WORK)
        small.times_small(ws, vectors, turn, work, n, block, stride)
        small.times_small(ws, images, turn, work, n, block, stride)
        # A v = L (L^T v); its distance from θ v, against the gap to the next Ritz value, bounds the angle left.
        error = V(0.0)
        for j in range(k):
            theta = ws[ritz + (j * block + j) * stride]
            for r in range(n):
                at = (r * block + j) * stride
                rest = ws[images + at] / ws[factor + tri(r, r) * stride] - theta * ws[vectors + at]
                row = factor + tri(r, 0) * stride
                for m in range(r):
                    rest = rest + ws[row + m * stride] * ws[images + (m * block + j) * stride]
                error = error + rest * rest
        following, last = ws[ritz + (k * block + k) * stride], ws[ritz + ((k - 1) * block + k - 1) * stride]
        gap = (following - last) * value[p.v + Value.GAP]
        keep(vectors, block, not (error > gap * gap), p, number, ws)

    @ti.func
    def jacobi(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Full cyclic Jacobi for the pixels that have no solution yet."""
        n, k = number[p.n + Number.N], number[p.n + Number.SOLUTIONS]
        full = region(p, number, Region.FULL)
        if any_left(p, number, ws) == 1:
            small.unpack(ws, region(p, number, Region.MATRIX), full, n, p.stride)
            small.jacobi(ws, full, n, JACOBI_SWEEPS, p.stride)
            small.sort_eigen(ws, full, n, k, p.stride)
            all_lanes = V(0.0) < V(1.0)
            keep(full + n * n * p.stride, n, all_lanes, p, number, ws)

    @ti.func
    def parameters(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Combine the vectors so that one time-like differential is 1 and the others 0 (section 3.3.2).

        ``P = V_f M^-1`` with M [k, k] the time-like rows: one column of M after the other is eliminated in place.
        """
        n, k, flow = number[p.n + Number.N], number[p.n + Number.SOLUTIONS], number[p.n + Number.FLOW]
        vectors, target = region(p, number, Region.SOLUTION), region(p, number, Region.PARAMETERS)
        for r in range(n):
            for c in range(k):
                at = vectors + (r * k + c) * p.stride
                ws[at] = ws[at] * value[p.v + Value.SCALE + r]
        for j in range(k):
            # The largest of row j among the columns that are left becomes its pivot.
            row = vectors + (flow + j) * k * p.stride
            for c in range(j + 1, k):
                larger = small.magnitude(ws[row + c * p.stride]) > small.magnitude(ws[row + j * p.stride])
                for r in range(n):
                    one = vectors + (r * k + j) * p.stride
                    two = vectors + (r * k + c) * p.stride
                    first, second = ws[one], ws[two]
                    ws[one] = ti.select(larger, second, first)
                    ws[two] = ti.select(larger, first, second)
            inverse = 1.0 / ws[row + j * p.stride]
            for c in range(k):
                if c != j:
                    factor = ws[row + c * p.stride] * inverse
                    for r in range(n):
                        at = vectors + r * k * p.stride
                        ws[at + c * p.stride] = ws[at + c * p.stride] - factor * ws[at + j * p.stride]
            for r in range(n):
                at = vectors + (r * k + j) * p.stride
                ws[at] = ws[at] * inverse
        chosen = ws[region(p, number, Region.ACTIVE)] > V(0.5)
        for j in range(k):
            for f in range(flow):
                at = target + (j * flow + f) * p.stride
                ws[at] = ti.select(chosen, ws[vectors + (f * k + j) * p.stride], ws[at])

    @ti.func
    def weighted_noise(
        j: ti.i32, k: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()
    ):
        """``p^T N p`` of solution j, whose scaled entries are column j of the vectors [n, k]."""
        vectors, noise = region(p, number, Region.VECTORS), region(p, number, Region.WEIGHT_NOISE)
        norm = V(0.0)
        for r in range(number[p.n + Number.N]):
            one = ws[vectors + (r * k + j) * p.stride] * value[p.v + Value.SCALE + r]
            for c in range(r + 1):
                both = one * ws[vectors + (c * k + j) * p.stride]
                twice = value[p.v + Value.SCALE + c] * ti.select(r == c, precise(1.0), precise(2.0))
                norm = norm + both * ws[noise + tri(r, c) * p.stride] * twice
        return norm

    @ti.func
    def residuals(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Image noise variance ``p^T J p / p^T C p`` that the residual of each solution amounts to."""
        n, k, flow = number[p.n + Number.N], number[p.n + Number.SOLUTIONS], number[p.n + Number.FLOW]
        vectors, images = region(p, number, Region.VECTORS), region(p, number, Region.IMAGES)
        found = region(p, number, Region.PARAMETERS)
        for j in range(k):
            norm = V(0.0)
            for r in range(n):
                unit = precise(1.0) / value[p.v + Value.SCALE + r]
                element = V(ti.select(r == flow + j, unit, precise(0.0)))
                if r < flow:
                    element = ws[found + (j * flow + r) * p.stride] * unit
                norm = norm + element * element * (value[p.v + Value.NOISE + r] / (unit * unit))
                ws[vectors + (r * k + j) * p.stride] = element
            if ti.static(spec.cut):
                if texture.any_cut(p, number, ws) == 1:
                    cut = ws[region(p, number, Region.CUT)] > V(0.5)
                    norm = ti.select(cut, weighted_noise(j, k, p, number, value, ws), norm)
            elif number[p.n + Number.REWEIGHTED] == 1:
                norm = weighted_noise(j, k, p, number, value, ws)
            ws[region(p, number, Region.VARIANCE) + j * p.stride] = norm
        small.upper_times(ws, region(p, number, Region.TENSOR), vectors, images, n, k, p.stride)
        for j in range(k):
            at = region(p, number, Region.VARIANCE) + j * p.stride
            own = images + j * p.stride
            ws[at] = small.dot(ws, own, k, own, k, n, p.stride) / ws[at]
            if number[p.n + Number.BIASED] == 1:
                keep_bias(j, k, p, number, value, ws)

    @ti.func
    def keep_bias(
        j: ti.i32, k: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()
    ):
        """``S σ² N_ff p``: what noise adds to J_ff, times solution j, whose scaled entries are in VECTORS."""
        flow, noise = number[p.n + Number.FLOW], region(p, number, Region.WEIGHT_NOISE)
        vectors, variance = region(p, number, Region.VECTORS), ws[region(p, number, Region.VARIANCE) + j * p.stride]
        for r in range(flow):
            total = V(0.0)
            for c in range(flow):
                element = V(ti.select(r == c, value[p.v + Value.NOISE + r], precise(0.0)))
                here = noise + tri(ti.max(r, c), ti.min(r, c)) * p.stride
                if ti.static(spec.cut):
                    element = ti.select(ws[region(p, number, Region.CUT)] > V(0.5), ws[here], element)
                elif number[p.n + Number.REWEIGHTED] == 1:
                    element = ws[here]
                total = total + element * ws[vectors + (c * k + j) * p.stride] * value[p.v + Value.SCALE + c]
            at = region(p, number, Region.BIAS) + (j * flow + r) * p.stride
            ws[at] = total * variance * value[p.v + Value.SCALE + r]

    @ti.func
    def centre(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Parameters at the window's centre, see ``identify.at_centre``."""
        found = region(p, number, Region.PARAMETERS)
        for j in range(number[p.n + Number.SOLUTIONS]):
            identify.at_centre(found + j * number[p.n + Number.FLOW] * p.stride, p, number, value, ws)

    return SimpleNamespace(
        load=load,
        scale=scale,
        factorise=factorise,
        least_squares=least_squares,
        accept=accept,
        inverse_iteration=inverse_iteration,
        jacobi=jacobi,
        parameters=parameters,
        residuals=residuals,
        centre=centre,
        keep=keep,
        left_out=left_out,
        unsolved=unsolved,
    )
