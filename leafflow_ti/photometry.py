"""What grey values say about a camera: saturation, pixels that do not work, how much texture there is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.matching import structure

Floats = NDArray[np.float64]

LEAST_IMAGES = 7
"""Images of one sensor from which a pixel that does not work can be told from the scene."""
SURE = 8.0
"""Standard errors by which such a pixel differs from its neighbours."""
MOST_DISPLACEMENT_ERROR = 0.02
"""Error by the noise [px], in the direction of least texture, of a displacement in a window with texture enough."""


@dataclass(frozen=True)
class Texture:
    """``share`` of the windows with texture in both directions; ``error_px``: median over windows of the error that the
    noise makes in a displacement; ``contrast``: standard deviation in windows; ``wavelength_px``: typical one."""

    window: int
    share: float
    error_px: float
    contrast: float
    wavelength_px: float


def saturated(image: Floats, largest: float) -> float:
    """Share of the pixels that hold the largest grey value there is."""
    return float(np.mean(image >= largest))


def texture_of(image: Floats, noise: float, window: int) -> Texture:
    """Texture of an image [H, W] in windows of ``window`` px, with the noise's own share taken out."""
    half = min(window, *(n - 2 for n in image.shape)) // 2
    known = np.isfinite(image)
    grey = np.where(known, image, float(np.mean(image[known])) if known.any() else 0.0)
    least = structure(grey, half)[half:-half, half:-half]
    samples = (2 * half + 1) ** 2
    # Half a difference of two pixels' noise, at two independent places: noise²/2 per axis.
    energy = np.maximum(least - samples * noise**2 / 2, 0.0)
    error = np.where(energy > 0, noise / np.sqrt(np.maximum(energy, 1e-300)), np.inf)
    gy, gx = np.gradient(grey)
    step = max(1, half)
    tiles = [
        grey[y : y + window, x : x + window]
        for y in range(0, grey.shape[0] - 2 * half, step)
        for x in range(0, grey.shape[1] - 2 * half, step)
    ]
    variance = max(float(np.median([np.var(tile) for tile in tiles])) - noise**2, 0.0)
    gradient = max(float(np.mean(gx**2 + gy**2)) - noise**2, 0.0)
    wavelength = 2 * np.pi * np.sqrt(variance / gradient) if gradient > 0 else np.inf
    share = float(np.mean(error < MOST_DISPLACEMENT_ERROR))
    return Texture(2 * half + 1, share, float(np.median(error)), variance**0.5, float(wavelength))


def defects(images: Sequence[Floats], noise: float) -> NDArray[np.intp]:
    """Rows and columns [n, 2] of pixels that differ from their neighbours in the same way in all images of a sensor.

    The scene must have moved over the sensor between the images: what stays is the sensor's. None of fewer than
    ``LEAST_IMAGES`` images.
    """
    if len(images) < LEAST_IMAGES:
        return np.empty((0, 2), np.intp)
    stack = np.stack([_against_neighbours(image) for image in images])
    middle = np.median(stack, axis=0)
    spread = 1.4826 * np.median(np.abs(stack - middle), axis=0)
    # Few images, many pixels: by chance the scatter of some looks small, that of all does not.
    spread = np.maximum(spread, max(float(np.median(spread)), noise))
    error = spread * np.sqrt(np.pi / 2 / len(images))
    return np.argwhere((np.abs(middle) > SURE * error) & (np.abs(middle) > SURE * noise))


def _against_neighbours(image: Floats) -> Floats:
    """Difference of every pixel from the mean of two opposite neighbours, the pair that it is nearest to.

    A line of the scene along the cameras' own would stay where it is; it agrees with the neighbours along it.
    """
    padded = np.pad(np.nan_to_num(image), 1, mode="reflect")
    rows, cols = image.shape

    def neighbour(j: int, i: int) -> Floats:
        return padded[1 + j : 1 + j + rows, 1 + i : 1 + i + cols]

    pairs = [
        neighbour(0, 0) - 0.5 * (neighbour(j, i) + neighbour(-j, -i)) for j, i in ((0, 1), (1, 0), (1, 1), (1, -1))
    ]
    nearest = np.argmin(np.abs(pairs), axis=0)
    return np.asarray(np.take_along_axis(np.stack(pairs), nearest[None], axis=0)[0])
