"""Naive float64 twin of the estimators that weight the cells of a window (see ``cells``).

Nothing is shared with the kernels; tables (columns, filters, window weights, noise gains) come from the library.

Notation (Schuchert 2010, sections 2.3-2.4): P [N, k] the solutions with the identity in their time-like rows, C̄ the
noise covariance of the columns summed over the window, c_j = p_j^T C̄ p_j; of cell b the sum J_b of w d d^T over its
valid samples, their weight w_b, and the mean C_b of the noise covariances (2.24) over all its samples.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from reference import chain
from reference.cells import Cells
from scipy.linalg import eigh

from leafflow_ti.models import ColumnSet
from leafflow_ti.stages import thresholds as tables
from leafflow_ti.stages.cells import NARROW
from leafflow_ti.stages.estimators import fns as fns_stages
from leafflow_ti.stages.estimators import for3 as for3_stages
from leafflow_ti.stages.estimators import robust as robust_stages
from leafflow_ti.stages.estimators import sampson as sampson_stages

Array = np.ndarray


@dataclass(frozen=True)
class Found:
    """What an estimator found: parameters [n_flow, k], and the ``weights`` [cells] of its last sums.

    M and N [N, N] are these sums, scaled so that the weighted mean of the weights is 1. ``spread``: the variance of the
    noise of the normal equations, relative to what it is where all cells weigh the same.
    """

    P: Array
    M: Array
    N: Array
    weights: Array
    spread: float
    share: float

    @classmethod
    def of(cls, cells, P, weights, S):
        """``S`` [cells]: the relative noise of the cells when they were weighed."""
        scaled = normalised(cells, weights) * weights * cells.w
        spread = float(scaled**2 @ S / np.sum(cells.w**2))
        return cls(P, *weighted(cells, weights), weights, spread, float(np.average(weights, weights=cells.w)))

    def solved(self, rho, biased):
        """What covariances follow from; ``rho`` is the smoothness of the texture, ``biased`` see ``chain.Solved``."""
        p = full(self.P)
        variance = np.einsum("ik,ij,jk->k", p, self.M, p) / np.einsum("ik,ij,jk->k", p, self.N, p)
        return chain.Solved(self.M, self.P, variance, self.N, rho * self.spread, min(self.share, 1.0), biased)


def full(P):
    """Solutions [N, k], with the identity in the time-like rows."""
    return np.vstack([P, np.eye(P.shape[1])])


def relative_noise(cells: Cells, P):
    """S [cells]: noise of the residual in every cell, relative to the window's; the mean over the solutions."""
    p = full(P)
    c = np.einsum("ik,i,ik->k", p, cells.noise, p)
    return np.mean(np.sum(p * (cells.C @ p), axis=1) / c, axis=1)


def residuals(cells: Cells, P, c=None):
    """R [cells]: image noise variance that the residual in every cell amounts to, were the noise everywhere as in the
    mean; the mean over the solutions. 0 in cells without valid samples. ``c`` [k]: gain of the noise of a solution."""
    p = full(P)
    c = np.einsum("ik,i,ik->k", p, cells.noise, p) if c is None else c
    sums = np.mean(np.sum(p * (cells.J @ p), axis=1) / c, axis=1)
    return np.divide(sums, cells.w, out=np.zeros_like(sums), where=cells.w > 0)


def normalised(cells: Cells, weights):
    """What weighted sums are multiplied by so that the mean weight is 1."""
    return cells.w.sum() / (weights @ cells.w)


def weighted(cells: Cells, weights):
    """M = Σ ω J_b and N = Σ ω w_b C_b [N, N], for the mean weight 1."""
    factor = normalised(cells, weights)
    return factor * np.tensordot(weights, cells.J, 1), factor * np.tensordot(weights * cells.w, cells.C, 1)


def parameters(vectors, k):
    """P [n_flow, k] from vectors [N, k] of the null space."""
    return vectors[:-k] @ np.linalg.inv(vectors[-k:])


def nearest_zero(X, scales, k):
    """P from the k eigenvalues of ``D X D`` that are nearest to 0; ``scales`` [N] is the diagonal of D."""
    values, vectors = np.linalg.eigh(X * np.outer(scales, scales))
    return parameters(scales[:, None] * vectors[:, np.argsort(np.abs(values))[:k]], k)


def generalised(M, N, k):
    """P from the k smallest eigenvalues of ``M v = λ N v``."""
    return parameters(eigh(M, N)[1][:, :k], k)


def plain(cells: Cells, estimator, scale=1.0):
    """The estimators without weights: ols, tls, tls-equilibrated."""
    J, columns = cells.tensor, cells.columns
    if estimator == "ols":
        P = chain.solutions_ols(J, columns)
    else:
        raw = chain.coordinate_scales(columns, scale)
        P = chain.solutions_tls(J, columns, cells.noise**-0.5 if estimator == "tls-equilibrated" else raw)
    return Found(P, J, np.diag(cells.noise), np.ones_like(cells.w), 1.0, 1.0)


