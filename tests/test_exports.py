"""Exports, opened again by other programs' readers: values, units, gaps, frames, meshes; and what is refused."""

from __future__ import annotations

import csv
import json
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from flat_leaf import X, Y, attributes, write_store
from numpy.typing import NDArray

from leafflow_ti.cli.main import main
from leafflow_ti.errors import InputError, MissingExtra, RunError, UsageError
from leafflow_ti.exporters import FORMATS, export
from leafflow_ti.exporters import tiff as tiff_exporter
from leafflow_ti.field import with_std
from leafflow_ti.mesh import surface_mesh
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

NAMES = (*with_std(("depth", "slope_x", "slope_y", "velocity_x", "velocity_y", "velocity_z", "acceleration_x",
                    "growth_rate")), "identified")  # fmt: skip
FRAMES = (2, 3, 4)
HOLE = (slice(3, 6), slice(10, 14))


def maps(t: int) -> dict[str, NDArray[Any]]:
    """A slanted plane with random maps upon it, a hole, and a border without values."""
    rng = np.random.default_rng(t)
    found: dict[str, NDArray[Any]] = {name: rng.normal(size=(Y.size, X.size)) for name in NAMES}
    rx, ry = np.meshgrid((X - 80) / 1000, (Y - 60) / 1000)
    found["depth"] = (500 + t) / (1 - 0.3 * rx + 0.2 * ry)
    found["slope_x"], found["slope_y"] = np.full(rx.shape, 0.3), np.full(rx.shape, -0.2)
    found["identified"] = rng.integers(0, 128, rx.shape)
    status = np.zeros(rx.shape, np.uint8)
    status[HOLE], status[0] = Status.APERTURE, Status.BORDER
    return found | {"status": status}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> ResultStore:
    def masked(t: int) -> dict[str, NDArray[Any]]:
        found = maps(t)
        found["identified"] = np.where(found["status"] == 0, found["identified"], 0)
        return found

    path = tmp_path_factory.mktemp("exports") / "out.zarr"
    made = ResultStore.create(
        path, frames=FRAMES, y=Y, x=X, names=NAMES, chunk=(1, Y.size, X.size), attrs=attributes(), interval_s=1800.0
    )
    for t in range(len(FRAMES)):
        found = masked(t)
        status = found.pop("status")
        values = {
            name: array.astype(np.uint8) if name == "identified" else np.where(status == 0, array, np.nan).astype("f4")
            for name, array in found.items()
        }
        made.write_unit(t, t, slice(0, Y.size), values, status)
    made.finish({})
    return made


@pytest.fixture(scope="module")
def untimed(tmp_path_factory: pytest.TempPathFactory) -> ResultStore:
    path = tmp_path_factory.mktemp("untimed") / "out.zarr"
    return write_store(path, ("flow_x", "flow_y"), lambda t: dict.fromkeys(("flow_x", "flow_y"), np.ones((30, 40))),
                       interval_s=None)  # fmt: skip


def test_imagej_opens_stacks_with_units_time_and_contrast(store: ResultStore, tmp_path: Path) -> None:
    written = export(store, "tiff", tmp_path / "fiji")
    assert {path.name for path in written} == {f"{name}.tif" for name in (*NAMES, "status")}
    with tifffile.TiffFile(tmp_path / "fiji" / "acceleration_x.tif") as file:
        found = file.imagej_metadata
        assert found is not None
        assert file.series[0].axes == "TYX"
        np.testing.assert_array_equal(file.asarray(), store.read("acceleration_x"))
        assert file.pages[0].tags["XResolution"].value == (1, 4)  # pixels of the image per entry: 4
    assert (found["frames"], found["hyperstack"], found["unit"], found["vunit"]) == (3, True, "pixel", "mm/frame^2")
    assert (found["finterval"], found["tunit"]) == (1800.0, "s")
    assert found["Labels"] == [f"frame {t}, {1800 * t} s [mm/frame^2]" for t in FRAMES]
    finite = store.read("acceleration_x", 1)[np.isfinite(store.read("acceleration_x", 1))]
    np.testing.assert_allclose((found["min"], found["max"]), np.percentile(finite, (2, 98)), rtol=1e-6)
    status = tifffile.imread(tmp_path / "fiji" / "status.tif")
    np.testing.assert_array_equal(status, store.read("status"))


