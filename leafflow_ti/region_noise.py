"""Standard errors of means over regions, from those of pixels and the correlation between them.

The errors of neighbouring pixels hang together, for their windows overlap. For a mean with the weights w,

    Var = Σ_ij w_i w_j σ_i σ_j R(i - j),   R a sum of products R_y(Δy) R_x(Δx)

What a window says of a value is a weighted mean of noise over it, and R falls off as windows part (``R_0``). What it
says of a derivative weighs the noise with opposite signs on both sides, so that neighbours' errors cancel in a mean
over a region, up to its border (``R_1``, negative in between). A growth rate is the divergence of the motion in the
image, half of its variance from the derivative along x, half from that along y, and what takes a surface that comes
nearer out of it: 2 N_z / Z, a value. Slopes are derivatives along their own axis, rotations of both kinds alike.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.correlation import KEY, NoiseCorrelation
from leafflow_ti.results import ResultStore

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Term:
    """A share of a map's variance with the correlation ``y``, ``x`` at 0, 1, 2, ... rows and columns; beyond: 0."""

    share: float
    y: Floats
    x: Floats


@dataclass(frozen=True)
class RegionNoise:
    """How the errors of a store's maps hang together.

    ``value``, ``gradient``: R_0, R_1 (y, x), None if not stated; ``frames``: correlation at 0, 1, 2, ... frames;
    ``refined``: whether growth comes from the refinement; ``fit``: side of the window of ``area_rate`` in output rows
    and columns, None if there is none.
    """

    value: tuple[Floats, Floats]
    gradient: tuple[Floats, Floats] | None
    frames: Floats
    refined: bool
    fit: tuple[int, int] | None

    @classmethod
    def of(cls, store: ResultStore) -> RegionNoise:
        """Of a store; where it states no correlations, errors count as the same throughout a window."""
        noise, attrs = NoiseCorrelation.of(store), store.attrs
        stated: Mapping[str, list[float]] = attrs.get("plan", {}).get(KEY, {})
        pitch = [int(p[1] - p[0]) if p.size > 1 else 1 for p in (store.y, store.x)]
        gradient = None
        if "x_gradient" in stated:
            gradient = tuple(np.array(stated[f"{a}_gradient"])[::p] for a, p in zip("yx", pitch, strict=True))
        window = attrs.get("growth", {}).get("strain_window_px")
        fit = None if window is None else tuple(2 * (int(window) // 2 // p) + 1 for p in pitch)
        return cls((noise.y, noise.x), gradient, noise.t, _refined(attrs), fit)  # type: ignore[arg-type]

    def terms(self, name: str, near: float = 0.0) -> tuple[Term, ...]:
        """The correlation of the errors of the map ``name``; ``near``: a growth's variance from ``2 N_z / Z``, per
        its own.

        Where nothing better is known, that of values: an error bar that is too long rather than too short.
        """
        value = Term(1.0, *self.value)
        if self.gradient is None:
            return (value,)
        if name == "area_rate" and self.fit is not None:
            mean, slope = (tuple(_filtered(r, w(n)) for r, n in zip(self.value, self.fit, strict=True)) for w in _FITS)
            near *= float(np.prod([_averaged(r, n) for r, n in zip(self.value, self.fit, strict=True)]))
        elif name == "growth_rate":
            mean = self.value
            slope = self.gradient if self.refined else tuple(_filtered(r, np.array([-1.0, 0.0, 1.0])) for r in mean)
        elif name in ("slope_x", "slope_y"):
            along_y, along_x = self.gradient
            y, x = self.value
            return (Term(1.0, y, along_x) if name == "slope_x" else Term(1.0, along_y, x),)
        elif name.startswith("rotation"):
            mean, slope = self.value, self.gradient
        else:
            return (value,)
        near = min(near, 1.0)
        return (Term((1 - near) / 2, slope[0], mean[1]), Term((1 - near) / 2, mean[0], slope[1]), Term(near, *mean))


def mean_variance(weights: Floats, std: Floats, terms: tuple[Term, ...]) -> float:
    """Variance of ``Σ w v`` [y, x] for values with the standard errors ``std`` [y, x]; weights are 0 where v counts
    not."""
    error = np.where(weights != 0, weights * np.where(weights != 0, std, 0.0), 0.0)
    total = 0.0
    for term in terms:
        y, x = (_matrix(r, n) for r, n in zip((term.y, term.x), error.shape, strict=True))
        total += term.share * float(np.sum(error * (y @ error @ x)))
    return max(total, 0.0)


def _matrix(r: Floats, n: int) -> Floats:
    """Correlation matrix [n, n] of ``r`` at distances 0, 1, 2, ..."""
    padded = np.zeros(n)
    padded[: min(n, r.size)] = r[:n]
    return np.asarray(padded[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))])


_FITS = (np.ones, lambda n: np.arange(n) - (n - 1) / 2)
"""Weights of ``n`` values in the mean and the slope of a straight line fitted to them."""


def _averaged(r: Floats, n: int) -> float:
    """Variance of the mean of ``n`` values with the correlation ``r``, per that of a value."""
    return float(_matrix(r, n).sum()) / n**2


def _filtered(r: Floats, weights: Floats) -> Floats:
    """Correlation of weighted sums of neighbouring values with the correlation ``r``."""
    both = np.concatenate([r[:0:-1], r])
    found = np.convolve(np.correlate(weights, weights, "full"), both)
    middle = found.size // 2
    return np.asarray(found[middle:] / found[middle]) if found[middle] > 0 else np.ones(1)


def _refined(attrs: Mapping[str, Any]) -> bool:
    """Whether the store's values are those of the exact refinement."""
    import tomllib

    try:
        return int(tomllib.loads(attrs["config"])["refine"]["steps"]) > 0
    except (KeyError, ValueError):
        return False
