"""How noisy images are: the level that the configuration gives, or one estimated from an image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Capture
from leafflow_ti.config import RunConfig

Array = NDArray[np.float64]

DIGITS = 6
"""Of an estimated level: sums differ in their last bits from one machine to another, results shall not."""
LEAST_NOISE = 1e-6
"""Least noise of images that are not rounded, relative to their largest grey value."""
_MASK = np.array([1.0, -4.0, 6.0, -4.0, 1.0])
"""Fourth differences: the Laplacian once more, along each axis."""
_BLOCK = 16
"""Side of the blocks [px] that are judged one by one."""
_MOST_BLOCKS = 400
_MOST_FLAT = 0.2
"""Share of a block's differences that may vanish, because they are rounded off or saturated."""
_NORMAL_MEDIAN = 0.6745
"""Median of the size of a normal number of variance 1."""
_QUIET, _QUIET_SHARE = 0.25, 0.912
"""Which quantile of the blocks counts, and what it is of the true level in white noise (200 blocks, simulated)."""


def noise_level(capture: Capture, config: RunConfig) -> float:
    """Standard deviation of the noise of the images as the estimators take them, in their grey values.

    ``model.noise``, or "auto": that of the middle frame of the reference camera, wherever a run measures, so that
    results do not depend on the region. A highpass leaves the noise as it is but for its share under the Gaussian; a
    homomorphic prefilter makes it relative to the grey value, of which the median stands for all.
    """
    homomorphic = config.filters.prefilter == "homomorphic"
    given = config.model.noise
    if given != "auto" and not homomorphic:
        return float(given)
    image = capture.read(capture.n_frames // 2, *capture.reference, 0, capture.height, 0, capture.width, np.float64)
    noise = white_noise(image, capture.dtype.kind in "bui") if given == "auto" else float(given)
    if homomorphic and (image > 0).any():
        noise /= float(np.median(image[image > 0]))
    return float(f"{noise:.{DIGITS}g}")


def white_noise(image: NDArray[np.floating], rounded: bool) -> float:
    """Standard deviation of the white noise of an image [y, x], from fourth differences along both axes.

    What is smoother than some five pixels does not count. Fine texture does, but is seldom everywhere: the image is
    judged block by block, and the quietest quarter decides. Blocks where rounding or saturation hides the noise do not
    count, nor do values that are not finite. Images ``rounded`` to integers have at least the noise of that, others
    ``LEAST_NOISE`` of their largest value.
    """
    finite = np.isfinite(image)
    # No copy of the image: large ones are what the memory of making a plan goes to.
    largest = max(float(image.max(initial=0.0, where=finite)), -float(image.min(initial=0.0, where=finite)))
    least = 12**-0.5 if rounded else LEAST_NOISE * largest
    differences = _differences(_blocks(image))
    whole = np.isfinite(differences).all(axis=1)
    found = [*differences[whole], *(some[np.isfinite(some)] for some in differences[~whole])]
    levels = [_median(some) for some in found if some.size and np.count_nonzero(some) > (1 - _MOST_FLAT) * some.size]
    if not levels:
        return least or 1.0
    share = _QUIET_SHARE if len(levels) > 1 else 1.0
    sigma = float(np.quantile(levels, _QUIET)) / (_NORMAL_MEDIAN * float(np.sum(_MASK**2)))
    return max(sigma / share, least)


def _blocks(image: NDArray[np.floating]) -> Array:
    """Parts [n, y, x] of the image with ``_BLOCK`` x ``_BLOCK`` differences each, spread evenly if they are many."""
    need = _BLOCK + _MASK.size - 1
    if min(image.shape) < need:
        return np.asarray(image[None], np.float64)
    corners = [(y, x) for y in range(0, image.shape[0] - need + 1, _BLOCK)
               for x in range(0, image.shape[1] - need + 1, _BLOCK)]  # fmt: skip
    chosen = corners[:: -(-len(corners) // _MOST_BLOCKS)]
    return np.stack([np.asarray(image[y : y + need, x : x + need], np.float64) for y, x in chosen])


def _differences(blocks: Array) -> Array:
    """Sizes [n, differences] of the fourth differences along both axes of blocks [n, y, x]; none of a smaller block."""
    for _ in range(2):
        n = max(blocks.shape[1] - _MASK.size + 1, 0)
        total = np.zeros((len(blocks), n, blocks.shape[2]))
        for k, weight in enumerate(_MASK):
            with np.errstate(invalid="ignore"):  # infinite values, of which no difference counts
                total += weight * blocks[:, k : k + n]
        blocks = total.transpose(0, 2, 1)
    return np.abs(blocks.reshape(len(blocks), -1))


def _median(values: Array) -> float:
    """The median, without the checks that cost more than it."""
    half = values.size // 2
    return float(np.partition(values, half)[half])