def reweighted(cells: Cells, iterations, solve):
    """Rounds of ``P = solve(P, M, N)`` with the weights 1 / S_b from the equilibrated total least squares on."""
    P = plain(cells, "tls-equilibrated").P
    for _ in range(iterations):
        S = relative_noise(cells, P)
        P = solve(P, *weighted(cells, 1 / S))
    return Found.of(cells, P, 1 / S, S)


def sampson(cells: Cells, iterations, scale=1.0):
    """Sampson's scheme: the residual of every cell over its noise (2.25)."""
    D = chain.coordinate_scales(cells.columns, scale)
    return reweighted(cells, iterations, lambda _, M, N: chain.solutions_tls(M, cells.columns, D))


def fns(cells: Cells, iterations, scale=1.0):
    """Fundamental numerical scheme: where ``X p`` vanishes ``Σ w_b R_b / S_b`` is stationary. Sums are those of the
    last solution."""
    D, k = chain.coordinate_scales(cells.columns, scale), cells.columns.n_time_like
    P = reweighted(cells, iterations, lambda P, *_: nearest_zero(fundamental(cells, P), D, k)).P
    S = relative_noise(cells, P)
    return Found.of(cells, P, 1 / S, S)


def fundamental(cells: Cells, P):
    """X [N, N], by which ``X p`` is the gradient of ``Σ w_b R_b / S_b``, scaled as M."""
    weights = 1 / relative_noise(cells, P)
    pull = weights**2 * residuals(cells, P) * cells.w
    return weighted(cells, weights)[0] - normalised(cells, weights) * np.tensordot(pull, cells.C, 1)


def for3(cells: Cells, iterations):
    """First order renormalisation III: ``M v = λ N v`` with both sums weighted; needs no scale."""
    k = cells.columns.n_time_like
    return reweighted(cells, iterations, lambda _, M, N: generalised(M, N, k))


PENALTIES: dict[str, tuple[Callable, Callable]] = {
    "lorentzian": (lambda u: 1 / (1 + u / 2), lambda u: 2 * np.log1p(u / 2)),
    "geman-mcclure": (lambda u: 1 / (1 + u) ** 2, lambda u: u / (1 + u)),
    "truncated": (lambda u: np.where(u < 1, 1.0, 0.0), lambda u: np.minimum(u, 1.0)),
}
"""Of ``u = e²/σ²``: the weight ψ, and the penalty whose derivative it is (2.37)-(2.39)."""


@dataclass(frozen=True)
class Level:
    """A residual variance that grows with the noise and with what models leave out: ``noise`` times its variance, and
    that of a misplacement by ``px``."""

    noise: float
    px: float = 0.0

    def of(self, cells: Cells, noise):
        """For the noise variance ``noise``."""
        columns = cells.columns
        energy = np.mean([cells.tensor[i, i] for i in (columns.index("x"), columns.index("y"))]) / cells.w.sum()
        return self.noise * noise + self.px**2 * energy / np.mean(cells.noise[-columns.n_time_like :])


@dataclass(frozen=True)
class Schedule:
    """How the scale σ of the penalty falls, and what is estimated meanwhile; ``noise``: variance of the images' noise.

    σ² is ``start`` times the mean residual, times ``shrink`` after every round, at least the level ``least``. In the
    first ``translation`` rounds the columns without offset are estimated alone, in the others all columns. In these
    rounds and ``narrow`` further ones the middle of the window counts most, by a Gaussian of ``width`` times the
    window's; then there are ``wide`` rounds. The translation starts at its fit without a penalty.
    """

    start: float
    shrink: float
    least: Level
    translation: int
    narrow: int
    wide: int
    noise: float = 0.0
    width: float = 1.0


def graduated(cells: Cells, P, measures, psi, solve, schedule: Schedule):
    """Rounds of ``solve(M, N, columns, P, step)`` with weights ``ψ(R / S / σ²) / S``; ``step``: the mean weight, by
    which steps are shorter, or None for the columns without offset alone: they are always solved for.

    ``P``: of the plain fit. ``measures``: R and S of every cell by the parameters.
    """
    columns, before = cells.columns, np.ones_like(cells.w)
    near = np.exp(-0.5 * cells.distance / schedule.width**2)
    still = [i for i, c in enumerate(columns.columns) if c.offset == "1"]

    def solved(P, weights, first):
        active = still if first else list(range(columns.n))
        step = None if first else 1 / normalised(cells, weights)
        return expanded(solve(*weighted(cells, weights), active, P, step), active, columns)

    if schedule.translation:
        before = near / relative_noise(cells, P)
        P = solved(P, before, True)
    least = schedule.least.of(cells, schedule.noise)
    square = max(schedule.start * np.average(measures(P)[0], weights=before * cells.w), least)
    for number in range(schedule.translation + schedule.narrow + schedule.wide):
        R, S = measures(P)
        weights = psi(R / S / square) / S
        if number < schedule.translation + schedule.narrow:
            weights = weights * near
        P = solved(P, weights, number < schedule.translation)
        square = max(schedule.shrink * square, least)
    return Found.of(cells, P, weights, S)


