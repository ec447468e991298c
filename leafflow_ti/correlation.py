"""How the errors of the velocity hang together: its components, neighbouring output pixels, frames.

The covariance of the components at a pixel follows from the maps ``velocity_*_std`` and ``velocity_correlation_*``. At
pixels (Δx, Δy) and frames Δt apart it is that, times ``R_x(Δx) R_y(Δy) R_t(Δt)``. A run states R, which follows from
what its measurements share:

Along x and y an error is a sum of image noise over the window's pixels, each with its weight and the gradient there. Of
the model, ``R(d) = Σ v(Δ) v(Δ + d) / Σ v²``, v the weights under the smoothing filter. Of the refinement, which takes
every ``thin``-th pixel around its own centre from smoothed images, ``Σ w(Δ) w(Δ') c(d + Δ' - Δ)``, c being the
correlation of interpolated noise: neighbours whose samples fall between one another's share little else.
Along t a velocity is a difference between late and early frames, which the next frame's result takes with shifted
weights: ``R(d) = Σ v(t) v(t + d) / Σ v²`` again, v the derivative filters under the window, or the weights of a
regression's slope. Some of these are negative: what is averaged over a few frames is better than its single values say.

What a window tells of derivatives, slopes and growth among them, weighs the noise with opposite signs on both sides:
``v(Δ) Δ`` in place of v. Such errors are correlated negatively from about half a window on.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from leafflow_ti.errors import InputError
from leafflow_ti.field import CORRELATIONS, MOTION_NAMES, Field
from leafflow_ti.plan import Plan
from leafflow_ti.refine_plan import Refinement
from leafflow_ti.results import ResultStore
from leafflow_ti.sampling import AxisSampling
from leafflow_ti.stages.refine_tables import noise_correlation as interpolated_noise

Array = NDArray[np.float64]

INDEPENDENT = 0.1
"""Correlation of errors below which estimates count as independent."""
KEY = "noise_correlation"
"""Of the attribute ``plan`` of a results store."""
DIGITS = 5
USUAL_FRAMES = 9
"""Frames that windows and filters along time usually take together."""
VELOCITY = MOTION_NAMES[:3]
PAIRS = ((0, 1), (0, 2), (1, 2))
"""Components of the correlations, in their order."""


@dataclass(frozen=True, eq=False)
class NoiseCorrelation:
    """Correlation of the velocity's errors at 0, 1, 2, ... output columns, rows and frames; beyond the end it is 0.

    ``x_gradient``, ``y_gradient``: of what a window tells of derivatives along x and y; None where it is not known.
    ``stated``: by the run itself. Else the store is an older one, and errors are taken as the same throughout a window:
    that is safe for means, but never for differences.
    """

    x: Array
    y: Array
    t: Array
    x_gradient: Array | None = None
    y_gradient: Array | None = None
    stated: bool = True

    @classmethod
    def of(cls, store: ResultStore | Field) -> NoiseCorrelation:
        """Of the results of a run, or of one frame of them."""
        plan: Mapping[str, Any] = store.attrs.get("plan", {})
        if KEY not in plan:
            side = int(tomllib.loads(store.attrs["config"])["window"]["size"])
            x, y = (_at_pitch(np.ones(side), _pitch(positions)) for positions in (store.x, store.y))
            return cls(x, y, np.ones(USUAL_FRAMES), stated=False)
        pitch = {"x": _pitch(store.x), "y": _pitch(store.y)}
        found = {name: _at_pitch(np.array(r, np.float64), pitch.get(name[0], 1)) for name, r in plan[KEY].items()}
        return cls(**{"t": np.ones(1)} | found)

    def between(self, axis: str, places: ArrayLike) -> Array:
        """Correlation matrix [n, n] of errors at these output columns "x", rows "y" or frames "t"; a number n: at as
        many that follow each other."""
        return correlation_matrix(getattr(self, axis), places)

    def independent(self, axis: str) -> int:
        """Distance from which on estimates are independent: output columns "x" or rows "y"."""
        return int(np.flatnonzero(getattr(self, axis) >= INDEPENDENT).max()) + 1


def correlation_matrix(r: Array, places: ArrayLike) -> Array:
    """Matrix [n, n] of the correlation ``r`` at distances 0, 1, 2, ..., 0 beyond; ``places`` as for ``between``."""
    at = np.arange(places) if isinstance(places, int) else np.asarray(places, int)
    distance = np.abs(np.subtract.outer(at, at))
    first = np.zeros(max(int(distance.max(initial=0)) + 1, r.size))
    first[: r.size] = r
    return np.asarray(first[distance])


def _pitch(positions: NDArray[np.int64]) -> int:
    return int(positions[1] - positions[0]) if positions.size > 1 else 1


def _at_pitch(per_pixel: Array, pitch: int) -> Array:
    return per_pixel[::pitch]


def velocity_covariance(maps: Mapping[str, NDArray[Any]]) -> Array:
    """Covariance [..., 3, 3] of the velocity's components in (mm/frame)², from a store's or a field's maps.

    Not finite where a component is not determined. Raises InputError where maps are missing.
    """
    needed = (*(f"{name}_std" for name in VELOCITY), *CORRELATIONS)
    missing = [name for name in needed if name not in maps]
    if missing:
        raise InputError(f"the results have no map '{missing[0]}': measure again, with all of {', '.join(needed)}")
    std = np.stack([np.asarray(maps[f"{name}_std"], np.float64) for name in VELOCITY], axis=-1)
    correlation = np.ones((*std.shape, 3))
    for name, (i, j) in zip(CORRELATIONS, PAIRS, strict=True):
        correlation[..., i, j] = correlation[..., j, i] = maps[name]
    with np.errstate(invalid="ignore"):
        return np.asarray(correlation * std[..., :, None] * std[..., None, :])


def stated_correlation(plan: Plan) -> dict[str, list[float]]:
    """What a run states: R at 0, 1, 2, ... px along x and y and, where there is motion, frames along t.

    ``x_gradient``, ``y_gradient``: the same of what a window tells of derivatives along x and y, as slopes and growth.
    """
    refine, sampling = plan.refine, plan.problem.sampling
    if refine is not None:
        found = {axis: _refined_window(refine) for axis in "xy"}
        found |= {f"{axis}_gradient": _refined_window(refine, 1) for axis in "xy"}
    else:
        found = {axis: _window(sampling.axis(axis)) for axis in "xy"}
        found |= {f"{axis}_gradient": _window(sampling.axis(axis), 1) for axis in "xy"}
    if refine is not None and refine.motion:
        found["t"] = _autocorrelation(slope_weights(refine.frames, refine.motion > 6))
    elif sampling.t.filters is not None:
        found["t"] = _autocorrelation(sampling.t.response(True, 0))
    return {axis: np.round(values, DIGITS).tolist() for axis, values in found.items()}


def slope_weights(frames: tuple[float, ...], accelerated: bool) -> Array:
    """Weights [n] of the frames, at these times, in the slope of a regression with or without a quadratic term."""
    t = np.array(frames)
    terms = [np.ones_like(t), t, t * t] if accelerated else [np.ones_like(t), t]
    return np.asarray(np.linalg.pinv(np.stack(terms, axis=1))[1])


def _autocorrelation(weights: Array) -> Array:
    found = np.correlate(weights, weights, "full")[weights.size - 1 :]
    return np.asarray(found / found[0])


def _window(axis: AxisSampling, power: int = 0) -> Array:
    """Of the model's windows, at 0, 1, 2, ... px; ``power`` 1: of gradients within them."""
    return _autocorrelation(np.convolve(axis.window(power), axis.kernel(False)))


def _refined_window(refine: Refinement, power: int = 0) -> Array:
    """Of the refinement's windows, at 0, 1, 2, ... px; ``power`` 1: of gradients within them."""
    half = refine.across // 2
    offsets = refine.thin * np.arange(-half, half + 1)
    weights = np.zeros(2 * refine.thin * half + 1)
    weights[offsets + refine.thin * half] = offsets**power * np.exp(-0.5 * (offsets / refine.sigma) ** 2)
    one_side = interpolated_noise(1, refine.degree)
    noise = np.concatenate([one_side[:0:-1], one_side])
    shared = np.convolve(np.correlate(weights, weights, "full"), noise)[weights.size + one_side.size - 2 :]
    return np.asarray(shared / shared[0])
