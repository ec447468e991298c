"""Range flow: stages against the naive twin, exact scenes, and the pipeline around them."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from reference import chain, estimators
from reference import range_flow as twin
from reference.cells import Cells
from small_plane import assert_same, files_of
from test_kernels_tensor import relative_error
from tolerances import tolerance

import leafflow_ti as lf
from leafflow_ti import range_flow
from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.config import RunConfig, load_config
from leafflow_ti.errors import ConfigError, InputError
from leafflow_ti.filters import filter_set
from leafflow_ti.metrics import aae, erode
from leafflow_ti.models import TensorLayout
from leafflow_ti.noise import white_noise
from leafflow_ti.plan import make_plan
from leafflow_ti.progress import Progress
from leafflow_ti.runtime import Device
from leafflow_ti.sampling import AxisSampling, Sampling
from leafflow_ti.stages.estimate import EstimateStage, View
from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.stages.problem import Problem
from leafflow_ti.stages.tensor import EXTRA_PLANES, Band, TensorStage
from leafflow_ti.stages.thresholds import DENOISE
from leafflow_ti.status import Status
from leafflow_ti.synthetic import cube
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.plane import PlaneScene, render

PIXEL = AxisSampling.gaussian(filter_set("5"), 15, 4.4)
SAMPLING = Sampling(PIXEL, PIXEL, t=AxisSampling.gaussian(filter_set("5"), 3, 1.0))
BAND = Band.of(SAMPLING, 3, 5, 2)
SCENE = PlaneScene(
    f_px=900.0,
    baseline_mm=(0.3, 0.3),
    n_cols=1,
    n_frames=7,
    size=(BAND.in_cols, BAND.in_rows),
    centre=(0.3, -0.2, 80.0),
    zx=0.5,
    zy=-0.4,
    velocity=(0.021, -0.014, 0.06),
    wavelengths_mm=(0.6, 0.75),
    alpha=0.4,
    beta=1.0,
    noise=1.0,
)
LIGHT = (BrightnessTerm("t", 1, 0.01, 0.02, -0.03), BrightnessTerm("t", 2, -0.001))
WORKING, NOISE, BETA = 75.0, 1.3, 1.5
PIXELS = ((0, 0), (1, 3), (2, 4))
CASES = [(c, "none") for c in range_flow.CONSTRAINTS] + [("taylor", t) for t in ("time", "space", "both")]


def exact_depth(scene: PlaneScene) -> np.ndarray:
    """Range maps [t, y, x] of the middle camera."""
    times = [scene.time(k) for k in range(scene.n_frames)]
    return np.array([scene.intersect(scene.rays(), np.zeros(3), t)[..., 2] for t in times])


@functools.cache
def inputs(light: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Images, depth with noise and a hole, and its noise [t, y, x]."""
    scene = replace(SCENE, brightness=LIGHT if light else ())
    random = np.random.default_rng(8)
    depth = exact_depth(scene)
    noise = 0.01 * (1 + 0.3 * random.random(depth.shape))
    depth = depth + noise * random.normal(size=depth.shape)
    depth[3, 12, 14] = np.nan
    return render(scene)[:, 0, 0], depth, noise


