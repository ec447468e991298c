"""Per-pixel kernels against the naive twin: flow parameters, geometry, motion, and their standard errors."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from estimate_bench import OWN_FLOW_CASES
from reference import chain, patch
from tolerances import SOLVERS, tolerance

from leafflow_ti.models import MODELS
from leafflow_ti.stages.thresholds import DENOISE
from leafflow_ti.status import Status
from leafflow_ti.synthetic.plane import truth

PIXELS = ((0, 0), (1, 3), (2, 4))
MOTIONS = {
    "affine-translation": [("translation", "auto")],
    "affine": [("translation", "2d"), ("rotation", "auto")],
    "affine-4d": [
        ("translation", "auto"),
        ("rotation", "2d"),
        ("rotation", "2d+b5"),
        ("rotation", "auto"),
        ("acceleration", "2d+at"),
        ("acceleration", "2d+b5+at"),
        ("acceleration", "auto"),
    ],
    "affine-5d": [("translation", "auto"), ("rotation", "2d+b5"), ("rotation", "auto"), ("acceleration", "auto")],
}
SYSTEMS = [
    pytest.param(model, grid, motion, rows, id=f"{model}-{grid}-{motion}-{rows}")
    for model, motions in MOTIONS.items()
    for grid in ("line-x", "line-y", "square")
    if model != "affine-5d" or grid == "square"
    for motion, rows in motions
]


@pytest.mark.parametrize("estimator", ["ols", "tls", "tls-equilibrated"])
def test_parameters_equal_the_twin(bench: Callable, case: tuple[str, str, str], precision: str, estimator: str) -> None:
    b = bench(*case, precision)
    found = {solver: b.estimate(estimator=estimator, solver=solver) for solver in ("fast", "jacobi")}
    for pixel in PIXELS:
        J, rho = b.reference(*pixel)
        P, variance = chain.solve(J, b.columns, b.sampling, estimator)
        cov = chain.covariances(J, variance, b.columns, b.sampling, rho, DENOISE[estimator])
        P, cov = chain.at_centre(P, cov, b.columns)
        std = np.sqrt([np.diag(cov[k, k]) for k in range(b.columns.n_time_like)])
        for result in found.values():
            assert result.status[pixel] == Status.OK
            assert np.max(np.abs(result.parameters[pixel] - P.T) / std) <= tolerance(b.device).parameters
            assert result.variance[pixel] == pytest.approx(variance, rel=tolerance(b.device).errors)
        difference = found["fast"].parameters[pixel] - found["jacobi"].parameters[pixel]
        assert np.max(np.abs(difference) / std) <= SOLVERS


def assert_maps_equal(b, found) -> None:
    """Every map of the twin, and what the growth's error follows from, at ``PIXELS``, within the device's tolerance."""
    limit = tolerance(b.device)
    for pixel in PIXELS:
        assert found.status[pixel] == Status.OK
        solved, own = b.solved(*pixel, found.problem)
        reference = patch.measure(solved, found.problem, b.view, *b.position(*pixel), own)
        for name, (value, std) in reference.items():
            map_value, map_std = (m[pixel] for m in found.map(name))
            assert abs(map_value - value) <= limit.maps * std, f"{name}: {map_value} is not {value} ± {std}"
            assert map_std == pytest.approx(std, rel=limit.errors), f"standard error of {name}"
        if found.problem.unknowns >= 3:
            reference = patch.velocity_differences(solved, found.problem, b.view, *b.position(*pixel), own)
            for name, (value, scale) in reference.items():
                assert abs(found.difference(name)[pixel] - value) <= 2 * limit.errors * scale, name


@pytest.mark.parametrize("weighted", [True, False], ids=["wls", "ls"])
def test_maps_equal_the_twin(bench: Callable, case: tuple[str, str, str], precision: str, weighted: bool) -> None:
    model, _, grid = case
    b = bench(*case, precision)
    moving = MODELS[model].time and grid != "single"
    motion = MODELS[model].motions[0] if moving else None
    assert_maps_equal(b, b.estimate(motion, weighted=weighted))


@pytest.mark.parametrize("weighted", [True, False], ids=["wls", "ls"])
@pytest.mark.parametrize(("model", "grid", "motion", "rows"), SYSTEMS)
def test_every_motion_and_choice_of_rows(
    bench: Callable, model: str, grid: str, motion: str, rows: str, weighted: bool
) -> None:
    b = bench(model, "none", grid, "f64")
    assert_maps_equal(b, b.estimate(motion, rows, weighted=weighted))


@pytest.mark.parametrize(("model", "brightness", "grid"), OWN_FLOW_CASES)
def test_own_flows_equal_the_twin(bench: Callable, model: str, brightness: str, grid: str, precision: str) -> None:
    b = bench(model, brightness, grid, precision)
    for weighted in (True, False):
        assert_maps_equal(b, b.estimate(MODELS[model].motions[0], weighted=weighted))


@pytest.mark.parametrize("grid", ["line-x", "line-y", "square"])
@pytest.mark.parametrize(
    ("motion", "rows"),
    [
        ("translation", "u+b5"), ("translation", "2d"), ("translation", "2d+b5"), ("rotation", "2d"),
        ("rotation", "2d+b5"), ("acceleration", "2d+at"), ("acceleration", "auto"),
    ],
)  # fmt: skip
def test_submodels_of_the_affine_scene_flow(bench: Callable, grid: str, motion: str, rows: str) -> None:
    """Trans., Rot. and the full model, each stabilised or not, with and without acceleration (section 6.3)."""
    b = bench("affine-scene-flow", "none", grid, "f64")
    for growth in (False, True):
        assert_maps_equal(b, b.estimate(motion, rows, growth=growth and rows.startswith("2d")))


@pytest.mark.parametrize("model", ["scene-flow", "affine-scene-flow"])
def test_a_lost_camera_is_as_if_it_were_not_there(bench: Callable, precision: str, model: str) -> None:
    """A window that has left one camera's image must not cost the pixel, nor move it."""
    b = bench(model, "none", "line-x", precision)
    motion = MODELS[model].motions[0]
    lost, without = b.estimate(motion, lost=(0,)), b.estimate(motion, without=(0,))
    whole = b.estimate(motion)
    assert np.all(lost.status == Status.OK)
    for name in ("velocity_x", "velocity_y", "velocity_z"):
        for one, other in zip(lost.map(name), without.map(name), strict=True):
            assert np.all(np.isfinite(one))
            np.testing.assert_allclose(one, other, rtol=1e-6)
        assert np.all(lost.map(name)[0] != whole.map(name)[0])


