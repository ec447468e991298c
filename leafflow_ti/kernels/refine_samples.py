"""The samples of a window: warped images, the texture that is in all of them, and sums of residuals.

    V_k(δ) = g_k(δ) (T(δ) + blur_k · (Txx, Txy, Tyy))        g_k = 1 + Σ a_k,m φ_m(δ)

Images are interpolated by B-splines. What smooths an image (the area of a pixel, the prefilter) is isotropic
there, so images in which the surface looks narrower show it smoother along that direction: to first order by the second
derivatives of the texture, with weights that follow from the warps (``Warp.BLUR``).
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.engine import lane_type, ti
from leafflow_ti.kernels.refine_equations import equation_functions
from leafflow_ti.kernels.refine_tables import (
    ADDRESSED,
    DERIVATIVES,
    FUNCTIONS,
    NOTHING,
    SHIFTS,
    SHOWN,
    Scalar,
    Size,
    Value,
    Warp,
)
from leafflow_ti.kernels.refine_warp import warp_functions
from leafflow_ti.kernels.spec import KernelSpec

NO_WRAP = ADDRESSED - 1
"""An index that is known to be positive and small needs no extension of its own
for each neighbour: measured, three quarters of the time of an interpolation."""


@functools.cache
def sample_functions(spec: KernelSpec, taps: int) -> SimpleNamespace:
    """Stages on the samples of a window; ``S`` is their workspace in vectors, ``r`` the same in numbers.

    ``taps``: neighbours along an axis that a spline weighs, its degree + 1.
    """
    reach = float(taps // 2 - 1)
    real, precise, lanes = spec.real, spec.precise, spec.lanes
    V = lane_type(real, lanes)
    scalars, total = warp_functions(spec).scalars, equation_functions(spec).total

    @ti.func
    def gain(at: ti.i32, terms: ti.i32, x: ti.template(), y: ti.template(), r: ti.template()):
        """g_k at the window points (x, y), in halves of the window."""
        g = V(1.0)
        if terms > 0:
            g = g + r[at + Warp.GAIN]
        if terms > 1:
            g = g + r[at + Warp.GAIN + 1] * x + r[at + Warp.GAIN + 2] * y
        if terms > 3:
            g = g + (r[at + Warp.GAIN + 3] * x + r[at + Warp.GAIN + 4] * y) * x + r[at + Warp.GAIN + 5] * y * y
        return g

    @ti.func
    def weight_of(seen: ti.template(), expected: ti.template(), limit: real):
        """1 where there is a value; less where it is far from ``expected``, 0 beyond the root of ``limit``: Tukey's."""
        weight = ti.select(seen < V(0.1 * NOTHING), V(1.0), V(0.0))
        if limit > 0.0:
            off = ti.select(seen < V(0.1 * NOTHING), seen - expected, V(0.0))
            near = ti.max(1.0 - off * off / limit, V(0.0))
            weight = weight * near * near
        return weight

    @ti.func
    def window(
        slot: ti.template(), group: ti.i32, centre: ti.i32, size: ti.template(), sample: ti.template(),
        mask: ti.template(), S: ti.template(), r: ti.template(),
    ):  # fmt: skip
        """Weights of the samples; 0 where the mask is."""
        groups = size[Size.SAMPLE_GROUPS]
        w = sample[2 * groups + group]
        if size[Size.MASKED] > 0:
            x, y = sample[group], sample[groups + group]
            if ti.static(lanes == 1):
                w = w * mask[centre + ti.cast(y, ti.i32) * size[Size.PITCH] + ti.cast(x, ti.i32)]
            else:
                for i in ti.static(range(lanes)):
                    at = centre + ti.cast(y[i], ti.i32) * size[Size.PITCH] + ti.cast(x[i], ti.i32)
                    w[i] = w[i] * mask[at]
        S[slot.real + size[Size.WEIGHT] + group] = w

    @ti.func
    def position(at: ti.i32, x: ti.template(), y: ti.template(), along: ti.i32, r: ti.template()):
        """Where the homography at ``at`` puts window points, from the block's centre: along x (0) or y (1)."""
        depth = 1.0 / (r[at + 6] * x + r[at + 7] * y + 1.0)
        return (r[at + 3 * along] * x + r[at + 3 * along + 1] * y + r[at + 3 * along + 2]) * depth

    @ti.func
    def place(
        at: ti.i32, x: ti.template(), y: ti.template(), curved: ti.template(), along: ti.i32, r: ti.template()
    ):  # fmt: skip
        """The same of the points of a curved surface, ``curved`` of its κ."""
        depth = 1.0 / (r[at + 6] * x + r[at + 7] * y + 1.0 + r[at + Warp.BEND + 2] * curved)
        flat = r[at + 3 * along] * x + r[at + 3 * along + 1] * y + r[at + 3 * along + 2]
        return (flat + r[at + Warp.BEND + along] * curved) * depth

    @ti.func
    def spline(m: ti.i32, u: ti.template(), value: ti.template()):
        """Weight of neighbour m for a point ``u`` behind the middle one; then of its derivatives, in turn."""
        at = Value.SPLINE + m * taps
        w = ti.cast(value[at + taps - 1], real)
        weight = V(w)
        for k in range(1, taps):
            weight = weight * u + ti.cast(value[at + taps - 1 - k], real)
        return weight

    @ti.func
    def warp(
        slot: ti.template(), group: ti.i32, centre: ti.i32, size: ti.template(), value: ti.template(),
        origin: ti.template(), sample: ti.template(), coef: ti.template(), S: ti.template(), r: ti.template(),
        p: ti.template(),
    ):  # fmt: skip
        """Value and derivatives, to the second, of every image at one vector of samples."""
        groups, pitch = size[Size.SAMPLE_GROUPS], size[Size.PITCH]
        farthest = ti.cast(value[Value.LIMIT], real)
        # One place for all vectors of samples, unless they are warped at once.
        weights = slot.real + size[Size.SPLINES] + group * ti.static(6 * taps if spec.gpu else 0)
        x, y = sample[group], sample[groups + group]
        bent = scalars(slot, size) + Scalar.CURVATURE
        xx, xy, yy = ti.cast(0.5 * p[bent], real), ti.cast(p[bent + 1], real), ti.cast(0.5 * p[bent + 2], real)
        curved = x * (x * xx + y * xy) + y * y * yy
        for k in range(size[Size.IMAGES]):
            at = (slot.real + size[Size.WARP]) * lanes + k * Warp.N
            ix, iy = place(at, x, y, curved, 0, r), place(at, x, y, curved, 1, r)
            inside = ti.select(ti.max(ti.max(ix, 0.0 - ix), ti.max(iy, 0.0 - iy)) < V(farthest), V(1.0), V(0.0))
            ix = ti.max(ti.min(ix, V(farthest)), V(0.0 - farthest))
            iy = ti.max(ti.min(iy, V(farthest)), V(0.0 - farthest))
            fx, fy = ti.floor(ix), ti.floor(iy)
            u, v = ix - fx, iy - fy
            corner = (fy - reach) * ti.cast(pitch, real) + (fx - reach)
            for m in range(3 * taps):
                S[weights + m] = spline(m, u, value)
                S[weights + 3 * taps + m] = spline(m, v, value)
            val, gx, gy, gxx, gxy, gyy = V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0)
            worst = V(0.0)
            for row in range(taps):
                first = origin[k] + centre + row * pitch
                along, slope, bend = V(0.0), V(0.0), V(0.0)
                for col in ti.static(range(taps)):
                    c = V(0.0)
                    if ti.static(lanes == 1):
                        c = coef[first + ti.cast(corner, ti.i32) + col]
                    else:
                        for i in ti.static(range(lanes)):
                            c[i] = coef[((first + ti.cast(corner[i], ti.i32)) & NO_WRAP) + col]
                    worst = ti.max(worst, c)
                    along = along + S[weights + col] * c
                    slope = slope + S[weights + taps + col] * c
                    bend = bend + S[weights + 2 * taps + col] * c
                b = weights + 3 * taps + row
                val = val + S[b] * along
                gx = gx + S[b] * slope
                gxx = gxx + S[b] * bend
                gy = gy + S[b + taps] * along
                gxy = gxy + S[b + taps] * slope
                gyy = gyy + S[b + 2 * taps] * along
            seen = (worst < V(0.1 * NOTHING)) & (inside > V(0.5))
            to = slot.real + size[Size.SEEN] + DERIVATIVES * k * groups + group
            S[to] = ti.select(seen, val, V(NOTHING))
            S[to + groups] = ti.select(seen, gx, V(0.0))
            S[to + 2 * groups] = ti.select(seen, gy, V(0.0))
            S[to + 3 * groups] = ti.select(seen, gxx, V(0.0))
            S[to + 4 * groups] = ti.select(seen, gxy, V(0.0))
            S[to + 5 * groups] = ti.select(seen, gyy, V(0.0))

    @ti.func
    def texture(
        slot: ti.template(), group: ti.i32, size: ti.template(), value: ti.template(), sample: ti.template(),
        S: ti.template(), r: ti.template(), p: ti.template(),
    ):  # fmt: skip
        """One vector of samples: values of all images where the warps are now, and the texture.

        Since the images were sampled the warps have moved little, and what a curvature adds to them hardly at all:
        the second-order expansion there is exact enough.
        Where they have just been sampled, the texture's derivatives and the functions of the window are made, too.
        """
        groups, terms = size[Size.SAMPLE_GROUPS], size[Size.TERMS]
        s = scalars(slot, size)
        limit = ti.cast(p[s + Scalar.ROBUST], real)
        half = 1.0 / ti.cast(value[Value.HALF], real)
        x, y = sample[group], sample[groups + group]
        ux, uy = x * half, y * half
        before = S[slot.real + size[Size.TEXTURE] + group]
        blurred = slot.real + size[Size.BLUR] + group
        bxx, bxy, byy = S[blurred], S[blurred + groups], S[blurred + 2 * groups]
        mass, level = V(0.0), V(0.0)
        mean_xx, mean_xy, mean_yy = V(0.0), V(0.0), V(0.0)
        tx, ty, txx, txy, tyy = V(0.0), V(0.0), V(0.0), V(0.0), V(0.0)
        fresh = p[s + Scalar.RESAMPLE] > 0.5
        for k in range(size[Size.IMAGES]):
            at = (slot.real + size[Size.WARP]) * lanes + k * Warp.N
            n = slot.real + size[Size.SEEN] + DERIVATIVES * k * groups + group
            gx, gy, gxx, gxy, gyy = (
                S[n + groups], S[n + 2 * groups], S[n + 3 * groups], S[n + 4 * groups], S[n + 5 * groups]
            )  # fmt: skip
            val = S[n]
            if not fresh:
                dx = position(at, x, y, 0, r) - position(at + Warp.SAMPLED, x, y, 0, r)
                dy = position(at, x, y, 1, r) - position(at + Warp.SAMPLED, x, y, 1, r)
                val = val + dx * (gx + 0.5 * (dx * gxx) + dy * gxy) + dy * (gy + 0.5 * (dy * gyy))
            S[slot.real + size[Size.VALUES] + k * groups + group] = val
            g = gain(at, terms, ux, uy, r)
            blur = r[at + Warp.BLUR] * bxx + r[at + Warp.BLUR + 1] * bxy + r[at + Warp.BLUR + 2] * byy
            weight = weight_of(val, g * (before + blur), limit) * r[at + Warp.TRUST] * g
            level = level + weight * ti.select(val < V(0.1 * NOTHING), val, V(0.0))
            both = weight * g
            mass = mass + both
            mean_xx = mean_xx + both * r[at + Warp.BLUR]
            mean_xy = mean_xy + both * r[at + Warp.BLUR + 1]
            mean_yy = mean_yy + both * r[at + Warp.BLUR + 2]
            if fresh:
                # Derivatives by δ, through ∂x/∂δ at the window's centre; weighted as values are.
                xx, xy, yx, yy = r[at + Warp.D], r[at + Warp.D + 1], r[at + Warp.D + 2], r[at + Warp.D + 3]
                tx = tx + weight * (xx * gx + yx * gy)
                ty = ty + weight * (xy * gx + yy * gy)
                txx = txx + weight * (xx * xx * gxx + 2.0 * xx * yx * gxy + yx * yx * gyy)
                txy = txy + weight * (xx * xy * gxx + (xx * yy + xy * yx) * gxy + yx * yy * gyy)
                tyy = tyy + weight * (xy * xy * gxx + 2.0 * xy * yy * gxy + yy * yy * gyy)
        some = ti.select(mass > V(1e-6), V(1.0), V(0.0))
        scale = some / ti.max(mass, V(1e-6))
        if not limit > 0.0:
            # What no image shows is no part of the window.
            S[slot.real + size[Size.WEIGHT] + group] = S[slot.real + size[Size.WEIGHT] + group] * some
        old = slot.real + size[Size.SCRATCH] + group
        S[old], S[old + groups], S[old + 2 * groups] = bxx, bxy, byy
        S[old + SHOWN * groups] = mass
        to = slot.real + size[Size.FUNCTION] + group
        if fresh:
            tx, ty = tx * scale, ty * scale
            bxx, bxy, byy = txx * scale, txy * scale, tyy * scale
            S[blurred], S[blurred + groups], S[blurred + 2 * groups] = bxx, bxy, byy
            e = x * tx + y * ty
            S[to] = tx
            S[to + groups] = ty
            S[to + 2 * groups] = x * tx
            S[to + 3 * groups] = y * tx
            S[to + 4 * groups] = x * ty
            S[to + 5 * groups] = y * ty
            S[to + 6 * groups] = x * e
            S[to + 7 * groups] = y * e
        found = (level - mean_xx * bxx - mean_xy * bxy - mean_yy * byy) * scale
        S[slot.real + size[Size.BEFORE] + group] = before
        S[slot.real + size[Size.TEXTURE] + group] = found
        to = to + SHIFTS * groups
        S[to] = found
        S[to + groups] = found * ux
        S[to + 2 * groups] = found * uy
        S[to + 3 * groups] = found * ux * ux
        S[to + 4 * groups] = found * ux * uy
        S[to + 5 * groups] = found * uy * uy

    @ti.func
    def residual(
        slot: ti.template(), at: ti.i32, k: ti.i32, i: ti.i32, g: ti.template(), limit: real, size: ti.template(),
        S: ti.template(), r: ti.template(),
    ):  # fmt: skip
        """Residual of image k at a vector of samples, and its weight."""
        groups = size[Size.SAMPLE_GROUPS]
        n = slot.real + size[Size.BLUR] + i
        blur = r[at + Warp.BLUR] * S[n] + r[at + Warp.BLUR + 1] * S[n + groups]
        blur = blur + r[at + Warp.BLUR + 2] * S[n + 2 * groups]
        n = slot.real + size[Size.SCRATCH] + i
        old = r[at + Warp.BLUR] * S[n] + r[at + Warp.BLUR + 1] * S[n + groups]
        old = old + r[at + Warp.BLUR + 2] * S[n + 2 * groups]
        seen = S[slot.real + size[Size.VALUES] + k * groups + i]
        weight = weight_of(seen, g * (S[slot.real + size[Size.BEFORE] + i] + old), limit)
        weight = weight * S[slot.real + size[Size.WEIGHT] + i]
        off = seen - g * (S[slot.real + size[Size.TEXTURE] + i] + blur)
        return ti.select(weight > V(0.0), off, V(0.0)), weight

    @ti.func
    def sums(
        slot: ti.template(), k: ti.i32, size: ti.template(), value: ti.template(), sample: ti.template(),
        S: ti.template(), r: ti.template(), p: ti.template(),
    ):  # fmt: skip
        """Of one image: residual times functions of the window, squared residual, and weight of its samples."""
        groups, terms = size[Size.SAMPLE_GROUPS], size[Size.TERMS]
        limit = ti.cast(p[scalars(slot, size) + Scalar.ROBUST], real)
        half = 1.0 / ti.cast(value[Value.HALF], real)
        at = (slot.real + size[Size.WARP]) * lanes + k * Warp.N
        y0, y1, y2, y3, y4, y5, y6, y7 = V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0)
        b0, b1, b2, b3, b4, b5, mass, energy = V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0)
        for i in range(groups):
            ux, uy = sample[i] * half, sample[groups + i] * half
            g = gain(at, terms, ux, uy, r)
            off, weight = residual(slot, at, k, i, g, limit, size, S, r)
            mass = mass + weight
            off_w = off * weight
            energy = energy + off_w * off
            n = slot.real + size[Size.FUNCTION] + i
            scaled = off_w * g
            y0 = y0 + scaled * S[n]
            y1 = y1 + scaled * S[n + groups]
            y2 = y2 + scaled * S[n + 2 * groups]
            y3 = y3 + scaled * S[n + 3 * groups]
            y4 = y4 + scaled * S[n + 4 * groups]
            y5 = y5 + scaled * S[n + 5 * groups]
            y6 = y6 + scaled * S[n + 6 * groups]
            y7 = y7 + scaled * S[n + 7 * groups]
            if terms > 0:
                n = n + SHIFTS * groups
                b0 = b0 + off_w * S[n]
                b1 = b1 + off_w * S[n + groups]
                b2 = b2 + off_w * S[n + 2 * groups]
                b3 = b3 + off_w * S[n + 3 * groups]
                b4 = b4 + off_w * S[n + 4 * groups]
                b5 = b5 + off_w * S[n + 5 * groups]
        step = size[Size.IMAGE_GROUPS] * lanes
        to = (slot.precise + size[Size.SUMS]) * lanes + k
        found = ti.static([y0, y1, y2, y3, y4, y5, y6, y7, b0, b1, b2, b3, b4, b5])
        for n in ti.static(range(FUNCTIONS)):
            p[to + n * step] = ti.cast(total(found[n]), precise)
        p[(slot.precise + size[Size.MASS]) * lanes + k] = ti.cast(total(mass), precise)
        p[(slot.precise + size[Size.ENERGY]) * lanes + k] = ti.cast(total(energy), precise)

    @ti.func
    def halves(
        slot: ti.template(), k: ti.i32, size: ti.template(), value: ti.template(), sample: ti.template(),
        S: ti.template(), r: ti.template(), p: ti.template(),
    ):  # fmt: skip
        """Of one image: the sums of the right half of the window less those of the left; below less above."""
        groups, terms = size[Size.SAMPLE_GROUPS], size[Size.TERMS]
        limit = ti.cast(p[scalars(slot, size) + Scalar.ROBUST], real)
        half = 1.0 / ti.cast(value[Value.HALF], real)
        at = (slot.real + size[Size.WARP]) * lanes + k * Warp.N
        to = (slot.precise + size[Size.HALVES]) * lanes + k
        step = size[Size.IMAGE_GROUPS] * lanes
        x0, x1, x2, x3, x4, x5, x6, x7 = V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0)
        y0, y1, y2, y3, y4, y5, y6, y7 = V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0), V(0.0)
        for i in range(groups):
            x, y = sample[i], sample[groups + i]
            g = gain(at, terms, x * half, y * half, r)
            off, weight = residual(slot, at, k, i, g, limit, size, S, r)
            scaled = off * weight * g
            across = ti.select(x > V(0.0), scaled, V(0.0)) - ti.select(x < V(0.0), scaled, V(0.0))
            down = ti.select(y > V(0.0), scaled, V(0.0)) - ti.select(y < V(0.0), scaled, V(0.0))
            n = slot.real + size[Size.FUNCTION] + i
            f0, f1, f2, f3 = S[n], S[n + groups], S[n + 2 * groups], S[n + 3 * groups]
            f4, f5, f6, f7 = S[n + 4 * groups], S[n + 5 * groups], S[n + 6 * groups], S[n + 7 * groups]
            x0, x1, x2, x3 = x0 + across * f0, x1 + across * f1, x2 + across * f2, x3 + across * f3
            x4, x5, x6, x7 = x4 + across * f4, x5 + across * f5, x6 + across * f6, x7 + across * f7
            y0, y1, y2, y3 = y0 + down * f0, y1 + down * f1, y2 + down * f2, y3 + down * f3
            y4, y5, y6, y7 = y4 + down * f4, y5 + down * f5, y6 + down * f6, y7 + down * f7
        found = ti.static([x0, x1, x2, x3, x4, x5, x6, x7, y0, y1, y2, y3, y4, y5, y6, y7])
        for n in ti.static(range(2 * SHIFTS)):
            p[to + n * step] = ti.cast(total(found[n]), precise)

    @ti.func
    def gram(slot: ti.template(), i: ti.i32, size: ti.template(), S: ti.template(), p: ti.template()):
        """Row i of the sums of products of the functions of the window."""
        s, groups = scalars(slot, size), size[Size.SAMPLE_GROUPS]
        first = slot.real + size[Size.FUNCTION]
        for j in range(i + 1):
            found = V(0.0)
            for n in range(groups):
                found = (
                    found + S[first + i * groups + n] * S[first + j * groups + n] * S[slot.real + size[Size.WEIGHT] + n]
                )
            element = ti.cast(total(found), precise)
            p[s + Scalar.GRAM + i * FUNCTIONS + j] = element
            p[s + Scalar.GRAM + j * FUNCTIONS + i] = element

    return SimpleNamespace(
        window=window, warp=warp, texture=texture, sums=sums, halves=halves, gram=gram,
    )  # fmt: skip