def estimated(device: Device, constraint: str, terms: str, **options: Any) -> tuple:
    """Problem, full tensors [rows, cols, N, N], ρ and the planes of ``Output``; ``options``: of the problem."""
    images, depth, noise = inputs(constraint == "taylor")
    radius = range_flow.window_radius(SAMPLING)
    columns = range_flow.columns(constraint, SAMPLING, terms, 1 / BETA**2)
    layout = TensorLayout.of(columns)
    ratios = (WORKING / SCENE.f_px, WORKING / radius)
    problem = Problem(columns, SAMPLING, fitted=3, range_scale=ratios, **options)
    weighed = ESTIMATORS[problem.estimator].weighs
    stage = TensorStage(device, columns, layout, SAMPLING, BAND, weighed=weighed)
    gradients = [g for g, _ in twin.gradients(images, SAMPLING)]
    stack = dict(zip(range_flow.STACK, (images, np.nan_to_num(depth - WORKING), *gradients), strict=True))
    for t in range(len(images)):
        block = np.array([stack[name][t] for name in range_flow.images(constraint)])[None]
        planes = range_flow.factors(depth[t], noise[t], WORKING, radius, NOISE, BETA)
        packed = stage.push(block, np.isfinite(depth[t]), planes)
    x, y = SCENE.principal
    view = View(
        SCENE.f_px, (x, y), (0.0, 0.0), (0.0, 0.0), BAND.halo_x, BAND.halo_y, BAND.stride, BAND.rows, BAND.cols,
        stage.out_pitch,
    )  # fmt: skip
    maps = np.array(EstimateStage(device, problem, layout, view, sources=stage.sources)(packed))
    n = (len(layout.entries) + EXTRA_PLANES) * BAND.rows * stage.out_pitch
    planes = np.array(device.host(packed)[:n], np.float64).reshape(-1, BAND.rows, stage.out_pitch)[..., : BAND.cols]
    J = np.zeros((BAND.rows, BAND.cols, columns.n, columns.n))
    J[..., *np.tril_indices(columns.n)] = np.moveaxis(planes[list(layout.lower)], 0, -1)
    J += np.swapaxes(np.tril(J, -1), -1, -2)
    return problem, J, planes[-2] / planes[-3], planes[-4], maps


def check(device: Device, constraint: str, terms: str, estimator: str, **options: Any) -> None:
    from leafflow_ti.kernels.maps import Output

    problem, J, rho, seen, maps = estimated(device, constraint, terms, estimator=estimator, **options)
    columns = problem.columns
    images, depth, noise = inputs(constraint == "taylor")
    limit = tolerance(device)
    for row, col in PIXELS:
        x, y = BAND.halo_x + BAND.stride * col, BAND.halo_y + BAND.stride * row
        window = twin.window_of(
            images, depth, noise, NOISE, BETA, constraint, terms, SAMPLING, SCENE.f_px, WORKING, (x, y)
        )
        wanted = twin.structure_tensor(*window, SAMPLING)
        # Range and its derivative in time differ by a factor of 1e3, the rounding of both counts.
        assert relative_error(J[row, col], wanted) <= 2 * limit.tensor
        assert maps[Output.STATUS, row, col] == Status.OK
        if ESTIMATORS[estimator].weighs:
            weighted = estimators.estimate(Cells.of(*window, SAMPLING, columns), problem)
            solved = weighted.solved(rho[row, col], ESTIMATORS[estimator].biased)
        else:
            solved = chain.Solved.of(wanted, rho[row, col] / seen[row, col], columns, SAMPLING, estimator)
        x0, y0 = x - SCENE.principal[0], y - SCENE.principal[1]
        N, cov, light, spread = twin.velocity(
            solved, columns, SAMPLING, DENOISE[estimator], SCENE.f_px, WORKING, x0, y0
        )  # fmt: skip
        found = {Output.MOTION + k: (N[k], cov[k, k]) for k in range(3)}
        if constraint == "taylor":
            planes = (Output.BRIGHTNESS_T, Output.BRIGHTNESS_TX, Output.BRIGHTNESS_TY, Output.BRIGHTNESS_TT)
            found |= {plane: (light[k], spread[k, k]) for k, plane in enumerate(planes)}
        for plane, (value, variance) in found.items():
            assert abs(maps[plane, row, col] - value) <= limit.maps * np.sqrt(variance), plane
            assert maps[Output.STD + plane, row, col] == pytest.approx(np.sqrt(variance), rel=limit.errors)


@pytest.mark.parametrize(("constraint", "terms"), CASES)
def test_equals_the_twin(device: Callable[[str], Device], precision: str, constraint: str, terms: str) -> None:
    check(device(precision), constraint, terms, "tls-equilibrated")


OTHERS = [name for name in ESTIMATORS if name != "tls-equilibrated"]


@pytest.mark.parametrize(("constraint", "estimator"), list(product(range_flow.CONSTRAINTS, OTHERS)))
def test_other_estimators(device: Callable[[str], Device], precision: str, constraint: str, estimator: str) -> None:
    check(device(precision), constraint, "none", estimator, robust="all", noise=NOISE)


