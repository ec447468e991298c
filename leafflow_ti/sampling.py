"""Filters and window weights along each of the five axes, and what image noise becomes under them."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.filters import FilterSet, gaussian_weights
from leafflow_ti.models import AXES, Column, ColumnSet

Array = NDArray[np.float64]


LEAST_BLOCKS = 9
"""Blocks across a window: with fewer, its steps are so coarse that measured errors grow."""


@dataclass(frozen=True)
class Blocks:
    """Window weights that are constant on blocks of samples, so that sums over blocks serve every window.

    Block b covers the samples ``b * step`` to ``b * step + length - 1`` with the weights ``weights[b] * shape``.
    Blocks side by side share a sample where ``length`` is ``step + 1``; its ``shape`` is then ½ in both.
    """

    step: int
    shape: tuple[float, ...]
    weights: tuple[float, ...]

    @property
    def length(self) -> int:
        """Samples of a block."""
        return len(self.shape)

    @property
    def inner(self) -> Array:
        """Offsets of a block's samples from its middle."""
        return np.asarray(np.arange(self.length) - (self.length - 1) / 2, np.float64)

    @property
    def centres(self) -> Array:
        """Offsets of the blocks' middles from that of the window."""
        return np.asarray(self.step * (np.arange(len(self.weights)) - (len(self.weights) - 1) / 2), np.float64)

    @classmethod
    @functools.lru_cache(maxsize=64)
    def of(cls, size: int, moment: float, stride: int) -> Blocks | None:
        """Blocks for outputs at distance ``stride`` in place of a window of ``size`` samples; None: no such blocks.

        ``step`` is the largest divisor of ``stride`` that leaves ``LEAST_BLOCKS`` across the window. Their number is
        the one whose window is nearest to ``size`` in length (the shorter of two): within ``(step + 1) / 2`` samples.
        Weights are those of a Gaussian at the middles of the blocks, its σ such that the second moment of the window
        is ``moment``, or else as near to it as its length allows.
        """
        steps = [d for d in range(2, stride + 1) if stride % d == 0 and (size - 1) // d >= LEAST_BLOCKS]
        if not steps:
            return None
        step = steps[-1]

        def shape(n: int) -> tuple[float, ...]:
            # An output lies at the middle of its window, which must be a sample: blocks share samples unless both
            # their number and their length are odd.
            return (1.0,) * step if n % 2 and step % 2 else (0.5, *(1.0,) * (step - 1), 0.5)

        fewest = (size - 1) // step
        n = min(range(fewest - 1, fewest + 2), key=lambda n: abs((n - 1) * step + len(shape(n)) - size))

        def narrowed(q: float) -> Blocks:
            w = np.exp(-q * cls(step, shape(n), (1.0,) * n).centres ** 2)
            return cls(step, shape(n), tuple((w / (w.sum() * sum(shape(n)))).tolist()))

        low, high = 0.0, 1.0
        for _ in range(200):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if narrowed(middle).moment > moment else (low, middle)
        return narrowed(low)

    @property
    def moment(self) -> float:
        """``Σ w(Δ) Δ²``."""
        offset = self.centres[:, None] + self.inner
        return float(np.sum(np.outer(self.weights, self.shape) * offset**2))

    @property
    def samples(self) -> tuple[float, ...]:
        """Weight of every sample of the window."""
        found = np.zeros((len(self.weights) - 1) * self.step + self.length)
        for b, weight in enumerate(self.weights):
            found[b * self.step : b * self.step + self.length] += weight * np.array(self.shape)
        return tuple(found.tolist())


@dataclass(frozen=True)
class AxisSampling:
    """One axis: its derivative filters (None: a single sample, no derivative) and its window weights (sum 1).

    ``blocks``: the blocks that ``weights`` are constant on; ``blocked`` has one block per sample where there are none.
    """

    filters: FilterSet | None = None
    weights: tuple[float, ...] = (1.0,)
    blocks: Blocks | None = None

    @classmethod
    def gaussian(cls, filters: FilterSet | None, size: int, sigma: float, stride: int = 1) -> AxisSampling:
        """Window of ``size`` samples with a Gaussian of ``sigma`` samples, for outputs at distance ``stride``.

        With a stride the weights are constant on blocks where the window is large enough, see ``Blocks.of``.
        """
        plain = cls(filters, tuple(gaussian_weights(size, sigma).tolist()))
        blocks = Blocks.of(size, plain.moment(2), stride)
        return cls(filters, blocks.samples, blocks) if blocks else plain

    @property
    def blocked(self) -> Blocks:
        """The window as blocks."""
        return self.blocks or Blocks(1, (1.0,), self.weights)

    @property
    def size(self) -> int:
        """Number of window samples."""
        return len(self.weights)

    @property
    def filter_radius(self) -> int:
        """Halo of the filters alone."""
        return self.filters.radius if self.filters else 0

    @property
    def radius(self) -> int:
        """Halo of window and filters together: samples needed on each side of the centre."""
        return self.size // 2 + self.filter_radius

    def kernel(self, differentiate: bool) -> Array:
        """Filter kernel along this axis; the identity where there is a single sample."""
        if self.filters is None:
            return np.ones(1)
        return self.filters.kernel(differentiate)

    def window(self, power: int) -> Array:
        """Weights times the offset to ``power``: ``w(Δ) Δ^power``, shape (size,)."""
        offset = np.arange(self.size) - self.size // 2
        return np.asarray(np.array(self.weights) * offset.astype(float) ** power)

    def moment(self, power: int) -> float:
        """``Σ w(Δ) Δ^power``."""
        return float(self.window(power).sum())


@dataclass(frozen=True)
class Sampling:
    """The sampling of all five axes."""

    x: AxisSampling
    y: AxisSampling
    sx: AxisSampling = AxisSampling()
    sy: AxisSampling = AxisSampling()
    t: AxisSampling = AxisSampling()

    def axis(self, name: str) -> AxisSampling:
        """The sampling along one axis of ``AXES``."""
        sampling: AxisSampling = getattr(self, name)
        return sampling

    @property
    def camera_axes(self) -> tuple[str, ...]:
        """Camera axes that have a derivative."""
        return tuple(a for a in ("sx", "sy") if self.axis(a).filters is not None)

    @property
    def sampled(self) -> dict[str, float]:
        """Axes along which the window holds more than one sample, and the second moment of its weights."""
        return {a: self.axis(a).moment(2) for a in AXES if self.axis(a).size > 1}

    def moment(self, exponents: tuple[int, ...]) -> float:
        """``Σ w(Δ) Δ^exponents`` over the whole window."""
        return float(np.prod([self.axis(a).moment(e) for a, e in zip(AXES, exponents, strict=True)]))


def difference_variance(axis: AxisSampling, span: int, power: int = 0) -> float:
    """Variance of ``(e(span) - e(0)) / span`` per variance of e, the error of a moment ``Σ w(Δ) Δ^power n(Δ)``.

    Windows side by side share most of their noise n, the errors at distance d have the correlation
    ``R(d) = Σ v(Δ) v(Δ + d) / Σ v²``, v = w Δ^power, and the quotient the variance ``2 (1 - R(span)) / span²``.
    """
    v = np.convolve(axis.window(power), axis.kernel(False))
    shared = float(np.dot(v[span:], v[: max(v.size - span, 0)]) / np.dot(v, v))
    return 2 * (1 - shared) / span**2


def noise_gain(sampling: Sampling, channel: str) -> float:
    """Variance of a channel per variance of the image noise: product of the squared filter norms (2.24)."""
    return float(np.prod([np.sum(sampling.axis(a).kernel(a == channel) ** 2) for a in AXES]))


def channel_noise(sampling: Sampling, columns: ColumnSet, channel: str) -> float:
    """The same, also of channels that are made of several images."""
    return columns.derived[channel].gain if channel in columns.derived else noise_gain(sampling, channel)


def white_smoothness(sampling: Sampling) -> float:
    """Share of the gradient's energy that smoothing in x and y once more leaves of white noise; 1 without smoothing."""

    def share(axis: AxisSampling, differentiate: bool) -> float:
        h = axis.kernel(differentiate)
        return float(np.sum(np.convolve(h, axis.kernel(False)) ** 2) / np.sum(h**2))

    return share(sampling.x, True) * share(sampling.y, False)


def column_noise(sampling: Sampling, columns: ColumnSet) -> Array:
    """Diagonal of ``C = Σ w C_i``, the noise covariance of the columns summed over the window; shape (N,).

    For symmetric windows C is diagonal: the filters of different channels are orthogonal, odd moments vanish, and
    squares are centred.
    """

    def of(column: Column) -> float:
        return sum(
            p.factor
            * q.factor
            * channel_noise(sampling, columns, p.channel)
            * sampling.moment(_sum(p.exponents, q.exponents))
            for p, q in product(column.terms, repeat=2)
            if (p.channel, p.vector) == (q.channel, q.vector)
        )

    return np.array([of(c) for c in columns.columns])


def _sum(one: tuple[int, ...], two: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(m + n for m, n in zip(one, two, strict=True))


def _pixel_factor(axis: AxisSampling, m: int, n: int) -> float:
    """Ratio of the moments of w² and w along an image axis; the geometric mean where an odd moment vanishes."""

    def ratio(power: int) -> float:
        return float(np.sum(np.array(axis.weights) * axis.window(power)) / axis.moment(power))

    return ratio(m + n) if (m + n) % 2 == 0 else float(np.sqrt(ratio(2 * m) * ratio(2 * n)))


def _series_factor(axis: AxisSampling, differentiate: bool, m: int, n: int) -> float:
    """Exact noise of a weighted sum of filtered samples along a camera or time axis, relative to the moment of w."""
    if (m + n) % 2:
        return 0.0
    h = axis.kernel(differentiate)[::-1]
    noise = np.dot(np.convolve(h, axis.window(m)), np.convolve(h, axis.window(n)))
    return float(noise / axis.moment(m + n))


@dataclass(frozen=True)
class NoiseTerm:
    """Part of a noise covariance: ``Cov(Σ w f_a n_i, Σ w f_b n_j) += σ² ρ J[base_a, base_b] value``."""

    a: int
    b: int
    base_a: int
    base_b: int
    value: float


@functools.lru_cache(maxsize=64)
def noise_ratio(sampling: Sampling, columns: ColumnSet, solution: str) -> tuple[Array, tuple[NoiseTerm, ...]]:
    """``Cov(Σ w f n) = σ² ρ (J_ff ∘ K + terms)`` for the solution along ``solution``: K [n_flow, n_flow] and terms.

    ``f`` are the columns that are not time-like and ``n`` the residual that image noise of variance σ² leaves. In the
    frame that moves with the texture, n is the derivative of the noise along ``solution`` smoothed along all other
    axes; f is then constant along camera and time axes, where the few samples are summed exactly (the noise of a
    derivative telescopes there). In x and y, w is smooth on the scale of the filters, so the sum runs over w², and
    the smoothing meets the texture's own spectrum: that is the factor ρ, measured per pixel.

    All this is said of monomials. A centred square is one less a share of the constant, and K differs between the two:
    the difference is the terms, of the lower triangle (a >= b) alone, the same ones for every solution.
    """

    def factor(one: tuple[int, ...], two: tuple[int, ...]) -> float:
        value = 1.0
        for name, m, n in zip(AXES, one, two, strict=True):
            axis = sampling.axis(name)
            value *= _pixel_factor(axis, m, n) if name in ("x", "y") else _series_factor(axis, name == solution, m, n)
        return value

    n = columns.n_flow
    powers = [c.terms[0].exponents for c in columns.columns[:n]]
    K = np.array([[factor(a, b) for b in powers] for a in powers])
    shares: dict[int, list[tuple[int, float]]] = {}
    for base, square, share in columns.at_centre:
        shares.setdefault(square, []).append((base, share))
    terms = []
    for a in range(n):
        for b in range(a + 1):
            found: dict[tuple[int, int], float] = {}
            # Column -> monomials, K between these, monomials -> columns whose J is known.
            for (p, u), (q, v) in product([(a, 1.0), *shares.get(a, ())], [(b, 1.0), *shares.get(b, ())]):
                for (c, r), (d, s) in product([(p, 1.0), *shares.get(p, ())], [(q, 1.0), *shares.get(q, ())]):
                    sign = (-1.0) ** ((c != p) + (d != q))
                    pair = (max(c, d), min(c, d))
                    found[pair] = found.get(pair, 0.0) + sign * u * v * r * s * float(K[p, q])
            found.pop((a, b))
            terms += [NoiseTerm(a, b, *pair, value) for pair, value in found.items()]
    K.flags.writeable = False  # shared by all who ask
    return K, tuple(terms)


def cross_noise(sampling: Sampling, columns: ColumnSet, first: str, second: str) -> tuple[NoiseTerm, ...]:
    """The covariances between two solutions that do not vanish by symmetry.

    ``∂/∂t`` of the disparity and ``∂/∂s`` of the motion are the same mixed derivative, measured twice from the same
    noise: only the pairs (offset along the other's axis) × (offset along one's own axis) are correlated.
    """
    one, two = sampling.axis(first), sampling.axis(second)

    def series(axis: AxisSampling, derivative_power: int, smooth_power: int) -> float:
        d, b = axis.kernel(True)[::-1], axis.kernel(False)[::-1]
        return float(np.dot(np.convolve(d, axis.window(derivative_power)), np.convolve(b, axis.window(smooth_power))))

    value = series(one, 0, 1) * series(two, 0, 1) * _pixel_factor(sampling.x, 0, 0) * _pixel_factor(sampling.y, 0, 0)
    terms = []
    for p in ("x", "y", "i"):
        for q in ("x", "y", "i"):
            a, b = columns.index(p, second), columns.index(q, first)
            base_a, base_b = columns.index(p), columns.index(q)
            if a is not None and b is not None and base_a is not None and base_b is not None:
                terms.append(NoiseTerm(a, b, base_a, base_b, value))
    return tuple(terms)


def shared_noise(
    sampling: Sampling, columns: ColumnSet, own: ColumnSet, step: tuple[int, int]
) -> list[tuple[int, float]]:
    """What the motion solution of the columns of a grid has in common with one camera's own flow.

    For every column a that is not time-like: the own column a' of the same channel and the same offset in x, y, t, and
    the factor with ``Cov(Σ w f_a n, Σ w f_b n_c) = factor · Cov(Σ w f_a' n_c, Σ w f_b n_c)``: the share of camera c,
    ``step`` = (x, y) steps from the reference, in the filters and the window along the camera axes. Partner -1: none.
    """

    def share(axis: AxisSampling, power: int, at: int) -> float:
        seen = np.convolve(axis.kernel(False)[::-1], axis.window(power))
        i = at + len(seen) // 2
        return float(seen[i]) if 0 <= i < len(seen) else 0.0

    found = []
    for column in columns.columns[: columns.n_flow]:
        e = dict(zip(AXES, column.terms[0].exponents, strict=True))
        factor = share(sampling.sx, e["sx"], step[0]) * share(sampling.sy, e["sy"], step[1])
        partner = own.index(column.channel, column.offset.replace("sx", "").replace("sy", "") or "1")
        found.append((-1 if partner is None or factor == 0 else partner, factor))
    return found
