"""Dense flow with the signatures of OpenCV: ``calcOpticalFlowFarneback``, and an object with ``calc``.

The results are those of ``backend.optical_flow``, not of Farnebäck's polynomials or of OpenCV's inverse search: same
meaning, shape, type and units, other numbers, and the more exact ones.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from leafflow_ti.backend.boundary import ArrayError
from leafflow_ti.backend.flow import optical_flow
from leafflow_ti.errors import ConfigError

OPTFLOW_USE_INITIAL_FLOW = 4
OPTFLOW_FARNEBACK_GAUSSIAN = 256

SIGMA_PER_WINSIZE = 0.3
"""Gaussian window per window size: a square window of the same size has the standard deviation of 0.29."""


def calcOpticalFlowFarneback(
    prev: Any, next: Any, flow: Any, pyr_scale: float, levels: int, winsize: int, iterations: int,
    poly_n: int, poly_sigma: float, flags: int,
) -> Any:  # fmt: skip
    """Flow [y, x, 2] float32, x first, in px from ``prev`` [y, x] to ``next``; also written to ``flow`` if that is an
    array.

    ``winsize``: the flow is affine in a Gaussian window of 0.3 times as many pixels, whether or not ``flags`` has
    OPTFLOW_FARNEBACK_GAUSSIAN. ``levels`` of the pyramid, the images themselves included, whose coarsest is scaled by
    ``pyr_scale ** (levels - 1)``: as many halvings as come nearest to it. ``iterations`` at full resolution.
    ``flags`` with OPTFLOW_USE_INITIAL_FLOW: ``flow`` is where to begin. ``poly_n`` and ``poly_sigma`` belong to
    Farnebäck's expansion, which has no counterpart here: they have no effect.

    Raises ArrayError for arrays of other shapes, ConfigError for options out of range.
    """
    if not 0 < pyr_scale < 1 or levels < 1 or winsize < 1 or iterations < 1 or poly_n < 1:
        raise ConfigError(
            f"pyr_scale {pyr_scale}, levels {levels}, winsize {winsize}, iterations {iterations}, poly_n {poly_n}: "
            "pyr_scale must lie between 0 and 1, the others must be at least 1"
        )
    if flags & ~(OPTFLOW_USE_INITIAL_FLOW | OPTFLOW_FARNEBACK_GAUSSIAN):
        raise ConfigError(f"flags is {flags}: only OPTFLOW_USE_INITIAL_FLOW and OPTFLOW_FARNEBACK_GAUSSIAN exist")
    halvings = round((levels - 1) * math.log(pyr_scale) / math.log(0.5))
    sigma = max(SIGMA_PER_WINSIZE * winsize, 0.5)
    begin = flow if flags & OPTFLOW_USE_INITIAL_FLOW else None
    return _calc(prev, next, flow, begin, sigma=sigma, steps=iterations, levels=min(halvings, 20))


class DenseOpticalFlow:
    """What OpenCV's ``DISOpticalFlow_create`` and the like return; options are those of ``backend.optical_flow``:
    ``model``, ``window``, ``sigma``, ``steps``, ``levels``."""

    def __init__(self, **options: Any) -> None:
        self._options = options

    def calc(self, I0: Any, I1: Any, flow: Any = None) -> Any:
        """Flow [y, x, 2] float32, x first, in px from ``I0`` [y, x] to ``I1``; begins with ``flow`` where it is an
        array, and writes there."""
        return _calc(I0, I1, flow, flow, **self._options)

    def collectGarbage(self) -> None:
        """Nothing is kept between calls, so nothing is given back."""


def _calc(before: Any, behind: Any, flow: Any, initial: Any, **options: Any) -> Any:
    images = [np.asarray(image) for image in (before, behind)]
    if images[0].shape != images[1].shape or images[0].ndim != 2:
        raise ArrayError(f"the images have the shapes {images[0].shape} and {images[1].shape}: both must be [y, x]")
    shape = (*images[0].shape, 2)
    if flow is not None and (np.shape(flow) != shape or np.asarray(flow).dtype != np.float32):
        raise ArrayError(f"flow must be float32 of the shape {shape}, it has {np.shape(flow)}; or give None")
    begin = None if initial is None else np.asarray(initial).transpose(2, 0, 1)
    found = optical_flow(np.stack(images).astype(np.float32), initial=begin, **options)
    result = np.ascontiguousarray(found.transpose(1, 2, 0))
    if flow is None:
        return result
    flow[...] = result
    return flow
