"""Images shifted by whole pixels per frame: what is measured in them is what stands still, as the naive twin has it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reference import chain, patch
from test_every_model import GRIDS, PRESHIFT, captured  # noqa: F401 - `captured` is a fixture

import leafflow_ti as lf
from leafflow_ti.aim import Aim
from leafflow_ti.capture import FileCapture
from leafflow_ti.config import load_config
from leafflow_ti.models import ColumnSet
from leafflow_ti.pipeline import Pipeline
from leafflow_ti.plan import Plan, make_plan
from leafflow_ti.runtime import start
from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.tensor import Band
from leafflow_ti.status import HAS_VALUE
from leafflow_ti.stays import without_images

MOTION = (1, -1)
X, Y, FRAME = 47, 39, 3
CASES: dict[str, tuple[str, dict[str, object]]] = {
    "flow-affine": ("line", {"model": "flow-affine"}),
    "range constraint": ("line", {"model": "affine-4d", "rows": "2d+b5"}),
    "brightness": ("line", {"model": "affine-4d", "brightness": "spatial", "brightness_terms": "time"}),
    "acceleration": ("square", {"model": "affine-5d", "motion": "acceleration", "brightness": "camera"}),
    "scene flow": ("line", {"model": "scene-flow"}),
    "own flows": ("line", {"model": "affine-scene-flow", "motion": "acceleration", "rows": "2d+b5+as+at"}),
}


def measured(capture: FileCapture, plan: Plan, aim: Aim) -> tuple[dict[str, float], object]:
    """Maps of the one pixel of a plan in images that are shifted as ``aim`` says; and the view."""
    pipeline = Pipeline(plan, capture, start("cpu", "f64", None))
    sampling = plan.problem.sampling
    band = Band.of(sampling, 1, 1, plan.x.step)
    frames = range(FRAME - sampling.t.before, FRAME + sampling.t.after + 1)
    stay = pipeline.stays.move(pipeline.engine(band), band, (X, Y), aim, frames.start, FRAME)
    samples = []
    for t, block in zip(frames, pipeline.reader.blocks(frames, stay.box, aim, FRAME), strict=True):
        sample = pipeline.stays.sample(stay, t, *block)
        tensors = stay.engine.push(sample)
        samples.append(without_images(sample))
    stay.engine.set_frame(FRAME)
    maps, status = pipeline.stays.maps(stay, tensors, samples[sampling.t.before])
    assert status[0, 0] in HAS_VALUE
    return {name: float(values[0, 0]) for name, values in maps.items()}, stay.engine.estimate.view


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("motion", [(0, 0), MOTION], ids=["still", "shifted"])
def test_maps_equal_the_twins(captured, case: str, motion: tuple[int, int]) -> None:  # noqa: F811
    grid, options = CASES[case]
    folder: Path = captured(grid, "spatial" if "brightness" in options else "none", True)
    capture = lf.open_capture(folder)
    preshift = tuple(int(n) for n in PRESHIFT[grid].split(","))
    config = load_config(
        overrides={
            "preshift": preshift, "window": 15, "sigma": 4.4, "precision": "f64", "refine": 0, "stride": 1,
            "roi": (X, Y, X + 1, Y + 1), **options,
        }
    )  # fmt: skip
    plan = make_plan(capture, config)
    maps, view = measured(capture, plan, Aim(preshift, motion))
    found = twin(capture, plan, preshift, motion, view)
    assert {"flow_x", "flow_y"} <= set(found)
    for name, (value, std) in found.items():
        assert maps[name] == pytest.approx(value, rel=1e-6, abs=2e-4 * std), name
        assert maps[f"{name}_std"] == pytest.approx(std, rel=2e-4), name


def twin(capture: FileCapture, plan: Plan, preshift: tuple[int, ...], motion: tuple[int, int], view: object) -> dict:
    """The same from the naive float64 twin."""
    problem, sampling, half = plan.problem, plan.problem.sampling, 20
    row, col = capture.reference

    def images(rows: range, cols: range) -> np.ndarray:
        frames = []
        for t in range(FRAME - sampling.t.before, FRAME + sampling.t.after + 1):
            x, y = (at + m * (t - FRAME) - half for at, m in zip((X, Y), motion, strict=True))
            size = 2 * half + 1
            frames.append(capture.block([t], rows, cols, y, y + size, x, x + size, preshift, np.float64)[0])
        return np.array(frames)

    def around(centre: int, radius: int) -> range:
        return range(centre - radius, centre + radius + 1)

    def solved(one: np.ndarray, columns: ColumnSet, sampling: Sampling) -> chain.Solved:
        J = chain.structure_tensor(one, sampling, columns, [(half, half)])[0]
        rho = chain.texture_smoothness(one, sampling, half, half)
        return chain.Solved.of(J, rho, columns, sampling, problem.estimator)

    block = images(around(row, sampling.sy.radius), around(col, sampling.sx.radius))
    own = []
    for step in problem.own_flows.steps if problem.own_flows else ():
        flows = problem.own_flows
        one = images(range(row + step[1], row + step[1] + 1), range(col + step[0], col + step[0] + 1))
        own.append(solved(one, flows.columns, flows.sampling))
    return patch.measure(solved(block, problem.columns, sampling), problem, replace(view, pitch=1), X, Y, own)
