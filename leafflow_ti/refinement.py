"""Refined maps: starts from those of a model, refinement of single pixels, and what follows from its parameters.

Where the refinement does not converge from a pixel's own start it is tried once more from the plane and the motion that
a neighbour has arrived at. Pixels that it does not improve keep the values of the model. A surface that the model has
found curved is refined once more as curved, from the plane that has been found, unless the images contradict.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Geometry
from leafflow_ti.field import CORRELATIONS, FLOW_GRADIENT_NAMES, MOTION_NAMES, PRINCIPAL_NAMES, STRAIN_NAMES
from leafflow_ti.principal import principal_axes
from leafflow_ti.refine_plan import Effort, Refinement
from leafflow_ti.stages.refine import Refined, RefineStage
from leafflow_ti.status import Status

Array = NDArray[Any]
Maps = dict[str, Array]
PARAMETERS = ("depth", "slope_x", "slope_y", *MOTION_NAMES)
"""Maps that are parameters themselves, in their order; growth rates stand behind them."""
PLANE_WINS = 4.0
"""Sum of squared residuals, in their mean, by which a plane must explain the images better than a curved surface: two
standard deviations, if all residuals were independent. A curvature is rarely larger than what one window can tell, but
moves depth and strain all the same; that of a plane comes from systematic errors of the model, and is told at once."""
_GROWTH = len(PARAMETERS)
_NEIGHBOURS = ((0, -1), (0, 1), (-1, 0), (1, 0))


@dataclass(frozen=True)
class Place:
    """Output pixels of some maps: image positions of rows ``y`` and columns ``x``, and of the block's first pixel."""

    y: range
    x: range
    corner: tuple[int, int]
    geometry: Geometry

    def rays(self, rows: Array, cols: Array) -> Array:
        """Positions [n, 2] from the principal point, px."""
        x, y = np.array(self.x)[cols], np.array(self.y)[rows]
        return np.stack([x - self.geometry.principal_px[0], y - self.geometry.principal_px[1]], axis=1).astype(float)


def refine_maps(
    stage: RefineStage, plan: Refinement, maps: Maps, status: NDArray[np.uint8], place: Place, steps: int | None = None,
    curvature: Array | None = None, wanted: NDArray[np.bool_] | None = None,
) -> Effort:  # fmt: skip
    """Refine every pixel whose status is ok and whose depth is known, in place of ``maps`` [rows, cols] and ``status``;
    returns what it took.

    Texture in one direction alone (aperture) does not determine the motion, and the noise in the texture's gradient
    would pass for what does: such pixels keep what the model says. So do those where a robust estimator had to choose
    between surfaces (``support`` below 1): the refinement takes all of the window as one, and would mix them again.
    ``maps`` hold what the model gives; those that only the refinement gives are there, too, and not looked at. Of a
    ``flat`` patch it is the flow that must be known, not the depth. ``steps``: at most so many; None: as planned.
    ``curvature`` [rows, cols, 3]: that of the surface, see ``surface_curvature``, taken unless a plane explains the
    images better; None: planes. ``wanted``: pixels that matter; None: all.
    """
    if "support" in maps:
        status[(status == Status.OK) & (maps["support"] < 1)] = Status.UNREFINED
    begun = refined_from(plan, maps, status)
    rows, cols = np.nonzero(begun if wanted is None else begun & wanted)
    if not rows.size:
        return Effort()
    start = _starts(plan, {name: maps[name][rows, cols] for name in starting(plan) if name in maps}, rows.size)
    found = _call(stage, place, rows, cols, start, steps)
    good, effort = found.converged, found.effort
    parameters, covariance, cost = found.parameters, found.covariance, found.cost
    again, begin = _neighbours(plan, rows, cols, found, place, status.shape)
    if again.size:
        second = _call(stage, place, rows[again], cols[again], begin, steps)
        effort += second.effort
        better = again[second.converged]
        for whole, part in ((parameters, second.parameters), (covariance, second.covariance), (cost, second.cost)):
            whole[better] = part[second.converged]
        good[better] = True
    if curvature is not None:
        bent = np.flatnonzero(good & curvature[rows, cols].any(axis=-1))
        if bent.size:
            curved = _call(stage, place, rows[bent], cols[bent], parameters[bent], steps, curvature[rows, cols][bent])
            effort += curved.effort
            taken = curved.converged & (curved.cost <= (1 + PLANE_WINS / plan.residuals) * cost[bent])
            parameters[bent[taken]], covariance[bent[taken]] = curved.parameters[taken], curved.covariance[taken]
    status[rows[~good], cols[~good]] = Status.UNREFINED
    rows, cols = rows[good], cols[good]
    lever = maps["disparity"][rows, cols].astype(float) * maps["depth"][rows, cols] if "disparity" in maps else None
    _enter(plan, maps, place, rows, cols, parameters[good], covariance[good], lever)
    return effort


