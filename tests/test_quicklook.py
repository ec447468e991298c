"""Quick looks: which pictures appear, what their colours mean, robust limits, and the refusals."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.colours import STATUS_COLOURS, normal_colours, robust_limits
from leafflow_ti.errors import MissingExtra, RunError
from leafflow_ti.quicklook import write_quicklooks
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

matplotlib = pytest.importorskip("matplotlib", reason="matplotlib is not installed")

STEREO = ("disparity", "depth", "depth_std", "slope_x", "slope_y")
MOTION = ("velocity_x", "velocity_y", "velocity_z", "rotation_x", "rotation_y", "rotation_z")
FLOW = ("flow_x", "flow_y")


def make(folder: Path, names: tuple[str, ...], empty: bool = False) -> ResultStore:
    y, x = np.arange(10, 34, 2), np.arange(4, 40, 2)
    store = ResultStore.create(
        folder / "out.zarr", frames=[4], y=y, x=x, names=names, chunk=(1, y.size, x.size), attrs={}
    )
    status = np.zeros((y.size, x.size), np.uint8)
    status[:, :3] = Status.BORDER
    rng = np.random.default_rng(0)
    maps = {name: rng.normal(size=status.shape).astype(np.float32) for name in names}
    for values in maps.values():
        values[:] = np.where((status == Status.BORDER) | empty, np.nan, values)
    store.write_unit(0, 0, slice(0, y.size), maps, status)
    return store


@pytest.mark.parametrize(
    ("names", "pages"),
    [
        (STEREO + MOTION, {"depth", "normals", "motion", "rotation", "status", "overview"}),
        (("depth", "growth_rate", "growth_rate_std"), {"depth", "growth", "status", "overview"}),
        (STEREO, {"depth", "normals", "status", "overview"}),
        (("disparity",), {"depth", "status", "overview"}),
        (FLOW, {"flow", "status", "overview"}),
        ((*FLOW, "strain_xx", "strain_yy", "strain_xy"), {"flow", "strain", "status", "overview"}),
    ],
)
def test_pictures_follow_the_maps(tmp_path: Path, names: tuple[str, ...], pages: set[str]) -> None:
    written = write_quicklooks(make(tmp_path, names), 0, tmp_path / "new" / "pictures")
    assert {path.stem for path in written} == pages
    for path in written:
        picture = matplotlib.image.imread(path)
        assert picture.shape[0] > 200
        assert picture.std() > 0.02  # not a blank page


def test_maps_without_any_value_are_drawn(tmp_path: Path) -> None:
    written = write_quicklooks(make(tmp_path, STEREO + MOTION, empty=True), 0, tmp_path / "pictures")
    assert {path.stem for path in written} >= {"depth", "motion"}


def test_pictures_are_the_same_twice(tmp_path: Path) -> None:
    store = make(tmp_path, FLOW)
    first, second = (write_quicklooks(store, 0, tmp_path / name) for name in ("a", "b"))
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in second]


def test_status_picture_shows_its_colours_in_their_shares(tmp_path: Path) -> None:
    (path,) = [p for p in write_quicklooks(make(tmp_path, FLOW), 0, tmp_path / "q") if p.stem == "status"]
    picture = matplotlib.image.imread(path)[..., :3]
    pixels = {}
    for status in (Status.OK, Status.BORDER):
        colour = matplotlib.colors.to_rgb(STATUS_COLOURS[status])
        pixels[status] = np.isclose(picture, colour, atol=0.01).all(axis=-1).sum()
    assert pixels[Status.OK] / pixels[Status.BORDER] == pytest.approx(15 / 3, rel=0.15)
    assert set(STATUS_COLOURS) == set(Status)


def test_colours_of_normals() -> None:
    slope_x = np.array([[0.0, 1.0, 0.0, np.nan]])
    slope_y = np.array([[0.0, 0.0, -1e9, 0.0]])
    half = (1 + 0.5**0.5) / 2
    expected = np.array([[[0.5, 0.5, 1.0], [half, 0.5, half], [0.5, 0.0, 0.5], [np.nan] * 3]])
    assert np.allclose(normal_colours(slope_x, slope_y), expected, atol=1e-8, equal_nan=True)


def test_limits_are_robust_and_never_equal() -> None:
    values = np.arange(1000.0)
    values[-1] = 1e9
    low, high = robust_limits(np.append(values, np.nan))
    assert low == pytest.approx(20, abs=1)
    assert high == pytest.approx(979, abs=1)
    assert robust_limits(np.array([-1.0, 3.0] * 50)) == (-3.0, 3.0)
    low, high = robust_limits(np.full(5, 7.0))
    assert low < 7 < high
    assert robust_limits(np.zeros(5)) == (-1.0, 1.0)
    assert robust_limits(np.full(5, np.nan)) == (0.0, 1.0)


def test_missing_matplotlib_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = make(tmp_path, FLOW)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtra, match=r"leafflow-ti\[plot\]"):
        write_quicklooks(store, 0, tmp_path / "q")


def test_unwritable_folder_is_a_run_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RunError, match="quick looks cannot be written"):
        write_quicklooks(make(tmp_path, FLOW), 0, tmp_path / "file")