SMALL = PlaneScene(
    f_px=900.0,
    baseline_mm=(0.3, 0.3),
    n_cols=5,
    n_frames=11,
    size=(83, 63),
    centre=(0.3, -0.2, 80.0),
    zx=0.3,
    zy=-0.2,
    velocity=(0.021, -0.014, 0.06),
    wavelengths_mm=(0.9, 1.1),
    alpha=0.4,
    beta=1.0,
    noise=2.0,
)
OPTIONS: dict[str, object] = {
    "model": "range-flow", "preshift": (-3, 0), "window": 13, "sigma": 4.0, "size_time": 3, "taps_time": "5",
}  # fmt: skip


@functools.cache
def capture(cameras: int = 5, light: bool = False) -> Capture:
    scene = replace(SMALL, n_cols=cameras, brightness=LIGHT if light else ())
    return capture_from_array(render(scene), Geometry(scene.f_px, scene.principal, (scene.baseline_mm[0], 0.0)))


@pytest.fixture
def stack(tmp_path: Path) -> str:
    """Range maps with white noise of .02 mm and a hole, as one .npy file."""
    depth = exact_depth(SMALL)
    depth += np.random.default_rng(1).normal(0, 0.02, depth.shape)
    depth[:, 30:33, 40:43] = np.nan
    np.save(tmp_path / "depth.npy", depth)
    return str(tmp_path / "depth.npy")


def config(**options: object) -> RunConfig:
    return load_config(overrides={**OPTIONS, **options})


@pytest.mark.parametrize("constraint", range_flow.CONSTRAINTS)
@pytest.mark.parametrize("given", [False, True], ids=["own", "given"])
def test_velocity_of_a_plane(stack: str, constraint: str, given: bool) -> None:
    """Errors of a few standard errors, and small ones: the light changes where the constraint allows for it."""
    cameras, depth = (1, stack) if given else (5, None)
    light = constraint == "taylor"
    field = lf.estimate(capture(cameras, light), 5, **OPTIONS, constraint=constraint, depth=depth, stride=4)
    ok = field.status == Status.OK
    assert ok.sum() > (100 if given else 30)
    for i, axis in enumerate("xyz"):
        error = field[f"velocity_{axis}"][ok] - SMALL.velocity[i]
        largest = {"x": 1e-3, "y": 1e-3, "z": 1e-3 if given else 0.035}
        assert np.sqrt(np.mean(error**2)) < largest[axis], axis
        pulls = error / field[f"velocity_{axis}_std"][ok]
        assert 0.6 < np.sqrt(np.mean(pulls**2)) < 1.7, axis
    wanted = exact_depth(SMALL)[5][np.ix_(field.y, field.x)]
    np.testing.assert_allclose(field["depth"][ok], wanted[ok], atol=0.1 if given else 0.4)
    if given:
        assert np.median(field["depth_std"][ok]) == pytest.approx(0.02, rel=0.1)
    if given:
        hole = np.ix_((field.y >= 30) & (field.y < 33), (field.x >= 40) & (field.x < 43))
        assert (field.status[hole] == Status.NOT_FINITE).all()
        assert hole[0].size
        assert hole[1].size
    if light:
        x, y = np.meshgrid(field.x - SMALL.principal[0], field.y - SMALL.principal[1])
        place = [np.array(c) * wanted / SMALL.f_px - m for c, m in zip((x, y), SMALL.centre[:2], strict=True)]
        rate = LIGHT[0].g + LIGHT[0].gx * place[0] + LIGHT[0].gy * place[1]
        np.testing.assert_allclose(field["brightness_t"][ok], rate[ok], atol=6e-3)


