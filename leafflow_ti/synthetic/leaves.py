"""A plant-like scene: leaves at several depths over a textured ground, each with its own tilt and motion.

Every surface is a plane with noise fixed to it (``plane.PlaneScene``); a leaf is the part of its plane inside an
outline. The surface nearest along a ray hides the others. Light changes with time: grey values are ``exp(h)`` times the
albedo,

    h = t (g + gx X/Z + gy Y/Z)        t [frames] from the middle frame, (X, Y, Z) the point in the world

so that all cameras see the same light on the same point. Which leaves there are follows from ``layout_seed`` alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.geometry import Array, plane_axes, within_outline
from leafflow_ti.synthetic.material import no_growth
from leafflow_ti.synthetic.plane import PlaneScene
from leafflow_ti.synthetic.rig import CameraGrid, rays_of, render_grid

MOST_LEAVES = 20
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
GROUND = 0
"""Label of the ground; leaves count from 1, farthest first."""


@dataclass(frozen=True, eq=False)
class Leaf:
    """A plane and the outline on it.

    ``half`` (length, width) [mm] of the outline along and across the direction ``turn`` [rad] in the plane.
    ``pointed``: two parabolas that meet in tips, else an ellipse.
    """

    surface: PlaneScene
    half: tuple[float, float]
    turn: float
    pointed: bool

    def inside(self, offsets: Array) -> NDArray[np.bool_]:
        """Which points of the plane belong to the leaf: ``offsets`` [..., 3] [mm] from its centre at t = 0."""
        pq = offsets @ plane_axes(self.surface.zx, self.surface.zy)
        p, q = pq[..., 0], pq[..., 1]
        along = (math.cos(self.turn) * p + math.sin(self.turn) * q) / self.half[0]
        across = (math.cos(self.turn) * q - math.sin(self.turn) * p) / self.half[1]
        return within_outline(along, across, self.pointed)


@dataclass(frozen=True, kw_only=True)
class LeavesScene(CameraGrid):
    """``leaves`` leaves over a ground.

    ``disparity_px`` [px/step] of the ground and of the nearest leaf, of those between in equal ratios; ``motion_px``
    [px/frame] that no leaf's centre exceeds, and the fastest reaches; the ground rests. ``wavelengths_px`` shortest and
    longest wavelength of the textures as the middle camera sees them; ``offset`` mean and ``contrast`` standard
    deviation of the albedo. ``light_change`` (g, gx, gy) per frame. Raises UsageError for values that make no sense.
    """

    f_px: float = 1200.0
    baseline_mm: tuple[float, float] = (5.0, 5.0)
    size: tuple[int, int] = (401, 301)
    bits: int | None = 8
    leaves: int = 5
    disparity_px: tuple[float, float] = (3.0, 30.0)
    motion_px: float = 8.0
    wavelengths_px: tuple[float, float] = (5.0, 24.0)
    offset: float = 110.0
    contrast: float = 26.0
    light_change: tuple[float, float, float] = (0.01, 0.06, -0.03)
    layout_seed: int = 1
    supersampling: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.leaves <= MOST_LEAVES:
            raise UsageError(f"leaves = {self.leaves}: choose 1 to {MOST_LEAVES}")
        if not 0.0 < self.disparity_px[0] < self.disparity_px[1]:
            raise UsageError(
                f"disparities {self.disparity_px} px per step: give that of the ground, then that of the nearest leaf"
            )
        if self.motion_px < 0.0:
            raise UsageError(f"motion = {self.motion_px:g} px/frame: cannot be negative")
        if not 0.0 < self.wavelengths_px[0] < self.wavelengths_px[1]:
            raise UsageError(
                f"wavelengths {self.wavelengths_px} px: give the shortest, then the longest, both positive"
            )
        if self.layout_seed < 0:
            raise UsageError(f"layout_seed = {self.layout_seed}: a seed cannot be negative")
        if self.supersampling < 1:
            raise UsageError(f"supersampling = {self.supersampling}: at least 1 sample per pixel and axis is needed")
        if self.baseline_mm[0] == 0.0:
            raise UsageError("baseline along x = 0 mm: the depths follow from it and from the disparities")

    @cached_property
    def surfaces(self) -> tuple[PlaneScene, ...]:
        """The ground, then the planes of the leaves, farthest first."""
        return (self._ground(), *(leaf.surface for leaf in self.plants))

    @cached_property
    def plants(self) -> tuple[Leaf, ...]:
        """The leaves, farthest first."""
        return tuple(self._leaf(k) for k in range(1, self.leaves + 1))

    def _depth(self, share: float) -> float:
        """Depth [mm] at ``share`` of the way from the ground (0) to the nearest leaf (1), in ratios of disparities."""
        far, near = self.disparity_px
        return float(self.f_px * abs(self.baseline_mm[0]) / (far * (near / far) ** share))

    def _plane(self, label: int, x: float, y: float, depth: float, zx: float, zy: float, motion: Array) -> PlaneScene:
        """The plane through the point at pixel (x, y) from the principal point.

        ``motion`` [6]: N (px/frame along x and y, parts of the depth per frame along Z), Ω [rad/frame].
        """
        pixel = depth / self.f_px
        vx, vy, vz, *omega = motion.tolist()
        return PlaneScene(
            f_px=self.f_px, baseline_mm=self.baseline_mm, n_cols=self.n_cols, n_rows=self.n_rows,
            n_frames=self.n_frames, size=self.size, principal_px=self.principal_px,
            centre=(x * pixel, y * pixel, depth), zx=zx, zy=zy,
            velocity=((vx + x * vz) * pixel, (vy + y * vz) * pixel, vz * depth),
            omega=(omega[0], omega[1], omega[2]), texture="noise", texture_seed=100 * self.layout_seed + label,
            wavelengths_mm=(self.wavelengths_px[0] * pixel, self.wavelengths_px[1] * pixel), offset=self.offset,
            amplitude=self.contrast,
        )  # fmt: skip

    def _ground(self) -> PlaneScene:
        return self._plane(GROUND, 0.0, 0.0, self._depth(0.0), 0.12, -0.08, np.zeros(6))

    def _leaf(self, label: int) -> Leaf:
        """Leaves lie around the image's middle like those of a rosette, a golden angle apart."""
        random = np.random.default_rng([self.layout_seed, label])
        extent = float(min(self.size))
        depth = self._depth(label / self.leaves)
        bearing = label * GOLDEN_ANGLE + random.uniform(-0.3, 0.3)
        away = extent * random.uniform(0.2, 0.33)
        direction = random.uniform(0.0, 2.0 * math.pi)
        speed = self.motion_px * (1.0 if label == self.leaves else random.uniform(0.2, 0.9))
        motion = np.array(
            [
                speed * math.cos(direction), speed * math.sin(direction), random.uniform(-0.004, 0.004),
                *np.radians(random.uniform(-0.4, 0.4, 3)),
            ]
        )  # fmt: skip
        zx, zy = random.uniform(-0.6, 0.6, 2).tolist()
        (cx, cy), (px, py) = ((n - 1) / 2 for n in self.size), self.principal
        x, y = cx - px + away * math.cos(bearing), cy - py + away * math.sin(bearing)
        surface = self._plane(label, x, y, depth, zx, zy, motion)
        length = extent * random.uniform(0.28, 0.34) * depth / self.f_px
        return Leaf(surface, (length, length * random.uniform(0.5, 0.7)), bearing, pointed=label % 2 == 1)

    def log_light(self, points: Array, t: float) -> Array:
        """Logarithm ``h`` [...] of the light on world points [..., 3] at ``t`` frames."""
        g, gx, gy = self.light_change
        return np.asarray(t * (g + (gx * points[..., 0] + gy * points[..., 1]) / points[..., 2]))

    def trace(self, rays: Array, camera: Array, t: float) -> tuple[NDArray[np.int32], Array]:
        """What rays [..., 3] from ``camera`` [3] meet first at ``t`` frames: labels [...] and world points [..., 3].

        Raises UsageError if a plane turns away from the camera.
        """
        points = self.surfaces[GROUND].intersect(rays, camera, t)
        label = np.full(points.shape[:-1], GROUND, np.int32)
        for number, leaf in enumerate(self.plants, start=1):
            meets = leaf.surface.intersect(rays, camera, t)
            first = leaf.inside(leaf.surface.material(meets, t)) & (meets[..., 2] < points[..., 2])
            label[first] = number
            points[first] = meets[first]
        return label, points


