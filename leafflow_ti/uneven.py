"""Samples at measured positions: cameras that stand off their nominal places, frames at irregular times.

The kernels of a filtered sample are those of the even set, changed as little as its conditions allow. With positions s
from the sample's place, in units of their mean distance, these are ``Σ D = 0``, ``Σ s D = 1``, ``Σ s² D = 0``, ``Σ B =
1``, ``Σ s B = 0``, and from four taps on ``Σ s³ D - 3 Σ s² B`` as in the even set: D is the derivative of what B
smooths, to third order. Of the kernels that fulfil them, those are taken whose mismatch ``Σ D exp(iωs) - iω Σ B
exp(iωs)`` over the frequencies of the texture is nearest to that of the even set. Samples that are even have the even
set itself, bit for bit. ``Σ s³ B`` is left free: across a gap of three frames the depth of a moving surface is off by
1e-4 for it, but holding it at 0 there costs two and a half times the noise.

A filtered sample lies where its middle image does (half way between the two middle ones of an even number). Window
weights are a Gaussian at these places, tilted by the factor ``exp(λΔ)`` for which the first moment vanishes: constant
and slope of a window then stay uncorrelated.

Positions across the axis (cameras of a row that stand above or below it) are no part of this. Images are read shifted
by the preshift at their measured places along both axes (``Capture.shifts``), so that what is left across the axis
is the residual disparity, below a pixel per step, times some hundredths of a step; it changes the vertical disparity,
which is known to be 0 and which only noise ties to the disparity along the axis: an error of second order.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.filters import FilterSet, gaussian_weights
from leafflow_ti.sampling import AxisSampling

Array = NDArray[np.float64]

SAME = 1e-9
"""Steps by which positions may differ from even ones and count as even."""
BAND = np.linspace(0.05, 1.8, 36)
"""Frequencies [rad per mean distance] at which kernels are matched: where even sets are good."""
HOLD = 1e-3
"""Weight of the kernels' own change beside that of the mismatch."""


def is_even(positions: Array) -> bool:
    """Whether positions are one nominal step apart."""
    return bool(np.all(np.abs(positions - positions[0] - np.arange(len(positions))) <= SAME))


def adapted(filters: FilterSet, positions: Array) -> tuple[Array, Array]:
    """Derivative and smoothing kernel [taps] of a filter set for samples at ``positions`` [taps], increasing.

    Positions count from the sample's place; the derivative is by their unit.
    """
    even_d, even_b = filters.kernel(True), filters.kernel(False)
    distance = (positions[-1] - positions[0]) / (filters.taps - 1)
    s = positions / distance
    if np.all(np.abs(s - filters.offsets) <= SAME):
        return even_d if abs(distance - 1) <= SAME else even_d / distance, even_b
    n, zero = filters.taps, np.zeros(filters.taps)
    conditions = [(s**0, zero, 0.0), (s, zero, 1.0), (zero, s**0, 1.0), (zero, s, 0.0)]
    if n > 2:
        conditions.append((s**2, zero, 0.0))
    if n > 3:
        third = filters.offsets**3 @ even_d - 3 * filters.offsets**2 @ even_b
        conditions.append((s**3, -3 * s**2, float(third)))

    def mismatch(at: Array) -> Array:
        """Real and imaginary part of the mismatch [2 frequencies, 2 taps] at positions ``at``."""
        waves = np.exp(1j * np.outer(BAND, at))
        both = np.hstack([waves, -1j * BAND[:, None] * waves]) * smooth[:, None]
        return np.vstack([both.real, both.imag])

    # The texture is what the smoothing leaves of it.
    smooth = np.abs(np.exp(1j * np.outer(BAND, filters.offsets)) @ even_b) ** 2
    even = np.concatenate([even_d, even_b])
    wanted = np.concatenate([mismatch(filters.offsets) @ even, HOLD * even])
    A = np.vstack([mismatch(s), HOLD * np.eye(2 * n)])
    C = np.array([np.concatenate(c[:2]) for c in conditions])
    k = len(conditions)
    system = np.block([[A.T @ A, C.T], [C, np.zeros((k, k))]])
    right = np.concatenate([A.T @ wanted, [c[2] for c in conditions]])
    found = np.linalg.lstsq(system, right, rcond=1e-13)[0][: 2 * n]
    return found[:n] / distance, found[n:]


