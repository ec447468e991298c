"""The pipeline's promises: how the work is cut, threaded, resumed or repeated changes no bit of the result."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from small_plane import OPTIONS, SCENE, assert_same, capture_of, config, files_of, running_threads, write_compressed

import leafflow_ti as lf
from leafflow_ti.bands import least_limit
from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.models import MODELS
from leafflow_ti.plan import Plan, make_plan
from leafflow_ti.runtime import start
from leafflow_ti.status import Status
from leafflow_ti.synthetic.plane import render, truth
from leafflow_ti.synthetic.write import write_scene


@pytest.fixture(scope="module")
def capture() -> Capture:
    return capture_of(SCENE)


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


@pytest.fixture(scope="module")
def on_disk(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """A folder of compressed images, and what they hold."""
    folder = tmp_path_factory.mktemp("disk") / "capture"
    return folder, write_compressed(folder)


@pytest.mark.parametrize("more", [{}, {"prefilter": "highpass", "sigma_pre": 2.0}])
def test_reading_ahead_changes_nothing(
    on_disk: tuple[Path, np.ndarray], tmp_path: Path, more: dict[str, object]
) -> None:
    folder, images = on_disk
    in_memory = capture_from_array(images, Geometry(SCENE.f_px, SCENE.principal, SCENE.baseline_mm))
    files = lf.open_capture(folder)
    wanted = config(tile=16, frames="4:7", **more)
    assert [lf.plan_run(c, wanted).read_ahead for c in (files, in_memory)] == [2, 0]
    threads = running_threads()
    for name, source in (("files.zarr", files), ("memory.zarr", in_memory)):
        lf.run(source, tmp_path / name, wanted)
    assert running_threads() <= threads
    assert files_of(tmp_path / "files.zarr") == files_of(tmp_path / "memory.zarr")
    assert (lf.ResultStore.open(tmp_path / "files.zarr").read("status") == Status.NOT_FINITE).any()


def test_little_memory_means_less_reading_ahead(
    on_disk: tuple[Path, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    for taken in ("PROCESS_BYTES", "COMPILING_BYTES"):  # more than these small images need
        monkeypatch.setattr(f"leafflow_ti.bands.{taken}", 0)
    files = lf.open_capture(on_disk[0])

    def planned(**limit: object) -> Plan:
        large = {
            "model": "affine-scene-flow",
            "refine": 0,
            "window": 31,
            "prefilter": "highpass",
            "sigma_pre": 80,
            "tile": 43,
        }
        return lf.plan_run(files, config(**large, **limit))

    plenty = planned()
    scarce = planned(max_memory=least_limit(plenty.bytes) - 1000)
    assert (plenty.read_ahead, scarce.read_ahead) == (2, 1)
    # 5 cameras, 4 bytes and one that says whether the value is finite; around 61 x 43 pixels one more on each side for
    # the growth, half a window, half a filter of 5 taps twice, and four sigmas of the prefilter.
    reach = 2 * (1 + 15 + 2 + 2 + 320)
    assert plenty.bytes - scarce.bytes == 5 * 5 * (61 + reach) * (43 + reach)


def test_decoded_images_are_kept_where_bands_share_them(tmp_path: Path) -> None:
    """One strip an image: whole images are decoded."""
    write_scene(replace(SCENE, bits=8), tmp_path / "capture")
    for path in (tmp_path / "capture").rglob("*.tif"):
        tifffile.imwrite(path, tifffile.imread(path), compression="zlib")
    files = lf.open_capture(tmp_path / "capture")
    every = 13 * 5 * 43 * 61
    several, one = (lf.plan_run(files, config(tile=tile)) for tile in (16, 43))
    assert (several.bands, several.cache_bytes) == (3, every)
    assert (one.bands, one.cache_bytes) == (1, 0)
    assert several.bytes > every
    lf.run(files, tmp_path / "one.zarr", config(tile=43, frames="4:5"))
    assert files._cache.used == 0
    lf.run(files, tmp_path / "several.zarr", config(tile=16, frames="4:5"))
    assert files._cache.used == 9 * 5 * 43 * 61  # the frames that this run needs


RUN_WITH_THREADS = """
import sys
import leafflow_ti as lf
from small_plane import SCENE, capture_of, config
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
    from leafflow_ti.kernels import maps, spec
    from leafflow_ti.stages import tensor

    assert maps.Output.PLANES == tensor.OUTPUT_PLANES
    assert spec.EXTRA_PLANES == tensor.EXTRA_PLANES


