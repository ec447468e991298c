"""Batches of symmetric eigenproblems against NumPy's, and against what defines a solution."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from reference.eigen_cases import assert_solved, matrices

from leafflow_ti.runtime import Device, start
from leafflow_ti.stages import eigen
from leafflow_ti.stages.eigen import eigenproblems

BOUND = {np.float64: 1e-13, np.float32: 4e-6}
"""Rounding of about a hundred operations; in single precision that of the results, whose norm is up to 32 entries."""


def solved(
    device: Device, some: NDArray[Any], k: int, method: str = "ql", vectors: bool = True
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Values [count, k] and vectors [count, n, k] (zeros if not asked for), in the type of the matrices."""
    count, n = some.shape[:2]
    rows, cols = np.tril_indices(n)
    values, found = np.zeros((count, k), some.dtype), np.zeros((count, n, k), some.dtype)
    into = found.transpose(1, 2, 0) if vectors else None
    eigenproblems(some[:, rows, cols].T, n, device, values.T, into, method)
    return values, found


@pytest.fixture(scope="module")
def cpu() -> Device:
    return start("cpu")


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [1, 2, 3, 4, 9, 17, 32])
def test_whole_decompositions(cpu: Device, n: int, dtype: type) -> None:
    some = matrices(n)[:, :, :].astype(dtype) if n > 1 else np.array([[[2.0]], [[0.0]], [[-3.0]]], dtype)
    values, vectors = solved(cpu, some, n)
    assert_solved(some, values, vectors, BOUND[dtype])


@pytest.mark.parametrize("k", [1, 4])
def test_the_smallest_are_the_first_of_all(cpu: Device, k: int) -> None:
    some = matrices(9)
    every, all_vectors = solved(cpu, some, 9)
    values, vectors = solved(cpu, some, k)
    np.testing.assert_array_equal(values, every[:, :k])
    np.testing.assert_array_equal(vectors, all_vectors[:, :, :k])


def test_values_alone_are_the_same(cpu: Device) -> None:
    some = matrices(9)
    np.testing.assert_array_equal(solved(cpu, some, 9, vectors=False)[0], solved(cpu, some, 9)[0])


def test_jacobi_proves_it(cpu: Device) -> None:
    some = matrices(6)
    values, vectors = solved(cpu, some, 6, "jacobi")
    assert_solved(some, values, vectors, BOUND[np.float64])


def test_a_matrix_does_not_depend_on_its_neighbours(cpu: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    some = np.concatenate([matrices(5, seed) for seed in range(4)])
    values, vectors = solved(cpu, some, 5)
    order = np.random.default_rng(1).permutation(len(some))
    monkeypatch.setattr(eigen, "PORTION_BYTES", 1)  # portions of 64 matrices
    again = solved(cpu, some[order], 5)
    np.testing.assert_array_equal(again[0], values[order])
    np.testing.assert_array_equal(again[1], vectors[order])


@pytest.mark.parametrize("fault", [np.nan, np.inf])
def test_what_is_not_finite_is_nan_for_itself_alone(cpu: Device, fault: float) -> None:
    some = matrices(4)
    values, vectors = solved(cpu, some, 4)
    some[7, 2, 1] = fault
    faulty, turned = solved(cpu, some, 4)
    assert np.isnan(faulty[7]).all()
    assert np.isnan(turned[7]).all()
    others = np.arange(len(some)) != 7
    np.testing.assert_array_equal(faulty[others], values[others])
    np.testing.assert_array_equal(turned[others], vectors[others])


def test_no_matrices_have_no_results(cpu: Device) -> None:
    values, vectors = solved(cpu, np.zeros((0, 3, 3)), 2)
    assert values.shape == (0, 2)
    assert vectors.shape == (0, 3, 2)
