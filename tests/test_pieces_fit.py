"""One leaf through all that is made of finished results: they say the same of it, before and after an interruption."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tifffile
from flat_leaf import LEAF, SIZE, X, Y, leaf_maps, write_store

import leafflow_ti as lf
from leafflow_ti.cli.main import main
from leafflow_ti.field import CORRELATIONS, SURFACE_NAMES
from leafflow_ti.report.facts import Facts
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

GROWTH = 5e-4
"""Of lengths, per frame."""
TRUE = 100 * np.expm1(2 * GROWTH)
"""Of areas, %/frame."""
PER_H = 2.0
"""Frames."""


def make(path: Path, frames: tuple[int, ...] = (2, 3, 4, 5, 6), interval_s: float | None = 1800.0) -> ResultStore:
    """Results of a leaf whose lengths grow; the components of its motion have independent errors."""
    maps = leaf_maps(GROWTH)
    zeros = {name: np.zeros((Y.size, X.size)) for name in CORRELATIONS}
    return write_store(path, (*LEAF, *CORRELATIONS), lambda t: {**maps(t), **zeros}, frames, interval_s)


@pytest.fixture
def store(tmp_path: Path) -> ResultStore:
    return make(tmp_path / "leaf.zarr")


@pytest.fixture
def labels(tmp_path: Path) -> Path:
    """All of the images, one region."""
    path = tmp_path / "labels.tif"
    tifffile.imwrite(path, np.ones(SIZE[::-1], np.uint8))
    return path


@pytest.fixture
def call(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs a command in the folder of the test: exit code, output, errors."""

    def run(*args: object) -> tuple[int, str, str]:
        with contextlib.chdir(tmp_path), pytest.raises(SystemExit) as end:
            main([str(arg) for arg in args])
        return int(end.value.code or 0), *capsys.readouterr()

    return run


def stopping(after: int) -> Callable[[int, int], None]:
    """Interrupts what it shows the progress of."""

    def show(done: int, total: int) -> None:
        if done == after:
            raise KeyboardInterrupt

    return show


@pytest.mark.parametrize("average", [1, 3])
def test_every_measure_of_growth_is_the_same(store: ResultStore, labels: Path, average: int) -> None:
    """By regions, in the report, along tracks, in the summary; standard errors of means are one and the same."""
    summary = lf.measure_growth(store, average=average)
    assert summary.maps["area_rate"].median == pytest.approx(TRUE, rel=1e-3)
    store = ResultStore.open(store.path)
    table = lf.measure_regions(store, labels, still=True)
    told = re.findall(r"([\d.]+) ± ([\d.e-]+)", table.summary()[-1])
    facts = Facts.of(store)
    assert facts.growth_unit == "%/h"
    for series, name, (mean, error) in zip(facts.growth, ("growth", "area_rate"), told, strict=True):
        values, errors = table[f"{name}_percent_per_h"], table[f"{name}_se_percent_per_h"]
        assert values == pytest.approx(PER_H * TRUE, rel=1e-3)
        assert series.mean == pytest.approx(values, rel=1e-6)
        # Labels end with the image, pixels of maps stand for some beyond it.
        assert series.error == pytest.approx(errors, rel=0.02)
        overall = series.overall()
        assert overall is not None
        assert overall == (pytest.approx(float(mean), rel=1e-3), pytest.approx(float(error), rel=0.05))
    tracks = lf.track_growth(store, lf.track(store, X[5:-5:5], np.full(X[5:-5:5].size, Y[15])))
    for name in ("growth", "area_growth"):
        assert tracks[name][-1] == pytest.approx(100 * np.expm1(8 * GROWTH), rel=1e-3)


