"""Fixtures of several test files: devices, and benches built once per model, brightness, grid and precision."""

from __future__ import annotations

import functools
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from estimate_bench import (
    CASES,
    COLS,
    GRIDS,
    LIGHT,
    ROWS,
    SCENE,
    STRIDE,
    Bench,
    MakeBench,
    rendered,
    sampling_of,
)

from leafflow_ti.models import MODELS, ColumnSet, column_set
from leafflow_ti.runtime import Device, start
from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.tensor import Band

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # In the background of a script Ctrl-C is ignored, and programs that tests start and stop would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)

TOGETHER = {
    "estimate": "estimators kernels_estimate kernels_status kernels_tensor kernels_accuracy cut_windows second_order "
    "identifiability",
    "adaptive": "adaptive adaptive_scenes adaptive_runs adaptive_times",
    "refine": "refine refine_pipeline refine_warp refine_twin speckle leaf_growth strain_peers",
    "rig": "rig rig_check check",
}
"""Files, but for ``test_`` and ``.py``, that need the same kernels: one worker runs them, and compiles these once."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """``--dist loadfile`` that keeps the files of ``TOGETHER`` together, too."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    group_of = {f"test_{name}.py": group for group, names in TOGETHER.items() for name in names.split()}
    absent = [name for name in group_of if not (Path(__file__).parent / name).is_file()]
    assert not absent, f"TOGETHER names {absent}, which do not exist"

    class ByKernels(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return group_of.get(Path(file).name, file)

    return ByKernels(config, log)


@pytest.fixture(params=CASES, ids="-".join)
def case(request: pytest.FixtureRequest) -> tuple[str, str, str]:
    """Model, brightness and grid: the test runs for all ``CASES``."""
    return request.param


@pytest.fixture(params=["f64", "f32"])
def precision(request: pytest.FixtureRequest) -> str:
    """The test runs in both precisions."""
    return request.param


@pytest.fixture(scope="session")
def device() -> Callable[[str], Device]:
    """The device of this process (``LEAFFLOW_TI_ARCH``, else the CPU) in a precision."""
    return functools.cache(lambda precision: start("auto", precision))


@pytest.fixture(scope="session")
def bench(device: Callable[[str], Device]) -> MakeBench:
    """``bench(model, brightness, grid, precision)``: the scene as that model sees it."""

    @functools.cache
    def make(
        model: str, brightness: str, grid: str, precision: str,
        stride: int = STRIDE, cols: int = COLS, terms: str = "none",
    ) -> Bench:  # fmt: skip
        sampling = sampling_of(grid, MODELS[model].time, cameras=MODELS[model].cameras)
        band = Band.of(sampling, ROWS, cols, stride)
        scene = replace(SCENE, brightness=LIGHT if brightness != "none" else ())
        images = rendered(scene, grid, (band.in_cols, band.in_rows))
        if MODELS[model].cameras == "line" and min(GRIDS[grid]) > 1:
            images = images[:, GRIDS[grid][0] // 2][:, None]
        if not MODELS[model].time:
            images = images[SCENE.n_frames // 2][None]
        columns = column_set(MODELS[model], brightness, sampling.camera_axes, sampling.sampled, terms)
        return Bench(device(precision), images, sampling, columns, band, model, None, brightness, terms)

    return make


@pytest.fixture(scope="session")
def make_bench(device: Callable[[str], Device]) -> MakeBench:
    """A bench for given images [t, sy, sx, y, x], with as many output pixels as they allow."""

    def make(
        images: np.ndarray, sampling: Sampling, columns: ColumnSet, precision: str = "f64",
        shape: Sequence[int] = (1, 1), stride: int = 1, valid: np.ndarray | None = None,
    ) -> Bench:  # fmt: skip
        band = Band.of(sampling, *shape, stride)
        assert images.shape[3:] == (band.in_rows, band.in_cols)
        return Bench(device(precision), images, sampling, columns, band, valid=valid)

    return make
