"""Error bars, surface and motion in batched NumPy: the second half of ``scipy_twin``.

For models whose motion is fitted to the rows of the reference camera, with weights. Everything is an array over the
pixels n of a chunk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.field import MOTION_NAMES
from leafflow_ti.plan import Plan
from leafflow_ti.sampling import column_noise, cross_noise, noise_ratio
from leafflow_ti.stages.problem import Problem
from leafflow_ti.stages.thresholds import DENOISE, MODEL_ERROR, TURNING_ERROR

Array = NDArray[np.float64]
Maps = dict[str, Array]
STEP = 1e-4
"""Relative step of the central differences."""


@dataclass(frozen=True)
class Patch:
    """Where the pixels lie: ``x``, ``y`` [n] from the principal point; focal length, baselines, preshift."""

    x: Array
    y: Array
    f_px: float
    baseline_mm: tuple[float, float]
    shift_px: tuple[float, float]

    @classmethod
    def of(cls, plan: Plan, some: slice) -> Patch:
        """Of a run of the plan's output pixels, counted row by row."""
        geometry = plan.geometry
        row, col = np.divmod(np.arange(some.start, some.stop), len(plan.x))
        offset = geometry.disparity_offset_px
        return cls(
            np.array(plan.x)[col] - geometry.principal_px[0], np.array(plan.y)[row] - geometry.principal_px[1],
            geometry.f_px, geometry.baseline_mm, (plan.preshift[0] + offset[0], plan.preshift[1] + offset[1]),
        )  # fmt: skip


@dataclass(frozen=True)
class _Flow:
    """What the tensor says of the flow parameters [n, n_flow, k], and of their errors."""

    problem: Problem
    tensor: Array
    parameters: Array
    variance: Array
    inverse: Array
    rho: Array

    @classmethod
    def of(cls, problem: Problem, tensor: Array, parameters: Array, rho: Array) -> _Flow:
        """``inverse`` [n, n_flow, n_flow]: of J_ff without most of the noise of its own columns."""
        columns, noise = problem.columns, column_noise(problem.sampling, problem.columns)
        flow, k = columns.n_flow, columns.n_time_like
        full = np.concatenate([parameters, np.broadcast_to(np.eye(k), (len(tensor), k, k))], axis=1)
        variance = np.einsum("nik,nik->nk", full, tensor @ full) / np.einsum("nik,i->nk", full**2, noise)
        own = DENOISE[problem.estimator] * variance.min(axis=1)[:, None, None] * np.diag(noise[:flow])
        return cls(problem, tensor, parameters, variance, np.linalg.inv(tensor[:, :flow, :flow] - own), rho)

    def covariance(self, one: str, rows: list[int], two: str, cols: list[int]) -> Array:
        """Covariance [n, rows, cols] between parameters of two solutions."""
        columns, sampling = self.problem.columns, self.problem.sampling
        flow, i, j = columns.n_flow, columns.solutions.index(one), columns.solutions.index(two)
        if one == two:
            middle = self.tensor[:, :flow, :flow] * noise_ratio(sampling, columns, one)[0]
        else:
            middle = np.zeros_like(self.inverse)
            for term in cross_noise(sampling, columns, one, two):
                middle[:, term.a, term.b] = self.tensor[:, term.base_a, term.base_b] * term.value
        scale = self.rho * np.sqrt(self.variance[:, i] * self.variance[:, j])
        return np.asarray(scale[:, None, None] * (self.inverse[:, rows] @ middle @ self.inverse[:, :, cols]))


@dataclass(frozen=True)
class _Geometry:
    """(nu, b_x, b_y, b_t) per mm as ``names`` say: values [n, m], covariance, covariance with the motion's rows."""

    names: tuple[str, ...]
    values: Array
    covariance: Array
    shared: Array


def fit(tensor: Array, parameters: Array, rho: Array, problem: Problem, patch: Patch) -> Maps:
    """Every map [n] and its standard error, from tensors [n, N, N], parameters [n, n_flow, k] and ρ [n]."""
    assert problem.weighted
    assert not problem.own_flows
    assert not problem.columns.at_centre
    columns, flow = problem.columns, _Flow.of(problem, tensor, parameters, rho)
    rows = [i for d in ("x", "y") for o in problem.offsets if (i := columns.index(d, o)) is not None]
    last, cov_t = columns.solutions.index("t"), flow.covariance("t", rows, "t", rows)
    found: Maps = {}
    for k, axis in ((0, "x"), (len(problem.offsets), "y")):
        found[f"flow_{axis}"] = parameters[:, rows[k], last]
        found[f"flow_{axis}_std"] = np.sqrt(cov_t[:, k, k])
    geometry = _fit_geometry(flow, rows, patch)
    found |= _surface_maps(geometry, problem, patch)
    q, cov_q = _fit_motion(parameters[:, rows, last], cov_t, geometry, problem, patch)
    for i, name in enumerate(MOTION_NAMES[: problem.fitted]):
        found[name] = q[:, i]
        found[f"{name}_std"] = np.sqrt(cov_q[:, i, i])
    return found


