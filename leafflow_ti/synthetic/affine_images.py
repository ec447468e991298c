"""Images whose motion is affine and known exactly: a texture of waves, evaluated where each pixel comes from."""

from __future__ import annotations

import numpy as np

from leafflow_ti.synthetic.geometry import Array

GREYS = 255.0
WAVES, LONGEST, SHORTEST = 60, 42.0, 5.2
"""Waves of the texture, and their wavelengths [px]."""


def texture(x: Array, y: Array, seed: int = 0, mean: float = 128.0, deviation: float = 40.0) -> Array:
    """Grey values at (x, y) [px]: waves of random directions, phases and wavelengths from LONGEST to SHORTEST."""
    random = np.random.default_rng(seed)
    number = 2 * np.pi / random.uniform(SHORTEST, LONGEST, WAVES)
    angle, phase = random.uniform(0, 2 * np.pi, (2, WAVES))
    total = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
    for k, a, p in zip(number, angle, phase, strict=True):
        total += np.cos(k * (np.cos(a) * x + np.sin(a) * y) + p)
    return np.asarray(mean + deviation * np.sqrt(2 / WAVES) * total)


def affine_images(
    shape: tuple[int, int], levers: Array, flow: tuple[float, float], gradient: Array, noise: float = 0.0, seed: int = 0
) -> tuple[Array, Array]:
    """Images [k, y, x] in which what is at p in the reference is at ``p + lever_k u(p)``, and u [2, y, x] itself.

    ``flow`` (x, y) [px] in the middle of the image, ``gradient`` [2, 2] (row: component, column: along x, y).
    ``noise``: standard deviation, as a part of 255 grey values.
    """
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    place = np.stack([x - (shape[1] - 1) / 2, y - (shape[0] - 1) / 2])
    offset = np.array(flow)[:, None, None]
    images = []
    for lever in levers:
        back = np.linalg.inv(np.eye(2) + lever * np.asarray(gradient))
        source = np.einsum("ij,jyx->iyx", back, place - lever * offset)
        images.append(texture(source[0], source[1], seed))
    random = np.random.default_rng(seed + 1)
    noisy = np.stack(images) + random.normal(0.0, noise * GREYS, (len(images), *shape))
    return noisy, np.einsum("ij,jyx->iyx", np.asarray(gradient), place) + offset