def expanded(P, active, columns: ColumnSet):
    """P [n_flow, k] from the parameters of some columns, the others being 0."""
    out = np.zeros((columns.n_flow, columns.n_time_like))
    out[active[: -columns.n_time_like]] = P
    return out


def least_squares(M, N, active, P, step):
    """Parameters of the ``active`` columns: ``M_ff p = -M_f,time``."""
    k = P.shape[1]
    A = M[np.ix_(active, active)]
    return -np.linalg.solve(A[:-k, :-k], A[:-k, -k:])


def plain_measures(cells: Cells):
    """R and S of cells where the noise is all in the time-like columns."""
    c, ones = cells.noise[-cells.columns.n_time_like :], np.ones_like(cells.w)
    return lambda P: (residuals(cells, P, c), ones)


def robust_ols(cells: Cells, penalty, schedule: Schedule):
    """Iteratively reweighted least squares; the noise is all in the time-like columns (2.35)."""
    start = plain(cells, "ols").P
    return graduated(cells, start, plain_measures(cells), PENALTIES[penalty][0], least_squares, schedule)


def robust_ols_sor(cells: Cells, penalty, schedule: Schedule, factor, sweeps=1):
    """The same minimum by sweeps of successive over-relaxation, J_ii being the bound of the curvature.

    Derivatives start at 0, the translation at its solution.
    """
    bound = np.diag(cells.tensor)

    def relax(M, N, active, P, step):
        if step is None:
            return least_squares(M, N, active, P, step)
        P = P.copy()
        for _ in range(sweeps):
            for i in range(len(P)):
                P[i] -= factor * step * (M[i] @ full(P)) / bound[i]
        return P

    start = plain(cells, "ols").P
    return graduated(cells, start, plain_measures(cells), PENALTIES[penalty][0], relax, schedule)


def robust_tls(cells: Cells, penalty, schedule: Schedule):
    """Weights for what is far off, and for the noise of every cell; solved as renormalisation III (2.42)."""

    def measures(P):
        return residuals(cells, P), relative_noise(cells, P)

    def solve(M, N, active, P, step):
        some = np.ix_(active, active)
        return generalised(M[some], N[some], P.shape[1])

    start = plain(cells, "tls-equilibrated").P
    return graduated(cells, start, measures, PENALTIES[penalty][0], solve, schedule)


ROBUST = {"robust-ols": "ols", "robust-ols-sor": "ols", "robust-tls": "tls-equilibrated"}
"""Robust estimators, and the plain ones that must have failed where they are wanted."""


def failed(cells: Cells, estimator, most: Level, noise):
    """Whether the residual of the plain fit is above the level ``most``; ``noise``: variance of the images' noise."""
    plain_fit = ROBUST[estimator]
    P = plain(cells, plain_fit).P
    R = plain_measures(cells)(P)[0] if plain_fit == "ols" else residuals(cells, P)
    return np.average(R, weights=cells.w) > most.of(cells, noise)


def estimate(cells: Cells, problem):
    """What the library's ``problem`` asks for, with the library's tunables."""
    name = problem.estimator
    rounds = {"sampson": sampson_stages.ROUNDS, "fns": fns_stages.ROUNDS, "for3": for3_stages.ROUNDS}
    if name in ("sampson", "fns"):
        return {"sampson": sampson, "fns": fns}[name](cells, rounds[name], problem.scale)
    if name == "for3":
        return for3(cells, rounds[name])
    if name not in ROBUST:
        return plain(cells, name, problem.scale)
    variance = problem.noise**2
    schedule = Schedule(
        tables.SCALE_START, tables.SCALE_SHRINK, Level(tables.LEAST_NOISE, tables.LEAST_PX),
        robust_stages.TRANSLATION_ROUNDS, robust_stages.NARROW_ROUNDS, robust_stages.ROUNDS, variance, NARROW,
    )  # fmt: skip
    most = Level(tables.MOST_NOISE, tables.MOST_PX)
    if problem.robust == "failed" and not failed(cells, name, most, variance):
        return plain(cells, ROBUST[name])
    if name == "robust-ols-sor":
        return robust_ols_sor(cells, problem.penalty, schedule, tables.RELAXATION, robust_stages.SWEEPS)
    return {"robust-ols": robust_ols, "robust-tls": robust_tls}[name](cells, problem.penalty, schedule)