def test_imagej_origin_is_that_of_the_image(tmp_path: Path) -> None:
    """x of ImageJ = (column - origin) times the pixel width."""
    x = X[5:20] + 2
    made = write_store(tmp_path / "o.zarr", ("flow_x",), lambda t: {"flow_x": np.ones((Y.size, x.size))}, x=x)
    (path,) = export(made, "tiff", tmp_path / "flow_x.tif", maps=["flow_x"])
    with tifffile.TiffFile(path) as file:
        found = file.imagej_metadata
    assert found is not None
    assert (0 - found["xorigin"]) * 4 == x[0]
    assert found["yorigin"] == 0


def test_ome_tiff_names_channels_units_and_times(store: ResultStore, tmp_path: Path) -> None:
    (path,) = export(store, "ome-tiff", tmp_path / "all.ome.tif")
    floats = [name for name in NAMES if name != "identified"]
    with tifffile.TiffFile(path) as file:
        assert file.is_ome
        assert file.ome_metadata is not None
        series, flags = file.series
        assert (series.axes, series.shape) == ("TCYX", (3, len(floats), Y.size, X.size))
        for c, name in enumerate(floats):
            np.testing.assert_array_equal(series.asarray()[:, c], store.read(name))
        np.testing.assert_array_equal(flags.asarray()[:, 1], store.read("status"))
        root = ElementTree.fromstring(file.ome_metadata)
    space = {"o": "http://www.openmicroscopy.org/Schemas/OME/2016-06"}
    first = root.findall("o:Image", space)[0]
    names = [channel.get("Name") for channel in first.iterfind(".//o:Channel", space)]
    assert names[0] == "depth [mm]"
    assert "acceleration_x [mm/frame²]" in names
    times = [float(plane.get("DeltaT", "nan")) for plane in first.iterfind(".//o:Plane", space)]
    np.testing.assert_array_equal(times, np.repeat([3600.0, 5400.0, 7200.0], len(floats)))
    units = {entry.get("K"): entry.text for entry in root.iterfind(".//o:M", space)}
    assert units["growth_rate"] == "%/frame"
    pixels = first.find("o:Pixels", space)
    assert pixels is not None
    assert (pixels.get("PhysicalSizeX"), pixels.get("PhysicalSizeXUnit")) == ("4.0", "pixel")


