"""What a refined pixel comes to: parameters, their covariance, and whether the window held a single surface."""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.refine_equations import equation_functions
from leafflow_ti.kernels.refine_solve import LEFT, solve_functions
from leafflow_ti.kernels.refine_tables import MAX_UNKNOWNS, SHIFTS, Code, Out, Scalar, Size
from leafflow_ti.kernels.refine_warp import warp_functions
from leafflow_ti.kernels.spec import KernelSpec

DOUBTFUL = 4.0
"""Mean square of how much the halves of the window contradict each other, in standard errors, beyond which error bars
grow with it: the window then holds more than a plane in rigid motion, and its residual is not noise alone."""


@functools.cache
def result_functions(spec: KernelSpec) -> SimpleNamespace:
    """``finish``: covariance and results of a pixel, whose sums of halves and noise have been made."""
    precise, V = spec.precise, spec.element
    scalars, equations = warp_functions(spec).scalars, equation_functions(spec)
    total, substitute = equations.total, equations.substitute
    one_error, not_converged = solve_functions(spec).one_error, float(Code.NOT_CONVERGED)

    @ti.func
    def doubt(slot: ti.template(), variance: precise, size: ti.template(), P: ti.template(), p: ti.template()):
        """Factor for the variances: 1, or how much the halves of the window contradict each other.

        What one half says of an unknown more than the other has the variance of what both say together, the scaled
        NORMAL of the noise.
        """
        s, n, groups = scalars(slot, size), size[Size.UNKNOWNS], size[Size.IMAGE_GROUPS]
        worst = precise(0.0)
        for half in range(2):
            square = precise(0.0)
            for i in range(n):
                total_score = V(0.0)
                for b in range(SHIFTS):
                    moves = slot.precise + size[Size.MOVES] + (b * n + i) * groups
                    sums = slot.precise + size[Size.HALVES] + (half * SHIFTS + b) * groups
                    for g in range(groups):
                        trust = P[slot.precise + size[Size.TRUST] + g]
                        total_score = total_score + P[moves + g] * P[sums + g] * trust
                score = total(total_score) * p[s + Scalar.SCALE + i]
                expected = variance * ti.max(p[s + Scalar.NORMAL + i * n + i], precise(1e-30))
                square += score * score / (expected * ti.cast(n, precise))
            worst = ti.max(worst, square)
        return ti.select(worst > DOUBTFUL, worst, precise(1.0))

    @ti.func
    def finish(
        slot: ti.template(), pixel: ti.i32, size: ti.template(), value: ti.template(), P: ti.template(),
        p: ti.template(), out: ti.template(),
    ):  # fmt: skip
        """Results and their covariance ``σ² H^-1 S H^-1``; rows of -1 where the data do not determine an unknown."""
        s, n = scalars(slot, size), size[Size.UNKNOWNS]
        to = pixel * Out.N
        out[to + Out.CODE], out[to + Out.PASSES] = p[s + Scalar.CODE], p[s + Scalar.PASSES]
        out[to + Out.SAMPLINGS] = p[s + Scalar.SAMPLINGS]
        out[to + Out.START], out[to + Out.COST] = p[s + Scalar.START], p[s + Scalar.COST]
        for i in range(MAX_UNKNOWNS):
            out[to + Out.Q + i] = p[s + Scalar.Q + i]
        for i in range(MAX_UNKNOWNS * MAX_UNKNOWNS):
            out[to + Out.COVARIANCE + i] = precise(0.0)
        # The factor of H is still there; NORMAL takes Σ ω² C^T S C.
        for i in range(n):
            for j in range(n):
                p[s + Scalar.INVERSE + i * n + j] = ti.cast(i == j, precise)
            substitute(s + Scalar.NORMAL, n, s + Scalar.INVERSE + i * n, 1, p)
        equations.normal_equations(slot, s + Scalar.NOISE, 1, size, P, p)
        for i in range(n):
            for j in range(i + 1):
                element = total(P[slot.precise + size[Size.NORMAL] + i * (i + 1) // 2 + j])
                element *= p[s + Scalar.SCALE + i] * p[s + Scalar.SCALE + j]
                p[s + Scalar.NORMAL + i * n + j] = element
                p[s + Scalar.NORMAL + j * n + i] = element
        images = p[s + Scalar.IMAGES]
        # The texture takes one image's worth of residuals, the photometric terms a few samples' of each.
        left = (1.0 - 1.0 / images) * ti.max(
            1.0 - ti.cast(size[Size.TERMS], precise) / p[s + Scalar.EFFECTIVE], precise(0.1)
        )
        variance = p[s + Scalar.COST] / left
        factor = doubt(slot, variance, size, P, p)
        variance *= factor
        if p[s + Scalar.CODE] == not_converged:
            # What is left to go may be small against error bars that have grown.
            left = ti.min(p[s + Scalar.LAST], p[s + Scalar.LEFT])
            if left < LEFT * factor * one_error(slot, size, value, p):
                out[to + Out.CODE] = precise(0.0)
        for i in range(n):
            for j in range(n):
                element = precise(0.0)
                for k in range(n):
                    element += p[s + Scalar.INVERSE + i * n + k] * p[s + Scalar.NORMAL + k * n + j]
                p[s + Scalar.SPREAD + i * n + j] = element
        for i in range(n):
            for j in range(n):
                element = precise(0.0)
                for k in range(n):
                    element += p[s + Scalar.SPREAD + i * n + k] * p[s + Scalar.INVERSE + k * n + j]
                element *= variance * p[s + Scalar.SCALE + i] * p[s + Scalar.SCALE + j]
                fixed = p[s + Scalar.FIXED + i] + p[s + Scalar.FIXED + j] > 0.5
                a, b = size[Size.LIST + i], size[Size.LIST + j]
                out[to + Out.COVARIANCE + a * MAX_UNKNOWNS + b] = ti.select(fixed, precise(-1.0), element)

    return SimpleNamespace(finish=finish)
