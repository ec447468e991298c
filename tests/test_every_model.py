"""Every model, from the command line on simulated captures: against the naive twin and against the exact scene."""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from reference import chain, patch
from test_cli import call

import leafflow_ti as lf
from leafflow_ti import api
from leafflow_ti.config import load_config
from leafflow_ti.models import MODELS, ColumnSet
from leafflow_ti.results import ResultStore
from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.estimate import View
from leafflow_ti.status import Status

SCENE = (
    "--frames", 7, "--size", "95x79", "--bits", "float", "--noise", 0.5, "--focal-px", 900, "--baseline-mm", "0.7,-0.4",
    "--depth-mm", 80, "--centre-mm", "0.3,-0.2", "--slope-x", 0.3, "--slope-y", -0.2, "--velocity", ".021,-.014,.06",
    "--omega-deg", "0.05,-0.08,0.1", "--wavelength-mm", "0.6,0.75", "--alpha-deg", 23, "--beta-deg", 57,
)  # fmt: skip
STILL = ("--omega-deg", "0,0,0")
LIGHTS: dict[str, tuple[object, ...]] = {
    "none": (),
    "temporal": ("--brightness", "t,1,.01", "--brightness", "t,2,-.001"),
    "spatial": ("--brightness", "t,1,.01,.004,-.003", "--brightness", "sx,1,.004"),
}
GRIDS = {"line": ("--cameras", 7, "--rows", 1), "square": ("--cameras", 5, "--rows", 5)}
PRESHIFT = {"line": "-8,0", "square": "-8,4"}

CASES: list[tuple[str, str, tuple[object, ...]]] = [
    ("flow", "line", ()),
    ("flow-affine", "line", ()),
    ("flow-affine", "line", ("--brightness", "temporal")),
    ("flow-quadratic", "line", ()),
    ("depth", "line", ()),
    ("depth", "square", ()),
    ("affine-translation", "line", ()),
    ("affine-translation", "square", ()),
    ("affine", "line", ("--rows", "2d")),
    ("affine", "square", ("--rows", "2d")),
    ("affine-4d", "line", ("--rows", "2d")),
    ("affine-4d", "line", ("--rows", "2d+b5")),
    ("affine-4d", "line", ("--brightness", "spatial")),
    ("affine-4d", "line", ("--brightness", "camera", "--brightness-terms", "both")),
    ("affine-5d", "square", ("--motion", "acceleration", "--brightness", "camera")),
    ("scene-flow", "line", ()),
    ("scene-flow", "square", ("--brightness", "spatial")),
    ("range-flow", "line", ("--constraint", "int")),
    ("range-flow", "line", ("--constraint", "grad")),
    ("range-flow", "line", ("--constraint", "intgrad")),
    ("range-flow", "line", ("--constraint", "taylor")),
    ("affine-scene-flow", "line", ("--motion", "translation", "--rows", "2d")),
    ("affine-scene-flow", "line", ("--motion", "translation", "--rows", "2d+b5")),
    ("affine-scene-flow", "line", ("--rows", "2d")),
    ("affine-scene-flow", "line", ("--rows", "2d+b5")),
    ("affine-scene-flow", "line", ("--motion", "acceleration", "--brightness", "camera")),
    ("affine-scene-flow", "square", ("--deformation", "none", "--brightness", "temporal")),
]
TRUTH = {"depth": ("depth", None), "slope_x": ("zx", None), "slope_y": ("zy", None)} | {
    f"{name}_{axis}": (key, i)
    for name, key in (
        ("flow", "flow"),
        ("velocity", "velocity"),
        ("rotation", "omega"),
        ("acceleration", "acceleration"),
    )
    for i, axis in enumerate("xyz")
}


def test_every_model_is_a_case() -> None:
    assert {model for model, _, _ in CASES} == set(MODELS)


@pytest.fixture(scope="session")
def captured(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str, bool], Path]:
    """The capture folder for a grid, a light, and whether the plane turns."""

    @functools.cache
    def make(grid: str, light: str, turns: bool) -> Path:
        folder = tmp_path_factory.mktemp(f"{grid}-{light}-{turns}") / "capture"
        assert call("simulate", "plane", folder, *SCENE, *GRIDS[grid], *LIGHTS[light], *(() if turns else STILL)) == 0
        return folder

    return make


