"""Filters and structure tensors of the backend beside SciPy, and beside the packages whose functions they stand for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from leafflow_ti import backend
from leafflow_ti.backend.compat import structure_tensor as ours
from leafflow_ti.backend.compat.skimage import feature
from leafflow_ti.backend.tensors import DERIVATIVES
from leafflow_ti.errors import ConfigError
from leafflow_ti.filters import filter_set
from leafflow_ti.stages.separable import MODES

SHAPES = [(150,), (70, 81), (1, 9), (5, 3), (9, 1), (20, 3, 70), (6, 7, 80), (3, 2, 4, 5, 6)]
TOLERANCE = {np.float32: 2e-6, np.float64: 1e-13}
"""Of the largest value, or of a tenth of the noise where derivatives vanish: some 50
roundings of 6e-8 and 1e-16, which partly cancel."""


def noise(shape: tuple[int, ...], dtype: Any = np.float64) -> np.ndarray:
    return np.random.default_rng(3).standard_normal(shape).astype(dtype)


def assert_near(found: Any, wanted: Any, dtype: Any, factor: float = 1.0) -> None:
    wanted = np.asarray(wanted)
    assert found.dtype == dtype
    assert found.shape == wanted.shape
    assert np.abs(found - wanted).max() <= factor * TOLERANCE[dtype] * max(np.abs(wanted).max(), 0.1)


def assert_gaussian_equals_scipy(shape: tuple[int, ...], dtype: Any, mode: str) -> None:
    array, orders = noise(shape, dtype), [k % 3 for k in range(len(shape))]
    found = backend.gaussian(array, 1.7, order=orders, mode=mode, cval=0.4)
    wanted = ndimage.gaussian_filter(array.astype(np.float64), 1.7, order=orders, mode=mode, cval=0.4)
    assert_near(found, wanted, dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("mode", MODES)
def test_gaussian_is_that_of_scipy(shape: tuple[int, ...], dtype: Any, mode: str) -> None:
    assert_gaussian_equals_scipy(shape, dtype, mode)


def test_gaussian_along_some_axes() -> None:
    array = noise((6, 20, 70))
    found = backend.gaussian(array, (2.0, 0.0), axes=(-1, 0), truncate=2.5)
    assert_near(found, ndimage.gaussian_filter1d(array, 2.0, axis=2, mode="nearest", truncate=2.5), np.float64)


def test_gaussian_into_its_own_input() -> None:
    array = noise((20, 30))
    wanted = backend.gaussian(array, 1.0)
    assert backend.gaussian(array, 1.0, out=array) is array
    np.testing.assert_array_equal(array, wanted)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_moments_are_weighted_sums(dtype: Any) -> None:
    array, powers = noise((21, 70), dtype), [(0, 0), (1, 0), (2, 1)]
    found = backend.gaussian_moments(array, 1.5, powers, truncate=2.0)
    offsets = np.arange(-3, 4)
    weights = np.exp(-0.5 * (offsets / 1.5) ** 2)
    weights /= weights.sum()
    for moment, part in zip(powers, found, strict=True):
        window = np.multiply.outer(weights * offsets ** moment[0], weights * offsets ** moment[1])
        assert_near(part, ndimage.correlate(array.astype(np.float64), window, mode="nearest"), dtype)


@pytest.mark.parametrize("taps", [3, "5", 7, 9, 11])
def test_derivatives_of_a_quadratic_are_exact(taps: int | str) -> None:
    """Filters are renormalised so that a ramp has its slope; away from the borders a parabola has, too."""
    z, y, x = np.mgrid[:12, :13, :14].astype(np.float64)
    found = backend.derivatives(0.5 * x**2 + 2.0 * x * y - 3.0 * z + 1.0, axes=(2, 1, 0), taps=taps)
    inner = (slice(None), *[slice(5, -5)] * 3)
    wanted = np.stack([x + 2.0 * y, 2.0 * x, np.full_like(x, -3.0)])
    np.testing.assert_allclose(found[inner], wanted[inner], atol=1e-7)


def test_derivatives_are_those_of_the_filter_set() -> None:
    array, filters = noise((3, 15, 70)), filter_set("5")
    found = backend.derivatives(array, axes=(1, 2), mode="reflect")
    for along, part in zip((1, 2), found, strict=True):
        wanted = array
        for axis in (1, 2):
            wanted = ndimage.correlate1d(wanted, np.array(filters.kernel(axis == along)), axis=axis, mode="reflect")
        assert_near(part, wanted, np.float64)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(70, 81), (9, 130), (1, 5), (12, 13, 70), (7, 6, 5), (3, 1, 9)], ids=str)
def test_structure_tensors_are_those_of_the_package(shape: tuple[int, ...], dtype: Any) -> None:
    package = pytest.importorskip("structure_tensor")
    name = f"structure_tensor_{len(shape)}d"
    array = noise(shape, dtype)
    wanted = getattr(package, name)(array.astype(np.float64), 1.0, 2.3, truncate=3.0)
    assert_near(getattr(ours, name)(array, 1.0, 2.3, truncate=3.0), wanted, dtype, 5)
    out = np.empty((2 * len(wanted), *shape), dtype)[::2]
    assert getattr(ours, name)(array, 1.0, 2.3, out, 3.0) is out
    assert_near(out, wanted, dtype, 5)


@pytest.mark.parametrize("derivatives", DERIVATIVES[1:])
def test_optimised_derivatives_find_the_direction_of_a_wave(derivatives: str) -> None:
    """Of 6 px wave length, direction (cos 33°, sin 33°) of (row, column). The error of the derivative of a Gaussian of
    1 px, sampled, is the bound for all filters but those of three taps."""
    rows, cols = np.mgrid[:64, :64].astype(np.float64)
    angle = np.deg2rad(33.0)
    image = np.sin(2 * np.pi / 6.0 * (np.cos(angle) * rows + np.sin(angle) * cols))

    def error(**options: Any) -> float:
        tensor = backend.structure_tensor_2d(image, rho=4.0, **options)[:, 20:-20, 20:-20]
        _, along = backend.eig_special_2d(tensor)  # along the crests
        return float(np.rad2deg(np.arcsin(np.abs(along[0] * np.cos(angle) + along[1] * np.sin(angle)).max())))

    assert error(sigma=0.0, derivatives=derivatives) < (0.5 if derivatives == "3" else 0.05)


def test_structure_tensor_of_columns_is_that_of_its_derivatives() -> None:
    image = noise((40, 70))
    columns = np.stack([ndimage.gaussian_filter(image, 1.0, order=o, mode="nearest") for o in ((1, 0), (0, 1))])
    found = backend.structure_tensor(columns, 2.0)
    xx, yy, xy = backend.structure_tensor_2d(image, 1.0, 2.0)
    assert_near(found, np.stack([xx, xy, yy]), np.float64)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8, np.int16])
@pytest.mark.parametrize("order", ["rc", "xy"])
@pytest.mark.parametrize("mode", MODES)
def test_functions_of_scikit_image(mode: str, order: str, dtype: Any) -> None:
    peer = pytest.importorskip("skimage.feature")
    array = (90.0 * noise((31, 70))).clip(-120, 120)
    array = (np.abs(array) if dtype == np.uint8 else array).astype(dtype)
    kind = np.float64 if dtype == np.float64 else np.float32
    exact = array.astype(np.float64) / (np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1)
    options = {"mode": mode, "cval": 0.3, "order": order}
    wanted = peer.structure_tensor(exact, (1.5, 2.0), **options)
    assert_near(np.stack(feature.structure_tensor(array, (1.5, 2.0), **options)), wanted, kind, 5)
    for way in (False, True):
        wanted = peer.hessian_matrix(exact, 1.5, use_gaussian_derivatives=way, **options)
        found = np.stack(feature.hessian_matrix(array, 1.5, use_gaussian_derivatives=way, **options))
        assert_near(found, wanted, kind, 20)  # differences of what is nearly equal


def test_functions_of_scikit_image_on_volumes() -> None:
    peer = pytest.importorskip("skimage.feature")
    volume = noise((9, 10, 70))
    assert_near(np.stack(feature.structure_tensor(volume)), peer.structure_tensor(volume), np.float64, 5)
    wanted = peer.hessian_matrix(volume, use_gaussian_derivatives=False)
    assert_near(np.stack(feature.hessian_matrix(volume)), wanted, np.float64, 20)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: backend.gaussian(np.zeros((2,) * 6), 1.0), backend.ArrayError, "1 to 5 axes"),
        (lambda: backend.gaussian(np.zeros((3, 3)), -1.0), ConfigError, "sigma is -1.0"),
        (lambda: backend.gaussian(np.zeros((3, 3)), (1, 2, 3)), ConfigError, "one per axis"),
        (lambda: backend.gaussian(np.zeros((3, 3)), 1.0, mode="mean"), ConfigError, "'mean'.*nearest"),
        (lambda: backend.gaussian(np.zeros((3, 3)), 1.0, axes=(0, 0)), ConfigError, "none twice"),
        (lambda: backend.gaussian(np.zeros((3, 3)), 1.0, truncate=0), ConfigError, "truncate is 0"),
        (lambda: backend.gaussian_moments(np.zeros((3, 3)), 1.0, [(1,)]), ConfigError, "one exponent"),
        (lambda: backend.derivatives(np.zeros((3, 3)), taps=4), ConfigError, "taps is 4: choose one of 3, 5"),
        (lambda: backend.structure_tensor_2d(np.zeros(3), 1.0, 1.0), backend.ArrayError, "must have 2 axes"),
        (lambda: backend.structure_tensor_3d(np.zeros((3, 3)), 1.0, 1.0), backend.ArrayError, "must have 3 axes"),
        (lambda: backend.structure_tensor_2d(np.zeros((3, 3)), 0.0, 1.0), ConfigError, "sigma is 0"),
        (
            lambda: backend.structure_tensor_2d(np.zeros((3, 3)), 1.0, 1.0, derivatives="4"),
            ConfigError, "derivatives is '4'",
        ),
        (lambda: backend.structure_tensor(np.zeros(3), 1.0), backend.ArrayError, r"\[n, \.\.\.\]"),
        (
            lambda: ours.parallel_structure_tensor_analysis(np.zeros((3, 3, 3)), 1, 1, devices=["cuda:0"]),
            ConfigError, "cuda:0.*LEAFFLOW_TI_ARCH",
        ),
        (lambda: ours.parallel_structure_tensor_analysis(np.zeros((3,) * 3), 1, 1, None, None), ConfigError, "nothing"),
        (lambda: feature.structure_tensor(np.zeros((3, 3, 3)), order="xy"), ConfigError, "order is 'xy'"),
        (lambda: feature.hessian_matrix(np.zeros((1, 3))), backend.ArrayError, "2 samples or more"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(call: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_blocks_are_parts_of_the_whole(tmp_path: Path) -> None:
    volume, done = noise((21, 30, 17), np.float32), []
    into = np.memmap(tmp_path / "vectors", np.float32, "w+", shape=(3, 3, *volume.shape))
    tensors, values, vectors = ours.parallel_structure_tensor_analysis(
        volume, 1.0, 1.5, into, np.float64, np.float32, block_size=11, include_all_eigenvectors=True,
        eigenvalue_order="asc", progress_callback_fn=lambda n, of: done.append((n, of)),
    )  # fmt: skip
    whole = ours.structure_tensor_3d(volume, 1.0, 1.5)
    assert vectors is into
    assert values.dtype == np.float64
    assert done == [(n, 12) for n in range(1, 13)]
    np.testing.assert_allclose(tensors, whole, atol=2e-6 * whole.max())
    wanted = ours.eig_special_3d(tensors, full=True, eigenvalue_order="asc")
    np.testing.assert_allclose(values, wanted[0], atol=2e-6 * whole.max())
    np.testing.assert_allclose(np.abs((vectors * wanted[1]).sum(axis=1)), 1.0, atol=1e-4)
    none = ours.parallel_structure_tensor_analysis(volume, 1.0, 1.5, None, np.float32)
    assert none[0] is None
    assert none[2] is None
    np.testing.assert_allclose(none[1], values[::-1], atol=4e-6 * whole.max())
