"""Separable filters of arrays with 1 to 5 axes: Gaussians and their derivatives, moments, optimised derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.backend.boundary import ArrayError, Call, opened
from leafflow_ti.errors import ConfigError

MOST_AXES = 5
ODD_SETS = ("3", "5", "7", "9", "11")
"""Optimised filter sets with a sample at the middle."""


def gaussian(
    array: Any,
    sigma: float | Sequence[float],
    *,
    order: int | Sequence[int] = 0,
    axes: Sequence[int] | None = None,
    truncate: float = 4.0,
    mode: str = "nearest",
    cval: float = 0.0,
    out: Any = None,
) -> Any:
    """``array`` [1 to 5 axes] under a Gaussian of ``sigma`` samples, or its derivative of ``order``, along ``axes``
    (all by default); both one number or one per axis. An axis with sigma 0 is left alone.

    As ``scipy.ndimage.gaussian_filter``, in the precision of the array. ``truncate``: sigmas at which it is cut off.
    ``mode``: "nearest", "reflect", "mirror", "wrap", or "constant" with the value ``cval``.

    Raises ArrayError for other numbers of axes, ConfigError for options out of range.
    """
    call = opened(array, out=out)
    source = checked(call, array)
    chosen = checked_axes(axes, source.ndim)
    sigmas = per_axis("sigma", sigma, len(chosen), 0.0)
    orders = [int(k) for k in per_axis("order", order, len(chosen), 0.0)]
    check_border(mode, truncate)
    steps = gaussian_steps(chosen, sigmas, orders, truncate)
    result = call.result(source.shape)
    if np.may_share_memory(result, source):
        source = source.copy()
    passes(call, mode, cval)(source, steps, result)
    return call.give(result)


def gaussian_moments(
    array: Any,
    sigma: float | Sequence[float],
    powers: Sequence[Sequence[int]],
    *,
    axes: Sequence[int] | None = None,
    truncate: float = 4.0,
    mode: str = "nearest",
    cval: float = 0.0,
    out: Any = None,
) -> Any:
    """Moments ``Σ w(Δ) Δ^m p(x + Δ)`` of ``array`` [1 to 5 axes] in a Gaussian window, one for each m of ``powers``.

    ``powers``: for each moment one exponent per axis of ``axes`` (all by default), such as ``[(0, 0), (1, 0)]``.
    The weights along each axis have the sum 1 and end at ``truncate`` times ``sigma`` samples. Returns [len(powers),
    ...] in samples to the power of m. Borders as for ``gaussian``.

    Raises ArrayError for other numbers of axes, ConfigError for options out of range.
    """
    call = opened(array, out=out)
    source = checked(call, array)
    chosen = checked_axes(axes, source.ndim)
    sigmas = per_axis("sigma", sigma, len(chosen), 0.0)
    check_border(mode, truncate)
    wanted = [tuple(int(e) for e in moment) for moment in powers]
    if not wanted or any(len(moment) != len(chosen) or min(moment) < 0 for moment in wanted):
        raise ConfigError(f"powers is {list(powers)}: one exponent from 0 on is needed for each of {len(chosen)} axes")
    result = call.result((len(wanted), *source.shape))
    if np.may_share_memory(result, source):
        source = source.copy()
    run = passes(call, mode, cval)
    for moment, target in zip(wanted, result, strict=True):
        steps = []
        for axis, s, power in zip(chosen, sigmas, moment, strict=True):
            weights = gaussian_steps([axis], [s or 1e-9], [0], truncate)[0][1]
            steps.append((axis, weights * (np.arange(len(weights)) - len(weights) // 2.0) ** power))
        run(source, steps, target)
    return call.give(result)


def derivatives(
    array: Any,
    axes: Sequence[int] | None = None,
    taps: str | int = "5",
    *,
    mode: str = "nearest",
    cval: float = 0.0,
    out: Any = None,
) -> Any:
    """Derivatives of ``array`` [1 to 5 axes] along each of ``axes`` (all by default), per sample: [len(axes), ...].

    Optimised filter sets (Schuchert 2010, Table 2.1, renormalised): ``taps`` 3, 5, 7, 9 or 11 for the derivative along
    one of the axes, and for the smoothing along the others of ``axes`` that belongs to it. Axes that are not named are
    not touched. Borders as for ``gaussian``.

    Raises ArrayError for other numbers of axes, ConfigError for options out of range.
    """
    from leafflow_ti.filters import filter_set

    call = opened(array, out=out)
    source = checked(call, array)
    chosen = checked_axes(axes, source.ndim)
    if str(taps) not in ODD_SETS:
        raise ConfigError(f"taps is {taps}: choose one of {', '.join(ODD_SETS)}")
    check_border(mode, 1.0)
    filters = filter_set(str(taps))
    result = call.result((len(chosen), *source.shape))
    if np.may_share_memory(result, source):
        source = source.copy()
    run = passes(call, mode, cval)
    for along, target in zip(chosen, result, strict=True):
        run(source, [(axis, filters.kernel(axis == along)) for axis in chosen], target)
    return call.give(result)


def checked(call: Call, array: Any) -> NDArray[Any]:
    """The array that filters are applied to."""
    source = call.read(array)
    if not 1 <= source.ndim <= MOST_AXES:
        raise ArrayError(f"the array has the shape {source.shape}: it must have 1 to {MOST_AXES} axes")
    return source


def checked_axes(axes: Sequence[int] | None, ndim: int) -> list[int]:
    """Axes from 0 on, each once."""
    found = list(range(ndim)) if axes is None else [int(a) + ndim * (a < 0) for a in axes]
    if not found or len(set(found)) != len(found) or any(not 0 <= a < ndim for a in found):
        raise ConfigError(f"axes is {axes}: each must be one of the {ndim} axes, and none twice")
    return found


def per_axis(name: str, value: float | Sequence[float], n: int, least: float) -> list[float]:
    """One value for each of n axes."""
    values = [float(v) for v in np.atleast_1d(np.asarray(value, np.float64))]
    values = values * n if len(values) == 1 else values
    if len(values) != n or not all(least <= v < np.inf for v in values):
        raise ConfigError(f"{name} is {value}: it must be a number from {least:g} on, or {n} of them, one per axis")
    return values


def check_border(mode: str, truncate: float) -> None:
    """Raises ConfigError for modes that do not exist, or windows without a width."""
    from leafflow_ti.stages.separable import MODES

    if mode not in MODES:
        raise ConfigError(f"mode is '{mode}': choose one of {', '.join(MODES)}")
    if not 0 < truncate < np.inf:
        raise ConfigError(f"truncate is {truncate}: it must be above 0 sigmas")


def gaussian_steps(
    axes: Sequence[int], sigmas: Sequence[float], orders: Sequence[int], truncate: float
) -> list[tuple[int, NDArray[np.float64]]]:
    """What a Gaussian does axis by axis; without axes that have no width."""
    from leafflow_ti.stages.separable import gaussian_derivative

    every = zip(axes, sigmas, orders, strict=True)
    return [(axis, gaussian_derivative(s, k, truncate)) for axis, s, k in every if s > 1e-15]


def passes(call: Call, mode: str, cval: float) -> Any:
    """Runs lists of steps with this border."""
    from leafflow_ti.stages.separable import Passes

    return Passes(call.device, mode, float(cval))
