"""Regions: labels of all kinds, followed leaves, means that are exact, tables."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from flat_leaf import (
    CORRELATION,
    DEPTH,
    F_PX,
    LEAF,
    PRINCIPAL,
    SIZE,
    X,
    Y,
    attributes,
    label_image,
    leaf_maps,
    write_store,
)  # fmt: skip
from numpy.typing import NDArray

from leafflow_ti.cli.main import main
from leafflow_ti.errors import InputError, MissingExtra, UsageError
from leafflow_ti.field import with_std
from leafflow_ti.following import spread
from leafflow_ti.labels import Labels, covered
from leafflow_ti.mesh import surface_points
from leafflow_ti.region_rows import surface_area
from leafflow_ti.regions import RegionTable, measure_regions
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

GROWTH, FLOW = 0.01, (2.5, -1.0)
MM2 = (DEPTH / F_PX) ** 2
"""Area of a pixel."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> ResultStore:
    """Frames 2 to 6; the leaf grows and moves, its origin lies at the principal point in the middle frame."""
    return write_store(tmp_path_factory.mktemp("leaf") / "out.zarr", LEAF, leaf_maps(GROWTH, FLOW))


def brute_force(image: NDArray[Any], value: int, t: int) -> NDArray[np.bool_]:
    """Pixels [H, W] that a region covers in the frame with index t, by the exact motion."""
    scale, shift = np.exp(GROWTH * (t - 2)), np.array(FLOW) * (t - 2)
    y, x = np.indices(image.shape)
    from_x, from_y = ((at - p - s) / scale + p for at, p, s in zip((x, y), PRINCIPAL, shift, strict=True))
    column, row = np.rint(from_x).astype(int), np.rint(from_y).astype(int)
    inside = (column >= 0) & (column < SIZE[0]) & (row >= 0) & (row < SIZE[1])
    return inside & (image[np.clip(row, 0, SIZE[1] - 1), np.clip(column, 0, SIZE[0] - 1)] == value)


def test_regions_follow_a_leaf_that_moves_and_grows(store: ResultStore) -> None:
    """A point's path is known in closed form; following it adds some hundredths of a pixel."""
    table = measure_regions(store, label_image())
    for region in (1, 5):
        rows = table.of(region)
        np.testing.assert_array_equal(rows["frame"], [2, 3, 4, 5, 6])
        expected = [brute_force(label_image(), region, t).sum() for t in range(5)]
        border = 2 * np.pi * np.sqrt(expected[2] / np.pi)
        assert np.abs(rows["pixels"] - expected).max() <= 0.05 * border  # pixels whose centres are at the very edge
        np.testing.assert_allclose(rows["area_mm2"], np.array(expected) * MM2, atol=0.1 * border * MM2)
        np.testing.assert_array_equal(rows["followed_share"], 1)
        np.testing.assert_array_equal(rows["valid_share"], 1)
    still = measure_regions(store, label_image(), still=True)
    assert "followed_share" not in still.columns
    assert len(np.unique(still.of(1)["pixels"])) == 1


def test_a_hole_moves_along_and_lowers_the_valid_share(tmp_path: Path) -> None:
    """Pixels without a value belong to their leaf in every frame; the area counts them as like the rest."""
    exact = leaf_maps(0.0, FLOW)

    def holed(t: int) -> dict[str, NDArray[Any]]:
        found = exact(t)
        x, y = np.meshgrid(X - FLOW[0] * (t - 2), Y - FLOW[1] * (t - 2))
        hole = (np.abs(x - 72) < 6) & (np.abs(y - 52) < 6)
        return found | {"status": np.where(hole, Status.NO_STRUCTURE, 0).astype(np.uint8)}

    rows = measure_regions(write_store(tmp_path / "o.zarr", LEAF, holed), label_image()).of(1)
    assert (rows["valid_share"] < 0.95).all()
    assert (rows["valid_share"] > 0.75).all()
    np.testing.assert_allclose(rows["area_mm2"], 31**2 * MM2, rtol=0.02)
    np.testing.assert_allclose(rows["area_measured_mm2"], rows["area_mm2"] * rows["valid_share"], rtol=1e-9)


def test_nearer_leaves_are_seen_before_others(tmp_path: Path) -> None:
    """Region 5 moves to where region 1 is, and is nearer."""
    image = label_image()

    def maps(t: int) -> dict[str, NDArray[Any]]:
        found = leaf_maps()(t)
        y, x = np.meshgrid(Y, X, indexing="ij")
        disc = np.hypot(x - 115 + 6 * (t - 2), y - 60) <= 14
        found["depth"] = np.where(disc, 400.0, DEPTH)
        found["flow_x"] = np.where(disc, -6.0, 0.0)
        found["velocity_x"] = found["flow_x"] * found["depth"] / F_PX
        return found

    table = measure_regions(write_store(tmp_path / "o.zarr", LEAF, maps), image)
    first, second = table.of(1), table.of(5)
    shared = sum(((image == 1)[:, :-12] & (image == 5)[:, 12:]).ravel())
    assert shared > 20
    assert second["pixels"][-1] == pytest.approx(second["pixels"][2], abs=4)
    assert first["pixels"][2] - first["pixels"][-1] == pytest.approx(shared, abs=8)
    np.testing.assert_allclose(second["depth_mm"], 400, rtol=1e-6)


