"""Every estimator with every model, in both precisions, against the naive twin: parameters, their errors, maps."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import estimate_bench
import numpy as np
import pytest
from estimate_bench import Bench, Estimated
from reference import estimators as twin
from reference import patch
from reference.estimators import PENALTIES
from reference.sequences import affine_sequence
from test_kernels_estimate import assert_maps_equal
from tolerances import tolerance

from leafflow_ti.filters import filter_set
from leafflow_ti.models import MODELS, column_set
from leafflow_ti.sampling import AxisSampling, Sampling
from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.stages.tensor import Band
from leafflow_ti.stages.thresholds import DENOISE
from leafflow_ti.status import Status

PIXELS = ((0, 0), (1, 3), (2, 4))
GRIDS = {
    "flow": "single", "flow-affine": "single", "flow-quadratic": "single", "depth": "square",
    "affine-translation": "square", "affine": "line-y", "affine-4d": "line-x", "affine-5d": "square",
    "scene-flow": "line-x", "affine-scene-flow": "line-x",
}  # fmt: skip
"""A grid for every model; all but ``range-flow``, whose images are others: see ``test_range_flow``."""
ROBUST = [name for name in ESTIMATORS if name.startswith("robust")]
MILD = {"penalty": "lorentzian"}
"""The penalty that forgets nothing: half way between two motions rounding decides which one the others forget."""
WEIGHTED = [name for name, estimator in ESTIMATORS.items() if estimator.weighs]


def assert_parameters_equal(b: Bench, found: Estimated, pixels: tuple[tuple[int, int], ...] = PIXELS) -> None:
    """Parameters in their standard errors, and the noise of the residuals.

    Where the texture does not determine the solution its error says so: such windows are left out. Where a solution
    would be mixed the regularised one is compared. At least two windows must have the estimator's own.
    """
    limit, problem = tolerance(b.device), found.problem
    compared = 0
    for pixel in pixels:
        assert found.status[pixel] in (Status.OK, Status.INCOHERENT)
        solved, _ = b.solved(*pixel, problem)
        P, cov = solved.at_centre(b.columns, b.sampling, DENOISE[problem.estimator])
        std = np.sqrt([np.diag(cov[k, k]) for k in range(b.columns.n_time_like)])
        assert found.variance[pixel] == pytest.approx(solved.variance, rel=limit.errors)
        if "t" in b.columns.solutions and found.map("flow_x")[1][pixel] > 1.01 * std[-1, b.columns.index("x")]:
            continue
        own = np.max(np.abs(found.parameters[pixel] - P.T) / std) <= limit.parameters
        if not own and b.columns.n_time_like == 1:
            denoise = DENOISE[problem.estimator]
            P, _ = replace(solved, P=solved.regularised(problem.noise**2, denoise)).at_centre(
                b.columns, b.sampling, denoise
            )
        assert np.max(np.abs(found.parameters[pixel] - P.T) / std) <= limit.parameters
        compared += own
    assert compared >= 2


def motion_of(model: str) -> str | None:
    return MODELS[model].motions[0] if MODELS[model].motions else None


def test_the_matrix_holds_all_models() -> None:
    assert set(GRIDS) == {name for name, model in MODELS.items() if not model.ranges}


@pytest.mark.parametrize("model", GRIDS)
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_maps_and_parameters_equal_the_twin(bench: Callable, model: str, estimator: str, precision: str) -> None:
    b = bench(model, "none", GRIDS[model], precision)
    found = b.estimate(motion_of(model), estimator=estimator, robust="all", noise=1.0)
    if not found.problem.own_flows:  # the workspace holds the flow that was solved last
        assert_parameters_equal(b, found)
    assert_maps_equal(b, found)


@pytest.mark.parametrize("estimator", WEIGHTED)
@pytest.mark.parametrize(
    ("model", "brightness", "grid"),
    [("flow-quadratic", "spatial", "single"), ("affine-4d", "camera", "line-y"), ("affine", "temporal", "square")],
)
def test_with_brightness(bench: Callable, model: str, brightness: str, grid: str, estimator: str) -> None:
    b = bench(model, brightness, grid, "f64")
    found = b.estimate(motion_of(model), estimator=estimator, robust="all", noise=1.0, **MILD)
    assert_parameters_equal(b, found)
    assert_maps_equal(b, found)


SERIES = AxisSampling.gaussian(filter_set("3"), 3, 1.0)
MOTION = np.array([[0.3, 0.01, 0.0], [-0.2, 0.0, 0.01]])
OTHER = np.array([[-0.5, 0.0, 0.0], [0.4, 0.0, 0.0]])


@functools.cache
def boundary(size: tuple[int, int], at: int, frames: int = 5) -> np.ndarray:
    """Images of two motions that meet at the column ``at``."""
    images, other = (affine_sequence(m, frames, size, noise=1.0, seed=i) for i, m in enumerate((MOTION, OTHER)))
    images[..., at:] = other[..., at:]
    return images


def boundary_bench(
    make_bench: Callable, precision: str, model: str = "flow-affine", size: int = 15, stride: int = 1, cols: int = 5,
    at: int = 16, hole: bool = False,
) -> Bench:  # fmt: skip
    """Three rows of windows over a motion boundary; ``hole``: with invalid pixels, 1e6 bright."""
    pixel = AxisSampling.gaussian(filter_set("5"), size, 0.3 * size, stride)
    sampling = Sampling(pixel, pixel, t=SERIES)
    band = Band.of(sampling, 3, cols, stride)
    images, valid = boundary((band.in_cols, band.in_rows), at), None
    if hole:
        valid = np.ones((len(images), band.in_rows, band.in_cols), bool)
        valid[:, :, : band.halo_x - 1], valid[1, band.halo_y + 2, -8] = False, False
        images = np.where(valid[:, None, None], images, 1e6)
    columns = column_set(MODELS[model], "none", (), sampling.sampled)
    return make_bench(images, sampling, columns, precision, (3, cols), stride, valid)


@pytest.mark.parametrize("penalty", PENALTIES)
@pytest.mark.parametrize("estimator", ROBUST)
def test_penalties_at_a_motion_boundary(make_bench: Callable, estimator: str, penalty: str) -> None:
    """Where next to no cell is left (truncated, over-relaxation), the few decide by their rounding: not compared.

    Double precision: in single, truncated residuals fall on either side of the threshold.
    """
    b = boundary_bench(make_bench, "f64")
    found = b.estimate(estimator=estimator, penalty=penalty, robust="all", noise=1.0, solver="jacobi")
    kept = []
    for pixel in PIXELS:
        cells, _ = b.reference(*pixel, True)
        if np.average(twin.estimate(cells, found.problem).weights, weights=cells.w) > 0.02:
            kept.append(pixel)
    assert len(kept) >= 2
    assert_parameters_equal(b, found, tuple(kept))


@pytest.mark.parametrize("estimator", ["tls-equilibrated", "sampson", "for3", "robust-tls"])
@pytest.mark.parametrize(("size", "stride"), [(15, 1), (37, 4)])
def test_the_fast_solver_at_a_motion_boundary(make_bench: Callable, estimator: str, size: int, stride: int) -> None:
    """Two motions leave a gap of eigenvalues in which inverse iteration is slower: found 6e-5 of a standard error."""
    b = boundary_bench(make_bench, "f64", size=size, stride=stride, at=30)
    fast, full = (b.estimate(estimator=estimator, robust="all", noise=1.0, solver=s) for s in ("fast", "jacobi"))
    for pixel in PIXELS:
        solved, _ = b.solved(*pixel, full.problem)
        std = np.sqrt(np.diag(solved.covariances(b.columns, b.sampling, DENOISE[estimator])[0, 0]))
        assert np.max(np.abs(fast.parameters[pixel] - full.parameters[pixel])[0] / std) <= 1e-3


@pytest.mark.parametrize("estimator", WEIGHTED)
@pytest.mark.parametrize(("size", "stride"), [(37, 4), (29, 3), (19, 2)])
def test_cells_of_blocks(make_bench: Callable, estimator: str, size: int, stride: int, precision: str) -> None:
    """Blocks that share samples or lie side by side, several to an output or one."""
    b = boundary_bench(make_bench, precision, size=size, stride=stride, at=30)
    assert b.sampling.x.blocks is not None
    assert_parameters_equal(b, b.estimate(estimator=estimator, robust="all", noise=1.0, solver="jacobi", **MILD))


@pytest.mark.parametrize("estimator", WEIGHTED)
def test_cells_of_blocks_with_cameras(make_bench: Callable, estimator: str) -> None:
    pixel = AxisSampling.gaussian(filter_set("5"), 37, 11.0, 4)
    sampling = replace(estimate_bench.sampling_of("line-x", True), x=pixel, y=pixel)
    columns = column_set(MODELS["affine-4d"], "none", sampling.camera_axes, sampling.sampled)
    band = Band.of(sampling, 3, 5, 4)
    images = estimate_bench.rendered(estimate_bench.SCENE, "line-x", (band.in_cols, band.in_rows))
    b = make_bench(images, sampling, columns, "f64", (3, 5), 4)
    assert_parameters_equal(b, b.estimate(estimator=estimator, robust="all", noise=1.0, solver="jacobi"))


@pytest.mark.parametrize("estimator", WEIGHTED)
@pytest.mark.parametrize(("size", "stride"), [(15, 1), (37, 4)])
def test_invalid_pixels(make_bench: Callable, estimator: str, size: int, stride: int, precision: str) -> None:
    """Cells without valid samples have no say; the penalty's scale is that of what is seen, however little it is."""
    b = boundary_bench(make_bench, precision, size=size, stride=stride, at=30, hole=True)
    assert_parameters_equal(b, b.estimate(estimator=estimator, robust="all", noise=1.0, solver="jacobi"))


