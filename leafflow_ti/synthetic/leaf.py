"""A curved, textured leaf that moves rigidly while it grows, alike or not in all directions, rendered exactly.

At t = 0 the leaf is the part inside its outline of a quadric through its centre,

    S(p, q) = p e1 + q e2 + ½ (k1 p² + k2 q² + 2 k12 p q) n

with e1 along its long axis, e2 across and n normal to it, all at the centre. Its material expands along these three
axes and moves with them (see ``material``), so that the map from the leaf's axes to the world is affine at any time: a
viewing ray, brought back through it, is still a straight line and meets the quadric where a quadratic equation says.
The texture is noise of (p, q). What lies beside the leaf is of one grey value, and of no depth.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.geometry import Array, tangent_axes, within_outline
from leafflow_ti.synthetic.material import MaterialScene, growth_maps
from leafflow_ti.synthetic.noise_texture import noise_albedo
from leafflow_ti.synthetic.plane import linear_growth
from leafflow_ti.synthetic.rig import Vector, rays_of, render_grid

LEAF = 1
"""Its label; 0 is what lies beside it."""


@dataclass(frozen=True, kw_only=True)
class LeafScene(MaterialScene):
    """One leaf. The defaults are a seedling's before the tobacco rig: f = 25 mm at 4.4 µm, 250 mm away, 1 mm steps.

    ``zx``, ``zy`` slopes at the centre; ``turn`` [rad] of the long axis from the tangent above the X axis;
    ``curvature`` (k1, k2, k12) [1/mm] along, across and between; ``half_mm`` half the length and the width of the
    outline, ``pointed`` or an ellipse. ``growth`` [1/frame] of lengths along the long axis, across and normal: what is
    alike in all three (see ``isotropic``) grows every surface alike, whatever its curvature.

    ``wavelengths_mm`` shortest and longest wavelength of the texture, ``offset`` mean and ``contrast`` standard
    deviation of the albedo, ``background`` grey value beside the leaf. Raises UsageError for values that make no sense.
    """

    f_px: float = 25.0 / 0.0044
    baseline_mm: tuple[float, float] = (1.0, 1.0)
    size: tuple[int, int] = (481, 321)
    bits: int | None = 8
    centre: Vector = (0.0, 0.0, 250.0)
    velocity: Vector = (0.04, -0.03, 0.05)
    omega: Vector = (0.0025, 0.0038, 0.0025)
    zx: float = 0.3
    zy: float = -0.2
    turn: float = 0.4
    curvature: Vector = (-0.012, 0.025, 0.006)
    half_mm: tuple[float, float] = (5.6, 4.0)
    pointed: bool = False
    growth: Vector = 3 * (linear_growth(0.1),)
    wavelengths_mm: tuple[float, float] = (0.3, 1.2)
    offset: float = 120.0
    contrast: float = 27.0
    background: float = 20.0
    supersampling: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.half_mm) <= 0.0:
            raise UsageError(f"half length and width {self.half_mm} mm: both must be positive")
        if not 0.0 < self.wavelengths_mm[0] < self.wavelengths_mm[1]:
            raise UsageError(
                f"wavelengths {self.wavelengths_mm} mm: give the shortest, then the longest, both positive"
            )
        if self.supersampling < 1:
            raise UsageError(f"supersampling = {self.supersampling}: at least 1 sample per pixel and axis is needed")

    @property
    def axes(self) -> Array:
        """The leaf's axes in the world at t = 0 as columns [3, 3]: along, across, normal."""
        first, second = tangent_axes(self.zx, self.zy).T
        along = math.cos(self.turn) * first + math.sin(self.turn) * second
        normal = np.cross(first, second)
        return np.stack([along, np.cross(normal, along), normal], axis=1)

    @property
    def expansion(self) -> Array:
        """See ``MaterialScene``."""
        return np.asarray(self.axes * np.array(self.growth) @ self.axes.T)

    @property
    def bending(self) -> Array:
        """Second derivatives [2, 2] of the height over the tangent plane at the centre, 1/mm."""
        along, across, both = self.curvature
        return np.array([[along, both], [both, across]])

    def surface(self, pq: Array) -> Array:
        """The material points [..., 3] mm, at t = 0 from the centre, of coordinates (p, q) [..., 2] mm on the leaf."""
        return np.asarray(np.concatenate([pq, _height(self.bending, pq, pq)[..., None]], axis=-1) @ self.axes.T)

    def slopes(self, pq: Array) -> tuple[Array, Array]:
        """Slopes ZX, ZY [...] of the surface at (p, q) [..., 2] and t = 0."""
        rise = pq @ self.bending
        normal = np.concatenate([-rise, np.ones_like(rise[..., :1])], axis=-1) @ self.axes.T
        return -normal[..., 0] / normal[..., 2], -normal[..., 1] / normal[..., 2]

    def trace(self, rays: Array, camera: Array, t: float) -> Array:
        """(p, q) [..., 2] mm of what rays [..., 3] from ``camera`` [3] meet first at ``t`` frames; NaN: nothing."""
        rotation, _ = self.pose(t)
        origin = self.material(camera, t) @ self.axes
        directions = rays @ (rotation @ np.linalg.inv(self.deformation(t)) @ self.axes)
        met = np.full((*rays.shape[:-1], 2), np.nan)
        nearest = np.full(rays.shape[:-1], np.inf)
        for way in _crossings(self.bending, origin, directions):
            pq = origin[:2] + way[..., None] * directions[..., :2]
            first = self.inside(pq) & (way > 0.0) & (way < nearest)
            met[first], nearest[first] = pq[first], way[first]
        return met

    def inside(self, pq: Array) -> NDArray[np.bool_]:
        """Which coordinates (p, q) [..., 2] belong to the leaf."""
        return within_outline(pq[..., 0] / self.half_mm[0], pq[..., 1] / self.half_mm[1], self.pointed)

    def seen(self, x: Array, y: Array, t: float = 0.0) -> Array:
        """The world points [..., 3] mm that the middle camera sees at pixels (x, y) [...] of its image at ``t``.

        NaN beside the leaf. ``follow`` says where their material is at another time, ``pixels`` where it is seen.
        """
        px, py = self.principal
        rays = np.stack(np.broadcast_arrays((x - px) / self.f_px, (y - py) / self.f_px, 1.0), axis=-1)
        return self.place(self.surface(self.trace(rays, np.zeros(3), t)), t)

    def albedo(self, pq: Array) -> Array:
        """Grey values [...] of the material at (p, q) [..., 2], without brightness changes."""
        u, v = pq[..., 0], pq[..., 1]
        return noise_albedo((self.texture_seed,), self.wavelengths_mm, u, v, self.offset, self.contrast)


