"""Optical flow of image sequences and disparity of camera rows, dense, with standard errors.

Every pixel is followed through all images at once (``stages.follow``): the motion from its first guess on is fitted by
least squares in a window, constant or affine (Schuchert 2010, Eqs. (2.3), (2.6)), on images moved by it (Lucas & Kanade
1981), from coarse images to fine ones. Maps are finite everywhere: where there is no texture, values come from coarser
images and from around; windows are cut at the image border, and pixels that leave an image lose that image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from leafflow_ti.backend.boundary import ArrayError, opened
from leafflow_ti.config_sections import SIGMA_PER_SIZE
from leafflow_ti.errors import ConfigError

if TYPE_CHECKING:
    from leafflow_ti.stages.follow import Following

MOST_FRAMES = 15
"""Images of a longer sequence beyond the middle ones change little of the noise and raise the model's error."""
SIGMA = {"flow": 5.0, "flow-affine": 8.0, "disparity": 3.0, "depth": 3.0}
"""Gaussian window [px] by model."""


def optical_flow(
    frames: Any,
    *,
    model: str = "flow-affine",
    window: int | None = None,
    sigma: float | None = None,
    reference: int | None = None,
    steps: int = 4,
    levels: int | None = None,
    initial: Any = None,
    errors: bool = False,
    out: Any = None,
) -> Any:
    """Flow of a sequence of 2 or more grey images ``frames`` [t, y, x] at its reference frame.

    Returns the flow [2, y, x], x first, in px/frame: what is seen at (x, y) in the reference frame is at
    ``(x + u τ, y + v τ)`` τ frames later. With ``errors`` a pair of it and its standard error [2, y, x], from what the
    images differ by after they are moved; it holds for noise that differs between pixels, not for a flow that the
    model does not describe.

    ``model``: "flow" (constant) or "flow-affine" in a Gaussian window of ``sigma`` px, cut off at 3 sigmas, or at
    ``window`` (odd) px; of the two, one follows from the other as 19 from 65; 5 and 8 px without either.
    ``reference``: index of the frame that results belong to, the middle one by default (the first of two). Of more
    than 15 frames only the 15 around it are used. ``steps``: how often images are moved at full resolution;
    ``levels`` of halved resolution, by default until 16 pixels are left; ``initial``: flow [2, y, x] to begin with.
    ``out``: where the flow is written.

    Raises ArrayError for frames that are no such sequence, ConfigError for options out of range, DeviceError.
    """
    call = opened(frames, initial, out=out)
    images = call.read(frames)
    n = len(_images(images, "frames [t, y, x]"))
    at = _reference(reference, n, (n - 1) // 2)
    first = max(0, min(at - MOST_FRAMES // 2, n - MOST_FRAMES))
    images = images[first : first + MOST_FRAMES]
    begin = None if initial is None else call.read(initial)
    if begin is not None and begin.shape != (2, *images.shape[1:]):
        raise ArrayError(f"initial has the shape {begin.shape}, frames ask for {(2, *images.shape[1:])}")
    how = _fit(model, ("flow", "flow-affine"), 2, window, sigma, steps, levels)
    found, std = followed(call, images, at - first, how, errors, begin)
    flow = call.give(found)
    return (flow, call.give(std, own=True)) if errors else flow


def epi_disparity(
    views: Any,
    *,
    axis: str = "x",
    model: str = "depth",
    window: int | None = None,
    sigma: float | None = None,
    reference: int | None = None,
    steps: int = 3,
    levels: int | None = None,
    errors: bool = False,
    out: Any = None,
) -> Any:
    """Disparity of the views [s, y, x] of a row of equally spaced cameras: slopes in the epipolar plane images.

    Returns the disparity [y, x] in px/view at the reference view: what is seen there at x is at ``x + d k`` in the k-th
    view behind it (so d is negative for cameras that move along +x). With ``errors`` a pair of it and its standard
    error. ``axis``: "x", or "y" for a column of cameras.

    ``model``: "depth", disparity affine in a window (a slanted surface), or "disparity", constant. ``window``,
    ``sigma`` (default 3 px), ``reference`` (default: the middle view), ``steps``, ``levels``, ``out`` as in
    ``optical_flow``; all views are used.

    Raises ArrayError for views that are no such row, ConfigError for options out of range, DeviceError.
    """
    if axis not in ("x", "y"):
        raise ConfigError(f"axis is {axis!r}: it must be 'x' for a row of cameras, or 'y' for a column")
    call = opened(views, out=out)
    images = _images(call.read(views), "views [s, y, x]")
    at = _reference(reference, len(images), (len(images) - 1) // 2)
    how = _fit(model, ("disparity", "depth"), 1, window, sigma, steps, levels)
    turned = axis == "y"
    found, std = followed(call, images.transpose(0, 2, 1) if turned else images, at, how, errors, None)
    disparity = call.give(found[0].T if turned else found[0])
    if std is None:
        return disparity
    return disparity, call.give(std[0].T if turned else std[0], own=True)


def followed(call: Any, images: Any, reference: int, how: Following, errors: bool = False, initial: Any = None) -> Any:
    """Flow and standard errors as NumPy arrays."""
    from leafflow_ti.kernels.engine import quick_front_end
    from leafflow_ti.stages.follow import follow

    if not np.isfinite(images).all():
        bad = int(images.size - np.count_nonzero(np.isfinite(images)))
        raise ArrayError(f"{bad} grey values are not finite; replace them, e.g. by numpy.nan_to_num")
    with quick_front_end():
        return follow(call.device, images, np.arange(len(images)) - float(reference), how, errors, initial)


def _images(images: Any, wanted: str) -> Any:
    if images.ndim != 3 or len(images) < 2 or min(images.shape[1:]) < 3:
        raise ArrayError(f"the shape is {images.shape}; {wanted} needs 2 images or more of at least 3 x 3 pixels")
    return images


def _reference(reference: int | None, n: int, middle: int) -> int:
    if reference is None:
        return middle
    if not 0 <= reference < n:
        raise ConfigError(f"reference is {reference}: there are the images 0 to {n - 1}")
    return int(reference)


def _fit(
    model: str, models: tuple[str, ...], components: int, window: int | None, sigma: float | None, steps: int,
    levels: int | None,
) -> Following:  # fmt: skip
    """The window and steps that the options ask for."""
    from leafflow_ti.filters import gaussian_weights
    from leafflow_ti.stages.follow import Following, gaussian_window

    if model not in models:
        raise ConfigError(f"model is {model!r}: choose one of {', '.join(models)}")
    if window is not None and (window < 3 or window % 2 == 0):
        raise ConfigError(f"window is {window}: it must be an odd number of pixels from 3 on")
    if sigma is not None and not 0 < sigma <= 500:
        raise ConfigError(f"sigma is {sigma}: it must be above 0 and at most 500 px")
    if steps < 1:
        raise ConfigError(f"steps is {steps}: at least 1 is needed")
    if levels is not None and not 0 <= levels <= 20:
        raise ConfigError(f"levels is {levels}: it must be 0 to 20, or None for as many as the image allows")
    if window is None:
        weights = gaussian_window(SIGMA[model] if sigma is None else sigma)
    else:
        weights = tuple(gaussian_weights(window, sigma or window * SIGMA_PER_SIZE).tolist())
    return Following(components, model in ("flow-affine", "depth"), weights, steps, levels=levels)
