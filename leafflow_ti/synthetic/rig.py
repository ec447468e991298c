"""The camera grid that films every synthetic scene, and its sensor.

Conventions: camera (row sy, column sx) stands at ``(k_x bx, k_y by, 0)`` mm and looks along +Z; ``k`` counts from the
middle camera (index ``n // 2``), ``t`` [frames] from the middle frame. ``x = f (X - s)/Z`` (Schuchert 2010, Eq. (3.20))
is in pixel, relative to the principal point, x right and y down.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields

import numpy as np

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.geometry import Array

Vector = tuple[float, float, float]
BIT_DEPTHS = (8, 10, 12, 14, 16)

BLOCK_ROWS = 8
"""Image rows shaded at once: the arrays of a block stay in the processor's cache."""


@dataclass(frozen=True, kw_only=True)
class CameraGrid:
    """Cameras, frames and sensor of a scene; every scene class inherits these fields.

    ``size`` is (width, height); ``principal_px`` defaults to the image centre ((W-1)/2, (H-1)/2); ``noise`` is the
    standard deviation of white Gaussian noise; ``bits`` rounds and clips to unsigned integers of that
    depth, None keeps real numbers. Scenes and noise are stated in grey values of 8 bits; deeper images hold these times
    ``2^(bits - 8)``. Raises UsageError for values that make no sense.
    """

    f_px: float
    baseline_mm: tuple[float, float]
    n_cols: int = 9
    n_rows: int = 1
    n_frames: int = 9
    size: tuple[int, int] = (301, 301)
    principal_px: tuple[float, float] | None = None
    noise: float = 0.0
    seed: int = 0
    bits: int | None = None

    def __post_init__(self) -> None:
        for field in fields(self):
            _check_finite(field.name, getattr(self, field.name))
        for name, count in (("n_cols", self.n_cols), ("n_rows", self.n_rows), ("n_frames", self.n_frames)):
            if count < 1:
                raise UsageError(f"{name} = {count}: at least 1 is needed")
        if min(self.size) < 1:
            raise UsageError(f"size = {self.size[0]}x{self.size[1]}: width and height must be at least 1 pixel")
        if self.f_px <= 0.0:
            raise UsageError(f"f_px = {self.f_px:g}: the focal length in pixel must be positive")
        if self.noise < 0.0:
            raise UsageError(f"noise = {self.noise:g}: a standard deviation cannot be negative")
        if self.seed < 0:
            raise UsageError(f"seed = {self.seed}: a seed cannot be negative")
        if self.bits is not None and self.bits not in BIT_DEPTHS:
            raise UsageError(
                f"bits = {self.bits}: choose one of {', '.join(map(str, BIT_DEPTHS))}, or none for real numbers"
            )
        for axis, step, count in zip("xy", self.baseline_mm, (self.n_cols, self.n_rows), strict=True):
            if step == 0.0 and count > 1:
                raise UsageError(f"baseline along {axis} = 0 mm with {count} cameras: give a step other than zero")

    @property
    def principal(self) -> tuple[float, float]:
        """Principal point (column, row) in pixel."""
        width, height = self.size
        return ((width - 1) / 2, (height - 1) / 2) if self.principal_px is None else self.principal_px

    @property
    def reference_frame(self) -> int:
        """Index of the middle frame, at which ``t = 0``."""
        return self.n_frames // 2

    def time(self, frame: int) -> float:
        """Frames since the reference frame."""
        return float(frame - self.reference_frame)

    def camera_position(self, row: int, col: int) -> Array:
        """World position (sx, sy, 0) [mm] of the camera in grid row ``row`` and column ``col``."""
        bx, by = self.baseline_mm
        return np.array([(col - self.n_cols // 2) * bx, (row - self.n_rows // 2) * by, 0.0])

    def ray_axes(self, oversampling: int = 1) -> tuple[Array, Array]:
        """``x/f`` [n W] and ``y/f`` [n H] of the viewing rays ``(x/f, y/f, 1)``, n x n of them in each pixel."""
        (width, height), (px, py) = self.size, self.principal
        return (_subpixels(width, oversampling) - px) / self.f_px, (_subpixels(height, oversampling) - py) / self.f_px

    def rays(self) -> Array:
        """Viewing rays ``(x/f, y/f, 1)`` through the pixel centres, [H, W, 3]."""
        return rays_of(*self.ray_axes())

    def pixels(self, points: Array, camera: Array | None = None) -> Array:
        """Where world points [..., 3] are seen: (x, y) [..., 2] in pixels of the image of the camera at ``camera`` [3].

        None: the middle camera.
        """
        relative = points - (np.zeros(3) if camera is None else camera)
        return np.asarray(self.f_px * relative[..., :2] / relative[..., 2:] + np.array(self.principal))

    def integrate(self, shade: Callable[[Array, Array], Array], oversampling: int) -> Array:
        """The image [H, W] of ``shade``, averaged over ``oversampling``² rays in each pixel; grey values, unexposed.

        ``shade(x, y)`` gives the grey values [h, w] of the rays ``(x, y, 1)``, x [w], y [h], a few rows at a time.
        """
        x, y = self.ray_axes(oversampling)
        width, height = self.size
        image = np.empty((height, width))
        for top in range(0, height, BLOCK_ROWS):
            rows = slice(top, min(top + BLOCK_ROWS, height))
            fine = shade(x, y[rows.start * oversampling : rows.stop * oversampling])
            image[rows] = fine.reshape(-1, oversampling, width, oversampling).mean(axis=(1, 3))
        return image

    def expose(self, image: Array, frame: int, row: int, col: int) -> Array:
        """Add the sensor's noise, then round and clip to its bit depth; float64 in any case.

        Each image has its own random stream of (seed, frame, row, col): parts of a sequence equal the whole.
        """
        if self.noise > 0.0:
            generator = np.random.default_rng([self.seed, frame, row, col])
            image = image + self.noise * generator.standard_normal(image.shape)
        if self.bits is not None:
            image = np.clip(np.rint(2.0 ** (self.bits - 8) * image), 0.0, 2.0**self.bits - 1.0)
        return image


def rays_of(x: Array, y: Array) -> Array:
    """The rays ``(x, y, 1)`` [h, w, 3] of every pair of x [w] and y [h]."""
    return np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=-1)


def render_grid(
    scene: CameraGrid,
    image: Callable[[int, int, int], Array],
    frames: Iterable[int] | None = None,
    cameras: tuple[Iterable[int], Iterable[int]] | None = None,
) -> Array:
    """Stack ``image(frame, row, col)`` [H, W] to float64 [t, sy, sx, y, x].

    ``frames`` and ``cameras`` (rows, columns) choose a part of the grid; all of it by default. Raises UsageError for
    an index that does not exist.
    """
    rows, cols = (None, None) if cameras is None else cameras
    t_indices = _indices("frame", frames, scene.n_frames)
    row_indices = _indices("camera row", rows, scene.n_rows)
    col_indices = _indices("camera column", cols, scene.n_cols)
    width, height = scene.size
    out = np.empty((len(t_indices), len(row_indices), len(col_indices), height, width))
    for i, frame in enumerate(t_indices):
        for j, row in enumerate(row_indices):
            for k, col in enumerate(col_indices):
                out[i, j, k] = image(frame, row, col)
    return out


def _subpixels(n: int, oversampling: int) -> Array:
    """Centres of ``oversampling`` equal parts of each of ``n`` pixels, in pixel; shape [n * oversampling]."""
    return np.asarray((np.arange(n * oversampling) + 0.5) / oversampling - 0.5)


def _indices(name: str, chosen: Iterable[int] | None, count: int) -> list[int]:
    indices = list(range(count)) if chosen is None else list(chosen)
    for index in indices:
        if not 0 <= index < count:
            raise UsageError(f"{name} {index} does not exist: choose from 0..{count - 1}")
    return indices


def _check_finite(name: str, value: object) -> None:
    numbers = value if isinstance(value, tuple) else (value,)
    for number in numbers:
        if isinstance(number, float) and not np.isfinite(number):
            raise UsageError(f"{name} = {number}: every number of a scene must be finite")
