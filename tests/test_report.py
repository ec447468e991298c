"""Reports without a browser: what the page says, what it leaves out, its size, and the refusals."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import sys
import zlib
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_stores import GROWTH, GROWTH_STD, PLAN, make_store

import leafflow_ti
from leafflow_ti.cli.main import main
from leafflow_ti.errors import InputError, MissingExtra, RunError, UsageError
from leafflow_ti.mesh import surface_mesh
from leafflow_ti.panels import panels_of
from leafflow_ti.report import LIMIT, facts, write_report
from leafflow_ti.report.charts import curves
from leafflow_ti.report.facts import Series, spread_evenly
from leafflow_ti.report.regions_table import read_region_curves
from leafflow_ti.report.surface import packed, packed_surfaces

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

EVIL = '</script><script>alert(1)</script><img src=x onerror="alert(2)">'


class _Parts(HTMLParser):
    """Elements of a page: tags with their attributes, texts of scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.scripts: list[str] = []
        self.text: list[str] = []
        self._in = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        self._in = tag

    def handle_endtag(self, tag: str) -> None:
        self._in = ""

    def handle_data(self, data: str) -> None:
        if self._in == "script":
            self.scripts.append(data)
        elif self._in != "style":
            self.text.append(data)


def parts_of(page: str) -> _Parts:
    parts = _Parts()
    parts.feed(page)
    return parts


def written(folder: Path, **options: Any) -> str:
    store = make_store(folder / "leaf.zarr", **options)
    return write_report(store, folder / "page.html").read_text(encoding="utf-8")


def growth_in(text: str, unit: str) -> tuple[float, float]:
    """Growth and its standard error, as the page's first lines give them."""
    found = re.search(rf"([\d.]+) ± ([\d.]+) {unit}", text)
    assert found is not None, text[:500]
    return float(found[1]), float(found[2])


def data_of(page: str) -> dict[str, Any]:
    """What the page's script works with."""
    found: dict[str, Any] = json.loads(parts_of(page).scripts[0])
    return found


def unpack(text: str, dtype: type[np.uint16] | type[np.uint32], width: int = 1) -> np.ndarray:
    differences = np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype).reshape(-1, width)
    return np.cumsum(differences, axis=0, dtype=dtype)


# --- the page --------------------------------------------------------------------------------------------------------


def test_page_tells_what_was_measured(tmp_path: Path) -> None:
    page = written(tmp_path)
    text = " ".join("".join(parts_of(page).text).split())
    assert "frames 2 to 4, one every 2 min" in text
    # .2 %/frame on average, one frame every 2 min; the pixels of the three frames are independent.
    assert growth_in(text, "%/h") == pytest.approx((6.0, 0.6 / (3 * 30 * 37) ** 0.5), rel=0.06)
    assert "affine-scene-flow" in text
    assert "33 × 33 px, 3 frames, stride 2" in text
    assert "45 files" in text
    assert "cpu (2 threads)" in text
    assert "border7.5%the window reaches beyond an image" in text
    assert "9.5 s" in text
    for title in ("growth rate", "growth rate, standard error", "depth", "surface normals", "velocity x", "status"):
        assert title in text


def test_every_map_has_its_frames_scale_and_words(tmp_path: Path) -> None:
    page = written(tmp_path)
    data, parts = data_of(page), parts_of(page)
    keys = [attrs["data-panel"] for tag, attrs in parts.elements if tag == "figure" and "data-panel" in attrs]
    assert list(data["images"]) == keys
    assert {"growth_rate", "growth_rate_std", "depth", "normals", "velocity", "status"} <= set(keys)
    for uris in data["images"].values():
        assert [uri is None for uri in uris] == [False, True, False]  # the middle one is in the figure
        assert all(base64.b64decode(uri.partition(",")[2])[:4] == b"\x89PNG" for uri in uris if uri)
    pictures = [attrs for tag, attrs in parts.elements if tag == "img"]
    assert all(attrs["alt"] for attrs in pictures)
    assert any("Map: relative growth rate of the surface area" in attrs["alt"] for attrs in pictures)


