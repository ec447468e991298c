"""How much each stage must compute and move: flops and bytes per output pixel, counted from the tables of a plan.

What is counted is the least that the chosen algorithm needs: a multiply-add is two flops, taps that are zero cost
nothing, square roots and divisions count as one, and bytes are those of arrays too large for a cache, each read or
written once. Halos, padding, masks, prefilters and conversions of grey values are the implementation's business: they
lower the share of the machine's ceilings that a stage reaches. Times are of one more frame of a sequence.

Stages: ``filter`` (derivatives, products and their sums over cameras, per new frame), ``tensor`` (sums over frames,
moment windows), ``solve`` (null space, covariances of the flow parameters), ``fit`` (geometry, motion, maps). Those of
the exact refinement are counted by ``refine_work``.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from leafflow_ti.ceilings import Ceilings
from leafflow_ti.kernels.numbers import NARROW, Stage, Weights
from leafflow_ti.models import AXES, ColumnSet, TensorLayout
from leafflow_ti.plan import Plan
from leafflow_ti.sampling import AxisSampling, Sampling, cross_noise
from leafflow_ti.stages.cells import Cells
from leafflow_ti.stages.channels import Request
from leafflow_ti.stages.estimators import ESTIMATORS, Move
from leafflow_ti.stages.problem import Problem
from leafflow_ti.stages.thresholds import GUARDED

Key = tuple[Any, ...]
STAGES = ("filter", "tensor", "solve", "fit")
EXTRA = 4
"""Maps beside those of the tensor: window mass, energies of the gradient, of it smoothed once more, of the image."""
EXTRA_FLOPS = 12
"""Their products: squares of two gradients, of the two smoothed, of the grey value, times the mask."""
RITZ_SWEEPS, FULL_SWEEPS = 3, 8
"""Sweeps after which cyclic Jacobi has usually converged: of the Ritz values and of N x N matrices."""
ROW_FLOPS = 40
"""Coefficients of one row of the motion fit."""


@dataclass(frozen=True)
class Work:
    """``flops`` and ``bytes`` per output pixel."""

    flops: float = 0.0
    bytes: float = 0.0

    def __add__(self, other: Work) -> Work:
        return Work(self.flops + other.flops, self.bytes + other.bytes)

    def __mul__(self, factor: float) -> Work:
        return Work(self.flops * factor, self.bytes * factor)


@dataclass(frozen=True)
class Rate:
    """What a stage reached: 10^9 flops and bytes per second, and their shares of the ceilings (0..1)."""

    gflops: float
    gbytes: float
    compute: float
    memory: float

    @property
    def limit(self) -> str:
        """The ceiling that is nearer: with a small share of it, instructions or the cache are what holds the stage."""
        return "compute" if self.compute >= self.memory else "memory"


def rate(stage: str, work: Work, seconds: float, ceilings: Ceilings, storage: str, algebra: str) -> Rate:
    """What a stage reached that did ``work`` in ``seconds``; small matrices are in the ``algebra`` precision.

    ``storage``, ``algebra``: "f32" or "f64", as of a ``Device``.
    """
    gflops, gbytes = work.flops / seconds / 1e9, work.bytes / seconds / 1e9
    peak = ceilings.gflops(algebra if stage in ("solve", "fit") else storage)
    return Rate(gflops, gbytes, gflops / peak, gbytes / ceilings.gbytes)


class _Data(Request):
    """One data vector: its columns on their sampling."""

    @property
    def samples(self) -> int:
        """Camera samples of the window."""
        return self.sampling.sx.size * self.sampling.sy.size

    @property
    def maps(self) -> set[Key]:
        """Product images summed over cameras: channels, powers of the camera offsets."""
        return {(m.channels, _power(m.exponents, "sy"), _power(m.exponents, "sx")) for m in self.layout.moments}


def _power(exponents: tuple[int, ...], axis: str) -> int:
    return exponents[AXES.index(axis)]


def count_work(plan: Plan) -> dict[str, Work]:
    """Work of each of ``STAGES`` per output pixel of one more frame."""
    problem, stride = plan.problem, plan.x.step
    block = problem.sampling.x.blocked.step
    total = _count(problem, plan.layout, plan.config.precision, stride, block, len(plan.names), plan.differences)
    if plan.ranges and plan.ranges.depth and plan.ranges.layout:
        # Range flow measures the depth of every input pixel first.
        depth = _count(plan.ranges.depth, plan.ranges.layout, plan.config.precision, 1, 1, 4, False)
        total = {stage: total[stage] + depth[stage] * stride**2 for stage in STAGES}
    return total


def _count(
    problem: Problem, layout: TensorLayout, precision: str, stride: int, block: int, n_maps: int, differences: bool
) -> dict[str, Work]:
    itemsize = 4 if precision == "f32" else 8
    own = problem.own_flows
    vectors = [_Data(r.columns, r.layout, r.sampling, r.step) for r in problem.requests(layout)]
    filters = _filter_flops(problem) + sum(_product_flops(data, block) for data in vectors)
    kept = sum(_kept(data, block) for data in vectors)
    images = _images(problem.columns, problem.sampling, len(own.steps) + 1 if own else 0)
    entries = sum(len(data.layout.entries) + EXTRA for data in vectors)
    n_t = problem.sampling.t.size
    return {
        "filter": Work(filters, itemsize * (images + kept)) * stride**2,
        "tensor": Work(
            sum(_window_flops(data, stride, block) for data in vectors),
            itemsize * (n_t * kept * stride**2 + entries),
        ),
        "solve": Work(sum(_solve_flops(problem, data) for data in vectors), itemsize * entries),
        "fit": Work(_fit_flops(problem, differences), itemsize * (n_maps + 1)),
    }


def _images(columns: ColumnSet, sampling: Sampling, own_cameras: int) -> int:
    """Grey images of one frame that are read."""
    if columns.derived:
        return 1 + max(d.image for d in columns.derived.values())
    return max((2 * sampling.sy.radius + 1) * (2 * sampling.sx.radius + 1), own_cameras)


def _taps(axis: AxisSampling, differentiate: bool) -> int:
    return int(np.count_nonzero(axis.kernel(differentiate)))


def _filter_flops(problem: Problem) -> int:
    """Separable filters per pixel of the frame, plane by plane; and the gradient smoothed once more.

    The axes come in the order that makes fewest planes: cameras before x and y; but after them where every camera's own
    flow needs the derivatives along x, y and t anyway. A plane that is not differentiated yet goes on as it is and
    with the axis's derivative, as far as one is wanted.
    """
    columns, sampling, own = problem.columns, problem.sampling, problem.own_flows
    order = ("t", "y", "x", "sy", "sx") if own else ("t", "sy", "sx", "y", "x")
    axes = {columns.derived[c].axis if columns.derived else c for c in columns.channels}
    wanted: set[str | None] = {None if a == "i" else a for a in axes if a != "1"}
    extent = {a: 2 * sampling.axis(a).radius + 1 for a in ("sy", "sx")}
    cameras = _images(columns, sampling, len(own.steps) + 1 if own else 0)
    aside = cameras - extent["sy"] * extent["sx"] if own else 0  # cameras that only their own flow needs
    planes: set[str | None] = {None}
    taps = 0
    for i, name in enumerate(order):
        axis = sampling.axis(name)
        if axis.filters is None:
            continue
        if name in extent:
            extent[name] -= 2 * axis.filter_radius
            aside = 0
        n_images = cameras if columns.derived else extent["sy"] * extent["sx"] + aside
        later = wanted & {None, *order[i + 1 :]}
        smooth = {d for d in planes if d is not None or later}
        derived = {name} & wanted if None in planes else set()
        taps += n_images * (len(smooth) * _taps(axis, False) + len(derived) * _taps(axis, True))
        planes = smooth | derived
    again = 2 * (_taps(sampling.x, False) + _taps(sampling.y, False))
    return 2 * (taps + again)


def _product_flops(data: _Data, block: int) -> float:
    """Products of channels and their weighted sums over cameras per pixel of the frame; sums over blocks."""
    pairs = {m.channels for m in data.layout.moments}
    terms = sum(
        int(np.count_nonzero(np.outer(data.sampling.sy.window(sy), data.sampling.sx.window(sx))))
        for _, sy, sx in data.maps
    )
    flops = data.samples * len(pairs) + 2.0 * terms + EXTRA_FLOPS
    if block > 1:
        along_x, both = _block_moments(data)
        flops += 2 * (len(along_x) + len(both) / block)
    return flops


def _block_moments(data: _Data) -> tuple[set[Key], set[Key]]:
    """Sums over a block: of which maps times powers of x, and of x and y; all powers up to those of the moments."""
    along_x: set[Key] = set()
    both: set[Key] = set()
    for m in data.layout.moments:
        one = (m.channels, _power(m.exponents, "sy"), _power(m.exponents, "sx"))
        for px, py in product(range(_power(m.exponents, "x") + 1), range(_power(m.exponents, "y") + 1)):
            along_x.add((*one, px))
            both.add((*one, px, py))
    extra = {(n, 0) for n in range(EXTRA)}
    return along_x | extra, both | extra


def _kept(data: _Data, block: int) -> float:
    """Numbers per pixel of the frame that are kept of it until it leaves the window."""
    return len(data.maps) + EXTRA if block == 1 else len(_block_moments(data)[1]) / block**2


def _window_flops(data: _Data, stride: int, block: int) -> float:
    """Sums over the frames of the window, then windows along y and x, per output pixel.

    From sums over blocks, the moment of power n is that of the blocks' own moments 0..n.
    """
    sampling = data.sampling
    cells = stride / block  # per output pixel, along each axis
    summed: set[Key] = set()
    tall: dict[Key, int] = {}
    wide = 0
    for m in data.layout.moments:
        n, power = _power(m.exponents, "y"), _power(m.exponents, "x")
        one = (m.channels, *(_power(m.exponents, a) for a in ("sy", "sx", "t")))
        parts = range(power + 1 if block > 1 else 1)
        for px in parts:
            summed |= {(*one, px, py) for py in range(n + 1 if block > 1 else 1)}
            tall[(*one, px, n)] = n + 1 if block > 1 else 1
        wide += len(parts)
    size_x, size_y = (-(-sampling.axis(a).size // block) for a in "xy")
    over_time = sum(int(np.count_nonzero(sampling.t.window(key[3]))) for key in summed)
    over_time += EXTRA * sampling.t.size
    flops = 2.0 * over_time * cells**2
    flops += 2.0 * (sum(tall.values()) + EXTRA) * size_y * cells
    return flops + 2.0 * (wide + EXTRA) * size_x


def cholesky_flops(n: int) -> float:
    """The factor of a symmetric matrix."""
    return n * (n * n - 1) / 3 + n * (n - 1) / 2 + 2 * n


def substitution_flops(n: int, columns: int) -> float:
    """Both triangular solves, for so many right sides."""
    return 2.0 * n * n * columns


def _jacobi(n: int, sweeps: int) -> float:
    """Each rotation of rows, columns and vectors: 3 n pairs of 6 flops, and some 15 for the angle."""
    return sweeps * n * (n - 1) / 2 * (18 * n + 15)


def _solve_flops(problem: Problem, request: Request) -> float:
    """Null space, parameters, residuals and covariances of one data vector.

    Of robust estimators that take up failed pixels alone, the plain solution: how many fail is not known beforehand.
    """
    columns, estimator = request.columns, ESTIMATORS[problem.estimator]
    flow = columns.n_flow
    plain = estimator.robust and problem.robust == "failed"
    moves = [move for move in estimator.moves(problem.solver, False) if not (plain and move.anew)]
    fast = any(move.stage == Stage.INVERSE_ITERATION for move in moves)
    cells = Cells(request) if estimator.weighs else None
    wanted = [move for move in moves if move.stage != Stage.JACOBI or not fast]
    flops = sum((_move_flops(move, problem, columns, cells) for move in wanted), 0.0)
    flops += flow * (flow + 1) + cholesky_flops(flow)  # J_ff without its noise
    for rows in _rows(problem, columns):
        flops += flow * (flow + 1) / 2 + substitution_flops(flow, rows)
        flops += 2 * flow * flow * rows + rows * (rows + 1) * flow
    return flops


def _move_flops(move: Move, problem: Problem, columns: ColumnSet, cells: Cells | None) -> float:
    """One move of an estimator; those not named cost next to nothing."""
    n, flow, k = columns.n, columns.n_flow, columns.n_time_like
    m = GUARDED[k]
    orthogonalise = m * (m - 1) / 2 * 4 * n + m * 3 * n
    ritz = n * n * m + m * (m + 1) * n + _jacobi(m, RITZ_SWEEPS) + 4 * n * m * m + k * (n * n + 4 * n)
    flops: dict[Stage, float] = {
        Stage.SCALE: n * (n + 1),
        Stage.FACTORISE: cholesky_flops(n),
        Stage.LEAST_SQUARES: flow * flow * k,
        Stage.INVERSE_ITERATION: problem.iterations * (substitution_flops(n, m) + orthogonalise) + ritz,
        Stage.JACOBI: _jacobi(n, FULL_SWEEPS),
        Stage.FUNDAMENTAL: _jacobi(n, FULL_SWEEPS),
        Stage.PARAMETERS: 2 * flow * k * k,
        Stage.RESIDUALS: k * (n * n + 3 * n),
        Stage.WHITEN: cholesky_flops(n) + 2 * n**3,
        Stage.UNWHITEN: n * n * k,
        Stage.RELAX: move.which * k * flow * 3 * n,
        Stage.REWEIGHT: _reweight_flops(move, cells) if cells else 0.0,
    }
    return flops.get(move.stage, 0.0)


def _reweight_flops(move: Move, cells: Cells) -> float:
    """Every cell's entries, its residual unless weights are of the noise alone, and the sums."""
    sampling = cells.request.sampling
    number = len(sampling.x.blocked.weights) * len(sampling.y.blocked.weights)
    entries, terms, monomials = len(cells.entries), sum(map(len, cells.entries)), len(cells.monomials)
    residual = 0 if move.which % NARROW == Weights.NOISE else 2 * entries
    return float(number * (2 * terms + residual + 2 * entries + 7 * monomials))