def _enter(
    plan: Refinement, maps: Maps, place: Place, rows: Array, cols: Array, parameters: Array, covariance: Array,
    lever: Array | None,
) -> None:  # fmt: skip
    """Write what pixels have been refined to into the maps. ``lever``: disparity times depth."""
    if plan.flat:
        derived = _flat_maps(plan, parameters, covariance)
    else:
        derived = _derived(plan, parameters, covariance, place.rays(rows, cols), place.geometry.f_px)
    if lever is not None:
        depth, std = derived["depth"]
        derived["disparity"] = lever / depth, np.abs(lever) / depth**2 * std
    for name, (values, std) in derived.items():
        for full, found_values in ((name, values), (f"{name}_std", std)):
            if full in maps:
                maps[full][rows, cols] = found_values
    for name, values in _correlations(covariance).items():
        if name in maps:
            maps[name][rows, cols] = values


def refine_middle(stage: RefineStage) -> Refined:
    """Refine the pixel in the middle of the block from a start that means nothing: a frontal plane at rest."""
    start = np.zeros((1, _GROWTH + 3))
    start[:, 0] = 1.0
    return stage(np.array([stage.rows // 2]), np.array([stage.cols // 2]), np.zeros((1, 2)), start)


def refined_from(plan: Refinement, maps: Maps, status: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels that hold enough to be refined from."""
    needed = ("flow_x", "flow_y") if plan.flat else ("depth",)
    return np.asarray((status == Status.OK) & np.all([np.isfinite(maps[name]) for name in needed], axis=0))


def starting(plan: Refinement) -> tuple[str, ...]:
    """Maps that the refinement starts from, as far as the model has them."""
    if not plan.flat:
        return PARAMETERS
    return ("flow_x", "flow_y", *(name for name in FLOW_GRADIENT_NAMES if name not in plan.excluded))


def _starts(plan: Refinement, maps: Maps, n: int) -> Array:
    """Parameters [n, 15] from the values [n] of maps; 0 for what these do not hold."""
    start = np.zeros((n, _GROWTH + 3))
    if not plan.flat:
        for i, name in enumerate(PARAMETERS):
            if name in maps:
                start[:, i] = np.nan_to_num(maps[name])
        return start
    xx, xy, yx, yy = (np.nan_to_num(maps.get(name, np.zeros(n))) for name in FLOW_GRADIENT_NAMES)
    start[:, 0], start[:, 3], start[:, 4] = 1.0, maps["flow_x"], maps["flow_y"]
    if plan.turns:
        start[:, 8] = (yx - xy) / 2
    rates = {0: (), 1: ((xx + yy) / 2,), 3: (xx, yy, (xy + yx) / 2)}[plan.modes]
    for i, rate in enumerate(rates):
        start[:, _GROWTH + i] = rate
    return start


def _call(
    stage: RefineStage, place: Place, rows: Array, cols: Array, start: Array, steps: int | None = None,
    curvature: Array | None = None,
) -> Refined:  # fmt: skip
    y, x = np.array(place.y)[rows] - place.corner[0], np.array(place.x)[cols] - place.corner[1]
    # A flat patch is the same anywhere in the image; from its own pixel its lengths stay small.
    at = np.zeros((len(y), 2)) if stage.plan.flat else place.rays(rows, cols)
    return stage(y, x, at, start, steps, curvature)


def _neighbours(
    plan: Refinement, rows: Array, cols: Array, found: Refined, place: Place, shape: tuple[int, ...]
) -> tuple[NDArray[np.intp], Array]:
    """Which pixels to try again, and their starts: from the best of the four neighbours that converged."""
    index = np.full((shape[0] + 2, shape[1] + 2), -1)
    index[rows + 1, cols + 1] = np.where(found.converged, np.arange(rows.size), -1)
    failed = np.flatnonzero(~found.converged)
    around = np.stack([index[rows[failed] + 1 + dy, cols[failed] + 1 + dx] for dy, dx in _NEIGHBOURS], axis=1)
    cost = np.where(around >= 0, found.cost[around], np.inf)
    best = np.take_along_axis(around, cost.argmin(axis=1)[:, None], axis=1)[:, 0]
    failed, best = failed[best >= 0], best[best >= 0]
    rays = place.rays(rows, cols) / (1.0 if plan.flat else place.geometry.f_px)
    return failed, transferred(found.parameters[best], rays[best], rays[failed])


def transferred(parameters: Array, seen: Array, wanted: Array) -> Array:
    """Parameters [n, 15] of the patches seen at the rays ``seen`` [n, 2], for their points at the rays ``wanted``.

    The plane stays, and its points move with it: N + Ω × P + A's share Ω × (Ω × P), without the small growth.
    """
    result = parameters.copy()
    zx, zy = parameters[:, 1], parameters[:, 2]
    slant = [1 - zx * r[:, 0] - zy * r[:, 1] for r in (seen, wanted)]
    result[:, 0] = parameters[:, 0] * slant[0] / slant[1]
    one = np.ones((len(seen), 1))
    before, after = (depth[:, None] * np.hstack([r, one]) for depth, r in
                     ((parameters[:, 0], seen), (result[:, 0], wanted)))  # fmt: skip
    omega = parameters[:, 6:9]
    turning = np.cross(omega, after - before)
    result[:, 3:6] += turning
    result[:, 9:12] += np.cross(omega, turning)
    return result


@dataclass(frozen=True, eq=False)
class _Spread:
    """``covariance`` [n, 15, 15] of parameters, and what follows from it."""

    covariance: Array

    def error(self, gradient: Mapping[int, Array | float]) -> Array:
        """Standard error [n] of a function of this gradient; infinite where one of its parameters is not determined."""
        n = len(self.covariance)
        total, lost = np.zeros(n), np.zeros(n, bool)
        for i, a in gradient.items():
            lost |= self.covariance[:, i, i] < 0
            for j, b in gradient.items():
                total += a * b * self.covariance[:, i, j]
        return np.where(lost, np.inf, np.sqrt(np.maximum(total, 0)))

    def rate(self, q: Array, gradient: Mapping[int, float]) -> tuple[Array, Array]:
        """Value and standard error [n] of a sum of parameters q [n, 15]; no value where one is not determined."""
        std = self.error(gradient)
        return np.where(np.isfinite(std), sum(a * q[:, i] for i, a in gradient.items()), np.nan), std


def _flat_maps(plan: Refinement, q: Array, covariance: Array) -> dict[str, tuple[Array, Array]]:
    """Maps and standard errors [n] of a patch that faces the camera: its velocity, its turn and strain as derivatives
    of the flow, from parameters [n, 15]."""
    turn = {8: 1.0} if plan.turns else {}
    one, two, both = _GROWTH, _GROWTH + (plan.modes == 3), _GROWTH + 2
    shear = {both: 1.0} if plan.modes == 3 else {}
    sums: dict[str, dict[int, float]] = {
        "flow_x": {3: 1.0}, "flow_y": {4: 1.0}, "flow_xx": {one: 1.0}, "flow_yy": {two: 1.0},
        "flow_xy": {i: -a for i, a in turn.items()} | shear, "flow_yx": turn | shear,
        "strain_xx": {one: 100.0}, "strain_yy": {two: 100.0}, "strain_xy": {both: 100.0},
    }  # fmt: skip
    spread = _Spread(covariance)
    found = {name: spread.rate(q, gradient) for name, gradient in sums.items() if name in plan.names}
    return found | (_principal(q, covariance) if plan.modes == 3 else {})


def _principal(q: Array, covariance: Array) -> dict[str, tuple[Array, Array]]:
    """Principal strain rates and their direction [n]; no values where one of the rates is not determined."""
    rates = slice(_GROWTH, _GROWTH + 3)
    spread = covariance[:, rates, rates]
    lost = np.any(np.diagonal(spread, axis1=1, axis2=2) < 0, axis=1, keepdims=True)
    values, std = principal_axes(100 * q[:, rates], 1e4 * spread)
    values, std = np.where(lost, np.nan, values), np.where(lost, np.inf, std)
    return {name: (values[:, k], std[:, k]) for k, name in enumerate(PRINCIPAL_NAMES)}


def _correlations(covariance: Array) -> Maps:
    """Correlations [n] between the errors of the velocity's components, from the covariance of the parameters."""
    velocity = covariance[:, 3:6, 3:6]
    std = np.sqrt(np.maximum(np.diagonal(velocity, axis1=1, axis2=2), 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        found = velocity / (std[:, :, None] * std[:, None, :])
    pairs = ((0, 1), (0, 2), (1, 2))
    return {name: np.clip(found[:, i, j], -1, 1) for name, (i, j) in zip(CORRELATIONS, pairs, strict=True)}


def _derived(plan: Refinement, q: Array, covariance: Array, rays: Array, f: float) -> dict[str, tuple[Array, Array]]:
    """Maps and standard errors [n] from parameters [n, 15] and their covariance."""
    spread = _Spread(covariance)
    linear = spread.error
    found = {name: (q[:, i], linear({i: 1.0})) for i, name in enumerate(PARAMETERS[: 3 + plan.motion])}
    if plan.motion:
        for k, axis in enumerate("xy"):
            flow = (f * q[:, 3 + k] - rays[:, k] * q[:, 5]) / q[:, 0]
            gradient = {0: -flow / q[:, 0], 3 + k: f / q[:, 0], 5: -rays[:, k] / q[:, 0]}
            found[f"flow_{axis}"] = flow, linear(gradient)
    if plan.modes:
        one, two, both = (q[:, _GROWTH + (i if plan.modes == 3 else 0)] for i in range(3))
        both = both if plan.modes == 3 else np.zeros(len(q))
        area = [(1 + s * one / 2) * (1 + s * two / 2) - both**2 / 4 for s in (1, -1)]
        rate = linear({_GROWTH: 200.0} if plan.modes == 1 else {_GROWTH: 100.0, _GROWTH + 1: 100.0})
        found["growth_rate"] = np.where(np.isfinite(rate), 100 * (area[0] / area[1] - 1), np.nan), rate
    if plan.modes == 3:
        for i, name in enumerate(STRAIN_NAMES):
            found[name] = spread.rate(q, {_GROWTH + i: 100.0})
        found |= _principal(q, covariance)
    return found