@pytest.mark.parametrize("scale", [0.1, 10.0])
@pytest.mark.parametrize("estimator", ["tls", "sampson", "fns"])
@pytest.mark.parametrize("model", ["flow-affine", "flow-quadratic", "affine-4d"])
def test_scales_of_the_coordinates(bench: Callable, model: str, estimator: str, scale: float, precision: str) -> None:
    b = bench(model, "none", GRIDS[model], precision)
    assert_parameters_equal(b, b.estimate(estimator=estimator, scale=scale, solver="jacobi"))


@pytest.mark.parametrize("estimator", ["ols", "tls-equilibrated", "for3", *ROBUST])
def test_other_estimators_do_not_know_the_scale(bench: Callable, estimator: str) -> None:
    b = bench("flow-affine", "none", "single", "f64")
    one, other = (b.estimate(estimator=estimator, robust="all", noise=1.0, scale=s).parameters for s in (1.0, 7.0))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("estimator", ROBUST)
def test_only_what_failed_is_estimated_anew(make_bench: Callable, estimator: str, precision: str) -> None:
    """Across the boundary some windows hold one motion, some two: neighbours, within one group of lanes."""
    b = boundary_bench(make_bench, precision, cols=40, at=40)
    found, every, plain = (
        b.estimate(estimator=name, robust=which, noise=1.0, solver="jacobi")
        for name, which in ((estimator, "failed"), (estimator, "all"), (twin.ROBUST[estimator], "failed"))
    )
    changed = np.any(found.parameters != plain.parameters, axis=(2, 3))
    assert 0.2 < changed.mean() < 0.9
    np.testing.assert_array_equal(found.parameters[changed], every.parameters[changed])
    pixels = tuple((row, col) for row in (0, 2) for col in (0, 1, 13, 19, 26, 33, 39))
    for pixel in pixels:
        cells, _ = b.reference(*pixel, True)
        assert changed[pixel] == bool(np.any(twin.estimate(cells, found.problem).weights != 1)), pixel
    assert_parameters_equal(b, found, pixels)


