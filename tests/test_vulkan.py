"""The same kernels on the Vulkan back end, in a process of its own: an engine runs one arch per process.

``test_suite_on_vulkan`` starts it; the functions ``on_vulkan_*`` are what it runs there. Skipped only where no Vulkan
driver is installed, and not even there with ``LEAFFLOW_TI_REQUIRE_VULKAN=1``, as the continuous integration sets.
"""

from __future__ import annotations

import ctypes.util
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import test_backend_eigen
import test_cut_windows
import test_estimators
import test_kernels_tensor
import test_range_flow
import test_refine
from reference import chain, patch
from refine_bench import SCENE, Case, covariance, estimated
from test_backend_flow import assert_follow_equals_twin
from test_backend_tensors import assert_gaussian_equals_scipy
from test_kernels_estimate import assert_maps_equal
from test_prefilter import assert_equals_twin
from test_search import assert_search_equals_twin
from test_surfaces import assert_hidden_equals_naive
from tolerances import SOLVERS, tolerance

from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.stages.prefilter import PREFILTERS
from leafflow_ti.status import Status

pytestmark = pytest.mark.vulkan
PIXELS = ((0, 0), (1, 3), (2, 4))
SYSTEMS = [
    ("depth", "none", "line-x", None),
    ("depth", "camera", "square", None),
    ("flow-affine", "none", "single", None),
    ("affine-4d", "none", "line-x", "rotation"),
    ("affine-scene-flow", "temporal", "line-x", "acceleration"),
]
WEIGHTED = [
    *(("flow-affine", name) for name, estimator in ESTIMATORS.items() if estimator.weighs),
    ("affine-scene-flow", "robust-tls"),
]


def driver_installed() -> bool:
    """Whether a loader and at least one driver are there."""
    chosen = os.environ.get("VK_DRIVER_FILES") or os.environ.get("VK_ICD_FILENAMES")
    roots = (Path("/etc/vulkan/icd.d"), Path("/usr/share/vulkan/icd.d"))
    files = chosen.split(os.pathsep) if chosen else [f for root in roots for f in root.glob("*.json")]
    return ctypes.util.find_library("vulkan") is not None and bool(files)


def test_suite_on_vulkan() -> None:
    if not driver_installed() and os.environ.get("LEAFFLOW_TI_REQUIRE_VULKAN") != "1":
        pytest.skip("no Vulkan driver is installed (apt-get install libvulkan1 mesa-vulkan-drivers)")
    command = [
        sys.executable, "-m", "pytest", __file__, "-q", "-p", "no:cacheprovider", "-o", "python_functions=on_vulkan_*",
    ]  # fmt: skip
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")} | {"LEAFFLOW_TI_ARCH": "vulkan"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=540, check=False)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert f"{len(SYSTEMS) + len(WEIGHTED) + len(PREFILTERS) + 15} passed" in done.stdout


def on_vulkan_the_engine_really_runs_on_it(device: Callable) -> None:
    from leafflow_ti.kernels.engine import ti

    assert device("f32").arch == "vulkan"
    assert device("f32").gpu
    assert ti.lang.impl.current_cfg().arch == ti.vulkan


def on_vulkan_eigenproblems_are_solved(device: Callable) -> None:
    some = test_backend_eigen.matrices(6).astype(np.float32)
    values, vectors = test_backend_eigen.solved(device("f32"), some, 6)
    test_backend_eigen.assert_solved(some, values, vectors, test_backend_eigen.BOUND[np.float32])


def on_vulkan_planes_of_tensors_are_solved() -> None:
    for n, count in ((2, 3), (3, 70)):
        test_backend_eigen.assert_planes_are_solved(n, count, np.float32)


def on_vulkan_a_gaussian_is_that_of_scipy() -> None:
    assert_gaussian_equals_scipy((6, 7, 80), np.float32, "constant")


def on_vulkan_filtering_is_correlation(device: Callable) -> None:
    """The plane kernel alone: shifts, weights, strides and a displaced target."""
    from leafflow_ti.stages.planes import Filtering

    d = device("f32")
    random = np.random.default_rng(1)
    rows, pitch, weights = 6, 64, random.normal(size=5)
    planes = random.normal(size=(2, 2 * rows + 4, pitch)).astype(np.float32)
    size = planes[0].size
    terms = [[(p * size + r * pitch, float(w)) for r, w in enumerate(weights)] for p in range(2)]
    target = d.array(np.zeros(10 + 2 * rows * pitch))
    Filtering(d, terms, rows, pitch, 2 * pitch)(d.array(planes), target, 10)
    wanted = [sum(w * plane[r : r + 2 * rows : 2].astype(float) for r, w in enumerate(weights)) for plane in planes]
    found = d.host(target)
    np.testing.assert_allclose(found[10:].reshape(2, rows, pitch), wanted, atol=1e-5)
    assert not found[:10].any()


