"""Exact flow parameters of a moving plane, by finite differences of following material points.

An oracle: it knows ray, plane and its material's motion only, none of the flow equations (Schuchert 2010, ch. 5 and 6).
Two fields are defined at every pixel (x, y) [px, relative to the principal point] of every camera position s [mm] and
time t [frames], from the material point seen there:

    nu(x, y, sx, sy, t)   change of its image position x with the camera position sx, at fixed t      [px/mm]
    u(x, y, sx, sy, t)    change of its image position (x, y) with time, in that fixed camera         [px/frame]

The affine parameters are the derivatives of both fields at fixed pixel. All derivatives are 8th-order central
differences with steps of a fixed small part of the scene's own scales: truncation and rounding both stay far below
1e-8 of the parameters' natural size.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypedDict

import numpy as np

from leafflow_ti.synthetic.geometry import Array
from leafflow_ti.synthetic.plane import PlaneScene

WEIGHTS = np.array([4.0 / 5.0, -1.0 / 5.0, 4.0 / 105.0, -1.0 / 280.0])
"""One side of the antisymmetric 8th-order stencil for a first derivative."""

STEP = 1.0 / 80.0
"""Step of the differences, as a part of the length over which the fields change."""


class FlowParameters(TypedDict):
    """Parameters in the order of model columns (x, y, sx, sy, t)."""

    nu: float
    b: Array  # [5], per mm of baseline
    u: Array  # [2], px/frame
    a: Array  # [2, 5]


class PreshiftedFlowParameters(TypedDict):
    """The same per camera step, in preshifted pixel x' = x - nu0 k; first axis of nu and b: step along sx, sy."""

    nu: Array  # [2], px/step, what is left of the disparity
    b: Array  # [2, 5]
    u: Array  # [2]
    a: Array  # [2, 5]


def flow_parameters(scene: PlaneScene, x: float, y: float) -> FlowParameters:
    """Parameters at pixel (x, y) [px, from the principal point] of the middle camera and frame.

    ``b[m]`` and ``a[k, m]`` are derivatives of nu and u_k along m = x, y, sx, sy (per mm), t at fixed pixel.
    Raises UsageError if the plane is not seen from the front.
    """
    at = np.array([x, y, 0.0, 0.0, 0.0])
    steps = _steps(scene)

    def nu(place: Array) -> Array:
        return disparity(scene, place, 0)

    def u(place: Array) -> Array:
        return optical_flow(scene, place)

    return {"nu": float(nu(at)), "b": _gradient(nu, at, steps), "u": u(at), "a": _gradient(u, at, steps)}


def preshifted_flow_parameters(
    scene: PlaneScene, x: float, y: float, nu0: tuple[float, float]
) -> PreshiftedFlowParameters:
    """Parameters that preshifted images show: x' = x - nu0 k with k the camera index from the middle [px per step].

    Derivatives along the camera axes are per step and at fixed x'. Raises UsageError if the plane is not seen.
    """
    baseline = np.array(scene.baseline_mm)
    shift = np.array(nu0)

    def unshifted(place: Array) -> Array:
        k = place[2:4]
        return np.concatenate([place[:2] + shift * k, baseline * k, place[4:]])

    def nu(axis: int) -> Callable[[Array], Array]:
        return lambda place: baseline[axis] * disparity(scene, unshifted(place), axis) - shift[axis]

    def u(place: Array) -> Array:
        return optical_flow(scene, unshifted(place))

    at = np.array([x, y, 0.0, 0.0, 0.0])
    steps = _steps(scene)
    steps[2:4] /= np.abs(baseline)
    # A step along the camera index also moves the pixel: stay within the scale of the pixel's own step.
    steps[2:4] = np.minimum(steps[2:4], steps[:2] / np.maximum(np.abs(shift), 1.0))
    return {
        "nu": np.array([nu(axis)(at) for axis in (0, 1)]),
        "b": np.stack([_gradient(nu(axis), at, steps) for axis in (0, 1)]),
        "u": u(at),
        "a": _gradient(u, at, steps),
    }


def disparity(scene: PlaneScene, place: Array, axis: int) -> Array:
    """Image motion [px/mm] along ``axis`` of the point seen at ``place`` = (x, y, sx, sy, t) as the camera moves so."""
    point, camera, _ = _seen(scene, place)
    along = np.eye(3)[axis]
    step = STEP * scene.centre[2]
    return _derivative(lambda d: _image(scene, point, camera + d * along)[axis], step)


def optical_flow(scene: PlaneScene, place: Array) -> Array:
    """Image motion [2, px/frame] of the material point seen at ``place`` = (x, y, sx, sy, t)."""
    point, camera, t = _seen(scene, place)
    offset = scene.material(point, t)

    def follow(d: float) -> Array:
        return _image(scene, scene.place(offset, t + d), camera)

    return _derivative(follow, _steps(scene)[4])


def _seen(scene: PlaneScene, place: Array) -> tuple[Array, Array, float]:
    x, y, sx, sy, t = place.tolist()
    camera = np.array([sx, sy, 0.0])
    return scene.intersect(np.array([x / scene.f_px, y / scene.f_px, 1.0]), camera, t), camera, t


def _image(scene: PlaneScene, point: Array, camera: Array) -> Array:
    relative = point - camera
    return np.asarray(scene.f_px * relative[:2] / relative[2])


def _steps(scene: PlaneScene) -> Array:
    """Steps along (x, y, sx, sy, t) [px, px, mm, mm, frames]: STEP of where depth or direction change by their size."""
    z0 = scene.centre[2]
    slant = 1.0 + abs(scene.zx) + abs(scene.zy)
    pixel, camera = scene.f_px / slant, z0 / slant
    speed = float(np.linalg.norm(scene.velocity)) / z0
    speed += float(np.linalg.norm(scene.omega)) * (1.0 + float(np.linalg.norm(scene.pivot - scene.centre)) / z0)
    speed += float(np.sqrt(np.linalg.norm(scene.acceleration) / z0))
    frames = 1.0 / (slant * speed) if speed > 0.0 else 1.0
    return STEP * np.array([pixel, pixel, camera, camera, frames])


def _derivative(f: Callable[[float], Array], step: float) -> Array:
    total = sum(weight * (f(j * step) - f(-j * step)) for j, weight in enumerate(WEIGHTS.tolist(), start=1))
    return np.asarray(total / step)


def _gradient(field: Callable[[Array], Array], at: Array, steps: Array) -> Array:
    """Derivatives of ``field`` along each coordinate of ``at``, as the last axis."""
    columns = []
    for unit, step in zip(np.eye(len(at)), steps.tolist(), strict=True):
        columns.append(_derivative(partial(_at, field, at, unit), step))
    return np.stack(columns, axis=-1)


def _at(field: Callable[[Array], Array], origin: Array, direction: Array, distance: float) -> Array:
    return field(origin + distance * direction)
