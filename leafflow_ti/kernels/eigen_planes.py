"""Eigenvalues and eigenvectors of symmetric 2 x 2 and 3 x 3 matrices that are stored as planes, one entry each.

Cyclic Jacobi on numbers that stay in registers: as exact for repeated and vanishing eigenvalues as for others, which
closed formulas are not. A lane that is done rotates by nothing, so no result depends on its neighbours.
"""

import functools

from leafflow_ti.kernels.dense import dense
from leafflow_ti.kernels.engine import lane_kernel, lane_type, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec

SWEEPS = {"f32": 5, "f64": 6}
"""Convergence is quadratic: one sweep more than were ever needed."""


@functools.cache
def eigen_planes_kernel(spec: KernelSpec, n: int, wanted: int):
    """For matrices of ``n`` = 2 or 3 rows, and ``wanted`` = 0, 1 (the smallest's) or n vectors."""
    real, lanes, V = spec.real, spec.lanes, lane_type(spec.real, spec.lanes)
    small = dense(KernelSpec(algebra=spec.storage, lanes=lanes, gpu=spec.gpu))
    tiny, negligible = (1e-290, 1e-32) if spec.storage == "f64" else (1e-36, 1e-15)

    @ti.func
    def load(src: ti.template(), at: ti.i32):
        value = V(0.0)
        if ti.static(lanes > 1):
            for l in range(lanes):
                value[l] = src[at + l]
        else:
            value = src[at]
        return value

    @ti.func
    def store(value: ti.template(), dst: ti.template(), at: ti.i32):
        if ti.static(lanes > 1):
            for l in range(lanes):
                dst[at + l] = value[l]
        else:
            dst[at] = value

    @ti.func
    def turn(one: ti.template(), two: ti.template(), cosine: ti.template(), sine: ti.template()):
        kept = cosine * one - sine * two
        two = sine * one + cosine * two
        one = kept

    @ti.func
    def rotate(
        pp: ti.template(), qq: ti.template(), pq: ti.template(), rp: ti.template(), rq: ti.template(),
        v0p: ti.template(), v0q: ti.template(), v1p: ti.template(), v1q: ti.template(), v2p: ti.template(),
        v2q: ti.template(),
    ):  # fmt: skip
        """Make the entry (p, q) 0; r is the third row, and v are rows of the eigenvectors."""
        turned = pq * pq > small.magnitude(pp * qq) * real(negligible)
        theta = (qq - pp) / ti.select(turned, pq * 2.0, V(1.0))
        t = 1.0 / (small.magnitude(theta) + ti.sqrt(theta * theta + 1.0))
        t = ti.select(turned, ti.select(theta >= V(0.0), t, 0.0 - t), V(0.0))
        cosine = 1.0 / ti.sqrt(t * t + 1.0)
        sine = t * cosine
        pp = pp - t * pq
        qq = qq + t * pq
        pq = ti.select(turned, V(0.0), pq)
        turn(rp, rq, cosine, sine)
        if ti.static(wanted > 0):
            turn(v0p, v0q, cosine, sine)
            turn(v1p, v1q, cosine, sine)
            turn(v2p, v2q, cosine, sine)

    @ti.func
    def order(
        a: ti.template(), b: ti.template(), v0a: ti.template(), v0b: ti.template(), v1a: ti.template(),
        v1b: ti.template(), v2a: ti.template(), v2b: ti.template(),
    ):  # fmt: skip
        """Exchange two eigenvalues, and their vectors, where the second one is smaller."""
        swap = b < a
        exchange(swap, a, b)
        if ti.static(wanted > 0):
            exchange(swap, v0a, v0b)
            exchange(swap, v1a, v1b)
            exchange(swap, v2a, v2b)

    @ti.func
    def exchange(swap: ti.template(), one: ti.template(), two: ti.template()):
        kept = ti.select(swap, two, one)
        two = ti.select(swap, one, two)
        one = kept

    @ti.func
    def give(
        slot: ti.i32, x: ti.template(), y: ti.template(), z: ti.template(), at: ti.i32, count: ti.i32,
        vectors: ti.template(),
    ):  # fmt: skip
        """A vector with its sign: in 2D y, else x, is positive; in 3D the product of the components, else their sum."""
        last = y
        other = x
        if ti.static(n == 3):
            last = x * y * z
            other = x + y + z
        negative = (last < V(0.0)) | ((last == V(0.0)) & (other < V(0.0)))
        sign = ti.select(negative, V(-1.0), V(1.0))
        here = slot * n * count + at
        store(x * sign, vectors, here)
        store(y * sign, vectors, here + count)
        if ti.static(n == 3):
            store(z * sign, vectors, here + 2 * count)

    @ti.func
    def one_group(
        at: ti.i32, count: ti.i32, descending: ti.i32, src: ti.template(), values: ti.template(),
        vectors: ti.template(),
    ):  # fmt: skip
        xx, yy, zz = load(src, at), load(src, at + count), V(0.0)
        xy, xz, yz = load(src, at + n * count), V(0.0), V(0.0)
        if ti.static(n == 3):
            zz = load(src, at + 2 * count)
            xz = load(src, at + 4 * count)
            yz = load(src, at + 5 * count)
        largest = ti.max(
            ti.max(small.magnitude(xx), small.magnitude(yy)), ti.max(small.magnitude(zz), small.magnitude(xy))
        )
        largest = ti.max(ti.max(largest, V(real(tiny))), ti.max(small.magnitude(xz), small.magnitude(yz)))
        scale = 1.0 / largest
        xx, yy, zz, xy, xz, yz = xx * scale, yy * scale, zz * scale, xy * scale, xz * scale, yz * scale
        a, b, c = V(1.0), V(0.0), V(0.0)  # rows of the eigenvectors
        d, e, f = V(0.0), V(1.0), V(0.0)
        g, h, i = V(0.0), V(0.0), V(1.0)
        if ti.static(n == 2):
            rotate(xx, yy, xy, xz, yz, a, b, d, e, g, h)
        else:
            active = 1
            for _ in range(SWEEPS[spec.storage]):
                if active == 1:
                    rotate(xx, yy, xy, xz, yz, a, b, d, e, g, h)
                    rotate(xx, zz, xz, xy, yz, a, c, d, f, g, i)
                    rotate(yy, zz, yz, xy, xz, b, c, e, f, h, i)
                    left = ti.max(ti.max(small.magnitude(xy), small.magnitude(xz)), small.magnitude(yz))
                    active = small.any_lane(left > V(0.0))
        order(xx, yy, a, b, d, e, g, h)
        if ti.static(n == 3):
            order(yy, zz, b, c, e, f, h, i)
            order(xx, yy, a, b, d, e, g, h)
        store(xx * largest, values, at + descending * (n - 1) * count)
        store(yy * largest, values, at + ti.select(descending == 1, n - 2, 1) * count)
        if ti.static(n == 3):
            store(zz * largest, values, at + (1 - descending) * 2 * count)
        if ti.static(wanted > 0):
            give(ti.select(descending == 1, wanted - 1, 0), a, d, g, at, count, vectors)
        if ti.static(wanted > 1):
            give(ti.select(descending == 1, n - 2, 1), b, e, h, at, count, vectors)
        if ti.static(wanted > 2):
            give((1 - descending) * 2, c, f, i, at, count, vectors)

    @lane_kernel(lanes, numbers=True)
    def eigen_planes(
        count: ti.i32,  # at least the lanes
        descending: ti.i32,
        n_tasks: ti.i32,
        src_in: ti.types.ndarray(dtype=real, ndim=1),  # [n (n + 1) / 2, count]: xx, yy, (zz,) xy, (xz, yz)
        values_out: ti.types.ndarray(dtype=real, ndim=1),  # [n, count]
        vectors_out: ti.types.ndarray(dtype=real, ndim=1),  # [wanted, n, count]
    ):
        if ti.static(spec.gpu):
            for g in range(count):
                one_group(g, count, descending, src_in, values_out, vectors_out)
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    groups = (count + lanes - 1) // lanes
                    for s in range(task * groups // n_tasks, (task + 1) * groups // n_tasks):
                        # The last group overlaps the one before it, and finds there what that has found.
                        at = ti.min(s * lanes, count - lanes)
                        one_group(at, count, descending, src_in, values_out, vectors_out)

    return eigen_planes
