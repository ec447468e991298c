"""Disks: their room is asked for first; what fills up, goes away or refuses leaves a clear error and whole files."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import subprocess
import sys
from collections import namedtuple
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from report_stores import make_store
from small_plane import SCENE, capture_of, config, files_of
from test_surface_growth import store_of

import leafflow_ti as lf
from leafflow_ti.capture import Capture
from leafflow_ti.chunk_files import write_chunks
from leafflow_ti.disk import check_space, space_needed
from leafflow_ti.errors import RunError
from leafflow_ti.events import warnings_said
from leafflow_ti.exporters import export
from leafflow_ti.plan import Plan
from leafflow_ti.progress import Progress
from leafflow_ti.quicklook import write_quicklooks
from leafflow_ti.report import write_report
from leafflow_ti.results import ResultStore
from leafflow_ti.surface_growth import measure_growth
from leafflow_ti.tables import write_table

Usage = namedtuple("Usage", "total used free")


@pytest.fixture(scope="module")
def capture() -> Capture:
    return capture_of(SCENE)


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Sets what every disk says is free."""
    return lambda free: monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(2 * free, free, free))


@pytest.fixture(scope="module")
def plan(capture: Capture) -> Plan:
    return lf.plan_run(capture, config(stride=1))


def test_too_little_room_is_said_before_anything_is_written(
    plan: Plan, room: Callable[[int], None], tmp_path: Path
) -> None:
    likely, most = space_needed(plan, plan.n_units)
    out = tmp_path / "new" / "out.zarr"
    room(most)
    with warnings_said() as said:
        check_space(out, plan, plan.n_units)
    assert said == []
    room(most - 1)
    with warnings_said() as said:
        check_space(out, plan, plan.n_units)
    assert len(said) == 1
    room(likely - 1)
    with pytest.raises(RunError, match=r"out\.zarr: \d+ units take .* has .* free: make room.*check_disk=false"):
        check_space(out, plan, plan.n_units)
    check_space(out, plan, plan.n_units // 4)  # of what is left when most of them are done
    assert not (tmp_path / "new").exists()


def test_run_asks_before_it_writes(capture: Capture, room: Callable[[int], None], tmp_path: Path) -> None:
    out, options = tmp_path / "out.zarr", config(frames="4:6", stride=2)
    room(0)
    with pytest.raises(RunError, match="on the disk, which has"):
        lf.run(capture, out, options)
    assert list(tmp_path.iterdir()) == []
    room(1 << 30)
    lf.run(capture, out, options)
    room(0)
    lf.run(capture, out, options, resume=True)  # nothing is left to write


def test_check_can_be_turned_off(capture: Capture, room: Callable[[int], None], tmp_path: Path) -> None:
    plan = lf.plan_run(capture, config(**{"stride": 1, "plan.check_disk": False}))
    room(0)
    check_space(tmp_path / "out.zarr", plan, plan.n_units)


def test_store_that_is_replaced_counts_as_room(plan: Plan, room: Callable[[int], None], tmp_path: Path) -> None:
    (tmp_path / "out.zarr").mkdir()
    (tmp_path / "out.zarr" / "values").write_bytes(bytes(space_needed(plan, plan.n_units)[1]))
    room(0)
    check_space(tmp_path / "out.zarr", plan, plan.n_units)
    with pytest.raises(RunError, match=r"0\.0 MiB free"):
        check_space(tmp_path / "out.zarr", plan, plan.n_units - 1)


def test_no_store_takes_more_than_is_asked_for(tmp_path: Path) -> None:
    """Of noise, which does not compress, in small units, whose files fill no block."""
    names = ("depth", "depth_std", "velocity_x")
    store = ResultStore.create(
        tmp_path / "o.zarr", frames=range(3), y=np.arange(40), x=np.arange(60), names=names, chunk=(1, 10, 60), attrs={}
    )
    rng = np.random.default_rng(0)
    for unit in range(store.n_units):
        noise = {name: rng.normal(size=(10, 60)).astype(np.float32) for name in names}
        rows = slice(10 * (unit % 4), 10 * (unit % 4) + 10)
        store.write_unit(unit, unit // 4, rows, noise, rng.integers(0, 9, (10, 60)).astype(np.uint8))
    taken = sum(p.stat().st_blocks * 512 for p in [store.path, *store.path.rglob("*")])

    class Small:
        band_rows, x = 10, range(60)

    Small.names = names  # type: ignore[attr-defined]
    assert taken <= space_needed(Small, store.n_units)[1]  # type: ignore[arg-type]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 6 MiB, where this process may mount one."""
    place = tmp_path / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", str(place)]
    if sys.platform != "linux" or shutil.which("mount") is None or subprocess.run(command, check=False).returncode:
        pytest.skip("this process may not mount a disk")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def fill(disk: Path) -> Path:
    """Fill a disk to its last byte; returns the file that does."""
    filler = disk / "filler"
    with filler.open("wb", buffering=0) as file:
        for size in (1 << 16, 1):
            with contextlib.suppress(OSError):
                while file.write(bytes(size)):
                    pass
    assert shutil.disk_usage(disk).free == 0
    return filler


def test_run_on_a_disk_that_fills_up_goes_on_when_there_is_room(
    capture: Capture, small_disk: Path, tmp_path: Path
) -> None:
    options = config(frames="4:8", stride=2)
    whole, out = tmp_path / "whole.zarr", small_disk / "out.zarr"
    lf.run(capture, whole, options)
    fillers: list[Path] = []

    def then_fill(state: Progress) -> None:
        if state.done_units == 1:
            fillers.append(fill(small_disk))

    with pytest.raises(
        RunError, match=r"out\.zarr: cannot be written \(No space left on device\): .*--resume"
    ) as error:
        lf.run(capture, out, options, progress=then_fill)
    assert error.value.exit_code == 6
    left = ResultStore.open(out)
    assert 1 <= len(left.done()) < left.n_units
    np.testing.assert_array_equal(left.read("depth", 0), ResultStore.open(whole).read("depth", 0))
    fillers[0].unlink()
    lf.run(capture, out, options, resume=True)
    assert files_of(out) == files_of(whole)


OUTPUTS: dict[str, Callable[[ResultStore, Path], object]] = {
    "csv": lambda store, folder: export(store, "csv", folder / "csv"),
    "tiff": lambda store, folder: export(store, "tiff", folder / "tiff"),
    "netcdf": lambda store, folder: export(store, "netcdf", folder / "o.nc"),
    "ply": lambda store, folder: export(store, "ply", folder / "ply"),
    "vtk": lambda store, folder: export(store, "vtk", folder / "vtk"),
    "report": lambda store, folder: write_report(store, folder / "o.html"),
    "table": lambda store, folder: write_table({"a": np.arange(5000.0)}, folder / "o.csv"),
    "parquet": lambda store, folder: write_table({"a": np.random.default_rng(0).random(5000)}, folder / "o.parquet"),
    "pictures": lambda store, folder: write_quicklooks(store, 0, folder / "pictures"),
}


@pytest.mark.parametrize("output", OUTPUTS)
@pytest.mark.parametrize("fault", ["No space left on device", "Read-only file system"])
def test_outputs_leave_nothing_half_written(output: str, fault: str, small_disk: Path, tmp_path: Path) -> None:
    if output == "netcdf":
        pytest.importorskip("h5netcdf")
    if output == "parquet":
        pytest.importorskip("pyarrow")
    store = make_store(tmp_path / "s.zarr", frames=(2, 3))
    if fault.startswith("No space"):
        fill(small_disk)
    else:
        subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    with pytest.raises(RunError, match="cannot be written") as error:
        OUTPUTS[output](store, small_disk)
    assert fault in str(error.value)
    assert "\n" not in str(error.value)
    assert [p.name for p in small_disk.rglob("*") if p.is_file() and p.name != "filler"] == []


def test_growth_on_a_full_disk_is_made_again(small_disk: Path) -> None:
    store = store_of(small_disk / "s.zarr")
    filler = fill(small_disk)
    with pytest.raises(RunError, match="No space left on device"):
        measure_growth(store)
    filler.unlink()
    measure_growth(ResultStore.open(store.path))
    assert "area_rate" in ResultStore.open(store.path).names


@pytest.mark.parametrize("code", [errno.EDQUOT, errno.EIO, errno.EACCES, errno.EROFS])
def test_refusals_of_the_system_are_one_line(code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = make_store(tmp_path / "s.zarr", frames=(2, 3), done=(0,))

    def refuse(handle: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", refuse)
    values = {"depth": np.ones((30, 40), np.float32)}
    with pytest.raises(RunError, match="--resume") as error:
        write_chunks(store.path, (1, 0), store._arrays, values)
    assert os.strerror(code) in str(error.value)
    assert np.isnan(store.read("depth", 1)).all()


def test_folder_that_vanishes_ends_the_run(capture: Capture, tmp_path: Path) -> None:
    out = tmp_path / "out.zarr"
    with pytest.raises(RunError, match=r"out\.zarr: cannot be written \(No such file"):
        lf.run(capture, out, config(frames="4:8", stride=2), progress=lambda state: shutil.rmtree(out))
