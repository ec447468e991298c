"""Runs that were interrupted, damaged, or could not read all: what is done stays, the rest follows, bytes are equal."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from small_plane import SCENE, capture_of, config, files_of, running_threads, write_compressed

import leafflow_ti as lf
from leafflow_ti.capture import Capture
from leafflow_ti.errors import InputError, PartlyDone, RunError
from leafflow_ti.locks import FOLDER as LOCKS
from leafflow_ti.plan import Plan, make_plan
from leafflow_ti.progress import Progress, Timings
from leafflow_ti.provenance import provenance
from leafflow_ti.results import ResultStore
from leafflow_ti.run_store import create_store


@pytest.fixture(scope="module")
def capture() -> Capture:
    return capture_of(SCENE)


@pytest.fixture(scope="module")
def on_disk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of compressed images."""
    folder = tmp_path_factory.mktemp("disk") / "capture"
    write_compressed(folder)
    return folder


@pytest.mark.parametrize("stop_after", [1, 4, 8])
def test_resumed_run_ends_with_the_same_bytes(capture: Capture, tmp_path: Path, stop_after: int) -> None:
    """Nine units; the run dies in the middle of a band, or between bands."""
    wanted = config(frames="4:7", tile=16)

    def die(progress: Progress) -> None:
        if progress.done_units == stop_after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        lf.run(capture, tmp_path / "out.zarr", wanted, progress=die)
    store = lf.ResultStore.open(tmp_path / "out.zarr")
    assert len(store.done()) == stop_after
    first = Timings.of(store.attrs["timings"])
    assert (first.units, first.runs) == (stop_after, 1)
    lf.run(capture, tmp_path / "out.zarr", wanted, resume=True)
    lf.run(capture, tmp_path / "whole.zarr", wanted)
    assert files_of(tmp_path / "out.zarr") == files_of(tmp_path / "whole.zarr")
    both, alone = (Timings.of(lf.ResultStore.open(tmp_path / n).attrs["timings"]) for n in ("out.zarr", "whole.zarr"))
    assert (both.units, both.frames, both.pixels, both.runs) == (9, 3, 3 * 43 * 61, 2)
    assert (alone.units, alone.frames, alone.pixels, alone.runs) == (9, 3, 3 * 43 * 61, 1)
    assert both.device == alone.device
    assert set(both.stages) == set(alone.stages) >= {"compile", "decode", "filter", "tensor", "estimate", "write"}
    assert both.seconds > first.seconds
    assert all(both.stages[stage] >= seconds > 0 for stage, seconds in first.stages.items())


def test_damaged_units_are_computed_again(capture: Capture, tmp_path: Path) -> None:
    """Six units: a file of one is cut, another one's is lost; without ``verify`` both pass for done."""
    wanted, out = config(frames="4:6", tile=16), tmp_path / "out.zarr"
    lf.run(capture, out, wanted)
    whole = files_of(out)
    (out / "depth/c/0/1/0").write_bytes(b"")
    (out / "velocity_x/c/1/2/0").unlink()
    lf.run(capture, out, wanted, resume=True)
    assert files_of(out) != whole
    lf.run(capture, out, wanted, resume=True, verify=True)
    assert files_of(out) == whole
    assert [run["timings"]["units"] for run in lf.ResultStore.open(out).attrs["runs"]] == [6, 0, 2]


