"""Leaf axes, and tracks as tables and data sets, from Python and from the command line."""

from __future__ import annotations

import csv
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from leafflow_ti.cli.main import main
from leafflow_ti.cumulative import track_growth
from leafflow_ti.errors import InputError, UsageError
from leafflow_ti.leaf_axes import foot, leaf_coordinates, principal_axis
from leafflow_ti.results import ResultStore
from leafflow_ti.synthetic.plane import PlaneScene
from leafflow_ti.tracking import Tracks, TrackStatus, track
from perf.exact_stores import exact_store, pixels, seen

SCENE = PlaneScene(
    f_px=2700.0, baseline_mm=(0.5, 0.5), size=(121, 81), n_frames=6, zx=0.4, zy=-0.3, velocity=(0.01, 0.0, 0.02),
    strain=(0.004, -0.001, 0.0),
)  # fmt: skip
INTERVAL_S = 120.0


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> ResultStore:
    """Exact maps of a plane that is strained as it moves."""
    path = tmp_path_factory.mktemp("tracks") / "o.zarr"
    return exact_store(SCENE, path, range(SCENE.n_frames), interval_s=INTERVAL_S)


@pytest.fixture(scope="module")
def tracks(store: ResultStore) -> Tracks:
    """A grid of points; two of them are lost before the end."""
    x, y = np.meshgrid([0.0, 16.0, 40.0, 64.0, 88.0, 112.0], [0.0, 16.0, 40.0, 64.0])
    return track_growth(store, track(store, x.ravel(), y.ravel(), start=2), gauge=60.0)


def test_feet_are_the_nearest_points_of_a_curve() -> None:
    rng = np.random.default_rng(1)
    curve = np.cumsum(np.concatenate([[[0.0, 0.0, 100.0]], rng.uniform(0.5, 1.5, (6, 3)) * [1.0, 0.3, 0.2]]), axis=0)
    points = curve[rng.integers(0, 7, 40)] + rng.normal(0.0, 0.3, (40, 3))
    along, across, _ = foot(curve, points)
    # By brute force: a fine curve, with straight ends.
    ends = [curve[0] - (curve[1] - curve[0]), *curve, curve[-1] + (curve[-1] - curve[-2])]
    fine = np.concatenate([np.linspace(a, b, 4000) for a, b in itertools.pairwise(ends)])
    steps = np.linalg.norm(np.diff(fine, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps)]) - np.linalg.norm(curve[1] - curve[0])
    distance = np.linalg.norm(points[:, None] - fine, axis=-1)
    np.testing.assert_allclose(np.abs(across), distance.min(axis=1), atol=1e-5)
    np.testing.assert_allclose(along, length[distance.argmin(axis=1)], atol=2e-3)


def test_across_is_positive_to_the_right_of_the_axis() -> None:
    up = np.array([[0.0, 5.0, 100.0], [0.0, -5.0, 100.0]])
    along, across, direction = foot(up, np.array([[2.0, 1.0, 100.0], [-3.0, -9.0, 100.0], [np.nan] * 3]))
    np.testing.assert_allclose(along, [4.0, 14.0, np.nan])
    np.testing.assert_allclose(across, [2.0, -3.0, np.nan])
    np.testing.assert_allclose(direction[:2], [[0.0, -1.0, 0.0]] * 2)


def test_coordinates_on_a_plane_are_its_lengths(store: ResultStore, tracks: Tracks) -> None:
    """On a plane any straight line in the image is a straight line in space, and lengths are known."""
    axis = np.array([[20.0, 60.0], [60.0, 40.0], [100.0, 20.0]])
    found = leaf_coordinates(store, tracks, axis)
    begin = SCENE.time(tracks.start)
    first, last = seen(SCENE, axis[[0, 2], 0], axis[[0, 2], 1], begin)
    way = (last - first) / np.linalg.norm(last - first)
    at = tracks.start_index
    points = seen(SCENE, tracks.x[at], tracks.y[at], begin)
    np.testing.assert_allclose(found["along"], (points - first) @ way, atol=1e-4)
    off = np.linalg.norm(np.cross(points - first, way), axis=1)
    np.testing.assert_allclose(np.abs(found["across"]), off, atol=1e-4)
    side = (axis[2, 0] - axis[0, 0]) * (tracks.y[at] - axis[0, 1]) - (axis[2, 1] - axis[0, 1]) * (
        tracks.x[at] - axis[0, 0]
    )
    assert np.array_equal(np.sign(found["across"]), np.sign(side))
    # Strain along the axis: how much longer its direction has become.
    end = SCENE.time(int(tracks.frames[-1]))
    stretched = SCENE.follow(first + way, end, begin) - SCENE.follow(first, end, begin)
    known = np.isfinite(found["strain_along"][-1])
    assert known.sum() >= 8
    np.testing.assert_allclose(found["strain_along"][-1][known], 50 * (stretched @ stretched - 1), atol=2e-3)
    total = found["strain_along"] + found["strain_across"]
    np.testing.assert_allclose(total, tracks["strain_11"] + tracks["strain_22"], atol=1e-9)