def test_without_any_camera_there_is_no_motion(bench: Callable) -> None:
    b = bench("scene-flow", "none", "line-x", "f64")
    found = b.estimate("translation", lost=tuple(range(len(b.steps))))
    assert np.all(np.isnan(found.map("velocity_z")[0]))


@pytest.mark.parametrize("estimator", ["ols", "tls"])
def test_maps_of_the_other_estimators(bench: Callable, precision: str, estimator: str) -> None:
    b = bench("affine-4d", "spatial", "line-x", precision)
    assert_maps_equal(b, b.estimate("rotation", estimator=estimator))


@pytest.mark.parametrize(
    ("model", "grid"),
    [
        ("affine-4d", "line-x"), ("affine-4d", "line-y"), ("affine-5d", "square"), ("affine-scene-flow", "line-x"),
        ("affine-scene-flow", "square"),
    ],
)  # fmt: skip
def test_maps_lie_near_the_truth(bench: Callable, model: str, grid: str) -> None:
    """Twin and kernels share their formulas; the scene does not. Five standard errors, the windows being tiny."""
    b = bench(model, "none", grid, "f64")
    found = b.estimate("acceleration")
    exact = truth(b.scene)
    for pixel in PIXELS:
        x, y = b.position(*pixel)
        wanted = {"depth": exact["depth"][y, x], "slope_x": exact["zx"][y, x], "slope_y": exact["zy"][y, x]}
        for i, axis in enumerate("xyz"):
            wanted[f"velocity_{axis}"] = exact["velocity"][y, x, i]
            wanted[f"rotation_{axis}"] = exact["omega"][i]
        for i, axis in enumerate("xyz" if found.problem.own_flows else "xy"):
            wanted[f"acceleration_{axis}"] = exact["acceleration"][y, x, i]
        for name, value in wanted.items():
            map_value, map_std = (m[pixel] for m in found.map(name))
            assert abs(map_value - value) <= 5 * map_std, f"{name}: {map_value} ± {map_std}, truth {value}"
