"""From the packed structure tensor to the flow parameters of every solution.

All work is on the scaled tensor ``A = S J S``; with S = C^-1/2 its smallest eigenvectors solve the equilibrated
total least-squares problem, with S = 1 the plain one (2.17). One Cholesky factor serves the least-squares solution
(2.15), the inverse iteration that starts from it, and the residuals.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import BLOCK, Number, Region, Value, batch_kernel

JACOBI_SWEEPS = 16
RITZ_SWEEPS = 8
ROUNDS = 4


@functools.cache
def null_space_kernels(spec: KernelSpec) -> SimpleNamespace:
    """The stages ``load``, ``least_squares``, ``factorise``, ``accept``, ``inverse_iteration``, ``jacobi``,
    ``parameters``, ``residuals`` and ``centre``."""
    precise, lanes = spec.precise, spec.lanes
    small = dense(spec)

    @ti.func
    def load(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """``A = S J S``, packed, with a ridge."""
        n = number[Number.N]
        packed = base + number[Region.TENSOR] * stride
        trace = ti.Vector.zero(precise, lanes)
        for r in range(n):
            for c in range(r + 1):
                begin = number[Number.LOWER + tri(r, c)] * n_pixels + pixel
                s = value[Value.SCALE + r] * value[Value.SCALE + c]
                element = ti.Vector.zero(precise, lanes)
                for i in range(lanes):
                    element[i] = ti.cast(J[begin + i], precise) * s
                small.store(ws, packed + tri(r, c) * stride, element)
                if r == c:
                    for i in range(lanes):
                        trace[i] += element[i]
        for r in range(n):
            at = packed + tri(r, r) * stride
            element = ti.Vector.zero(precise, lanes)
            for i in range(lanes):
                element[i] = ws[at + i] + value[Value.RIDGE] * trace[i]
            small.store(ws, at, element)

    @ti.func
    def least_squares(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Factor A; the ordinary least-squares solutions (2.15) become the first vectors, fixed patterns the guards."""
        n, k, flow = number[Number.N], number[Number.SOLUTIONS], number[Number.FLOW]
        factor = base + number[Region.TENSOR] * stride
        vectors = base + number[Region.VECTORS] * stride
        small.cholesky(ws, factor, n, -1, stride)
        for i in range(lanes):
            ws[base + number[Region.CONVERGED] * stride + i] = precise(0.0)
        for j in range(BLOCK):
            for back in range(n):
                r = n - 1 - back
                at = vectors + (r * BLOCK + j) * stride
                element = ti.Vector.zero(precise, lanes)
                if r >= flow or j >= k:
                    start = ti.cast(r - flow == j, precise)
                    if j >= k:
                        start = ti.cast((r * (5 + 2 * j) + 3 * j) % 7 - 3, precise) + precise(0.5)
                    for i in range(lanes):
                        element[i] = start
                else:
                    # The rows of the factor below the flow block are -L_ff^T X: one back substitution is left.
                    row = factor + tri(flow + j, r) * stride
                    for i in range(lanes):
                        element[i] = -ws[row + i]
                    for m in range(r + 1, flow):
                        one = factor + tri(m, r) * stride
                        two = vectors + (m * BLOCK + j) * stride
                        for i in range(lanes):
                            element[i] -= ws[one + i] * ws[two + i]
                    diagonal = factor + tri(r, r) * stride
                    for i in range(lanes):
                        element[i] *= ws[diagonal + i]
                small.store(ws, at, element)

    @ti.func
    def factorise(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Factor A alone."""
        small.cholesky(ws, base + number[Region.TENSOR] * stride, number[Number.N], -1, stride)

    @ti.func
    def accept(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Take the vectors as they are: the solution was direct."""
        done = ti.Vector.zero(precise, lanes)
        for i in range(lanes):
            done[i] = 1.0
        keep(base, base + number[Region.VECTORS] * stride, BLOCK, stride, done, number, ws)

    @ti.func
    def keep(
        base: ti.i32, source: ti.i32, width: ti.i32, stride: ti.i32,
        done: ti.template(), number: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """The first vectors [n, width] at ``source`` solve the pixels that are ``done`` and were not before."""
        n, k = number[Number.N], number[Number.SOLUTIONS]
        solution = base + number[Region.SOLUTION] * stride
        flag = base + number[Region.CONVERGED] * stride
        fresh = ti.Vector.zero(precise, lanes)
        for i in range(lanes):
            fresh[i] = done[i] * (1.0 - ws[flag + i])
        for r in range(n):
            for j in range(k):
                at = solution + (r * k + j) * stride
                one = source + (r * width + j) * stride
                element = ti.Vector.zero(precise, lanes)
                for i in range(lanes):
                    element[i] = ti.select(fresh[i] > 0.5, ws[one + i], ws[at + i])
                small.store(ws, at, element)
        for i in range(lanes):
            fresh[i] += ws[flag + i]
        small.store(ws, flag, fresh)

    @ti.func
    def any_left(base: ti.i32, stride: ti.i32, number: ti.template(), ws: ti.template()) -> ti.i32:
        """Whether a pixel of the group has no solution yet."""
        left = 0
        for i in range(lanes):
            left |= ti.cast(ws[base + number[Region.CONVERGED] * stride + i] < 0.5, ti.i32)
        return left

    @ti.func
    def inverse_iteration(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Rounds of block inverse iteration and Rayleigh-Ritz until all have converged.

        A pixel keeps the solution of its first round that is good enough, so it does not depend on its neighbours.
        """
        for _ in range(ROUNDS):
            if any_left(base, stride, number, ws) == 1:
                one_round(base, stride, number, value, ws)

    @ti.func
    def one_round(base: ti.i32, stride: ti.i32, number: ti.template(), value: ti.template(), ws: ti.template()):
        n, k = number[Number.N], number[Number.SOLUTIONS]
        factor = base + number[Region.TENSOR] * stride
        vectors = base + number[Region.VECTORS] * stride
        images = base + number[Region.IMAGES] * stride
        ritz = base + number[Region.RITZ] * stride
        turn = base + number[Region.RITZ_VECTORS] * stride
        for _ in range(number[Number.ITERATIONS]):
            small.solve(ws, factor, vectors, n, BLOCK, stride)
            for j in range(BLOCK):
                for m in range(j):
                    overlap = small.dot(ws, vectors + m * stride, BLOCK, vectors + j * stride, BLOCK, n, stride)
                    for r in range(n):
                        one = vectors + (r * BLOCK + m) * stride
                        two = vectors + (r * BLOCK + j) * stride
                        element = ti.Vector.zero(precise, lanes)
                        for i in range(lanes):
                            element[i] = ws[two + i] - overlap[i] * ws[one + i]
                        small.store(ws, two, element)
                norm = small.dot(ws, vectors + j * stride, BLOCK, vectors + j * stride, BLOCK, n, stride)
                for i in range(lanes):
                    norm[i] = 1.0 / ti.sqrt(ti.max(norm[i], precise(1e-30)))
                for r in range(n):
                    at = vectors + (r * BLOCK + j) * stride
                    element = ti.Vector.zero(precise, lanes)
                    for i in range(lanes):
                        element[i] = ws[at + i] * norm[i]
                    small.store(ws, at, element)
        small.upper_times(ws, factor, vectors, images, n, BLOCK, stride)
        for j in range(BLOCK):
            for m in range(BLOCK):
                product = small.dot(ws, images + j * stride, BLOCK, images + m * stride, BLOCK, n, stride)
                if j >= n or m >= n:
                    # A block wider than the space: rounding is all that is left for its last vectors.
                    for i in range(lanes):
                        product[i] = ti.select(j == m, precise(1e30), precise(0.0))
                small.store(ws, ritz + (j * BLOCK + m) * stride, product)
        small.jacobi(ws, ritz, BLOCK, RITZ_SWEEPS, stride)
        small.sort_eigen(ws, ritz, BLOCK, k, stride)
        small.times_small(ws, vectors, turn, 2 * n, BLOCK, stride)  # and the images, which lie behind
        # A v = L (L^T v); its distance from θ v, against the gap to the next Ritz value, bounds the angle left.
        error = ti.Vector.zero(precise, lanes)
        for j in range(k):
            theta = ritz + (j * BLOCK + j) * stride
            for r in range(n):
                diagonal = factor + tri(r, r) * stride
                own = images + (r * BLOCK + j) * stride
                rest = vectors + (r * BLOCK + j) * stride
                element = ti.Vector.zero(precise, lanes)
                for i in range(lanes):
                    element[i] = ws[own + i] / ws[diagonal + i] - ws[theta + i] * ws[rest + i]
                for m in range(r):
                    one = factor + tri(r, m) * stride
                    two = images + (m * BLOCK + j) * stride
                    for i in range(lanes):
                        element[i] += ws[one + i] * ws[two + i]
                for i in range(lanes):
                    error[i] += element[i] * element[i]
        last = ritz + ((k - 1) * BLOCK + k - 1) * stride
        following = ritz + (k * BLOCK + k) * stride
        done = ti.Vector.zero(precise, lanes)
        for i in range(lanes):
            gap = (ws[following + i] - ws[last + i]) * value[Value.GAP]
            done[i] = ti.cast(not error[i] > gap * gap, precise)
        keep(base, vectors, BLOCK, stride, done, number, ws)

    @ti.func
    def jacobi(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Full cyclic Jacobi for the pixels that have no solution yet."""
        n, k = number[Number.N], number[Number.SOLUTIONS]
        full = base + number[Region.FULL] * stride
        if any_left(base, stride, number, ws) == 1:
            for r in range(n):
                for c in range(n):
                    begin = number[Number.LOWER + tri(ti.max(r, c), ti.min(r, c))] * n_pixels + pixel
                    s = value[Value.SCALE + r] * value[Value.SCALE + c]
                    element = ti.Vector.zero(precise, lanes)
                    for i in range(lanes):
                        element[i] = ti.cast(J[begin + i], precise) * s
                    small.store(ws, full + (r * n + c) * stride, element)
            small.jacobi(ws, full, n, JACOBI_SWEEPS, stride)
            small.sort_eigen(ws, full, n, k, stride)
            done = ti.Vector.zero(precise, lanes)
            for i in range(lanes):
                done[i] = 1.0
            keep(base, base + number[Region.FULL_VECTORS] * stride, n, stride, done, number, ws)

    @ti.func
    def parameters(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Combine the vectors so that one time-like differential is 1 and the others 0 (section 3.3.2)."""
        k, flow = number[Number.SOLUTIONS], number[Number.FLOW]
        vectors = base + number[Region.SOLUTION] * stride
        target = base + number[Region.PARAMETERS] * stride
        for i in range(lanes):
            m = ti.Matrix.identity(precise, 3)
            for r in ti.static(range(3)):
                for c in ti.static(range(3)):
                    if r < k and c < k:
                        m[r, c] = ws[vectors + ((flow + r) * k + c) * stride + i] * value[Value.SCALE + flow + r]
            inverse = m.inverse()
            for f in range(flow):
                v = ti.Vector.zero(precise, 3)
                for c in ti.static(range(3)):
                    if c < k:
                        v[c] = ws[vectors + (f * k + c) * stride + i] * value[Value.SCALE + f]
                for j in ti.static(range(3)):
                    if j < k:
                        p = v[0] * inverse[0, j] + v[1] * inverse[1, j] + v[2] * inverse[2, j]
                        ws[target + (j * flow + f) * stride + i] = p

    @ti.func
    def residuals(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Image noise variance ``p^T J p / p^T C p`` that the residual of each solution amounts to."""
        n, k, flow = number[Number.N], number[Number.SOLUTIONS], number[Number.FLOW]
        factor = base + number[Region.TENSOR] * stride
        vectors = base + number[Region.VECTORS] * stride
        images = base + number[Region.IMAGES] * stride
        for j in range(BLOCK):
            norm = ti.Vector.zero(precise, lanes)
            for r in range(n):
                element = ti.Vector.zero(precise, lanes)
                if j < k and r < flow:
                    at = base + (number[Region.PARAMETERS] + j * flow + r) * stride
                    for i in range(lanes):
                        element[i] = ws[at + i] / value[Value.SCALE + r]
                elif j < k and r == flow + j:
                    for i in range(lanes):
                        element[i] = 1.0 / value[Value.SCALE + r]
                noise = value[Value.NOISE + r] * value[Value.SCALE + r] * value[Value.SCALE + r]
                for i in range(lanes):
                    norm[i] += noise * element[i] * element[i]
                small.store(ws, vectors + (r * BLOCK + j) * stride, element)
            if j < k:
                small.store(ws, base + (number[Region.VARIANCE] + j) * stride, norm)
        small.upper_times(ws, factor, vectors, images, n, BLOCK, stride)
        for j in range(k):
            energy = small.dot(ws, images + j * stride, BLOCK, images + j * stride, BLOCK, n, stride)
            at = base + (number[Region.VARIANCE] + j) * stride
            for i in range(lanes):
                energy[i] /= ws[at + i]
            small.store(ws, at, energy)

    @ti.func
    def centre(
        base: ti.i32, pixel: ti.i32, stride: ti.i32, n_pixels: ti.i32, which: ti.i32,
        number: ti.template(), value: ti.template(), J: ti.template(), ws: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Parameters of constants become values at the window's centre, where centred squares are not 0."""
        for j in range(number[Number.SOLUTIONS]):
            first = base + (number[Region.PARAMETERS] + j * number[Number.FLOW]) * stride
            for term in range(number[Number.CENTRE_TERMS]):
                at = first + number[Number.CENTRE + 2 * term] * stride
                square = first + number[Number.CENTRE + 2 * term + 1] * stride
                for i in range(lanes):
                    ws[at + i] += value[Value.CENTRE + term] * ws[square + i]

    stages = (load, least_squares, factorise, accept, inverse_iteration, jacobi, parameters, residuals, centre)
    return SimpleNamespace(**{f.__name__: batch_kernel(spec, f) for f in stages})