def test_every_source_of_range_is_the_same(stack: str, tmp_path: Path) -> None:
    """A stack, a file per frame, and a results store of our own depth; a store gives what own depth gives."""
    maps = np.load(stack)
    for t, image in enumerate(maps):
        np.save(tmp_path / f"z_{t:02d}.npy", image)
        tifffile.imwrite(tmp_path / f"z_{t:02d}.tif", image)
    tifffile.imwrite(tmp_path / "stack.tif", maps, photometric="minisblack")
    whole = lf.estimate(capture(1), 5, **OPTIONS, depth=stack, stride=6)
    for name in ("z_{t:02d}.npy", "z_{t:02d}.tif", "stack.tif"):
        assert_same(whole, lf.estimate(capture(1), 5, **OPTIONS, depth=str(tmp_path / name), stride=6))
    static = {k: v for k, v in OPTIONS.items() if k in ("preshift", "window", "sigma")}
    lf.run(capture(), tmp_path / "depth.zarr", load_config(overrides={"model": "depth", **static}))
    own = lf.estimate(capture(), 5, **OPTIONS)
    stored = lf.estimate(capture(), 5, **OPTIONS, depth=str(tmp_path / "depth.zarr"))
    ok = own.status == Status.OK
    assert ok.sum() > 300
    assert (stored.status[ok] == Status.OK).all()
    for name in ("velocity_x", "velocity_y", "velocity_z"):
        # The working distances differ, and with them the share of the range's noise.
        assert np.max(np.abs(own[name][ok] - stored[name][ok]) / own[f"{name}_std"][ok]) < 0.05


@pytest.mark.parametrize("constraint", ["taylor", "grad"])
@pytest.mark.parametrize("given", [False, True], ids=["own", "given"])
@pytest.mark.parametrize("prefilter", ["none", "homomorphic"])
def test_tiled_equals_whole(stack: str, constraint: str, given: bool, prefilter: str) -> None:
    depth = stack if given else None
    options = {**OPTIONS, "constraint": constraint, "depth": depth, "stride": 2, "prefilter": prefilter, "sigma_pre": 4}
    whole, tiled = (lf.estimate(capture(), 5, **options, tile=tile) for tile in (40, 7))
    assert_same(whole, tiled)


def test_resumed_run_and_single_frames_are_the_same(tmp_path: Path) -> None:
    """Sliding through the sequence, interrupted and resumed, equals one run and equals single frames."""
    wanted = config(tile=16, stride=2)

    def die(progress: Progress) -> None:
        if progress.done_units == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lf.run(capture(), tmp_path / "out.zarr", wanted, progress=die)
    lf.run(capture(), tmp_path / "out.zarr", wanted, resume=True)
    lf.run(capture(), tmp_path / "whole.zarr", wanted)
    assert files_of(tmp_path / "out.zarr") == files_of(tmp_path / "whole.zarr")
    store = lf.ResultStore.open(tmp_path / "out.zarr")
    assert len(store.frames) > 2
    for index, frame in enumerate(store.frames[:2]):
        assert_same(store.field(index), lf.estimate(capture(), frame, **OPTIONS, tile=16, stride=2))


def test_measurable_region_shrinks_by_the_second_window() -> None:
    """Window and filters of depth, of range flow, and the preshift of the outer cameras."""
    plan = lf.plan_run(capture(), config())
    reach = 2 * (6 + 2)
    assert plan.reach("x") == plan.reach("y") == reach
    field = lf.estimate(capture(), 5, **OPTIONS)
    inside = np.argwhere(field.status != Status.BORDER)
    assert inside[:, 0].min() == reach
    assert inside[:, 1].min() == reach + 2 * 3
    assert "window of 13 px before that of range flow" in plan.describe()


def test_weight_of_the_intensity(stack: str) -> None:
    """β shifts the balance: a large one leaves little of the range, which alone tells W well here."""
    errors = [
        lf.estimate(capture(1), 5, **OPTIONS, depth=stack, stride=6, beta=beta)["velocity_z_std"]
        for beta in (1.0, 1000.0)
    ]
    assert np.nanmedian(errors[1]) > 5 * np.nanmedian(errors[0])