def test_images_of_a_map_share_one_scale(tmp_path: Path) -> None:
    from io import BytesIO

    from PIL import Image

    data = data_of(written(tmp_path))
    shown = []
    for uri in (data["images"]["growth_rate"][i] for i in (0, 2)):
        with Image.open(BytesIO(base64.b64decode(uri.partition(",")[2]))) as image:
            assert image.size == (40, 30)
            shown.append(np.asarray(image.convert("RGBA")))
    assert (shown[0][..., 3] == 0).sum() == 3 * 30  # the border is transparent
    assert tuple(shown[0][5, 10]) != tuple(shown[1][5, 10])  # growth differs between the frames


def test_page_needs_nothing_from_elsewhere(tmp_path: Path) -> None:
    page = written(tmp_path)
    parts = parts_of(page)
    for _, attrs in parts.elements:
        for name in ("src", "href", "srcset", "action"):
            assert attrs.get(name, "data:").startswith("data:")
    policy = next(a["content"] for t, a in parts.elements if a.get("http-equiv") == "Content-Security-Policy")
    checksum = base64.b64encode(hashlib.sha256(parts.scripts[1].encode()).digest()).decode()
    assert "default-src 'none'" in policy
    assert f"script-src 'sha256-{checksum}'" in policy
    assert "http://" not in page.replace("http://www.w3.org", "")


def test_what_comes_from_outside_is_escaped(tmp_path: Path) -> None:
    plain = parts_of(written(tmp_path / "plain"))
    store = make_store(
        tmp_path / "<b>leaf&.zarr", device=EVIL, config=f"# {EVIL}\n", versions={EVIL: EVIL},
        plan={**PLAN, "model": EVIL}, input={"files": EVIL}, timings={"stages": {EVIL: 1.0}, "seconds": 1},
    )  # fmt: skip
    table = tmp_path / "t.csv"
    table.write_text(
        f'region,frame,pixels,growth_percent_per_h,growth_se_percent_per_h\n"{EVIL.replace(chr(34), "")}",2,9,1.0,.1\n'
    )
    page = write_report(store, tmp_path / "evil.html", title=EVIL, regions=table).read_text()
    parts = parts_of(page)
    assert len(parts.scripts) == 2
    assert not [attrs for _, attrs in parts.elements if "onerror" in attrs]
    kinds = {tag for tag, _ in parts.elements}
    assert kinds - {tag for tag, _ in plain.elements} <= {"i"}
    assert EVIL in "".join(parts.text)


def test_page_is_the_same_twice(tmp_path: Path) -> None:
    store = make_store(tmp_path / "s.zarr")
    one, two = (write_report(store, tmp_path / f"{name}.html").read_bytes() for name in "ab")
    assert one == two


# --- its size --------------------------------------------------------------------------------------------------------


def test_large_results_stay_below_the_limit(tmp_path: Path) -> None:
    """Noise in every map, as hardly compresses, and more frames than are shown."""
    store = make_store(tmp_path / "s.zarr", frames=range(13), size=(200, 260), noise=0.3)
    page = write_report(store, tmp_path / "page.html")
    assert 0.3 * LIMIT < page.stat().st_size <= LIMIT
    data = data_of(page.read_text(encoding="utf-8"))
    assert len(data["labels"]) == 12
    assert data["labels"][0].startswith("frame 0")
    assert data["labels"][-1] == "frame 12 · 24 min"
    assert "one of" in page.read_text(encoding="utf-8")  # says that pixels are left out


def test_frames_are_chosen_evenly() -> None:
    assert spread_evenly(range(5), 12) == [0, 1, 2, 3, 4]
    assert spread_evenly(range(100), 3) == [0, 50, 99]
    assert spread_evenly([7, 9, 40], 1) == [7]


# --- runs that go on, and maps that are not there --------------------------------------------------------------------


def test_unfinished_run_is_shown_as_far_as_it_is(tmp_path: Path) -> None:
    page = written(tmp_path, frames=range(6), done=(0, 2))
    text = " ".join("".join(parts_of(page).text).split())
    assert "This run is not finished: 2 of 6 frames are done" in text
    assert "--resume" in text
    assert [label.split(" ·")[0] for label in data_of(page)["labels"]] == ["frame 0", "frame 2"]


def test_run_without_any_unit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing is measured yet"):
        written(tmp_path, done=())


