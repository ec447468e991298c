"""Rigid motion of a scene's object: exact positions at any time, and the instantaneous motion as truth.

    X(t) = Xr + N t + A t²/2 + R(Ω t) (X(0) - Xr)                   t = 0 at the middle frame

with the finite rotation ``R`` about the rotation centre ``Xr``, the object's centre unless given.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.geometry import Array, rotation_matrix
from leafflow_ti.synthetic.rig import CameraGrid, Vector


@dataclass(frozen=True, kw_only=True)
class RigidScene(CameraGrid):
    """An object with ``centre`` [mm] at t = 0 that moves rigidly before the camera grid.

    ``velocity`` N [mm/frame] and ``acceleration`` A [mm/frame²] belong to the rotation centre [mm]; ``omega`` Ω
    [rad/frame] is axis times angle. Raises UsageError for values that make no sense.
    """

    centre: Vector
    velocity: Vector = (0.0, 0.0, 0.0)
    omega: Vector = (0.0, 0.0, 0.0)
    rotation_centre: Vector | None = None
    acceleration: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.centre[2] <= 0.0:
            raise UsageError(f"Z0 = {self.centre[2]:g} mm: the object must lie in front of the cameras, Z0 > 0")

    @property
    def pivot(self) -> Array:
        """The rotation centre ``Xr`` at t = 0 [mm]."""
        return np.array(self.centre if self.rotation_centre is None else self.rotation_centre)

    def pose(self, t: float) -> tuple[Array, Array]:
        """Rotation [3, 3] and shift [3] of ``X(t) = rotation X(0) + shift`` at ``t`` frames."""
        rotation = rotation_matrix(t * np.array(self.omega))
        moved = self.pivot + t * np.array(self.velocity) + 0.5 * t * t * np.array(self.acceleration)
        return rotation, moved - rotation @ self.pivot

    def follow(self, points: Array, t: float, start: float = 0.0) -> Array:
        """Where what is at the world points [..., 3] of the object at ``start`` is at ``t`` (both in frames)."""
        (before, shift), (rotation, moved) = self.pose(start), self.pose(t)
        return np.asarray((points - shift) @ before @ rotation.T + moved)

    def point_motion(self, points: Array) -> tuple[Array, Array]:
        """Velocity ``N + Ω × (X - Xr)`` and acceleration ``A + Ω × (Ω × (X - Xr))`` at t = 0 of points [..., 3]."""
        omega = np.array(self.omega)
        turning = np.cross(omega, points - self.pivot)
        return np.array(self.velocity) + turning, np.array(self.acceleration) + np.cross(omega, turning)

    def image_motion(self, points: Array, velocity: Array) -> Array:
        """Optical flow [..., 2] px/frame in the middle camera of ``points`` [..., 3] that move with ``velocity``."""
        forward = velocity[..., 2:] * points[..., :2] / points[..., 2:]
        return np.asarray(self.f_px * (velocity[..., :2] - forward) / points[..., 2:])
