"""Naive float64 twin of the estimators that weight the parts of a window: every part a tensor of its own.

A *cell* is a part of the window whose samples share a weight: a block of pixels with all its camera and time samples,
or in the exact form a single sample. Nothing is shared with the kernels; tables (columns, filters, window weights,
noise gains) come from the library.

Notation (Schuchert 2010, sections 2.3-2.4): P [N, k] the solutions with the identity in their time-like rows, C̄ the
noise covariance of the columns summed over the window, c_j = p_j^T C̄ p_j; of cell b the sum J_b of w d d^T over its
valid samples, their weight w_b, and the mean C_b of the noise covariances (2.24) over all its samples.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from reference import chain
from scipy.linalg import eigh

from leafflow_ti.models import ColumnSet
from leafflow_ti.sampling import Sampling, column_noise, noise_gain

Array = np.ndarray


@dataclass(frozen=True)
class Cells:
    """Cells of one window: ``J`` and ``C`` [cells, N, N], ``w`` [cells]; ``noise`` [N] is the diagonal of C̄."""

    J: Array
    w: Array
    C: Array
    columns: ColumnSet
    noise: Array

    @classmethod
    def of(cls, vectors, seen, sampling: Sampling, columns: ColumnSet, exact=False):
        """From data vectors and the samples that count, as ``chain.window_of`` has them."""
        whole = np.ones_like(seen)
        C = cell_sums(noise_vectors(sampling, columns), whole, sampling, exact)
        mass = partial(cell_sums, [np.ones((1, *vectors[0].shape[1:]))], sampling=sampling, exact=exact)
        return cls(
            cell_sums(vectors, seen, sampling, exact), mass(seen=seen)[:, 0, 0], C / mass(seen=whole), columns,
            column_noise(sampling, columns),
        )  # fmt: skip

    @classmethod
    def at(cls, images, sampling: Sampling, columns: ColumnSet, pixel, valid=None, exact=False):
        """Of the window around a pixel (x, y) of images [t, sy, sx, y, x]; ``valid`` [t, y, x]."""
        return cls.of(*chain.window_of(images, sampling, columns, pixel, valid), sampling, columns, exact)

    @property
    def tensor(self):
        """J [N, N] of the window."""
        return self.J.sum(axis=0)

    def degree_scales(self, scale):
        """D [N]: what columns are multiplied by where the unit of the image coordinates is ``1 / scale`` px."""
        return np.array([scale ** sum(c.terms[0].exponents[:2]) for c in self.columns.columns], dtype=float)


def noise_vectors(sampling: Sampling, columns: ColumnSet):
    """g [N, t, sy, sx, y, x] of every channel of every data vector: the noise covariance (2.24) of d is Σ g g^T."""
    grids = chain.offsets(sampling)
    found = {}
    for i, column in enumerate(columns.columns):
        for term in column.terms:
            g = found.setdefault((term.channel, term.vector), np.zeros((columns.n, *grids["t"].shape)))
            derived = columns.derived.get(term.channel)
            gain = derived.gain if derived else noise_gain(sampling, term.channel)
            g[i] += term.factor * np.sqrt(gain) * chain.monomial(grids, term.exponents)
    return list(found.values())


def cell_sums(vectors, seen, sampling: Sampling, exact):
    """Σ w d d^T over the samples of every cell [cells, n, n] of vectors d [n, t, sy, sx, y, x]."""
    if exact:
        weights = (chain.window_weights(sampling) * seen).ravel()
        flat = [d.reshape(len(d), -1).T for d in vectors]
        return sum(weights[:, None, None] * d[:, :, None] * d[:, None, :] for d in flat)
    series = np.einsum("i,j,k", *(np.array(sampling.axis(a).weights) for a in ("t", "sy", "sx")))
    total = 0.0
    for d in vectors:
        # One matrix product for each pixel: [y, x, n, samples] by [y, x, samples, n].
        weighted = d * (series[..., None, None] * seen)
        one, two = (np.moveaxis(a.reshape(len(d), -1, *d.shape[4:]), (2, 3), (0, 1)) for a in (weighted, d))
        total = total + one @ np.swapaxes(two, 2, 3)
    cells = np.einsum("by,ax,yxij->baij", block_weights(sampling.y), block_weights(sampling.x), total, optimize=True)
    return cells.reshape(-1, *cells.shape[2:])


def block_weights(axis):
    """Weights [blocks, samples] that the blocks of an axis give to its samples."""
    blocks = axis.blocked
    found = np.zeros((len(blocks.weights), axis.size))
    for b, weight in enumerate(blocks.weights):
        found[b, b * blocks.step : b * blocks.step + blocks.length] = weight * np.array(blocks.shape)
    return found


@dataclass(frozen=True)
class Found:
    """What an estimator found: parameters [n_flow, k], the weighted tensor and its noise [N, N], ``weights`` [cells].

    ``M`` and ``N`` are scaled so that the weighted mean of the weights is 1, and those that ``P`` was solved from.
    """

    P: Array
    M: Array
    N: Array
    weights: Array


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


def null_space(X, scale, k, nearest_zero=False):
    """P from the k smallest eigenvalues of ``D X D``, by value or by magnitude; ``scale`` [N] is the diagonal of D."""
    values, vectors = np.linalg.eigh(X * np.outer(scale, scale))
    order = np.argsort(np.abs(values) if nearest_zero else values)
    return parameters(scale[:, None] * vectors[:, order[:k]], k)


def generalised(M, N, k):
    """P from the k smallest eigenvalues of ``M v = λ N v``."""
    return parameters(eigh(M, N)[1][:, :k], k)


def plain(cells: Cells, estimator, scale=1.0):
    """The estimators without weights: ols, tls, tls-equilibrated."""
    J, ones = cells.tensor, np.ones_like(cells.w)
    k = cells.columns.n_time_like
    if estimator == "ols":
        P = chain.solutions_ols(J, cells.columns)
    else:
        P = null_space(J, cells.noise**-0.5 if estimator == "tls-equilibrated" else cells.degree_scales(scale), k)
    return Found(P, *weighted(cells, ones), ones)


def sampson(cells: Cells, iterations, scale=1.0):
    """Sampson's scheme: the residual of every cell over its noise, the weights those of the last round (2.25)."""
    P, D, k = plain(cells, "tls-equilibrated").P, cells.degree_scales(scale), cells.columns.n_time_like
    for _ in range(iterations):
        weights = 1 / relative_noise(cells, P)
        M, N = weighted(cells, weights)
        P = null_space(M, D, k)
    return Found(P, M, N, weights)