@pytest.mark.parametrize("estimator", ROBUST)
def test_the_noise_level_is_the_least_scale(make_bench: Callable, estimator: str) -> None:
    """With more noise assumed than there is, nothing is an outlier any more: the plain fit comes back."""
    b = boundary_bench(make_bench, "f64")
    plain = b.estimate(estimator=twin.ROBUST[estimator], solver="jacobi")
    off = []
    for noise in (1.0, 1e5):
        found = b.estimate(estimator=estimator, robust="all", noise=noise, solver="jacobi")
        assert_parameters_equal(b, found)
        off.append(np.max(np.abs(found.parameters - plain.parameters)))
    assert off[0] > 0.05
    # Over-relaxation has not quite arrived; total least squares weighs by the noise of the cells, too.
    assert off[1] < 1e-6 if estimator == "robust-ols" else off[1] < 0.1 * off[0]


def test_own_flows_that_contradict_are_left_out(
    bench: Callable, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One camera sees everything run backwards: a robust estimate leaves its flow out, as the twin does."""
    b = bench("affine-scene-flow", "none", "line-x", precision)
    images = b.images.copy()
    images[:, 0, 0] = images[::-1, 0, 0]
    spoiled = Bench(b.device, images, b.sampling, b.columns, b.band, b.model)
    found = spoiled.estimate("rotation", estimator="robust-tls", robust="all", noise=1.0)
    assert_maps_equal(spoiled, found)
    monkeypatch.setattr(patch, "MAX_CONTRADICTION", np.inf)
    solved, own = spoiled.solved(*PIXELS[0], found.problem)
    taken_in = patch.measure(solved, found.problem, spoiled.view, *spoiled.position(*PIXELS[0]), own)
    value, std = (m[PIXELS[0]] for m in found.map("velocity_x"))
    assert abs(taken_in["velocity_x"][0] - value) > 0.5 * std
