"""The results store: a layout that xarray opens, markers written last, equal bytes, refusals; and its Field."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from leafflow_ti.errors import InputError, MissingExtra, RunError, UsageError
from leafflow_ti.field import QUANTITIES, Field, map_attributes, quantity
from leafflow_ti.rates import per_hour
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

NAMES = ("depth", "depth_std", "velocity_x")
Y, X = np.arange(0, 40, 4), np.arange(8, 88, 4)


def make(path: Path, overwrite: bool = False, names: Sequence[str] = NAMES) -> ResultStore:
    return ResultStore.create(
        path,
        frames=[3, 5],
        y=Y,
        x=X,
        names=names,
        chunk=(1, 4, X.size),
        attrs={"run": {"a": 1}},
        interval_s=120.0,
        overwrite=overwrite,
    )


def write(store: ResultStore, unit: int) -> None:
    t, band = divmod(unit, store.bands)
    rows = slice(4 * band, min(4 * band + 4, Y.size))
    shape = (rows.stop - rows.start, X.size)
    rng = np.random.default_rng(unit)
    status = np.zeros(shape, np.uint8)
    status[0, :3] = Status.APERTURE
    store.write_unit(unit, t, rows, {name: rng.normal(size=shape).astype(np.float32) for name in NAMES}, status)


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture
def full(tmp_path: Path) -> ResultStore:
    store = make(tmp_path / "out.zarr")
    for unit in range(store.n_units):
        write(store, unit)
    return store


def test_new_store_is_preallocated(tmp_path: Path) -> None:
    store = make(tmp_path / "sub" / "out.zarr")
    assert (store.bands, store.n_units, store.done()) == (3, 6, set())
    assert store.frames == (3, 5)
    assert store.names == NAMES
    assert np.isnan(store.read("depth")).all()
    assert (store.read("status") == Status.NOT_COMPUTED).all()
    assert [p.name for p in (tmp_path / "sub").iterdir()] == ["out.zarr"]


def test_written_units_read_back(full: ResultStore) -> None:
    assert full.done() == set(range(6))
    reopened = ResultStore.open(full.path)
    assert (reopened.frames, reopened.names, reopened.unit_rows, reopened.interval_s) == ((3, 5), NAMES, 4, 120.0)
    expected = np.random.default_rng(4).normal(size=(4, X.size)).astype(np.float32)
    np.testing.assert_array_equal(reopened.read("depth", 1)[4:8], expected)
    np.testing.assert_array_equal(reopened.read("depth")[1, 4:8], expected)
    field = reopened.field(1)
    assert field.frame == 5
    np.testing.assert_array_equal(field.x, X)
    np.testing.assert_array_equal(field["depth"][4:8], expected)
    with pytest.raises(InputError, match="has no map 'flow_x'; it has: depth"):
        full.read("flow_x")


def test_times_of_the_frames(full: ResultStore, tmp_path: Path) -> None:
    assert full.times_s is not None
    np.testing.assert_array_equal(full.times_s, [360, 600])  # frames 3 and 5, every 120 s

    def of(name: str, **times: Any) -> ResultStore:
        return ResultStore.create(
            tmp_path / name, frames=[3, 5], y=Y, x=X, names=NAMES, chunk=(1, 4, X.size), attrs={}, **times
        )

    np.testing.assert_array_equal(of("half", interval_s=120.0, time_offset=0.5).times_s, [420, 660])
    np.testing.assert_array_equal(of("stamps", interval_s=120.0, times_s=[361.5, 599.0]).times_s, [361.5, 599])
    assert of("unknown").times_s is None


def test_xarray_opens_it_without_a_warning(full: ResultStore) -> None:
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    dataset = xarray.open_zarr(full.path, consolidated=False)  # warnings are errors in this suite
    assert dataset.depth.dims == ("t", "y", "x")
    assert set(dataset.data_vars) == {*NAMES, "status"}
    np.testing.assert_array_equal(dataset.t, [3, 5])
    np.testing.assert_array_equal(dataset.y, Y)
    np.testing.assert_array_equal(dataset.x, X)
    assert dataset.depth.attrs["units"] == "mm"
    assert dataset.depth.attrs["ancillary_variables"] == "depth_std status"
    assert dataset.t.attrs["interval_s"] == 120.0
    assert dataset.status.dtype == np.uint8
    meanings = dict(
        zip(dataset.status.attrs["flag_values"], dataset.status.attrs["flag_meanings"].split(), strict=True)
    )
    assert meanings[Status.NOT_COMPUTED] == "not_computed"
    assert dataset.attrs["run"] == {"a": 1}


def test_zarr_walks_it_without_a_warning(full: ResultStore) -> None:
    group = zarr.open_group(full.path, mode="r")
    assert set(dict(group.members(max_depth=None))) == {*NAMES, "status", "t", "y", "x"}
    status = group["status"]
    assert isinstance(status, zarr.Array)
    assert status.nchunks_initialized == full.n_units


def test_chunks_are_those_that_zarr_itself_writes(full: ResultStore, tmp_path: Path) -> None:
    """The last band is lower than a chunk, and a chunk of fill values has no file."""
    again = make(tmp_path / "again.zarr")
    for store in (full, again):
        empty = np.full((4, X.size), np.nan, np.float32)
        status = np.full(empty.shape, Status.NOT_COMPUTED, np.uint8)
        store.write_unit(1, 0, slice(4, 8), dict.fromkeys(NAMES, empty), status)
    group = zarr.open_group(again.path, mode="r+")
    for name in (*NAMES, "status"):
        array = group[name]
        assert isinstance(array, zarr.Array)
        array[:] = full.read(name)
    written, expected = files(full.path), files(again.path)
    assert {n: b for n, b in written.items() if "/c/" in n} == {n: b for n, b in expected.items() if "/c/" in n}
    assert not any(name.startswith("depth/c/0/1/") for name in written)


def test_a_store_packed_otherwise_is_not_written(tmp_path: Path) -> None:
    store = make(tmp_path / "out.zarr")
    zarr.create_array(
        store.path / "depth", shape=(2, 10, X.size), chunks=(1, 4, X.size), dtype="f4", compressors=None, overwrite=True
    )
    with pytest.raises(RunError, match="depth is stored in a way that this program does not write: use --overwrite"):
        write(ResultStore.open(store.path), 0)


def test_attributes_change_as_a_whole(full: ResultStore) -> None:
    before = full.attrs
    full.update_attrs({"timings": {"seconds": 1.5}})
    assert full.attrs == ResultStore.open(full.path).attrs == {**before, "timings": {"seconds": 1.5}}
    assert dict(zarr.open_group(full.path, mode="r").attrs) == full.attrs
    assert sorted(p.name for p in (full.path / "status" / ".done").iterdir()) == [str(n) for n in range(6)]


def test_two_runs_and_a_resumed_one_give_equal_bytes(full: ResultStore, tmp_path: Path) -> None:
    again = make(tmp_path / "again.zarr")
    write(again, 5)
    write(again, 0)
    (again.path / "status" / ".done" / "0").unlink()  # as after a kill between the last chunk and the marker
    resumed = ResultStore.open(again.path)
    assert resumed.done() == {5}
    for unit in set(range(6)) - resumed.done():
        write(resumed, unit)
    assert files(again.path) == files(full.path)


def test_threads_may_write_units_in_any_order(full: ResultStore, tmp_path: Path) -> None:
    again = make(tmp_path / "again.zarr")
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda unit: write(again, unit), [5, 0, 3, 1, 4, 2]))
    assert files(again.path) == files(full.path)


def test_unit_of_fill_values_replaces_what_was_there(full: ResultStore) -> None:
    empty = np.full((4, X.size), np.nan, np.float32)
    full.write_unit(0, 0, slice(0, 4), dict.fromkeys(NAMES, empty), np.full(empty.shape, Status.NOT_COMPUTED, np.uint8))
    assert np.isnan(full.read("depth", 0)[:4]).all()
    assert np.isfinite(full.read("depth", 0)[4:]).all()


def test_unit_must_be_the_chunk_row(full: ResultStore) -> None:
    maps, status = dict.fromkeys(NAMES, np.zeros((4, X.size), np.float32)), np.zeros((4, X.size), np.uint8)
    for unit, t, rows in [(0, 1, slice(0, 4)), (0, 0, slice(4, 8)), (2, 0, slice(8, 12)), (6, 2, slice(0, 4))]:
        with pytest.raises(ValueError, match=f"unit {unit} is frame"):
            full.write_unit(unit, t, rows, maps, status)
    with pytest.raises(ValueError, match="depth has"):
        full.write_unit(0, 0, slice(0, 4), {**maps, "depth": np.zeros((3, X.size), np.float32)}, status)


def test_chunk_must_be_whole_rows(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="whole rows"):
        ResultStore.create(tmp_path / "o.zarr", frames=[0], y=Y, x=X, names=NAMES, chunk=(1, 4, 5), attrs={})


def test_existing_path_is_kept_unless_told(full: ResultStore) -> None:
    with pytest.raises(UsageError, match=r"exists: give --overwrite .* --resume"):
        make(full.path)
    assert full.done() == set(range(6))
    assert make(full.path, overwrite=True).done() == set()


def test_overwrite_spares_what_is_no_store(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "precious.txt").write_text("x")
    zarr.create_group(tmp_path / "foreign.zarr")
    for name in ("data", "foreign.zarr", "data/precious.txt"):
        with pytest.raises(UsageError, match="no results store"):
            make(tmp_path / name, overwrite=True)
    assert (tmp_path / "data" / "precious.txt").read_text() == "x"


def test_open_refuses_what_is_no_store(tmp_path: Path) -> None:
    zarr.create_group(tmp_path / "foreign.zarr")
    (tmp_path / "file.zarr").write_text("x")
    for name in ("absent.zarr", "foreign.zarr", "file.zarr", "."):
        with pytest.raises(InputError, match="no results store"):
            ResultStore.open(tmp_path / name)
    assert not (tmp_path / "absent.zarr").exists()


def test_open_refuses_another_format(full: ResultStore) -> None:
    zarr.open_group(full.path, mode="r+").attrs["leafflow_ti_format"] = 99
    with pytest.raises(InputError, match="format 99, this version reads 1"):
        ResultStore.open(full.path)


def test_finish_adds_attributes_when_all_is_done(tmp_path: Path, full: ResultStore) -> None:
    full.finish({"device": "cpu"})
    assert ResultStore.open(full.path).attrs == {**full.attrs, "device": "cpu", "run": {"a": 1}}
    with pytest.raises(RunError, match=r"6 of 6 units are not done: run again with --resume"):
        make(tmp_path / "empty.zarr").finish({})


def test_maps_are_added_to_a_whole_store(full: ResultStore) -> None:
    before = files(full.path)
    values = np.random.default_rng(1).normal(size=(Y.size, X.size)).astype(np.float32)
    for _ in range(2):  # the second time replaces the first
        store = full.add_maps(("area_rate", "area_rate_std"))
        assert store.names == NAMES
        assert store.unfinished == ("area_rate", "area_rate_std")
        (remark,) = store.remarks
        assert "area_rate and others) are left out: run it again" in remark
        store.write_maps(1, {"area_rate": values})
        store = store.finish_maps({"growth": {"window": 5}})
        assert (store.unfinished, store.remarks) == ((), ())
        assert "unfinished_maps" not in store.attrs
    assert store.names == (*NAMES, "area_rate", "area_rate_std")
    assert store.attrs["growth"] == {"window": 5}
    np.testing.assert_array_equal(store.read("area_rate", 1), values)
    assert np.isnan(store.read("area_rate", 0)).all()
    assert {name: data for name, data in files(full.path).items() if name in before and name != "zarr.json"} == {
        name: data for name, data in before.items() if name != "zarr.json"
    }
    with pytest.raises(ValueError, match="needs the shape"):
        store.write_maps(1, {"area_rate": values[1:]})


def test_maps_are_not_added_to_an_unfinished_store(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="6 of 6 units are not done"):
        make(tmp_path / "out.zarr").add_maps(("area_rate",))


@pytest.mark.parametrize(
    ("unit", "wanted"),
    [
        ("mm", ("mm", 1.0)),
        ("%/frame", ("%/h", 30.0)),
        ("mm/frame²", ("mm/h²", 900.0)),
        ("1/(frame mm)", ("1/(h mm)", 30.0)),
    ],
)
def test_rates_per_hour(unit: str, wanted: tuple[str, float]) -> None:
    assert per_hour(unit, 120.0) == wanted
    assert per_hour(unit, None) == (unit, 1.0)


def test_unwritable_folder_is_a_run_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RunError, match="cannot be written"):
        make(tmp_path / "file" / "out.zarr")
    store = make(tmp_path / "out.zarr")
    (store.path / "depth" / "c").write_text("in the way of the chunks")
    with pytest.raises(RunError, match=r"cannot be written \(.+\): .*--resume"):
        write(store, 1)
    assert store.done() == set()


LIMITED = """
import resource, signal, sys
import numpy as np
from leafflow_ti.errors import RunError
from leafflow_ti.results import ResultStore
store = ResultStore.open(sys.argv[1])
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # a write beyond the limit then fails as on a full disk
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
noise = np.random.default_rng(0).normal(size=(4, store.x.size)).astype(np.float32)
try:
    store.write_unit(0, 0, slice(0, 4), dict.fromkeys(store.names, noise), np.zeros(noise.shape, np.uint8))