def test_flow_alone_has_no_surface_and_no_growth(tmp_path: Path) -> None:
    page = written(tmp_path, names=("flow_x", "flow_y"), interval_s=None)
    assert "<canvas" not in page
    assert "Growth over time" not in page
    assert data_of(page)["surface"] is None
    assert data_of(page)["labels"] == ["frame 2", "frame 3", "frame 4"]


def test_growth_without_a_known_interval_is_per_frame(tmp_path: Path) -> None:
    text = "".join(parts_of(written(tmp_path, interval_s=None)).text)
    assert growth_in(text, "%/frame") == pytest.approx((0.2, 0.02 / (3 * 30 * 37) ** 0.5), rel=0.03)
    assert "%/h" not in text


def test_residuals_are_shown_where_they_are_known() -> None:
    """As the confidence, beside the status; results without that map have the status alone."""
    pages = [panels_of(names)["status"] for names in (("depth", "confidence"), ("depth",))]
    assert [[panel.key for panel in page] for page in pages] == [["status", "confidence"], ["status"]]


def test_single_frame_has_no_slider(tmp_path: Path) -> None:
    assert 'id="frame"' not in written(tmp_path, frames=(4,))


# --- its numbers -----------------------------------------------------------------------------------------------------


def test_a_few_bad_pixels_do_not_spoil_the_mean(tmp_path: Path) -> None:
    """One pixel with an error, and a value, a thousand times the others'."""
    store = make_store(tmp_path / "s.zarr", frames=(0,))
    before = facts.Facts.of(store).growth[0]
    for name, value in (("growth_rate", -50 * GROWTH), ("growth_rate_std", 1000 * GROWTH_STD)):
        values = store.read(name, 0)
        values[15, 20] = value
        store.write_maps(0, {name: values})
    after = facts.Facts.of(store).growth[0]
    assert after.mean == pytest.approx(before.mean, rel=1e-3)
    assert after.error == pytest.approx(before.error, rel=0.01)


def test_growth_rests_on_pixels_that_are_ok(tmp_path: Path) -> None:
    store = make_store(tmp_path / "s.zarr")
    found = facts.Facts.of(store)
    (series,) = found.growth
    assert series.mean == pytest.approx([30 * GROWTH * (1 + i) for i in range(3)], rel=1e-5)
    independent = 30 * 37  # at the pitch of 2 px, neighbours share nothing
    # Pixels stand for nearly the same area, so the mean's error is nearly that of equal weights.
    assert series.error == pytest.approx(np.full(3, 30 * GROWTH_STD / independent**0.5), rel=0.02)
    assert found.measured == pytest.approx([37 / 40] * 3)


def test_curves_have_gaps_where_nothing_is_known() -> None:
    x, y = np.arange(6.0), np.array([1.0, 2.0, np.nan, 3.0, 4.0, np.nan])
    svg = curves([Series("a", x, y, np.full(6, 0.1))], "frame", "<unit>", 'say "x"', [0.0, 5.0])
    assert len(re.findall("<polyline", svg)) == 2
    assert "&lt;unit&gt;" in svg
    assert "nan" not in svg
    assert 'data-at="58.0 468.0"' in svg


def test_curves_without_any_value_are_drawn() -> None:
    svg = curves([Series("a", np.array([4.0]), np.array([np.nan]), np.array([np.nan]))], "frame", "%", "none", [4.0])
    assert "nan" not in svg
    assert "<polyline" not in svg


# --- the surface -----------------------------------------------------------------------------------------------------


def test_packed_arrays_come_back() -> None:
    rng = np.random.default_rng(0)
    triangles = rng.integers(0, 2**31, (50, 3))
    assert (unpack(packed(triangles, np.uint32), np.uint32, 3) == triangles).all()
    signed = rng.integers(-(2**15), 2**15, (40, 3)).astype(np.int16)
    assert (unpack(packed(signed, np.uint16), np.uint16, 3).view(np.int16) == signed).all()
    assert unpack(packed(np.empty(0, int), np.uint16), np.uint16).size == 0


