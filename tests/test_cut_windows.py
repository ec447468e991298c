"""Windows that a mask or a border cuts: the stages against the naive twin, and what noise does to their estimates."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tolerances import tolerance

from leafflow_ti.models import MODELS
from leafflow_ti.stages.estimate_tables import DENOISE
from leafflow_ti.status import Status
from test_kernels_estimate import assert_maps_equal

CUT = [(model, "none" if "flow" in model else "spatial", grid) for model, grid in (
    ("flow", "single"), ("flow-affine", "single"), ("flow-quadratic", "single"), ("depth", "line-x"),
    ("affine-translation", "line-x"), ("affine", "square"), ("affine-4d", "line-y"), ("affine-5d", "square"),
    ("affine-scene-flow", "line-x"), ("scene-flow", "line-x"),
)]  # fmt: skip
ALONE = [c for c in CUT if not MODELS[c[0]].own_flows]
MASKS = ("half", "corner", "spots")


def masked(b: Any, mask: str) -> Any:
    """The bench with only a part of its pixels valid: half of some windows, a corner; "spots" differ by frame."""
    t, (height, width) = len(b.images), b.images.shape[3:]
    x, y = b.position(1, 3)
    valid = np.ones((t, height, width), bool)
    if mask != "spots":
        valid[:, :, x + 4 :] = False
    if mask == "corner":
        valid[:, : y - 3] = False
    if mask == "spots":
        valid[t // 2, y - 4, x - 2] = valid[-1, y + 1, x + 5] = False
    return replace(b, valid=valid)


@pytest.mark.parametrize("estimator", ["ols", "tls", "tls-equilibrated"])
@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize(("model", "brightness", "grid"), ALONE)
def test_parameters_equal_the_twin(
    bench: Callable, model: str, brightness: str, grid: str, mask: str, precision: str, estimator: str
) -> None:
    if model == "flow-quadratic" and mask != "spots":
        pytest.skip("half of so small a window does not determine second derivatives")
    b = masked(bench(model, brightness, grid, precision), mask)
    found = {solver: b.estimate(estimator=estimator, solver=solver) for solver in ("fast", "jacobi")}
    for pixel in ((1, 3), (1, 0), (2, 4)):
        solved, _ = b.solved(*pixel, found["fast"].problem)
        P, cov = solved.at_centre(b.columns, b.sampling, DENOISE[estimator])
        std = np.sqrt([np.diag(cov[k, k]) for k in range(b.columns.n_time_like)])
        for result in found.values():
            if result.status[pixel] == Status.BORDER:
                continue
            assert np.max(np.abs(result.parameters[pixel] - P.T) / std) <= tolerance(b.device).parameters
            assert result.variance[pixel] == pytest.approx(solved.variance, rel=tolerance(b.device).errors)


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize(("model", "brightness", "grid"), [c for c in CUT if c[0] != "flow"])
def test_maps_equal_the_twin(bench: Callable, model: str, brightness: str, grid: str, mask: str) -> None:
    b = masked(bench(model, brightness, grid, "f64"), mask)
    assert_maps_equal(b, b.estimate(MODELS[model].motions[0] if MODELS[model].motions else None))
