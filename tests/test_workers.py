"""Runs whose units are computed by other processes: who computed what, and who died over it, changes no byte."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import tifffile
from small_plane import OPTIONS, SCENE, config, files_of, running_threads

import leafflow_ti as lf
from leafflow_ti.errors import PartlyDone
from leafflow_ti.progress import Progress, Timings
from leafflow_ti.synthetic.write import write_scene

HANG_S = 120.0
"""How long something is waited for that must happen: a busy machine takes its time."""
needs_proc = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="processes are found in /proc")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of 13 frames, of which 5 can be measured."""
    folder = tmp_path_factory.mktemp("workers") / "capture"
    write_scene(replace(SCENE, bits=8), folder)
    for path in folder.rglob("*.tif"):
        tifffile.imwrite(path, tifffile.imread(path), compression="zlib")
    return folder


@pytest.fixture(scope="module")
def alone(folder: Path) -> dict[str, str]:
    """Checksums of the results of this process: three bands of five frames."""
    out = folder.parent / "alone.zarr"
    lf.run(folder, out, config(tile=16))
    return files_of(out)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def children(pid: int) -> set[int]:
    """Processes that this one has started, and that have not ended."""
    found = (int(p) for task in Path(f"/proc/{pid}/task").glob("*/children") for p in task.read_text().split())
    return set(filter(alive, found))


def wait_until(what: Callable[[], bool]) -> None:
    end = time.monotonic() + HANG_S
    while not what():
        assert time.monotonic() < end, "it never happened"
        time.sleep(0.02)


def started(folder: Path, out: Path) -> subprocess.Popen[str]:
    """A run of two workers by the command line, in a process group of its own."""
    options = [f"--{key}={','.join(map(str, v)) if isinstance(v, tuple) else v}" for key, v in OPTIONS.items()]
    command = [sys.executable, "-m", "leafflow_ti.cli.main", "run", str(folder), "-o", str(out), *options,
               "--set=plan.tile=16", "--workers=2", "--no-quicklook", "--quiet"]  # fmt: skip
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)


@needs_proc
def test_workers_write_the_same_bytes_even_if_one_is_killed_and_an_image_is_damaged(
    folder: Path, alone: dict[str, str], tmp_path: Path
) -> None:
    """Frame 10 is the last one that frame 6 needs."""
    capture, out, resources = tmp_path / "capture", tmp_path / "out.zarr", config(tile=16, workers=2)
    shutil.copytree(folder, capture)
    damaged = capture / "cam_02" / "frame_010.tif"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole.replace(whole[-400:], bytes(400)))  # of the compressed values
    before, threads, states = children(os.getpid()), running_threads(), list[Progress]()

    def kill_one(state: Progress) -> None:
        states.append(state)
        if state.done_units == 2:
            os.kill(min(children(os.getpid()) - before), signal.SIGKILL)

    with pytest.raises(PartlyDone, match=r"9 of 15 units .*frames 6-8: .*cam_02.frame_010\.tif"):
        lf.run(capture, out, resources, progress=kill_one)
    assert children(os.getpid()) == before
    assert running_threads() <= threads
    assert [state.done_units for state in states] == list(range(1, 7))
    store = lf.ResultStore.open(out)
    assert store.done() == set(range(6))
    assert [m["unit"] for m in store.attrs["missing"]] == list(range(6, 15))
    timings = Timings.of(store.attrs["timings"])
    assert (timings.units, timings.device[:4], [run["executor"] for run in store.attrs["runs"]]) == (
        6,
        "2 x ",
        ["2 processes"],
    )
    assert timings.stages.keys() >= {"compile", "decode", "estimate", "write"}
    assert files_of(out).items() <= alone.items()


def test_workers_share_frames_that_are_searched(tmp_path: Path) -> None:
    """Adaptive: the bands of a frame follow each other."""
    scene = replace(SCENE, bits=8, n_frames=2, velocity=(0.0, 0.0, 0.0), omega=(0.0, 0.0, 0.0))
    write_scene(scene, tmp_path / "capture")
    options = {"model": "depth", "preshift": "adaptive", "window": 9, "stride": 2, "tile": 8}
    for name, workers in (("one", 1), ("two", 2)):
        lf.run(tmp_path / "capture", tmp_path / name, lf.load_config(overrides={**options, "workers": workers}))
    assert lf.ResultStore.open(tmp_path / "two").done() == set(range(6))
    assert files_of(tmp_path / "one") == files_of(tmp_path / "two")


@needs_proc
def test_an_interrupted_run_leaves_no_worker_and_is_resumed(
    folder: Path, alone: dict[str, str], tmp_path: Path
) -> None:
    """As a terminal does it: everybody gets the signal."""
    out = tmp_path / "out.zarr"
    with started(folder, out) as process:
        wait_until(lambda: process.poll() is not None or out.exists())
        workers = children(process.pid)
        os.killpg(process.pid, signal.SIGINT)
        _, said = process.communicate(timeout=HANG_S)
    assert process.returncode == 130, said
    assert "with --resume goes on" in said
    assert "Traceback" not in said
    assert len(workers) == 2
    wait_until(lambda: not any(map(alive, workers)))
    assert len(lf.ResultStore.open(out).done()) < 15
    lf.run(folder, out, config(), resume=True)
    assert files_of(out) == alone


@needs_proc
def test_workers_go_with_their_parent(folder: Path, tmp_path: Path) -> None:
    with started(folder, tmp_path / "out.zarr") as process:
        wait_until(lambda: process.poll() is not None or len(children(process.pid)) == 2)
        workers = children(process.pid)
        process.kill()
    assert len(workers) == 2
    wait_until(lambda: not any(map(alive, workers)))