def test_packed_surface_is_that_of_the_mesh(tmp_path: Path) -> None:
    store = make_store(tmp_path / "s.zarr")
    field = store.field(1)
    found = packed_surfaces([field, store.field(2)])
    mesh, frame = surface_mesh(field), found["frames"][0]
    low, step = found["depth"]
    assert (unpack(frame["pixels"], np.uint32).ravel() == mesh.pixels).all()
    assert (unpack(frame["triangles"], np.uint32, 3) == mesh.triangles).all()
    assert low + step * unpack(frame["depths"], np.uint16).ravel() == pytest.approx(mesh.vertices[:, 2], abs=step)
    tails = unpack(frame["tails"], np.uint32).ravel()
    velocity = unpack(frame["arrows"], np.uint16, 3).view(np.int16) * found["step"]
    expected = np.stack([mesh.at(field[f"velocity_{a}"])[tails] for a in "xyz"], axis=-1)
    assert velocity == pytest.approx(expected, abs=found["step"])
    assert 50 < len(tails) < 200
    centre, radius = np.array(found["view"][:3]), found["view"][3]
    assert (np.linalg.norm(mesh.vertices - centre, axis=1) < 1.1 * radius).all()


# --- regions, the command, refusals ----------------------------------------------------------------------------------


def table(folder: Path, text: str) -> Path:
    path = folder / "t.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_regions_are_read_largest_first(tmp_path: Path) -> None:
    head = "frame,region,pixels,growth_percent_per_h,growth_se_percent_per_h\n"
    found = read_region_curves(table(tmp_path, head + "3,1,10,,\n2,1,12,1.5,.1\n2,2,90,2.5,.2\n3,2,91,2.25,.2\n"))
    assert [s.name for s in found.series] == ["region 2", "region 1"]
    assert found.unit == "%/h"
    assert found.series[0].mean == pytest.approx([2.5, 2.25])
    assert found.series[1].x == pytest.approx([2, 3])
    assert found.series[1].mean == pytest.approx([1.5, np.nan], nan_ok=True)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "needs the columns region, frame"),
        ("frame,region,pixels\n1,1,1\n", "needs the columns region, frame"),
        ("frame,region,pixels,growth_percent_per_h,growth_se_percent_per_h\n1,1,1,abc,1\n", "holds 'abc'"),
    ],
)
def test_tables_that_are_none_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_region_curves(table(tmp_path, text))


def test_missing_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read as a table"):
        read_region_curves(tmp_path / "absent.csv")


def call(*args: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(arg) for arg in args])
    return int(end.value.code or 0)


def test_command_writes_and_replaces_reports_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make_store(tmp_path / "s.zarr")
    page = tmp_path / "new" / "page.html"
    assert call("report", tmp_path / "s.zarr", "-o", page, "--title", "My leaf", "--frames", 2) == 0
    assert str(page) in capsys.readouterr().out
    assert "<title>My leaf · leafflow-ti</title>" in page.read_text(encoding="utf-8")
    assert len(data_of(page.read_text(encoding="utf-8"))["labels"]) == 2
    assert call("report", tmp_path / "s.zarr", "-o", page) == 0
    assert "<title>s · leafflow-ti</title>" in page.read_text(encoding="utf-8")
    page.write_text("precious", encoding="utf-8")
    assert call("report", tmp_path / "s.zarr", "-o", page) == 2
    assert "is no report" in capsys.readouterr().err
    assert page.read_text(encoding="utf-8") == "precious"
    assert call("report", tmp_path / "s.zarr", "-o", tmp_path / "s.zarr") == 2
    assert call("report", tmp_path / "absent.zarr", "-o", tmp_path / "p.html") == 4
    assert call("report", tmp_path / "s.zarr", "-o", tmp_path / "p.html", "--frames", 0) == 2


def test_unwritable_page_is_a_run_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RunError, match="cannot be written"):
        write_report(make_store(tmp_path / "s.zarr"), tmp_path / "file" / "page.html")


def test_missing_matplotlib_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = make_store(tmp_path / "s.zarr")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtra, match=r"leafflow-ti\[plot\]"):
        write_report(store, tmp_path / "page.html")


def test_public_name() -> None:
    assert leafflow_ti.write_report is write_report


def test_fewer_than_one_frame_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="at least 1"):
        write_report(make_store(tmp_path / "s.zarr"), tmp_path / "page.html", frames=0)
