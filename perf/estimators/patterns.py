"""Moving patterns with known affine flow, one or two to an image: exact at any time, whatever the flow.

A point that moves with ``u(x) = v + G (x - c)`` is at time t where ``exp(t [[G, v], [0, 0]])`` takes it. The pattern
is read where its points were at t = 0: waves of random direction and phase, which need no interpolation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from leafflow_ti.api import estimate
from leafflow_ti.capture import capture_from_array
from leafflow_ti.field import Field
from leafflow_ti.metrics import aae
from perf.fields import vectors

Array = NDArray[np.float64]

WAVES = 80
WAVELENGTHS_PX = (5.0, 32.0)
MEAN, CONTRAST = 120.0, 25.0
"""Mean and standard deviation of a pattern [grey values]."""


@dataclass(frozen=True)
class AffineFlow:
    """``velocity`` (x, y) [px/frame] at the middle of the image, and its gradient ((xx, xy), (yx, yy)) [1/frame]."""

    velocity: tuple[float, float]
    gradient: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))

    def at(self, x: Array, y: Array) -> Array:
        """The flow [..., 2] at x, y [px] from the middle."""
        return np.asarray(np.stack([x, y], axis=-1) @ np.array(self.gradient).T + np.array(self.velocity))

    def origin(self, x: Array, y: Array, t: float) -> tuple[Array, Array]:
        """Where the points that are at x, y after ``t`` frames were at first."""
        generator = np.zeros((3, 3))
        generator[:2, :2], generator[:2, 2] = self.gradient, self.velocity
        back = expm(-t * generator)
        return back[0, 0] * x + back[0, 1] * y + back[0, 2], back[1, 0] * x + back[1, 1] * y + back[1, 2]


@dataclass(frozen=True)
class Scene:
    """A square image of ``size`` pixels in ``n_frames``: one pattern, or two that meet at a vertical line.

    ``flow``: of the pattern; of the left one, which lies in front and takes the line with it, where there is ``other``
    for the right one. The line stands in the middle of the image in the middle frame, half a pixel left of a pixel's
    centre. ``noise``: standard deviation [grey values]. ``samples``: per pixel and axis.
    """

    flow: AffineFlow
    other: AffineFlow | None = None
    size: int = 129
    n_frames: int = 9
    noise: float = 0.0
    seed: int = 0

    @property
    def grid(self) -> tuple[Array, Array]:
        """x, y [size, size] from the middle pixel."""
        offset = np.arange(self.size, dtype=np.float64) - self.size // 2
        x, y = np.meshgrid(offset, offset)
        return x, y

    @property
    def truth(self) -> Array:
        """Flow [y, x, 2] in px/frame of the middle frame."""
        x, y = self.grid
        flow = self.flow.at(x, y)
        return flow if self.other is None else np.where((x < -0.5)[..., None], flow, self.other.at(x, y))

    def images(self) -> Array:
        """Grey values [t, y, x] with noise."""
        clean = np.stack([self._image(t - self.n_frames // 2) for t in range(self.n_frames)])
        return clean + self.noise * np.random.default_rng(self.seed).standard_normal(clean.shape)

    def _image(self, t: int) -> Array:
        x, y = self.grid
        if self.other is None:
            return _pattern(*self.flow.origin(x, y, t), 0)
        total = np.zeros_like(x)
        shifts = (-1 / 3, 0.0, 1 / 3)  # the line crosses pixels
        for dx in shifts:
            left, right = (flow.origin(x + dx, y, t) for flow in (self.flow, self.other))
            total += np.where(left[0] < -0.5, _pattern(*left, 0), _pattern(*right, 1)) / len(shifts)
        return total


def _pattern(x: Array, y: Array, number: int) -> Array:
    """Grey values of the ``number``-th pattern: waves of equal contrast in every octave of wavelength."""
    rng = np.random.default_rng(number)
    wavelength = np.exp(rng.uniform(*np.log(WAVELENGTHS_PX), WAVES))
    direction, phase = rng.uniform(0.0, 2.0 * np.pi, (2, WAVES))
    total = np.zeros_like(x)
    for k, angle, shift in zip(2.0 * np.pi / wavelength, direction, phase, strict=True):
        total += np.cos(k * (np.cos(angle) * x + np.sin(angle) * y) + shift)
    return MEAN + CONTRAST * np.sqrt(2.0 / WAVES) * total


def measure(images: Array, **options: Any) -> Field:
    """The flow of the middle frame of grey values [t, y, x]; ``options`` of ``estimate``."""
    return estimate(capture_from_array(images[:, None, None]), **options)


def angular_errors(field: Field, truth: Array) -> Array:
    """Angular errors [y, x] in degrees; NaN where there is no value."""
    return aae(vectors(field, "flow", "xy"), truth[np.ix_(field.y, field.x)])
