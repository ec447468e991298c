"""Steps of a pixel's refinement: weights of the images, the step, and its control."""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.refine_equations import equation_functions
from leafflow_ti.kernels.refine_tables import (
    FUNCTIONS,
    GROWTH,
    MAX_UNKNOWNS,
    SHIFTS,
    SHOWN,
    START,
    TERMS,
    Code,
    Image,
    Scalar,
    Size,
    Value,
)
from leafflow_ti.kernels.refine_warp import warp_functions
from leafflow_ti.kernels.spec import KernelSpec

LEAST_IMAGES = 1.5
"""Images that must be left for a comparison, robust weights taken off: of two, some of the samples."""
LONGEST_STEP = 1.0
"""Pixels that a step may move anything in the window of any image."""
RISE = 1.02
"""Factor by which a step may raise the cost: near the end its direction is that of what is approximated."""
DRIFT = 0.05
"""Pixels that the warps may move before the images are sampled anew."""
OUTLYING = 16.0
"""Mean squared residual of an image, against the typical one, beyond which it is trusted less."""
TOLERATED = 0.03
"""Pixels of misplacement whose residual is no reason to trust an image or a sample less."""
TUKEY = 6.0
"""Standard deviations beyond which a sample has no weight."""
MOST_IMAGES, LEVELS = 0.8, 8
"""Share of the images that show a sample of a window where light is fitted, at most; and how many shares are tried."""
WHOLE = 0.97
"""Share of the window that an image must show to take part where light is fitted."""
CONVERGED = 0.01
"""Square of a step, in standard errors, that ends the iteration."""
LEFT = 0.25
"""The same of what may be left to go after the last of the allowed steps, if the next ones shrink as this one did."""
CONTRACTED = 0.1
"""Share of the square by which a first step is supposed to shrink."""
NOTHING_MOVED = 1e-3
"""Pixels by which a step without noise may move the images where one with noise may take a standard error."""


