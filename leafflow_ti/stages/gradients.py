"""Derivative images: every frame filtered along x and y, before any other filter (gradient constancy)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.range_flow import gradient_kernel
from leafflow_ti.runtime import Device
from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.planes import Filtering, round_up


class GradientStage:
    """Turns an image [rows + 2 radius, cols + 2 radius] into its derivatives [2, rows, cols] along x and y."""

    def __init__(self, device: Device, sampling: Sampling, rows: int, cols: int):
        self.device, self.rows, self.cols = device, rows, cols
        self.radius = max(sampling.x.filter_radius, sampling.y.filter_radius)
        self._in_pitch, self._pitch = round_up(cols + 2 * self.radius, 64), round_up(cols, 64)
        kernels = [gradient_kernel(sampling, axis) for axis in ("x", "y")]
        margin = [self.radius - n // 2 for n in kernels[0].shape]
        outputs = [
            [
                ((dy + margin[0]) * self._in_pitch + dx + margin[1], float(kernel[dy, dx]))
                for dy, dx in np.ndindex(*kernel.shape)
                if kernel[dy, dx]
            ]
            for kernel in kernels
        ]
        self._filtering = Filtering(device, outputs, rows, self._pitch, self._in_pitch)
        slack = (2 * self.radius + 1) * self._in_pitch
        self._source = device.array(np.zeros((rows + 2 * self.radius) * self._in_pitch + slack))
        self._result = device.empty(self._filtering.size)

    def __call__(self, image: NDArray[Any]) -> NDArray[Any]:
        """The derivative images, in the units of grey values per pixel."""
        padded = np.zeros((image.shape[0], self._in_pitch), self.device.real("storage"))
        padded[:, : image.shape[1]] = image
        self.device.write(self._source, 0, padded)
        self._filtering(self._source, self._result)
        planes = np.array(self.device.host(self._result)).reshape(2, self.rows, self._pitch)
        return planes[:, :, : self.cols]
