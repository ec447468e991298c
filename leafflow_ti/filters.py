"""Derivative filter sets and window weights (Schuchert 2010, Table 2.1, section 2.2).

One-sided coefficients h0..hR of the antisymmetric derivative D and of the symmetric smoothing B; of sets with an even
number of taps (for time) those at the offsets 1/2, 3/2: what they measure lies half way between two samples. They
are renormalised so that ``sum r D_r = 1`` and ``sum B = 1`` hold exactly. The four digits printed for 7 taps cannot
be all right (they sum to 0.9995 and 1.0004); renormalised they differentiate with a gain error of 1.8e-3 at 1.8
rad/px. The ones here, within 1.2e-4 of the printed, minimise the largest gain error up to there: 1e-5. Longer sets do
so further, without a print to stay near: 9 taps 2.4e-7 up to 2.4 rad/px, 11 taps 1e-6 up to 2.6; 4 taps 1.6e-5 up to 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_TABLE: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "3x1x1": ((0.0, 0.5), (1.0, 0.0)),
    "3": ((0.0, 0.5), (0.6326, 0.1837)),
    "5": ((0.0, 0.3327, 0.0836), (0.4704, 0.2415, 0.0233)),
    "7": ((0.0, 0.223320, 0.118963, 0.012918), (0.384567, 0.246220, 0.058339, 0.003158)),
    "9": (
        (0.0, 0.171569071, 0.120639844, 0.027049732, 0.001500511),
        (0.341477975, 0.239495824, 0.079059816, 0.010380691, 0.000324682),
    ),
    "11": (
        (0.0, 0.126798469, 0.112927383, 0.040723194, 0.005987052, 0.000245795),
        (0.300808461, 0.228274343, 0.097526095, 0.021668861, 0.002075562, 0.000050907),
    ),
}
_HALFWAY: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "2": ((1.0,), (0.5,)),
    "4": ((0.431689061, 0.189436980), (0.446864227, 0.053135773)),
}
FILTER_SETS = tuple(_TABLE)
HALFWAY_SETS = tuple(_HALFWAY)
"""Sets with an even number of taps, for time: what they measure lies half way between two samples."""

BLUR_CUT = 3
"""Sigmas at which the Gaussian of ``FilterSet.blurred`` is cut off."""
MAX_BLUR = 4.0
"""Widest such Gaussian [samples]: beyond, the filters would be longer than the windows they serve."""


@dataclass(frozen=True)
class FilterSet:
    """Correlation kernels over the samples around the one that is measured at: ``derivative`` and ``smooth``.

    An odd number of taps has the offsets -radius..radius, an even one ±1/2, ±3/2, ...
    """

    name: str
    derivative: tuple[float, ...]
    smooth: tuple[float, ...]

    @property
    def radius(self) -> int:
        """Half length: the halo that the filter needs."""
        return len(self.smooth) // 2

    @property
    def taps(self) -> int:
        """Samples that it takes."""
        return len(self.smooth)

    @property
    def offsets(self) -> Array:
        """Where these lie, shape (taps,)."""
        return np.asarray(np.arange(self.taps) - (self.taps - 1) / 2, np.float64)

    def kernel(self, differentiate: bool) -> Array:
        """The derivative or the smoothing kernel, shape (taps,)."""
        return np.array(self.derivative if differentiate else self.smooth)

    def blurred(self, sigma: float) -> FilterSet:
        """The set of a signal that a Gaussian of ``sigma`` samples has smoothed; itself for 0."""
        if sigma == 0.0:
            return self
        gaussian = gaussian_weights(2 * blur_radius(sigma) + 1, sigma)
        derivative, smooth = (np.convolve(self.kernel(d), gaussian) for d in (True, False))
        return FilterSet(f"{self.name}, blur {sigma:g}", tuple(derivative.tolist()), tuple(smooth.tolist()))


def blur_radius(sigma: float) -> int:
    """Half length of the Gaussian of ``FilterSet.blurred``."""
    return math.ceil(BLUR_CUT * sigma)


def filter_set(name: str) -> FilterSet:
    """The filter set with this name (of ``FILTER_SETS``; Table 2.1 has "3x1x1", "3", "5", "7"), renormalised."""
    d, b = (np.array(h) for h in (_TABLE | _HALFWAY)[name])
    if name in _HALFWAY:
        d, b = d / (2 * np.sum((np.arange(len(d)) + 0.5) * d)), b / (2 * b.sum())
        return FilterSet(
            name, tuple(np.concatenate([-d[::-1], d]).tolist()), tuple(np.concatenate([b[::-1], b]).tolist())
        )
    d = d / (2 * np.sum(np.arange(len(d)) * d))
    b = b / (2 * b.sum() - b[0])
    return FilterSet(
        name, tuple(np.concatenate([-d[:0:-1], d]).tolist()), tuple(np.concatenate([b[:0:-1], b]).tolist())
    )


def choose_filter_set(n_samples: int, wanted: str = "5") -> FilterSet | None:
    """The largest set, at most ``wanted``, that ``n_samples`` samples along an axis allow; None below three samples."""
    for name in ("7", "5", "3"):
        if int(name) <= n_samples and int(name) <= int(wanted.split("x")[0]):
            return filter_set("3x1x1" if wanted == "3x1x1" else name)
    return None


def gaussian_radius(sigma: float) -> int:
    """Half length of a Gaussian that is cut off at four sigmas."""
    return math.ceil(4 * sigma)


def gaussian_weights(size: int, sigma: float) -> Array:
    """Gaussian over ``size`` (odd) samples, normalised to sum 1; shape (size,)."""
    offset = np.arange(size) - size // 2
    w = np.exp(-0.5 * (offset / sigma) ** 2)
    return np.asarray(w / w.sum())
