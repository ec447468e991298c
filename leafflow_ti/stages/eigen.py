"""Batches of small symmetric eigenproblems on the device: packed, in portions, and solved for."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.runtime import Device

PORTION_BYTES = 1 << 24
"""Of packed matrices: what is worked on at once, so that memory stays bounded."""


def eigenproblems(
    packed: NDArray[Any],
    n: int,
    device: Device,
    values: NDArray[Any],
    vectors: NDArray[Any] | None = None,
    method: str = "ql",
) -> None:
    """The k smallest eigenvalues into ``values`` [k, count], ascending, and unit eigenvectors into ``vectors``
    [n, k, count], of packed matrices [n (n + 1) / 2, count] (lower triangle by rows).

    The results may have any strides. A matrix with an entry that is not finite has NaN as results.
    """
    size, count = packed.shape
    portion = max(1, PORTION_BYTES // (8 * size * 64)) * 64
    for begin in range(0, count, portion):
        part = slice(begin, min(count, begin + portion))
        _portion(packed[:, part], n, device, values[:, part], None if vectors is None else vectors[..., part], method)


def _portion(
    packed: NDArray[Any],
    n: int,
    device: Device,
    values: NDArray[Any],
    vectors: NDArray[Any] | None,
    method: str,
) -> None:
    from leafflow_ti.kernels.eigen import eigen_kernel, room_of

    spec, (size, count), k = device.dense, packed.shape, len(values)
    lanes = spec.lanes
    groups = -(-count // lanes)
    n_tasks = device.tasks(groups)
    scale = np.abs(packed).max(axis=0).astype(np.float64)
    usable = np.isfinite(scale)
    divisor = np.where(usable & (scale > 0), scale, 1.0)
    scaled = np.zeros((size, groups * lanes), device.real("algebra"))
    np.divide(packed, divisor, out=scaled[:, :count], casting="same_kind")
    scaled[:, :count][:, ~usable] = 0

    found = device.empty(groups * lanes * k, "algebra")
    turned = device.empty(lanes if vectors is None else groups * lanes * n * k, "algebra")
    work = device.empty(lanes * room_of(n) * (groups if device.gpu else n_tasks), "algebra")
    arrays = (device.array(_in_groups(scaled, device, lanes), "algebra"), work, found, turned)
    vectors_wanted = int(vectors is not None)
    eigen_kernel(spec, method == "jacobi")(
        n, k, vectors_wanted, room_of(n), groups, n_tasks, *(device.vectors(array, lanes) for array in arrays)
    )
    device.synchronize()
    _spread(found, values, device, lanes, groups)
    with np.errstate(over="ignore"):  # a result beyond the type's range is infinite, as in other programs
        values *= divisor
    values[:, ~usable] = np.nan
    if vectors is not None:
        _spread(turned, vectors, device, lanes, groups)
        vectors[..., ~usable] = np.nan


def _in_groups(array: NDArray[Any], device: Device, lanes: int) -> NDArray[Any]:
    """Host planes [rows, count] in the order of the device: by groups, on a GPU by rows."""
    return array if device.gpu else array.reshape(len(array), -1, lanes).transpose(1, 0, 2)


def _spread(source: Any, target: NDArray[Any], device: Device, lanes: int, groups: int) -> None:
    """Planes [..., count] from what a kernel has written by groups, without a copy in between."""
    host, rows, count = device.host(source), target.shape[:-1], target.shape[-1]
    if device.gpu:
        target[...] = host.reshape(*rows, groups)
        return
    by_groups = np.moveaxis(host.reshape(groups, *rows, lanes), 0, -2)
    whole = count // lanes
    # Splitting the last axis makes a view, whatever its stride.
    target[..., : whole * lanes].reshape(*rows, whole, lanes)[...] = by_groups[..., :whole, :]
    if whole < groups:
        target[..., whole * lanes :] = by_groups[..., whole, : count - whole * lanes]


def eigen_of_planes(
    planes: NDArray[Any], n: int, device: Device, wanted: int, descending: bool
) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Eigenvalues [n, count] of symmetric matrices of ``n`` = 2 or 3 rows, and the ``wanted`` = 0, 1 (the smallest's)
    or n eigenvectors [wanted, n, count] in their order, from contiguous planes ``(xx, yy, xy)`` or
    ``(xx, yy, zz, xy, xz, yz)`` of the storage's type. What is not finite has NaN as results."""
    from leafflow_ti.kernels.eigen_planes import eigen_planes_kernel

    spec, count = device.moments, planes.shape[1]
    real = device.real("storage")
    broken = None
    with np.errstate(over="ignore", invalid="ignore"):
        if not np.isfinite(planes.sum()):  # of finite numbers, too, but then nothing is lost
            broken = ~np.isfinite(planes).all(axis=0)
    wide = max(count, spec.lanes)
    if broken is not None or wide > count:
        padded = np.zeros((len(planes), wide), real)
        padded[:, :count] = planes if broken is None else np.where(broken, 0, planes)
        planes = padded
    values = np.empty((n, wide), real)
    vectors = np.empty((wanted, n, wide) if wanted else (1,), real)
    if device.gpu:
        found = device.empty(values.size), device.empty(vectors.size)
        eigen_planes_kernel(spec, n, wanted)(wide, int(descending), 1, device.array(planes), *found)
        values, vectors = (device.host(f).reshape(t.shape) for f, t in zip(found, (values, vectors), strict=True))
    else:
        tasks = device.tasks(-(-wide // spec.lanes))
        eigen_planes_kernel(spec, n, wanted)(
            wide, int(descending), tasks, *(array.reshape(-1) for array in (planes, values, vectors))
        )
    values, turned = values[:, :count], vectors[..., :count] if wanted else None
    if broken is not None:
        values[:, broken] = np.nan
        if turned is not None:
            turned[..., broken] = np.nan
    return values, turned
