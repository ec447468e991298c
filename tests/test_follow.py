"""Captures that are still being taken: frames are measured when they are whole, and the end is that of a batch run."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile

import leafflow_ti as lf
from leafflow_ti import growing
from leafflow_ti.capture import Arrivals
from leafflow_ti.config import RunConfig, load_config
from leafflow_ti.errors import ConfigError, InputError, PartlyDone
from leafflow_ti.provenance import differences
from leafflow_ti.results import ResultStore

FRAMES, CAMERAS = 8, 3
SETTLE_S = 0.05
OPTIONS = {"window": 9, "sigma": 2.5, "refine": 0, "taps_time": "3", "size_time": 3, "tile": 12}


@pytest.fixture(scope="module")
def taken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole capture: 3 cameras, 8 frames of smooth texture that moves."""
    folder = tmp_path_factory.mktemp("taken")
    rng = np.random.default_rng(3)
    waves = [(rng.normal(0, 0.35, 2), rng.uniform(0, 6.3)) for _ in range(24)]
    y, x = np.mgrid[:28, :40].astype(float)
    for t in range(FRAMES):
        for sx in range(CAMERAS):
            at_x, at_y = x - 0.3 * t + 0.4 * (sx - 1), y - 0.1 * t
            grey = 128 + 10 * sum(np.sin(k[0] * at_x + k[1] * at_y + phase) for k, phase in waves)
            tifffile.imwrite(folder / f"c{sx}_{t:03d}.tif", np.clip(grey, 0, 255).astype(np.uint8), compression="zlib")
    (folder / "capture.toml").write_text(
        '[images]\npattern = "c{sx}_{t:03d}.tif"\n[camera]\nfocal_length_px = 1500.0\n[grid]\nbaseline_mm = 5.0\n'
        "disparity_offset_px = -20.0\n[time]\ninterval_s = 60.0\n",
        encoding="utf-8",
    )
    return folder


