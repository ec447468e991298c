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

LEAST_WEIGHT = 1e-3
"""Least mean weight of a window: where next to nothing counts, the solution stays as it is."""


@ti.dataclass
class Tables:
    """Where the tables of a problem's cells begin, see ``stages.cells``: lists in ``number``, the rest in ``value``."""

    firsts: ti.i32  # first term of each entry
    terms: ti.i32  # x 3: source, powers of the cell's middle along x and y
    noises: ti.i32  # x 3: row, column, monomial
    monomials: ti.i32  # x 2: powers
    factors: ti.i32  # of terms, then of noises
    noise_factors: ti.i32
    x: ti.i32  # weights of the cells, those of a narrow window, powers of their middles, mean powers of their samples
    y: ti.i32
    n_x: ti.i32  # cells
    n_y: ti.i32
    mean: ti.i32  # which of the rows of ``x`` and ``y`` is the first of mean powers
    entries: ti.i32  # numbers of entries, sources, monomials, noises
    sources: ti.i32
    n_monomials: ti.i32
    n_noises: ti.i32


MIDDLE = 2
"""Which of the rows of ``Tables.x`` and ``y`` is the first of powers of the middles."""


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
    def tables_of(p: ti.template(), number: ti.template()):
        """The problem's ``Tables``."""
        lists = p.n + number[p.n + Number.CELL_LISTS]
        entries, n_terms = number[p.n + Number.EXTRA], number[p.n + Number.CELL_TERMS]
        n_noises, n_x = number[p.n + Number.CELL_NOISES], number[p.n + Number.CELLS_X]
        terms = lists + entries + 1
        factors = p.v + number[p.n + Number.CELL_VALUES]
        along_x = factors + n_terms + n_noises
        degrees = number[lists - 1]
        return Tables(
            firsts=lists, terms=terms, noises=terms + 3 * n_terms, monomials=terms + 3 * n_terms + 3 * n_noises,
            factors=factors, noise_factors=factors + n_terms, x=along_x, y=along_x + (MIDDLE + 2 * degrees) * n_x,
            n_x=n_x, n_y=number[p.n + Number.CELLS_Y], mean=MIDDLE + degrees, entries=entries,
            sources=number[p.n + Number.SOURCES], n_monomials=number[p.n + Number.CELL_MONOMIALS], n_noises=n_noises,
        )  # fmt: skip

    @ti.func
    def prepare(
        plain: ti.i32, t: ti.template(), p: ti.template(), number: ti.template(), value: ti.template(),
        ws: ti.template(),
    ):  # fmt: skip
        """Mean squared residual and mean relative noise of the solutions, as functions of a cell's sums."""
        n, k = number[p.n + Number.N], number[p.n + Number.SOLUTIONS]
        quadratic, relative = region(p, number, Region.QUADRATIC), region(p, number, Region.RELATIVE)
        small.clear(ws, quadratic, t.entries, p.stride)
        small.clear(ws, relative, t.n_monomials, p.stride)
        for j in range(k):
            share = 1.0 / (gauge(j, plain, p, number, value, ws) * ti.cast(k, precise))
            for r in range(n):
                one = parameter(j, r, p, number, ws) * share
                for c in range(r + 1):
                    at = quadratic + number[p.n + Number.LOWER + tri(r, c)] * p.stride
                    twice = ti.select(r == c, precise(1.0), precise(2.0))
                    ws[at] = ws[at] + one * parameter(j, c, p, number, ws) * twice
            for e in range(t.n_noises):
                r, c = number[t.noises + 3 * e], number[t.noises + 3 * e + 1]
                at = relative + number[t.noises + 3 * e + 2] * p.stride
                twice = ti.select(r == c, precise(1.0), precise(2.0))
                both = parameter(j, r, p, number, ws) * parameter(j, c, p, number, ws)
                ws[at] = ws[at] + both * share * (twice * value[t.noise_factors + e])

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
        tables = tables_of(p, number)
        prepare(ti.cast(kind == Weights.PENALTY_PLAIN, ti.i32), tables, p, number, value, ws)
        entries = tables.entries
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
    def power(row: ti.i32, x: ti.i32, y: ti.i32, bx: ti.i32, by: ti.i32, t: ti.template(), value: ti.template()):
        """A cell's entry in the tables along x and y, of the powers (x, y) behind ``row``."""
        return value[t.x + (row + x) * t.n_x + bx] * value[t.y + (row + y) * t.n_y + by]

    @ti.func
    def load_cell(
        at: ti.i32, bx: ti.i32, by: ti.i32, t: ti.template(), p: ti.template(), number: ti.template(),
        value: ti.template(), ws: ti.template(), J: ti.template(),
    ):  # fmt: skip
        """CELL_ENTRIES: the tensor of the cell whose sources begin at ``at``; the weight of its valid samples."""
        cell, own = region(p, number, Region.CELL), region(p, number, Region.CELL_ENTRIES)
        for s in range(t.sources):
            plane = s * number[p.n + Number.SOURCE_PLANE]
            ws[cell + s * p.stride] = gather(at + plane, number[p.n + Number.CELL_STEP_X], J)
        window = value[t.x + bx] * value[t.y + by]
        for e in range(t.entries):
            total = V(0.0)
            for term in range(number[t.firsts + e], number[t.firsts + e + 1]):
                entry = t.terms + 3 * term
                factor = power(MIDDLE, number[entry + 1], number[entry + 2], bx, by, t, value)
                total = total + ws[cell + number[entry] * p.stride] * (factor * window * value[t.factors + term])
            ws[own + e * p.stride] = total
        return ws[cell + number[p.n + Number.MASS_SOURCE] * p.stride] * window

    @ti.func
    def relative_noise(
        bx: ti.i32, by: ti.i32, t: ti.template(), p: ti.template(), number: ti.template(), value: ti.template(),
        ws: ti.template(),
    ):  # fmt: skip
        """Noise of a cell's residual relative to that of the window's."""
        relative, noise = region(p, number, Region.RELATIVE), V(0.0)
        for m in range(t.n_monomials):
            x, y = number[t.monomials + 2 * m], number[t.monomials + 2 * m + 1]
            noise = noise + ws[relative + m * p.stride] * power(t.mean, x, y, bx, by, t, value)
        return noise

    @ti.func
    def add_cell(
        weight: ti.template(), counted: ti.template(), less: ti.template(), bx: ti.i32, by: ti.i32, t: ti.template(),
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """Add a cell to the sums: its tensor by ``weight``, its monomials by that times what is ``counted`` of it, and
        by ``less``."""
        sums, own = region(p, number, Region.WEIGHT_SUMS), region(p, number, Region.CELL_ENTRIES)
        for e in range(t.entries):
            ws[sums + e * p.stride] = ws[sums + e * p.stride] + ws[own + e * p.stride] * weight
        one, two = sums + t.entries * p.stride, sums + (t.entries + t.n_monomials) * p.stride
        for m in range(t.n_monomials):
            x, y = number[t.monomials + 2 * m], number[t.monomials + 2 * m + 1]
            mean = power(t.mean, x, y, bx, by, t, value)
            ws[one + m * p.stride] = ws[one + m * p.stride] + counted * weight * mean
            ws[two + m * p.stride] = ws[two + m * p.stride] + less * mean

    @ti.func
    def reweight(
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(), J: ti.template(),
        out: ti.template(),
    ):  # fmt: skip
        """Weigh the window's cells by the present solution; ``which``: ``Weights``. Then σ² of the penalty shrinks."""
        kind, narrow = p.which % NARROW, p.which // NARROW
        plain = ti.cast(kind == Weights.PENALTY_PLAIN, ti.i32)
        t = tables_of(p, number)
        prepare(plain, t, p, number, value, ws)
        small.clear(ws, region(p, number, Region.WEIGHT_SUMS), t.entries + 2 * t.n_monomials, p.stride)
        squared = ws[region(p, number, Region.SCALE_SQUARED)]
        quadratic, own = region(p, number, Region.QUADRATIC), region(p, number, Region.CELL_ENTRIES)
        row = p.pixel // number[p.n + Number.PITCH]
        column = p.pixel - row * number[p.n + Number.PITCH]
        pitch = number[p.n + Number.SOURCE_PITCH]
        corner = number[p.n + Number.SOURCES_AT] + row * number[p.n + Number.CELL_STEP_Y] * pitch
        corner += column * number[p.n + Number.CELL_STEP_X]
        mass, weighted, alone, spread = V(0.0), V(0.0), V(0.0), V(0.0)
        for by in range(t.n_y):
            for bx in range(t.n_x):
                counted = load_cell(corner + by * pitch + bx, bx, by, t, p, number, value, ws, J)
                noise = V(1.0)
                if plain == 0:
                    noise = relative_noise(bx, by, t, p, number, value, ws)
                some = counted > V(0.0)
                weight, less = 1.0 / ti.max(noise, V(1e-6)), V(0.0)
                if kind != Weights.NOISE:
                    residual = small.dot(ws, quadratic, 1, own, 1, t.entries, p.stride)
                    residual = residual / ti.select(some, counted, V(1.0))
                    if kind == Weights.FUNDAMENTAL:
                        less = counted * residual * weight * weight
                    else:
                        weight = weight * penalise(residual * weight / squared, number[p.n + Number.PENALTY])
                if narrow == 1:
                    weight = weight * (value[t.x + t.n_x + bx] * value[t.y + t.n_y + by])
                weight = ti.select(some, weight, V(0.0))
                add_cell(weight, counted, less, bx, by, t, p, number, value, ws)
                mass = mass + counted
                weighted = weighted + weight * counted
                alone = alone + counted * counted
                spread = spread + weight * weight * noise * counted * counted
        store(mass, weighted, alone, spread, t, p, number, value, ws)
        shrunk = squared * value[p.v + Value.SCALE_SHRINK]
        ws[region(p, number, Region.SCALE_SQUARED)] = ti.max(shrunk, ws[region(p, number, Region.LEAST_SQUARED)])

    @ti.func
    def store(
        mass: ti.template(), weighted: ti.template(), alone: ti.template(), spread: ti.template(), t: ti.template(),
        p: ti.template(), number: ti.template(), value: ti.template(), ws: ti.template(),
    ):  # fmt: skip
        """What the weights made of tensor and noise, in the pixels that are weighted anew."""
        n = number[p.n + Number.N]
        sums, moments = region(p, number, Region.WEIGHT_SUMS), region(p, number, Region.MOMENTS)
        noise, active = region(p, number, Region.WEIGHT_NOISE), ws[region(p, number, Region.ACTIVE)] > V(0.5)
        enough = active & (weighted > mass * LEAST_WEIGHT)
        grown = mass / ti.select(enough, weighted, V(1.0))
        for e in range(t.entries):
            at = moments + e * p.stride
            ws[at] = ti.select(enough, ws[sums + e * p.stride] * grown, ws[at])
        for e in range(n * (n + 1) // 2):
            at = noise + e * p.stride
            ws[at] = ti.select(enough, V(0.0), ws[at])
        # The fundamental scheme takes the sums with the residuals off instead.
        first = t.entries + ti.select(p.which == Weights.FUNDAMENTAL, t.n_monomials, 0)
        for e in range(t.n_noises):
            entry = t.noises + 3 * e
            at = noise + tri(number[entry], number[entry + 1]) * p.stride
            found = ws[sums + (first + number[entry + 2]) * p.stride] * (grown * value[t.noise_factors + e])
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
