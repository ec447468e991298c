"""The pipeline's promises: how the work is cut, threaded, resumed or repeated changes no bit of the result."""

from __future__ import annotations

import hashlib
import importlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import leafflow_ti as lf
from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.config import RunConfig, load_config
from leafflow_ti.plan import make_plan
from leafflow_ti.progress import Progress
from leafflow_ti.stages.tensor import OUTPUT_PLANES
from leafflow_ti.status import Status
from leafflow_ti.synthetic.plane import PlaneScene, render, truth

SCENE = PlaneScene(
    f_px=900.0,
    baseline_mm=(0.3, 0.3),
    n_cols=5,
    n_frames=13,
    size=(61, 43),
    centre=(0.3, -0.2, 80.0),
    zx=0.3,
    zy=-0.2,
    velocity=(0.021, -0.014, 0.06),
    omega=(0.002, -0.003, 0.004),
    wavelengths_mm=(0.6, 0.75),
    alpha=0.4,
    beta=1.0,
    noise=1.0,
)
OPTIONS: dict[str, object] = {
    "model": "affine-4d",
    "motion": "rotation",
    "preshift": (-3, 0),
    "window": 9,
    "sigma": 2.5,
}


def capture_of(scene: PlaneScene, **geometry: tuple[float, float]) -> Capture:
    return capture_from_array(render(scene), Geometry(scene.f_px, scene.principal, scene.baseline_mm, **geometry))


@pytest.fixture(scope="module")
def capture() -> Capture:
    return capture_of(SCENE)


def config(**options: object) -> RunConfig:
    return load_config(overrides={**OPTIONS, **options})