except RunError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits of the file size are a POSIX facility")
def test_full_disk_leaves_no_marker(tmp_path: Path) -> None:
    store = make(tmp_path / "out.zarr")
    done = subprocess.run([sys.executable, "-c", LIMITED, str(store.path)], capture_output=True, text=True, check=True)
    assert "cannot be written (File too large)" in done.stdout
    assert store.done() == set()


def test_table_of_quantities() -> None:
    assert quantity("acceleration_z") == ("mm/frame²", "surface acceleration along Z")
    assert quantity("depth_std") == ("mm", "standard error of the depth of the surface along the optical axis")
    assert all(unit and name for unit, name in QUANTITIES.values())
    with pytest.raises(KeyError, match="no map is called 'dept'"):
        quantity("dept")
    assert map_attributes("status")["flag_values"] == [int(code) for code in Status]


def field() -> Field:
    status = np.zeros((2, 5), np.uint8)
    status[0] = Status.BORDER
    maps = {name: np.arange(10, dtype=np.float32).reshape(2, 5) for name in NAMES}
    return Field(maps, status, np.arange(2), np.arange(5), 7, {"model": "depth"})


def test_field_is_a_mapping_of_its_maps() -> None:
    f = field()
    assert list(f) == list(NAMES)
    assert f["depth"][1, 0] == 5
    assert f.status_shares() == {"ok": 0.5, "border": 0.5}
    assert repr(f) == "<Field frame 7, 2 x 5 (y, x): depth, velocity_x; ok 50.0%, border 50.0%>"
    with pytest.raises(KeyError, match="no map 'flow_x'; it has: depth"):
        f["flow_x"]


def test_measured_leaves_out_what_the_search_alone_gives() -> None:
    f = field()
    f.status[1, :2] = Status.COARSE
    values = f.measured()["depth"]
    assert np.isnan(values[1, :2]).all()
    np.testing.assert_array_equal(values[1, 2:], f["depth"][1, 2:])
    assert np.isfinite(f["depth"]).all()


def test_field_checks_its_shapes_and_names() -> None:
    f = field()
    with pytest.raises(ValueError, match=r"status has the shape \(2, 4\)"):
        Field(f.maps, f.status[:, :4], f.y, f.x, 0)
    with pytest.raises(KeyError, match="no map is called 'Z'"):
        Field({"Z": f["depth"]}, f.status, f.y, f.x, 0)


def test_field_as_dataset() -> None:
    pytest.importorskip("xarray", reason="xarray is not installed")
    dataset = field().to_xarray()
    assert dataset.depth.dims == ("y", "x")
    assert dataset.depth.attrs["units"] == "mm"
    assert int(dataset.t) == 7
    assert dataset.attrs == {"model": "depth"}


def test_field_without_xarray_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingExtra, match=r"leafflow-ti\[xarray\]"):
        field().to_xarray()
