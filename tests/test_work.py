"""Counted work against counts by hand, and the measured ceilings as numbers that can be ceilings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.ceilings import Ceilings, measure_ceilings
from leafflow_ti.config import load_config
from leafflow_ti.plan import Plan, make_plan
from leafflow_ti.refine_plan import Effort
from leafflow_ti.refine_work import count_refinement, refine_flops
from leafflow_ti.runtime import Device
from leafflow_ti.splines import filter_taps
from leafflow_ti.work import STAGES, Work, count_work, rate


def capture(n_cameras: int) -> Capture:
    images = np.random.default_rng(0).random((9, 1, n_cameras, 64, 96), np.float32)
    return capture_from_array(images, Geometry(1000.0, (47.5, 31.5), (1.0, 0.0)))


def plan(n_cameras: int = 9, **options: Any) -> Plan:
    return make_plan(
        capture(n_cameras), load_config(overrides={"window": 33, "preshift": (0, 0), "refine": 0, **options})
    )


def test_optical_flow_is_counted_as_by_hand() -> None:
    found = count_work(plan(1, model="flow"))
    # 5-tap filters: 5 taps of a smoothing, 4 of a derivative. Along t: I, It; along y: I, Iy, It; along x: all three.
    filters = 2 * ((5 + 4) + (5 + 4 + 5) + (4 + 5 + 5)) + 2 * 2 * (5 + 5)
    products = 6 + 2 * 6 + (2 + 2 + 1 + 1) * 2  # each once, weighted into its map; and the four extra maps
    assert found["filter"].flops == filters + products
    planes = 6 + 4
    assert found["tensor"].flops == 2 * planes * (5 + 33 + 33)
    assert found["tensor"].bytes == 4 * (5 * planes + planes)
    assert found["fit"].flops == 0


def test_windows_of_the_4d_model_are_those_of_its_moments() -> None:
    layout = plan(model="affine-4d", brightness="camera").layout
    found = count_work(plan(model="affine-4d", brightness="camera"))
    tall = {(m.channels, m.exponents[1:]) for m in layout.moments}
    windows = 2 * 33 * (len(tall) + len(layout.moments) + 8)
    summed = {(m.channels, m.exponents[2:]) for m in layout.moments}
    assert windows < found["tensor"].flops <= windows + 2 * 5 * (len(summed) + 4)


def test_a_stride_filters_every_pixel_and_solves_few() -> None:
    one, four = (count_work(plan(model="affine-4d", stride=stride, window=9)) for stride in (1, 4))
    assert four["filter"].flops == 16 * one["filter"].flops
    assert four["solve"] == one["solve"]
    assert one["tensor"].flops < four["tensor"].flops < 16 * one["tensor"].flops


def test_windows_of_blocks_cost_less() -> None:
    blocks = plan(model="affine-4d", stride=4, window=49)
    assert blocks.problem.sampling.x.blocked.step == 4
    x, y = (replace(axis, blocks=None) for axis in (blocks.problem.sampling.x, blocks.problem.sampling.y))
    problem = replace(blocks.problem, sampling=replace(blocks.problem.sampling, x=x, y=y))
    smooth, found = (count_work(p) for p in (replace(blocks, problem=problem), blocks))
    assert found["tensor"].flops < smooth["tensor"].flops / 4
    assert smooth["filter"].flops < found["filter"].flops < 1.3 * smooth["filter"].flops


@pytest.mark.parametrize("estimator", ["ols", "tls", "tls-equilibrated"])
@pytest.mark.parametrize("model", ["affine", "affine-4d", "scene-flow", "affine-scene-flow", "range-flow", "depth"])
def test_every_model_has_work_in_every_stage(model: str, estimator: str) -> None:
    found = count_work(plan(model=model, estimator=estimator, window=15))
    assert tuple(found) == STAGES
    for stage, work in found.items():
        assert work.bytes > 0, stage
        assert math.isfinite(work.flops), stage
        assert work.flops > 0 or (stage == "fit" and model == "range-flow"), stage


def test_full_jacobi_is_counted_as_the_dearer_solver() -> None:
    fast, full = (count_work(plan(model="affine-4d", solver=solver)) for solver in ("fast", "jacobi"))
    assert full["solve"].flops > 3 * fast["solve"].flops


def refined(**options: Any) -> Plan:
    """Windows of 21 x 21 samples in nine images of each of nine frames."""
    return plan(model="affine-scene-flow", **{"refine": 3, "window": 41, "thin": 2, **options})


def test_nothing_is_counted_without_a_refinement() -> None:
    assert count_refinement(plan(model="affine-4d")) == {}


def test_interpolation_is_counted_as_by_hand() -> None:
    """Quintic splines: 36 neighbours, six of them in each of six rows."""
    one, two = (count_refinement(refined(), Effort(1, 2, n))["refine"].flops for n in (1, 2))
    # Polynomials of degree 5, 4, 3 and their six neighbours, along x and y; sums of a row, and of the rows.
    weights, rows = 2 * 6 * 2 * (5 + 4 + 3), 6 * (3 * 6 * 2 + 6 * 2)
    # Position, 15, and what is left of it behind the pixel, 2; the texture's two slopes and three curvatures.
    image = 15 + 2 + weights + rows + 2 * 5 + 3 * 7
    # In a pass that does not interpolate two positions, and the expansion between them.
    expanded = 2 * 15 + 2 + 12
    window = 14  # means, and products with the window's coordinates
    assert two - one == 21**2 * (81 * (image - expanded) + window)


def test_splines_are_filtered_along_two_axes() -> None:
    found = count_refinement(refined(stride=4))["splines"]
    assert found.flops == 9 * 4**2 * 2 * 2 * len(filter_taps(5))
    assert found.bytes == 9 * 4**2 * 2 * 4


def test_refinement_is_linear_in_effort_and_nearly_in_samples() -> None:
    flops = [count_refinement(refined(), Effort(*e))["refine"].flops for e in ((1, 1, 1), (0, 1, 1), (1, 0, 0))]
    assert flops[0] == pytest.approx(flops[1] + flops[2])
    assert count_refinement(refined())["refine"] == count_refinement(refined(), Effort(1, 3, 3))["refine"]
    dense = count_refinement(refined(thin=1))["refine"].flops
    assert 0.9 * (41 / 21) ** 2 < dense / count_refinement(refined())["refine"].flops < (41 / 21) ** 2


@pytest.mark.parametrize("brightness", ["none", "temporal", "spatial", "camera"])
def test_more_photometric_terms_are_more_work(brightness: str) -> None:
    terms = refined(brightness=brightness).refine
    plain, found = (
        refine_flops(p, Effort(1, 3, 1)) for p in (replace(terms, terms=0, modes=0), replace(terms, modes=0))
    )
    assert (found > plain) == (brightness != "none")
    assert found < 1.5 * plain
    assert refine_flops(replace(terms, modes=3), Effort(1, 3, 1)) > found


def test_ceilings_are_rates(device: Callable[[str], Device]) -> None:
    single = device("f32")
    found = measure_ceilings(single)
    assert found.gflops_f32 > 0
    assert math.isnan(found.gflops_f64) == (single.algebra == "f32")
    assert found.gbytes > 0
    assert math.isnan(found.gbytes_cache) == single.gpu
    assert found.gflops("f32") == found.gflops_f32


def test_rates_are_shares_of_the_ceiling_of_their_precision() -> None:
    ceilings = Ceilings(gflops_f32=400.0, gflops_f64=200.0, gbytes=40.0, gbytes_cache=300.0)
    work = Work(flops=1e9, bytes=1e8)
    tensor, solve = (rate(stage, work, 0.1, ceilings, "f32", "f64") for stage in ("tensor", "solve"))
    assert (tensor.gflops, tensor.gbytes) == (10.0, 1.0)
    assert (tensor.compute, solve.compute) == (0.025, 0.05)
    assert (tensor.memory, tensor.limit, solve.limit) == (0.025, "compute", "compute")
    assert rate("tensor", work * 2, 0.1, replace(ceilings, gbytes=20.0), "f32", "f64").limit == "memory"
