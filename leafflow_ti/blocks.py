"""Window weights that are constant on blocks of samples."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