def test_netcdf_follows_the_conventions(store: ResultStore, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")
    (path,) = export(store, "netcdf", tmp_path / "out.nc")
    with xarray.open_dataset(path) as found:  # warnings are errors in this suite
        assert set(found.data_vars) == {*NAMES, "status"}
        for name in (*NAMES, "status"):
            assert found[name].dims == ("t", "y", "x")
            np.testing.assert_array_equal(found[name], store.read(name))
        np.testing.assert_array_equal(found.t, FRAMES)
        np.testing.assert_array_equal(found.x, X)
        assert found.attrs["Conventions"] == "CF-1.11"
        assert json.loads(found.attrs["plan"])["f_px"] == 1000
        assert found.velocity_x.attrs["units"] == "mm/frame"
        assert found.velocity_x.attrs["ancillary_variables"] == "velocity_x_std status"
        assert found.depth.encoding["zlib"]
        assert found.status.dtype == found.status.attrs["flag_values"].dtype == np.uint8
        meanings = found.status.attrs["flag_meanings"].split()
        assert meanings[list(found.status.attrs["flag_values"]).index(Status.APERTURE)] == "aperture"
        assert found.identified.attrs["flag_masks"].dtype == np.uint8
    with xarray.open_dataset(path, decode_times=False) as found:
        np.testing.assert_array_equal(found.time, [3600, 5400, 7200])
        assert found.time.attrs["units"] == "s"


def test_netcdf_without_its_package_names_the_extra(
    store: ResultStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "h5netcdf", None)
    with pytest.raises(MissingExtra, match=r"leafflow-ti\[netcdf\]"):
        export(store, "netcdf", tmp_path / "out.nc")
    assert list(tmp_path.iterdir()) == []


def test_ply_holds_the_mesh_and_all_maps(store: ResultStore, tmp_path: Path) -> None:
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed")
    written = export(store, "ply", tmp_path / "ply", frames="3:")
    assert [path.name for path in written] == ["frame_0003.ply", "frame_0004.ply"]
    found = plyfile.PlyData.read(str(written[0]))
    mesh = surface_mesh(store.field(1))
    vertex = found["vertex"]
    assert not found.text
    assert found.byte_order == "<"
    np.testing.assert_array_equal(np.stack([vertex[a] for a in "xyz"], axis=1), mesh.vertices)
    np.testing.assert_array_equal(np.stack([vertex[f"n{a}"] for a in "xyz"], axis=1), mesh.normals)
    np.testing.assert_array_equal(np.stack(found["face"]["vertex_indices"]), mesh.triangles)
    for name in (*NAMES, "status"):
        np.testing.assert_array_equal(vertex[name], mesh.at(store.read(name, 1)))
    assert vertex["status"].dtype == np.uint8
    assert "unit acceleration_x mm/frame^2" in found.comments


def test_vtk_series_has_vectors_units_and_times(store: ResultStore, tmp_path: Path) -> None:
    vtk = pytest.importorskip("vtk", reason="vtk is not installed")
    from vtk.util.numpy_support import vtk_to_numpy

    units_key = vtk.vtkDataArray.UNITS_LABEL()
    index, *written = export(store, "vtk", tmp_path / "vtk")
    entries = ElementTree.parse(index).getroot().findall(".//DataSet")
    assert [(float(e.get("timestep", "nan")), e.get("file")) for e in entries] == [
        (1800.0 * t, path.name) for t, path in zip(FRAMES, written, strict=True)
    ]
    reader = vtk.vtkXMLPolyDataReader()
    reader.SetFileName(str(written[2]))
    reader.Update()
    surface, mesh = reader.GetOutput(), surface_mesh(store.field(2))
    np.testing.assert_array_equal(vtk_to_numpy(surface.GetPoints().GetData()), mesh.vertices)
    corners = vtk_to_numpy(surface.GetPolys().GetConnectivityArray()).reshape(-1, 3)
    np.testing.assert_array_equal(corners, mesh.triangles)
    data = surface.GetPointData()
    velocity = data.GetArray("velocity")
    expected = np.stack([mesh.at(store.read(f"velocity_{a}", 2)) for a in "xyz"], axis=1)
    np.testing.assert_array_equal(vtk_to_numpy(velocity), expected)
    assert velocity.GetInformation().Get(units_key) == "mm/frame"
    assert data.GetArray("velocity_std").GetNumberOfComponents() == 3
    assert data.GetArray("acceleration_x").GetNumberOfComponents() == 1  # y and z are not there
    assert data.GetVectors().GetName() == "velocity"
    assert data.GetScalars().GetName() == "growth_rate"
    np.testing.assert_array_equal(vtk_to_numpy(data.GetNormals()), mesh.normals)
    np.testing.assert_array_equal(vtk_to_numpy(data.GetArray("status")), mesh.at(store.read("status", 2)))
    areas = vtk.vtkMassProperties()
    areas.SetInputData(surface)
    sides = mesh.vertices[mesh.triangles]
    crossed = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    np.testing.assert_allclose(areas.GetSurfaceArea(), np.linalg.norm(crossed, axis=1).sum() / 2, rtol=1e-5)


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_csv_has_a_line_per_measured_pixel(store: ResultStore, tmp_path: Path) -> None:
    (path,) = export(store, "csv", tmp_path / "all.csv", frames="2:4")
    rows = rows_of(path)
    measured = store.read("status")[:2] == Status.OK
    assert len(rows) == measured.sum()
    assert list(rows[0])[:9] == ["frame", "time_s", "x_px", "y_px", "X_mm", "Y_mm", "Z_mm", "depth_mm", "depth_std_mm"]
    row = rows[-1]
    y, x = (int(np.flatnonzero(a == int(row[k]))[0]) for a, k in ((Y, "y_px"), (X, "x_px")))
    assert (row["frame"], row["time_s"], row["status"]) == ("3", "5400", "ok")
    for column, name in (("velocity_x_mm_per_frame", "velocity_x"), ("growth_rate_percent_per_frame", "growth_rate"),
                         ("acceleration_x_mm_per_frame2", "acceleration_x"), ("Z_mm", "depth")):  # fmt: skip
        np.testing.assert_allclose(float(row[column]), store.read(name, 1)[y, x], rtol=5e-7)
    np.testing.assert_allclose(float(row["X_mm"]), store.read("depth", 1)[y, x] * (X[x] - 80) / 1000, rtol=1e-6)


def test_csv_folder_has_a_file_per_frame(store: ResultStore, tmp_path: Path) -> None:
    written = export(store, "csv", tmp_path / "frames", maps=["velocity_?"])
    assert [path.name for path in written] == [f"frame_{t:04d}.csv" for t in FRAMES]
    rows = rows_of(written[1])
    assert {row["frame"] for row in rows} == {"3"}
    assert list(rows[0])[7:] == [f"velocity_{a}_mm_per_frame" for a in "xyz"]


@pytest.mark.parametrize("to", FORMATS)
def test_every_format_is_one_command(to: str, store: ResultStore, tmp_path: Path) -> None:
    target = tmp_path / {"ome-tiff": "o.ome.tif", "netcdf": "o.nc"}.get(to, "folder")
    command = ["export", str(store.path), "--to", to, "-o", str(target), "--maps", "depth,velocity_*"]
    for extra, code in (([], 0), ([], 2), (["--overwrite"], 0)):
        with pytest.raises(SystemExit) as end:
            main([*command, *extra])
        assert (end.value.code or 0) == code
    assert sorted(p.name for p in tmp_path.iterdir()) == [target.name]  # no scratch left


def test_results_without_time_or_depth(untimed: ResultStore, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray", reason="xarray is not installed")
    for to in ("ply", "vtk"):
        with pytest.raises(InputError, match="has no depth, so no surface"):
            export(untimed, to, tmp_path / "mesh")
    (path,) = export(untimed, "tiff", tmp_path / "flow_x.tif", maps=["flow_x"])
    with tifffile.TiffFile(path) as file:
        assert file.imagej_metadata is not None
        assert file.imagej_metadata["Labels"][0] == "frame 2 [px/frame]"
    (path,) = export(untimed, "csv", tmp_path / "flow.csv")
    assert list(rows_of(path)[0]) == ["frame", "x_px", "y_px", "flow_x_px_per_frame", "flow_y_px_per_frame", "status"]
    (path,) = export(untimed, "netcdf", tmp_path / "flow.nc")
    with xarray.open_dataset(path) as found:
        assert "time" not in found.coords


@pytest.mark.parametrize(
    ("to", "path", "options", "error", "match"),
    [
        ("jpeg", "o", {}, UsageError, "no format 'jpeg': choose one of tiff, ome-tiff"),
        ("netcdf", "folder", {}, UsageError, r"netcdf is one file: let its name end in \.nc"),
        ("tiff", "o.tif", {}, UsageError, r"o\.tif is one file, this selection makes 18: give a folder"),
        ("ply", "o.ply", {}, UsageError, "this selection makes 3"),
        ("csv", "o", {"maps": ["depht"]}, InputError, "has no map 'depht'; it has: depth, depth_std"),
        ("csv", "o", {"frames": "7:9"}, InputError, r"holds the frames 2\.\.4, none in 7:9"),
        ("csv", "o", {"frames": "3"}, UsageError, "give A:B"),
        ("csv", "o", {"frames": "a:b"}, UsageError, "give A:B"),
        ("csv", "file/o", {}, RunError, "cannot be written"),
    ],
)
def test_refusals(
    to: str, path: str, options: dict[str, Any], error: type[Exception], match: str, store: ResultStore, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(error, match=match):
        export(store, to, tmp_path / path, **options)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_one_frame_may_be_one_file(store: ResultStore, tmp_path: Path) -> None:
    for to in ("ply", "vtk"):
        path = tmp_path / f"leaf{FORMATS[to].suffixes[0]}"
        assert export(store, to, path, frames="2:3") == [path]
        assert path.stat().st_size > 1000


def existing(kind: str, path: Path) -> None:
    if kind == "folder":
        path.mkdir()
        (path / "notes.txt").write_text("precious")
    else:
        path.write_text("precious")


@pytest.mark.parametrize(
    ("kind", "name", "match"), [("folder", "o", "holds something else"), ("file", "o", "is a file"),
                                ("folder", "o.csv", "is a folder")]
)  # fmt: skip
def test_overwrite_spares_what_is_no_export(
    kind: str, name: str, match: str, store: ResultStore, tmp_path: Path
) -> None:
    existing(kind, tmp_path / name)
    with pytest.raises(UsageError, match=match):
        export(store, "csv", tmp_path / name, overwrite=True)
    kept = tmp_path / name / "notes.txt" if kind == "folder" else tmp_path / name
    assert kept.read_text() == "precious"


def test_overwrite_leaves_no_old_frames(store: ResultStore, tmp_path: Path) -> None:
    export(store, "vtk", tmp_path / "o")
    with pytest.raises(UsageError, match="give --overwrite"):
        export(store, "vtk", tmp_path / "o")
    export(store, "vtk", tmp_path / "o", frames="2:3", overwrite=True)
    assert sorted(p.name for p in (tmp_path / "o").iterdir()) == ["frame_0002.vtp", "series.pvd"]


def test_an_unfinished_store_is_refused(tmp_path: Path, store: ResultStore) -> None:
    path = tmp_path / "out.zarr"
    shutil.copytree(store.path, path)
    (path / "status" / ".done" / "1").unlink()
    with pytest.raises(RunError, match="1 of 3 units are not done: finish"):
        export(path, "csv", tmp_path / "o")


def test_stacks_beyond_what_imagej_reads_are_refused(
    store: ResultStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tiff_exporter, "_CLASSIC_BYTES", 4 * 3 * Y.size * X.size - 1)
    with pytest.raises(UsageError, match="more than ImageJ's 4 GiB: give --frames"):
        export(store, "tiff", tmp_path / "o", maps=["depth"])
    export(store, "tiff", tmp_path / "o", maps=["depth"], frames="2:4")
    (path,) = export(store, "ome-tiff", tmp_path / "big.ome.tif", maps=["depth"])
    with tifffile.TiffFile(path) as file:
        assert file.is_bigtiff


def test_one_frame_is_read_at_a_time(store: ResultStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What makes memory independent of the sequence's length."""
    asked: list[object] = []
    read = ResultStore.read

    def watched(self: ResultStore, name: str, t_index: int | None = None) -> NDArray[Any]:
        asked.append(t_index)
        return read(self, name, t_index)

    monkeypatch.setattr(ResultStore, "read", watched)
    targets: Sequence[str] = ("a", "b.ome.tif", "c.nc", "d", "e", "f")
    for to, target in zip(FORMATS, targets, strict=True):
        export(store, to, tmp_path / target)
    assert set(asked) == {0, 1, 2}
