"""Memory that a plan asks for against the arrays of its run, and bands under a limit, with the refinement."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_pipeline import SCENE, capture_of, config

import leafflow_ti as lf
from leafflow_ti import engines
from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.config import load_config
from leafflow_ti.kernels.refine_tables import ADDRESSED
from leafflow_ti.pipeline import Pipeline
from leafflow_ti.plan import Plan
from leafflow_ti.refine_plan import Refinement
from leafflow_ti.runtime import Device
from leafflow_ti.stages.refine import RefineStage
from leafflow_ti.stages.refine_tables import CPU_BYTES, SLOTS_PER_THREAD, Workspaces
from leafflow_ti.stages.view import View

LANES = 16
WIDE = replace(SCENE, size=(150, 130))


@pytest.fixture(scope="module")
def capture() -> Capture:
    return capture_of(WIDE)


def planned(capture: Capture, **options: Any) -> Plan:
    """A window of 21 pixels, all of it samples, in 5 cameras and 9 frames."""
    common = {"model": "affine-scene-flow", "refine": 2, "window": 21, "thin": 1, "stride": 2, "motion": "auto"}
    return lf.plan_run(capture, config(**{**common, "frames": "4:5", **options}))


def refinement(across: int, cameras: int) -> Refinement:
    grid = tuple((x, 0) for x in range(cameras))
    return Refinement(3, across, across / 3, 1, tuple(range(-4, 5)), grid, 9, 1, 0)


def test_slots_are_many_where_they_are_small_and_one_a_thread_where_they_are_large() -> None:
    def slots(across: int, cameras: int) -> Workspaces:
        return Workspaces.of(refinement(across, cameras), LANES, (4, 8), False, 4)

    small, medium, large = slots(21, 9), slots(41, 50), slots(65, 81)
    assert small.slots == 4 * SLOTS_PER_THREAD
    assert small.bytes < CPU_BYTES
    assert 4 < medium.slots < 4 * SLOTS_PER_THREAD
    assert CPU_BYTES - medium.slot_bytes < medium.bytes <= CPU_BYTES
    assert large.slots == 4
    assert large.bytes > CPU_BYTES
    # Six numbers that are interpolated, and the value where the warp is now, of every sample of every image.
    assert large.slot_bytes > 7 * 4 * 65**2 * 81 * 9
    assert large.slot_bytes < 1.2 * 7 * 4 * 65**2 * 81 * 9


@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_workspaces_are_those_that_a_stage_has(precision: str, device: Callable[[str], Device]) -> None:
    wanted, plan = device(precision), refinement(21, 5)
    view = View(1000.0, (60.0, 60.0), (1.0, 1.0), (0.0, 0.0), 0, 0, 1, 1, 1, 64)
    stage = RefineStage(wanted, plan, view, 140, 140)
    itemsize = (4 if precision == "f32" else 8, 8 if wanted.algebra == "f64" else 4)
    space = Workspaces.of(plan, wanted.dense.lanes, itemsize, wanted.gpu, wanted.threads)
    lanes = wanted.dense.lanes
    held = [len(wanted.host(array)) for array in (stage._real, stage._precise)]
    assert held == [space.slots * space.real * lanes, space.slots * space.precise * lanes]
    assert space.bytes == sum(n * size for n, size in zip(held, itemsize, strict=True))


def test_planned_memory_is_that_of_a_run(capture: Capture, device: Callable[[str], Device]) -> None:
    """Of arrays on the host, which the allocator reports; kernels are compiled before."""
    if device("f32").gpu:
        pytest.skip("arrays of a GPU are not on the host")
    plan = planned(capture, roi=(45, 35, 105, 95))
    pipeline = Pipeline(plan, capture, device("f32"))
    pipeline.warm_up()
    engines.release()
    tracemalloc.start()
    try:
        pipeline.run(set(), lambda *_: None)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak == pytest.approx(plan.bytes, rel=0.2)


def test_little_memory_lowers_the_bands_of_a_refinement(capture: Capture) -> None:
    """The limit lies between the memory with a refinement and that without."""
    plain, whole = planned(capture, refine=0, stride=1), planned(capture, stride=1)
    assert (plain.bands, whole.bands) == (1, 1)
    assert plain.bytes < 0.8 * whole.bytes
    limit = int(0.9 * whole.bytes / 0.8)
    assert planned(capture, refine=0, stride=1, max_memory=limit).bands == 1
    lowered = planned(capture, stride=1, max_memory=limit)
    assert lowered.bands > 1
    assert lowered.bytes <= 0.9 * whole.bytes


def test_coefficients_stay_where_kernels_can_index_them() -> None:
    """9 x 9 cameras of 1600 x 1200 pixels in 25 frames: the arrays of other kernels could be larger."""
    images = np.broadcast_to(np.zeros(1, np.uint8), (25, 9, 9, 1200, 1600))
    large = capture_from_array(images, Geometry(2800.0, (799.5, 599.5), (5.0, 5.0)))
    options = {"model": "affine-5d", "window.size_time": 21}
    plan = lf.plan_run(
        large, load_config(overrides={**options, "preshift": (0, 0), "refine": 3, "stride": 16, "max_memory": "200G"})
    )
    assert plan.refine is not None
    rows, cols = (
        (n - 1 + 2 * plan.margin) * plan.x.step + 1 + 2 * plan.refine.halo for n in (plan.band_rows, len(plan.x))
    )  # fmt: skip
    assert plan.bands > 1
    assert len(plan.refine.frames) * len(plan.refine.cameras) * rows * cols < ADDRESSED
