"""Where the images see a moving patch, and what a change of its parameters does to that.

A window point δ [px] of the reference image is the point ``P(δ) = Z(δ) r - C`` of a plane through ``C = Z0 r0``, and at
time t it is at ``X = C + N t + V(Ω t) A t²/2 + R(Ω t) G(t) P``. The acceleration turns with the patch, V = 1 + K/3 +
K²/12 + ... with K the cross product by Ω t: so the path is exact for a turn about any axis, and without V the jerk
of a turn would be taken for velocity. With ``ρ = 1 / Z(δ)``, which is linear in δ,

    P ρ = L δ,   L = [e_x/f + r0 η_x, e_y/f + r0 η_y],   η = (ZX, ZY) / (f (1 - ZX x0/f - ZY y0/f))
    (X - s) ρ = R G L δ + γ (1 - η δ),   γ = r0 + (N t + V A t²/2 - s) / Z0

so every image is seen through a homography ``H = [R G L - γ η^T | γ]`` of (δ, 1), exactly.

A surface that is curved has ``Z0 ρ = 1 - η δ - κ(δ)``, κ = ½ δ^T K δ, with a K that is known beforehand. It is seen at
``H (δ, 1) + β κ(δ)``, ``β = R G r0 - γ``, exactly, too. What a change of the parameters does is taken from the
plane: that makes steps a little shorter or longer than they should be, and leaves alone where they end.

A change dH moves what an image shows at its pixel as if the window point had moved by ``dδ``, ``(dδ, 0) = ξ (δ, 1) -
λ (δ, 1)`` with ``ξ = H^-1 dH``: a quadratic polynomial of eight coefficients. Texture T and its gradient then give the
change of the grey value as a sum over eight functions of the window, the same ones for every image:

    Tx, Ty, δx Tx, δy Tx, δx Ty, δy Ty, δx E, δy E,   E = δx Tx + δy Ty
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.refine_tables import GROWTH, TERMS, Geometry, Image, Scalar, Size, Value, Warp
from leafflow_ti.kernels.spec import KernelSpec


@ti.dataclass
class Slot:
    """Where a pixel's workspaces begin."""

    real: ti.i32  # first sample vector
    precise: ti.i32  # first image vector