def test_a_region_that_leaves_what_is_measured_is_lost(tmp_path: Path) -> None:
    table = measure_regions(write_store(tmp_path / "o.zarr", LEAF, leaf_maps(0.0, (30.0, 0.0))), label_image())
    rows = table.of(5)
    assert rows["pixels"][2] > 400
    assert rows["pixels"][4] == 0
    assert np.isnan(rows["growth_percent_per_h"][4])
    assert rows["followed_share"][4] < 0.25


def test_means_are_those_of_the_maps(store: ResultStore) -> None:
    rows = measure_regions(store, label_image()).of(1)
    area = 100 * (np.exp(2 * GROWTH) - 1)
    np.testing.assert_allclose(rows["growth_percent_per_frame"], area, rtol=1e-6)
    np.testing.assert_allclose(rows["growth_percent_per_h"], 2 * area, rtol=1e-6)
    np.testing.assert_allclose(rows["growth_se_percent_per_h"], 2 * rows["growth_se_percent_per_frame"])
    np.testing.assert_allclose(rows["growth_sd_percent_per_frame"], 0, atol=1e-6)
    np.testing.assert_allclose(rows["velocity_x_mm_per_frame"][2], FLOW[0] * DEPTH / F_PX, rtol=1e-3)
    np.testing.assert_allclose(rows["velocity_x_mm_per_h"], 2 * rows["velocity_x_mm_per_frame"])
    np.testing.assert_allclose([rows[f"normal_{a}"][0] for a in "xyz"], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(rows["tilt_deg"], 0, atol=1e-9)
    np.testing.assert_array_equal(rows["time_s"], 1800.0 * np.arange(2, 7))
    assert "flow_x_px_per_frame" not in rows  # velocities are there


def test_rotations_are_degrees_and_tilt_is_that_of_the_normal(tmp_path: Path) -> None:
    def maps(t: int) -> dict[str, NDArray[Any]]:
        found = leaf_maps()(t)
        found["slope_x"][:], found["slope_y"][:], found["rotation_z"][:] = 0.75, 0.0, np.radians(0.5)
        depth = DEPTH / (1 - 0.75 * (X - PRINCIPAL[0]) / F_PX)
        return found | {"depth": np.broadcast_to(depth, (Y.size, X.size))}

    rows = measure_regions(write_store(tmp_path / "o.zarr", LEAF, maps), label_image(), still=True).of(1)
    np.testing.assert_allclose(rows["rotation_z_deg_per_frame"], 0.5, rtol=1e-6)
    np.testing.assert_allclose(rows["rotation_z_deg_per_h"], 1.0, rtol=1e-6)
    np.testing.assert_allclose(rows["tilt_deg"], np.degrees(np.arctan(0.75)), rtol=1e-6)
    np.testing.assert_allclose([rows[f"normal_{a}"][0] for a in "xyz"], [0.6, 0, -0.8], rtol=1e-5, atol=1e-12)
    assert (rows["tilt_se_deg"] < np.degrees(0.01) * 0.64).all()


@pytest.mark.parametrize("slopes", [True, False])
def test_area_of_a_slanted_surface(slopes: bool, tmp_path: Path) -> None:
    """Against the exact area of the quadrangles between the pixels' corners."""
    zx, zy = 0.6, -0.4
    rx, ry = np.meshgrid((X - PRINCIPAL[0]) / F_PX, (Y - PRINCIPAL[1]) / F_PX)
    maps = {"depth": DEPTH / (1 - zx * rx - zy * ry), "slope_x": np.full(rx.shape, zx),
            "slope_y": np.full(rx.shape, zy)}  # fmt: skip
    names = tuple(maps) if slopes else ("depth",)
    field = write_store(tmp_path / "o.zarr", names, lambda t: maps, frames=(0,)).field(0)
    x, y = (np.append(a - 2.0, a[-1] + 2.0) for a in (X, Y))
    rays = np.stack([*np.meshgrid((x - PRINCIPAL[0]) / F_PX, (y - PRINCIPAL[1]) / F_PX), np.ones((y.size, x.size))], -1)
    corners = rays * (DEPTH / (1 - zx * rays[..., 0] - zy * rays[..., 1]))[..., None]
    sides = (corners[1:, 1:] - corners[:-1, :-1], corners[1:, :-1] - corners[:-1, 1:])
    exact = np.linalg.norm(np.cross(*sides), axis=-1) / 2
    inner = (slice(1, -1), slice(1, -1))  # without slopes, differences are one-sided at the border
    np.testing.assert_allclose(surface_area(field)[inner], exact[inner], rtol=1e-4)
    assert surface_points(field).shape == (*rx.shape, 3)


# Labels.


def write_labels(path: Path, image: NDArray[Any]) -> Path:
    if path.suffix == ".png":
        pytest.importorskip("imagecodecs", reason="imagecodecs is not installed")
        from PIL import Image

        Image.fromarray(image).save(path)
    else:
        tifffile.imwrite(path, image)
    return path


@pytest.mark.parametrize(
    ("name", "dtype"),
    [("l.tif", np.uint8), ("l.tif", np.uint16), ("l.tif", np.int32), ("l.tif", np.float32), ("l.png", np.uint8),
     ("l.png", np.uint16)],
)  # fmt: skip
def test_label_files_of_all_kinds(name: str, dtype: type, store: ResultStore, tmp_path: Path) -> None:
    labels = Labels.of(write_labels(tmp_path / name, label_image(dtype)), store)
    assert labels.values == (1, 5)
    assert labels.index == 2
    np.testing.assert_array_equal(labels.image(0), label_image())


def test_a_mask_is_one_region(store: ResultStore, tmp_path: Path) -> None:
    path = write_labels(tmp_path / "mask.png", ((label_image() > 0) * 255).astype(np.uint8))
    assert measure_regions(store, path).regions == (255,)


def test_a_stack_has_labels_for_every_frame(store: ResultStore, tmp_path: Path) -> None:
    stack = np.stack([np.roll(label_image(), 2 * t, axis=1) for t in range(5)])
    stack[3][stack[3] == 5] = 0
    tifffile.imwrite(tmp_path / "stack.tif", stack)
    table = measure_regions(store, tmp_path / "stack.tif")
    assert len(table) == 9
    assert np.unique(table.of(1)["pixels"]).tolist() == [31**2]
    with pytest.raises(UsageError, match="has a page for every frame, so leave it out"):
        measure_regions(store, stack, labels_frame=4)


def test_coverage_counts_the_pixels_between_the_maps_own(store: ResultStore) -> None:
    image = label_image().astype(np.int64)
    for value in (1, 5):
        place = covered(store, image, value)
        assert place is not None
        assert place.pixels == (image == value).sum()
        assert place.share.max() == 1
        assert ((place.share > 0) & (place.share < 1)).any()


def test_another_frame_of_the_labels(store: ResultStore) -> None:
    table = measure_regions(store, label_image(), labels_frame=6)
    assert table.of(1)["pixels"][4] == 31**2
    assert table.of(1)["pixels"][0] < 31**2  # the leaf was smaller


@pytest.mark.parametrize(
    ("image", "frame", "error", "match"),
    [
        (np.zeros((120, 160), int), None, InputError, "no labels, all pixels are 0"),
        (np.ones((119, 160), int), None, InputError, "160 x 119 pixels for images of 160 x 120: make them the same"),
        (np.full((120, 160), 0.5), None, InputError, "no labels: they must be whole numbers"),
        (np.full((120, 160), -1), None, InputError, "whole numbers, 0 or more"),
        (np.ones((3, 120, 160), int), None, InputError, "3 pages for the 5 frames"),
        (np.ones((120, 160), int), 9, UsageError, r"holds the frames 2\.\.6"),
        (np.ones(7, int), None, InputError, "give \\[height, width\\]"),
    ],
)
def test_labels_that_do_not_fit(
    image: NDArray[Any], frame: int | None, error: type[Exception], match: str, store: ResultStore
) -> None:
    with pytest.raises(error, match=match):
        measure_regions(store, image, labels_frame=frame)


def test_pictures_of_labels_are_refused(store: ResultStore, tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "c.tif", np.zeros((120, 160, 3), np.uint8), photometric="rgb")
    with pytest.raises(InputError, match="a colour picture, labels are one whole number per pixel"):
        measure_regions(store, tmp_path / "c.tif")


def test_sizes_are_told_where_the_run_does_not_say_its_own(tmp_path: Path) -> None:
    attrs = attributes()
    del attrs["plan"]["image_px"]
    store = write_store(tmp_path / "o.zarr", LEAF, leaf_maps(), attrs=attrs)
    with pytest.raises(InputError, match="results reach to x = 156, y = 116"):
        measure_regions(store, np.ones((100, 160), int))


def test_gaps_are_filled_outwards() -> None:
    values = np.full((1, 5, 5), np.nan)
    values[0, 2, 2] = 3.0
    np.testing.assert_array_equal(spread(values), np.full((1, 5, 5), 3.0))
    np.testing.assert_array_equal(spread(np.full((1, 2, 2), np.nan)), np.zeros((1, 2, 2)))


# Tables.


def test_tables_are_what_other_programs_read(store: ResultStore, tmp_path: Path) -> None:
    table = measure_regions(store, label_image(), start_time="2024-05-31T06:00+02:00")
    path = table.to_csv(tmp_path / "t.csv")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == list(table.columns)
    assert rows[0]["clock"] == "2024-05-31T07:00:00"  # frame 2 is an hour after frame 0
    assert float(rows[3]["growth_percent_per_h"]) == pytest.approx(table["growth_percent_per_h"][3], rel=1e-9)
    with pytest.raises(UsageError, match="give --overwrite to replace it"):
        table.to_csv(path)
    with pytest.raises(UsageError, match=r"let the name end in \.csv or \.parquet"):
        table.to_csv(tmp_path / "t.xlsx")


def test_parquet_and_pandas(store: ResultStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    pytest.importorskip("pyarrow", reason="pyarrow is not installed")
    table = measure_regions(store, label_image(), start_time="2024-05-31T06:00")
    back = pandas.read_parquet(table.to_csv(tmp_path / "t.parquet"))
    assert list(back.columns) == list(table.columns)
    assert back["frame"].dtype == np.int64
    assert back["clock"].dt.hour.tolist() == [7, 7, 7, 7, 8, 8, 8, 8, 9, 9]
    np.testing.assert_allclose(back["area_mm2"], table.to_pandas()["area_mm2"])
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(MissingExtra, match=r"leafflow-ti\[parquet\]"):
        table.to_csv(tmp_path / "u.parquet")


def test_missing_values_are_empty(tmp_path: Path) -> None:
    store = write_store(tmp_path / "o.zarr", LEAF, leaf_maps(0.0, (30.0, 0.0)))
    path = measure_regions(store, label_image()).to_csv(tmp_path / "t.csv")
    last = path.read_text(encoding="utf-8").splitlines()[-1]
    assert last.startswith("5,6,10800,0,0,,")
    assert "nan" not in path.read_text(encoding="utf-8")


def test_results_without_an_interval_have_rates_per_frame(tmp_path: Path) -> None:
    store = write_store(tmp_path / "o.zarr", LEAF, leaf_maps(GROWTH), interval_s=None)
    table = measure_regions(store, label_image())
    assert not any("per_h" in name for name in table.columns)
    assert "time_s" not in table.columns
    assert "rates are per frame" in table.notes[0]
    assert "growth [%/frame]" in repr(table)
    with pytest.raises(UsageError, match="time between frames is unknown"):
        measure_regions(store, label_image(), start_time="2024-05-31T06:00")


def test_a_run_that_goes_on_is_measured_so_far(tmp_path: Path) -> None:
    store = write_store(tmp_path / "o.zarr", LEAF, leaf_maps())
    (store.path / "status" / ".done" / "4").unlink()
    assert "1 of 5 units" in measure_regions(store, label_image()).notes[0]


def test_results_of_one_camera_have_flow_and_strain(tmp_path: Path) -> None:
    names = with_std(("flow_x", "flow_y", "strain_xx"))
    maps = {name: np.full((Y.size, X.size), 0.25) for name in names}
    rows = measure_regions(write_store(tmp_path / "o.zarr", names, lambda t: maps), label_image(), still=True).of(5)
    np.testing.assert_allclose(rows["flow_x_px_per_h"], 0.5)
    np.testing.assert_allclose(rows["strain_xx_percent_per_frame"], 0.25)
    assert "area_mm2" not in rows


def test_the_table_shows_itself(store: ResultStore) -> None:
    table = measure_regions(store, label_image())
    assert isinstance(table, RegionTable)
    assert repr(table).startswith("<RegionTable: 2 regions, frames 2..6>\n region")
    assert "4.04 ± " in repr(table)
    assert "<td>4.04 ± " in table._repr_html_()
    with pytest.raises(KeyError, match="no column 'growth'; there are: region"):
        table["growth"]


def test_command(store: ResultStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tifffile.imwrite(tmp_path / "labels.tif", label_image())
    command = ["regions", str(store.path), "--labels", str(tmp_path / "labels.tif"), "-o", str(tmp_path / "t.csv")]
    for extra, code in (([], 0), ([], 2), (["--overwrite", "--still"], 0), (["--light", "8-22"], 2)):
        with pytest.raises(SystemExit) as end:
            main([*command, *extra])
        assert (end.value.code or 0) == code
    out, err = capsys.readouterr()
    assert "4.04 ± " in out
    assert "t.csv, 10 rows" in out
    assert err.count("error:") == 2
    assert CORRELATION["t"][0] == 1
