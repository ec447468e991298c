"""Standard errors of means over regions, from those of pixels and the correlation between them.

The errors of neighbouring pixels hang together, for their windows overlap. For a mean with the weights w,

    Var = Σ_ij w_i w_j σ_i σ_j R(i - j),   R a sum of products R_y(Δy) R_x(Δx)

What a window says of a value is a weighted mean of noise over it, and R falls off as windows part. What it says of a
derivative weighs the noise with opposite signs on both sides, so that neighbours' errors cancel in a mean over a
region, up to its border: R is negative in between. Slopes are derivatives along their own axis; rotations, and growth
within a window, of both kinds alike; growth also takes out that a surface comes nearer, 2 N_z / Z, a value.

For growth from the motions of different windows see ``region_divergence``.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.correlation import NoiseCorrelation, correlation_matrix
from leafflow_ti.results import ResultStore

Floats = NDArray[np.float64]
Maps = Mapping[str, Floats]


@dataclass(frozen=True)
class Term:
    """A share of a map's variance with the correlation ``y``, ``x`` at 0, 1, 2, ... rows and columns; beyond: 0."""

    share: float
    y: Floats
    x: Floats


@dataclass(frozen=True)
class RegionNoise:
    """How the errors of a store's maps hang together.

    ``value``, ``gradient``: correlation (y, x) of values and of derivatives in a window, None if not stated;
    ``frames``: at 0, 1, 2, ... frames; ``refined``: whether growth comes from the refinement; ``reach``: output rows
    and columns on each side that the window of ``area_rate`` holds, and ``averaged``: frames that it is the mean of.
    """

    value: tuple[Floats, Floats]
    gradient: tuple[Floats, Floats] | None
    frames: Floats
    refined: bool
    reach: tuple[int, int] = (0, 0)
    averaged: int = 1

    @classmethod
    def of(cls, store: ResultStore) -> RegionNoise:
        """Of a store; where it states no correlations, errors count as the same throughout a window."""
        noise, attrs = NoiseCorrelation.of(store), store.attrs
        gradient = None
        if noise.y_gradient is not None and noise.x_gradient is not None:
            gradient = noise.y_gradient, noise.x_gradient
        step_y, step_x = (int(p[1] - p[0]) if p.size > 1 else 1 for p in (store.y, store.x))
        growth = attrs.get("growth", {})
        half = int(growth.get("strain_window_px", 1)) // 2
        reach, averaged = (half // step_y, half // step_x), int(growth.get("average_frames", 1))
        return cls((noise.y, noise.x), gradient, noise.t, _refined(attrs), reach, averaged)

    @property
    def margin(self) -> int:
        """Output rows and columns around a region that its growth is taken from, too."""
        return max(*self.reach, 1)

    def averaging(self, t: int, frames: int) -> float:
        """Variance of ``area_rate`` in the frame with index ``t`` of ``frames``, per that of a single frame's."""
        half = self.averaged // 2
        n = min(frames, t + half + 1) - max(0, t - half)
        return float(correlation_matrix(self.frames, n).sum()) / n**2

    def over_time(self, name: str) -> Floats:
        """Correlation of the errors of the map ``name`` at 0, 1, 2, ... frames."""
        if name != "area_rate" or self.averaged == 1:
            return self.frames
        both, box = np.concatenate([self.frames[:0:-1], self.frames]), np.ones(self.averaged)
        means = np.convolve(np.correlate(box, box, "full"), both)
        middle = means.size // 2
        return np.asarray(means[middle:] / means[middle])

    def terms(self, name: str, part: Maps) -> tuple[Term, ...]:
        """The correlation of the errors of the map ``name`` in a region with the maps ``part`` [y, x].

        Where nothing better is known, it is that of values: an error bar that is too long rather than too short.
        """
        (y, x), gradient = self.value, self.gradient
        whole = (Term(1.0, y, x),)
        if gradient is None:
            return whole
        if name == "slope_x":
            return (Term(1.0, y, gradient[1]),)
        if name == "slope_y":
            return (Term(1.0, gradient[0], x),)
        near = _near(part) if name == "growth_rate" else 0.0
        if name.startswith("rotation") or (name == "growth_rate" and self.refined):
            alike = 0.5 * (1 - near)
            return (Term(alike, gradient[0], x), Term(alike, y, gradient[1]), Term(near, y, x))
        return whole


def mean_variance(weights: Floats, std: Floats, terms: tuple[Term, ...]) -> float:
    """Variance of ``Σ w v`` [y, x] for values with the standard errors ``std`` [y, x]; weights are 0 where v counts
    not."""
    error = np.where(weights != 0, weights * np.where(weights != 0, std, 0.0), 0.0)
    return max(sum(term.share * correlated(error, error, term.y, term.x) for term in terms), 0.0)


def correlated(one: Floats, two: Floats, r_y: Floats, r_x: Floats) -> float:
    """``Σ_ij one_i two_j R_y(Δy) R_x(Δx)`` over maps [y, x]."""
    y, x = (correlation_matrix(r, n) for r, n in zip((r_y, r_x), one.shape, strict=True))
    return float(np.sum(one * (y @ two @ x)))


def _near(part: Maps) -> float:
    """Share of ``2 N_z / Z`` in the variance of the growth rate, over a region."""
    if "velocity_z_std" not in part or "growth_rate_std" not in part:
        return 0.0
    approach, own = 200 * part["velocity_z_std"] / part["depth"], part["growth_rate_std"]
    known = np.isfinite(approach) & np.isfinite(own)
    return min(1.0, float((approach[known] ** 2).mean() / (own[known] ** 2).mean())) if known.any() else 0.0


def _refined(attrs: Mapping[str, Any]) -> bool:
    """Whether the store's values are those of the exact refinement."""
    try:
        return int(tomllib.loads(attrs["config"])["refine"]["steps"]) > 0
    except (KeyError, ValueError):
        return False
