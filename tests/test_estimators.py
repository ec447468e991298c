"""Every estimator with every model, in both precisions, against the naive twin: parameters, their errors, maps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from conftest import Bench, Estimated
from test_kernels_estimate import assert_maps_equal
from tolerances import tolerance

from leafflow_ti.models import MODELS
from leafflow_ti.stages.estimate_tables import DENOISE
from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.status import Status

PIXELS = ((0, 0), (1, 3), (2, 4))
GRIDS = {
    "flow": "single", "flow-affine": "single", "flow-quadratic": "single", "depth": "square",
    "affine-translation": "square", "affine": "line-y", "affine-4d": "line-x", "affine-5d": "square",
    "scene-flow": "line-x", "affine-scene-flow": "line-x",
}  # fmt: skip
"""A grid for every model; all but ``range-flow``, whose images are others."""
ROBUST = [name for name in ESTIMATORS if name.startswith("robust")]
WEIGHTED = [name for name, estimator in ESTIMATORS.items() if estimator.weighs]


def assert_parameters_equal(b: Bench, found: Estimated) -> None:
    """Parameters in their standard errors, and the noise of the residuals."""
    limit, problem = tolerance(b.device), found.problem
    for pixel in PIXELS:
        assert found.status[pixel] == Status.OK
        solved, _ = b.solved(*pixel, problem)
        P, cov = solved.at_centre(b.columns, b.sampling, DENOISE[problem.estimator])
        std = np.sqrt([np.diag(cov[k, k]) for k in range(b.columns.n_time_like)])
        assert np.max(np.abs(found.parameters[pixel] - P.T) / std) <= limit.parameters
        assert found.variance[pixel] == pytest.approx(solved.variance, rel=limit.errors)


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
