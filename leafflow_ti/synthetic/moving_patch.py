"""The exact image of a moving plane patch: where each camera sees its points at each time, and how that depends on its
state (depth, slopes, motion, growth).

An oracle: rays, planes and rotations, no flow equation and no expansion. With offsets δ [px] from the pixel (x0, y0)
and rays ``r = ((x0 + δx)/f, (y0 + δy)/f, 1)``,

    Z(δ) = (Z0 - ZX Cx - ZY Cy) / (1 - ZX rx - ZY ry)          C = Z0 (x0/f, y0/f, 1)
    Z0 / Z(δ) is less by ½ δ^T K δ where the patch is curved
    X(δ, t) = C + N t + V(Ω t) A t²/2 + R(Ω t) (1 + t E) (Z(δ) r - C)
    x_k = f (X - s_k) / X_z                                     camera k at s_k, frame t

``V = 1 + K/3 + K²/12 + ...``, with K the cross product by Ω t, lets the acceleration turn with the patch: the path of a
patch that turns about any axis is exact, and most accelerations come from that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from leafflow_ti.synthetic.geometry import Array, in_plane, rotation_matrix
from leafflow_ti.synthetic.rig import CameraGrid

UNKNOWNS = (
    "depth", "slope_x", "slope_y", "velocity_x", "velocity_y", "velocity_z", "rotation_x", "rotation_y", "rotation_z",
    "acceleration_x", "acceleration_y", "acceleration_z", "strain_rate_11", "strain_rate_22", "strain_rate_12",
)  # fmt: skip
"""Order of the state [15]: mm, 1, mm/frame, rad/frame, mm/frame², and strain rates in 1/frame (not per cent)."""

STEP = 1e-5
"""Step of the central differences: of lengths relative to the depth, of what has no length as it is."""


@dataclass(frozen=True)
class Views:
    """One pixel and the images that see its patch: ``x0``, ``y0`` [px] from the principal point, ``cameras`` [K, 2]
    mm, ``times`` [K] frames, of each of K images."""

    f_px: float
    x0: float
    y0: float
    cameras: Array
    times: Array

    @classmethod
    def of(cls, scene: CameraGrid, x: float, y: float) -> Views:
        """All images of a scene, frames, then camera rows, then columns; ``x``, ``y`` [px] in the middle camera."""
        images = list(np.ndindex(scene.n_frames, scene.n_rows, scene.n_cols))
        cameras = np.array([scene.camera_position(row, col)[:2] for _, row, col in images])
        px, py = scene.principal
        return cls(scene.f_px, x - px, y - py, cameras, np.array([scene.time(frame) for frame, _, _ in images]))


def window(size: int, thin: int = 1) -> Array:
    """Offsets [S, 2] px of every ``thin``-th pixel from the centre within ``size // 2`` of it, rows of x."""
    reach = size // 2 // thin * thin
    steps = np.arange(-reach, reach + 1, thin, dtype=np.float64)
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


def true_state(maps: Mapping[str, Array], x: int, y: int) -> Array:
    """The state [15] of the patch at a pixel, from the arrays that ``truth`` gives for a scene."""
    strain = maps["strain_rate"][y, x] / 100.0 if "strain_rate" in maps else np.zeros(3)
    plane = [maps[name][y, x] for name in ("depth", "zx", "zy")]
    return np.concatenate([plane, maps["velocity"][y, x], maps["omega"], maps["acceleration"][y, x], strain])


IN_PLANE = ("velocity_x", "velocity_y", "rotation_z", "acceleration_x", "acceleration_y")
"""What moves a plane within itself where it faces the camera."""


def directions(motion: int, modes: int, flat: bool = False) -> Array:
    """Directions [15, n] of the state that are unknown, columns in the order of ``UNKNOWNS``.

    ``motion``: the first 0, 3, 6 or 9 of N, Ω, A. ``modes`` of growth: 0, 1 (the same in all directions) or 3.
    ``flat``: depth and slopes are known, and of the motion only what is ``IN_PLANE`` is not.
    """
    every = np.eye(len(UNKNOWNS))
    growth = {0: every[:, :0], 1: every[:, 12:13] + every[:, 13:14], 3: every[:, 12:]}[modes]
    rigid = [i for i in range(3 + motion) if not flat or UNKNOWNS[i] in IN_PLANE]
    return np.concatenate([every[:, rigid], growth], axis=1)


def warp(
    views: Views, state: Array, offsets: Array, k: int, curvature: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Array:
    """Where image ``k`` shows the points seen at ``offsets`` [S, 2] of the reference: [S, 2] px from the principal
    point. ``curvature``: K (xx, xy, yy), 1/px²."""
    depth, zx, zy = state[:3]
    velocity, omega, acceleration, strain = state[3:6], state[6:9], state[9:12], state[12:15]
    pixels = np.array([views.x0, views.y0]) + offsets
    rays = np.column_stack([pixels / views.f_px, np.ones(len(offsets))])
    centre = depth * np.array([views.x0 / views.f_px, views.y0 / views.f_px, 1.0])
    z = (depth - zx * centre[0] - zy * centre[1]) / (1.0 - zx * rays[:, 0] - zy * rays[:, 1])
    xx, xy, yy = curvature
    bent = 0.5 * (xx * offsets[:, 0] ** 2 + yy * offsets[:, 1] ** 2) + xy * offsets[:, 0] * offsets[:, 1]
    z = 1.0 / (1.0 / z - bent / depth)
    t = float(views.times[k])
    grown = (z[:, None] * rays - centre) @ (np.eye(3) + t * in_plane(zx, zy, strain))
    points = (
        centre + t * velocity + 0.5 * t * t * (turning(t * omega) @ acceleration) + grown @ rotation_matrix(t * omega).T
    )
    return np.asarray(views.f_px * (points[:, :2] - views.cameras[k]) / points[:, 2:])


def turning(angle: Array) -> Array:
    """``V`` [3, 3] for a rotation vector [rad]: twice the integral of (1 - s) R(s angle) over s from 0 to 1."""
    x, y, z = angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    term, total = np.eye(3), np.eye(3)
    for n in range(3, 15):
        term = term @ k / n
        total = total + term
    return total


def window_derivative(views: Views, state: Array, offsets: Array, k: int) -> Array:
    """``D = ∂x_k/∂δ`` [S, 2, 2] (row: component of x_k, column: of δ), by central differences of half a pixel's
    hundredth."""
    h = 5e-3
    columns = [
        (warp(views, state, offsets + step, k) - warp(views, state, offsets - step, k)) / (2.0 * h)
        for step in h * np.eye(2)
    ]
    return np.stack(columns, axis=-1)


def pulled_back(views: Views, state: Array, offsets: Array, k: int, along: Array) -> Array:
    """``D^-1 ∂x_k/∂q`` [S, 2, n]: how far the window moves over the texture for the unknowns ``along`` [15, n]."""
    lengths = np.array([name.startswith(("depth", "velocity", "acceleration")) for name in UNKNOWNS])
    steps = np.where(lengths, STEP * state[0], STEP)
    columns = []
    for direction in along.T:
        h = float(np.abs(direction) @ steps / np.abs(direction).sum())
        ends = (warp(views, state + sign * h * direction, offsets, k) for sign in (1.0, -1.0))
        columns.append((next(ends) - next(ends)) / (2.0 * h))
    return np.asarray(np.linalg.solve(window_derivative(views, state, offsets, k), np.stack(columns, axis=-1)))