@pytest.fixture
def growing_folder(taken: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "capture"
    folder.mkdir()
    shutil.copy(taken / "capture.toml", folder)
    return folder


def config(**options: object) -> RunConfig:
    return load_config(overrides={**OPTIONS, **options})


def files_of(store: Path) -> dict[str, bytes]:
    files = [p for p in store.rglob("*") if p.is_file() and p != store / "zarr.json" and ".locks" not in p.parts]
    return {str(p.relative_to(store)): p.read_bytes() for p in files}


def name(sx: int, t: int) -> str:
    return f"c{sx}_{t:03d}.tif"


def give(taken: Path, folder: Path, t: int, cameras: range = range(CAMERAS)) -> None:
    for sx in cameras:
        shutil.copyfile(taken / name(sx, t), folder / name(sx, t))


def in_awkward_ways(taken: Path, folder: Path) -> None:
    """Half a file, then the rest; a camera late; frames out of order; renamed into place; files of others."""
    (folder / "notes.txt").write_text("not an image")
    for t in range(3):
        give(taken, folder, t)
        time.sleep(SETTLE_S)
    give(taken, folder, 4)  # before frame 3
    give(taken, folder, 3, range(1, CAMERAS))
    content = (taken / name(0, 3)).read_bytes()
    with (folder / name(0, 3)).open("wb", buffering=0) as file:
        for part in (content[:8], content[8:200], content[200:]):
            file.write(part)
            time.sleep(SETTLE_S / 2)
    for t in range(5, FRAMES):
        for sx in reversed(range(CAMERAS)):
            shutil.copyfile(taken / name(sx, t), folder / f"{name(sx, t)}.part")
            (folder / f"{name(sx, t)}.part").rename(folder / name(sx, t))
        time.sleep(2 * SETTLE_S)


def followed(folder: Path, out: Path, **options: object) -> Callable[..., None]:
    def work(**more: object) -> None:
        lf.follow(folder, out, config(**options), settle_s=SETTLE_S, **{"timeout_s": 1.0, **more})  # type: ignore[arg-type]

    return work


def test_a_followed_capture_ends_as_a_batch_run(taken: Path, growing_folder: Path, tmp_path: Path) -> None:
    said: list[str] = []
    camera = threading.Thread(target=in_awkward_ways, args=(taken, growing_folder))
    camera.start()
    followed(growing_folder, tmp_path / "out.zarr")(waiting=said.append, timeout_s=3.0)
    camera.join()
    store = ResultStore.open(tmp_path / "out.zarr")
    assert len(store.done()) == store.n_units
    assert store.frames[-1] + store.frames[0] == FRAMES - 1
    assert any("c0_003.tif is" in text for text in said), said
    assert len(store.attrs["runs"]) == 1
    printed = tmp_path / "run.toml"
    printed.write_text(store.attrs["config"], encoding="utf-8")
    lf.run(taken, tmp_path / "batch.zarr", load_config(printed, overrides={"tile": 12}))
    batch = ResultStore.open(tmp_path / "batch.zarr")
    assert files_of(store.path) == files_of(batch.path)
    assert batch.frames == store.frames
    assert (
        differences({**store.attrs, "input": 0, "input_files": 0}, {**batch.attrs, "input": 0, "input_files": 0}) == []
    )


def test_what_never_comes_is_named(taken: Path, growing_folder: Path, tmp_path: Path) -> None:
    """Camera 1 fails once; what comes behind it waits, until it is there and the run is resumed."""
    out = tmp_path / "out.zarr"
    for t in range(FRAMES):
        give(taken, growing_folder, t)
    (growing_folder / name(1, 5)).unlink()
    with pytest.raises(PartlyDone, match=r"frame 5: 2 of 3 images: c1_005\.tif is not there; .*--resume"):
        followed(growing_folder, out)(timeout_s=0.3)
    frames = ResultStore.open(out).frames
    assert frames[-1] < 5
    give(taken, growing_folder, 5)
    lf.run(growing_folder, out, config(), resume=True)
    again = ResultStore.open(out)
    assert again.frames[: len(frames)] == frames
    assert again.frames[-1] > frames[-1]
    assert len(again.done()) == again.n_units


def test_nothing_comes(growing_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"arrived for 0\.1 s, and 1 frames are needed.*run without --follow"):
        followed(growing_folder, tmp_path / "out.zarr")(timeout_s=0.1)
    assert not (tmp_path / "out.zarr").exists()


@pytest.mark.parametrize(
    ("options", "text"),
    [({"prefilter": "homomorphic"}, "prefilter 'homomorphic'"), ({"workers": 2}, "plan.workers = 2")],
)
def test_what_cannot_be_followed(growing_folder: Path, tmp_path: Path, options: dict[str, object], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        followed(growing_folder, tmp_path / "out.zarr", **options)()


def test_stacks_are_not_followed(growing_folder: Path) -> None:
    (growing_folder / "capture.toml").write_text('[images]\npath = "stack.tif"\naxes = "t y x"\n', encoding="utf-8")
    with pytest.raises(ConfigError, match=r"pattern with \{t\}"):
        Arrivals(growing_folder)


def test_a_frame_between_those_that_are_done_is_refused(taken: Path, growing_folder: Path) -> None:
    for t in (0, 2, 4, 6):
        give(taken, growing_folder, t)
    arrivals = Arrivals(growing_folder, settle_s=0.0)
    arrivals.look()
    assert arrivals.look() == 4
    give(taken, growing_folder, 3)
    with pytest.raises(InputError, match=r"c\d_003\.tif: has appeared between frames that are done"):
        arrivals.look()


def small_store(path: Path) -> ResultStore:
    return ResultStore.create(
        path, frames=[2, 3], y=[0, 1], x=[0, 1, 2], names=["depth", "depth_std"], chunk=(1, 2, 3), attrs={}
    )


def test_a_grown_store_is_that_of_all_frames(tmp_path: Path) -> None:
    grown = growing.extend(small_store(tmp_path / "grown.zarr"), range(2, 3000))
    whole = ResultStore.create(
        tmp_path / "whole.zarr", frames=range(2, 3000), y=[0, 1], x=[0, 1, 2], names=["depth", "depth_std"],
        chunk=(1, 2, 3), attrs={},
    )  # fmt: skip
    assert grown.frames == whole.frames
    assert files_of(grown.path) == files_of(whole.path)


def test_a_kill_while_a_store_grows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After every number of files that were replaced the store opens with its old frames, and grows to the same end."""
    growing.extend(small_store(tmp_path / "wanted.zarr"), range(2, 9))
    wanted, real = files_of(tmp_path / "wanted.zarr"), growing.replace_file
    for steps in range(4):
        store = small_store(tmp_path / f"{steps}.zarr")
        left = [steps]

        def dying(path: Path, content: bytes, beside: Path, left: list[int] = left) -> None:
            if left[0] == 0:
                raise KeyboardInterrupt
            left[0] -= 1
            real(path, content, beside)

        monkeypatch.setattr(growing, "replace_file", dying)
        with pytest.raises(KeyboardInterrupt):
            growing.extend(store, range(2, 9))
        monkeypatch.setattr(growing, "replace_file", real)
        again = ResultStore.open(store.path)
        assert again.frames == (2, 3)
        assert again.read("depth").shape == (2, 2, 3)
        growing.extend(again, range(2, 9))
        assert files_of(store.path) == wanted