@functools.cache
def solve_functions(spec: KernelSpec) -> SimpleNamespace:
    """``begin``: a pixel's start. ``masses``: of its window. ``solve``: one step. ``one_error``: its unit."""
    precise, lanes, V = spec.precise, spec.lanes, spec.element
    scalars, equations = warp_functions(spec).scalars, equation_functions(spec)
    total, largest, substitute = equations.total, equations.largest, equations.substitute
    not_converged, singular, empty, worse = (
        float(c) for c in (Code.NOT_CONVERGED, Code.SINGULAR, Code.EMPTY, Code.WORSE)
    )

    @ti.func
    def begin(
        slot: ti.template(), pixel: ti.i32, size: ti.template(), image: ti.template(), start: ti.template(),
        P: ti.template(), p: ti.template(),
    ):  # fmt: skip
        """The start of a pixel: position and parameters; all images trusted, no change of brightness."""
        s, groups = scalars(slot, size), size[Size.IMAGE_GROUPS]
        at = pixel * START
        p[s + Scalar.X0], p[s + Scalar.Y0] = start[at], start[at + 1]
        for i in range(MAX_UNKNOWNS):
            p[s + Scalar.Q + i] = start[at + 2 + i]
            p[s + Scalar.ACCEPTED + i] = start[at + 2 + i]
        for i in range(3):
            p[s + Scalar.CURVATURE + i] = start[at + 2 + MAX_UNKNOWNS + i]
        for i in range(Scalar.COST, Scalar.ROBUST + 1):
            p[s + i] = precise(0.0)
        p[s + Scalar.RESAMPLE], p[s + Scalar.DRIFT], p[s + Scalar.SAMPLINGS] = precise(1.0), precise(0.0), precise(0.0)
        for g in range(groups):
            P[slot.precise + size[Size.KEPT] + g] = image[Image.PRESENT * groups + g]
            P[slot.precise + size[Size.TRUST] + g] = image[Image.PRESENT * groups + g]
            for m in range(TERMS):
                P[slot.precise + size[Size.GAIN] + m * groups + g] = V(0.0)
                P[slot.precise + size[Size.GAIN_STEP] + m * groups + g] = V(0.0)

    @ti.func
    def tolerated(slot: ti.template(), size: ti.template(), p: ti.template()):
        """Mean squared residual of a texture that is slightly misplaced."""
        s = scalars(slot, size)
        gradient = p[s + Scalar.GRAM] + p[s + Scalar.GRAM + FUNCTIONS + 1]
        return 0.5 * TOLERATED * TOLERATED * gradient / ti.max(p[s + Scalar.MASS], precise(1e-30))

    @ti.func
    def plain_variance(weighted: precise, limit: precise) -> precise:
        """Variance of normal residuals whose mean square under Tukey's weights is ``weighted``."""
        found = weighted
        if limit > 0.0:
            for _ in range(4):
                # Expectations of z² m and of m, m = (1 - z²/c²)², c far outside.
                inverse = ti.min(found / limit, precise(0.1))
                found = (
                    weighted
                    * (1.0 - 2.0 * inverse + 3.0 * inverse * inverse)
                    / (1.0 - 6.0 * inverse + 15.0 * inverse * inverse)
                )
        return found

    @ti.func
    def leave_light_out(slot: ti.template(), size: ti.template(), P: ti.template(), p: ti.template()):
        """Take from the squared residuals of the images what a change of their photometric terms would."""
        s, groups, terms = scalars(slot, size), size[Size.IMAGE_GROUPS], size[Size.TERMS]
        whole, product = p[s + Scalar.MASS], slot.precise + size[Size.PRODUCT]
        for g in range(groups):
            lit = V(0.0)
            for r in range(terms):
                element = P[slot.precise + size[Size.SUMS] + (SHIFTS + r) * groups + g]
                for k in range(r):
                    element = element - P[product + k] * p[s + Scalar.TERMS + r * terms + k]
                P[product + r] = element * (1.0 / p[s + Scalar.TERMS + r * terms + r])
                lit = lit + P[product + r] * P[product + r]
            share = ti.max(P[slot.precise + size[Size.MASS] + g] * (1.0 / whole), V(0.1))
            energy = P[slot.precise + size[Size.ENERGY] + g]
            # Of an image that is partly seen the explained part is an estimate.
            P[slot.precise + size[Size.ENERGY] + g] = ti.max(energy - lit / share, 1e-6 * energy)

    @ti.func
    def weigh(slot: ti.template(), size: ti.template(), P: ti.template(), p: ti.template()):
        """Cost of the pass, and the weights of the images from their residuals, against the harmonic mean of these."""
        s, groups = scalars(slot, size), size[Size.IMAGE_GROUPS]
        energy, mass, inverse, counted = precise(0.0), precise(0.0), precise(0.0), precise(0.0)
        whole = p[s + Scalar.MASS]
        if p[s + Scalar.PASSES] < 1.5 and size[Size.TERMS] > 0:
            for g in range(groups):
                seen = ti.select(P[slot.precise + size[Size.MASS] + g] > V(WHOLE * whole), V(1.0), V(0.0))
                P[slot.precise + size[Size.KEPT] + g] = P[slot.precise + size[Size.KEPT] + g] * seen
                P[slot.precise + size[Size.TRUST] + g] = P[slot.precise + size[Size.TRUST] + g] * seen
        for g in range(groups):
            e, m = P[slot.precise + size[Size.ENERGY] + g], P[slot.precise + size[Size.MASS] + g]
            trust = P[slot.precise + size[Size.TRUST] + g]
            energy += total(e * trust)
            mass += total(m * trust)
            some = ti.select(m > V(0.1 * whole), V(1.0), V(0.0))
            inverse += total(some * m / ti.max(e, V(1e-30)))
            counted += total(some)
        p[s + Scalar.COST] = plain_variance(energy / ti.max(mass, precise(1e-30)), p[s + Scalar.ROBUST])
        p[s + Scalar.IMAGES] = mass / ti.max(whole, precise(1e-30))
        typical = ti.max(counted / ti.max(inverse, precise(1e-30)), tolerated(slot, size, p))
        for g in range(groups):
            e, m = P[slot.precise + size[Size.ENERGY] + g], P[slot.precise + size[Size.MASS] + g]
            bound = V(OUTLYING * typical) * m / ti.max(e, V(1e-30))
            share = ti.min(bound, V(1.0))
            P[slot.precise + size[Size.TRUST] + g] = P[slot.precise + size[Size.KEPT] + g] * share * share

    @ti.func
    def farthest(slot: ti.template(), size: ti.template(), value: ti.template(), P: ti.template(), p: ti.template()):
        """How far the step moves anything in the window of any image, px."""
        s, n, groups = scalars(slot, size), size[Size.UNKNOWNS], size[Size.IMAGE_GROUPS]
        half = value[Value.HALF]
        worst = V(0.0)
        for g in range(groups):
            square = V(0.0)
            for b in range(6):
                moved = V(0.0)
                for i in range(n):
                    at = slot.precise + size[Size.MOVES] + (b * n + i) * groups + g
                    moved = moved + P[at] * p[s + Scalar.STEP + i]
                weight = ti.select(b < 2, precise(1.0), 0.5 * half * half)
                square = square + moved * moved * weight
            worst = ti.max(worst, square * P[slot.precise + size[Size.TRUST] + g])
        return ti.sqrt(largest(worst))

    @ti.func
    def change_gains(slot: ti.template(), factor: precise, size: ti.template(), P: ti.template(), p: ti.template()):
        """The photometric terms' own step, given that of the unknowns."""
        s, n, groups, terms = scalars(slot, size), size[Size.UNKNOWNS], size[Size.IMAGE_GROUPS], size[Size.TERMS]
        whole, product = p[s + Scalar.MASS], slot.precise + size[Size.PRODUCT]
        for g in range(groups):
            for b in range(SHIFTS):
                moved = V(0.0)
                for i in range(n):
                    at = slot.precise + size[Size.MOVES] + (b * n + i) * groups + g
                    moved = moved + P[at] * p[s + Scalar.STEP + i]
                P[product + b] = moved
            share = P[slot.precise + size[Size.MASS] + g] * (1.0 / whole)
            enough = ti.select(share > V(0.1), V(1.0), V(0.0)) / ti.max(share, V(0.1))
            # M^-1 b by the factor, in place of b.
            sums = slot.precise + size[Size.SUMS] + SHIFTS * groups + g
            factor_at = s + Scalar.TERMS
            for r in range(terms):
                element = P[sums + r * groups]
                for k in range(r):
                    element = element - P[sums + k * groups] * p[factor_at + r * terms + k]
                P[sums + r * groups] = element * (1.0 / p[factor_at + r * terms + r])
            for m in range(terms):
                r = terms - 1 - m
                element = P[sums + r * groups]
                for k in range(r + 1, terms):
                    element = element - P[sums + k * groups] * p[factor_at + k * terms + r]
                P[sums + r * groups] = element * (1.0 / p[factor_at + r * terms + r])
            for m in range(terms):
                change = P[sums + m * groups] * enough
                for b in range(SHIFTS):
                    change = change + P[product + b] * p[s + Scalar.SOLVED + m * SHIFTS + b]
                at = slot.precise + size[Size.GAIN_STEP] + m * groups + g
                P[at] = change * factor
                at = slot.precise + size[Size.GAIN] + m * groups + g
                P[at] = P[at] + change * factor

    @ti.func
    def shorten(slot: ti.template(), size: ti.template(), P: ti.template(), p: ti.template()):
        """Go back by half the last step."""
        s, groups = scalars(slot, size), size[Size.IMAGE_GROUPS]
        p[s + Scalar.BACK] *= 0.5
        for i in range(size[Size.UNKNOWNS]):
            u = size[Size.LIST + i]
            p[s + Scalar.Q + u] = p[s + Scalar.ACCEPTED + u] + p[s + Scalar.BACK] * p[s + Scalar.STEP + i]
        for m in range(size[Size.TERMS]):
            for g in range(groups):
                to = slot.precise + size[Size.GAIN_STEP] + m * groups + g
                P[to] = P[to] * 0.5
                at = slot.precise + size[Size.GAIN] + m * groups + g
                P[at] = P[at] - P[to]

    @ti.func
    def one_error(slot: ti.template(), size: ti.template(), value: ti.template(), p: ti.template()):
        """Square of a step by a standard error of every unknown, or of one that moves the images by next to nothing."""
        s, n = scalars(slot, size), ti.cast(size[Size.UNKNOWNS], precise)
        # The noise of the sums is correlated and weighted.
        noise = p[s + Scalar.COST] * value[Value.CORRELATION] * n
        least = tolerated(slot, size, p) * p[s + Scalar.MASS] * p[s + Scalar.IMAGES]
        return ti.max(noise, least * (NOTHING_MOVED / TOLERATED) ** 2)

    @ti.func
    def step(slot: ti.template(), size: ti.template(), value: ti.template(), P: ti.template(), p: ti.template()):
        """Solve the normal equations and go one step."""
        s, n = scalars(slot, size), size[Size.UNKNOWNS]
        equations.centre_moves(slot, size, P, p)
        equations.normal_equations(slot, s + Scalar.METRIC, 0, size, P, p)
        equations.right_side(slot, size, P, p)
        equations.scaled_factor(slot, size, P, p)
        lost = precise(0.0)
        for i in range(n):
            p[s + Scalar.STEP + i] = 0.0 - p[s + Scalar.RIGHT + i] * p[s + Scalar.SCALE + i]
            if p[s + Scalar.FIXED + i] > 0.5:
                p[s + Scalar.STEP + i] = precise(0.0)
                if size[Size.LIST + i] < GROWTH:
                    lost = precise(1.0)
        substitute(s + Scalar.NORMAL, n, s + Scalar.STEP, 1, p)
        square = precise(0.0)
        for i in range(n):
            p[s + Scalar.STEP + i] *= p[s + Scalar.SCALE + i]
            square -= p[s + Scalar.STEP + i] * p[s + Scalar.RIGHT + i]
        far = farthest(slot, size, value, P, p)
        factor = ti.min(precise(1.0), LONGEST_STEP / ti.max(far, precise(1e-30)))
        # Moves are about their mean, so the images move by up to twice as much.
        p[s + Scalar.DRIFT] += 2.0 * far * factor
        for i in range(n):
            p[s + Scalar.STEP + i] *= factor
            u = size[Size.LIST + i]
            p[s + Scalar.Q + u] = p[s + Scalar.ACCEPTED + u] + p[s + Scalar.STEP + i]
        change_gains(slot, factor, size, P, p)
        p[s + Scalar.BACK] = precise(1.0)
        # The share of the square by which steps shrink, known from the second one on.
        shrink = CONTRACTED
        if p[s + Scalar.LAST] > 0.0:
            shrink = ti.min(square / p[s + Scalar.LAST], precise(1.0))
        p[s + Scalar.LAST] = square
        ratio = ti.sqrt(shrink)
        p[s + Scalar.LEFT] = square * shrink / ti.max((1.0 - ratio) * (1.0 - ratio), precise(1e-30))
        if square < CONVERGED * one_error(slot, size, value, p) and factor > 0.999:
            p[s + Scalar.DONE] = precise(1.0)
        if lost > 0.5 or not (far < 1e6):
            p[s + Scalar.DONE], p[s + Scalar.CODE] = precise(1.0), singular

    @ti.func
    def solve(slot: ti.template(), size: ti.template(), value: ti.template(), P: ti.template(), p: ti.template()):
        """Judge the pass, and go a step further, or half the last step back. The last of the allowed steps is judged by
        its size: it is not looked at again."""
        s = scalars(slot, size)
        p[s + Scalar.PASSES] += 1.0
        p[s + Scalar.SAMPLINGS] += p[s + Scalar.RESAMPLE]
        passes = ti.cast(p[s + Scalar.PASSES], ti.i32)
        # The cost is that of the best photometric terms: without them a change of light would count as noise.
        equations.photometry(slot, size, p)
        leave_light_out(slot, size, P, p)
        weigh(slot, size, P, p)
        cost = p[s + Scalar.COST]
        if passes == 1:
            p[s + Scalar.START] = cost
        if p[s + Scalar.IMAGES] < LEAST_IMAGES:
            p[s + Scalar.DONE], p[s + Scalar.CODE] = precise(1.0), empty
        elif passes > 1 and not (cost <= p[s + Scalar.BEST] * RISE):
            shorten(slot, size, P, p)
            if passes >= size[Size.STEPS]:
                p[s + Scalar.DONE], p[s + Scalar.CODE] = precise(1.0), worse
        else:
            p[s + Scalar.BEST] = cost
            for i in range(MAX_UNKNOWNS):
                p[s + Scalar.ACCEPTED + i] = p[s + Scalar.Q + i]
            step(slot, size, value, P, p)
            if passes >= size[Size.STEPS] and p[s + Scalar.DONE] < 0.5:
                p[s + Scalar.DONE] = precise(1.0)
                # Steps that are small no longer shrink: they follow the robust weights.
                if ti.min(p[s + Scalar.LAST], p[s + Scalar.LEFT]) > LEFT * one_error(slot, size, value, p):
                    p[s + Scalar.CODE] = not_converged
        p[s + Scalar.ROBUST] = TUKEY * TUKEY * ti.max(cost, tolerated(slot, size, p))
        p[s + Scalar.RESAMPLE] = precise(0.0)
        if p[s + Scalar.DRIFT] > DRIFT:
            p[s + Scalar.RESAMPLE], p[s + Scalar.DRIFT] = precise(1.0), precise(0.0)

    @ti.func
    def agree(slot: ti.template(), size: ti.template(), r: ti.template()):
        """Leave samples out that fewer images show than others: light would be fitted to different parts of the window
        in different images. Which are left out is chosen so that most is kept, samples times images."""
        first = (slot.real + size[Size.WEIGHT]) * lanes
        shown = (slot.real + size[Size.SCRATCH] + SHOWN * size[Size.SAMPLE_GROUPS]) * lanes
        best, least = ti.cast(0.0, spec.real), ti.cast(0.0, spec.real)
        for n in range(LEVELS):
            images = ti.cast(size[Size.IMAGES] * (LEVELS - n), spec.real) * ti.cast(MOST_IMAGES / LEVELS, spec.real)
            kept = ti.cast(0.0, spec.real)
            for i in range(size[Size.SAMPLES]):
                kept += ti.select(r[shown + i] > images, r[first + i], ti.cast(0.0, spec.real))
            if images * kept > best:
                best, least = images * kept, images
        for i in range(size[Size.SAMPLES]):
            r[first + i] = ti.select(r[shown + i] > least, r[first + i], ti.cast(0.0, spec.real))

    @ti.func
    def masses(slot: ti.template(), size: ti.template(), r: ti.template(), p: ti.template()):
        """In the first pass: weight of the window, and how many samples of equal weight it stands for."""
        s = scalars(slot, size)
        if p[s + Scalar.PASSES] < 0.5:
            first = (slot.real + size[Size.WEIGHT]) * lanes
            if size[Size.TERMS] > 0:
                agree(slot, size, r)
            one, two = precise(0.0), precise(0.0)
            for i in range(size[Size.SAMPLES]):
                w = ti.cast(r[first + i], precise)
                one += w
                two += w * w
            p[s + Scalar.MASS] = one
            p[s + Scalar.EFFECTIVE] = one * one / ti.max(two, precise(1e-30))

    return SimpleNamespace(begin=begin, masses=masses, solve=solve, one_error=one_error)