def _fit_geometry(flow: _Flow, rows_t: list[int], patch: Patch) -> _Geometry:
    """Weighted least squares over the camera solutions; disparities across the baseline are zero."""
    problem, columns, names = flow.problem, flow.problem.columns, flow.problem.terms
    m, n = len(names), len(flow.tensor)
    normal, rhs, cross = np.zeros((n, m, m)), np.zeros((n, m)), np.zeros((n, m, len(rows_t)))
    for axis in problem.camera_axes:
        which = ("sx", "sy").index(axis)
        own, other = ("x", "y") if axis == "sx" else ("y", "x")
        rows = [i for d in (own, other) for o in names if (i := columns.index(d, o)) is not None]
        value = flow.parameters[:, rows, columns.solutions.index(axis)]
        value[:, 0] += patch.shift_px[which]
        step = patch.baseline_mm[which]
        weights = step * np.linalg.inv(flow.covariance(axis, rows, axis, rows))[:, :m]
        normal += step * weights[:, :, :m]
        rhs += np.einsum("nij,nj->ni", weights, value)
        cross += weights @ flow.covariance(axis, rows, "t", rows_t)
    inverse = np.linalg.inv(normal)
    return _Geometry(names, np.einsum("nij,nj->ni", inverse, rhs), inverse, inverse @ cross)


def _surface(patch: Patch, g: Array) -> tuple[Array, Array, Array, Array]:
    """Z0, ZX, ZY, c of Eqs. (6.13), (6.14) from (nu, b_x, b_y) [n, 3]."""
    Z0 = -patch.f_px / g[:, 0]
    p, q = g[:, 1] * Z0, g[:, 2] * Z0
    c = 1 / (1 + (p * patch.x + q * patch.y) / patch.f_px)
    return Z0, c * p, c * q, c


def _steps(g: Array, f_px: float) -> list[Array]:
    """Displacements [n, 3] of the geometry, one component at a time."""
    size = STEP * np.abs(g[:, 0])
    return [np.multiply.outer(size / (1 if i == 0 else f_px), np.eye(3)[i]) for i in range(3)]


def _surface_maps(geometry: _Geometry, problem: Problem, patch: Patch) -> Maps:
    g, cov = geometry.values[:, :3], geometry.covariance[:, :3, :3]
    step = patch.baseline_mm[0 if problem.camera_axes[0] == "sx" else 1]

    def values(g: Array) -> Array:
        Z0, ZX, ZY, _ = _surface(patch, g)
        return np.stack([g[:, 0] * step, Z0, ZX, ZY], axis=1)

    gradient = _derivative(values, g, patch.f_px)
    std = np.sqrt(np.einsum("nai,nij,naj->na", gradient, cov, gradient))
    found: Maps = {}
    for i, name in enumerate(("disparity", "depth", "slope_x", "slope_y")):
        found[name], found[f"{name}_std"] = values(g)[:, i], std[:, i]
    return found


def _derivative(function: Callable[[Array], Array], g: Array, f_px: float) -> Array:
    """Derivatives [n, values, 3] by the geometry, by central differences."""
    found = []
    for step in _steps(g, f_px):
        width = 2 * step.sum(axis=1)[:, None]
        found.append((function(g + step) - function(g - step)) / width)
    return np.stack(found, axis=-1)


def _fit_motion(value: Array, cov_t: Array, geometry: _Geometry, problem: Problem, patch: Patch) -> tuple[Array, Array]:
    """Unknowns [n, Q] of (N, Ω, A) and their covariance; passes linearise Ω × N and the geometry's share."""
    n, unknowns = len(value), problem.fitted
    codes = [*problem.offsets, *problem.offsets]
    shared = geometry.shared
    if problem.use_range:
        codes.append("range")
        t = geometry.names.index("t")
        value = np.concatenate([value, geometry.values[:, t, None]], axis=1)
        cov_t, shared = np.pad(cov_t, ((0, 0), (0, 1), (0, 1))), np.pad(shared, ((0, 0), (0, 0), (0, 1)))
    g, q = geometry.values[:, :3], np.zeros((n, unknowns))
    for _ in range(problem.passes):

        def design(g: Array, q: Array = q) -> Array:
            return _design(g, q, problem, patch)

        A = design(g)
        D = np.zeros((n, len(codes), len(geometry.names)))
        D[:, :, :3] = -_derivative(lambda g, q=q: np.einsum("nri,ni->nr", design(g), q), g, patch.f_px)
        if problem.use_range:
            D[:, -1, t] += 1
        by_geometry = D @ geometry.covariance @ D.swapaxes(1, 2)
        left_out = _left_out(A, q, codes, _surface(patch, g), patch) ** 2
        weights = np.linalg.inv(cov_t + by_geometry + left_out[:, :, None] * np.eye(len(codes)))
        half = A.swapaxes(1, 2) @ weights
        gain = np.linalg.solve(half @ A, half)
        q = np.einsum("nij,nj->ni", gain, value)
    part = gain @ D @ shared @ gain.swapaxes(1, 2)
    return q, gain @ (cov_t + by_geometry) @ gain.swapaxes(1, 2) + part + part.swapaxes(1, 2)


