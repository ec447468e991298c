"""``skimage.registration.optical_flow_ilk`` by the kernels of this package: ``from leafflow_ti.backend.compat.skimage
import registration``."""

from __future__ import annotations

from typing import Any

import numpy as np

from leafflow_ti.backend.boundary import ArrayError, opened
from leafflow_ti.backend.flow import followed
from leafflow_ti.errors import ConfigError


def optical_flow_ilk(
    reference_image: Any,
    moving_image: Any,
    *,
    radius: int = 7,
    num_warp: int = 10,
    gaussian: bool = False,
    prefilter: bool = False,
    dtype: Any = np.float32,
    affine: bool = False,
) -> Any:
    """Displacement field [2, y, x] in px, rows first, from ``reference_image`` [y, x] to ``moving_image``: iterative
    Lucas-Kanade, coarse to fine. What is seen at (y, x) in the one is at ``(y + flow[0], x + flow[1])`` in the other.

    ``radius``: of the square window, or with ``gaussian`` a Gaussian of ``(2 radius + 1) / 4`` px; ``num_warp`` steps
    per resolution; ``prefilter``: a median of 3 x 3 pixels before each step; ``dtype``: float32 or float64, of the
    result. ``affine``, ours alone: flow that is affine in the window, not constant.

    Where it differs from scikit-image: images are cubic splines there, not linear ones; gradients are those of the mean
    of both images, by five taps; windows are cut at the border instead of mirrored; a pixel whose match lies outside
    of the moving image does not count; what has no texture keeps the flow of the coarser image instead of 0.

    Raises ArrayError for images that are not both [y, x] (volumes included), ConfigError for options out of range.
    """
    from leafflow_ti.filters import gaussian_radius, gaussian_weights
    from leafflow_ti.stages.follow import Following

    if radius < 1 or num_warp < 1:
        raise ConfigError(f"radius is {radius}, num_warp is {num_warp}: both must be at least 1")
    wanted = np.dtype(dtype)
    if wanted not in (np.dtype(np.float32), np.dtype(np.float64)):
        raise ConfigError(f"dtype is {wanted}: only float32 and float64 are computed in")
    shapes = tuple(tuple(image.shape) for image in (reference_image, moving_image))
    if shapes[0] != shapes[1] or len(shapes[0]) != 2 or min(shapes[0]) < 3:
        raise ArrayError(
            f"the images have the shapes {shapes[0]} and {shapes[1]}: both must be [y, x] of at least 3 x 3 pixels; "
            "flow of volumes is not computed here"
        )
    call = opened(reference_image, moving_image, precision="f64" if wanted == np.float64 else "f32")
    images = np.stack([call.read(reference_image), call.read(moving_image)])
    size = 2 * radius + 1
    weights = gaussian_weights(2 * gaussian_radius(size / 4) + 1, size / 4) if gaussian else np.full(size, 1.0 / size)
    how = Following(2, affine, tuple(weights.tolist()), num_warp, num_warp, median=prefilter, same_window=True)
    found, _ = followed(call, images, 0, how)
    return call.give(np.ascontiguousarray(found[::-1]))
