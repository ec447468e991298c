"""Eigenvalues and eigenvectors of batches of small symmetric matrices, one matrix per lane.

A matrix is made tridiagonal by Householder reflections, and that diagonalised by the implicit QL method (Wilkinson and
Reinsch 1971, II/3); cyclic Jacobi is there as its proof. A lane's result never depends on its neighbours.
"""

import functools

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import lane_kernel, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec

QL_ROUNDS = 40
JACOBI_SWEEPS = 16


def room_of(n: int) -> int:
    """Elements of work space that one group takes."""
    return 2 * n * n + 3 * n


@functools.cache
def eigen_kernel(spec: KernelSpec, jacobi: bool):
    """``values[g, j]``, ascending, and ``vectors[g, r, j]``, j < k, of the packed matrices ``packed[g, tri(r, c)]``,
    whose largest entries are near 1. ``wanted`` = 0: without the vectors. ``jacobi``: by cyclic Jacobi."""
    precise, lanes, V = spec.precise, spec.lanes, spec.element
    small = dense(spec)
    epsilon = 1e-16 if spec.algebra == "f64" else 6e-8
    smallest = 1e-300 if spec.algebra == "f64" else 1e-36

    @ti.func
    def tridiagonal(ws: ti.template(), a: ti.i32, d: ti.i32, n: ti.i32, wanted: ti.i32, stride: ti.i32):
        """``A = Q T Q^T``: d and e (behind d) get T's diagonals; Q^T stands behind A [n, n]."""
        e, w, q = d + n * stride, d + 2 * n * stride, a + n * n * stride
        for c in range(n - 1):
            tail = V(0.0)
            for r in range(c + 2, n):
                tail = tail + ws[a + (r * n + c) * stride] * ws[a + (r * n + c) * stride]
            first = ws[a + ((c + 1) * n + c) * stride]
            turned = tail > V(smallest)
            length = ti.sqrt(first * first + tail)
            alpha = ti.select(turned, ti.select(first > V(0.0), 0.0 - length, length), first)
            head = first - alpha
            beta = ti.select(turned, 2.0 / ti.select(turned, head * head + tail, V(1.0)), V(0.0))
            ws[e + c * stride] = alpha
            ws[a + ((c + 1) * n + c) * stride] = head
            ws[a + (c * n + n - 1) * stride] = beta  # the upper triangle is free; c < n - 1
            along = V(0.0)
            for r in range(c + 1, n):
                total = V(0.0)
                for k in range(c + 1, n):
                    at = a + (ti.max(r, k) * n + ti.min(r, k)) * stride
                    total = total + ws[at] * ws[a + (k * n + c) * stride]
                ws[w + r * stride] = total * beta
                along = along + total * beta * ws[a + (r * n + c) * stride]
            along = along * beta * 0.5
            for r in range(c + 1, n):
                ws[w + r * stride] = ws[w + r * stride] - along * ws[a + (r * n + c) * stride]
            for r in range(c + 1, n):
                v, x = ws[a + (r * n + c) * stride], ws[w + r * stride]
                for k in range(c + 1, r + 1):
                    at = a + (r * n + k) * stride
                    ws[at] = ws[at] - v * ws[w + k * stride] - x * ws[a + (k * n + c) * stride]
        for r in range(n):
            ws[d + r * stride] = ws[a + (r * n + r) * stride]
        ws[e + (n - 1) * stride] = V(0.0)
        if wanted == 1:
            small.set_identity(ws, q, n, stride)
            for back in range(n - 1):
                c = n - 2 - back
                beta = ws[a + (c * n + n - 1) * stride]
                for j in range(c + 1, n):
                    total = V(0.0)
                    for r in range(c + 1, n):
                        total = total + ws[a + (r * n + c) * stride] * ws[q + (j * n + r) * stride]
                    total = total * beta
                    for r in range(c + 1, n):
                        at = q + (j * n + r) * stride
                        ws[at] = ws[at] - total * ws[a + (r * n + c) * stride]

    @ti.func
    def implicit_ql(ws: ti.template(), q: ti.i32, d: ti.i32, n: ti.i32, wanted: ti.i32, stride: ti.i32):
        """Diagonalise T; the rows of Q^T become the eigenvectors. Each lane splits T where its own e is negligible."""
        e = d + n * stride
        for l in range(n - 1):
            busy = 1
            for _ in range(QL_ROUNDS):
                if busy == 1:
                    # The first negligible e from l on ends the lane's block: end[lane], and d there.
                    end, last = V(ti.cast(n - 1, precise)), ws[d + (n - 1) * stride]
                    for back in range(n - 1 - l):
                        m = n - 2 - back
                        here = ws[d + m * stride]
                        size = small.magnitude(here) + small.magnitude(ws[d + (m + 1) * stride])
                        cut = small.magnitude(ws[e + m * stride]) <= size * precise(epsilon) + precise(epsilon * 1e-3)
                        end = ti.select(cut, V(ti.cast(m, precise)), end)
                        last = ti.select(cut, here, last)
                    active = end > V(ti.cast(l, precise))
                    busy = small.any_lane(active)
                    if busy == 1:
                        one_chase(ws, q, d, e, l, n, wanted, end, last, active, stride)

    @ti.func
    def one_chase(
        ws: ti.template(), q: ti.i32, d: ti.i32, e: ti.i32, l: ti.i32, n: ti.i32, wanted: ti.i32, end: ti.template(),
        last: ti.template(), active: ti.template(), stride: ti.i32,
    ):  # fmt: skip
        """One implicit step with Wilkinson's shift, from every active lane's ``end`` up to l."""
        first, beside = ws[d + l * stride], ti.select(active, ws[e + l * stride], V(1.0))
        g = (ws[d + (l + 1) * stride] - first) / (beside * 2.0)
        root = ti.sqrt(g * g + 1.0)
        g = last - first + beside / (g + ti.select(g >= V(0.0), root, 0.0 - root))
        s, c, p = V(1.0), V(1.0), V(0.0)
        alive = ti.select(active, V(1.0), V(0.0))
        for back in range(n - 1 - l):
            i = n - 2 - back
            inside = (V(ti.cast(i, precise)) < end) & (alive > V(0.5))
            if small.any_lane(inside) == 1:
                f, b = s * ws[e + i * stride], c * ws[e + i * stride]
                r = ti.sqrt(f * f + g * g)
                gone = r <= V(0.0)
                on = inside & (r > V(0.0))
                ws[e + (i + 1) * stride] = ti.select(inside, r, ws[e + (i + 1) * stride])
                below = ws[d + (i + 1) * stride]
                inverse = 1.0 / ti.select(on, r, V(1.0))
                s, c = ti.select(on, f * inverse, s), ti.select(on, g * inverse, c)
                moved = below - p
                step = (ws[d + i * stride] - moved) * s + c * b * 2.0
                after = s * step
                ws[d + (i + 1) * stride] = ti.select(on, moved + after, ti.select(inside, moved, below))
                p = ti.select(on, after, p)
                g = ti.select(on, c * step - b, g)
                alive = ti.select(inside & gone, V(0.0), alive)
                if wanted == 1:
                    sine, cosine = ti.select(on, s, V(0.0)), ti.select(on, c, V(1.0))
                    for k in range(n):
                        upper, lower = q + (i * n + k) * stride, q + ((i + 1) * n + k) * stride
                        one, two = ws[upper], ws[lower]
                        ws[lower] = sine * one + cosine * two
                        ws[upper] = cosine * one - sine * two
        done = alive > V(0.5)
        ws[d + l * stride] = ti.select(done, ws[d + l * stride] - p, ws[d + l * stride])
        ws[e + l * stride] = ti.select(done, g, ws[e + l * stride])
        for m in range(l + 1, n):
            ended = active & (end > V(ti.cast(m, precise) - 0.5)) & (end < V(ti.cast(m, precise) + 0.5))
            ws[e + m * stride] = ti.select(ended, V(0.0), ws[e + m * stride])

    @ti.func
    def sort(ws: ti.template(), q: ti.i32, d: ti.i32, n: ti.i32, k: ti.i32, wanted: ti.i32, stride: ti.i32):
        """The k smallest values, and their rows of Q^T, to the front in ascending order."""
        for j in range(k):
            for m in range(j + 1, n):
                one, two = ws[d + j * stride], ws[d + m * stride]
                swap = two < one
                if small.any_lane(swap) == 1:
                    ws[d + j * stride] = ti.select(swap, two, one)
                    ws[d + m * stride] = ti.select(swap, one, two)
                    for r in range(n * wanted):
                        upper, lower = q + (j * n + r) * stride, q + (m * n + r) * stride
                        left, right = ws[upper], ws[lower]
                        ws[upper] = ti.select(swap, right, left)
                        ws[lower] = ti.select(swap, left, right)

    @ti.func
    def one_group(
        g: ti.i32, base: ti.i32, stride: ti.i32, n: ti.i32, k: ti.i32, wanted: ti.i32,
        packed: ti.template(), ws: ti.template(), values: ti.template(), vectors: ti.template(),
    ):  # fmt: skip
        size = n * (n + 1) // 2
        source, to_values, to_vectors = g * size, g * k, g * n * k * wanted
        if ti.static(spec.gpu):
            source, to_values, to_vectors = g, g, g
        q, d = base + n * n * stride, base + 2 * n * n * stride
        for r in range(n):
            for c in range(n):
                ws[base + (r * n + c) * stride] = packed[source + tri(ti.max(r, c), ti.min(r, c)) * stride]
        if ti.static(jacobi):
            small.jacobi(ws, base, n, JACOBI_SWEEPS, stride)
            small.transpose(ws, q, n, stride)
            for r in range(n):
                ws[d + r * stride] = ws[base + (r * n + r) * stride]
        else:
            tridiagonal(ws, base, d, n, wanted, stride)
            implicit_ql(ws, q, d, n, wanted, stride)
        sort(ws, q, d, n, k, wanted, stride)
        for j in range(k):
            values[to_values + j * stride] = ws[d + j * stride]
            for r in range(n * wanted):
                vectors[to_vectors + (r * k + j) * stride] = ws[q + (j * n + r) * stride]

    @lane_kernel(lanes, long=True)
    def eigen(
        n: ti.i32,
        k: ti.i32,
        wanted: ti.i32,
        room: ti.i32,
        n_groups: ti.i32,
        n_tasks: ti.i32,
        packed_in: ti.types.ndarray(dtype=V, ndim=1),  # [n_groups, n * (n + 1) / 2]
        ws_tmp: ti.types.ndarray(dtype=V, ndim=1),  # [n_tasks, room], on a GPU [room, n_groups]
        values_out: ti.types.ndarray(dtype=V, ndim=1),  # [n_groups, k]
        vectors_out: ti.types.ndarray(dtype=V, ndim=1),  # [n_groups, n, k], or 1 element if not wanted
    ):
        if ti.static(spec.gpu):
            for g in range(n_groups):
                one_group(g, g, n_groups, n, k, wanted, packed_in, ws_tmp, values_out, vectors_out)
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for g in range(task * n_groups // n_tasks, (task + 1) * n_groups // n_tasks):
                        one_group(g, task * room, 1, n, k, wanted, packed_in, ws_tmp, values_out, vectors_out)

    return eigen