def render_image(scene: LeavesScene, frame: int, row: int, col: int) -> Array:
    """One image [H, W] of the camera (row, col) at ``frame``; float64 grey values, exposed (noise, bit depth).

    Raises UsageError if a leaf or the ground turns away from the camera.
    """
    camera, t = scene.camera_position(row, col), scene.time(frame)

    def shade(x: Array, y: Array) -> Array:
        label, points = scene.trace(rays_of(x, y), camera, t)
        grey = np.exp(scene.log_light(points, t))
        for number, surface in enumerate(scene.surfaces):
            seen = label == number
            if seen.any():
                grey[seen] *= surface.albedo(surface.material(points[seen], t))
        return grey

    return scene.expose(scene.integrate(shade, scene.supersampling), frame, row, col)


def render(
    scene: LeavesScene,
    frames: Iterable[int] | None = None,
    cameras: tuple[Iterable[int], Iterable[int]] | None = None,
) -> Array:
    """Images, float64 [t, sy, sx, y, x]; ``frames`` and ``cameras`` (rows, columns) choose a part.

    Raises UsageError as ``render_image``, or for an index that does not exist.
    """
    return render_grid(scene, partial(render_image, scene), frames, cameras)


def truth(scene: LeavesScene) -> dict[str, Any]:
    """What the middle camera sees at the middle frame, at the pixel centres.

    ``depth`` [mm], ``zx``, ``zy`` [H, W]; ``velocity`` mm/frame, ``omega`` rad/frame and ``acceleration`` mm/frame²
    [H, W, 3] of the point seen; ``flow`` [H, W, 2] px/frame; ``growth_rate`` [H, W], ``strain_rate`` and
    ``surface_strain`` [H, W, 3], none: 0 %/frame; ``face`` [H, W] label, 0 on the ground, leaves from 1.
    """
    label, points = scene.trace(scene.rays(), np.zeros(3), 0.0)
    zx, zy = np.empty(label.shape), np.empty(label.shape)
    velocity, acceleration, omega = np.empty(points.shape), np.empty(points.shape), np.empty(points.shape)
    for number, surface in enumerate(scene.surfaces):
        seen = label == number
        zx[seen], zy[seen], omega[seen] = surface.zx, surface.zy, surface.omega
        velocity[seen], acceleration[seen] = surface.point_motion(points[seen])
    return {
        "depth": points[..., 2],
        "zx": zx,
        "zy": zy,
        "velocity": velocity,
        "omega": omega,
        "acceleration": acceleration,
        "flow": scene.surfaces[GROUND].image_motion(points, velocity),
        **no_growth(np.ones(label.shape, np.bool_)),
        "face": label,
    }
