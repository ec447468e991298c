"""A frontal plane that moves across the view of a row of cameras, from any texture: its images and their truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

import leafflow_ti as lf
from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.field import FLOW_GRADIENT_NAMES, PLANE_STRAIN_NAMES

Array = np.ndarray
Texture = Callable[[Array, Array], Array]

F_PX, BASELINE_MM, DISPARITY = 900.0, 0.3, -0.4


def stripes(angle: float, wavelength: float = 9.0) -> Texture:
    """Grey values that change along the direction ``angle`` [rad] from x alone."""
    k = 2 * np.pi / wavelength
    return lambda x, y: 100 + 40 * np.cos(k * (np.cos(angle) * x + np.sin(angle) * y))


def checks(x: Array, y: Array) -> Array:
    """A single spatial frequency in either direction."""
    return 100 + 40 * np.cos(2 * np.pi * x / 9) * np.cos(2 * np.pi * y / 9)


def half(x: Array, y: Array) -> Array:
    """Texture on the right alone, fading over some pixels; it moves with the surface, as does its edge."""
    return 100 + (checks(x, y) - 100) / (1 + np.exp(-(x - 2) / 2))


def plain(x: Array, y: Array) -> Array:
    """No texture at all."""
    return np.full(np.broadcast(x, y).shape, 100.0)


@dataclass(frozen=True)
class Moving:
    """``texture`` seen with the flow ``flow`` [px/frame] in ``n_frames`` frames of ``n_cameras`` cameras."""

    texture: Texture
    noise: float = 1.0
    flow: tuple[float, float] = (0.3, -0.2)
    size: tuple[int, int] = (52, 44)
    n_cameras: int = 5
    n_frames: int = 7
    seed: int = 0

    def images(self) -> Array:
        """[t, 1, camera, y, x], float64."""
        width, height = self.size
        t = np.arange(self.n_frames)[:, None, None, None, None] - self.n_frames // 2
        s = np.arange(self.n_cameras)[:, None, None] - self.n_cameras // 2
        y, x = np.arange(height)[:, None] - height / 2, np.arange(width) - width / 2
        moved = self.texture(x - self.flow[0] * t - DISPARITY * s, y - self.flow[1] * t + 0 * s)
        return moved + np.random.default_rng(self.seed).normal(0, self.noise, moved.shape)

    @property
    def truth(self) -> dict[str, float]:
        """Map -> its value, everywhere alike."""
        depth = -F_PX * BASELINE_MM / DISPARITY
        known = {f"{q}_{a}": 0.0 for q, axes in (("slope", "xy"), ("rotation", "xyz"), ("velocity", "z")) for a in axes}
        known |= {"disparity": DISPARITY, "depth": depth}
        known |= dict.fromkeys((*FLOW_GRADIENT_NAMES, *PLANE_STRAIN_NAMES), 0.0)
        for axis, u in zip("xy", self.flow, strict=True):
            known |= {f"flow_{axis}": u, f"velocity_{axis}": u * depth / F_PX}
        return known

    def measure(self, model: str, **options: object) -> lf.Field:
        """The field of the middle frame, windows of 17 pixels unless ``options`` say otherwise."""
        one = replace(self, n_cameras=1) if model.startswith("flow") else self
        width, height = self.size
        geometry = Geometry(F_PX, ((width - 1) / 2, (height - 1) / 2), (BASELINE_MM, BASELINE_MM))
        usual: dict[str, object] = {"window": 17, "sigma": 5.0, "stride": 1, "refine": 0}
        usual |= {} if model.startswith("flow") else {"preshift": (0, 0)}
        return lf.estimate(capture_from_array(one.images(), geometry), model=model, **{**usual, **options})
