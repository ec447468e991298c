"""Functions of ``skimage.feature`` on the kernels of this package."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.backend.boundary import ArrayError, Call, opened
from leafflow_ti.backend.filters import check_border, checked, gaussian_steps, passes, per_axis
from leafflow_ti.errors import ConfigError


def structure_tensor_eigenvalues(A_elems: Sequence[Any]) -> Any:
    """Eigenvalues [n, ...], descending, from the upper triangle of a tensor field by rows: n (n + 1) / 2 arrays of one
    shape. Raises ArrayError for another number of arrays, or arrays of several shapes."""
    from leafflow_ti.stages.eigen import eigenproblems

    call = opened(*A_elems)
    fields = [call.read(field) for field in A_elems]
    n = int((8 * len(fields) + 1) ** 0.5 - 1) // 2
    if n * (n + 1) // 2 != len(fields) or len({field.shape for field in fields}) != 1:
        raise ArrayError(f"{len(fields)} arrays were given: it must be 3, 6, 10, ... of one shape, an upper triangle")
    place = {pair: at for at, pair in enumerate(zip(*np.triu_indices(n), strict=True))}
    rows, cols = np.tril_indices(n)
    packed = np.stack([fields[place[c, r]].ravel() for r, c in zip(rows, cols, strict=True)])
    values = np.empty((n, packed.shape[1]), call.dtype)
    eigenproblems(packed, n, call.device, values)
    return call.give(values[::-1].reshape(n, *fields[0].shape))


def hessian_matrix_eigvals(H_elems: Sequence[Any]) -> Any:
    """Eigenvalues [n, ...], descending, of Hessians: as ``structure_tensor_eigenvalues``."""
    return structure_tensor_eigenvalues(H_elems)


def structure_tensor(
    image: Any, sigma: float | Sequence[float] = 1, mode: str = "constant", cval: float = 0, order: str = "rc"
) -> list[Any]:
    """Upper triangle by rows of the structure tensors of an ``image`` with 1 to 5 axes, a list of arrays: products of
    Sobel derivatives in a Gaussian window of ``sigma`` px, one number or one per axis.

    ``mode``, ``cval``: what lies beyond the border. ``order``: of the axes, "rc" from the first on, or for images
    [rows, cols] "xy" from the last on. Integer images are scaled to 0..1 or -1..1, as scikit-image does.
    For derivatives with a smaller error of direction see ``backend.structure_tensor_2d(derivatives="5")``.

    Raises ArrayError for another number of axes, ConfigError for options out of range.
    """
    call, source = _image(image, order)
    check_border(mode, 1.0)
    sobel = {True: np.array([-1.0, 0.0, 1.0]), False: np.array([1.0, 2.0, 1.0])}
    run, axes = passes(call, mode, cval), list(range(source.ndim))
    slopes = [np.empty_like(source) for _ in axes]
    for along, slope in zip(axes, slopes, strict=True):
        # The derivative comes first, which only the constant beyond the border can tell.
        ordered = [along, *(axis for axis in axes if axis != along)]
        run(source, [(axis, sobel[axis == along]) for axis in ordered], slope)
    if order == "xy":
        slopes.reverse()
    window = _window(sigma, source.ndim)
    found = []
    for one, two in combinations_with_replacement(slopes, 2):
        found.append(np.empty_like(source))
        run(one * two, window, found[-1])
    return [call.give(part) for part in found]


def hessian_matrix(
    image: Any,
    sigma: float | Sequence[float] = 1,
    mode: str = "constant",
    cval: float = 0,
    order: str = "rc",
    use_gaussian_derivatives: bool | None = None,
) -> list[Any]:
    """Upper triangle by rows of the Hessians of an ``image`` with 2 to 5 axes, a list of arrays.

    With ``use_gaussian_derivatives`` by derivatives of a Gaussian of ``sigma`` px, first along one axis and then along
    the other, else (None too, without the warning of scikit-image) by differences of neighbours in the image under
    that Gaussian. The other options are those of ``structure_tensor``.

    Raises ArrayError for another number of axes, ConfigError for options out of range.
    """
    call, source = _image(image, order)
    check_border(mode, 1.0)
    run, axes = passes(call, mode, cval), list(range(source.ndim))
    sigmas = per_axis("sigma", sigma, source.ndim, 0.0)
    pairs = list(combinations_with_replacement(axes if order == "rc" else axes[::-1], 2))
    if not use_gaussian_derivatives:
        if min(source.shape) < 2:
            raise ArrayError(
                f"the image has the shape {source.shape}: differences need 2 samples or more along each axis"
            )
        smooth = np.empty_like(source)
        run(source, _window(sigma, source.ndim), smooth)
        return [call.give(np.gradient(np.gradient(smooth, axis=one), axis=two)) for one, two in pairs]
    narrow, truncate = [s / math.sqrt(2) for s in sigmas], 8.0 if all(s > 1 for s in sigmas) else 100.0

    def derived(values: NDArray[Any], along: int) -> NDArray[Any]:
        result = np.empty_like(values)
        run(values, gaussian_steps(axes, narrow, [int(axis == along) for axis in axes], truncate), result)
        return result

    slopes = [derived(source, along) for along in axes]
    return [call.give(derived(slopes[one], two)) for one, two in pairs]


def _image(image: Any, order: str) -> tuple[Call, NDArray[Any]]:
    """The image in floats, of integers the part of their range."""
    call = opened(image)
    kind = getattr(image, "dtype", None) if isinstance(image, np.ndarray | np.generic) else np.asarray(image).dtype
    source = checked(call, image)
    if order not in ("rc", "xy") or (order == "xy" and source.ndim > 2):
        raise ConfigError(f"order is '{order}': it must be 'rc', or 'xy' for images of 2 axes")
    if kind is not None and kind.kind in "iu":
        source = source / np.asarray(np.iinfo(kind).max, source.dtype)
    return call, source


def _window(sigma: float | Sequence[float], ndim: int) -> list[Any]:
    return gaussian_steps(list(range(ndim)), per_axis("sigma", sigma, ndim, 0.0), [0] * ndim, 4.0)