def test_the_engine_is_left_as_it_was() -> None:
    from leafflow_ti.kernels.engine import ENGINE, lane_kernel, quick_front_end, ti

    contexts = importlib.import_module(f"{ENGINE}.lang.ast.ast_transformer_utils")
    if ENGINE == "taichi":
        kernels = importlib.import_module("taichi.lang.kernel_impl")
        places = ((kernels, "getsourcelines"), (kernels, "textwrap"), (contexts.ASTTransformerContext, "get_pos_info"))
    else:
        kernels = importlib.import_module("quadrants.lang._func_base")
        places = (
            (kernels, "get_source_info_and_src"), (kernels, "textwrap"),
            (contexts.ASTTransformerFuncContext, "_build_pos_info"),
        )  # fmt: skip

    def settings() -> tuple[object, ...]:
        return tuple(getattr(*place) for place in places)

    usual = settings()
    with quick_front_end():
        assert not any(one is other for one, other in zip(settings(), usual, strict=True))
    assert settings() == usual
    with pytest.raises(RuntimeError, match="stop"), quick_front_end(), quick_front_end():
        raise RuntimeError("stop")
    assert settings() == usual

    start()
    config = ti.lang.impl.current_cfg()

    def set_now() -> tuple[bool, bool]:
        return config.real_matrix_scalarize, config.advanced_optimization

    engine_wide = set_now()
    for long in (False, True):
        whole = lane_kernel(16, long)(set_now)
        whole._kernel = set_now
        assert whole() == (False, engine_wide[1] and not long)
        assert set_now() == engine_wide


@pytest.mark.parametrize("model", ["affine-4d", "affine-scene-flow"])
def test_steps_launched_apart_give_the_same_bits(bench: Callable, model: str) -> None:
    b = bench(model, "none", "line-x", "f32")
    motion = MODELS[model].motions[0]
    apart, together = (b.estimate(motion, apart=apart) for apart in (True, False))
    np.testing.assert_array_equal(together.status, apart.status)
    for name in ("disparity", "depth", "slope_x", "slope_y", "flow_x", "flow_y", *(f"velocity_{a}" for a in "xyz")):
        for one, other in zip(together.map(name), apart.map(name), strict=True):
            np.testing.assert_array_equal(one, other)


def test_kept_stages_measure_as_new_ones(capture: Capture) -> None:
    """Stages that have seen other images, invalid pixels among them, and another region give the same bits."""
    from leafflow_ti import engines

    options = OPTIONS | {"model": "affine-scene-flow", "refine": 0, "frame": 6, "roi": (14, 10, 46, 34)}
    images = capture.block(range(13), (0,), range(5), 0, 43, 0, 61, (0, 0), np.float32)
    spoilt = images.copy()
    spoilt[6, 0, 2, 20, 30] = np.nan
    clean, holed = (capture_from_array(i, capture.geometry) for i in (images, spoilt))

    def measure(seen: Capture, **other: object) -> lf.Field:
        return lf.estimate(seen, **{**options, **other})

    wanted = []
    for seen in (clean, holed):
        lf.release()
        wanted.append(measure(seen))
    assert (wanted[1].status == Status.OK).sum() < (wanted[0].status == Status.OK).sum()
    lf.release()
    measure(clean)
    used = engines._kept[0]
    for seen, field in zip((holed, clean, holed), (wanted[1], wanted[0], wanted[1]), strict=True):
        found = measure(seen)
        assert engines._kept[0] is used
        np.testing.assert_array_equal(found.status, field.status)
        for name in field:
            np.testing.assert_array_equal(found[name], field[name])
    # The same size elsewhere: the stages move; another size needs its own, and the old ones are gone.
    moved = measure(clean, roi=(16, 12, 48, 36))
    assert engines._kept[0] is used
    np.testing.assert_array_equal(moved["depth"][:-2, :-2], wanted[0]["depth"][2:, 2:])
    measure(clean, roi=(14, 10, 46, 32))
    assert engines._kept[0] is not used
    lf.release()
    assert not engines._kept
