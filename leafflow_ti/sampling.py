"""Filters and window weights along each of the five axes, and what image noise becomes under them."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.blocks import Blocks
from leafflow_ti.filters import FilterSet, gaussian_weights
from leafflow_ti.models import AXES, ONE, Column, ColumnSet

Array = NDArray[np.float64]


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
    def uneven(self) -> bool:
        """Whether kernels differ from sample to sample."""
        return False

    @property
    def reference(self) -> int:
        """Index of the reference sample, where that matters."""
        return 0

    def about(self, sample: int) -> AxisSampling:
        """The same about another reference sample of the sequence."""
        return self

    @property
    def taps(self) -> int:
        """Samples under the filters."""
        return self.filters.taps if self.filters else 1

    @property
    def filter_radius(self) -> int:
        """Halo of the filters alone."""
        return self.filters.radius if self.filters else 0

    @property
    def radius(self) -> int:
        """Halo of window and filters together: samples needed on each side of the centre."""
        return self.size // 2 + self.filter_radius

    @property
    def before(self) -> int:
        """Samples needed before the reference sample; as many behind it (``after``) where the taps are odd."""
        return self.size // 2 + (self.taps - 1) // 2

    @property
    def after(self) -> int:
        """Samples needed behind the reference sample. With an even number of taps the results lie half a sample behind
        it."""
        return self.size // 2 + self.taps // 2

    @property
    def halfway(self) -> float:
        """How far behind the reference sample the results lie, in samples: 0, or .5 with an even number of taps."""
        return 0.0 if self.taps % 2 else 0.5

    @property
    def positions(self) -> Array:
        """Of all samples that are needed, from where the results lie: [before + 1 + after], in nominal steps."""
        return self.around(self.before, self.after)

    def around(self, before: int, after: int) -> Array:
        """Of so many samples before and behind the reference sample: [before + 1 + after], in nominal steps."""
        return np.asarray(np.arange(-before, after + 1) - self.halfway, np.float64)

    @cached_property
    def offsets(self) -> Array:
        """Where the filtered samples of the window lie, from its centre, shape (size,)."""
        return np.asarray(np.arange(self.size) - self.size // 2, np.float64)

    def kernel(self, differentiate: bool, sample: int = 0) -> Array:
        """Filter kernel of a sample, counted from the reference; the identity where there is a single sample."""
        if self.filters is None:
            return np.ones(1)
        return self.filters.kernel(differentiate)

    @cached_property
    def _weights(self) -> Array:
        return np.array(self.weights)

    def window(self, power: int) -> Array:
        """Weights times the offset to ``power``: ``w(Δ) Δ^power``, shape (size,)."""
        return np.asarray(self._weights * self.offsets**power)

    def moment(self, power: int) -> float:
        """``Σ w(Δ) Δ^power``."""
        return float(self.window(power).sum())

    def response(self, differentiate: bool, power: int) -> Array:
        """Weights of the unfiltered samples in ``Σ w(Δ) Δ^power`` times the filtered ones, [size + taps - 1]."""
        return np.asarray(np.convolve(self.window(power), self.kernel(differentiate)))

    def gains(self, differentiate: bool) -> Array:
        """Noise variance of each filtered sample per variance of the samples' noise, shape (size,)."""
        return np.full(self.size, np.sum(self.kernel(differentiate) ** 2))

    def gain(self, differentiate: bool, power: int = 0) -> float:
        """The same, averaged over the window with the weights ``w(Δ) Δ^power``; 1, whose sum vanishes, as 0."""
        return float(np.sum(self.kernel(differentiate) ** 2))


class CameraGrid(Protocol):
    """What knows the kernels of a camera grid that is no product of two axes."""

    def kernel(self, names: tuple[str, str], row: int, col: int) -> Array:
        """Kernel [taps along sy, taps along sx] of the sample (row, col), from the reference; names "d" or "b"."""


@dataclass(frozen=True)
class Sampling:
    """The sampling of all five axes."""

    x: AxisSampling
    y: AxisSampling
    sx: AxisSampling = AxisSampling()
    sy: AxisSampling = AxisSampling()
    t: AxisSampling = AxisSampling()
    grid: CameraGrid | None = None
    """Kernels of both camera axes together; None: they are products of one along each."""

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

    def about(self, frame: int) -> Sampling:
        """The sampling about the reference frame ``frame``: another one where frames are uneven in time."""
        return replace(self, t=self.t.about(frame)) if self.t.uneven else self

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


