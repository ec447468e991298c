"""Structure tensors from the kernels against direct window sums and exact polynomials."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from reference import chain
from scipy.ndimage import minimum_filter
from tolerances import EXACT, tolerance

from leafflow_ti.blocks import LEAST_BLOCKS
from leafflow_ti.filters import FILTER_SETS, filter_set
from leafflow_ti.models import AXES, MODELS, OWN_FLOW, TensorLayout, column_set, monomial
from leafflow_ti.sampling import AxisSampling, Sampling
from leafflow_ti.stages.tensor import Band, Request, TensorStage, band_bytes

PIXELS = ((0, 0), (1, 3), (2, 4))
PASSES = ("t", "sy", "sx", "y", "x")
SERIES = AxisSampling.gaussian(filter_set("3"), 3, 1.0)


def sample_grids(sampling: Sampling) -> dict[str, np.ndarray]:
    """Offsets from the centre along every axis, [t, sy, sx, y, x], of all samples that one pixel needs."""
    halo = {a: sampling.axis(a).radius + (sampling.axis(a).filter_radius if a in "xy" else 0) for a in AXES}
    axes = [np.arange(-halo[a], halo[a] + 1.0) for a in PASSES]
    return dict(zip(PASSES, np.meshgrid(*axes, indexing="ij"), strict=True))


def relative_error(found: np.ndarray, wanted: np.ndarray) -> float:
    scale = np.sqrt(np.diag(wanted))
    return float(np.max(np.abs(found - wanted) / np.outer(scale, scale)))


def test_tensor_equals_direct_sums(bench: Callable, case: tuple[str, str, str], precision: str) -> None:
    b = bench(*case, precision)
    for pixel in PIXELS:
        J, rho = b.reference(*pixel)
        mass, energy, smooth = b.planes[-4:-1, *pixel]
        limit = tolerance(b.device).tensor
        assert relative_error(b.tensor(*pixel), J) <= limit
        assert mass == pytest.approx(1.0, rel=limit)
        assert smooth / energy == pytest.approx(rho, rel=limit)


@pytest.mark.parametrize("stride", [1, 2, 3, 4])
@pytest.mark.parametrize("cols", [1, 63, 65])
def test_any_stride_and_width(bench: Callable, stride: int, cols: int) -> None:
    b = bench("flow-affine", "none", "single", "f32", stride, cols)
    for pixel in ((0, 0), (2, cols - 1), (1, cols // 2)):
        J, rho = b.reference(*pixel)
        assert relative_error(b.tensor(*pixel), J) <= tolerance(b.device).tensor
        assert b.planes[-2, *pixel] / b.planes[-3, *pixel] == pytest.approx(rho, rel=tolerance(b.device).tensor)


@pytest.mark.parametrize("model", ["affine-4d", "flow-quadratic"])
@pytest.mark.parametrize(("size", "stride"), [(19, 2), (31, 3), (37, 4), (29, 3), (19, 4)])
def test_windows_of_blocks_equal_direct_sums(
    make_bench: Callable, model: str, size: int, stride: int, precision: str
) -> None:
    """Blocks of odd and even length, odd and even in number, and several to an output: the sums are exact."""
    pixel = AxisSampling.gaussian(filter_set("5"), size, 0.3 * size, stride)
    assert pixel.blocks is not None
    along = {"sx": SERIES} if model == "affine-4d" else {}
    sampling = Sampling(pixel, pixel, t=SERIES, **along)
    columns = column_set(MODELS[model], "camera", sampling.camera_axes, sampling.sampled)
    band = Band.of(sampling, 20, 3, stride)
    cameras = 2 * sampling.sx.radius + 1
    images = np.random.default_rng(7).random((2 * SERIES.radius + 1, 1, cameras, band.in_rows, band.in_cols))
    b = make_bench(images, sampling, columns, precision, (band.rows, band.cols), stride)
    for pixel_at in ((0, 0), (19, 2), (11, 1)):
        J, rho = b.reference(*pixel_at)
        assert relative_error(b.tensor(*pixel_at), J) <= tolerance(b.device).tensor
        assert b.planes[-2, *pixel_at] / b.planes[-3, *pixel_at] == pytest.approx(rho, rel=tolerance(b.device).tensor)


@pytest.mark.parametrize("size", [19, 31, 65])
@pytest.mark.parametrize("stride", range(1, 9))
def test_blocks_keep_length_and_second_moment(size: int, stride: int) -> None:
    smooth = AxisSampling.gaussian(None, size, 0.29 * size)
    found = AxisSampling.gaussian(None, size, 0.29 * size, stride)
    if found.blocks is None:
        assert found == smooth
        assert all(stride % d or (size - 1) // d < LEAST_BLOCKS for d in range(2, stride + 1))
        return
    assert stride % found.blocks.step == 0
    assert found.size % 2 == 1
    assert abs(found.size - size) <= (found.blocks.step + 1) / 2
    assert found.weights == pytest.approx(found.weights[::-1], rel=1e-12)
    assert found.moment(0) == pytest.approx(1.0, rel=1e-12)
    assert found.moment(2) == pytest.approx(smooth.moment(2), rel=1e-9)


@pytest.mark.parametrize("taps", FILTER_SETS)
def test_every_filter_set(make_bench: Callable, taps: str) -> None:
    pixel = AxisSampling.gaussian(filter_set(taps), 7, 2.0)
    sampling = Sampling(pixel, pixel, t=AxisSampling.gaussian(filter_set(taps), 3, 1.0))
    columns = column_set(MODELS["flow-affine"], "spatial", (), sampling.sampled)
    shape = sample_grids(sampling)["x"].shape
    images = np.random.default_rng(5).random(shape)
    b = make_bench(images, sampling, columns)
    assert relative_error(b.tensor(0, 0), b.reference(0, 0)[0]) <= tolerance(b.device).tensor


POLYNOMIALS = {
    "line-x": ("affine-4d", Sampling(SERIES, SERIES, sx=SERIES, t=SERIES)),
    "line-y": ("affine-4d", Sampling(SERIES, SERIES, sy=SERIES, t=SERIES)),
    "square": ("affine-5d", Sampling(SERIES, SERIES, sx=SERIES, sy=SERIES, t=SERIES)),
}


@pytest.mark.parametrize("grid", POLYNOMIALS)
def test_derivatives_of_a_quadratic_are_exact(make_bench: Callable, grid: str) -> None:
    """On ``I = Δ^T Q Δ / 2 + g^T Δ`` every channel is known in closed form: J must be its plain window sum."""
    model, sampling = POLYNOMIALS[grid]
    columns = column_set(MODELS[model], "camera", sampling.camera_axes, sampling.sampled)
    random = np.random.default_rng(3)
    Q = random.normal(size=(5, 5))
    Q, g = Q + Q.T, random.normal(size=5)
    at = sample_grids(sampling)
    delta = np.stack([at[a] for a in AXES])
    gradient = np.einsum("ij,j...->i...", Q, delta) + g[:, None, None, None, None, None]
    images = 0.5 * np.einsum("i...,ij,j...->...", delta, Q, delta) + np.einsum("i,i...->...", g, delta)
    # Smoothing adds half the curvature times the filter's second moment, and leaves derivatives alone.
    radius = {a: sampling.axis(a).filter_radius for a in AXES}
    second = [np.sum(sampling.axis(a).kernel(False) * np.arange(-radius[a], radius[a] + 1) ** 2) for a in AXES]
    channels = dict(zip(AXES, gradient, strict=True)) | {"i": images + 0.5 * np.dot(np.diag(Q), second)}

    size = {a: sampling.axis(a).size for a in AXES}
    window = tuple(slice((n - size[a]) // 2, (n + size[a]) // 2) for a, n in zip(PASSES, images.shape, strict=True))
    weight = 1.0
    for a in PASSES:
        weight = np.multiply.outer(weight, np.array(sampling.axis(a).weights))
    d = []
    for column in columns.columns:
        value = channels[column.channel][window].copy()
        for a, power in zip(AXES, monomial(column.offset), strict=True):
            value *= at[a][window] ** power
        d.append(value.ravel())
    wanted = (np.array(d) * weight.ravel()) @ np.array(d).T
    found = make_bench(images, sampling, columns).tensor(0, 0)
    assert relative_error(found, wanted) <= EXACT


def test_moments_of_a_constant_are_those_of_the_window(make_bench: Callable) -> None:
    """On ``I = 1`` the entries of intensity × intensity are products of the windows' moments, all others vanish."""
    _, sampling = POLYNOMIALS["square"]
    columns = column_set(MODELS["affine-5d"], "camera", sampling.camera_axes, sampling.sampled)
    J = make_bench(np.ones(sample_grids(sampling)["x"].shape), sampling, columns).tensor(0, 0)
    for (i, a), (j, b) in itertools.product(enumerate(columns.columns), repeat=2):
        both = a.channel == b.channel == "i"
        powers = [p + q for p, q in zip(monomial(a.offset), monomial(b.offset), strict=True)]
        wanted = np.prod([sampling.axis(n).moment(p) for n, p in zip(AXES, powers, strict=True)]) if both else 0.0
        assert J[i, j] == pytest.approx(wanted, abs=1e-14)