def files_of(store: Path) -> dict[str, str]:
    """Checksum of every file of a store but the attributes, which hold timings."""
    files = [p for p in store.rglob("*") if p.is_file() and p != store / "zarr.json"]
    return {str(p.relative_to(store)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def assert_same(one: lf.Field, two: lf.Field, part: tuple[slice, slice] = (slice(None), slice(None))) -> None:
    """``two`` equals ``part`` of ``one``, bit for bit."""
    assert list(one) == list(two)
    np.testing.assert_array_equal(one.status[part], two.status)
    assert (two.status == 0).any()
    for name in one:
        np.testing.assert_array_equal(one[name][part].view(np.int32), two[name].view(np.int32), err_msg=name)


@pytest.mark.parametrize("precision", ["f32", "f64"])
@pytest.mark.parametrize("tile", [1, 5, 16])
def test_tiled_equals_whole(capture: Capture, tile: int, precision: str) -> None:
    whole = lf.estimate(capture, 6, **OPTIONS, tile=43, precision=precision)
    assert_same(whole, lf.estimate(capture, 6, **OPTIONS, tile=tile, precision=precision))


@pytest.mark.parametrize("stride", [2, 4])
def test_tiled_equals_whole_with_windows_of_blocks(capture: Capture, stride: int) -> None:
    options = {**OPTIONS, "window": 19, "sigma": 5.0, "stride": stride}
    assert "in 9 blocks of 2" in make_plan(capture, config(**options)).describe()
    whole, tiled = (lf.estimate(capture, 6, **options, tile=tile) for tile in (22, 3))
    assert_same(whole, tiled)


def test_tiled_equals_whole_with_stride_and_mask(capture: Capture, tmp_path: Path) -> None:
    mask = tmp_path / "mask.pgm"
    keep = np.full((43, 61), 255, np.uint8)
    keep[10:20, 25:33] = 0
    mask.write_bytes(b"P5 61 43 255\n" + keep.tobytes())
    whole, tiled = (lf.estimate(capture, 6, **OPTIONS, stride=3, mask=mask, tile=tile) for tile in (15, 4))
    assert_same(whole, tiled)
    assert (whole.status == Status.MASKED).sum() == np.sum(keep[::3, ::3] == 0)


@pytest.mark.parametrize("stride", [1, 3])
def test_region_equals_crop_of_whole(capture: Capture, stride: int) -> None:
    whole = lf.estimate(capture, 6, **OPTIONS, stride=stride)
    x0, y0 = 6 * stride, 3 * stride
    region = lf.estimate(capture, 6, **OPTIONS, stride=stride, roi=(x0, y0, x0 + 30, y0 + 25))
    part = tuple(slice(n, n + size) for n, size in zip((3, 6), region.shape, strict=True))
    np.testing.assert_array_equal(whole.y[part[0]], region.y)
    np.testing.assert_array_equal(whole.x[part[1]], region.x)
    assert_same(whole, region, part)


def test_sliding_through_a_sequence_equals_single_frames(capture: Capture, tmp_path: Path) -> None:
    lf.run(capture, tmp_path / "out.zarr", config(tile=20))
    store = lf.ResultStore.open(tmp_path / "out.zarr")
    assert store.frames == tuple(range(4, 9))
    for index, frame in enumerate(store.frames):
        assert_same(store.field(index), lf.estimate(capture, frame, **OPTIONS, tile=20))


def test_second_run_writes_the_same_bytes(capture: Capture, tmp_path: Path) -> None:
    for name in ("one.zarr", "two.zarr"):
        lf.run(capture, tmp_path / name, config(frames="5:7", tile=16))
    first = files_of(tmp_path / "one.zarr")
    assert first == files_of(tmp_path / "two.zarr")
    assert any(name.startswith("depth/c/") for name in first)


@pytest.mark.parametrize("stop_after", [1, 4, 8])
def test_resumed_run_ends_with_the_same_bytes(capture: Capture, tmp_path: Path, stop_after: int) -> None:
    """Nine units; the run dies in the middle of a band, or between bands."""
    wanted = config(frames="4:7", tile=16)

    def die(progress: Progress) -> None:
        if progress.done_units == stop_after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lf.run(capture, tmp_path / "out.zarr", wanted, progress=die)
    assert len(lf.ResultStore.open(tmp_path / "out.zarr").done()) == stop_after
    lf.run(capture, tmp_path / "out.zarr", wanted, resume=True)
    lf.run(capture, tmp_path / "whole.zarr", wanted)
    assert files_of(tmp_path / "out.zarr") == files_of(tmp_path / "whole.zarr")


RUN_WITH_THREADS = """
import sys
import leafflow_ti as lf
from test_pipeline import SCENE, capture_of, config
for precision in ("f32", "f64"):
    options = {"frames": "6:7", "threads": int(sys.argv[1]), "precision": precision}
    lf.run(capture_of(SCENE), f"{sys.argv[2]}/{precision}.zarr", config(**options))
"""


def test_one_thread_equals_two(tmp_path: Path) -> None:
    """Threads are fixed when the engine starts: each number has a process of its own."""
    found = []
    for threads in ("1", "2"):
        folder = tmp_path / threads
        folder.mkdir()
        command = [sys.executable, "-c", RUN_WITH_THREADS, threads, str(folder)]
        environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
        subprocess.run(command, check=True, env=environment, timeout=300)
        devices = {lf.ResultStore.open(p).attrs["device"] for p in folder.glob("*.zarr")}
        assert len(devices) == 2
        assert all(f"({threads} threads)" in device for device in devices)
        found.append({p.name: files_of(p) for p in folder.glob("*.zarr")})
    assert found[0] == found[1]


def test_stated_disparity_offset_is_part_of_the_depth() -> None:
    """A light field sheared by a fraction of a pixel per step, as cameras along y would record it."""
    offset = -0.4
    scene = replace(SCENE, n_cols=1, n_rows=5, n_frames=1, noise=0.0)
    x, y = scene.principal
    sheared = [replace(scene, principal_px=(x, y - offset * (row - 2))) for row in range(5)]
    images = np.concatenate([render(s, cameras=([row], [0])) for row, s in enumerate(sheared)], axis=1)
    geometry = Geometry(scene.f_px, scene.principal, (0.0, 0.3), (0.0, offset))
    field = lf.estimate(capture_from_array(images, geometry), model="depth", preshift=(0, -3), window=9, stride=2)
    ok = field.status == Status.OK
    assert ok.sum() > 100
    depth = truth(scene)["depth"][::2, ::2]
    assert np.max(np.abs(field["depth"][ok] / depth[ok] - 1)) < 2e-3


def test_plan_counts_every_output_plane() -> None:
    # The plan is made without the engine, so it cannot ask the kernels.
    from leafflow_ti.kernels.maps import Output

    assert Output.PLANES == OUTPUT_PLANES


def test_front_end_of_the_engine_is_left_as_it_was() -> None:
    from leafflow_ti.kernels.engine import ENGINE, quick_front_end

    front_end = importlib.import_module(f"{ENGINE}.lang.ast.ast_transformer_utils")
    usual = front_end.TextWrapper
    with quick_front_end():
        assert front_end.TextWrapper is not usual
    assert front_end.TextWrapper is usual