def fns(cells: Cells, iterations, scale=1.0):
    """Fundamental numerical scheme: where ``X p`` vanishes ``Σ w_b R_b / S_b`` is stationary."""
    P, D, k = plain(cells, "tls-equilibrated").P, cells.degree_scales(scale), cells.columns.n_time_like
    for _ in range(iterations):
        weights = 1 / relative_noise(cells, P)
        M, N = weighted(cells, weights)
        P = null_space(fundamental(cells, P, weights), D, k, nearest_zero=True)
    return Found(P, M, N, weights)


def fundamental(cells: Cells, P, weights):
    """X [N, N], by which ``X p`` is the gradient of ``Σ w_b R_b / S_b`` where ``weights`` are 1 / S_b."""
    pull = weights**2 * residuals(cells, P) * cells.w
    return weighted(cells, weights)[0] - normalised(cells, weights) * np.tensordot(pull, cells.C, 1)


def for3(cells: Cells, iterations):
    """First order renormalisation III: ``M v = λ N v`` with both sums weighted; needs no scale."""
    P, k = plain(cells, "tls-equilibrated").P, cells.columns.n_time_like
    for _ in range(iterations):
        weights = 1 / relative_noise(cells, P)
        M, N = weighted(cells, weights)
        P = generalised(M, N, k)
    return Found(P, M, N, weights)


