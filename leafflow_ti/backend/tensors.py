"""Structure tensors of images and volumes, and of any columns: windowed products of derivatives.

What is summed is the outer product of the columns of a local linear model (Schuchert 2010, Eq. (2.16)); its smallest
eigenvectors solve the model in the total least-squares sense.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.backend.boundary import ArrayError, Call, opened
from leafflow_ti.backend.filters import check_border, gaussian_steps, passes, per_axis
from leafflow_ti.errors import ConfigError

DERIVATIVES = ("gaussian", "3", "5", "7", "9", "11")
Steps = Sequence[tuple[int, Any]]


def structure_tensor_2d(
    image: Any,
    sigma: float,
    rho: float,
    out: Any = None,
    truncate: float = 4.0,
    *,
    derivatives: str = "gaussian",
    mode: str = "nearest",
) -> Any:
    """Structure tensors ``(xx, yy, xy)`` [3, rows, cols] of an image [rows, cols], where **x is the first axis**, as in
    the package structure-tensor.

    Derivatives of a Gaussian of ``sigma`` samples; with ``derivatives`` "3", "5", "7", "9" or "11" the optimised
    filters of so many taps instead, after a Gaussian of ``sigma`` (0: none), which have a smaller error of direction.
    Their products are smoothed by a Gaussian of ``rho``. Both end at ``truncate`` sigmas. ``mode``: what lies beyond
    the border, as for ``gaussian``. In float32, or in float64 where the image asks for it.

    Raises ArrayError for another number of axes or an ``out`` that does not fit, ConfigError for options out of range.
    """
    return _of_array(image, 2, sigma, rho, out, truncate, derivatives, mode)


def structure_tensor_3d(
    volume: Any,
    sigma: float,
    rho: float,
    out: Any = None,
    truncate: float = 4.0,
    *,
    derivatives: str = "gaussian",
    mode: str = "nearest",
) -> Any:
    """Structure tensors ``(xx, yy, zz, xy, xz, yz)`` [6, ...] of a volume [z, y, x]; options as for
    ``structure_tensor_2d``, but x is the **last** axis, as in the package structure-tensor.

    Beside the result three arrays of the volume's size are needed.
    Raises ArrayError for another number of axes or an ``out`` that does not fit, ConfigError for options out of range.
    """
    return _of_array(volume, 3, sigma, rho, out, truncate, derivatives, mode)


def structure_tensor(
    columns: Any,
    sigma: float | Sequence[float],
    *,
    truncate: float = 4.0,
    mode: str = "nearest",
    cval: float = 0.0,
    out: Any = None,
) -> Any:
    """Windowed products of n columns [n, ...] (1 to 5 axes behind the first): [n (n + 1) / 2, ...], the lower triangle
    by rows: ``Σ w(Δ) c_i c_j`` at ``i (i + 1) / 2 + j``.

    Columns are what a linear model multiplies its unknowns with, such as derivatives along x, y and t. The window is a
    Gaussian of ``sigma`` samples, one number or one per axis (0: none along that axis). Borders as for ``gaussian``.

    Raises ArrayError for other shapes, ConfigError for options out of range.
    """
    call = opened(columns, out=out)
    read = call.read(columns)
    if not 2 <= read.ndim <= 6 or len(read) == 0:
        raise ArrayError(f"columns have the shape {read.shape}: it must be [n, ...] with 1 to 5 axes behind the first")
    axes = range(read.ndim - 1)
    sigmas = per_axis("sigma", sigma, len(axes), 0.0)
    check_border(mode, truncate)
    steps = gaussian_steps(list(axes), sigmas, [0] * len(axes), truncate)
    result = call.result((len(read) * (len(read) + 1) // 2, *read.shape[1:]))
    if np.may_share_memory(result, read):
        read = read.copy()
    run, work = passes(call, mode, cval), (np.empty_like(read[0]), np.empty_like(read[0]))
    pairs = [(i, j) for i in range(len(read)) for j in range(i + 1)]
    for target, (i, j) in zip(result, pairs, strict=True):
        np.multiply(read[i], read[j], out=work[0])
        run(work[0], steps, target, *work)
    return call.give(result)


def _of_array(
    array: Any, ndim: int, sigma: float, rho: float, out: Any, truncate: float, derivatives: str, mode: str
) -> Any:
    call = opened(array, out=out)
    read = call.read(array)
    if read.ndim != ndim:
        raise ArrayError(f"the array has the shape {read.shape}: it must have {ndim} axes")
    if derivatives not in DERIVATIVES:
        raise ConfigError(f"derivatives is '{derivatives}': choose one of {', '.join(DERIVATIVES)}")
    noise, window = per_axis("sigma", sigma, 1, 0.0)[0], per_axis("rho", rho, 1, 0.0)[0]
    if derivatives == "gaussian" and noise == 0:
        raise ConfigError("sigma is 0: a Gaussian has a derivative from above 0 on; or choose derivatives='5'")
    check_border(mode, truncate)
    result = call.result((ndim * (ndim + 1) // 2, *read.shape))
    if np.may_share_memory(result, read):
        read = read.copy()
    slopes = _slopes(call, read, noise, truncate, derivatives, mode, (result[0], result[1]))
    if ndim == 3:
        slopes.reverse()  # x is the last axis
    axes = list(range(ndim))
    steps = gaussian_steps(axes, [window] * ndim, [0] * ndim, truncate)
    _windowed_products(call, slopes, steps, mode, result)
    return call.give(result)


def _slopes(
    call: Call, read: NDArray[Any], sigma: float, truncate: float, derivatives: str, mode: str, work: Any
) -> list[NDArray[Any]]:
    """Derivatives along each axis."""
    from leafflow_ti.filters import filter_set

    axes = list(range(read.ndim))
    run, found = passes(call, mode, 0.0), []
    for along in axes:
        steps: list[Any] = []
        if derivatives == "gaussian":
            steps = gaussian_steps(axes, [sigma] * len(axes), [int(axis == along) for axis in axes], truncate)
        else:
            filters = filter_set(derivatives)
            steps = gaussian_steps(axes, [sigma] * len(axes), [0] * len(axes), truncate)
            steps += [(axis, filters.kernel(axis == along)) for axis in axes]
        found.append(np.empty_like(read))
        run(read, steps, found[-1], *work)
    return found


def _windowed_products(call: Call, slopes: list[NDArray[Any]], steps: Steps, mode: str, result: NDArray[Any]) -> None:
    """The mixed products, then the squares, each in the window. Work arrays are those of the result that come last,
    then slopes that nobody needs any more."""
    n, run = len(slopes), passes(call, mode, 0.0)
    mixed = [pair for pair in combinations_with_replacement(range(n), 2) if pair[0] != pair[1]]
    for target, (i, j) in zip(result[n:], mixed, strict=True):
        np.multiply(slopes[i], slopes[j], out=result[0])
        run(result[0], steps, target, result[0], result[1])
    for i in reversed(range(n)):
        np.multiply(slopes[i], slopes[i], out=slopes[i])
        run(slopes[i], steps, result[i], slopes[i], slopes[i + 1] if i + 1 < n else result[0])
