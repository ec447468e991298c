"""What notebooks show of results, and results as xarray datasets."""

from __future__ import annotations

import importlib.util
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from report_stores import make_store

import leafflow_ti as lf
from leafflow_ti.colours import LEVELS, STATUS_COLOURS, Scale, palette_png, rgba_png, status_png
from leafflow_ti.errors import MissingExtra
from leafflow_ti.panels import PAGES, Panel, arrows_of, panels_of, shown_in
from leafflow_ti.status import Status


class _Text(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.rows: list[list[str]] = []
        self.images = 0
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.images += tag == "img"
        if tag == "tr":
            self.rows.append([])

    def handle_data(self, data: str) -> None:
        self.words.append(data)
        if self.rows:
            self.rows[-1].append(data)


def test_field_shows_its_maps(tmp_path: Path) -> None:
    shown = _Text(make_store(tmp_path / "s.zarr").field(1)._repr_html_())
    assert "Field · frame 3 · 30 x 40 (y, x)" in shown.words
    assert "ok 92.5%" in shown.words
    assert "border 7.5%" in shown.words
    assert ["growth_rate", "%/frame", "0.200", "0.020", "92%"] in shown.rows
    (slope,) = [row for row in shown.rows if row[0] == "slope_x"]
    assert slope[2:] == ["–", "92%"]  # neither a unit, whose cell is empty, nor a standard error
    assert not any(row[0].endswith("_std") for row in shown.rows)
    assert shown.images == (4 if importlib.util.find_spec("matplotlib") else 0)


def test_field_without_matplotlib_shows_the_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("leafflow_ti.display.importlib.util.find_spec", lambda name: None)
    shown = _Text(make_store(tmp_path / "s.zarr").field(1)._repr_html_())
    assert shown.images == 0
    assert ["growth_rate", "%/frame", "0.200", "0.020", "92%"] in shown.rows


def test_store_shows_how_far_it_is(tmp_path: Path) -> None:
    store = make_store(tmp_path / "<s>.zarr", frames=range(5), done=(0, 1, 2))
    shown = _Text(store._repr_html_())
    assert "<s>.zarr · 3 of 5 frames · 30 x 40 (y, x) · below: frame 1" in shown.words
    assert repr(store).startswith("<ResultStore <s>.zarr, 5 x 30 x 40 (t, y, x), 3 of 5 units done: depth, slope_x")
    empty = make_store(tmp_path / "empty.zarr", done=())
    assert _Text(empty._repr_html_()).words == ["empty.zarr · 0 of 3 frames · 30 x 40 (y, x)"]


def test_capture_shows_what_it_is() -> None:
    geometry = lf.Geometry(f_px=2800.0, principal_px=(31.5, 23.5), baseline_mm=(5.0, 0.0))
    images = np.zeros((3, 1, 9, 48, 64), np.uint8)
    text = " ".join(_Text(lf.capture_from_array(images, geometry)._repr_html_()).words)
    assert "64 x 48 px, 8 bit in uint8" in text
    assert "1 x 9 (rows, columns)" in text
    assert "focal length 2800 px" in text
    assert "not stated" in text


def test_store_as_a_dataset(tmp_path: Path) -> None:
    pytest.importorskip("xarray", reason="xarray is not installed")
    store = make_store(tmp_path / "s.zarr")
    with store.to_xarray() as dataset:
        assert dataset["depth"].dims == ("t", "y", "x")
        assert dataset["depth"].attrs["units"] == "mm"
        assert dataset["t"].values.tolist() == [2, 3, 4]
        assert np.array_equal(dataset["depth"].sel(t=3).values, store.read("depth", 1), equal_nan=True)
        assert dataset["status"].attrs["flag_meanings"].startswith("ok ")


def test_missing_xarray_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = make_store(tmp_path / "s.zarr")
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingExtra, match=r"leafflow-ti\[xarray\]"):
        store.to_xarray()


# --- colours and panels ----------------------------------------------------------------------------------------------


def read(png: bytes) -> np.ndarray:
    """A PNG file by an independent reader, [y, x, 4]."""
    import io

    pillow = pytest.importorskip("PIL.Image", reason="pillow is not installed")
    with pillow.open(io.BytesIO(png)) as image:
        image.load()
        return np.asarray(image.convert("RGBA"))


def test_images_open_elsewhere() -> None:
    palette = np.array([[1, 2, 3], [40, 50, 60]], np.uint8)
    found = read(palette_png(np.array([[0, 1, 2]], np.uint8), palette))
    assert found[0, :2].tolist() == [[1, 2, 3, 255], [40, 50, 60, 255]]
    assert found[0, 2, 3] == 0
    assert read(rgba_png(np.array([[[0.0, 0.6, 1.0, 1.0]]])))[0, 0].tolist() == [0, 153, 255, 255]
    shades = read(status_png(np.array([[Status.OK, Status.NOT_COMPUTED]], np.uint8)))[0, :, :3]
    expected = [bytes.fromhex(STATUS_COLOURS[s][1:]) for s in (Status.OK, Status.NOT_COMPUTED)]
    assert [bytes(shade) for shade in shades] == expected


def test_scale_runs_from_its_lowest_to_its_highest_value() -> None:
    matplotlib = pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    scale = Scale(-1.0, 3.0, "viridis")
    assert scale.indices(np.array([-9.0, -1.0, 1.0, 3.0, 9.0, np.nan])).tolist() == [
        0, 0, LEVELS // 2, LEVELS - 1, LEVELS - 1, LEVELS,
    ]  # fmt: skip
    ends = [np.rint(255 * np.array(matplotlib.colormaps["viridis"](v)[:3])).astype(int).tolist() for v in (0.0, 1.0)]
    assert scale.palette()[[0, -1]].tolist() == ends
    assert Scale.of(np.arange(5.0), signed=True) == Scale(-3.92, 3.92, "coolwarm")
    assert Scale.of(np.arange(1.0, 5.0), error=True).colours == "cividis"


def test_panels_show_what_there_is_once() -> None:
    keys = {
        page: [panel.key for panel in panels] for page, panels in panels_of(("depth", "disparity", "flow_x")).items()
    }
    assert keys == {
        "depth": ["depth"], "flow": ["flow_x"], "status": ["status"], "overview": ["depth", "status", "flow_x"],
    }  # fmt: skip
    assert [panel.key for panel in panels_of(("disparity",))["depth"]] == ["disparity"]
    assert len({key for _, (_, found) in PAGES.items() for key in found}) == sum(len(f) for _, f in PAGES.values())


def test_growth_is_shown_per_hour_motion_per_frame() -> None:
    assert shown_in("growth_rate_std", 120.0) == ("%/h", 30.0)
    assert shown_in("velocity_x", 120.0) == ("mm/frame", 1.0)
    assert shown_in("growth_rate", None) == ("%/frame", 1.0)
    assert Panel("area_rate", 3600.0).unit == "%/h"
    assert Panel("normals").unit == ""


def test_arrows_are_as_long_as_the_motion(tmp_path: Path) -> None:
    field = make_store(tmp_path / "s.zarr").field(0)
    arrows = arrows_of(field, "velocity", 0.3)
    column, row = (int(arrows.x[5]) // 2, int(arrows.y[5]) // 2)
    step = 2  # output pixels between two arrows, which lie 2 px apart
    stretch = 0.9 * 2 * step / 0.3
    assert arrows.u[5] == pytest.approx(stretch * field["velocity_x"][row, column])
    assert arrows.v[5] == pytest.approx(stretch * field["velocity_y"][row, column])
    assert np.isfinite([arrows.u, arrows.v]).all()