@pytest.mark.parametrize(
    ("model", "grid", "options"), CASES, ids=lambda v: "-".join(map(str, v)) if isinstance(v, tuple) else v
)
def test_model(
    captured: Callable[[str, str, bool], Path], model: str, grid: str, options: tuple[object, ...], tmp_path: Path
) -> None:
    """Three pixels: values equal to the twin's (but of range flow, whose own tests do that), and near the truth."""
    turns = "translation" not in options and model not in ("scene-flow", "range-flow")
    given = {str(k)[2:]: str(v) for k, v in zip(options[::2], options[1::2], strict=True)}
    light = "spatial" if "taylor" in options else given.get("brightness", "none")
    folder = captured(grid, "spatial" if light == "camera" else light, turns)
    out = tmp_path / "out.zarr"
    choice = {
        "model": model, "preshift": PRESHIFT[grid], "window": 15, "sigma": 4.4, "stride": 4, "precision": "f64",
        "frames": "3:4", "roi": "43,39,52,40", "refine": 0, **given,
    }  # fmt: skip
    arguments = [a for key, value in choice.items() for a in (f"--{key}", value)]
    assert call("run", folder, "-o", out, "--quiet", "--no-quicklook", *arguments) == 0
    store = ResultStore.open(out)
    assert (store.read("status", 0) == Status.OK).all()
    maps = {name: store.read(name, 0)[0].astype(float) for name in store.names}
    truth = dict(np.load(folder / "truth.npz"))
    checked = 0
    for name, (key, component) in TRUTH.items():
        if name in maps:
            exact = truth[key]
            exact = exact if component is None else exact[..., component]
            wanted = np.broadcast_to(exact, truth["depth"].shape)[39, 43:52:4]
            # Models that are constant in the window see means over it; five standard errors besides.
            coarse = 0.02 * np.abs(wanted) if model in ("flow", "affine-translation") else 0.0
            assert np.all(np.abs(maps[name] - wanted) <= 5 * maps[f"{name}_std"] + coarse), name
            checked += 1
    assert checked >= 2
    if model != "range-flow":
        assert_equal_to_twin(folder, choice, maps)


def assert_equal_to_twin(folder: Path, choice: dict[str, object], maps: dict[str, np.ndarray]) -> None:
    """The middle one of the pixels by the naive twin, from the same files."""
    capture = lf.open_capture(folder)
    keys = {key.replace("-", "_"): value for key, value in choice.items()}
    plan = api.plan_run(capture, load_config(overrides=keys))
    problem, sampling, geometry = plan.problem, plan.problem.sampling, plan.geometry
    x, y, half = 47, 39, 20
    frames = range(3 - sampling.t.radius, 3 + sampling.t.radius + 1)

    def images(rows: range, cols: range) -> np.ndarray:
        return capture.block(
            frames, rows, cols, y - half, y + half + 1, x - half, x + half + 1, plan.preshift, np.float64
        )

    def around(centre: int, radius: int) -> range:
        return range(centre - radius, centre + radius + 1)

    row, col = capture.reference
    block = images(around(row, sampling.sy.radius), around(col, sampling.sx.radius))

    def solved(one: np.ndarray, columns: ColumnSet, sampling: Sampling) -> chain.Solved:
        J = chain.structure_tensor(one, sampling, columns, [(half, half)])[0]
        rho = chain.texture_smoothness(one, sampling, half, half)
        return chain.Solved.of(J, rho, columns, sampling, problem.estimator)

    own = []
    for step in problem.own_flows.steps if problem.own_flows else ():
        flows = problem.own_flows
        one = images(range(row + step[1], row + step[1] + 1), range(col + step[0], col + step[0] + 1))
        own.append(solved(one, flows.columns, flows.sampling))
    shift = tuple(float(p) for p in plan.preshift)
    view = View(geometry.f_px, geometry.principal_px, geometry.baseline_mm, shift, x, y, 4, 1, 1, 1)
    arguments = (solved(block, problem.columns, sampling), problem, view, x, y, own)
    found = patch.measure(*arguments)
    others = {"growth_rate", "normal_flow_x", "normal_flow_y", "confidence", "identified"}
    correlations = patch.velocity_correlations(*arguments) if problem.unknowns > 1 else {}
    for name, value in correlations.items():  # stored to 3e-5
        assert maps[name][1] == pytest.approx(value, abs=1e-4), name
    assert {name for name in maps if not name.endswith("_std")} - others - set(correlations) == set(found)
    for name, (value, std) in found.items():
        # Maps are stored in single precision.
        assert maps[name][1] == pytest.approx(value, rel=1e-6, abs=1e-4 * std), name
        assert maps[f"{name}_std"][1] == pytest.approx(std, rel=1e-4), name