def _rows(problem: Problem, columns: ColumnSet) -> Iterable[int]:
    """Rows of each solution whose covariances are wanted."""
    own = problem.own_flows
    brightness = columns.index("i") is not None
    for axis in columns.solutions:
        if axis != "t":
            yield 2 * len(problem.terms) + brightness
        elif own and columns is own.columns:
            yield 2 * len(own.offsets)
        else:
            yield 2 * len(problem.offsets) + len(problem.brightness)


def _fit_flops(problem: Problem, differences: bool) -> float:
    """Geometry from every camera solution, the motion from its rows, pass by pass, and the errors of both."""
    columns, sampling, own = problem.columns, problem.sampling, problem.own_flows
    terms, flops = len(problem.terms), 0.0
    motion_rows = 2 * len(problem.offsets)
    for axis in problem.camera_axes:
        rows = 2 * terms
        flops += cholesky_flops(rows) + substitution_flops(rows, terms) + rows * terms * 2
        if "t" in columns.solutions:
            flops += rows * motion_rows * (2 * len(cross_noise(sampling, columns, axis, "t")) + 2 * terms)
    if terms:
        flops += cholesky_flops(terms) + substitution_flops(terms, 1 + motion_rows + terms)
    variants = 3 if differences else 1
    for i in range(problem.passes if problem.fitted else 0):
        last = i == problem.passes - 1 and not own
        flops += _row_set_flops(motion_rows + problem.use_range, terms, problem.fitted, variants if last else 0, True)
    if own:
        unknowns = own.unknowns + own.growth
        sets = [2 * len(own.offsets)] * len(own.steps)
        sets += [motion_rows + problem.use_range] if own.reference_rows else []
        flops += sum(_row_set_flops(rows, terms, unknowns, variants, i == 0) for i, rows in enumerate(sets))
    return flops


def _row_set_flops(rows: int, terms: int, unknowns: int, variants: int, finish: bool) -> float:
    """Design and its sensitivity to the geometry, weights, normal equations and covariances of one set of rows.

    ``variants``: covariances, 0 where only the motion is wanted. Of symmetric matrices one triangle counts.
    """
    flops = rows * (ROW_FLOPS + 2 * unknowns) * (1.0 + min(terms, 3))  # forward differences
    flops += rows * terms * 2 * (terms + (rows + 1) / 2)  # D C_g D^T
    flops += cholesky_flops(rows) + substitution_flops(rows, unknowns)
    flops += rows * unknowns * (unknowns + 1) + 2 * rows * unknowns
    flops += variants * 2 * rows * unknowns * (rows + (unknowns + 1) / 2 + 2 * terms)
    if finish:
        flops += cholesky_flops(unknowns) + substitution_flops(unknowns, 1)
        flops += variants * (2 * substitution_flops(unknowns, unknowns) + 2 * unknowns * terms * (terms + unknowns + 1))
    return flops
