"""Symmetric matrices that are hard for eigensolvers, and what every solution has to fulfil."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def matrices(n: int, seed: int = 0) -> NDArray[np.float64]:
    """Definite, indefinite, singular, diagonal, with repeated eigenvalues, zero, tiny and huge: [count, n, n]."""
    rng = np.random.default_rng(seed)
    factors = rng.normal(size=(37, n, n))
    many = factors @ factors.transpose(0, 2, 1)
    many[10:20] -= 2 * np.eye(n)
    turn = np.linalg.qr(rng.normal(size=(n, n)))[0]
    many[20] = turn @ np.diag(np.arange(n) // 2) @ turn.T
    many[21] = np.outer(turn[0], turn[0])
    many[22], many[23], many[24] = 0, np.eye(n), np.ones((n, n))
    many[25] = np.diag(np.arange(n) % 3)
    many[26] = np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1)
    many[27] = turn @ np.diag(10.0 ** -np.arange(n)) @ turn.T
    many[28] *= 1e-30
    many[29] *= 1e30
    return (many + many.transpose(0, 2, 1)) / 2


def assert_solved(matrices: NDArray[Any], values: NDArray[Any], vectors: NDArray[Any], bound: float) -> None:
    """Eigenvalues as NumPy's in double precision, small residuals, orthonormal vectors; errors against the largest
    entry of each matrix."""
    k = values.shape[-1]
    exact = matrices.astype(np.float64)
    size = np.maximum(np.abs(exact).max(axis=(-1, -2)), 1e-300)[..., None]
    truth = np.linalg.eigvalsh(exact)[..., :k]
    assert np.max(np.abs(values - truth) / size) < bound
    residual = exact @ vectors - vectors * values[..., None, :].astype(np.float64)
    assert np.max(np.abs(residual) / size[..., None]) < bound
    assert np.max(np.abs(np.swapaxes(vectors, -1, -2) @ vectors - np.eye(k))) < bound
