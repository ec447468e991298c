"""Small dense matrices, one per lane: functions on a workspace whose innermost index is the lane.

Element ``e`` of group ``g`` and lane ``i`` is ``ws[base + e * stride + i]``. On the CPU ``base = g n_elements
lanes`` and ``stride = lanes``; on a GPU, with one lane, ``base = g`` and ``stride = n_groups``, so that
neighbouring threads read neighbouring words. A lower triangle is packed by rows: element (r, c) at
``r (r + 1) / 2 + c``. Values are loaded into a local vector first and stored in a loop of their own: a loop that
does both on one array is not vectorised.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.spec import KernelSpec


@ti.func
def tri(r: ti.i32, c: ti.i32) -> ti.i32:
    """Position of (r, c), r >= c, in a packed lower triangle."""
    return r * (r + 1) // 2 + c


@functools.cache
def dense(spec: KernelSpec) -> SimpleNamespace:
    """The functions for one precision and number of lanes."""
    precise, lanes = spec.precise, spec.lanes
    tiny = 1e-290 if spec.algebra == "f64" else 1e-36

    @ti.func
    def cholesky(ws: ti.template(), a: ti.i32, n: ti.i32, floor: ti.i32, stride: ti.i32):
        """Factor the packed matrix at ``a`` in place; the diagonal holds the inverse of the factor's diagonal.

        Pivots are at least the element at ``floor``, or a tiny number if that is negative.
        """
        least = ti.Vector.zero(precise, lanes)
        for i in range(lanes):
            least[i] = precise(tiny)
        if floor >= 0:
            for i in range(lanes):
                least[i] = ws[floor + i]
        for c in range(n):
            inverse = ti.Vector.zero(precise, lanes)
            for r in range(c, n):
                total = ti.Vector.zero(precise, lanes)
                at = a + tri(r, c) * stride
                for i in range(lanes):
                    total[i] = ws[at + i]
                for k in range(c):
                    one = a + tri(r, k) * stride
                    two = a + tri(c, k) * stride
                    for i in range(lanes):
                        total[i] -= ws[one + i] * ws[two + i]
                if r == c:
                    for i in range(lanes):
                        inverse[i] = 1.0 / ti.sqrt(ti.max(total[i], least[i]))
                    for i in range(lanes):
                        ws[at + i] = inverse[i]
                else:
                    for i in range(lanes):
                        ws[at + i] = total[i] * inverse[i]

    @ti.func
    def solve(ws: ti.template(), l: ti.i32, x: ti.i32, n: ti.i32, m: ti.i32, stride: ti.i32):
        """``X := (L L^T)^-1 X`` for the factor at ``l`` and X [n, m] at ``x``.

        Forward and backward substitution are one loop over both directions: inlined code is compiled once per call.
        """
        for backward in range(2):
            for step in range(n):
                r = ti.select(backward == 1, n - 1 - step, step)
                first = ti.select(backward == 1, r + 1, 0)
                diagonal = l + tri(r, r) * stride
                for c in range(m):
                    total = ti.Vector.zero(precise, lanes)
                    at = x + (r * m + c) * stride
                    for i in range(lanes):
                        total[i] = ws[at + i]
                    for k in range(first, first + step):
                        one = l + tri(ti.max(r, k), ti.min(r, k)) * stride
                        two = x + (k * m + c) * stride
                        for i in range(lanes):
                            total[i] -= ws[one + i] * ws[two + i]
                    for i in range(lanes):
                        total[i] *= ws[diagonal + i]
                    store(ws, at, total)

    @ti.func
    def sandwich(ws: ti.template(), l: ti.i32, x: ti.i32, n: ti.i32, times: ti.i32, stride: ti.i32):
        """``X := M^-1 X`` once, or ``M^-1 X M^-1`` with ``times`` = 2, for symmetric X [n, n] and the factor of M."""
        always = ti.Vector.one(ti.i32, lanes)
        for _ in range(times):
            solve(ws, l, x, n, n, stride)
            for r in range(n):
                for c in range(r):
                    exchange(ws, x + (r * n + c) * stride, x + (c * n + r) * stride, always)

    @ti.func
    def upper_times(ws: ti.template(), l: ti.i32, x: ti.i32, y: ti.i32, n: ti.i32, m: ti.i32, stride: ti.i32):
        """``Y := L^T X`` for the factor at ``l`` (inverse diagonal), X and Y [n, m]."""
        for r in range(n):
            for c in range(m):
                total = ti.Vector.zero(precise, lanes)
                diagonal = l + tri(r, r) * stride
                own = x + (r * m + c) * stride
                for i in range(lanes):
                    total[i] = ws[own + i] / ws[diagonal + i]
                for k in range(r + 1, n):
                    one = l + tri(k, r) * stride
                    two = x + (k * m + c) * stride
                    for i in range(lanes):
                        total[i] += ws[one + i] * ws[two + i]
                at = y + (r * m + c) * stride
                for i in range(lanes):
                    ws[at + i] = total[i]

    @ti.func
    def symmetric_times(ws: ti.template(), a: ti.i32, x: ti.i32, y: ti.i32, n: ti.i32, m: ti.i32, stride: ti.i32):
        """``Y := A X`` for the packed symmetric matrix at ``a``, X and Y [n, m]."""
        for r in range(n):
            for c in range(m):
                total = ti.Vector.zero(precise, lanes)
                for k in range(n):
                    one = a + tri(ti.max(r, k), ti.min(r, k)) * stride
                    two = x + (k * m + c) * stride
                    for i in range(lanes):
                        total[i] += ws[one + i] * ws[two + i]
                store(ws, y + (r * m + c) * stride, total)

    @ti.func
    def dot(ws: ti.template(), x: ti.i32, xstep: ti.i32, y: ti.i32, ystep: ti.i32, n: ti.i32, stride: ti.i32):
        """``Σ_k X[k xstep] Y[k ystep]`` as a vector over the lanes."""
        total = ti.Vector.zero(precise, lanes)
        for k in range(n):
            one = x + k * xstep * stride
            two = y + k * ystep * stride
            for i in range(lanes):
                total[i] += ws[one + i] * ws[two + i]
        return total

    @ti.func
    def store(ws: ti.template(), at: ti.i32, value: ti.template()):
        """Write one element of every lane."""
        for i in range(lanes):
            ws[at + i] = value[i]

    @ti.func
    def copy(ws: ti.template(), x: ti.i32, y: ti.i32, n: ti.i32, stride: ti.i32):
        """``Y := X`` for n elements."""
        for k in range(n):
            value = ti.Vector.zero(precise, lanes)
            for i in range(lanes):
                value[i] = ws[x + k * stride + i]
            store(ws, y + k * stride, value)

    @ti.func
    def set_identity(ws: ti.template(), x: ti.i32, n: ti.i32, stride: ti.i32):
        """``X := 1`` for X [n, n]."""
        for r in range(n):
            for c in range(n):
                unit = ti.cast(r == c, precise)
                at = x + (r * n + c) * stride
                for i in range(lanes):
                    ws[at + i] = unit

    @ti.func
    def unpack(ws: ti.template(), a: ti.i32, x: ti.i32, n: ti.i32, stride: ti.i32):
        """Square matrix [n, n] at ``x`` from the packed symmetric one at ``a``."""
        for r in range(n):
            for c in range(n):
                copy(ws, a + tri(ti.max(r, c), ti.min(r, c)) * stride, x + (r * n + c) * stride, 1, stride)

    @ti.func
    def jacobi(ws: ti.template(), a: ti.i32, n: ti.i32, sweeps: ti.i32, stride: ti.i32):
        """Cyclic Jacobi: diagonalises the matrix [n, n] at ``a``; V, right behind it, gets the eigenvectors as columns.

        A lane whose off-diagonal element is negligible rotates by nothing, so a lane's result does not depend on its
        neighbours, however many sweeps they need.
        """
        for r in range(n):
            for c in range(n):
                at = a + ((n + r) * n + c) * stride
                unit = ti.cast(r == c, precise)
                for i in range(lanes):
                    ws[at + i] = unit
        active = 1
        for _ in range(sweeps):
            if active == 1:
                active = 0
                for p in range(n - 1):
                    for q in range(p + 1, n):
                        cosine = ti.Vector.zero(precise, lanes)
                        sine = ti.Vector.zero(precise, lanes)
                        turned = ti.Vector.zero(ti.i32, lanes)
                        pp = a + (p * n + p) * stride
                        qq = a + (q * n + q) * stride
                        pq = a + (p * n + q) * stride
                        for i in range(lanes):
                            app = ws[pp + i]
                            aqq = ws[qq + i]
                            apq = ws[pq + i]
                            turned[i] = ti.cast(apq * apq > precise(negligible) * ti.abs(app * aqq), ti.i32)
                            theta = (aqq - app) / ti.select(turned[i] == 1, precise(2.0) * apq, precise(1.0))
                            t = ti.select(theta >= 0, precise(1.0), precise(-1.0)) / (
                                ti.abs(theta) + ti.sqrt(theta * theta + precise(1.0))
                            )
                            t = ti.select(turned[i] == 1, t, precise(0.0))
                            cosine[i] = precise(1.0) / ti.sqrt(t * t + precise(1.0))
                            sine[i] = t * cosine[i]
                        for i in range(lanes):
                            active |= turned[i]
                        for k in range(3 * n):
                            # Columns of A and of V, which lies behind it, then rows of A.
                            one = ti.select(k < 2 * n, k * n + p, p * n + k - 2 * n)
                            two = ti.select(k < 2 * n, k * n + q, q * n + k - 2 * n)
                            rotate(ws, a + one * stride, a + two * stride, cosine, sine)

    negligible = 1e-32 if spec.algebra == "f64" else 1e-15

    @ti.func
    def rotate(ws: ti.template(), one: ti.i32, two: ti.i32, cosine: ti.template(), sine: ti.template()):
        first = ti.Vector.zero(precise, lanes)
        second = ti.Vector.zero(precise, lanes)
        for i in range(lanes):
            first[i] = cosine[i] * ws[one + i] - sine[i] * ws[two + i]
            second[i] = sine[i] * ws[one + i] + cosine[i] * ws[two + i]
        store(ws, one, first)
        store(ws, two, second)

    @ti.func
    def sort_eigen(ws: ti.template(), a: ti.i32, n: ti.i32, k: ti.i32, stride: ti.i32):
        """Bring the k + 1 smallest diagonal elements of [n, n] at ``a``, and their columns of V, to the front."""
        for j in range(ti.min(k + 1, n)):
            for m in range(j + 1, n):
                swap = ti.Vector.zero(ti.i32, lanes)
                one = a + (j * n + j) * stride
                two = a + (m * n + m) * stride
                for i in range(lanes):
                    swap[i] = ti.cast(ws[two + i] < ws[one + i], ti.i32)
                for r in range(n + 1):
                    # The diagonal elements themselves, then the rows of V.
                    left = ti.select(r == n, one, a + ((n + r) * n + j) * stride)
                    right = ti.select(r == n, two, a + ((n + r) * n + m) * stride)
                    exchange(ws, left, right, swap)

    @ti.func
    def exchange(ws: ti.template(), one: ti.i32, two: ti.i32, swap: ti.template()):
        first = ti.Vector.zero(precise, lanes)
        second = ti.Vector.zero(precise, lanes)
        for i in range(lanes):
            first[i] = ti.select(swap[i] == 1, ws[two + i], ws[one + i])
            second[i] = ti.select(swap[i] == 1, ws[one + i], ws[two + i])
        store(ws, one, first)
        store(ws, two, second)

    @ti.func
    def times_small(ws: ti.template(), x: ti.i32, q: ti.i32, n: ti.i32, m: ti.template(), stride: ti.i32):
        """``X := X Q`` for X [n, m] and Q [m, m]; ``m`` is a compile-time number."""
        for r in range(n):
            row = ti.Matrix.zero(precise, m, lanes)
            for c in range(m):
                for k in range(m):
                    one = x + (r * m + k) * stride
                    two = q + (k * m + c) * stride
                    for i in range(lanes):
                        row[c, i] += ws[one + i] * ws[two + i]
            for c in range(m):
                at = x + (r * m + c) * stride
                for i in range(lanes):
                    ws[at + i] = row[c, i]

    return SimpleNamespace(
        copy=copy,
        set_identity=set_identity,
        unpack=unpack,
        sandwich=sandwich,
        sort_eigen=sort_eigen,
        times_small=times_small,
        cholesky=cholesky,
        solve=solve,
        upper_times=upper_times,
        symmetric_times=symmetric_times,
        dot=dot,
        store=store,
        jacobi=jacobi,
    )