def test_invalid_pixels_have_no_weight(bench: Callable, make_bench: Callable) -> None:
    """A sample counts only if its filters, in space and time, see valid pixels alone; the rest of the window stays."""
    whole = bench("affine-4d", "camera", "line-x", "f64")
    valid = np.ones((len(whole.images), *whole.images.shape[3:]), bool)
    valid[2, 9, 8] = valid[:, 14, 12] = valid[:, :, 24:] = False
    images = np.where(valid[:, None, None], whole.images, 1e6)
    shape = (whole.band.rows, whole.band.cols)
    b = make_bench(images, whole.sampling, whole.columns, shape=shape, stride=whole.band.stride, valid=valid)
    seen = chain.filters_see(valid, whole.sampling)
    for pixel in PIXELS:
        J, _ = b.reference(*pixel)
        assert relative_error(b.tensor(*pixel), J) <= tolerance(b.device).tensor
        assert relative_error(J, whole.reference(*pixel)[0]) > 1e-3
        (x, y), h, middle = b.position(*pixel), whole.sampling.x.size // 2, len(seen) // 2
        window = seen[middle - 1 : middle + 2, y - h : y + h + 1, x - h : x + h + 1]
        weights = (whole.sampling.axis(a).weights for a in ("t", "y", "x"))
        assert b.planes[-4, *pixel] == pytest.approx(np.einsum("i,j,k,ijk", *weights, window))