@functools.cache
def warp_functions(spec: KernelSpec) -> SimpleNamespace:
    """``aim``: what the warps of a pixel have in common. ``prepare``: warps of one vector of images, and what every
    unknown does to them. ``hand_over``: their numbers for the samples."""
    precise, real, lanes, V = spec.precise, spec.real, spec.lanes, spec.element

    @ti.func
    def scalars(slot: ti.template(), size: ti.template()) -> ti.i32:
        """The pixel's first number."""
        return (slot.precise + size[Size.SCALAR]) * lanes

    @ti.func
    def geometry(slot: ti.template(), group: ti.i32, size: ti.template()) -> ti.i32:
        """What the warps of a vector of images are made of: one place for all, unless they are made at once."""
        return slot.precise + size[Size.GEOMETRY] + group * ti.static(Geometry.N if spec.gpu else 0)

    @ti.func
    def aim(slot: ti.template(), size: ti.template(), value: ti.template(), p: ti.template()):
        """Ray, η and its derivatives, L, and E_j L of the growth rates, for the pixel's parameters."""
        s = scalars(slot, size)
        f = value[Value.FOCAL]
        rx, ry = p[s + Scalar.X0] / f, p[s + Scalar.Y0] / f
        zx, zy = p[s + Scalar.Q + 1], p[s + Scalar.Q + 2]
        slant = 1.0 - zx * rx - zy * ry
        ex, ey = zx / (f * slant), zy / (f * slant)
        p[s + Scalar.RAY], p[s + Scalar.RAY + 1], p[s + Scalar.RAY + 2] = rx, ry, precise(1.0)
        p[s + Scalar.ETA], p[s + Scalar.ETA + 1] = ex, ey
        p[s + Scalar.ETA + 2] = (1.0 / f + ex * rx) / slant
        p[s + Scalar.ETA + 3] = ey * rx / slant
        p[s + Scalar.ETA + 4] = ex * ry / slant
        p[s + Scalar.ETA + 5] = (1.0 / f + ey * ry) / slant
        for r in range(3):
            for c in range(2):
                p[s + Scalar.LIFT + 2 * r + c] = (
                    p[s + Scalar.RAY + r] * p[s + Scalar.ETA + c] + ti.cast(r == c, precise) / f
                )
        # Tangents e1 = (1, 0, ZX), e2 = (-ZX ZY, 1 + ZX², ZY) of the surface, to length 1.
        one = 1.0 + zx * zx
        n1, n2 = 1.0 / ti.sqrt(one), 1.0 / ti.sqrt(one * (one + zy * zy))
        a0, a2 = n1, zx * n1
        b0, b1, b2 = 0.0 - zx * zy * n2, one * n2, zy * n2
        for c in range(2):
            l0 = p[s + Scalar.LIFT + c]
            l1 = p[s + Scalar.LIFT + 2 + c]
            l2 = p[s + Scalar.LIFT + 4 + c]
            first, second = a0 * l0 + a2 * l2, b0 * l0 + b1 * l1 + b2 * l2
            at = s + Scalar.MODES + c
            if size[Size.MODES] == 1:
                p[at], p[at + 2], p[at + 4] = l0, l1, l2
            else:
                p[at], p[at + 2], p[at + 4] = a0 * first, precise(0.0), a2 * first
                p[at + 6], p[at + 8], p[at + 10] = b0 * second, b1 * second, b2 * second
                p[at + 12] = a0 * second + b0 * first
                p[at + 14] = b1 * first
                p[at + 16] = a2 * second + b2 * first

    @ti.func
    def power_series(
        at: ti.i32, first: ti.template(), second: ti.template(), x: ti.template(), y: ti.template(), z: ti.template(),
        P: ti.template(),
    ):  # fmt: skip
        """``1 + first K + second K²`` with the cross product matrix K of (x, y, z)."""
        P[at] = 1.0 - second * (y * y + z * z)
        P[at + 1] = second * x * y - first * z
        P[at + 2] = second * x * z + first * y
        P[at + 3] = second * x * y + first * z
        P[at + 4] = 1.0 - second * (x * x + z * z)
        P[at + 5] = second * y * z - first * x
        P[at + 6] = second * x * z - first * y
        P[at + 7] = second * y * z + first * x
        P[at + 8] = 1.0 - second * (x * x + y * y)

    @ti.func
    def turn(g: ti.i32, t: ti.template(), s: ti.i32, P: ti.template(), p: ti.template()):
        """Rotation by Ω t, its left Jacobian, and V; power series are exact to 1e-9 for angles up to 1 rad."""
        x, y, z = p[s + Scalar.Q + 6] * t, p[s + Scalar.Q + 7] * t, p[s + Scalar.Q + 8] * t
        a = x * x + y * y + z * z
        sine = 1.0 - a * (1.0 - a * (1.0 - a * (1.0 - a / 72.0) / 42.0) / 20.0) / 6.0
        cosine = 0.5 * (1.0 - a * (1.0 - a * (1.0 - a * (1.0 - a / 90.0) / 56.0) / 30.0) / 12.0)
        third = (1.0 - a * (1.0 - a * (1.0 - a * (1.0 - a / 110.0) / 72.0) / 42.0) / 20.0) / 6.0
        power_series(g + Geometry.R, sine, cosine, x, y, z, P)
        power_series(g + Geometry.TURN, cosine, third, x, y, z, P)
        fourth = (1.0 - a * (1.0 - a * (1.0 - a / 90.0) / 56.0) / 30.0) / 24.0
        power_series(g + Geometry.TRACK, 2.0 * third, 2.0 * fourth, x, y, z, P)

    @ti.func
    def rank_one(
        to: ti.i32, step: ti.i32, g: ti.i32, w0: ti.template(), w1: ti.template(), w2: ti.template(),
        n0: precise, n1: precise, n2: precise, P: ti.template(),
    ):  # fmt: skip
        """The change ``dH = w n^T``."""
        h = g + Geometry.INVERSE
        v0 = P[h] * w0 + P[h + 1] * w1 + P[h + 2] * w2
        v1 = P[h + 3] * w0 + P[h + 4] * w1 + P[h + 5] * w2
        v2 = P[h + 6] * w0 + P[h + 7] * w1 + P[h + 8] * w2
        P[to] = v0 * n2
        P[to + step] = v1 * n2
        P[to + 2 * step] = v0 * n0 - v2 * n2
        P[to + 3 * step] = v0 * n1
        P[to + 4 * step] = v1 * n0
        P[to + 5 * step] = v1 * n1 - v2 * n2
        P[to + 6 * step] = 0.0 - v2 * n0
        P[to + 7 * step] = 0.0 - v2 * n1

    @ti.func
    def two_columns(to: ti.i32, step: ti.i32, g: ti.i32, t: ti.template(), P: ti.template()):
        """Add the change whose first two columns are t times those at PLAIN; the third is 0."""
        for c in range(2):
            q = g + Geometry.PLAIN + c
            q0, q1, q2 = t * P[q], t * P[q + 2], t * P[q + 4]
            for r in range(3):
                h = g + Geometry.INVERSE + 3 * r
                moved = P[h] * q0 + P[h + 1] * q1 + P[h + 2] * q2
                # ξ00, ξ01, ξ10, ξ11 are coefficients 2 to 5; -ξ20, -ξ21 the last two.
                if r < 2:
                    P[to + (2 + 2 * r + c) * step] = P[to + (2 + 2 * r + c) * step] + moved
                else:
                    P[to + (6 + c) * step] = P[to + (6 + c) * step] - moved

    @ti.func
    def behind(
        r: ti.template(), g: ti.i32, t: ti.template(), s: ti.i32, size: ti.template(), P: ti.template(),
        p: ti.template(),
    ):  # fmt: skip
        """Component r of β = R G r0 - γ: where a point goes that lies farther along the viewing ray than the plane. Of
        an anisotropic growth the mean acts on what is not in the surface."""
        size_now = 1.0 + t * p[s + Scalar.Q + GROWTH]
        if size[Size.MODES] > 1:
            size_now = 1.0 + t * (0.5 * (p[s + Scalar.Q + GROWTH] + p[s + Scalar.Q + GROWTH + 1]))
        h = g + Geometry.R + 3 * r
        turned = P[h] * p[s + Scalar.RAY] + P[h + 1] * p[s + Scalar.RAY + 1] + P[h + 2]
        return turned * size_now - P[g + Geometry.GAMMA + r]

    @ti.func
    def moves(
        slot: ti.template(), group: ti.i32, t: ti.template(), size: ti.template(), value: ti.template(),
        P: ti.template(), p: ti.template(),
    ):  # fmt: skip
        """What each unknown does to the warps of one vector of images."""
        s, g = scalars(slot, size), geometry(slot, group, size)
        groups = size[Size.IMAGE_GROUPS]
        step = size[Size.UNKNOWNS] * groups
        near = 1.0 / p[s + Scalar.Q]
        ex, ey = 0.0 - p[s + Scalar.ETA], 0.0 - p[s + Scalar.ETA + 1]
        zero, one = V(0.0), precise(1.0)
        for i in range(size[Size.UNKNOWNS]):
            to = slot.precise + size[Size.MOVES] + i * groups + group
            unknown = size[Size.LIST + i]
            if unknown == 0:
                c0 = (P[g + Geometry.GAMMA] - p[s + Scalar.RAY]) * (0.0 - near)
                c1 = (P[g + Geometry.GAMMA + 1] - p[s + Scalar.RAY + 1]) * (0.0 - near)
                c2 = (P[g + Geometry.GAMMA + 2] - 1.0) * (0.0 - near)
                rank_one(to, step, g, c0, c1, c2, ex, ey, one, P)
            elif unknown < 3:
                c0, c1, c2 = (
                    behind(0, g, t, s, size, P, p), behind(1, g, t, s, size, P, p), behind(2, g, t, s, size, P, p)
                )  # fmt: skip
                eta = s + Scalar.ETA + 2 * unknown
                rank_one(to, step, g, c0, c1, c2, p[eta], p[eta + 1], precise(0.0), P)
            elif unknown < 6:
                c0, c1, c2 = zero, zero, zero
                if unknown == 3:
                    c0 = t * near
                elif unknown == 4:
                    c1 = t * near
                else:
                    c2 = t * near
                rank_one(to, step, g, c0, c1, c2, ex, ey, one, P)
            elif unknown >= 9 and unknown < GROWTH:
                far, track = t * t * (0.5 * near), g + Geometry.TRACK + unknown - 9
                rank_one(to, step, g, far * P[track], far * P[track + 3], far * P[track + 6], ex, ey, one, P)
            else:
                # Turning the acceleration, e_i × A t³/6, and then the patch.
                c0, c1, c2 = zero, zero, zero
                if unknown < GROWTH:
                    far, turned = t * t * t * (near / 6.0), s + Scalar.Q + 9
                    if unknown == 6:
                        c1, c2 = far * (0.0 - p[turned + 2]), far * p[turned + 1]
                    elif unknown == 7:
                        c0, c2 = far * p[turned + 2], far * (0.0 - p[turned])
                    else:
                        c0, c1 = far * (0.0 - p[turned + 1]), far * p[turned]
                rank_one(to, step, g, c0, c1, c2, ex, ey, one, P)
                for c in range(2):
                    for r in range(3):
                        plain = zero
                        if unknown < GROWTH:
                            # (left Jacobian e_i) × the columns of R G L
                            j, k = (r + 1) % 3, (r + 2) % 3
                            axis = g + Geometry.TURN + unknown - 6
                            column = g + Geometry.ML + c
                            plain = P[axis + 3 * j] * P[column + 2 * k] - P[axis + 3 * k] * P[column + 2 * j]
                        else:
                            mode = s + Scalar.MODES + 6 * (unknown - GROWTH) + c
                            for k in range(3):
                                plain = plain + P[g + Geometry.R + 3 * r + k] * p[mode + 2 * k]
                        P[g + Geometry.PLAIN + 2 * r + c] = plain
                two_columns(to, step, g, t, P)

    @ti.func
    def prepare(
        slot: ti.template(), group: ti.i32, size: ti.template(), value: ti.template(), image: ti.template(),
        P: ti.template(), p: ti.template(),
    ):  # fmt: skip
        """Warps of one vector of images, and what every unknown does to them; ``aim`` has been called."""
        s, g = scalars(slot, size), geometry(slot, group, size)
        groups = size[Size.IMAGE_GROUPS]
        t = image[Image.TIME * groups + group]
        turn(g, t, s, P, p)
        for c in range(2):
            for r in range(3):
                total = V(0.0)
                for k in range(3):
                    grown = V(p[s + Scalar.LIFT + 2 * k + c])
                    for j in range(size[Size.MODES]):
                        rate = p[s + Scalar.Q + GROWTH + j] * p[s + Scalar.MODES + 6 * j + 2 * k + c]
                        grown = grown + t * rate
                    total = total + P[g + Geometry.R + 3 * r + k] * grown
                P[g + Geometry.ML + 2 * r + c] = total
        near = 1.0 / p[s + Scalar.Q]
        for r in range(3):
            moved = V(0.0)
            for k in range(3):
                moved = moved + P[g + Geometry.TRACK + 3 * r + k] * p[s + Scalar.Q + 9 + k]
            moved = t * (0.5 * t * moved + p[s + Scalar.Q + 3 + r])
            if r < 2:
                moved = moved - image[(Image.CAMERA_X + r) * groups + group]
            gamma = moved * near + p[s + Scalar.RAY + r]
            P[g + Geometry.GAMMA + r] = gamma
            for c in range(2):
                P[g + Geometry.H + 3 * r + c] = P[g + Geometry.ML + 2 * r + c] - gamma * p[s + Scalar.ETA + c]
            P[g + Geometry.H + 3 * r + 2] = gamma
        invert(g, P)
        moves(slot, group, t, size, value, P, p)
        place(slot, group, size, value, image, P, p)

    @ti.func
    def invert(g: ti.i32, P: ti.template()):
        """The inverse of H by its adjugate."""
        h = g + Geometry.H
        for r in range(3):
            for c in range(3):
                i, j, k, m = (c + 1) % 3, (c + 2) % 3, (r + 1) % 3, (r + 2) % 3
                P[g + Geometry.INVERSE + 3 * r + c] = (
                    P[h + 3 * i + k] * P[h + 3 * j + m] - P[h + 3 * i + m] * P[h + 3 * j + k]
                )
        i = g + Geometry.INVERSE
        scale = 1.0 / (P[h] * P[i] + P[h + 1] * P[i + 3] + P[h + 2] * P[i + 6])
        for k in range(9):
            P[i + k] = P[i + k] * scale

    @ti.func
    def place(
        slot: ti.template(), group: ti.i32, size: ti.template(), value: ti.template(), image: ti.template(),
        P: ti.template(), p: ti.template(),
    ):  # fmt: skip
        """The homography in pixels about the window's and the block's centre, ∂x/∂δ there, the blur's weights, β."""
        s, g = scalars(slot, size), geometry(slot, group, size)
        h, groups = g + Geometry.H, size[Size.IMAGE_GROUPS]
        to = slot.precise + size[Size.HOMOGRAPHY] + group
        depth = 1.0 / P[h + 8]
        for r in range(2):
            centre = image[(Image.SHIFT_X + r) * groups + group] + p[s + Scalar.X0 + r]
            for c in range(3):
                P[to + (3 * r + c) * groups] = (P[h + 3 * r + c] * value[Value.FOCAL] - centre * P[h + 6 + c]) * depth
        gx, gy = P[h + 6] * depth, P[h + 7] * depth
        P[to + 6 * groups] = gx
        P[to + 7 * groups] = gy
        x, y = P[to + 2 * groups], P[to + 5 * groups]
        xx, xy = P[to] - x * gx, P[to + groups] - x * gy
        yx, yy = P[to + 3 * groups] - y * gx, P[to + 4 * groups] - y * gy
        d = to + Warp.D * groups
        P[d], P[d + groups], P[d + 2 * groups], P[d + 3 * groups] = xx, xy, yx, yy
        # D^-1 D^-T - 1
        area = xx * yy - xy * yx
        weight = value[Value.SMOOTHING] / (area * area)
        b = to + Warp.BLUR * groups
        P[b] = (yy * yy + xy * xy) * weight - value[Value.SMOOTHING]
        P[b + groups] = (xx * xy + yx * yy) * weight * (0.0 - 2.0)
        P[b + 2 * groups] = (xx * xx + yx * yx) * weight - value[Value.SMOOTHING]
        t, bend = image[Image.TIME * groups + group], to + Warp.BEND * groups
        b2 = behind(2, g, t, s, size, P, p)
        for r in ti.static(range(2)):
            centre = image[(Image.SHIFT_X + r) * groups + group] + p[s + Scalar.X0 + r]
            P[bend + r * groups] = (behind(r, g, t, s, size, P, p) * value[Value.FOCAL] - centre * b2) * depth
        P[bend + 2 * groups] = b2 * depth

    @ti.func
    def hand_over(slot: ti.template(), k: ti.i32, size: ti.template(), p: ti.template(), r: ti.template()):
        """The numbers of image k, as the samples need them."""
        groups = size[Size.IMAGE_GROUPS]
        to = (slot.real + size[Size.WARP]) * lanes + k * Warp.N
        at = (slot.precise + size[Size.HOMOGRAPHY]) * lanes + k
        for n in range(Warp.GAIN):
            r[to + n] = ti.cast(p[at + n * groups * lanes], real)
        if p[scalars(slot, size) + Scalar.RESAMPLE] > 0.5:
            for n in range(8):
                r[to + Warp.SAMPLED + n] = r[to + n]
        at = (slot.precise + size[Size.GAIN]) * lanes + k
        for n in range(TERMS):
            r[to + Warp.GAIN + n] = ti.cast(p[at + n * groups * lanes], real)
        r[to + Warp.TRUST] = ti.cast(p[(slot.precise + size[Size.TRUST]) * lanes + k], real)

    return SimpleNamespace(scalars=scalars, aim=aim, prepare=prepare, hand_over=hand_over)
