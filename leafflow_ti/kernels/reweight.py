"""Windows weighted anew, pixel by pixel: sums over the cells of a window with weights that depend on a solution.

A *cell* is a block of the window's pixels with all its camera and time samples; its tensor J_b is what the products'
block sums are. ``M = Σ ω_b J_b`` takes the place of the structure tensor, and ``N = Σ ω_b w_b C_b`` that of the noise
covariance of its columns, C being Eq. (2.24) of Schuchert 2010; both are normalised to a mean weight of 1. Exact where
a cell is one sample; otherwise its samples share one weight, in M and N alike.
"""

import functools
from types import SimpleNamespace

from leafflow_ti.kernels.dense import dense, tri
from leafflow_ti.kernels.engine import ti
from leafflow_ti.kernels.group import region
from leafflow_ti.kernels.numbers import AGAIN, NARROW, Penalty, Weights
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.workspace import Number, Region, Value

LEAST_SHARE = 1e-3
"""Least mean weight of a window: where next to nothing counts, the solution stays as it is."""


@functools.cache
def reweight_stages(spec: KernelSpec) -> SimpleNamespace:
    """The stages ``begin_weights``, ``reweight`` and ``relax``."""
    precise, lanes, V = spec.precise, spec.lanes, spec.element
    small = dense(spec)

    @ti.func
    def parameter(j: ti.i32, r: ti.i32, p: ti.template(), number: ti.template(), ws: ti.template()):
        """Entry r of the full null vector of solution j."""
        flow = number[p.n + Number.FLOW]
        element = V(ti.cast(r - flow == j, precise))
        if r < flow:
            element = ws[region(p, number, Region.PARAMETERS) + (j * flow + r) * p.stride]
        return element

    @ti.func
    def gauge(
        j: ti.i32, plain: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()
    ):
        """The noise of the residual of solution j: of all columns, or of the time-like one alone."""
        flow = number[p.n + Number.FLOW]
        total = V(value[p.v + Value.NOISE + flow + j])
        if plain == 0:
            for r in range(flow):
                element = parameter(j, r, p, number, ws)
                total = total + element * element * value[p.v + Value.NOISE + r]
        return total

    @ti.func
    def prepare(plain: ti.i32, p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template()):
        """Mean squared residual and mean relative noise of the solutions, as functions of a cell's sums."""
        n, k = number[p.n + Number.N], number[p.n + Number.SOLUTIONS]
        quadratic, relative = region(p, number, Region.QUADRATIC), region(p, number, Region.RELATIVE)
        lists, values = p.n + number[p.n + Number.CELL_LISTS], p.v + number[p.n + Number.CELL_VALUES]
        terms, noises = number[p.n + Number.CELL_TERMS], number[p.n + Number.CELL_NOISES]
        first_noise = lists + number[p.n + Number.EXTRA] + 1 + 3 * terms
        small.clear(ws, quadratic, number[p.n + Number.EXTRA], p.stride)
        small.clear(ws, relative, number[p.n + Number.CELL_MONOMIALS], p.stride)
        for j in range(k):
            share = 1.0 / (gauge(j, plain, p, number, value, ws) * ti.cast(k, precise))
            for r in range(n):
                one = parameter(j, r, p, number, ws) * share
                for c in range(r + 1):
                    at = quadratic + number[p.n + Number.LOWER + tri(r, c)] * p.stride
                    twice = ti.select(r == c, precise(1.0), precise(2.0))
                    ws[at] = ws[at] + one * parameter(j, c, p, number, ws) * twice
            for e in range(noises):
                r, c = number[first_noise + 3 * e], number[first_noise + 3 * e + 1]
                at = relative + number[first_noise + 3 * e + 2] * p.stride
                twice = ti.select(r == c, precise(1.0), precise(2.0))
                both = parameter(j, r, p, number, ws) * parameter(j, c, p, number, ws)
                ws[at] = ws[at] + both * share * (twice * value[values + terms + e])

    @ti.func
    def begin_weights(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Before any weights: which pixels are weighted anew, and the first σ² of the penalty.

        ``which`` counts in ``Weights``, plus AGAIN where the pixels have been chosen before.
        """
        kind = p.which % AGAIN
        n, k = number[p.n + Number.N], number[p.n + Number.SOLUTIONS]
        moments, quadratic = region(p, number, Region.MOMENTS), region(p, number, Region.QUADRATIC)
        prepare(ti.cast(kind == Weights.PENALTY_PLAIN, ti.i32), p, number, value, ws)
        entries = number[p.n + Number.EXTRA]
        # Means over what is seen of the window, as the residuals of the cells are.
        seen = ti.max(ws[moments + entries * p.stride], V(1e-6))
        residual = small.dot(ws, quadratic, 1, moments, 1, entries, p.stride) / seen
        ix, iy = number[p.n + Number.FLOW_ROWS], number[p.n + Number.FLOW_ROWS + 1]
        energy = ws[moments + number[p.n + Number.LOWER + tri(ix, ix)] * p.stride]
        energy = energy + ws[moments + number[p.n + Number.LOWER + tri(iy, iy)] * p.stride]
        energy = energy / seen
        gain = precise(0.0)
        for j in range(k):
            gain += value[p.v + Value.NOISE + n - k + j] / ti.cast(k, precise)
        energy = energy * (precise(0.5) / gain)
        level = value[p.v + Value.NOISE_LEVEL]
        least = region(p, number, Region.LEAST_SQUARED)
        if p.which < AGAIN:
            lowest = energy * value[p.v + Value.LEAST_DISPLACED] + level * value[p.v + Value.LEAST_NOISE]
            ws[least] = ti.max(lowest, V(1e-30))
            most = energy * value[p.v + Value.MOST_DISPLACED] + level * value[p.v + Value.MOST_NOISE]
            failed = residual > most
            if kind < Weights.PENALTY or number[p.n + Number.EVERYWHERE] == 1:
                failed = energy > V(0.0)
            ws[region(p, number, Region.ACTIVE)] = ti.select(failed, V(1.0), V(0.0))
            ws[region(p, number, Region.SPREAD)] = V(1.0)
            ws[region(p, number, Region.SHARE)] = V(1.0)
            for r in range(n):
                scale = value[p.v + Value.SCALE + r]
                own = ws[moments + number[p.n + Number.LOWER + tri(r, r)] * p.stride]
                ws[region(p, number, Region.DIAGONAL) + r * p.stride] = own * (scale * scale)
                for c in range(r + 1):
                    noise = ti.select(r == c, value[p.v + Value.NOISE + r], precise(0.0))
                    ws[region(p, number, Region.WEIGHT_NOISE) + tri(r, c) * p.stride] = V(noise)
        first = residual * value[p.v + Value.SCALE_START]
        ws[region(p, number, Region.SCALE_SQUARED)] = ti.max(first, ws[least])

    @ti.func
    def gather(at: ti.i32, step: ti.i32, J: ti.template()):
        """One source of a cell of each lane's window."""
        element = V(0.0)
        if ti.static(lanes == 1):
            element = ti.cast(J[at], precise)
        else:
            for i in ti.static(range(lanes)):
                element[i] = ti.cast(J[at + i * step], precise)
        return element

    @ti.func
    def penalise(ratio: ti.template(), penalty: ti.i32):
        """Weight of a cell whose squared residual is ``ratio`` σ²."""
        weight = 1.0 / (1.0 + 0.5 * ratio)
        if penalty == Penalty.GEMAN_MCCLURE:
            weight = 1.0 / ((1.0 + ratio) * (1.0 + ratio))
        if penalty == Penalty.TRUNCATED:
            weight = ti.select(ratio < V(1.0), V(1.0), V(0.0))
        return weight

    @ti.func
    def reweight(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Weigh the window's cells by the present solution; ``which``: ``Weights``. Then σ² of the penalty shrinks."""
        kind, narrow = p.which % NARROW, p.which // NARROW
        plain = ti.cast(kind == Weights.PENALTY_PLAIN, ti.i32)
        prepare(plain, p, number, value, ws)
        n_x, n_y = number[p.n + Number.CELLS_X], number[p.n + Number.CELLS_Y]
        terms, monomials = number[p.n + Number.CELL_TERMS], number[p.n + Number.CELL_MONOMIALS]
        entries, sources = number[p.n + Number.EXTRA], number[p.n + Number.SOURCES]
        noises = number[p.n + Number.CELL_NOISES]
        lists = p.n + number[p.n + Number.CELL_LISTS]
        first_term = lists + entries + 1
        powers_at = first_term + 3 * terms + 3 * noises
        # Weights, narrow weights, powers of the middles, mean powers; along x, then along y.
        along_x = p.v + number[p.n + Number.CELL_VALUES] + terms + noises
        degrees = number[lists - 1]
        along_y = along_x + (2 + 2 * degrees) * n_x
        sums, cell = region(p, number, Region.WEIGHT_SUMS), region(p, number, Region.CELL)
        noise_sums = sums + entries * p.stride
        own, relative = region(p, number, Region.CELL_ENTRIES), region(p, number, Region.RELATIVE)
        quadratic = region(p, number, Region.QUADRATIC)
        squared = ws[region(p, number, Region.SCALE_SQUARED)]
        row = p.pixel // number[p.n + Number.PITCH]
        column = p.pixel - row * number[p.n + Number.PITCH]
        step, pitch = number[p.n + Number.CELL_STEP_X], number[p.n + Number.SOURCE_PITCH]
        corner = number[p.n + Number.SOURCES_AT] + row * number[p.n + Number.CELL_STEP_Y] * pitch + column * step
        small.clear(ws, sums, entries + 2 * monomials, p.stride)
        mass, weighted, alone, spread = V(0.0), V(0.0), V(0.0), V(0.0)
        for by in range(n_y):
            for bx in range(n_x):
                at = corner + by * pitch + bx
                for s in range(sources):
                    ws[cell + s * p.stride] = gather(at + s * number[p.n + Number.SOURCE_PLANE], step, J)
                window = value[along_x + bx] * value[along_y + by]
                counted = ws[cell + number[p.n + Number.MASS_SOURCE] * p.stride] * window
                noise = V(0.0)
                for m in range(monomials):
                    x, y = number[powers_at + 2 * m], number[powers_at + 2 * m + 1]
                    mean = value[along_x + (2 + degrees + x) * n_x + bx] * value[along_y + (2 + degrees + y) * n_y + by]
                    noise = noise + ws[relative + m * p.stride] * mean
                if plain == 1:
                    noise = V(1.0)
                for e in range(entries):
                    total = V(0.0)
                    for t in range(number[lists + e], number[lists + e + 1]):
                        x, y = number[first_term + 3 * t + 1], number[first_term + 3 * t + 2]
                        power = value[along_x + (2 + x) * n_x + bx] * value[along_y + (2 + y) * n_y + by]
                        factor = window * power * value[p.v + number[p.n + Number.CELL_VALUES] + t]
                        total = total + ws[cell + number[first_term + 3 * t] * p.stride] * factor
                    ws[own + e * p.stride] = total
                some = counted > V(0.0)
                inverse = 1.0 / ti.max(noise, V(1e-6))
                weight, second = inverse, V(0.0)
                if kind != Weights.NOISE:
                    residual = small.dot(ws, quadratic, 1, own, 1, entries, p.stride)
                    residual = residual / ti.select(some, counted, V(1.0))
                    if kind == Weights.FUNDAMENTAL:
                        second = residual * inverse * inverse
                    else:
                        weight = inverse * penalise(residual * inverse / squared, number[p.n + Number.PENALTY])
                if narrow == 1:
                    weight = weight * (value[along_x + n_x + bx] * value[along_y + n_y + by])
                weight = ti.select(some, weight, V(0.0))
                for e in range(entries):
                    ws[sums + e * p.stride] = ws[sums + e * p.stride] + ws[own + e * p.stride] * weight
                for m in range(monomials):
                    x, y = number[powers_at + 2 * m], number[powers_at + 2 * m + 1]
                    mean = value[along_x + (2 + degrees + x) * n_x + bx] * value[along_y + (2 + degrees + y) * n_y + by]
                    one, two = noise_sums + m * p.stride, noise_sums + (monomials + m) * p.stride
                    ws[one] = ws[one] + weight * counted * mean
                    ws[two] = ws[two] + second * counted * mean
                mass = mass + counted
                weighted = weighted + weight * counted
                alone = alone + counted * counted
                spread = spread + weight * weight * noise * counted * counted
        store(mass, weighted, alone, spread, p, number, value, ws)
        shrunk = squared * value[p.v + Value.SCALE_SHRINK]
        ws[region(p, number, Region.SCALE_SQUARED)] = ti.max(shrunk, ws[region(p, number, Region.LEAST_SQUARED)])

    @ti.func
    def store(
        mass: ti.template(), weighted: ti.template(), alone: ti.template(), spread: ti.template(), p: ti.template(),
        number: ti.template(), value: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """What the weights made of tensor and noise, in the pixels that are weighted anew."""
        n, entries = number[p.n + Number.N], number[p.n + Number.EXTRA]
        monomials, noises = number[p.n + Number.CELL_MONOMIALS], number[p.n + Number.CELL_NOISES]
        terms = number[p.n + Number.CELL_TERMS]
        first_noise = p.n + number[p.n + Number.CELL_LISTS] + entries + 1 + 3 * terms
        factors = p.v + number[p.n + Number.CELL_VALUES] + terms
        sums, moments = region(p, number, Region.WEIGHT_SUMS), region(p, number, Region.MOMENTS)
        noise_sums = sums + entries * p.stride
        noise, active = region(p, number, Region.WEIGHT_NOISE), ws[region(p, number, Region.ACTIVE)] > V(0.5)
        enough = active & (weighted > mass * LEAST_SHARE)
        grown = mass / ti.select(enough, weighted, V(1.0))
        for e in range(entries):
            at = moments + e * p.stride
            ws[at] = ti.select(enough, ws[sums + e * p.stride] * grown, ws[at])
        for e in range(n * (n + 1) // 2):
            at = noise + e * p.stride
            ws[at] = ti.select(enough, V(0.0), ws[at])
        # The fundamental scheme takes the sums with the residuals off instead.
        other = ti.select(p.which == Weights.FUNDAMENTAL, monomials, 0)
        for e in range(noises):
            entry = first_noise + 3 * e
            at = noise + tri(number[entry], number[entry + 1]) * p.stride
            found = ws[noise_sums + (other + number[entry + 2]) * p.stride] * (grown * value[factors + e])
            ws[at] = ws[at] + ti.select(enough, found, V(0.0))
        share, more = region(p, number, Region.SHARE), region(p, number, Region.SPREAD)
        ws[share] = ti.select(enough, 1.0 / grown, ws[share])
        known = ti.select(enough, weighted * alone, V(1.0))
        ws[more] = ti.select(enough, grown * spread * mass / known, ws[more])

    @ti.func
    def relax(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Sweeps of successive over-relaxation; ``which``: their number.

        A step divides by the bound of the second derivative: the diagonal of the tensor where all weights are 1.
        """
        flow, k = number[p.n + Number.FLOW], number[p.n + Number.SOLUTIONS]
        matrix, diagonal = region(p, number, Region.TENSOR), region(p, number, Region.DIAGONAL)
        found = region(p, number, Region.PARAMETERS)
        share = ws[region(p, number, Region.SHARE)] * value[p.v + Value.RELAXATION]
        active = ws[region(p, number, Region.ACTIVE)] > V(0.5)
        for _ in range(p.which):
            for j in range(k):
                for r in range(flow):
                    slope = V(0.0)
                    for c in range(number[p.n + Number.N]):
                        element = ws[matrix + tri(ti.max(r, c), ti.min(r, c)) * p.stride]
                        scale = precise(1.0) / value[p.v + Value.SCALE + c]
                        slope = slope + element * parameter(j, c, p, number, ws) * scale
                    bound = ti.max(ws[diagonal + r * p.stride], V(1e-30))
                    at = found + (j * flow + r) * p.stride
                    moved = ws[at] - slope * share / bound * value[p.v + Value.SCALE + r]
                    ws[at] = ti.select(active, moved, ws[at])

    return SimpleNamespace(begin_weights=begin_weights, reweight=reweight, relax=relax)
