"""Filters against slow changes of the light, image by image (Schuchert 2010, Eq. (4.1))."""

from __future__ import annotations

from typing import Any

import numpy as np

from leafflow_ti.backend.boundary import ArrayError, opened
from leafflow_ti.backend.filters import per_axis
from leafflow_ti.errors import ConfigError


def highpass(images: Any, sigma: float, *, mask: Any = None, out: Any = None) -> Any:
    """``I - G * I`` of ``images`` [..., y, x], G a Gaussian of ``sigma`` px that ends at four sigmas: removes slow
    additive changes of the light.

    ``mask`` [y, x] or of the images' shape: True where pixels are valid; pixels that are not finite never are. G is
    normalised over valid pixels inside the image; the others are NaN in the result.
    Raises ArrayError for other shapes, ConfigError for a sigma that is not above 0.
    """
    return _filtered(images, "highpass", sigma, mask, out)


def homomorphic(images: Any, sigma: float, *, mask: Any = None, out: Any = None) -> Any:
    """``exp(log I - G * log I)`` of ``images`` [..., y, x]: removes slow multiplicative changes of the light; the
    result lies around 1. Grey values of valid pixels must be positive (ArrayError); otherwise as ``highpass``."""
    return _filtered(images, "homomorphic", sigma, mask, out)


def _filtered(images: Any, kind: str, sigma: float, mask: Any, out: Any) -> Any:
    from leafflow_ti.stages.prefilter import Prefilter

    call = opened(images, out=out)
    read = call.read(images)
    if read.ndim < 2 or 0 in read.shape:
        raise ArrayError(f"images have the shape {read.shape}: it must be [..., y, x] without empty axes")
    (width,) = per_axis("sigma", sigma, 1, 0.0)
    if width == 0:
        raise ConfigError("sigma is 0: it must be above 0 px")
    valid = np.isfinite(read)
    if mask is not None:
        chosen = np.asarray(mask)
        if chosen.dtype != bool or chosen.shape not in (read.shape, read.shape[-2:]):
            raise ArrayError(
                f"the mask is {chosen.dtype} of the shape {chosen.shape}: it must be bool of {read.shape[-2:]} or "
                f"{read.shape}"
            )
        valid &= chosen
    if kind == "homomorphic" and (read[valid] <= 0).any():
        least = float(read[valid].min())
        raise ArrayError(
            f"a grey value is {least:g}: homomorphic needs positive ones; mask the others, or use highpass"
        )
    result = call.result(read.shape)
    rows, cols = read.shape[-2:]
    prefilter = Prefilter(call.device, kind, width, rows, cols)
    margin = [(0, 0), *[(prefilter.radius, prefilter.radius)] * 2]
    every = zip(*(a.reshape(-1, 1, rows, cols) for a in (np.where(valid, read, 1), valid, result)), strict=True)
    for image, seen, target in every:
        target[:] = np.where(seen, prefilter(np.pad(image, margin), np.pad(seen, margin)), np.nan)
    return call.give(result)