def _left_out(A: Array, q: Array, codes: list[str], surface: tuple[Array, Array, Array, Array], patch: Patch) -> Array:
    """Standard size [n, rows] of what each equation leaves out."""
    Z0, ZX, ZY, _ = surface
    size = np.abs(A) @ np.abs(q)[:, :, None]
    left_out = np.array([MODEL_ERROR[code] for code in codes]) * size[:, :, 0]
    turning = TURNING_ERROR * patch.f_px / Z0 * np.linalg.norm(q[:, 3:6], axis=1) * np.sqrt(1 + ZX**2 + ZY**2)
    steps = {"sx": abs(patch.baseline_mm[0]), "sy": abs(patch.baseline_mm[1]), "range": 1.0}
    for i, code in enumerate(codes):
        left_out[:, i] += turning * steps.get(code, 0.0)
    return left_out


def _design(g: Array, q: Array, problem: Problem, patch: Patch) -> Array:
    """Coefficients [n, rows, Q] of (N, Ω, A) in the motion's rows (5.18) and, last, in the range constraint (5.23)."""
    f, x, y = patch.f_px, patch.x / patch.f_px, patch.y / patch.f_px
    nu = g[:, 0]
    Z0, ZX, ZY, c = _surface(patch, g)
    n, zero, one = len(g), np.zeros_like(nu), np.ones_like(nu)
    N = np.zeros((n, 3))
    N[:, : min(3, q.shape[1])] = q[:, :3]
    Zt = N[:, 2] - ZX * N[:, 0] - ZY * N[:, 1]
    e = (np.stack([one, zero, -x], axis=1), np.stack([zero, one, -y], axis=1))
    delta = {
        "x": (Z0 / (f * c), (1 - ZY * y, ZX * y, ZX)), "y": (Z0 / (f * c), (ZY * x, 1 - ZX * x, ZY)),
        "sx": (1 / c, (c + ZX * x, ZX * y, ZX)), "sy": (1 / c, (ZY * x, c + ZY * y, ZY)),
        "t": (Zt / c, (x, y, one)),
    }  # fmt: skip
    b = {
        "x": ZX / (Z0 * c), "y": ZY / (Z0 * c), "sx": f * ZX / (Z0**2 * c), "sy": f * ZY / (Z0**2 * c),
        "t": f * Zt / (Z0**2 * c),
    }  # fmt: skip

    def row(k: int, offset: str) -> Array:
        found = np.zeros((n, 9))
        if offset == "1":
            # The window's mean of the flow holds its second derivative along its own axis, too.
            moment = problem.sampling.axis("xy"[k]).moment(2)
            bend = moment * (ZX, ZY)[k] / (f * Z0 * c)
            found[:, :3] = -nu[:, None] * e[k]
            found[:, 2] += bend
            found[:, 3] -= bend * Z0 * y + (k == 1) * moment / f
            found[:, 4] += bend * Z0 * x + (k == 0) * moment / f
            return found
        scale, vector = delta[offset]
        turned = scale[:, None] * np.stack(vector, axis=1) - (N if offset == "t" else 0.0)
        found[:, :3] = -b[offset][:, None] * e[k]
        if offset == "xy"[k]:
            found[:, 2] += nu / f
        found[:, 3:6] = -nu[:, None] * np.cross(turned, e[k])
        if offset == "t":
            found[:, 6:] = -nu[:, None] * e[k]
        return found

    def measured(k: int, offset: str) -> Array:
        """Preshifted data measure a mixture along the cameras."""
        if offset not in ("sx", "sy"):
            return row(k, offset)
        which = ("sx", "sy").index(offset)
        return patch.baseline_mm[which] * row(k, offset) + patch.shift_px[which] * row(k, "xy"[which])

    rows = [measured(k, offset) for k in (0, 1) for offset in problem.offsets]
    if problem.use_range:
        scale = f / (Z0**2 * c)
        rows.append(np.stack([-scale * ZX, -scale * ZY, scale, *6 * [zero]], axis=1))
    return np.stack(rows, axis=1)[:, :, : problem.fitted]
