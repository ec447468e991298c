"""Range flow: stages against the naive twin, exact scenes, and the pipeline around them."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from reference import range_flow as twin
from test_kernels_tensor import relative_error
from tolerances import tolerance

from leafflow_ti import range_flow
from leafflow_ti.filters import filter_set
from leafflow_ti.models import TensorLayout
from leafflow_ti.runtime import Device
from leafflow_ti.sampling import AxisSampling, Sampling
from leafflow_ti.stages.estimate import DENOISE, EstimateStage, Problem, View
from leafflow_ti.stages.tensor import EXTRA_PLANES, Band, TensorStage
from leafflow_ti.status import Status
from leafflow_ti.synthetic.plane import BrightnessTerm, PlaneScene, render

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


def estimated(device: Device, constraint: str, terms: str, estimator: str = "tls-equilibrated") -> tuple:
    """Columns, full tensors [rows, cols, N, N], ρ and the planes of ``Output``."""
    images, depth, noise = inputs(constraint == "taylor")
    columns = range_flow.columns(constraint, SAMPLING, SCENE.f_px, terms, 1 / BETA**2)
    layout = TensorLayout.of(columns)
    stage = TensorStage(device, columns, layout, SAMPLING, BAND)
    gradients = [g for g, _ in twin.gradients(images, SAMPLING)]
    stack = dict(zip(range_flow.STACK, (images, np.nan_to_num(depth - WORKING), *gradients), strict=True))
    for t in range(len(images)):
        block = np.array([stack[name][t] for name in range_flow.images(constraint)])[None]
        planes = range_flow.factors(depth[t], noise[t], WORKING, SCENE.f_px, NOISE, BETA)
        packed = stage.push(block, np.isfinite(depth[t]), planes)
    x, y = SCENE.principal
    view = View(
        SCENE.f_px, (x, y), (0.0, 0.0), (0.0, 0.0), BAND.halo_x, BAND.halo_y, BAND.stride, BAND.rows, BAND.cols,
        stage.out_pitch,
    )  # fmt: skip
    problem = Problem(columns, SAMPLING, estimator, fitted=3, range_scale=WORKING / SCENE.f_px)
    maps = np.array(EstimateStage(device, problem, layout, view)(packed))
    n = (len(layout.entries) + EXTRA_PLANES) * BAND.rows * stage.out_pitch
    planes = np.array(device.host(packed)[:n], np.float64).reshape(-1, BAND.rows, stage.out_pitch)[..., : BAND.cols]
    J = np.zeros((BAND.rows, BAND.cols, columns.n, columns.n))
    J[..., *np.tril_indices(columns.n)] = np.moveaxis(planes[list(layout.lower)], 0, -1)
    J += np.swapaxes(np.tril(J, -1), -1, -2)
    return columns, J, planes[-2] / planes[-3], maps


def check(device: Device, constraint: str, terms: str, estimator: str) -> None:
    from leafflow_ti.kernels.maps import Output

    columns, J, rho, maps = estimated(device, constraint, terms, estimator)
    images, depth, noise = inputs(constraint == "taylor")
    limit = tolerance(device)
    for row, col in PIXELS:
        x, y = BAND.halo_x + BAND.stride * col, BAND.halo_y + BAND.stride * row
        wanted = twin.structure_tensor(
            images, depth, noise, NOISE, BETA, constraint, terms, SAMPLING, SCENE.f_px, WORKING, (x, y)
        )
        # Range and its derivative in time differ by a factor of 1e3, the rounding of both counts.
        assert relative_error(J[row, col], wanted) <= 2 * limit.tensor
        assert maps[Output.STATUS, row, col] == Status.OK
        N, cov, light, spread = twin.velocity(
            wanted, rho[row, col], columns, SAMPLING, estimator, DENOISE[estimator], SCENE.f_px, WORKING,
            x - SCENE.principal[0], y - SCENE.principal[1],
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


@pytest.mark.parametrize(("constraint", "estimator"), list(product(("taylor", "intgrad"), ("ols", "tls"))))
def test_other_estimators(device: Callable[[str], Device], constraint: str, estimator: str) -> None:
    check(device("f64"), constraint, "none", estimator)