def tilted_weights(offsets: Array, sigma: float) -> Array:
    """Weights [size], sum 1, of a Gaussian of ``sigma`` at ``offsets`` [size], tilted so that ``Σ w Δ = 0``.

    Offsets lie on both sides of 0, or the tilt is left out.
    """
    log = -0.5 * (offsets / sigma) ** 2
    tilt = 0.0
    for _ in range(100 if offsets.min() < 0 < offsets.max() else 0):
        w = np.exp(log + tilt * offsets)
        first, second = w @ offsets / w.sum(), w @ offsets**2 / w.sum()
        tilt -= first / (second - first**2)
        if abs(first) < 1e-15:
            break
    w = np.exp(log + tilt * offsets)
    return np.asarray(w / w.sum())


@dataclass(frozen=True)
class UnevenSampling(AxisSampling):
    """An axis whose samples lie at ``places`` [nominal steps]; ``centre``: index of the reference sample.

    ``sigma``: of the window, in nominal steps. ``origin``: where the reference lies; for frames that is their place,
    so that another reference has another origin (``about``), for cameras 0 throughout.
    """

    places: tuple[float, ...] = ()
    centre: int = 0
    sigma: float = 1.0
    origin: float = 0.0

    @classmethod
    def of(
        cls, filters: FilterSet, size: int, sigma: float, places: tuple[float, ...], centre: int, origin: float = 0.0
    ) -> UnevenSampling:
        """A window of ``size`` samples around the one with the index ``centre``, under ``filters``."""
        one = cls(filters, (1.0,) * size, None, places, centre, sigma, origin)
        even = is_even(one.positions) and abs(one.positions[one.before] + one.halfway) <= SAME
        weights = gaussian_weights(size, sigma) if even else tilted_weights(one.offsets, sigma)
        return replace(one, weights=tuple(weights.tolist()))

    @classmethod
    def of_frames(
        cls, filters: FilterSet, size: int, sigma: float, times: tuple[float, ...], frame: int
    ) -> UnevenSampling:
        """The same along time, from where the results of the reference ``frame`` lie; ``times`` in nominal steps."""
        origin = times[frame] if filters.taps % 2 else 0.5 * (times[frame] + times[frame + 1])
        return cls.of(filters, size, sigma, times, frame, origin)

    @property
    def uneven(self) -> bool:
        """See ``AxisSampling``."""
        return True

    @property
    def reference(self) -> int:
        """See ``AxisSampling``."""
        return self.centre

    def about(self, sample: int) -> UnevenSampling:
        """See ``AxisSampling``."""
        assert self.filters is not None
        return self.of_frames(self.filters, self.size, self.sigma, self.places, sample)

    @property
    def halfway(self) -> float:
        """See ``AxisSampling``; in nominal steps."""
        return 0.0 if self.taps % 2 else self.origin - self.places[self.centre]

    def around(self, before: int, after: int) -> Array:
        """See ``AxisSampling``."""
        return np.array(self.places[self.centre - before : self.centre + after + 1]) - self.origin

    def _under(self, sample: int) -> tuple[float, ...]:
        """Places under the filters of a sample, counted from the reference sample."""
        first = self.centre + sample - (self.taps - 1) // 2
        assert 0 <= first <= len(self.places) - self.taps
        return self.places[first : first + self.taps]

    @cached_property
    def offsets(self) -> Array:
        """See ``AxisSampling``."""
        half = self.size // 2
        return np.array([_middle(self._under(i)) for i in range(-half, half + 1)]) - self.origin

    def kernel(self, differentiate: bool, sample: int = 0) -> Array:
        """See ``AxisSampling``."""
        assert self.filters is not None
        return _kernels(self.filters, self._under(sample))[0 if differentiate else 1]

    def moment(self, power: int) -> float:
        """See ``AxisSampling``; the first one vanishes but for rounding."""
        return 0.0 if power == 1 and self.size > 1 else float(self.window(power).sum())

    def response(self, differentiate: bool, power: int) -> Array:
        """See ``AxisSampling``."""
        found = np.zeros(self.size + self.taps - 1)
        for i, weight in enumerate(self.window(power)):
            found[i : i + self.taps] += weight * self.kernel(differentiate, i - self.size // 2)
        return found

    def gains(self, differentiate: bool) -> Array:
        """See ``AxisSampling``."""
        samples = np.arange(self.size) - self.size // 2
        return np.array([np.sum(self.kernel(differentiate, int(i)) ** 2) for i in samples])

    def gain(self, differentiate: bool, power: int = 0) -> float:
        """See ``AxisSampling``."""
        window = self.window(power if power > 1 else 0)
        return float(window @ self.gains(differentiate) / window.sum())


def _middle(under: tuple[float, ...]) -> float:
    """Where a filtered sample lies, from the places under the filters."""
    return 0.5 * (under[(len(under) - 1) // 2] + under[len(under) // 2])


@functools.lru_cache(maxsize=512)
def _kernels(filters: FilterSet, under: tuple[float, ...]) -> tuple[Array, Array]:
    """Derivative and smoothing kernel of samples at these places; the same whatever the reference is."""
    return adapted(filters, np.array(under) - _middle(under))


@dataclass(frozen=True)
class UnevenGrid:
    """Kernels of both camera axes together for cameras at ``x``, ``y`` [rows, columns], nominal steps.

    ``along_x``, ``along_y``: the axes with the mean positions of columns and rows. A kernel is the product of theirs,
    changed as little as possible (least squares) so that its moments up to the second on the true positions are those
    of the product on the mean ones. ``reference``: row and column of the reference camera.
    """

    x: tuple[tuple[float, ...], ...]
    y: tuple[tuple[float, ...], ...]
    along_x: AxisSampling
    along_y: AxisSampling
    reference: tuple[int, int]
    mean_x: tuple[float, ...]
    mean_y: tuple[float, ...]

    def kernel(self, names: tuple[str, str], row: int, col: int) -> Array:
        """Kernel [taps along sy, taps along sx] of the sample (row, col), from the reference; names "d" or "b"."""
        return _grid_kernel(self, names, row, col)


@functools.lru_cache(maxsize=512)
def _grid_kernel(grid: UnevenGrid, names: tuple[str, str], row: int, col: int) -> Array:
    even = np.outer(grid.along_y.kernel(names[0] == "d", row), grid.along_x.kernel(names[1] == "d", col))
    first = [r + i - n // 2 for r, i, n in zip(grid.reference, (row, col), even.shape, strict=True)]
    under = tuple(slice(f, f + n) for f, n in zip(first, even.shape, strict=True))
    mean = np.meshgrid(np.array(grid.mean_y)[under[0]], np.array(grid.mean_x)[under[1]], indexing="ij")
    true = np.array(grid.y)[under], np.array(grid.x)[under]
    # From the sample's place: powers of small numbers are better conditioned.
    place = np.array(grid.mean_y)[grid.reference[0] + row], np.array(grid.mean_x)[grid.reference[1] + col]
    powers = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)]

    def monomials(y: Array, x: Array) -> Array:
        return np.array([((y - place[0]) ** i * (x - place[1]) ** j).ravel() for i, j in powers])

    wanted, A = monomials(*mean) @ even.ravel(), monomials(*true)
    change = np.linalg.lstsq(A, wanted - A @ even.ravel(), rcond=None)[0]
    return np.asarray(even + change.reshape(even.shape))