PENALTIES: dict[str, tuple[Callable, Callable]] = {
    "lorentzian": (lambda u: 1 / (1 + u / 2), lambda u: 2 * np.log1p(u / 2)),
    "geman-mcclure": (lambda u: 1 / (1 + u) ** 2, lambda u: u / (1 + u)),
    "truncated": (lambda u: np.where(u < 1, 1.0, 0.0), lambda u: np.minimum(u, 1.0)),
}
"""Of ``u = e²/σ²``: the weight ψ, and the penalty whose derivative it is (2.37)-(2.39)."""


@dataclass(frozen=True)
class Schedule:
    """How the scale σ of the penalty falls, and what is estimated meanwhile.

    σ² is ``start`` times the mean residual of the plain fit, times ``shrink`` after every round, at least ``limit``²
    times the floor: the larger one of the variance ``noise`` and that of a misplacement by ``floor_px``. The first
    ``translation`` rounds have the columns of no offset alone, then there are ``affine`` rounds of all columns.
    """

    start: float
    shrink: float
    limit: float
    floor_px: float
    translation: int
    affine: int
    noise: float = 0.0

    def floor(self, cells: Cells):
        """Residual variance below which nothing is an outlier."""
        columns = cells.columns
        energy = sum(cells.tensor[i, i] for i in (columns.index("x"), columns.index("y"))) / cells.w.sum()
        return max(self.noise, self.floor_px**2 * energy / cells.noise[-1])

    def rounds(self, cells: Cells, residual):
        """σ² and the columns of every round; ``residual`` [cells] of the plain fit."""
        square = self.start * (cells.w @ residual) / cells.w.sum()
        least = self.limit**2 * self.floor(cells)
        columns, n = cells.columns, cells.columns.n
        still = [i for i, c in enumerate(columns.columns) if c.offset == "1"]
        for number in range(self.translation + self.affine):
            yield max(square, least), still if number < self.translation else list(range(n))
            square *= self.shrink


def expanded(P, active, columns: ColumnSet):
    """P [n_flow, k] from the parameters of some columns, the others being 0."""
    out = np.zeros((columns.n_flow, columns.n_time_like))
    out[active[: -columns.n_time_like]] = P
    return out


def robust_ols(cells: Cells, penalty, schedule: Schedule):
    """Iteratively reweighted least squares; the noise is all in the time-like columns (2.35)."""
    psi, k = PENALTIES[penalty][0], cells.columns.n_time_like
    P, c = plain(cells, "ols").P, cells.noise[-k:]
    for square, active in schedule.rounds(cells, residuals(cells, P, c)):
        weights = psi(residuals(cells, P, c) / square)
        M, N = weighted(cells, weights)
        A = M[np.ix_(active, active)]
        P = expanded(-np.linalg.solve(A[:-k, :-k], A[:-k, -k:]), active, cells.columns)
    return Found(P, M, N, weights)


def robust_ols_sor(cells: Cells, penalty, schedule: Schedule, factor):
    """The same minimum by successive over-relaxation: one sweep a round, J_ii being the bound of the curvature."""
    psi, k = PENALTIES[penalty][0], cells.columns.n_time_like
    P, c, bound = plain(cells, "ols").P, cells.noise[-k:], np.diag(cells.tensor)
    for square, active in schedule.rounds(cells, residuals(cells, P, c)):
        weights = psi(residuals(cells, P, c) / square)
        M, N = weighted(cells, weights)
        gradient = M / normalised(cells, weights)
        P = expanded(P[active[:-k]], active, cells.columns)
        for i in active[:-k]:
            P[i] -= factor * (gradient[i] @ full(P)) / bound[i]
    return Found(P, M, N, weights)


def robust_tls(cells: Cells, penalty, schedule: Schedule):
    """Weights for what is far off, and for the noise of every cell; solved as renormalisation III (2.42)."""
    psi, k = PENALTIES[penalty][0], cells.columns.n_time_like
    P = plain(cells, "tls-equilibrated").P
    for square, active in schedule.rounds(cells, residuals(cells, P)):
        S = relative_noise(cells, P)
        weights = psi(residuals(cells, P) / S / square) / S
        M, N = weighted(cells, weights)
        some = np.ix_(active, active)
        P = expanded(generalised(M[some], N[some], k), active, cells.columns)
    return Found(P, M, N, weights)
