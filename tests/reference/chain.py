"""Naive float64 twin from images to flow parameters: every sum written out, one pixel at a time, nothing shared with
the kernels.

Only the tables (columns, filters, noise factors) come from the library.
"""

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh
from scipy.ndimage import correlate1d, minimum_filter

from leafflow_ti import sampling as tables
from leafflow_ti.models import AXES, ColumnSet
from leafflow_ti.sampling import Sampling, cross_noise, noise_ratio, pixel_factor

column_noise = functools.cache(tables.column_noise)
ARRAY_AXIS = {"t": 0, "sy": 1, "sx": 2, "y": 3, "x": 4}


def derivative(images, sampling: Sampling, channel: str):
    """One channel of ``images`` [t, sy, sx, y, x], same shape; the outermost filter radius is meaningless.

    Along time a sample of an even number of taps stands at the frame before it. On uneven axes each sample has its own
    kernel; ``images`` hold what the sampling needs along cameras and time, its reference at the index ``before``.
    """
    out = np.asarray(images, dtype=np.float64)
    if sampling.grid and out.shape[1] > 1 and out.shape[2] > 1:
        out = grid_derivative(out, sampling, channel)
    for name in AXES:
        axis, at = sampling.axis(name), ARRAY_AXIS[name]
        if sampling.grid and name in ("sx", "sy"):
            continue
        if name in ("x", "y") or not (axis.uneven or axis.taps % 2 == 0):
            out = correlate1d(out, axis.kernel(name == channel), axis=at, mode="nearest")
            continue
        filtered = np.zeros_like(out)
        for sample in range(-(axis.size // 2), axis.size // 2 + 1):
            first = axis.before + sample - (axis.taps - 1) // 2
            under = np.take(out, range(first, first + axis.taps), axis=at)
            value = np.tensordot(axis.kernel(name == channel, sample), under, axes=(0, at))
            np.moveaxis(filtered, at, 0)[axis.before + sample] = value
        out = filtered
    return out


def grid_derivative(images, sampling: Sampling, channel):
    """``images`` filtered along both camera axes at once."""
    out = np.zeros_like(images)
    sy, sx = sampling.sy, sampling.sx
    for row in range(-(sy.size // 2), sy.size // 2 + 1):
        for col in range(-(sx.size // 2), sx.size // 2 + 1):
            kernel = sampling.grid.kernel(("d" if channel == "sy" else "b", "d" if channel == "sx" else "b"), row, col)
            i, j = (a.radius + n for a, n in ((sy, row), (sx, col)))
            h, w = (n // 2 for n in kernel.shape)
            out[:, i, j] = np.einsum("rc,trcyx->tyx", kernel, images[:, i - h : i + h + 1, j - w : j + w + 1])
    return out


def filters_see(valid, sampling: Sampling):
    """Where every pixel under the filters is valid; [t, y, x] like ``valid``."""
    size = [sampling.axis(a).taps for a in ("t", "y", "x")]
    # Of an even number of frames, the one before the middle and those behind it.
    return minimum_filter(valid.astype(float), size, mode="nearest", origin=[-1 + size[0] % 2, 0, 0])


def window_of(images, sampling: Sampling, columns: ColumnSet, pixel, valid=None):
    """Data vectors [N, t, sy, sx, y, x] of the window around a pixel (x, y), middle camera and frame; which samples
    count, [t, 1, 1, y, x].

    There are several vectors where columns are shared. Samples whose filters see a pixel that is not ``valid``
    [t, y, x] do not count.
    """
    reach = {a: sampling.axis(a).size // 2 for a in ARRAY_AXIS}
    where = {a: sampling.axis(a).before for a in ("t", "sy", "sx")} | dict(zip("xy", pixel, strict=True))
    window = {a: slice(where[a] - reach[a], where[a] + reach[a] + 1) for a in ARRAY_AXIS}
    channels = {c: derivative(images, sampling, c)[tuple(window.values())] for c in columns.channels}
    grids = offsets(sampling)
    vectors = []
    for number in sorted({term.vector for column in columns.columns for term in column.terms}):
        d = np.zeros((columns.n, *grids["t"].shape))
        for i, column in enumerate(columns.columns):
            for term in (term for term in column.terms if term.vector == number):
                d[i] += term.factor * channels[term.channel] * monomial(grids, term.exponents)
        vectors.append(d)
    seen = np.ones((len(images), *images.shape[3:])) if valid is None else filters_see(valid, sampling)
    return vectors, seen[window["t"], window["y"], window["x"]][:, None, None]


def offsets(sampling: Sampling):
    """Offset of every sample of the window from its centre, by axis, each [t, sy, sx, y, x]."""
    along = [sampling.axis(a).offsets for a in ARRAY_AXIS]
    return dict(zip(ARRAY_AXIS, np.meshgrid(*along, indexing="ij"), strict=True))


def monomial(grids, exponents):
    """``Δ^exponents`` of every sample."""
    return np.prod([grids[a] ** e for a, e in zip(AXES, exponents, strict=True)], axis=0)


def window_weights(sampling: Sampling):
    """Weight of every sample of the window [t, sy, sx, y, x]."""
    return np.einsum("i,j,k,l,m", *(np.array(sampling.axis(a).weights) for a in ARRAY_AXIS))


def structure_tensor(images, sampling: Sampling, columns: ColumnSet, pixels, valid=None):
    """J [n, N, N] by direct sums of d d^T over the window around each pixel (x, y), see ``window_of``."""
    result = []
    for pixel in pixels:
        vectors, seen = window_of(images, sampling, columns, pixel, valid)
        weights = (window_weights(sampling) * seen).ravel()
        flat = [d.reshape(columns.n, -1) for d in vectors]
        result.append(sum((d * weights) @ d.T for d in flat))
    return np.array(result)


def shares(columns: ColumnSet):
    """Matrix [n_flow, n_flow] by which the columns come from monomials: 1, and what centring takes off."""
    flow = columns.columns[: columns.n_flow]
    T = np.eye(columns.n_flow)
    for i, column in enumerate(flow):
        for term in column.terms[1:] if max(column.terms[0].exponents) > 1 else ():
            T[i, [c.terms[0] for c in flow].index(replace(term, factor=1.0))] = term.factor
    return T


def unsheared(columns: ColumnSet, motion):
    """T [n_flow, n_flow] with p = T p' but for the flow itself."""
    T = np.eye(columns.n_flow)
    for channel in ("x", "y", "i"):
        t = columns.index(channel, "t")
        for m, o in zip(motion, ("x", "y"), strict=True):
            at = columns.index(channel, o)
            if t is not None and at is not None:
                T[t, at] -= m
    return T


def unshifted(P, cov, columns: ColumnSet, motion=(0.0, 0.0)):
    """The same for images that were not shifted by ``motion`` px per frame: p_t = p'_t - m · (p_x, p_y)."""
    T = unsheared(columns, motion)
    moved = T @ P
    if "t" in columns.solutions:
        k = columns.solutions.index("t")
        for m, channel in zip(motion, ("x", "y"), strict=True):
            moved[columns.index(channel), k] += m
    return moved, T @ cov @ T.T


def at_centre(P, cov, columns: ColumnSet):
    """Parameters [n_flow, k] and covariances of monomials instead of centred columns: the values at the centre."""
    T = shares(columns)
    return T.T @ P, T.T @ cov @ T


def texture_smoothness(images, sampling: Sampling, x, y, valid=None):
    """The factor ρ: energy of the reference camera's gradient smoothed once more in x and y, over its energy.

    Of pixels at which also the filters that smooth once more see what is ``valid`` [t, y, x] alone.
    """
    middle = [sampling.axis(a).before for a in ("t", "sy", "sx")]
    h, w = sampling.y.size // 2, sampling.x.size // 2
    window = np.outer(sampling.y.weights, sampling.x.weights)
    energy = np.zeros(2)
    seen = np.ones((len(images), *images.shape[3:]))
    if valid is not None:
        size = [sampling.t.taps, 2 * sampling.y.taps - 1, 2 * sampling.x.taps - 1]
        seen = minimum_filter(valid.astype(float), size, mode="nearest", origin=[-1 + size[0] % 2, 0, 0])
    for channel in ("x", "y"):
        gradient = derivative(images, sampling, channel)[:, middle[1], middle[2]]
        for i, weight in enumerate(sampling.t.weights, start=middle[0] - sampling.t.size // 2):
            smooth = correlate1d(gradient[i], sampling.y.kernel(False), axis=0)
            smooth = correlate1d(smooth, sampling.x.kernel(False), axis=1)
            for k, image in enumerate((gradient[i], smooth)):
                at = np.s_[y - h : y + h + 1, x - w : x + w + 1]
                energy[k] += weight * np.sum(window * seen[i][at] * image[at] ** 2)
    return energy[1] / energy[0]


def solutions_ols(J, columns: ColumnSet):
    """P [n_flow, k]: Eq. (2.15) for each time-like axis."""
    n = columns.n_flow
    return -np.linalg.solve(J[:n, :n], J[:n, n:])


def solutions_tls(J, columns: ColumnSet, scales):
    """P [n_flow, k] from the k smallest eigenvectors, combined so that one time-like differential is 1 (3.3.2).

    ``scales`` [N]: what the columns are multiplied by.
    """
    _, vectors = np.linalg.eigh(J * np.outer(scales, scales))
    v = vectors[:, : columns.n_time_like] * scales[:, None]
    n = columns.n_flow
    return v[:n] @ np.linalg.inv(v[n:])


def coordinate_scales(columns: ColumnSet, scale):
    """Factors [N] of columns in raw units where those of the image coordinates are ``1 / scale`` px."""
    return np.array([float(scale) ** sum(c.terms[0].exponents[:2]) for c in columns.columns])


def noise_variance(J, P, columns: ColumnSet, noise):
    """Image noise variance [k] that each solution's residual amounts to; ``noise``: covariance of the columns' noise,
    or its diagonal."""
    full = np.vstack([P, np.eye(columns.n_time_like)])
    noise = np.diag(noise) if noise.ndim == 1 else noise
    return np.einsum("ik,ij,jk->k", full, J, full) / np.einsum("ik,ij,jk->k", full, noise, full)


def solution_noise(J, columns: ColumnSet, sampling: Sampling, solution):
    """Noise [n_flow, n_flow] of the normal equations of one solution, per σ² ρ; the ratios are those of monomials."""
    T = shares(columns)
    R = np.linalg.inv(T)
    n = columns.n_flow
    return T @ (R @ J[:n, :n] @ R.T * noise_ratio(sampling, columns, solution)[0]) @ T.T


@dataclass(frozen=True)
class Solved:
    """A solution and what its covariances follow from.

    ``J`` [N, N]: the tensor, weighted where the estimator weighs; ``P`` [n_flow, k]; ``variance`` [k] of the noise that
    the residuals amount to; ``noise`` [N, N]: covariance of the columns' noise, of variance 1; ``rho``: the factor ρ.
    ``support``: mean weight where the window was weighted anew, at most 1; ``biased``: by the noise of all columns but
    the time-like ones, towards 0. Of a window that is cut also ``turn``, ``curved`` and ``centroid`` of ``cut.Cut``.
    """

    J: np.ndarray
    P: np.ndarray
    variance: np.ndarray
    noise: np.ndarray
    rho: float
    support: float = 1.0
    biased: bool = False
    turn: np.ndarray | None = None
    curved: np.ndarray | None = None
    centroid: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of(cls, J, rho, columns: ColumnSet, sampling: Sampling, estimator, scale=1.0, cut=None):
        """By one of the estimators without weights, see ``solve``; ``cut``: of a window that is, its ``cut.Cut``.

        ``rho``: the factor ρ over the share of the window that is seen.
        """
        noise = np.diag(column_noise(sampling, columns)) if cut is None else cut.noise
        found = solve(J, columns, sampling, estimator, scale, None if cut is None else noise)
        if cut is None:
            return cls(J, *found, noise, rho, biased=estimator == "ols")
        rho = rho * cut.share * cut.spread
        return cls(
            J, *found, noise, rho, biased=estimator == "ols", turn=cut.turn, curved=cut.curved, centroid=cut.centroid
        )

    def clean(self, denoise):
        """J_ff less the share ``denoise`` of the noise of its own columns, at the variance of the quietest solution."""
        n = len(self.P)
        return self.J[:n, :n] - denoise * np.min(self.variance) * self.noise[:n, :n]

    def regularised(self, known, denoise):
        """P [n_flow, 1] that takes the place of a single solution which holds a direction of no more than noise.

        ``known``: variance of the images' noise. Three steps with J_ff, noise and all, to the solution without noise.
        """
        n, S = len(self.P), np.diag(self.noise) ** -0.5
        residual = float(np.min(self.variance))
        J, held = self.J * np.outer(S, S), max(min(residual, 4 * known), min(known, 4 * residual)) * denoise
        x = np.zeros(n)
        for _ in range(3):
            x = x + np.linalg.solve(J[:n, :n], held * x - J[:n, :n] @ x - J[:n, n])
        return (S[:n] * x / S[n])[:, None]

    def solution_noise(self, columns: ColumnSet, sampling: Sampling, solution):
        """As the function of this name. Of a cut window, centred squares of x and y are turned as they are; others as
        in a whole one."""
        found = solution_noise(self.J, columns, sampling, solution)
        if self.turn is None:
            return found
        n, K = len(self.P), noise_ratio(sampling, columns, solution)[0]
        powers = [c.terms[0].exponents[:2] for c in columns.columns[:n]]
        square = np.array([max(e) > 1 for e in powers])
        pixels = np.array([
            [pixel_factor(sampling.x, p[0], q[0]) * pixel_factor(sampling.y, p[1], q[1]) for q in powers]
            for p in powers
        ])  # fmt: skip
        centred = np.where(square[:, None] | square, 0.0, found - self.J[:n, :n] * K)
        turned = self.turn @ self.J[:n, :n] @ self.turn.T
        return turned * K * pixel_factor(sampling.x, 0, 0) * pixel_factor(sampling.y, 0, 0) / pixels + centred

    def covariances(self, columns: ColumnSet, sampling: Sampling, denoise):
        """Cov [k, k, n_flow, n_flow] between the parameters of each pair of solutions."""
        n, k = columns.n_flow, columns.n_time_like
        inverse = np.linalg.inv(self.clean(denoise))
        cov = np.zeros((k, k, n, n))
        for i, one in enumerate(columns.solutions):
            for j, two in enumerate(columns.solutions):
                M = np.zeros((n, n))
                if i == j:
                    M = self.solution_noise(columns, sampling, one)
                else:
                    for term in cross_noise(sampling, columns, one, two):
                        M[term.a, term.b] = self.J[term.base_a, term.base_b] * term.value
                cov[i, j] = self.rho * np.sqrt(self.variance[i] * self.variance[j]) * inverse @ M @ inverse
                if i == j and self.biased:
                    bias = inverse @ (self.variance[i] * self.noise[:n, :n] @ self.P[:, i])
                    cov[i, i] += np.outer(bias, bias)
        return cov

    def at_centre(self, columns: ColumnSet, sampling: Sampling, denoise, motion=(0.0, 0.0)):
        """Parameters and covariances of monomials, of images that stand still, see ``at_centre``, ``unshifted``."""
        P, cov = at_centre(self.P, self.covariances(columns, sampling, denoise), columns)
        return unshifted(P, cov, columns, motion)


def covariances(J, variances, columns: ColumnSet, sampling: Sampling, rho=1.0, denoise=0.9):
    """The same for a tensor and the variances [k] of its residuals."""
    solved = Solved(J, np.empty((columns.n_flow, 0)), variances, np.diag(column_noise(sampling, columns)), rho)
    return solved.covariances(columns, sampling, denoise)


def solve(J, columns: ColumnSet, sampling: Sampling, estimator, scale=1.0, noise=None):
    """Parameters P [n_flow, k] of one of the estimators, and the noise variance [k] of their residuals.

    ``scale``: see ``coordinate_scales``; of raw total least squares. ``noise`` [N, N]: covariance of the columns' noise
    where it is not that of a whole window.
    """
    own, noise = noise is not None, column_noise(sampling, columns) if noise is None else noise
    if estimator == "ols":
        P = solutions_ols(J, columns)
    elif own and estimator == "tls-equilibrated":
        vectors = eigh(J, noise)[1][:, : columns.n_time_like]
        P = vectors[: columns.n_flow] @ np.linalg.inv(vectors[columns.n_flow :])
    else:
        scales = noise**-0.5 if estimator == "tls-equilibrated" else coordinate_scales(columns, scale)
        P = solutions_tls(J, columns, scales)
    return P, noise_variance(J, P, columns, noise)
