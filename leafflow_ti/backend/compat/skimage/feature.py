"""Functions of ``skimage.feature`` on the kernels of this package."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from leafflow_ti.backend.boundary import ArrayError, opened


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
