"""A textured box on a rotating stage, ray-traced with supersampling (the cube of Schuchert 2010, section 5.3.2).

The box has its own axes; ``orientation`` and ``centre`` put it into the world at t = 0. A camera outside a convex box
sees a point of its surface exactly where a ray meets one of the (at most three) faces turned towards it, so every
face is traced alone, in its own coordinates. Grey values are albedo times light, averaged over each pixel's area.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.geometry import Array, rotation_matrix
from leafflow_ti.synthetic.material import no_growth
from leafflow_ti.synthetic.motion import RigidScene
from leafflow_ti.synthetic.noise_texture import albedo, noise_texture
from leafflow_ti.synthetic.rig import Vector, render_grid

Light = Literal["ambient", "spot", "spot-camera"]

FACES = ((0, -1), (2, -1), (0, 1), (2, 1), (1, -1), (1, 1))
"""Box axis and side of each face; label = index + 1. In the default orientation 1 is left, 2 is right."""


@dataclass(frozen=True, kw_only=True)
class CubeScene(RigidScene):
    """A box with its noise texture and light. The defaults are the rotating cube of Schuchert 2010, section 5.3.2.

    ``edges_mm`` box edges; ``orientation`` [rad] rotation vector from box to world axes at t = 0: by default the faces
    are inclined 60° (left) and 30° (right) to the image plane, the edge between them stands in the middle of the image,
    970 mm away. ``wavelengths_mm`` shortest and longest wavelength of the texture; ``offset`` mean and ``contrast``
    standard deviation of the albedo; ``background`` grey value around the box.

    ``light``: ``ambient`` (none but the albedo), ``spot`` fixed in the world, ``spot-camera`` fixed to the camera, at
    ``light_mm`` aimed at ``light_target_mm`` (for ``spot-camera`` both relative to the camera). The spot is Lambert's
    cosine times a Gaussian cone of standard deviation ``light_cone`` [rad]; ``ambient_share`` of the light has no
    direction. Raises UsageError for values that make no sense.
    """

    f_px: float = 2800.0
    baseline_mm: tuple[float, float] = (5.0, 5.0)
    bits: int | None = 8
    centre: Vector = (18.3, 0.0, 1038.3)
    velocity: Vector = (-0.2, 0.0, -1.0)
    omega: Vector = (0.0, math.radians(0.4), 0.0)
    edges_mm: Vector = (100.0, 100.0, 100.0)
    orientation: Vector = (0.0, -math.pi / 6.0, 0.0)
    wavelengths_mm: tuple[float, float] = (2.2, 8.0)
    offset: float = 120.0
    contrast: float = 27.0
    background: float = 20.0
    texture_seed: int = 1
    supersampling: int = 4
    light: Light = "ambient"
    light_mm: Vector = (-150.0, -100.0, 0.0)
    light_target_mm: Vector = (0.0, 0.0, 1000.0)
    light_cone: float = math.radians(4.0)
    ambient_share: float = 0.2

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.edges_mm) <= 0.0:
            raise UsageError(f"edges {self.edges_mm} mm: all must be positive")
        if not 0.0 < self.wavelengths_mm[0] < self.wavelengths_mm[1]:
            raise UsageError(
                f"wavelengths {self.wavelengths_mm} mm: give the shortest, then the longest, both positive"
            )
        if self.supersampling < 1:
            raise UsageError(f"supersampling = {self.supersampling}: at least 1 sample per pixel and axis is needed")
        if self.light not in get_args(Light):
            raise UsageError(f"light '{self.light}': choose one of {', '.join(get_args(Light))}")
        if self.light_mm == self.light_target_mm:
            raise UsageError(f"light at {self.light_mm} mm is aimed at itself: give another target")
        if self.light_cone <= 0.0:
            raise UsageError(f"light cone {self.light_cone:g} rad: must be positive")
        if not 0.0 <= self.ambient_share <= 1.0:
            raise UsageError(f"ambient share {self.ambient_share:g}: choose 0 to 1")

    @property
    def half(self) -> Array:
        """Half the edges [3] in mm."""
        return 0.5 * np.array(self.edges_mm)

    def box_pose(self, t: float) -> tuple[Array, Array]:
        """Box axes as the columns of a rotation [3, 3], and the box centre [3] in mm, at ``t`` frames."""
        rotation, shift = self.pose(t)
        return rotation @ rotation_matrix(self.orientation), rotation @ np.array(self.centre) + shift


class Hits(NamedTuple):
    """Where the rays of a block meet one face."""

    face: int  # index into FACES
    inside: NDArray[np.bool_]  # [h, w]
    depth: Array  # [n], mm, of the rays inside
    uv: tuple[Array, Array]  # [n] each, coordinates on the face from its centre, mm


def render_image(scene: CubeScene, frame: int, row: int, col: int) -> Array:
    """One image [H, W] of the camera (row, col) at ``frame``; float64 grey values, exposed (noise, bit depth).

    Raises UsageError if the camera stands inside the box.
    """
    camera, t = scene.camera_position(row, col), scene.time(frame)

    def shade(x: Array, y: Array) -> Array:
        block = np.full((y.size, x.size), scene.background)
        for hits in _trace(scene, x, y, camera, t):
            grey = _albedo(scene, hits)
            if scene.light != "ambient":
                rays = _compressed_rays(x, y, hits.inside)
                grey *= _light(scene, camera + hits.depth[:, None] * rays, hits.face, camera, t)
            block[hits.inside] = grey
        return block

    return scene.expose(scene.integrate(shade, scene.supersampling), frame, row, col)


def render(
    scene: CubeScene,
    frames: Iterable[int] | None = None,
    cameras: tuple[Iterable[int], Iterable[int]] | None = None,
) -> Array:
    """Images, float64 [t, sy, sx, y, x]; ``frames`` and ``cameras`` (rows, columns) choose a part.

    Raises UsageError if a camera stands inside the box, or for an index that does not exist.
    """
    return render_grid(scene, partial(render_image, scene), frames, cameras)


def truth(scene: CubeScene) -> dict[str, Array]:
    """What the middle camera sees at the middle frame, at the pixel centres; NaN beside the box.

    ``depth`` [mm], ``zx``, ``zy`` [H, W]; ``velocity`` [H, W, 3] mm/frame and ``acceleration`` [H, W, 3] mm/frame² of
    the point seen; ``flow`` [H, W, 2] px/frame; ``omega`` [3] rad/frame; ``growth_rate`` [H, W],
    ``strain_rate`` and ``surface_strain`` [H, W, 3], none: 0 %/frame; ``face`` [H, W] integer label, 0 beside the box
    (see FACES).
    """
    camera = np.zeros(3)
    x, y = scene.ray_axes()
    depth, zx, zy = (np.full((y.size, x.size), np.nan) for _ in range(3))
    face = np.zeros((y.size, x.size), dtype=np.int32)
    for hits in _trace(scene, x, y, camera, 0.0):
        normal = _normal(scene, hits.face, 0.0)
        depth[hits.inside] = hits.depth
        zx[hits.inside] = -normal[0] / normal[2]
        zy[hits.inside] = -normal[1] / normal[2]
        face[hits.inside] = hits.face + 1
    points = depth[..., None] * scene.rays()
    velocity, acceleration = scene.point_motion(points)
    return {
        "depth": depth,
        "zx": zx,
        "zy": zy,
        "velocity": velocity,
        "omega": np.array(scene.omega),
        "acceleration": acceleration,
        "flow": scene.image_motion(points, velocity),
        **no_growth(face > 0),
        "face": face,
    }


def _trace(scene: CubeScene, x: Array, y: Array, camera: Array, t: float) -> Iterator[Hits]:
    """Hits of the rays ``(x, y, 1)``, x [w], y [h], on every face that is turned towards ``camera`` [3]."""
    axes, centre = scene.box_pose(t)
    origin = (camera - centre) @ axes
    visible = [(face, k, side) for face, (k, side) in enumerate(FACES) if side * origin[k] > scene.half[k]]
    if not visible:
        raise UsageError(f"the camera at {camera[:2]} mm is inside the box at t = {t:g} frames: move the box away")
    directions = [axes[0, k] * x + (axes[1, k] * y + axes[2, k])[:, None] for k in range(3)]
    for face, k, side in visible:
        towards = side * directions[k] < 0.0
        depth = np.divide(
            side * scene.half[k] - origin[k], directions[k], out=np.full(towards.shape, -1.0), where=towards
        )
        inside = depth > 0.0
        uv = []
        for i in _in_face(k):
            position = origin[i] + depth * directions[i]
            inside &= np.abs(position) <= scene.half[i]
            uv.append(position)
        yield Hits(face, inside, depth[inside], (uv[0][inside], uv[1][inside]))


def _in_face(axis: int) -> tuple[int, int]:
    """The two box axes that span the faces across ``axis``."""
    first, second = (k for k in range(3) if k != axis)
    return first, second


def _normal(scene: CubeScene, face: int, t: float) -> Array:
    """Outward normal of a face in the world, [3]."""
    axis, side = FACES[face]
    return np.asarray(side * scene.box_pose(t)[0][:, axis])


def _albedo(scene: CubeScene, hits: Hits) -> Array:
    """Grey values [n] of the texture under full light."""
    shortest, longest = scene.wavelengths_mm
    period = max(scene.edges_mm)
    field = noise_texture((scene.texture_seed, hits.face), period, shortest, longest)
    return albedo(field, period, *hits.uv, scene.offset, scene.contrast)


def _compressed_rays(x: Array, y: Array, inside: NDArray[np.bool_]) -> Array:
    """The rays [n, 3] of the samples ``inside`` [h, w]."""
    rows, cols = np.nonzero(inside)
    return np.stack([x[cols], y[rows], np.ones(rows.size)], axis=1)


def _light(scene: CubeScene, points: Array, face: int, camera: Array, t: float) -> Array:
    """Light [n], 0..1, on ``points`` [n, 3] of a face."""
    carrier = camera if scene.light == "spot-camera" else np.zeros(3)
    lamp = carrier + np.array(scene.light_mm)
    beam = carrier + np.array(scene.light_target_mm) - lamp
    beam /= np.linalg.norm(beam)
    to_point = points - lamp
    to_point /= np.sqrt(np.einsum("ij,ij->i", to_point, to_point))[:, None]
    lambert = np.maximum(-(to_point @ _normal(scene, face, t)), 0.0)
    # The chord between two directions, 2 sin(angle/2), is the angle itself in a cone, and smooth on the axis.
    chord2 = 2.0 - 2.0 * (to_point @ beam)
    spot = lambert * np.exp(-0.5 * chord2 / scene.light_cone**2)
    return np.asarray(scene.ambient_share + (1.0 - scene.ambient_share) * spot)