def test_the_axis_of_a_region_is_its_longest(store: ResultStore, tracks: Tracks) -> None:
    row = np.round(tracks.y[tracks.start_index] / 24)
    found = leaf_coordinates(store, tracks.having({"label": row}))
    for value in np.unique(row):
        members = row == value
        order = np.argsort(tracks.x[tracks.start_index][members])
        assert (np.diff(found["along"][members][order]) > 0).all()
        assert found["along"][members].min() == pytest.approx(0.0, abs=1e-9)
        assert np.abs(found["across"][members]).max() < 0.1
    points = np.random.default_rng(2).normal(0.0, [0.1, 3.0, 0.2], (200, 3)) + np.array([0.0, 0.0, 50.0])
    begin, end = principal_axis(points)
    assert end[1] < begin[1]  # upwards
    assert np.linalg.norm(end - begin) == pytest.approx(np.ptp(points[:, 1]), rel=0.02)


@pytest.mark.parametrize(
    ("axis", "error", "message"),
    [
        ([[1.0, 2.0]], UsageError, "two or more points"),
        ([[1.0, 2.0], [1.0, 2.0]], UsageError, "are the same"),
        ("midrib", UsageError, "axis 'midrib'"),
        ([[-50.0, 2.0], [-20.0, 2.0]], InputError, "lay it on the leaf"),
    ],
)
def test_an_axis_that_makes_no_sense(
    store: ResultStore, tracks: Tracks, axis: object, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        leaf_coordinates(store, tracks, axis)  # type: ignore[arg-type]


def read_rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_tables_have_a_row_for_every_known_place(tracks: Tracks, tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    tracks.to_csv(path)
    rows = read_rows(path)
    assert len(rows) == tracks.known.sum() < tracks.known.size
    for row in rows:
        t, n = int(row["frame"]) - int(tracks.frames[0]), int(row["point"])
        assert float(row["time_s"]) == INTERVAL_S * int(row["frame"])
        for column, value in (
            ("x_px", tracks.x[t, n]), ("Z_mm", tracks.position[t, n, 2]), ("drift_px", tracks.drift[t, n]),
            ("growth_percent", tracks["growth"][t, n]), ("growth_std_percent", tracks["growth_std"][t, n]),
        ):  # fmt: skip
            assert float(row[column]) == pytest.approx(value, rel=1e-9, abs=1e-12), column
        assert row["status"] == TrackStatus(int(tracks.status[n])).name.lower()
        assert (row["strain_11_percent"] == "") == bool(np.isnan(tracks["strain_11"][t, n]))
    with pytest.raises(UsageError, match="--overwrite"):
        tracks.to_csv(path)
    tracks.save(path, overwrite=True)


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_data_sets_open_elsewhere(tracks: Tracks, tmp_path: Path, suffix: str) -> None:
    xarray = pytest.importorskip("xarray")
    path = tmp_path / f"t{suffix}"
    tracks.save(path)
    tracks.save(path, overwrite=True)
    opened = xarray.open_zarr(path, consolidated=False) if suffix == ".zarr" else xarray.open_dataset(path)
    with opened as data:
        np.testing.assert_array_equal(data.t, tracks.frames)
        np.testing.assert_allclose(data.time, INTERVAL_S * tracks.frames)
        for name in ("x", "drift", "growth", "growth_std", "strain_angle"):
            np.testing.assert_array_equal(data[name], tracks[name])
        np.testing.assert_array_equal(data.Z, tracks.position[..., 2])
        np.testing.assert_array_equal(data.status, tracks.status)
        assert data.growth.units == "%"
        assert data.growth_std.long_name == f"standard error of the {data.growth.long_name}"
        assert data.status.flag_meanings.split()[int(TrackStatus.OUTSIDE)] == "outside"
        assert "tangents" not in data
    with pytest.raises(UsageError, match="--overwrite"):
        tracks.save(path)


def test_parquet(tracks: Tracks, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    tracks.save(tmp_path / "t.parquet")
    table = parquet.read_table(tmp_path / "t.parquet")
    np.testing.assert_array_equal(table["x_px"].to_numpy(), tracks.x.T[tracks.known.T])


def test_what_exists_and_is_no_tracks_stays(store: ResultStore, tracks: Tracks) -> None:
    with pytest.raises(UsageError, match="holds no tracks"):
        tracks.save(store.path, overwrite=True)
    assert ResultStore.open(store.path).frames == store.frames


def test_some_points(tracks: Tracks) -> None:
    some = np.arange(tracks.n_points) % 3 == 0
    chosen = tracks.chosen(some)
    np.testing.assert_array_equal(chosen["growth"], tracks["growth"][:, some])
    np.testing.assert_array_equal(chosen.status, tracks.status[some])
    assert chosen.n_points == some.sum()
    with pytest.raises(KeyError, match="they have: x, y"):
        tracks["nothing"]


def run(*args: object) -> int:
    with pytest.raises(SystemExit) as end:
        main([str(a) for a in args])
    return int(end.value.code or 0)


def test_command(store: ResultStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    labels = np.zeros((SCENE.size[1], SCENE.size[0]), np.uint8)
    labels[10:70, 10:55], labels[10:70, 65:110] = 3, 8
    tifffile.imwrite(tmp_path / "l.tif", labels)
    out = tmp_path / "t.csv"
    assert run("track", store.path, "-o", out, "--grid", 8, "--labels", tmp_path / "l.tif", "--axis", "auto") == 0
    text = capsys.readouterr().out
    rows = read_rows(out)
    assert {row["label"] for row in rows} == {"3", "8"}
    true = 100 * (np.linalg.det(SCENE.deformation(3.0 - 1)) / np.linalg.det(SCENE.deformation(-3.0)) - 1)
    last = [float(row["growth_percent"]) for row in rows if row["frame"] == "5" and row["growth_percent"]]
    np.testing.assert_allclose(last, true, rtol=1e-3)
    assert text.count("by the growth rate") == 2
    assert f"growth to frame 5 {true:.4g} %" in text
    assert f"{100 * np.log1p(true / 100) / 5 * 30:.4g} %/h" in text  # 30 frames an hour


def test_command_with_points(store: ResultStore, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = tmp_path / "p.csv"
    points.write_text("name,x,y\na,40,40\nb,60.5,33.25\n")
    assert run("track", store.path, "-o", tmp_path / "t.csv", "--points", points, "--axis", "20,40,60,40,100,42") == 0
    assert capsys.readouterr().out.startswith("points      2 from frame 0, 2 in all frames 0..5")
    begin, end = (SCENE.time(t) for t in (0, 5))
    x, y = pixels(SCENE, SCENE.follow(seen(SCENE, np.array([60.5]), np.array([33.25]), begin), end, begin))
    row = read_rows(tmp_path / "t.csv")[-1]
    assert (float(row["x_px"]), float(row["y_px"])) == pytest.approx((x[0], y[0]), abs=1e-3)


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("-o", "t.txt"), 2, "the format is not clear"),
        (("-o", "t.csv", "--start", 9), 2, "hold the frames 0..5"),
        (("-o", "t.csv", "--axis", "1,2,3"), 2, "or auto"),
        (("-o", "t.csv", "--grid", 0), 2, "must be 1 px or more"),
        (("-o", "t.csv", "--grid", 4, "--points", "p.csv"), 2, "exclude each other"),
        (("-o", "t.csv", "--points", "p.csv"), 4, "p.csv: cannot be read"),
        (("-o", "t.csv", "--max-drift", 0), 2, "max_drift = 0 px"),
    ],
)
def test_command_errors(
    store: ResultStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    options: tuple[object, ...], code: int, message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert run("track", store.path, *options) == code
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_points_without_depth_have_a_place_in_the_image(store: ResultStore, tmp_path: Path) -> None:
    """One camera: motion and no depth."""
    scene = replace(SCENE, n_frames=3)
    whole = exact_store(scene, tmp_path / "whole.zarr", range(3))
    names = [n for n in whole.names if n.startswith("flow")]
    flat = ResultStore.create(
        tmp_path / "flat.zarr", frames=range(3), y=whole.y, x=whole.x, names=names, attrs={"plan": whole.attrs["plan"]},
        chunk=(1, whole.y.size, whole.x.size),
    )  # fmt: skip
    for k in range(3):
        field = whole.field(k)
        flat.write_unit(k, k, slice(0, whole.y.size), {n: field[n] for n in names}, field.status)
    found = track_growth(flat, track(flat, [40.0, 60.0], [40.0, 30.0]))
    np.testing.assert_allclose(found.x, track(whole, [40.0, 60.0], [40.0, 30.0]).x, atol=1e-6)
    assert np.isnan(found.position).all()
    assert not found.variables
    with pytest.raises(InputError, match="no depth"):
        leaf_coordinates(flat, found)