def isotropic(percent: float) -> Vector:
    """The ``growth`` of a leaf whose area grows by ``percent`` %/frame; UsageError unless above -100."""
    rate = linear_growth(percent)
    return rate, rate, rate


def render_image(scene: LeafScene, frame: int, row: int, col: int) -> Array:
    """One image [H, W] of the camera (row, col) at ``frame``; float64 grey values, exposed (noise, bit depth)."""
    camera, t = scene.camera_position(row, col), scene.time(frame)

    def shade(x: Array, y: Array) -> Array:
        pq = scene.trace(rays_of(x, y), camera, t)
        leaf = np.isfinite(pq[..., 0])
        grey = np.full(leaf.shape, scene.background)
        grey[leaf] = scene.albedo(pq[leaf])
        if scene.brightness:
            grey[leaf] *= np.exp(scene.log_brightness(scene.surface(pq[leaf]), camera, t))
        return grey

    return scene.expose(scene.integrate(shade, scene.supersampling), frame, row, col)


def render(
    scene: LeafScene,
    frames: Iterable[int] | None = None,
    cameras: tuple[Iterable[int], Iterable[int]] | None = None,
) -> Array:
    """Images, float64 [t, sy, sx, y, x]; ``frames`` and ``cameras`` (rows, columns) choose a part.

    Raises UsageError for an index that does not exist.
    """
    return render_grid(scene, partial(render_image, scene), frames, cameras)


def truth(scene: LeafScene) -> dict[str, Any]:
    """What the middle camera sees at the middle frame, at the pixel centres; NaN beside the leaf.

    ``depth`` [mm], ``zx``, ``zy`` [H, W]; ``velocity`` mm/frame, ``omega`` rad/frame and ``acceleration`` mm/frame²
    [H, W, 3] of the point seen; ``flow`` [H, W, 2] px/frame; ``growth_rate`` [H, W], ``strain_rate`` and
    ``surface_strain`` [H, W, 3] as of ``material.growth_maps``; ``region`` [H, W] label: 1 the leaf, 0 beside it.

    ``omega`` is that of the surface element: growth that is not the same in all directions turns those that are
    inclined to the leaf's axes.
    """
    pq = scene.trace(scene.rays(), np.zeros(3), 0.0)
    points = np.array(scene.centre) + scene.surface(pq)
    zx, zy = scene.slopes(pq)
    velocity, acceleration = scene.point_motion(points)
    normal = np.stack([-zx, -zy, np.ones_like(zx)], axis=-1) / np.sqrt(1.0 + zx * zx + zy * zy)[..., None]
    return {
        "depth": points[..., 2],
        "zx": zx,
        "zy": zy,
        "velocity": velocity,
        "omega": np.array(scene.omega) + np.cross(normal @ scene.expansion, normal),
        "acceleration": acceleration,
        "flow": scene.image_motion(points, velocity),
        **growth_maps(zx, zy, scene.expansion),
        "region": np.where(np.isfinite(zx), LEAF, 0).astype(np.int32),
    }


def _height(bending: Array, a: Array, b: Array) -> Array:
    """``½ a^T K b`` [...] for the second derivatives K and vectors a, b [..., 2]."""
    return np.asarray(0.5 * np.sum((a @ bending) * b, axis=-1))


def _crossings(bending: Array, origin: Array, directions: Array) -> tuple[Array, Array]:
    """How far along the lines ``origin + λ directions`` [..., 3] the quadric is met: both λ [...], NaN where not."""
    at, along = origin[:2], directions[..., :2]
    a = _height(bending, along, along)
    b = 2.0 * _height(bending, at, along) - directions[..., 2]
    c = _height(bending, at, at) - origin[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        # Neither quotient loses digits where one of the two lies far away, as on a leaf that is nearly flat.
        sum_ = -0.5 * (b + np.copysign(np.sqrt(b * b - 4.0 * a * c), b))
        return c / sum_, sum_ / a