@pytest.mark.parametrize("stride", [1, 4])
def test_the_memory_plan_holds_the_arrays(device: Callable, stride: int) -> None:
    pixel = AxisSampling.gaussian(filter_set("5"), 41, 12.0, stride)
    sampling, alone = Sampling(pixel, pixel, sx=SERIES, t=SERIES), Sampling(pixel, pixel, t=SERIES)
    columns = column_set(MODELS["affine-4d"], "none", sampling.camera_axes, sampling.sampled)
    flow = column_set(OWN_FLOW, "none", (), alone.sampled)
    own = [Request(flow, TensorLayout.of(flow), alone, (0, x)) for x in (-2, 2)]
    band, d = Band.of(sampling, 60, 200, stride), device("f32")
    stage = TensorStage(d, columns, TensorLayout.of(columns), sampling, band, own)
    arrays = [a for a in vars(stage).values() if getattr(a, "dtype", None) == np.float32]
    taken = sum(a.nbytes for a in arrays)
    planned = band_bytes(columns, TensorLayout.of(columns), sampling, band, 4, tuple(own))
    # The plan does not know how many tasks share the scratch, and counts the output of the next stage.
    assert 0.5 * planned < taken <= planned


def test_smoothness_looks_at_valid_pixels_only(bench: Callable, make_bench: Callable) -> None:
    """Where smoothing the gradient once more would see invalid pixels, neither energy counts."""
    whole = bench("flow-affine", "none", "single", "f64")
    valid = np.ones((len(whole.images), *whole.images.shape[3:]), bool)
    valid[:, :2], valid[2, 12, 9] = False, False
    images = np.where(valid[:, None, None], whole.images, 1e6)
    shape = (whole.band.rows, whole.band.cols)
    b = make_bench(images, whole.sampling, whole.columns, shape=shape, stride=whole.band.stride, valid=valid)
    size = [2 * whole.sampling.t.filter_radius + 1, *(4 * whole.sampling.axis(a).filter_radius + 1 for a in ("y", "x"))]
    seen = minimum_filter(valid.astype(float), size, mode="nearest")
    for pixel in PIXELS:
        (x, y), h, m = b.position(*pixel), whole.sampling.x.size // 2, len(seen) // 2
        window = np.s_[m - 1 : m + 2, y - h : y + h + 1, x - h : x + h + 1]
        weights = [whole.sampling.axis(a).weights for a in ("t", "y", "x")]
        energy = 0.0
        for axis in ("x", "y"):
            gradient = chain.derivative(images, whole.sampling, axis)[:, 0, 0][window]
            energy += np.einsum("i,j,k,ijk", *weights, seen[window] * gradient**2)
        assert 0 < b.planes[-3, *pixel] == pytest.approx(energy, rel=1e-12)
        assert b.planes[-2, *pixel] < energy