def test_what_an_unreadable_image_is_needed_for_is_left_out(on_disk: Path, tmp_path: Path) -> None:
    """Frame 10 is the last one that frame 6 needs; three bands per frame."""
    folder, wanted = tmp_path / "capture", config(tile=16)
    shutil.copytree(on_disk, folder)
    damaged = folder / "cam_02" / "frame_010.tif"
    whole = damaged.read_bytes()
    data = bytearray(whole)
    with tifffile.TiffFile(damaged) as tif:
        page = tif.pages[0]
        assert isinstance(page, tifffile.TiffPage)
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            data[offset : offset + count] = bytes(count)
    damaged.write_bytes(data)
    threads = running_threads()
    out = tmp_path / "out.zarr"
    with pytest.raises(PartlyDone, match=r"9 of 15 units .*frames 6-8: .*cam_02.frame_010\.tif: page 0 cannot"):
        lf.run(lf.open_capture(folder), out, wanted)
    assert running_threads() <= threads
    store = lf.ResultStore.open(out)
    assert store.done() == set(range(6))
    assert [(m["unit"], m["frame"], m["rows"]) for m in store.attrs["missing"]][:2] == [
        (6, 6, [0, 15]),
        (7, 6, [16, 31]),
    ]
    assert store.attrs["runs"][0]["ended"] == "partly done"
    damaged.write_bytes(whole)
    lf.run(lf.open_capture(folder), out, wanted, resume=True)
    assert store.attrs["missing"] == []
    lf.run(lf.open_capture(folder), tmp_path / "whole.zarr", wanted)
    assert files_of(out) == files_of(tmp_path / "whole.zarr")


def test_a_capture_of_which_nothing_can_be_read_is_an_input_error(on_disk: Path, tmp_path: Path) -> None:
    folder = tmp_path / "capture"
    shutil.copytree(on_disk, folder)
    damaged = folder / "cam_02" / "frame_006.tif"
    damaged.write_bytes(damaged.read_bytes()[:-400])
    with pytest.raises(InputError, match=r"cam_02.frame_006\.tif"):
        lf.run(lf.open_capture(folder), tmp_path / "out.zarr", config(frames="6:8"))


def test_another_middle_frame_is_another_run(on_disk: Path, tmp_path: Path) -> None:
    """No unit that is done has needed it, but the noise of the images was estimated from it."""
    folder, out = tmp_path / "capture", tmp_path / "out.zarr"
    wanted = config(frames="10:11", tile=16, taps_time="3", size_time=1)
    shutil.copytree(on_disk, folder)
    lf.run(lf.open_capture(folder), out, wanted)
    (out / "status" / ".done" / "2").unlink()
    middle = folder / "cam_02" / "frame_006.tif"
    image = tifffile.imread(middle)
    image += np.random.default_rng(0).normal(0, 9, image.shape).astype(np.float32)
    tifffile.imwrite(middle, image)
    with pytest.raises(RunError, match=r"another run: plan\.noise was \d\.\d+, is \d+\.\d+; use"):
        lf.run(lf.open_capture(folder), out, wanted, resume=True)


def test_what_differs_is_said_in_the_words_of_the_configuration(capture: Capture, tmp_path: Path) -> None:
    lf.run(capture, tmp_path / "out.zarr", config(frames="5:6", tile=16))
    with pytest.raises(RunError) as said:
        lf.run(capture, tmp_path / "out.zarr", config(frames="5:6", window=11), resume=True)
    assert "another run: refine.window was 9, is 11; window.size was 9, is 11; use --overwrite" in str(said.value)


def test_shard_on_another_machine_that_comes_second(
    capture: Capture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both plan at once, with other limits of memory; who has not made the store takes the units of who has."""
    mine, other, out = config(frames="4:6"), config(frames="4:6", tile=16), tmp_path / "out.zarr"
    lf.run(capture, tmp_path / "whole.zarr", other)

    def second(out: Path, plan: Plan, attrs: dict[str, object], *args: Any, **options: Any) -> ResultStore:
        create_store(out, theirs := make_plan(capture, other), provenance(theirs, capture), *args, **options)
        return create_store(out, plan, attrs, *args, **options)

    monkeypatch.setattr("leafflow_ti.runs.create_store", second)
    for number in (1, 2):
        lf.run(capture, out, mine, shard=(number, 2))
    for store in (out, tmp_path / "whole.zarr"):
        shutil.rmtree(store / LOCKS)
    assert files_of(out) == files_of(tmp_path / "whole.zarr")
