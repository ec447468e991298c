"""Memory that a plan asks for against the arrays of its run, and bands under a limit, with the refinement."""

from __future__ import annotations

import json
import re
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from small_plane import SCENE, capture_of, config

import leafflow_ti as lf
from leafflow_ti import engines
from leafflow_ti.bands import COMPILING_BYTES, PROCESS_BYTES, least_limit
from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.config import load_config
from leafflow_ti.config_sections import PARENT_BYTES
from leafflow_ti.errors import ConfigError
from leafflow_ti.kernels.refine_tables import ADDRESSED
from leafflow_ti.pipeline import Pipeline
from leafflow_ti.plan import Plan
from leafflow_ti.refine_plan import Refinement
from leafflow_ti.runtime import Device
from leafflow_ti.stages.refine import RefineStage
from leafflow_ti.stages.refine_tables import CPU_BYTES, SLOTS_PER_THREAD, Workspaces
from leafflow_ti.stages.view import View
from leafflow_ti.synthetic.write import write_scene

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
        pipeline.run(lambda *_: None)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak == pytest.approx(plan.bytes, rel=0.2)


def blank(width: int, height: int, cameras: int, frames: int) -> Capture:
    """Images that only plans are made for: any number of them takes no memory."""
    images = np.broadcast_to(np.zeros(1, np.uint8), (frames, 1, cameras, height, width))
    return capture_from_array(images, Geometry(2800.0, (width / 2, height / 2), (5.0, 0.0)))


def test_little_memory_lowers_the_bands_of_a_refinement() -> None:
    """The limit lies between the memory with a refinement and that without."""
    images = blank(500, 400, 5, 9)
    plain, whole = planned(images, refine=0, stride=2), planned(images, stride=2)
    assert (plain.bands, whole.bands) == (1, 1)
    assert plain.bytes < 0.8 * whole.bytes
    limit = least_limit(int(0.9 * whole.bytes))
    assert planned(images, refine=0, stride=2, max_memory=limit).bands == 1
    lowered = planned(images, stride=2, max_memory=limit)
    assert lowered.bands > 1
    assert lowered.bytes <= 0.9 * whole.bytes


def test_limit_that_is_too_little_says_what_is_needed() -> None:
    images = blank(3000, 400, 9, 9)
    with pytest.raises(ConfigError, match=r"plan\.max_memory = 340M is too little: .* need (\d+)M: raise it") as error:
        planned(images, max_memory="340M")
    found = re.search(r"need (\d+)M", str(error.value))
    assert found is not None
    needed = int(found[1])
    assert planned(images, max_memory=f"{needed}M").read_ahead == 0
    with pytest.raises(ConfigError, match=rf"need {needed}M"):
        planned(images, max_memory=f"{needed - 1}M")


def test_limit_leaves_room_for_the_program(capture: Capture) -> None:
    """However small the images are."""
    with pytest.raises(ConfigError, match=rf"need {COMPILING_BYTES >> 20}M"):
        planned(capture, max_memory=COMPILING_BYTES - 1)
    plan = planned(capture, max_memory=COMPILING_BYTES)
    assert PROCESS_BYTES + plan.bytes <= COMPILING_BYTES


def test_workers_share_the_limit_with_the_process_that_starts_them(capture: Capture) -> None:
    one = planned(capture, max_memory="600M", threads=1)
    three = planned(capture, max_memory=3 * 600 * 2**20 + PARENT_BYTES, workers=3, threads=1)
    assert (three.bytes, three.band_rows) == (one.bytes, one.band_rows)
    least = (3 * COMPILING_BYTES + PARENT_BYTES) >> 20
    with pytest.raises(ConfigError, match=rf"need {least}M in 3 workers"):
        planned(capture, max_memory=f"{least - 1}M", workers=3, threads=1)
    planned(capture, max_memory=f"{least}M", workers=3, threads=1)


LENS = {"camera_matrix": [[900, 0, 149.5], [0, 900, 99.5], [0, 0, 1]], "distortion_coefficients": [-0.05, 0.01, 0, 0]}


@pytest.mark.parametrize("kind", ["plain", "lens", "decoded as a whole"])
def test_reading_is_counted_as_it_is_measured(kind: str, tmp_path: Path) -> None:
    folder = tmp_path / "images"
    write_scene(replace(SCENE, bits=8, size=(300, 200), n_frames=1), folder)
    if kind == "lens":
        (folder / "lens.json").write_text(json.dumps(LENS))
        described = (folder / "capture.toml").read_text()
        named = re.sub(r"focal_length_px.*\nprincipal_point_px.*", 'calibration = "lens.json"', described)
        (folder / "capture.toml").write_text(named)
    elif kind == "decoded as a whole":
        for path in folder.rglob("*.tif"):
            tifffile.imwrite(path, tifffile.imread(path), compression="zlib", rowsperstrip=200)
    images = lf.open_capture(folder)
    images.keep_decoded(0)
    images.read(0, 0, 0, 20, 180, 30, 270)  # once for what is remembered, such as headers
    tracemalloc.start()
    try:
        window = images.read(0, 0, 0, 20, 180, 30, 270)
        peak = tracemalloc.get_traced_memory()[1] - window.nbytes
    finally:
        tracemalloc.stop()
    counted = images.reading_bytes(*window.shape)
    assert 0.5 * counted < peak < 1.1 * counted + 4096


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