def test_interrupted_growth_is_told_and_mended(
    store: ResultStore, labels: Path, call: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in the middle, on results that have such maps already: nobody takes the rest for results."""
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    assert call("growth", store.path)[0] == 0
    with monkeypatch.context() as patch:
        patch.setattr("leafflow_ti.cli.growth.counted", lambda what: stopping(2))
        code, _, err = call("growth", store.path, "--average", 3)
    assert code == 130
    assert err.startswith("error: interrupted: maps that are not whole are left out")
    assert not set(SURFACE_NAMES) & set(ResultStore.open(store.path).names)
    said = "did not come to its end, so its maps (area_rate and others) are left out: run it again"
    commands = (
        ("regions", store.path, "--labels", labels, "-o", "r.csv"),
        ("track", store.path, "-o", "t.csv"),
        ("export", store.path, "--to", "csv", "-o", "e.csv"),
        ("info", store.path),
    )
    for command in commands:
        code, out, err = call(*command)
        assert code == 0, err
        assert said in out, command[0]
    for name in ("r.csv", "t.csv", "e.csv"):
        header = labels.with_name(name).read_text(encoding="utf-8").partition("\n")[0]
        assert "growth" in header
        assert "area_" + ("growth" if name == "t.csv" else "rate") not in header
    assert call("report", store.path, "-o", "page.html")[0] == 0
    page = labels.with_name("page.html")
    assert "Growth from the motion is not finished" in page.read_text(encoding="utf-8")
    assert call("growth", store.path, "--average", 3)[0] == 0
    code, out, _ = call("regions", store.path, "--labels", labels, "-o", "r.csv", "--overwrite")
    assert "note:" not in out
    assert "area rate [%/h]" in out
    assert call("report", store.path, "-o", "page.html")[0] == 0
    assert "not finished" not in page.read_text(encoding="utf-8")


def test_datasets_have_no_unfinished_maps(store: ResultStore) -> None:
    pytest.importorskip("xarray", reason="xarray is not installed")
    with pytest.raises(KeyboardInterrupt):
        lf.measure_growth(store, progress=stopping(1))
    found = ResultStore.open(store.path).to_xarray()
    assert "growth_rate" in found
    assert "area_rate" not in found


@pytest.mark.parametrize(
    ("command", "code", "message"),
    [
        (("regions", "-o", "t.csv", "--diel", "t.csv"), 2, "give different names"),
        (("regions", "-o", "t.csv", "--diel-figure", "t.bmp"), 2, "end in one of .png, .pdf, .svg"),
        (("regions", "-o", "t.csv", "--diel", "d.csv", "--bin-h", "5"), 2, "do not divide a day"),
        (("regions", "-o", "labels.tif/t.csv"), 6, "labels.tif is no folder"),
        (("track", "-o", "t.csv", "--points", "outside.csv"), 4, "none of these points is measured in frame 2"),
        (("track", "-o", "t.csv", "--axis", "10,10"), 2, "give x0,y0,x1,y1"),
        (("track", "-o", "t.csv", "--axis", "10,10,10,10"), 2, "neighbouring points of the axis are the same"),
        (("track", "-o", "t.csv", "--labels", "hidden.tif"), 4, "none of the points lies on a label"),
        (("track", "-o", "labels.tif/t.nc"), 6, "labels.tif is no folder"),
        (("export", "--to", "csv", "-o", "t.txt"), 2, "t.txt: no name for csv"),
        (("export", "--to", "ply", "-o", "t.vtk"), 2, "t.vtk: no name for ply"),
        (("report", "-o", "t.html", "--regions", "absent.csv"), 4, "absent.csv: cannot be read as a table (No such"),
        (("growth", "--average", "7"), 2, "hold 5 frames: choose --average 5 at most"),
        (("growth", "--strain-window", "1000"), 2, "cover 157 x 117 px: choose --strain-window 117 at most"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_what_cannot_be_done_leaves_nothing(
    store: ResultStore, labels: Path, call: Callable[..., tuple[int, str, str]], command: tuple[str, ...], code: int,
    message: str,
) -> None:  # fmt: skip
    """One line, the right exit code, no file."""
    if command[0] in ("report", "regions"):
        pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    if command[2].endswith(".nc"):
        pytest.importorskip("h5netcdf", reason="h5netcdf is not installed")
    folder = labels.parent
    (folder / "outside.csv").write_text("x,y\n-40,20\n900,20\n")
    corner = np.zeros(SIZE[::-1], np.uint8)
    corner[-2:, -2:] = 1
    tifffile.imwrite(folder / "hidden.tif", corner)
    before = sorted(path.name for path in folder.iterdir())
    more = ("--labels", labels) if command[0] == "regions" else ()
    found, _, err = call(command[0], store.path, *command[1:], *more)
    assert (found, err.count("\n")) == (code, 1), err
    assert message in err
    assert sorted(path.name for path in folder.iterdir()) == before


@pytest.mark.parametrize(
    ("module", "command", "extra"),
    [
        ("matplotlib.figure", ("regions", "-o", "t.csv", "--diel-figure", "d.png"), "plot"),
        ("pyarrow", ("regions", "-o", "t.parquet"), "parquet"),
        ("pyarrow", ("track", "-o", "t.parquet"), "parquet"),
        ("h5netcdf", ("track", "-o", "t.nc"), "netcdf"),
        ("h5netcdf", ("export", "--to", "netcdf", "-o", "t.nc"), "netcdf"),
        ("h5py", ("track", "-o", "t.nc"), "netcdf"),
        ("h5py", ("export", "--to", "netcdf", "-o", "t.nc"), "netcdf"),
        ("matplotlib", ("report", "-o", "t.html"), "plot"),
    ],
)
def test_what_is_not_installed_is_named(
    store: ResultStore, labels: Path, call: Callable[..., tuple[int, str, str]], monkeypatch: pytest.MonkeyPatch,
    module: str, command: tuple[str, ...], extra: str,
) -> None:  # fmt: skip
    monkeypatch.setitem(sys.modules, module, None)
    more = ("--labels", labels) if command[0] == "regions" else ()
    code, _, err = call(command[0], store.path, *command[1:], *more)
    assert code == 3
    assert f"leafflow-ti[{extra}]" in err
    assert not [path for path in labels.parent.iterdir() if path.suffix in (".csv", ".png", ".nc", ".html", ".parquet")]


def test_a_diel_curve_without_time_leaves_no_table(
    tmp_path: Path, labels: Path, call: Callable[..., tuple[int, str, str]]
) -> None:
    store = make(tmp_path / "untimed.zarr", interval_s=None)
    code, _, err = call("regions", store.path, "--labels", labels, "-o", "t.csv", "--diel", "d.csv")
    assert code == 4
    assert "no growth or area_rate per hour" in err
    assert not list(tmp_path.glob("*.csv"))


def test_a_single_frame_has_nothing_to_follow(tmp_path: Path, call: Callable[..., tuple[int, str, str]]) -> None:
    store = make(tmp_path / "single.zarr", frames=(4,))
    code, _, err = call("track", store.path, "-o", "t.csv")
    assert code == 4
    assert "holds one frame, so there is nothing to follow" in err


def test_what_is_nowhere_measured_is_told(
    store: ResultStore, labels: Path, call: Callable[..., tuple[int, str, str]]
) -> None:
    """Pixels of a region exist, and none of them is ok; a coarse grid finds none that is measured."""
    for t in range(len(store.frames)):
        status = store.read("status", t)
        status[:, :10] = Status.MASKED
        store.write_unit(t, t, slice(0, Y.size), {name: store.read(name, t) for name in store.names}, status)
    image = np.ones(SIZE[::-1], np.uint8)
    image[:, :30] = 2
    table = lf.measure_regions(store, image, still=True)
    assert table.notes == ("nothing of region 2 is measured in any frame: see the status map",)
    assert np.isfinite(table.of(1)["growth_percent_per_h"]).all()
    code, _, err = call("track", store.path, "-o", "t.csv", "--grid", 500)
    assert code == 2
    assert "--grid 500: pixels so far apart miss all that is measured" in err
