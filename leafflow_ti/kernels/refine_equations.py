"""Normal equations of a pixel from the sums of its images.

With C_k [8, n] what the unknowns do to the functions B of the window, and the texture eliminated, the Jacobian of
image k is ``g_k B^T (C_k - mean C)``; without what the photometric terms ``T φ`` explain,

    H = Σ_k ω_k (C_k - mean C)^T (G - X M^-1 X^T) (C_k - mean C),   G = Σ w B B^T, X = Σ w B Tφ^T, M = Σ w Tφ Tφ^T

where the weights ω_k of the images take the share of their samples that is valid, too.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.refine_tables import FUNCTIONS, SHIFTS, Scalar, Size
from leafflow_ti.kernels.refine_warp import warp_functions
from leafflow_ti.kernels.spec import KernelSpec

UNDETERMINED = 1e-9
"""Share of an unknown's column, squared, that the others must leave of it."""


@functools.cache
def equation_functions(spec: KernelSpec) -> SimpleNamespace:
    """Small dense algebra on the numbers of a pixel, and sums over the vectors of its images."""
    precise, lanes, V = spec.precise, spec.lanes, spec.element
    scalars = warp_functions(spec).scalars

    @ti.func
    def total(v: ti.template()):
        """Sum over the lanes."""
        if ti.static(lanes > 1):
            return v.sum()
        return v

    @ti.func
    def largest(v: ti.template()):
        """Maximum over the lanes."""
        if ti.static(lanes > 1):
            return v.max()
        return v

    @ti.func
    def cholesky(a: ti.i32, n: ti.i32, least: precise, fixed: ti.i32, p: ti.template()):
        """Factor the lower triangle [n, n] of numbers at ``a`` in place. A pivot below ``least`` times its diagonal
        element takes its unknown out; it is marked at ``fixed``."""
        for c in range(n):
            diagonal = p[a + c * n + c]
            pivot = diagonal
            for k in range(c):
                pivot -= p[a + c * n + k] * p[a + c * n + k]
            good = pivot > least * diagonal
            p[fixed + c] = ti.select(good, precise(0.0), precise(1.0))
            root = ti.sqrt(ti.max(pivot, precise(1e-30)))
            for r in range(c + 1, n):
                element = p[a + r * n + c]
                for k in range(c):
                    element -= p[a + r * n + k] * p[a + c * n + k]
                p[a + r * n + c] = ti.select(good, element / root, precise(0.0))
            p[a + c * n + c] = ti.select(good, root, precise(1.0))
            if not good:
                for k in range(c):
                    p[a + c * n + k] = precise(0.0)

    @ti.func
    def substitute(a: ti.i32, n: ti.i32, x: ti.i32, step: ti.i32, p: ti.template()):
        """Solve with a factor in place: right-hand side and solution at ``x``, ``step`` apart."""
        for r in range(n):
            element = p[x + r * step]
            for k in range(r):
                element -= p[a + r * n + k] * p[x + k * step]
            p[x + r * step] = element / p[a + r * n + r]
        for m in range(n):
            r = n - 1 - m
            element = p[x + r * step]
            for k in range(r + 1, n):
                element -= p[a + k * n + r] * p[x + k * step]
            p[x + r * step] = element / p[a + r * n + r]

    @ti.func
    def weight_at(slot: ti.template(), g: ti.i32, size: ti.template(), P: ti.template(), whole: precise):
        """Weights of a vector of images: trust times the share of their samples."""
        return P[slot.precise + size[Size.TRUST] + g] * P[slot.precise + size[Size.MASS] + g] * (1.0 / whole)

    @ti.func
    def photometry(slot: ti.template(), size: ti.template(), p: ti.template()):
        """Factor of M, ``M^-1 X^T``, and the metric ``G - X M^-1 X^T``."""
        s, terms = scalars(slot, size), size[Size.TERMS]
        gram = s + Scalar.GRAM
        for i in range(terms):
            for j in range(terms):
                p[s + Scalar.TERMS + i * terms + j] = p[gram + (SHIFTS + i) * FUNCTIONS + SHIFTS + j]
        cholesky(s + Scalar.TERMS, terms, precise(1e-12), s + Scalar.FIXED, p)
        for b in range(SHIFTS):
            for m in range(terms):
                p[s + Scalar.SOLVED + m * SHIFTS + b] = p[gram + b * FUNCTIONS + SHIFTS + m]
            substitute(s + Scalar.TERMS, terms, s + Scalar.SOLVED + b, SHIFTS, p)
        for a in range(SHIFTS):
            for b in range(SHIFTS):
                element = p[gram + a * FUNCTIONS + b]
                for m in range(terms):
                    element -= p[gram + a * FUNCTIONS + SHIFTS + m] * p[s + Scalar.SOLVED + m * SHIFTS + b]
                p[s + Scalar.METRIC + a * SHIFTS + b] = element

    @ti.func
    def centre_moves(slot: ti.template(), size: ti.template(), P: ti.template(), p: ti.template()):
        """Subtract from the moves their mean over the images: what is common to all is texture."""
        s, n, groups = scalars(slot, size), size[Size.UNKNOWNS], size[Size.IMAGE_GROUPS]
        whole = p[s + Scalar.MASS]
        all_images = precise(0.0)
        for g in range(groups):
            all_images += total(weight_at(slot, g, size, P, whole))
        for i in range(SHIFTS * n):
            at = slot.precise + size[Size.MOVES] + i * groups
            mean = V(0.0)
            for g in range(groups):
                mean = mean + P[at + g] * weight_at(slot, g, size, P, whole)
            average = total(mean) / ti.max(all_images, precise(1e-30))
            for g in range(groups):
                P[at + g] = P[at + g] - average

    @ti.func
    def normal_equations(
        slot: ti.template(), metric: ti.i32, squared: ti.i32, size: ti.template(), P: ti.template(), p: ti.template()
    ):
        """Packed ``Σ ω C^T metric C`` into NORMAL; with ω² where ``squared``."""
        s, n, groups = scalars(slot, size), size[Size.UNKNOWNS], size[Size.IMAGE_GROUPS]
        whole = p[s + Scalar.MASS]
        normal, product = slot.precise + size[Size.NORMAL], slot.precise + size[Size.PRODUCT]
        for i in range(n * (n + 1) // 2):
            P[normal + i] = V(0.0)
        for g in range(groups):
            weight = weight_at(slot, g, size, P, whole)
            if squared > 0:
                weight = weight * P[slot.precise + size[Size.TRUST] + g]
            first = slot.precise + size[Size.MOVES] + g
            for i in range(n):
                for a in range(SHIFTS):
                    element = V(0.0)
                    for b in range(SHIFTS):
                        element = element + P[first + (b * n + i) * groups] * p[metric + a * SHIFTS + b]
                    P[product + a] = element * weight
                for j in range(i + 1):
                    element = P[normal + i * (i + 1) // 2 + j]
                    for a in range(SHIFTS):
                        element = element + P[first + (a * n + j) * groups] * P[product + a]
                    P[normal + i * (i + 1) // 2 + j] = element

    @ti.func
    def right_side(slot: ti.template(), size: ti.template(), P: ti.template(), p: ti.template()):
        """``Σ ω C^T (residual sums without the photometric terms')``."""
        s, n, groups = scalars(slot, size), size[Size.UNKNOWNS], size[Size.IMAGE_GROUPS]
        right, product = slot.precise + size[Size.RIGHT], slot.precise + size[Size.PRODUCT]
        sums = slot.precise + size[Size.SUMS]
        for i in range(n):
            P[right + i] = V(0.0)
        for g in range(groups):
            trust = P[slot.precise + size[Size.TRUST] + g]
            for b in range(SHIFTS):
                element = P[sums + b * groups + g]
                for m in range(size[Size.TERMS]):
                    element = element - P[sums + (SHIFTS + m) * groups + g] * p[s + Scalar.SOLVED + m * SHIFTS + b]
                P[product + b] = element * trust
            for i in range(n):
                element = P[right + i]
                for b in range(SHIFTS):
                    element = element + P[slot.precise + size[Size.MOVES] + (b * n + i) * groups + g] * P[product + b]
                P[right + i] = element
        for i in range(n):
            p[s + Scalar.RIGHT + i] = total(P[right + i])

    @ti.func
    def scaled_factor(slot: ti.template(), size: ti.template(), P: ti.template(), p: ti.template()):
        """Cholesky factor of the normal matrix, its columns scaled to a diagonal of 1."""
        s, n = scalars(slot, size), size[Size.UNKNOWNS]
        normal = slot.precise + size[Size.NORMAL]
        for i in range(n):
            diagonal = total(P[normal + i * (i + 1) // 2 + i])
            p[s + Scalar.SCALE + i] = 1.0 / ti.sqrt(ti.max(diagonal, precise(1e-30)))
        for i in range(n):
            for j in range(i + 1):
                element = total(P[normal + i * (i + 1) // 2 + j])
                p[s + Scalar.NORMAL + i * n + j] = element * p[s + Scalar.SCALE + i] * p[s + Scalar.SCALE + j]
        cholesky(s + Scalar.NORMAL, n, precise(UNDETERMINED), s + Scalar.FIXED, p)

    return SimpleNamespace(
        total=total, largest=largest, cholesky=cholesky, substitute=substitute, weight_at=weight_at,
        photometry=photometry, centre_moves=centre_moves, normal_equations=normal_equations, right_side=right_side,
        scaled_factor=scaled_factor,
    )  # fmt: skip