def noise_gain(sampling: Sampling, channel: str, exponents: tuple[int, ...] = ONE) -> float:
    """Variance of a channel per variance of the image noise: product of the squared filter norms (2.24).

    Where samples are uneven it differs from one to the next; ``exponents``: averaged over ``w(Δ) Δ^exponents``.
    """
    return float(np.prod([sampling.axis(a).gain(a == channel, e) for a, e in zip(AXES, exponents, strict=True)]))


def channel_noise(sampling: Sampling, columns: ColumnSet, channel: str, exponents: tuple[int, ...] = ONE) -> float:
    """The same, also of channels that are made of several images."""
    return columns.derived[channel].gain if channel in columns.derived else noise_gain(sampling, channel, exponents)


def white_smoothness(sampling: Sampling) -> float:
    """Share of the gradient's energy that smoothing in x and y once more leaves of white noise; 1 without smoothing."""

    def share(axis: AxisSampling, differentiate: bool) -> float:
        h = axis.kernel(differentiate)
        return float(np.sum(np.convolve(h, axis.kernel(False)) ** 2) / np.sum(h**2))

    return share(sampling.x, True) * share(sampling.y, False)


def column_noise(sampling: Sampling, columns: ColumnSet) -> Array:
    """Diagonal of ``C = Σ w C_i``, the noise covariance of the columns summed over the window; shape (N,).

    For symmetric windows C is diagonal: the filters of different channels are orthogonal, odd moments vanish, and
    squares are centred. Of what uneven cameras or frames add, nothing counts: Ix, Iy and the time-like channels stay
    orthogonal by their kernels along x and y, first moments vanish by the choice of the weights (see ``uneven``); only
    I and a time-like channel share noise, and that is next to nothing beside the energy of I.
    """

    def of(column: Column) -> float:
        total = 0.0
        for p, q in product(column.terms, repeat=2):
            if (p.channel, p.vector) == (q.channel, q.vector):
                e = _sum(p.exponents, q.exponents)
                total += p.factor * q.factor * channel_noise(sampling, columns, p.channel, e) * sampling.moment(e)
        return total

    return np.array([of(c) for c in columns.columns])


def _sum(one: tuple[int, ...], two: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(m + n for m, n in zip(one, two, strict=True))


def pixel_factor(axis: AxisSampling, m: int, n: int) -> float:
    """Ratio of the moments of w² and w along an image axis; the geometric mean where an odd moment vanishes."""

    def ratio(power: int) -> float:
        return float(np.sum(np.array(axis.weights) * axis.window(power)) / axis.moment(power))

    return ratio(m + n) if (m + n) % 2 == 0 else float(np.sqrt(ratio(2 * m) * ratio(2 * n)))


def _series_factor(axis: AxisSampling, differentiate: bool, m: int, n: int) -> float:
    """Exact noise of a weighted sum of filtered samples along a camera or time axis, relative to the moment of w."""
    if (m + n) % 2:
        return 0.0
    noise = np.dot(axis.response(differentiate, m), axis.response(differentiate, n))
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
            value *= pixel_factor(axis, m, n) if name in ("x", "y") else _series_factor(axis, name == solution, m, n)
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
        return float(np.dot(axis.response(True, derivative_power), axis.response(False, smooth_power)))

    value = series(one, 0, 1) * series(two, 0, 1) * pixel_factor(sampling.x, 0, 0) * pixel_factor(sampling.y, 0, 0)
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
        seen = axis.response(False, power)
        i = at + len(seen) // 2
        return float(seen[i]) if 0 <= i < len(seen) else 0.0

    found = []
    for column in columns.columns[: columns.n_flow]:
        e = dict(zip(AXES, column.terms[0].exponents, strict=True))
        factor = share(sampling.sx, e["sx"], step[0]) * share(sampling.sy, e["sy"], step[1])
        partner = own.index(column.channel, column.offset.replace("sx", "").replace("sy", "") or "1")
        found.append((-1 if partner is None or factor == 0 else partner, factor))
    return found