def test_noise_of_images() -> None:
    random = np.random.default_rng(2)
    y, x = np.mgrid[:80, :90]
    smooth = 100 + 40 * np.cos(0.3 * x) * np.sin(0.25 * y)
    assert white_noise(smooth + random.normal(0, 1.5, x.shape), False) == pytest.approx(1.5, rel=0.1)
    assert white_noise(np.round(smooth), True) == pytest.approx(12**-0.5, rel=0.2)
    flat = np.full(x.shape, 20.0)
    flat[:, :40] += random.normal(0, 1.5, (80, 40))
    assert white_noise(flat, False) == pytest.approx(1.5, rel=0.2)
    assert white_noise(np.full((20, 20), 7.0), True) == pytest.approx(12**-0.5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"motion": "rotation"}, "motion 'rotation': model 'range-flow' does not have it"),
        ({"rows": "2d"}, "rows '2d': model 'range-flow' has no rows"),
        ({"constraint": "int", "brightness_terms": "space"}, "constraint 'int' takes the brightness for constant"),
        ({"depth": "none_{t}.npy"}, "no such range maps"),
        ({"depth": "z_{sx}.npy"}, "a range map has the field {t} alone"),
        ({"brightness": "temporal"}, "brightness 'temporal' needs a sequence in time"),
    ],
)
def test_choices_that_do_not_fit(options: dict[str, object], message: str) -> None:
    with pytest.raises((ConfigError, InputError), match=re.escape(message)):
        lf.plan_run(capture(), config(**options))


def test_range_maps_that_do_not_fit(tmp_path: Path, stack: str) -> None:
    maps = np.load(stack)
    cases = {
        "short.npy": (maps[:5], "is no stack [t, y, x] of the capture's 11 frames"),
        "small.npy": (maps[:, :20], "a range map of 83 x 20 pixels for images of 83 x 63"),
        "empty.npy": (np.full_like(maps, np.nan), "no finite, positive value"),
        "text.npy": (np.full(maps.shape, "a"), "of type <U1: give depths in mm as floats"),
    }
    for name, (values, message) in cases.items():
        np.save(tmp_path / name, values)
        with pytest.raises(InputError, match=re.escape(message)):
            lf.plan_run(capture(1), config(depth=str(tmp_path / name)))
    for t in range(10):
        np.save(tmp_path / f"z_{t}.npy", maps[t])
    with pytest.raises(InputError, match="1 of 11 range maps are missing, first t = 10"):
        lf.plan_run(capture(1), config(depth=str(tmp_path / "z_{t}.npy")))
    with pytest.raises(
        ConfigError, match="needs a camera grid or range maps, the capture has one camera: give --depth"
    ):
        lf.plan_run(capture(1), config())
    static = {k: v for k, v in OPTIONS.items() if k in ("preshift", "window", "sigma")}
    lf.run(capture(), tmp_path / "thin.zarr", load_config(overrides={"model": "depth", "stride": 20, **static}))
    with pytest.raises(InputError, match="range flow needs depth at every pixel: run with --stride 1"):
        lf.plan_run(capture(), config(depth=str(tmp_path / "thin.zarr")))


def test_cube_under_a_fixed_spot() -> None:
    """Table 4.1, TAYLOR without prefilter: printed .148° on the left face, .056° on the right one."""
    scene = cube.CubeScene(light="spot", omega=(0.0, 0.0, 0.0), size=(481, 161), supersampling=2)
    images = capture_from_array(cube.render(scene).astype(np.uint8), Geometry(scene.f_px, scene.principal, (5.0, 0.0)))
    field = lf.estimate(images, 4, model="range-flow", preshift=(-14, 0), stride=8)
    exact = cube.truth(scene)
    at = np.ix_(field.y, field.x)
    error = aae(np.stack([field[f"velocity_{axis}"] for axis in "xyz"], axis=-1), exact["velocity"][at])
    # Half the window, the filters, and what disparity and motion add.
    faces = {
        side: erode(exact["face"] == label, 45)[at] & np.isfinite(error) for label, side in ((1, "left"), (2, "right"))
    }
    assert all(kept.sum() >= 5 for kept in faces.values())
    assert np.mean(error[faces["left"]]) <= 0.148
    assert np.mean(error[faces["right"]]) <= 0.056
    for kept in faces.values():
        assert abs(np.nanmean(field["growth_rate"][kept])) <= 0.02


def test_range_flow_takes_one_preshift() -> None:
    capture = capture_from_array(np.zeros((7, 1, 5, 60, 60)), Geometry(1000.0, (30.0, 30.0), (1.0, 0.0)))
    with pytest.raises(ConfigError, match=r"preshift 'adaptive': model 'range-flow' takes one.*--preshift uniform"):
        make_plan(capture, load_config(overrides={"model": "range-flow", "preshift": "adaptive"}))
