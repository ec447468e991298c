"""A textured plane that moves rigidly and may grow, rendered by exact ray/plane intersection (Schuchert 2010, App. B).

The texture, fixed to the material, is either of

    I = (o + a cos(2π xP/λ1) cos(2π yP/λ2)) exp(h)                       waves
    I = (o + a n(p, q)) exp(h)                                           noise n, wavelengths from λ1 to λ2, variance 1
    xP =  cos α p + sin α q,   yP = -sin β p + cos β q                   p, q: in-plane coordinates from the centre

with ``p, q`` along the axes of the smallest rotation that turns (0, 0, 1) into the normal; α = β turns an orthogonal
pattern in its plane, α ≠ β shears it. Waves are read at the pixel's centre, as in the dissertation; noise is averaged
over its area. Growing material expands in its plane about the centre: what was at ``P`` at t = 0, relative to the
centre, is at ``(1 + t E) P``, with the tensor E of its in-plane strain rates.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.geometry import Array, in_plane, plane_axes
from leafflow_ti.synthetic.material import MaterialScene, growth_maps
from leafflow_ti.synthetic.noise_texture import noise_albedo
from leafflow_ti.synthetic.rig import Vector, rays_of, render_grid

Texture = Literal["waves", "noise"]


@dataclass(frozen=True, kw_only=True)
class PlaneScene(MaterialScene):
    """The plane ``Z = Z0 + ZX (X - X0) + ZY (Y - Y0)`` and its texture; motion and cameras are inherited.

    ``alpha``, ``beta`` in rad (``beta`` None: equal to ``alpha``): of waves. ``offset`` and ``amplitude``: mean and
    amplitude of waves, or mean and standard deviation of noise, in grey values. ``wavelengths_mm``: of both waves, or
    the shortest and the longest of the noise. ``supersampling``: rays per pixel and axis, None: 1 for waves, 4 for
    noise.
    ``growth``: g [1/frame], of lengths, in all directions; see ``linear_growth``. ``strain`` [1/frame]: rates (11, 22,
    12) along ``tangent_axes`` beside it.
    Raises UsageError for values that make no sense.
    """

    centre: Vector = (0.0, 0.0, 100.0)
    zx: float = 0.0
    zy: float = 0.0
    offset: float = 100.0
    amplitude: float = 50.0
    wavelengths_mm: tuple[float, float] = (0.3, 0.3)
    alpha: float = 0.0
    beta: float | None = None
    growth: float = 0.0
    strain: Vector = (0.0, 0.0, 0.0)
    texture: Texture = "waves"
    supersampling: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if min(self.wavelengths_mm) <= 0.0:
            raise UsageError(f"wavelengths {self.wavelengths_mm} mm: both must be positive")
        if self.texture not in get_args(Texture):
            raise UsageError(f"texture '{self.texture}': choose one of {', '.join(get_args(Texture))}")
        if self.texture == "noise" and self.wavelengths_mm[0] >= self.wavelengths_mm[1]:
            raise UsageError(f"wavelengths {self.wavelengths_mm} mm of noise: give the shortest, then the longest")
        if self.supersampling is not None and self.supersampling < 1:
            raise UsageError(f"supersampling = {self.supersampling}: at least 1 sample per pixel and axis is needed")

    @property
    def rays_per_axis(self) -> int:
        """Rays along each axis of a pixel."""
        default = 4 if self.texture == "noise" else 1
        return default if self.supersampling is None else self.supersampling

    def intersect(self, rays: Array, camera: Array, t: float) -> Array:
        """World points [..., 3] where rays [..., 3] from ``camera`` [3 or ..., 3] meet the plane at time ``t``.

        Raises UsageError where a ray misses the front of the plane.
        """
        rotation, shift = self.pose(t)
        normal = rotation @ plane_axes(self.zx, self.zy)[:, 2]
        distance = (rotation @ np.array(self.centre) + shift - camera) @ normal
        slant = rays @ normal
        if np.min(distance) <= 0.0 or np.min(slant) <= 0.0:
            raise UsageError(
                f"at t = {t:g} frames the plane is seen edge-on or from behind: "
                "reduce its slopes or its motion, or make the images smaller"
            )
        return np.asarray(camera + (distance / slant)[..., None] * rays)

    @property
    def strain_rates(self) -> Array:
        """All in-plane strain rates (11, 22, 12) [3] along ``tangent_axes``, 1/frame: ``growth`` and ``strain``."""
        return np.asarray(self.growth * np.array([1.0, 1.0, 0.0]) + np.array(self.strain))

    @property
    def expansion(self) -> Array:
        """See ``MaterialScene``; none along the normal."""
        return in_plane(self.zx, self.zy, self.strain_rates)

    @property
    def growth_rate(self) -> float:
        """Growth of the area between half a frame before and after t = 0, in %/frame."""
        return float(growth_maps(np.array(self.zx), np.array(self.zy), self.expansion)["growth_rate"])

    def albedo(self, offsets: Array) -> Array:
        """Grey values [...] of the material points ``offsets`` [..., 3], without brightness changes."""
        pq = offsets @ plane_axes(self.zx, self.zy)
        if self.texture == "noise":
            u, v = pq[..., 0], pq[..., 1]
            return noise_albedo((self.texture_seed,), self.wavelengths_mm, u, v, self.offset, self.amplitude)
        beta = self.alpha if self.beta is None else self.beta
        first = math.cos(self.alpha) * pq[..., 0] + math.sin(self.alpha) * pq[..., 1]
        second = math.cos(beta) * pq[..., 1] - math.sin(beta) * pq[..., 0]
        k1, k2 = (2.0 * math.pi / wavelength for wavelength in self.wavelengths_mm)
        return np.asarray(self.offset + self.amplitude * np.cos(k1 * first) * np.cos(k2 * second))


def render_image(scene: PlaneScene, frame: int, row: int, col: int) -> Array:
    """One image [H, W] of the camera (row, col) at ``frame``; float64 grey values, exposed (noise, bit depth)."""
    camera, t = scene.camera_position(row, col), scene.time(frame)

    def shade(x: Array, y: Array) -> Array:
        offsets = scene.material(scene.intersect(rays_of(x, y), camera, t), t)
        grey = scene.albedo(offsets)
        return grey * np.exp(scene.log_brightness(offsets, camera, t)) if scene.brightness else grey

    return scene.expose(scene.integrate(shade, scene.rays_per_axis), frame, row, col)


def render(
    scene: PlaneScene,
    frames: Iterable[int] | None = None,
    cameras: tuple[Iterable[int], Iterable[int]] | None = None,
) -> Array:
    """Images, float64 [t, sy, sx, y, x]; ``frames`` and ``cameras`` (rows, columns) choose a part.

    Raises UsageError if the plane turns away from a camera, or for an index that does not exist.
    """
    return render_grid(scene, partial(render_image, scene), frames, cameras)


def truth(scene: PlaneScene) -> dict[str, Array]:
    """What the middle camera sees at the middle frame.

    ``depth`` [mm], ``zx``, ``zy`` [H, W]; ``velocity`` [H, W, 3] = N + Ω × (X - Xr) + E (X - Xc) mm/frame, of the point
    seen at the pixel; ``omega`` [3] rad/frame; ``acceleration`` [H, W, 3] = A + Ω × (Ω × (X - Xr)) + 2 Ω × E (X - Xc)
    mm/frame²; ``flow`` [H, W, 2] px/frame; ``growth_rate`` [H, W], ``strain_rate`` and ``surface_strain`` [H, W, 3]
    %/frame as of ``growth_maps``.
    """
    points = scene.intersect(scene.rays(), np.zeros(3), 0.0)
    velocity, acceleration = scene.point_motion(points)
    growth = growth_maps(np.array(scene.zx), np.array(scene.zy), scene.expansion)
    return {
        "depth": points[..., 2],
        "zx": np.full(points.shape[:2], scene.zx),
        "zy": np.full(points.shape[:2], scene.zy),
        "velocity": velocity,
        "omega": np.array(scene.omega),
        "acceleration": acceleration,
        "flow": scene.image_motion(points, velocity),
        **{name: np.broadcast_to(value, (*points.shape[:2], *value.shape)).copy() for name, value in growth.items()},
    }


def linear_growth(percent: float) -> float:
    """The ``growth`` of a scene whose area grows by ``percent`` %/frame; UsageError unless above -100."""
    if not percent > -100.0:
        raise UsageError(
            f"growth = {percent:g} %/frame: an area cannot lose all of itself in a frame: choose more than -100"
        )
    k = math.sqrt(1.0 + percent / 100.0)
    return 2.0 * (k - 1.0) / (k + 1.0)


def sinusoid_scene(noise: float = 0.0, size: tuple[int, int] = (161, 161), bits: int | None = None) -> PlaneScene:
    """The sinusoid of Schuchert 2010, section 5.3, with the patch centre on the optical axis.

    f = 12 mm at 4.4 µm pixel pitch (2727.27 px), 9 cameras 0.5 mm apart (disparity -13.6 px per step at the centre),
    9 frames. Grey values 100 ± 50, so that ``noise`` 2.5 is 2.5 % of the grey range of 100.
    """
    axis = np.array([2.0, 3.0, 2.0])
    ox, oy, oz = (math.radians(0.003) * axis / np.linalg.norm(axis)).tolist()
    return PlaneScene(
        f_px=12.0 / 0.0044,
        baseline_mm=(0.5, 0.5),
        size=size,
        noise=noise,
        bits=bits,
        centre=(0.0, 0.0, 100.0),
        zx=0.6,
        zy=-0.5,
        velocity=(0.0073, -0.0037, 0.06),
        omega=(ox, oy, oz),
        wavelengths_mm=(0.3, 0.3),
    )


def noise_scene(size: tuple[int, int] = (161, 161)) -> PlaneScene:
    """The plane of ``sinusoid_scene`` with noise of the same contrast: a texture that does not repeat itself."""
    return replace(sinusoid_scene(size=size), texture="noise", amplitude=25.0, wavelengths_mm=(0.25, 1.0))
