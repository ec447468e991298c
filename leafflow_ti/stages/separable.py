"""Correlations along single axes of arrays on the device: borders, weights, and launches."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.runtime import Device

Array = NDArray[Any]
MODES = ("nearest", "reflect", "mirror", "wrap", "constant")
"""How an axis goes on beyond its ends, as SciPy names it: a a|a b c d|d d; b a|a b c d|d c; c b|a b c d|c b;
c d|a b c d|a b; k k|a b c d|k k."""


@functools.cache
def continued(n: int, before: int, behind: int, mode: str) -> tuple[int, ...]:
    """Index of the sample that stands at -before .. n - 1 + behind of an axis of ``n``; -1: the constant."""
    at = np.arange(-before, n + behind)
    if mode == "nearest":
        found = np.clip(at, 0, n - 1)
    elif mode == "wrap":
        found = at % n
    elif mode == "constant":
        found = np.where((at < 0) | (at >= n), -1, at)
    elif mode == "reflect" or n == 1:
        turned = at % (2 * n)
        found = np.minimum(turned, 2 * n - 1 - turned)
    else:
        turned = at % (2 * n - 2)
        found = np.minimum(turned, 2 * n - 2 - turned)
    return tuple(found.tolist())


def gaussian_derivative(sigma: float, order: int, truncate: float) -> Array:
    """Correlation weights of the ``order``-th derivative of a Gaussian that is cut off at ``truncate`` sigmas (the
    nearest whole sample) and of sum 1 before it is differentiated; float64."""
    radius = int(truncate * sigma + 0.5)
    x = np.arange(-radius, radius + 1, dtype=np.float64)
    weights = np.exp(-0.5 * (x / sigma) ** 2)
    weights /= weights.sum()
    # d/dx (q g) = (q' - x / sigma² q) g: the polynomial before the Gaussian; a correlation takes it at -x.
    polynomial = np.polynomial.Polynomial([1.0])
    for _ in range(order):
        polynomial = polynomial.deriv() - polynomial * np.polynomial.Polynomial([0.0, 1.0 / sigma**2])
    return np.asarray(weights * polynomial(-x))


def correlate_axis(
    device: Device, source: Array, target: Array, axis: int, weights: Sequence[float], mode: str, constant: float = 0.0
) -> None:
    """``target`` = ``source`` correlated along ``axis`` with an odd number of ``weights``; both C-contiguous, of one
    shape and the type of the device's storage, and not the same."""
    if source.size == 0:
        return
    from leafflow_ti.kernels.separable import correlate_lines_kernel, correlate_rows_kernel

    n, taps = source.shape[axis], len(weights)
    outer, inner = math.prod(source.shape[:axis]), math.prod(source.shape[axis + 1 :])
    tables = (
        device.array(continued(n, taps // 2, taps - 1 - taps // 2, mode), "int"), device.array(weights),
    )  # fmt: skip
    spec, flat = device.planes, (source.reshape(-1), target.reshape(-1))
    if device.gpu:
        found = device.empty(source.size)
        correlate_rows_kernel(spec)(outer, n, inner, taps, 1, constant, *tables, device.array(flat[0]), found)
        flat[1][:] = device.host(found)
    elif inner == 1:
        n_tasks = device.tasks(outer)
        length = max(n, spec.lanes) + taps - 1
        scratch = device.zeros(n_tasks * length)
        correlate_lines_kernel(spec)(
            outer, n, taps, n_tasks, length, constant, *tables, flat[0], scratch, flat[1]
        )  # fmt: skip
    else:
        correlate_rows_kernel(spec)(outer, n, inner, taps, device.tasks(outer * n), constant, *tables, *flat)


class Passes:
    """Correlations along one axis after the other, with two work arrays that all of them share."""

    def __init__(self, device: Device, mode: str, constant: float = 0.0):
        self.device, self.mode, self.constant = device, mode, constant

    def __call__(
        self, source: Array, steps: Sequence[tuple[int, Sequence[float]]], target: Array, *work: Array
    ) -> None:
        """``target`` = ``source`` after all ``steps`` (axis, weights). ``work``: two arrays that may be written, of
        which the first may be ``source`` itself; made here if they are needed and not given."""
        if not steps:
            np.copyto(target, source)
        at = source
        for number, (axis, weights) in enumerate(steps):
            if number == len(steps) - 1:
                into = target
            else:
                if not work:
                    work = (np.empty_like(source), np.empty_like(source))
                into = work[1] if np.may_share_memory(at, work[0]) else work[0]
            correlate_axis(self.device, at, into, axis, weights, self.mode, self.constant)
            at = into