@pytest.mark.parametrize(("model", "brightness", "grid", "motion"), SYSTEMS)
def on_vulkan_the_chain_equals_the_twin(
    bench: Callable, model: str, brightness: str, grid: str, motion: str | None
) -> None:
    b = bench(model, brightness, grid, "f32")
    limit = tolerance(b.device)
    found = b.estimate(motion)
    for pixel in PIXELS:
        J, _ = b.reference(*pixel)
        scale = np.sqrt(np.diag(J))
        assert np.max(np.abs(b.tensor(*pixel) - J) / np.outer(scale, scale)) <= limit.tensor
        assert found.status[pixel] == Status.OK
        solved, own = b.solved(*pixel, found.problem)
        reference = patch.measure(solved, found.problem, b.view, *b.position(*pixel), own)
        for name, (value, std) in reference.items():
            map_value, map_std = (m[pixel] for m in found.map(name))
            assert abs(map_value - value) <= limit.maps * std, name
            assert map_std == pytest.approx(std, rel=limit.errors), name


@pytest.mark.parametrize(("model", "estimator"), WEIGHTED)
def on_vulkan_windows_weighted_anew_equal_the_twin(bench: Callable, model: str, estimator: str) -> None:
    b = bench(model, "none", test_estimators.GRIDS[model], "f32")
    found = b.estimate(test_estimators.motion_of(model), estimator=estimator, robust="all", noise=1.0)
    assert_maps_equal(b, found)


@pytest.mark.parametrize(("size", "stride"), [(31, 3), (37, 4)])
def on_vulkan_windows_of_blocks_equal_direct_sums(make_bench: Callable, size: int, stride: int) -> None:
    test_kernels_tensor.test_windows_of_blocks_equal_direct_sums(make_bench, "affine-4d", size, stride, "f32")


@pytest.mark.parametrize("kind", PREFILTERS)
def on_vulkan_the_prefilter_equals_the_twin(device: Callable, kind: str) -> None:
    assert_equals_twin(device("f32"), kind, 1e-6)


def on_vulkan_range_flow_equals_the_twin(device: Callable) -> None:
    test_range_flow.check(device("f32"), "taylor", "none", "tls-equilibrated")


def on_vulkan_the_solvers_agree(bench: Callable) -> None:
    b = bench("affine-4d", "none", "line-x", "f32")
    fast, full = (b.estimate(solver=solver) for solver in ("fast", "jacobi"))
    for pixel in PIXELS:
        P, variance = chain.solve(b.tensor(*pixel), b.columns, b.sampling, "tls-equilibrated")
        cov = chain.covariances(b.tensor(*pixel), variance, b.columns, b.sampling)
        std = np.sqrt([np.diag(cov[k, k]) for k in range(b.columns.n_time_like)])
        assert np.max(np.abs(fast.parameters[pixel] - full.parameters[pixel]) / std) <= SOLVERS
        assert np.max(np.abs(full.parameters[pixel] - P.T) / std) <= tolerance(b.device).parameters


def on_vulkan_the_refinement_equals_the_twin(device: Callable) -> None:
    """Every stage a launch of its own; as on the CPU, a step below a tenth of a standard error ends it."""
    case = Case(replace(SCENE, n_cols=5, n_frames=5, noise=0.1), modes=1, terms=3, steps=6)
    valid = np.ones(case.images.shape, bool)
    valid[1, 0, 40] = False
    found, wanted = case.refine(device("f32")), case.twin()
    assert found.converged.all()
    errors = np.sqrt(np.diag(wanted.covariance))
    assert np.abs(estimated(found.parameters[0] - wanted.state, case) / errors).max() < 0.05
    np.testing.assert_allclose(np.sqrt(np.diag(covariance(found, case))) / errors, 0.997, atol=0.015)
    holed = [
        case.refine(device("f32"), images=np.where(valid, case.images, garbage), valid=valid)
        for garbage in (0.0, 255.0)
    ]
    assert holed[0].converged.all()
    np.testing.assert_array_equal(holed[0].parameters, holed[1].parameters)
    assert (holed[0].parameters != found.parameters).any()


def on_vulkan_cut_windows_equal_the_twin(bench: Callable) -> None:
    b = test_cut_windows.masked(bench("affine-4d", "spatial", "line-y", "f32"), "corner")
    test_cut_windows.assert_parameters_equal(b, "tls-equilibrated", ("fast",))


def on_vulkan_what_is_hidden_equals_naive_loops(device: Callable) -> None:
    assert_hidden_equals_naive(device, (3, 5))


def on_vulkan_the_search_equals_its_twin(device: Callable) -> None:
    assert_search_equals_twin(device("f32"), "line", 0.5, 1e-5)


def on_vulkan_a_flat_patch_equals_the_twin(device: Callable) -> None:
    case = test_refine.CASES["flat, uneven times"]
    found, wanted = case.refine(device("f32")), case.twin()
    assert found.converged.all()
    errors = np.sqrt(np.diag(wanted.covariance))
    assert np.abs(estimated(found.parameters[0] - wanted.state, case) / errors).max() < 0.05
    np.testing.assert_allclose(np.sqrt(np.diag(covariance(found, case))) / errors, 0.997, atol=0.015)


def on_vulkan_following_equals_naive_loops(device: Callable) -> None:
    assert_follow_equals_twin(device("f32"), 2, True, 1e-3)
