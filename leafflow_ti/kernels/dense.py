"""Small dense matrices, one per lane: functions on a workspace whose elements are vectors over the lanes.

Element ``e`` of a group is ``ws[base + e * stride]``. On the CPU ``stride = 1``; on a GPU, with one lane, ``base`` is
the group and ``stride`` the number of groups, so that neighbouring threads read neighbouring words. A lower triangle
is packed by rows: element (r, c) at ``r (r + 1) / 2 + c``.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.spec import KernelSpec


@ti.func
def tri(r: ti.i32, c: ti.i32) -> ti.i32:
    """Position of (r, c), r >= c, in a packed lower triangle."""
    return (r * (r + 1) >> 1) + c


@functools.cache
def dense(spec: KernelSpec) -> SimpleNamespace:
    """The functions for one precision and number of lanes."""
    precise, lanes, V = spec.precise, spec.lanes, spec.element
    tiny = 1e-290 if spec.algebra == "f64" else 1e-36
    negligible = 1e-32 if spec.algebra == "f64" else 1e-15

    @ti.func
    def any_lane(mask: ti.template()) -> ti.i32:
        """Whether a condition holds in a lane."""
        flag = ti.select(mask, V(1.0), V(0.0))
        largest = precise(0.0)
        if ti.static(lanes > 1):  # noqa: SIM108 - the engine decides between statements only
            largest = flag.max()
        else:
            largest = flag
        return ti.cast(largest > 0.5, ti.i32)

    @ti.func
    def magnitude(x: ti.template()):
        """``|x|``: the engine has it for numbers only."""
        return ti.max(x, 0.0 - x)

    @ti.func
    def cholesky(ws: ti.template(), a: ti.i32, n: ti.i32, floor: ti.i32, stride: ti.i32):
        """Factor the packed matrix at ``a`` in place; the diagonal holds the inverse of the factor's diagonal.

        Pivots are at least the element at ``floor``, or a tiny number if that is negative.
        """
        least = V(tiny)
        if floor >= 0:
            least = ws[floor]
        for c in range(n):
            inverse = V(0.0)
            column = a + tri(c, 0) * stride
            for r in range(c, n):
                row = a + tri(r, 0) * stride
                total = ws[row + c * stride]
                for k in range(c):
                    total = total - ws[row + k * stride] * ws[column + k * stride]
                if r == c:
                    inverse = 1.0 / ti.sqrt(ti.max(total, least))
                    ws[row + c * stride] = inverse
                else:
                    ws[row + c * stride] = total * inverse

    @ti.func
    def solve(ws: ti.template(), l: ti.i32, x: ti.i32, n: ti.i32, m: ti.i32, stride: ti.i32):
        """``X := (L L^T)^-1 X`` for the factor at ``l`` and X [n, m] at ``x``."""
        substitute(ws, l, x, n, m, 0, 2, stride)

    @ti.func
    def substitute(
        ws: ti.template(), l: ti.i32, x: ti.i32, n: ti.i32, m: ti.i32, begin: ti.i32, end: ti.i32, stride: ti.i32
    ):
        """Directions ``begin`` to ``end - 1`` of: forward (0) ``X := L^-1 X``, backward (1) ``X := L^-T X``.

        Both are one loop over the directions: inlined code is compiled once per call.
        Here and below columns go in pairs (an odd last one twice): two sums at a time hide each other's latency.
        """
        for backward in range(begin, end):
            for step in range(n):
                r = ti.select(backward == 1, n - 1 - step, step)
                first = ti.select(backward == 1, r + 1, 0)
                start = ti.select(backward == 1, tri(r + 1, r), tri(r, 0))
                inverse = ws[l + tri(r, r) * stride]
                for pair in range((m + 1) // 2):
                    here = x + (r * m + 2 * pair) * stride
                    beside = ti.select(2 * pair + 1 < m, stride, 0)
                    one, two = ws[here], ws[here + beside]
                    place = start  # along row r of the factor, or down its column r
                    for k in range(first, first + step):
                        factor, at = ws[l + place * stride], x + (k * m + 2 * pair) * stride
                        one = one - factor * ws[at]
                        two = two - factor * ws[at + beside]
                        place += ti.select(backward == 1, k + 1, 1)
                    ws[here] = one * inverse
                    ws[here + beside] = two * inverse

    @ti.func
    def sandwich(ws: ti.template(), l: ti.i32, x: ti.i32, n: ti.i32, times: ti.i32, stride: ti.i32):
        """``X := M^-1 X`` once, or ``M^-1 X M^-1`` with ``times`` = 2, for symmetric X [n, n] and the factor of M."""
        for _ in range(times):
            solve(ws, l, x, n, n, stride)
            transpose(ws, x, n, stride)

    @ti.func
    def transpose(ws: ti.template(), x: ti.i32, n: ti.i32, stride: ti.i32):
        """``X := X^T`` for X [n, n]."""
        for r in range(n):
            for c in range(r):
                one, two = x + (r * n + c) * stride, x + (c * n + r) * stride
                kept = ws[one]
                ws[one] = ws[two]
                ws[two] = kept

    @ti.func
    def upper_times(ws: ti.template(), l: ti.i32, x: ti.i32, y: ti.i32, n: ti.i32, m: ti.i32, stride: ti.i32):
        """``Y := L^T X`` for the factor at ``l`` (inverse diagonal), X and Y [n, m]."""
        for r in range(n):
            diagonal = 1.0 / ws[l + tri(r, r) * stride]
            for c in range(m):
                total = ws[x + (r * m + c) * stride] * diagonal
                one = tri(r + 1, r)
                for k in range(r + 1, n):
                    total = total + ws[l + one * stride] * ws[x + (k * m + c) * stride]
                    one += k + 1
                ws[y + (r * m + c) * stride] = total

    @ti.func
    def symmetric_times(ws: ti.template(), a: ti.i32, x: ti.i32, y: ti.i32, n: ti.i32, m: ti.i32, stride: ti.i32):
        """``Y := A X`` for the packed symmetric matrix at ``a``, X and Y [n, m]."""
        for r in range(n):
            for pair in range((m + 1) // 2):
                beside = ti.select(2 * pair + 1 < m, stride, 0)
                one, two = V(0.0), V(0.0)
                place = tri(r, 0)  # along row r up to the diagonal, then down column r
                for k in range(n):
                    factor, at = ws[a + place * stride], x + (k * m + 2 * pair) * stride
                    one = one + factor * ws[at]
                    two = two + factor * ws[at + beside]
                    place += ti.select(k < r, 1, k + 1)
                here = y + (r * m + 2 * pair) * stride
                ws[here] = one
                ws[here + beside] = two

    @ti.func
    def add_product(
        ws: ti.template(), x: ti.i32, rows: ti.i32, y: ti.i32, cols: ti.i32, n: ti.i32, lower: ti.i32, z: ti.i32,
        scale: ti.template(), stride: ti.i32,
    ):  # fmt: skip
        """``Z += scale X^T Y`` for X [n, rows], Y [n, cols], Z [rows, cols]; ``lower``: of a symmetric Z the lower
        triangle (and what stands beside it)."""
        for r in range(rows):
            used = ti.select(lower == 1, r + 1, cols)
            for pair in range((used + 1) // 2):
                beside = ti.select(2 * pair + 1 < cols, stride, 0)
                one, two = V(0.0), V(0.0)
                for k in range(n):
                    factor, at = ws[x + (k * rows + r) * stride], y + (k * cols + 2 * pair) * stride
                    one = one + factor * ws[at]
                    two = two + factor * ws[at + beside]
                here = z + (r * cols + 2 * pair) * stride
                ws[here] = ws[here] + one * scale
                if beside > 0:
                    ws[here + stride] = ws[here + stride] + two * scale

    @ti.func
    def dot(ws: ti.template(), x: ti.i32, xstep: ti.i32, y: ti.i32, ystep: ti.i32, n: ti.i32, stride: ti.i32):
        """``Σ_k X[k xstep] Y[k ystep]`` as a vector over the lanes."""
        total = V(0.0)
        for k in range(n):
            total = total + ws[x + k * xstep * stride] * ws[y + k * ystep * stride]
        return total

    @ti.func
    def copy(ws: ti.template(), x: ti.i32, y: ti.i32, n: ti.i32, stride: ti.i32):
        """``Y := X`` for n elements."""
        for k in range(n):
            ws[y + k * stride] = ws[x + k * stride]

    @ti.func
    def clear(ws: ti.template(), x: ti.i32, n: ti.i32, stride: ti.i32):
        """``X := 0`` for n elements."""
        for k in range(n):
            ws[x + k * stride] = V(0.0)

    @ti.func
    def set_identity(ws: ti.template(), x: ti.i32, n: ti.i32, stride: ti.i32):
        """``X := 1`` for X [n, n]."""
        for r in range(n):
            for c in range(n):
                ws[x + (r * n + c) * stride] = V(ti.cast(r == c, precise))

    @ti.func
    def unpack(ws: ti.template(), a: ti.i32, x: ti.i32, n: ti.i32, stride: ti.i32):
        """Square matrix [n, n] at ``x`` from the packed symmetric one at ``a``."""
        for r in range(n):
            for c in range(n):
                ws[x + (r * n + c) * stride] = ws[a + tri(ti.max(r, c), ti.min(r, c)) * stride]

    @ti.func
    def jacobi(ws: ti.template(), a: ti.i32, n: ti.i32, sweeps: ti.i32, stride: ti.i32):
        """Cyclic Jacobi: diagonalises the matrix [n, n] at ``a``; V, right behind it, gets the eigenvectors as columns.

        A lane whose off-diagonal element is negligible rotates by nothing, so a lane's result does not depend on its
        neighbours, however many sweeps they need.
        """
        set_identity(ws, a + n * n * stride, n, stride)
        active = 1
        for _ in range(sweeps):
            if active == 1:
                active = 0
                for p in range(n - 1):
                    for q in range(p + 1, n):
                        app = ws[a + (p * n + p) * stride]
                        aqq = ws[a + (q * n + q) * stride]
                        apq = ws[a + (p * n + q) * stride]
                        turned = apq * apq > magnitude(app * aqq) * precise(negligible)
                        if any_lane(turned) == 1:
                            active = 1
                            theta = (aqq - app) / ti.select(turned, apq * 2.0, V(1.0))
                            t = 1.0 / (magnitude(theta) + ti.sqrt(theta * theta + 1.0))
                            t = ti.select(turned, ti.select(theta >= V(0.0), t, 0.0 - t), V(0.0))
                            cosine = 1.0 / ti.sqrt(t * t + 1.0)
                            sine = t * cosine
                            for k in range(3 * n):
                                # Columns of A and of V, which lies behind it, then rows of A.
                                one = a + ti.select(k < 2 * n, k * n + p, p * n + k - 2 * n) * stride
                                two = a + ti.select(k < 2 * n, k * n + q, q * n + k - 2 * n) * stride
                                first, second = ws[one], ws[two]
                                ws[one] = cosine * first - sine * second
                                ws[two] = sine * first + cosine * second

    @ti.func
    def sort_eigen(ws: ti.template(), a: ti.i32, n: ti.i32, k: ti.i32, stride: ti.i32):
        """Bring the k + 1 smallest diagonal elements of [n, n] at ``a``, and their columns of V, to the front."""
        for j in range(ti.min(k + 1, n)):
            for m in range(j + 1, n):
                one = a + (j * n + j) * stride
                two = a + (m * n + m) * stride
                swap = ws[two] < ws[one]
                for r in range(n + 1):
                    # The diagonal elements themselves come last, behind the rows of V.
                    left = ti.select(r == n, one, a + ((n + r) * n + j) * stride)
                    right = ti.select(r == n, two, a + ((n + r) * n + m) * stride)
                    first, second = ws[left], ws[right]
                    ws[left] = ti.select(swap, second, first)
                    ws[right] = ti.select(swap, first, second)

    @ti.func
    def times_small(ws: ti.template(), x: ti.i32, q: ti.i32, work: ti.i32, n: ti.i32, m: ti.i32, stride: ti.i32):
        """``X := X Q`` for X [n, m] and Q [m, m]; ``work``: room for m elements."""
        for r in range(n):
            row = x + r * m * stride
            for c in range(m):
                ws[work + c * stride] = dot(ws, row, 1, q + c * stride, m, m, stride)
            copy(ws, work, row, m, stride)

    return SimpleNamespace(
        any_lane=any_lane,
        magnitude=magnitude,
        copy=copy,
        clear=clear,
        set_identity=set_identity,
        unpack=unpack,
        sandwich=sandwich,
        sort_eigen=sort_eigen,
        times_small=times_small,
        cholesky=cholesky,
        solve=solve,
        substitute=substitute,
        transpose=transpose,
        upper_times=upper_times,
        symmetric_times=symmetric_times,
        add_product=add_product,
        dot=dot,
        jacobi=jacobi,
    )
