"""Prefilters of single images, before anything else (Schuchert 2010, Eq. (4.1), section 4.1).

    highpass      I - G * I                        removes slow additive changes of the light
    homomorphic   exp(log I - G * log I)           removes slow multiplicative ones; the result lies around 1

``G`` is a Gaussian of ``sigma`` pixels, cut off at four sigmas. At image borders and beside invalid pixels it is
normalised, ``(G * (I m)) / (G * m)`` with m = 1 at valid pixels and 0 elsewhere: nothing from outside leaks in, and a
pixel's value depends on the image only, never on the block in which it is read.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.filters import gaussian_radius, gaussian_weights
from leafflow_ti.runtime import Device
from leafflow_ti.stages.planes import Filtering, round_up

PREFILTERS: dict[str, tuple[Any, Any]] = {"highpass": (None, None), "homomorphic": (np.log, np.exp)}
"""What stands before and behind the highpass; on the host, for not every device has these functions in f64."""
ARRAYS = 6
"""Arrays of the size of one read image at most, beside one image of normalisation per camera."""


def prefilter_bytes(sigma: float, n_images: int, rows: int, cols: int, itemsize: int) -> int:
    """Memory that prefiltering blocks of [n_images, rows, cols] takes, wider blocks as read included."""
    radius = gaussian_radius(sigma)
    wide = (rows + 2 * radius) * round_up(cols + 2 * radius, 64)
    # Per image: the wide block and its validity (one byte), the result, the normalisation.
    return (ARRAYS * wide + n_images * (wide + 2 * rows * cols)) * itemsize + 2 * n_images * wide


class Prefilter:
    """Filters blocks [n_images, rows, cols] of one size, image by image.

    Called with a block that is ``radius`` pixels wider on every side, and the validity of each of its pixels (both
    [n_images, rows + 2 radius, cols + 2 radius]); returns the filtered block, 0 where a pixel is not valid.
    ``homomorphic`` needs positive grey values at all valid pixels.
    """

    def __init__(self, device: Device, kind: str, sigma: float, rows: int, cols: int):
        self.device, self.shape = device, (rows, cols)
        self.before, self.behind = PREFILTERS[kind]
        self.radius = gaussian_radius(sigma)
        weights = gaussian_weights(2 * self.radius + 1, sigma).tolist()
        self._wide = (rows + 2 * self.radius, round_up(cols + 2 * self.radius, 64))
        pitch = round_up(cols, 64)
        along_y = [(r * self._wide[1], w) for r, w in enumerate(weights)]
        self._along_y = Filtering(device, [along_y], rows, self._wide[1], self._wide[1])
        self._along_x = Filtering(device, [list(enumerate(weights))], rows, pitch, self._wide[1])
        # What lies behind a row's last pixel is read for pixels that nobody looks at.
        self._image = device.empty(self._wide[0] * self._wide[1])
        self._tall = device.empty(self._along_y.size + 2 * self.radius + pitch)
        self._smooth = device.empty(self._along_x.size)
        self._valid: NDArray[np.bool_] | None = None
        self._norm: list[NDArray[Any]] = []

    def __call__(self, block: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[Any]:
        """The filtered block [n_images, rows, cols], of the type of ``block``."""
        if self._valid is None or not np.array_equal(self._valid, valid):
            self._valid = valid
            self._norm = [self._gaussian(mask.astype(block.dtype)) for mask in valid]
        inner = (slice(self.radius, self.radius + self.shape[0]), slice(self.radius, self.radius + self.shape[1]))
        out = np.zeros((len(block), *self.shape), block.dtype)
        for image, mask, norm, result in zip(block, valid, self._norm, out, strict=True):
            values = np.where(mask, image, 1 if self.before else 0)  # log 1 = 0
            if self.before:
                values = self.before(values)
            seen = mask[inner]
            mean = np.divide(self._gaussian(values), norm, out=np.zeros_like(norm), where=seen)
            high = values[inner] - mean
            np.copyto(result, self.behind(high) if self.behind else high, where=seen)
        return out

    def _gaussian(self, values: NDArray[Any]) -> NDArray[Any]:
        """``G *`` one image without its margin, [rows, cols]."""
        padded = np.zeros(self._wide, values.dtype)
        padded[:, : values.shape[1]] = values
        self.device.write(self._image, 0, padded)
        self._along_y(self._image, self._tall)
        self._along_x(self._tall, self._smooth)
        rows, cols = self.shape
        smooth: NDArray[Any] = self.device.host(self._smooth)[: self._along_x.size].reshape(rows, -1)[:, :cols]
        return smooth.copy()
