"""Eigenvalues and eigenvectors of batches of symmetric matrices, and of fields of structure tensors.

Batches of matrices by Householder reflections and implicit QL (Wilkinson and Reinsch 1971), one matrix per lane, in
double precision where the device has it; fields of 2 x 2 and 3 x 3 tensors by Jacobi's rotations in the precision of
the input. A matrix with an entry that is not finite gets NaN, and no other matrix does.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from leafflow_ti.backend.boundary import ArrayError, Call, opened
from leafflow_ti.errors import ConfigError

LARGEST = 32
"""Rows of a matrix at most: the work space of more would not fit the caches."""
METHODS = {"auto": "ql", "ql": "ql", "jacobi": "jacobi"}


class NullSpace(NamedTuple):
    """``vectors`` [..., n, k] to the ``values`` [..., k], the smallest, ascending; ``gap`` [...] from the last of them
    to the next eigenvalue, infinite for k = n: small against ``values`` or 0 where the space is not determined."""

    vectors: Any
    values: Any
    gap: Any


def eigh(matrices: Any, k: int | None = None, eigenvectors: bool = True, method: str = "auto") -> Any:
    """Eigenvalues [..., k], ascending, and unit eigenvectors [..., n, k] as columns, of real symmetric matrices
    [..., n, n], whose lower triangles are read; the values alone without ``eigenvectors``.

    ``k``: only so many, the smallest. ``method``: "ql" (which "auto" takes) or "jacobi", cyclic rotations.

    Raises ArrayError for other shapes or n > 32, ConfigError for another k or method.
    """
    call = opened(matrices)
    values, vectors = _solved(call, call.read(matrices), k, eigenvectors, method)
    return (call.give(values), call.give(vectors)) if eigenvectors else call.give(values)


def null_space(matrices: Any, k: int, method: str = "auto") -> NullSpace:
    """The eigenvectors to the k smallest eigenvalues of positive semidefinite matrices [..., n, n]: solutions of
    ``A v = 0`` in the total least-squares sense. ``method`` and errors as for ``eigh``."""
    call = opened(matrices)
    read = call.read(matrices)
    n = read.shape[-1] if read.ndim else 0
    _check_number(k, n)
    values, vectors = _solved(call, read, min(k + 1, n), True, method)
    gap = values[..., k] - values[..., k - 1] if k < n else np.full(values.shape[:-1], np.inf, call.dtype)
    return NullSpace(call.give(vectors[..., :k]), call.give(values[..., :k]), call.give(gap))


def eigenvalues_2d(S: Any) -> Any:
    """Eigenvalues [2, ...], ascending, of structure tensors ``(xx, yy, xy)`` [3, ...]."""
    return _of_fields(S, 2, 0, False)[0]


def eigenvalues_3d(S: Any, eigenvalue_order: Literal["desc", "asc"] = "desc") -> Any:
    """Eigenvalues [3, ...] of structure tensors ``(xx, yy, zz, xy, xz, yz)`` [6, ...]."""
    return _of_fields(S, 3, 0, _descending(eigenvalue_order))[0]


def eig_special_2d(S: Any, full: bool = False) -> tuple[Any, Any]:
    """Eigenvalues [2, ...], ascending, of structure tensors ``(xx, yy, xy)`` [3, ...], and the unit eigenvector
    [2, ...] of the smaller one; with ``full`` both, [2 vectors, 2 components, ...].

    The second component is positive, or the first where the second is 0.
    Raises ArrayError for another shape.
    """
    return _of_fields(S, 2, 2 if full else 1, False)


def eig_special_3d(S: Any, full: bool = False, eigenvalue_order: Literal["desc", "asc"] = "desc") -> tuple[Any, Any]:
    """Eigenvalues [3, ...] of structure tensors ``(xx, yy, zz, xy, xz, yz)`` [6, ...], and the unit eigenvector
    [3, ...] of the smallest; with ``full`` all three in the order of the values, [3 vectors, 3 components, ...].

    The product of a vector's components is not negative; where it is 0, the sum of the components is not.
    Raises ArrayError for another shape, ConfigError for another order.
    """
    return _of_fields(S, 3, 3 if full else 1, _descending(eigenvalue_order))


def _descending(order: str) -> bool:
    if order not in ("desc", "asc"):
        raise ConfigError(f"eigenvalue_order is '{order}': allowed are desc and asc")
    return order == "desc"


def _check_number(k: int, n: int) -> None:
    if not 1 <= k <= max(n, 1):
        raise ConfigError(f"k is {k}: it must be 1 to {n}, the rows of the matrices")


def _solved(call: Call, read: Any, k: int | None, vectors: bool, method: str) -> tuple[Any, Any]:
    if read.ndim < 2 or read.shape[-1] != read.shape[-2] or not 1 <= read.shape[-1] <= LARGEST:
        raise ArrayError(f"matrices have the shape {read.shape}: it must be [..., n, n] with n from 1 to {LARGEST}")
    if method not in METHODS:
        raise ConfigError(f"method is '{method}': allowed are {', '.join(METHODS)}")
    n = read.shape[-1]
    k = n if k is None else k
    _check_number(k, n)
    from leafflow_ti.stages.eigen import eigenproblems

    flat = read.reshape(-1, n, n)
    rows, cols = np.tril_indices(n)
    values = np.empty((len(flat), k), call.dtype)
    found = np.empty((len(flat), n, k), call.dtype) if vectors else None
    into = None if found is None else found.transpose(1, 2, 0)
    eigenproblems(flat[:, rows, cols].T, n, call.device, values.T, into, METHODS[method])
    batch = read.shape[:-2]
    return values.reshape(*batch, k), None if found is None else found.reshape(*batch, n, k)


def _of_fields(S: Any, n: int, wanted: int, descending: bool) -> tuple[Any, Any]:
    """Values [n, ...] and vectors of packed fields, by Jacobi's rotations."""
    from leafflow_ti.stages.eigen import eigen_of_planes

    call = opened(S)
    read = call.read(S)
    size = n * (n + 1) // 2
    if read.ndim < 1 or read.shape[0] != size:
        raise ArrayError(f"S has the shape {read.shape}: it must be [{size}, ...]")
    values, vectors = eigen_of_planes(read.reshape(size, -1), n, call.device, wanted, descending)
    shape = read.shape[1:]
    if vectors is None:
        return call.give(values.reshape(n, *shape)), None
    rows = (n,) if wanted == 1 else (n, n)
    return call.give(values.reshape(n, *shape)), call.give(vectors.reshape(*rows, *shape))
