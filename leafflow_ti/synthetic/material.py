"""Material that expands about its centre while it moves rigidly, and whose brightness changes.

What was at ``P`` at t = 0, relative to the object's centre, is at ``(1 + t E) P``, with the symmetric tensor E of its
strain rates, before the object is turned and moved (see ``motion.RigidScene``): the motion of all material is affine at
any time. Grey values change by the factor ``exp(h)``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.geometry import Array, tangent_axes
from leafflow_ti.synthetic.motion import RigidScene


@dataclass(frozen=True)
class BrightnessTerm:
    """One term ``(g + gx ΔX + gy ΔY) m^power`` of ``h`` (Schuchert 2010, Eqs. (4.15), (4.27), section 6.1).

    ``m`` is ``t`` [frames] or the camera position ``sx``, ``sy`` [mm]; (ΔX, ΔY) [mm] is where the material point lies
    at t = 0, relative to the object's centre. ``g`` is in 1/m^power, ``gx``, ``gy`` per mm of that.
    """

    axis: Literal["t", "sx", "sy"]
    power: int
    g: float
    gx: float = 0.0
    gy: float = 0.0

    def __post_init__(self) -> None:
        if self.axis not in ("t", "sx", "sy"):
            raise UsageError(f"brightness axis '{self.axis}': choose t, sx or sy")
        if self.power < 1:
            raise UsageError(f"brightness power {self.power}: at least 1 (a constant factor belongs to the texture)")
        if not np.isfinite((self.g, self.gx, self.gy)).all():
            raise UsageError(f"brightness coefficients {self.g}, {self.gx}, {self.gy}: all must be finite")


@dataclass(frozen=True, kw_only=True)
class MaterialScene(RigidScene):
    """A rigid scene whose object expands by ``expansion``; subclasses say by how much, and what it looks like.

    Raises UsageError for values that make no sense, and for growth by which the object would vanish.
    """

    brightness: tuple[BrightnessTerm, ...] = ()
    texture_seed: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.texture_seed < 0:
            raise UsageError(f"texture_seed = {self.texture_seed}: a seed cannot be negative")
        ends = (self.time(0), self.time(self.n_frames - 1), -0.5, 0.5)
        if min(np.linalg.eigvalsh(self.deformation(t)).min() for t in ends) <= 0.0:
            rates = ", ".join(f"{100.0 * rate:.3g}" for rate in np.linalg.eigvalsh(self.expansion))
            raise UsageError(
                f"strain rates of {rates} %/frame: the object would vanish within the {self.n_frames} frames: "
                "choose less"
            )

    @property
    def expansion(self) -> Array:
        """The symmetric tensor E [3, 3] of the material's strain rates along the world's axes at t = 0, 1/frame."""
        raise NotImplementedError

    def deformation(self, t: float) -> Array:
        """The matrix ``1 + t E`` [3, 3] that takes offsets from the centre at t = 0 to those at ``t`` frames."""
        return np.eye(3) + t * self.expansion

    def place(self, offsets: Array, t: float) -> Array:
        """Where the material points ``offsets`` [..., 3] (see ``material``) are at time ``t``, in the world."""
        rotation, shift = self.pose(t)
        return np.asarray((np.array(self.centre) + offsets @ self.deformation(t)) @ rotation.T + shift)

    def material(self, points: Array, t: float) -> Array:
        """Where the material points now at ``points`` [..., 3] were at t = 0, relative to the centre [mm]."""
        rotation, shift = self.pose(t)
        return np.asarray(((points - shift) @ rotation - np.array(self.centre)) @ np.linalg.inv(self.deformation(t)))

    def follow(self, points: Array, t: float, start: float = 0.0) -> Array:
        """Where the material that is at the world points [..., 3] at ``start`` is at ``t`` (both in frames)."""
        return self.place(self.material(points, start), t)

    def point_motion(self, points: Array) -> tuple[Array, Array]:
        """Velocity and acceleration at t = 0 of the material at points [..., 3] of the object, growth included."""
        velocity, acceleration = super().point_motion(points)
        spreading = (points - np.array(self.centre)) @ self.expansion
        return velocity + spreading, acceleration + 2.0 * np.cross(np.array(self.omega), spreading)

    def log_brightness(self, offsets: Array, camera: Array, t: float) -> Array:
        """The exponent ``h`` [...] at the material points ``offsets`` [..., 3] for the camera at ``camera`` [3]."""
        h = np.zeros(offsets.shape[:-1])
        where = {"t": t, "sx": float(camera[0]), "sy": float(camera[1])}
        for term in self.brightness:
            h += (term.g + term.gx * offsets[..., 0] + term.gy * offsets[..., 1]) * where[term.axis] ** term.power
        return h


def growth_maps(zx: Array, zy: Array, expansion: Array) -> dict[str, Array]:
    """Growth in the surface of slopes ``zx``, ``zy`` [...] of material that expands by ``expansion`` [3, 3], 1/frame.

    ``growth_rate`` [...] %/frame, of the area from half a frame before t = 0 to half a frame after; ``strain_rate``
    [..., 3] %/frame, of lengths at t = 0; ``surface_strain`` [..., 3] %/frame, Lagrangian strain within that frame:
    half the change of the metric tensor, per metric tensor before. Components 11, 22 and 12 along ``tangent_axes``.
    """
    axes = tangent_axes(zx, zy)
    rate = _transposed(axes) @ expansion @ axes
    before, after = (_transposed(ends) @ ends for ends in ((np.eye(3) + h * expansion) @ axes for h in (-0.5, 0.5)))
    area = np.sqrt(_determinant(after) / _determinant(before))
    unit = _inverse_root(before)
    strain = 0.5 * (unit @ after @ unit - np.eye(2))
    return {
        "growth_rate": 100.0 * (area - 1.0),
        "strain_rate": 100.0 * _components(rate),
        "surface_strain": 100.0 * _components(strain),
    }


def no_growth(known: NDArray[np.bool_]) -> dict[str, Array]:
    """The maps of ``growth_maps`` where nothing grows: 0 where ``known`` [H, W] holds, NaN elsewhere."""
    none = np.where(known, 0.0, np.nan)
    three = np.repeat(none[..., None], 3, axis=-1)
    return {"growth_rate": none, "strain_rate": three, "surface_strain": three.copy()}


def _transposed(matrices: Array) -> Array:
    return np.swapaxes(matrices, -1, -2)


def _components(tensors: Array) -> Array:
    """11, 22 and 12 [..., 3] of symmetric tensors [..., 2, 2]."""
    return np.stack([tensors[..., 0, 0], tensors[..., 1, 1], tensors[..., 0, 1]], axis=-1)


def _determinant(tensors: Array) -> Array:
    """Determinants [...] of symmetric tensors [..., 2, 2]; NaN ones, which have none, are no error here."""
    return np.asarray(tensors[..., 0, 0] * tensors[..., 1, 1] - tensors[..., 0, 1] ** 2)


def _inverse_root(tensors: Array) -> Array:
    """Inverses of the symmetric square roots of positive definite tensors [..., 2, 2] (Cayley-Hamilton)."""
    root = np.sqrt(_determinant(tensors))[..., None, None]
    trace = np.trace(tensors, axis1=-2, axis2=-1)[..., None, None]
    adjugate = trace * np.eye(2) - tensors
    return np.asarray((adjugate + root * np.eye(2)) / (root * np.sqrt(trace + 2.0 * root)))
