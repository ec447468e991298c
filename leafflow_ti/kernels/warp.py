"""Images of one line of time (or of cameras), each moved by its share of a flow, and what is left of their change.

Every pixel follows ``x + lever_k u(x)`` through the images ``k``. Their values there are a line over the levers, but
for noise: its mean is the texture ``T``, its slope ``p`` what the flow does not explain yet, so that the flow's error
``e`` fulfils ``∇T·e + p = 0`` with the weight ``S = Σ weight_k (lever_k - mean)²``
(Lucas & Kanade 1981, with all images).

Images are cubic splines: coefficients with ``MARGIN`` pixels on every side. Of what lies outside an image nothing is
taken; an image that a pixel leaves loses its weight there.
"""

import functools

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import Kernel, lane_kernel, ti
from leafflow_ti.kernels.spec import TASK_GRAIN, KernelSpec
from leafflow_ti.kernels.warp_planes import COUNT, LEVER, MARGIN, SLOPE, SQUARES, TEXTURE


@functools.cache
def follow_kernel(spec: KernelSpec, components: int):
    """The planes ``TEXTURE`` to ``COUNT`` from the images and the flow; ``components`` 1: along x alone."""
    real = spec.real

    @ti.func
    def basis(f: real):
        """Weights of the four neighbours at the fraction ``f``."""
        g = real(1.0) - f
        sixth = real(1.0 / 6.0)
        far, near = g * g * g * sixth, real(2.0 / 3.0) - f * f * (real(1.0) - real(0.5) * f)
        return ti.Vector([far, near, real(1.0) - far - near - f * f * f * sixth, f * f * f * sixth])

    @ti.func
    def follow_one(
        x: ti.i32, y: ti.i32, n_images: ti.i32, rows: ti.i32, cols: ti.i32, pitch: ti.i32, wide: ti.i32,
        lever: ti.template(), image: ti.template(), flow: ti.template(), planes: ti.template(),
    ):  # fmt: skip
        at, size = y * pitch + x, rows * pitch
        u = flow[at]
        v = real(0.0)
        if ti.static(components == 2):
            v = flow[size + at]
        n, first, second = real(0.0), real(0.0), real(0.0)
        total, moment, squares = real(0.0), real(0.0), real(0.0)
        origin = real(0.0)  # sums of small numbers: grey values relative to the first one seen
        for k in range(n_images):
            tau = lever[k]
            px, py = ti.cast(x, real) + tau * u, ti.cast(y, real) + tau * v
            if px >= real(0.0) and px <= ti.cast(cols - 1, real) and py >= real(0.0) and py <= ti.cast(rows - 1, real):
                left = ti.cast(ti.floor(px), ti.i32)
                wx = basis(px - ti.cast(left, real))
                value = real(0.0)
                if ti.static(components == 2):
                    top = ti.cast(ti.floor(py), ti.i32)
                    wy = basis(py - ti.cast(top, real))
                    begin = (k * (rows + 2 * MARGIN) + top + MARGIN - 1) * wide + left + MARGIN - 1
                    for j in ti.static(range(4)):
                        row = begin + j * wide
                        across = wx[0] * image[row] + wx[1] * image[row + 1]
                        value += wy[j] * (across + wx[2] * image[row + 2] + wx[3] * image[row + 3])
                else:
                    row = (k * (rows + 2 * MARGIN) + y + MARGIN) * wide + left + MARGIN - 1
                    value = wx[0] * image[row] + wx[1] * image[row + 1]
                    value += wx[2] * image[row + 2] + wx[3] * image[row + 3]
                if n == real(0.0):
                    origin = value
                value -= origin
                n += real(1.0)
                first += tau
                second += tau * tau
                total += value
                moment += tau * value
                squares += value * value
        texture, slope, lever_sum, left_over = real(0.0), real(0.0), real(0.0), real(0.0)
        if n > real(0.5):
            texture = origin + total / n
            left_over = squares - total * total / n
        if n > real(1.5):
            lever_sum = second - first * first / n
            slope = (moment - first * total / n) / lever_sum
        planes[TEXTURE * size + at] = texture
        planes[SLOPE * size + at] = slope
        planes[LEVER * size + at] = lever_sum
        planes[SQUARES * size + at] = ti.max(left_over, real(0.0))
        planes[COUNT * size + at] = ti.max(n - real(1.0), real(0.0))

    @Kernel
    def follow(
        n_images: ti.i32,
        rows: ti.i32,
        cols: ti.i32,
        pitch: ti.i32,
        wide: ti.i32,
        n_tasks: ti.i32,
        lever_in: ti.types.ndarray(dtype=real, ndim=1),  # [n_images]
        image_in: ti.types.ndarray(dtype=real, ndim=1),  # [n_images * (rows + 2 MARGIN) * wide]
        flow_in: ti.types.ndarray(dtype=real, ndim=1),  # [components * rows * pitch]
        planes_out: ti.types.ndarray(dtype=real, ndim=1),  # [5 * rows * pitch]
    ):
        if ti.static(spec.gpu):
            for y, x in ti.ndrange(rows, cols):
                follow_one(x, y, n_images, rows, cols, pitch, wide, lever_in, image_in, flow_in, planes_out)
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for y in range(task * rows // n_tasks, (task + 1) * rows // n_tasks):
                        for x in range(cols):
                            follow_one(x, y, n_images, rows, cols, pitch, wide, lever_in, image_in, flow_in, planes_out)

    return follow


@functools.cache
def flow_products_kernel(spec: KernelSpec, components: int):
    """``S T_i T_j`` (lower triangle), ``-S T_i q`` with ``q = p - ∇T·u``, squared residuals and their number, each into
    a plane with a margin; derivatives of 5 taps, exact to the fourth order, one-sided as far as borders ask for it."""
    real = spec.real

    @ti.func
    def derivative(planes: ti.template(), at: ti.i32, i: ti.i32, n: ti.i32, step: ti.i32):
        """Along an axis of ``n`` pixels, at its pixel ``i``."""
        found = real(0.0)
        if i >= 2 and i < n - 2:
            near = planes[at + step] - planes[at - step]
            far = planes[at + 2 * step] - planes[at - 2 * step]
            found = real(2.0 / 3.0) * near - real(1.0 / 12.0) * far
        elif n > 1:
            before, behind = ti.min(i, 1), ti.min(n - 1 - i, 1)
            found = (planes[at + behind * step] - planes[at - before * step]) / ti.cast(before + behind, real)
        return found

    @ti.func
    def products_one(
        x: ti.i32, y: ti.i32, rows: ti.i32, cols: ti.i32, pitch: ti.i32, radius: ti.i32, wide: ti.i32,
        planes: ti.template(), flow: ti.template(), products: ti.template(),
    ):  # fmt: skip
        at, size = y * pitch + x, rows * pitch
        plane = (rows + 2 * radius) * wide
        to = (y + radius) * wide + x + radius
        weight, slope = planes[LEVER * size + at], planes[SLOPE * size + at]
        gx = derivative(planes, TEXTURE * size + at, x, cols, 1)
        rest = slope - gx * flow[at]
        products[to] = weight * gx * gx
        if ti.static(components == 2):
            gy = derivative(planes, TEXTURE * size + at, y, rows, pitch)
            rest -= gy * flow[size + at]
            products[plane + to] = weight * gx * gy
            products[2 * plane + to] = weight * gy * gy
            products[4 * plane + to] = real(0.0) - weight * gy * rest
        products[(3 if components == 2 else 1) * plane + to] = real(0.0) - weight * gx * rest
        products[(5 if components == 2 else 2) * plane + to] = planes[SQUARES * size + at]
        products[(6 if components == 2 else 3) * plane + to] = planes[COUNT * size + at]

    @Kernel
    def products(
        rows: ti.i32,
        cols: ti.i32,
        pitch: ti.i32,
        radius: ti.i32,
        wide: ti.i32,
        n_tasks: ti.i32,
        planes_in: ti.types.ndarray(dtype=real, ndim=1),  # [5 * rows * pitch]
        flow_in: ti.types.ndarray(dtype=real, ndim=1),  # [components * rows * pitch]
        products_out: ti.types.ndarray(dtype=real, ndim=1),  # [n_products * (rows + 2 radius) * wide]
    ):
        if ti.static(spec.gpu):
            for y, x in ti.ndrange(rows, cols):
                products_one(x, y, rows, cols, pitch, radius, wide, planes_in, flow_in, products_out)
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for y in range(task * rows // n_tasks, (task + 1) * rows // n_tasks):
                        for x in range(cols):
                            products_one(x, y, rows, cols, pitch, radius, wide, planes_in, flow_in, products_out)

    return products


@functools.cache
def flow_solve_kernel(spec: KernelSpec):
    """Solves ``(N + D) p = r + D p0`` per pixel: N and r from planes of moments, D diagonal, p0 the flow as it is.

    Of p, the first unknown of each component is the new flow; with ``errors`` its variance follows from
    ``s² m^T N' m``, m the column of N^-1 of that unknown and N' of squared windows, s² the mean of the squared
    residuals. ``power_in[i]``: degree of unknown i; the squared window has moments 2^-degree times as large.
    """
    small = dense(spec)
    V, precise = spec.element, spec.precise

    @ti.func
    def solve_one(
        g: ti.i32, base: ti.i32, stride: ti.i32, n: ti.i32, components: ti.i32, errors: ti.i32, groups: ti.i32,
        squares: ti.i32, share: ti.f32, lower: ti.template(), right: ti.template(), power: ti.template(),
        damping: ti.template(), moments: ti.template(), ws: ti.template(), flow: ti.template(), std: ti.template(),
    ):  # fmt: skip
        terms, columns = n // components, 1 + errors * components
        packed = base
        x = base + tri(n, 0) * stride
        kept = x + n * columns * stride
        for r in range(n):
            for c in range(r + 1):
                entry = moments[lower[tri(r, c)] * groups + g]
                ws[kept + tri(r, c) * stride] = entry
                ws[packed + tri(r, c) * stride] = entry
            held = V(1.0) * damping[r]
            ws[packed + tri(r, r) * stride] = ws[packed + tri(r, r) * stride] + held
            ws[x + r * columns * stride] = moments[right[r] * groups + g]
            if r % terms == 0:
                ws[x + r * columns * stride] = ws[x + r * columns * stride] + held * flow[r // terms * groups + g]
            for e in range(1, columns):
                ws[x + (r * columns + e) * stride] = V(ti.cast(r == (e - 1) * terms, precise))
        small.cholesky(ws, packed, n, -1, stride)
        small.solve(ws, packed, x, n, columns, stride)
        for c in range(components):
            flow[c * groups + g] = ws[x + c * terms * columns * stride]
            if errors == 1:
                total = V(0.0)
                for i in range(n):
                    for j in range(n):
                        entry = ws[kept + tri(ti.max(i, j), ti.min(i, j)) * stride] * (power[i] * power[j])
                        one, two = x + (i * columns + 1 + c) * stride, x + (j * columns + 1 + c) * stride
                        total = total + ws[one] * entry * ws[two]
                noise = moments[squares * groups + g] / ti.max(moments[(squares + 1) * groups + g], 1e-20)
                std[c * groups + g] = ti.sqrt(ti.max(total * noise * ti.cast(share, precise), 0.0))

    @lane_kernel(spec.lanes)
    def flow_solve(
        n: ti.i32,
        components: ti.i32,
        errors: ti.i32,
        groups: ti.i32,
        squares: ti.i32,
        share: ti.f32,
        n_tasks: ti.i32,
        lower_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n (n + 1) / 2]
        right_in: ti.types.ndarray(dtype=ti.i32, ndim=1),  # [n]
        power_in: ti.types.ndarray(dtype=spec.precise, ndim=1),  # [n]
        damping_in: ti.types.ndarray(dtype=spec.precise, ndim=1),  # [n]
        moments_in: ti.types.ndarray(dtype=V, ndim=1),  # [n_moments * groups]
        ws_tmp: ti.types.ndarray(dtype=V, ndim=1),  # [tasks * (n (n + 1) + n columns)], of a GPU as many as groups
        flow_io: ti.types.ndarray(dtype=V, ndim=1),  # [components * groups]
        std_out: ti.types.ndarray(dtype=V, ndim=1),  # [components * groups] with errors
    ):
        size = n * (n + 1) + n * (1 + errors * components)
        if ti.static(spec.gpu):
            for g in range(groups):
                solve_one(
                    g, g, groups, n, components, errors, groups, squares, share, lower_in, right_in, power_in,
                    damping_in, moments_in, ws_tmp, flow_io, std_out,
                )  # fmt: skip
        else:
            for task, part in ti.ndrange(n_tasks, TASK_GRAIN):
                if part == 0:
                    for g in range(task * groups // n_tasks, (task + 1) * groups // n_tasks):
                        solve_one(
                            g, task * size, 1, n, components, errors, groups, squares, share, lower_in, right_in,
                            power_in, damping_in, moments_in, ws_tmp, flow_io, std_out,
                        )  # fmt: skip

    return flow_solve
