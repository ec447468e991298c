"""Batches of symmetric eigenproblems against NumPy's, and against what defines a solution."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from reference.eigen_cases import assert_solved, matrices

from leafflow_ti import backend
from leafflow_ti.backend.compat.skimage import feature
from leafflow_ti.errors import ConfigError
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
    some = matrices(n).astype(dtype) if n > 1 else np.array([[[2.0]], [[0.0]], [[-3.0]]], dtype)
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


def test_eigh_reads_the_lower_triangle() -> None:
    some = matrices(5).reshape(37, 1, 5, 5)
    values, vectors = backend.eigh(np.tril(some) + np.triu(np.full((5, 5), 7.0), 1))
    assert_solved(some, values, vectors, BOUND[np.float64])
    np.testing.assert_array_equal(backend.eigh(some, k=2, eigenvectors=False), values[..., :2])


def test_null_space_of_what_has_one() -> None:
    columns = np.random.default_rng(3).normal(size=(6, 20, 9))
    columns[:, :, 7:] = columns[:, :, :2] - columns[:, :, 2:4]
    found = backend.null_space(np.swapaxes(columns, 1, 2) @ columns, 2)
    assert np.abs(columns @ found.vectors).max() < 1e-12
    assert np.abs(found.values).max() < 1e-12
    assert (found.gap > 0.1).all()
    assert np.isinf(backend.null_space(np.eye(2), 2).gap)


def fields(size: int) -> NDArray[Any]:
    """Tensors of random columns [size, 7, 5], positive definite, packed as the package structure-tensor has them."""
    n = {3: 2, 6: 3}[size]
    columns = np.random.default_rng(n).normal(size=(n, 4, 7, 5))
    pairs = [(r, r) for r in range(n)] + list(itertools.combinations(range(n), 2))
    return np.array([(columns[r] * columns[c]).sum(axis=0) for r, c in pairs])


def test_eig_special_2d_is_the_package_s() -> None:
    peer = pytest.importorskip("structure_tensor")
    S = fields(3)
    S[2, 0], S[0, 0, 0] = 0, 9  # diagonal ones
    values, vectors = peer.eig_special_2d(S)
    found = backend.eig_special_2d(S)
    np.testing.assert_allclose(found[0], values, atol=1e-12)
    np.testing.assert_allclose(found[1], vectors, atol=1e-10)
    both = backend.eig_special_2d(S, full=True)[1]
    np.testing.assert_array_equal(both[0], found[1])
    np.testing.assert_allclose((both[0] * both[1]).sum(axis=0), 0, atol=1e-12)
    np.testing.assert_array_equal(backend.eigenvalues_2d(S), found[0])


@pytest.mark.parametrize("order", ["desc", "asc"])
@pytest.mark.parametrize("full", [False, True])
def test_eig_special_3d_is_the_package_s(full: bool, order: Any) -> None:
    peer = pytest.importorskip("structure_tensor")
    S = fields(6)
    found = backend.eig_special_3d(S, full, order)
    for one, other in zip(found, peer.eig_special_3d(S, full, order), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
    np.testing.assert_array_equal(backend.eigenvalues_3d(S, order), found[0])


def test_eigenvalues_as_scikit_image_has_them() -> None:
    theirs = pytest.importorskip("skimage.feature")
    elements = list(np.random.default_rng(4).normal(size=(6, 4, 5, 3)))
    wanted = theirs.hessian_matrix_eigvals(elements)
    np.testing.assert_allclose(feature.hessian_matrix_eigvals(elements), wanted, atol=1e-12)
    np.testing.assert_allclose(
        feature.structure_tensor_eigenvalues([e[0] for e in elements[:3]]),
        theirs.structure_tensor_eigenvalues([e[0] for e in elements[:3]]),
        atol=1e-12,
    )
    with pytest.raises(backend.ArrayError, match="4 arrays were given"):
        feature.hessian_matrix_eigvals(elements[:4])


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: backend.eigh(np.zeros((2, 3))), ValueError, "shape"),
        (lambda: backend.eigh(np.zeros((33, 33))), backend.ArrayError, "1 to 32"),
        (lambda: backend.eigh(np.eye(3), k=4), ConfigError, "k is 4"),
        (lambda: backend.eigh(np.eye(3), method="qr"), ConfigError, "method is 'qr'"),
        (lambda: backend.null_space(np.eye(3), 0), ConfigError, "k is 0"),
        (lambda: backend.eigh(np.eye(3, dtype=complex)), TypeError, "complex128"),
        (lambda: backend.eig_special_3d(np.zeros((5, 2))), backend.ArrayError, r"\[6, ...\]"),
        (lambda: backend.eigenvalues_3d(np.zeros((6, 2)), "up"), ConfigError, "desc and asc"),
    ],
)
def test_errors_say_what_is_allowed(call: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        call()


def assert_planes_are_solved(n: int, count: int, dtype: type) -> None:
    """Random, indefinite, repeated, singular, zero and diagonal tensors, large and small, as planes."""
    random = np.random.default_rng(5)
    some = random.standard_normal((count, n, n))
    some = some + some.swapaxes(1, 2)
    special = [np.eye(n), np.zeros((n, n)), np.ones((n, n)), np.diag(np.arange(n) - 1.0), np.eye(n) + 1e-7 * some[0]]
    some[: len(special)] = special[:count]
    some *= 10.0 ** random.integers(-12, 12, count)[:, None, None]
    some = some.astype(dtype)
    pairs = [(i, i) for i in range(n)] + list(itertools.combinations(range(n), 2))
    planes = np.stack([some[:, i, j] for i, j in pairs])
    values, vectors = (backend.eig_special_2d if n == 2 else backend.eig_special_3d)(planes, full=True)
    values, vectors = values.T, vectors.transpose(2, 1, 0)
    if n == 3:  # descending
        values, vectors = values[:, ::-1], vectors[:, :, ::-1]
    assert_solved(some, values, vectors, BOUND[dtype])
    one = (backend.eig_special_2d if n == 2 else backend.eig_special_3d)(planes)[1]
    np.testing.assert_array_equal(one.T, vectors[:, :, 0])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize("count", [3, 16, 70])
def test_planes_of_tensors(count: int, n: int, dtype: type) -> None:
    assert_planes_are_solved(n, count, dtype)


def test_a_tensor_that_is_not_finite_spoils_no_other() -> None:
    planes = np.random.default_rng(6).standard_normal((6, 40))
    wanted = backend.eig_special_3d(planes)
    planes[3, 7], planes[0, 20] = np.nan, np.inf
    found = backend.eig_special_3d(planes)
    for one, other in zip(found, wanted, strict=True):
        assert np.isnan(one[:, [7, 20]]).all()
        np.testing.assert_array_equal(np.delete(one, [7, 20], axis=1), np.delete(other, [7, 20], axis=1))
