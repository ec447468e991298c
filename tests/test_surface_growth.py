"""Growth of finished results: maps in the store, their error bars, averages, agreement, and what is refused."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_cli import call

import leafflow_ti as lf
from leafflow_ti.cli.growth import format_growth
from leafflow_ti.correlation import KEY, NoiseCorrelation
from leafflow_ti.errors import InputError, LeafflowError, RunError, UsageError
from leafflow_ti.field import CORRELATIONS, SURFACE_NAMES, empty_map, with_std
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status
from leafflow_ti.surface_growth import ATTRIBUTE, Agreement, GrowthSummary, default_window, mean_over_frames
from leafflow_ti.synthetic.geometry import tangent_axes
from leafflow_ti.synthetic.plane import PlaneScene, linear_growth

F_PX, PRINCIPAL, PITCH, FRAMES = 2700.0, (70.0, 60.0), 4, (2, 3, 4, 5, 6)
Y, X = np.arange(2, 118, PITCH), np.arange(6, 142, PITCH)
PERCENT = 0.4
SCENE = PlaneScene(
    f_px=F_PX, baseline_mm=(0.5, 0.5), centre=(0.0, 0.0, 100.0), zx=0.3, zy=-0.2, velocity=(0.01, -0.02, 0.05),
    omega=(2e-3, -1e-3, 5e-4), growth=linear_growth(PERCENT), strain=(0.002, -0.002, 0.0005),
)  # fmt: skip
ALONG_PIXELS = np.exp(-0.5 * (np.arange(40) / 8.0) ** 2)
ALONG_FRAMES = np.array([1.0, 0.6, -0.1, -0.4, -0.2])
MOTION = np.diag([4e-5, 3e-5, 1e-3]) ** 2
"""Covariance of the motion across the line of sight and of the approach; independent."""
GROWTH_STD = 0.01


@functools.cache
def roots() -> list[np.ndarray]:
    """Square roots of the correlations between frames, rows and columns."""
    found = []
    for r, n, step in ((ALONG_FRAMES, len(FRAMES), 1), (ALONG_PIXELS, Y.size, PITCH), (ALONG_PIXELS, X.size, PITCH)):
        padded = np.zeros(max(n * step, r.size))
        padded[: r.size] = r
        values, vectors = np.linalg.eigh(padded[step * np.abs(np.subtract.outer(range(n), range(n)))])
        found.append(vectors * np.sqrt(np.maximum(values, 0)))
    return found


def maps_of(seed: int | None) -> dict[str, np.ndarray]:
    """Maps [t, y, x] of the scene; with errors as they say, for a seed."""
    x, y = np.meshgrid((X - PRINCIPAL[0]) / F_PX, (Y - PRINCIPAL[1]) / F_PX)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    points = SCENE.intersect(rays, np.zeros(3), 0.0)
    velocity = np.repeat(SCENE.point_motion(points)[0][None], len(FRAMES), axis=0)
    growth = np.full(velocity.shape[:3], SCENE.growth_rate)
    if seed is not None:
        rng = np.random.default_rng(seed)
        white = rng.normal(size=velocity.shape)
        m = np.einsum("ta,yb,xc,kl,abcl->tyxk", *roots(), np.sqrt(MOTION), white, optimize=True)
        m[..., :2] += rays[..., :2] * m[..., 2:]
        velocity = velocity + m
        growth = growth + GROWTH_STD * rng.normal(size=growth.shape)
    M = np.broadcast_to(np.eye(3), (*x.shape, 3, 3)).copy()
    M[..., :2, 2] = rays[..., :2]
    C = M @ MOTION @ np.swapaxes(M, -1, -2)
    std = np.sqrt(np.diagonal(C, axis1=-2, axis2=-1))
    found = {"depth": np.broadcast_to(points[..., 2], growth.shape), "growth_rate": growth}
    found["growth_rate_std"] = np.full(growth.shape, GROWTH_STD)
    for k, axis in enumerate("xyz"):
        found[f"velocity_{axis}"] = velocity[..., k]
        found[f"velocity_{axis}_std"] = np.broadcast_to(std[..., k], growth.shape)
    for name, (i, j) in zip(CORRELATIONS, ((0, 1), (0, 2), (1, 2)), strict=True):
        found[name] = np.broadcast_to(C[..., i, j] / (std[..., i] * std[..., j]), growth.shape)
    return found


def store_of(
    path: Path, seed: int | None = 0, without: tuple[str, ...] = (), stated: bool = True, units: int = len(FRAMES)
) -> ResultStore:
    """Results of the scene as a run would write them; of its units, so many."""
    maps = {name: values for name, values in maps_of(seed).items() if name not in without}
    plan: dict[str, Any] = {"f_px": F_PX, "principal_px": list(PRINCIPAL)}
    if stated:
        plan[KEY] = {"x": ALONG_PIXELS.tolist(), "y": ALONG_PIXELS.tolist(), "t": ALONG_FRAMES.tolist()}
    store = ResultStore.create(
        path, frames=FRAMES, y=Y, x=X, names=tuple(maps), chunk=(1, Y.size, X.size), interval_s=120.0,
        attrs={"plan": plan, "config": "[window]\nsize = 25\n"},
    )  # fmt: skip
    status = np.full((Y.size, X.size), Status.OK, np.uint8)
    status[:, :2] = Status.UNREFINED
    for t in range(units):
        frame = {name: values[t].astype(np.float32) for name, values in maps.items()}
        if "velocity_x" in frame:
            frame["velocity_x"][:, 0] = np.float32(9.0)  # unrefined: must not count
        store.write_unit(t, t, slice(0, Y.size), frame, status)
    return store


@pytest.fixture(scope="module")
def strains() -> dict[str, float]:
    """True values of the maps."""
    before, after = (SCENE.deformation(t) for t in (-0.5, 0.5))
    T = tangent_axes(SCENE.zx, SCENE.zy)
    F = T.T @ after @ np.linalg.inv(before) @ T
    E = 50 * (F.T @ F - np.eye(2))
    one, two = np.linalg.eigvalsh(E)[::-1]
    return {
        "area_rate": 100 * (np.linalg.det(F) - 1), "surface_strain_11": E[0, 0], "surface_strain_22": E[1, 1],
        "surface_strain_12": E[0, 1], "surface_principal_1": one, "surface_principal_2": two,
        "surface_angle": 0.5 * np.arctan2(2 * E[0, 1], E[0, 0] - E[1, 1]),
    }  # fmt: skip


def test_exact_motion_gives_exact_strain(tmp_path: Path, strains: dict[str, float]) -> None:
    """Maps are float32: velocities of .05 to 3e-9 mm over windows of 1.5 mm, in per cent."""
    summary = lf.measure_growth(store_of(tmp_path / "o.zarr", None))
    store = ResultStore.open(tmp_path / "o.zarr")
    assert set(with_std(SURFACE_NAMES)) <= set(store.names)
    assert store.attrs[ATTRIBUTE] == {"strain_window_px": summary.window_px, "average_frames": 1}
    for t in range(len(FRAMES)):
        assert np.isnan(store.read("area_rate", t)[:, :2]).all()
        for name, value in strains.items():
            np.testing.assert_allclose(store.read(name, t)[:, 2:], value, atol=1e-5, err_msg=name)
            assert (store.read(f"{name}_std", t)[:, 2:] > 0).all()
    assert summary.maps["area_rate"].median == pytest.approx(strains["area_rate"], abs=1e-6)
    assert summary.maps["area_rate"].share == 1.0
    assert summary.agreement is not None
    assert summary.agreement.mean == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("average", [1, 3])
def test_error_bars_and_agreement(tmp_path: Path, strains: dict[str, float], average: int) -> None:
    """Ten windows' worth of pixels in five frames and 4 seeds know a standard deviation to some 6 %.

    The refinement's growth has independent errors here, of which averages leave less than a smooth error's.
    """
    z: dict[str, list[np.ndarray]] = {name: [] for name in strains}
    agreement = []
    for seed in range(4):
        path = tmp_path / f"{seed}.zarr"
        found = lf.measure_growth(store_of(path, seed), average=average)
        store = ResultStore.open(path)
        for name, value in strains.items():
            z[name].append((store.read(name) - value) / store.read(f"{name}_std"))
        assert found.agreement is not None
        agreement.append(found.agreement.std)
    for name, values in z.items():
        of = np.array(values)[..., 2:]
        of = of[np.isfinite(of)]
        assert abs(of.mean()) < 0.35, name
        assert of.std() == pytest.approx(1.0, abs=0.2), name
        assert np.mean(np.abs(of) < 1) == pytest.approx(0.683, abs=0.1), name
    assert np.mean(agreement) == pytest.approx(1.0, abs=0.2)


def test_averages_are_more_certain_and_repeatable(tmp_path: Path) -> None:
    """The mean of the strain's maps over three frames, two at the ends; a second call leaves nothing of the first."""
    paths = [tmp_path / f"{n}.zarr" for n in range(2)]
    for path in paths:
        store_of(path, 1)
    single = lf.measure_growth(paths[0])
    one = ResultStore.open(paths[0]).read("surface_strain_11")
    std = ResultStore.open(paths[0]).read("surface_strain_11_std")
    mean = lf.measure_growth(paths[0], average=3)
    lf.measure_growth(paths[1], average=3)
    found, other = (ResultStore.open(path) for path in paths)
    for name in with_std(SURFACE_NAMES):
        np.testing.assert_array_equal(found.read(name), other.read(name))
    three = found.read("surface_strain_11")
    np.testing.assert_allclose(three[2], one[1:4].mean(axis=0), atol=1e-6)
    np.testing.assert_allclose(three[0], one[:2].mean(axis=0), atol=1e-6)
    share = np.sqrt((3 + 4 * 0.6 + 2 * -0.1) / 9)
    np.testing.assert_allclose(found.read("surface_strain_11_std")[2], share * std[2], rtol=1e-5)
    assert mean.maps["area_rate"].median_std < single.maps["area_rate"].median_std


def test_means_leave_out_frames_without_a_value() -> None:
    correlation = np.array([[1.0, 0.5, 0.0], [0.5, 1.0, 0.5], [0.0, 0.5, 1.0]])
    values = [np.array([[v, 2.0, np.nan]]) for v in (1.0, 2.0, 6.0)]
    variances = [np.array([[4.0, 1.0, np.inf]]) for _ in range(3)]
    values[2][0, 1], variances[2][0, 1] = np.nan, np.inf
    mean, variance = mean_over_frames(values, variances, correlation, 1)
    np.testing.assert_allclose(mean, [[3.0, 2.0, np.nan]])
    np.testing.assert_allclose(variance, [[4 * 5 / 9, 0.75, np.inf]])
    # Where the middle frame has no value there is none, whatever the others have.
    mean, variance = mean_over_frames(values, variances, correlation, 2)
    assert np.isnan(mean[0, 1])
    assert np.isinf(variance[0, 1])


def test_the_default_window_holds_nine_independent_estimates(tmp_path: Path) -> None:
    """exp(-(d/8)²/2) < .1 from 18 px on: the next output pixel is at 20."""
    noise = NoiseCorrelation.of(store_of(tmp_path / "o.zarr"))
    assert default_window(noise, PITCH) == 41
    assert lf.measure_growth(tmp_path / "o.zarr").window_px == 41
    assert lf.measure_growth(tmp_path / "o.zarr", strain_window=60).window_px == 57


@pytest.mark.parametrize(
    ("make", "options", "error", "message"),
    [
        ({"without": ("velocity_x", "velocity_y", "velocity_z")}, {}, InputError, "has no 'velocity_x', so no motion"),
        ({"without": ("velocity_z",)}, {}, InputError, "has no 'velocity_z', so no motion in space"),
        ({"without": CORRELATIONS[:1]}, {}, InputError, "no map 'velocity_correlation_xy'.*--overwrite"),
        ({"stated": False}, {}, InputError, "no attribute 'noise_correlation'"),
        ({"units": 3}, {}, RunError, "2 of 5 units are not done: run again with --resume"),
        ({}, {"strain_window": 8}, UsageError, "window 8 px: .* 4 px apart, .* --strain-window 9 at least"),
        ({}, {"strain_window": 300}, UsageError, "cover 133 x 113 px: choose --strain-window 113 at most"),
        ({}, {"average": 2}, UsageError, "average 2: choose an odd number"),
        ({}, {"average": 7}, UsageError, "hold 5 frames: choose --average 5 at most"),
    ],
)  # fmt: skip
def test_what_cannot_be_measured_is_refused(
    tmp_path: Path, make: dict[str, Any], options: dict[str, int], error: type[LeafflowError], message: str
) -> None:
    """In one line, before anything is changed."""
    store = store_of(tmp_path / "o.zarr", **make)
    with pytest.raises(error, match=message) as refused:
        lf.measure_growth(store, **options)
    assert "\n" not in str(refused.value)
    assert ATTRIBUTE not in store.attrs
    assert "area_rate" not in ResultStore.open(store.path).names


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str], strains: dict[str, float]) -> None:
    """Per hour for people, as the frames' interval is known; JSON as it is stored."""
    path = store_of(tmp_path / "o.zarr").path
    assert call("growth", path, "--strain-window", 57, "--average", 3) == 0
    text = capsys.readouterr().out
    assert "windows of 57 px, 5 frames, means over 3 frames" in text
    line = next(line for line in text.splitlines() if "area_rate " in line)
    assert "%/h" in line
    assert float(line.split()[1]) == pytest.approx(30 * strains["area_rate"], abs=3 * float(line.split()[2]))
    assert "(growth_rate - area_rate) / standard error: mean" in text
    assert call("growth", path, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["maps"]["area_rate"]["median"] == pytest.approx(strains["area_rate"], abs=0.1)
    assert facts["window_px"] == 41
    assert call("growth", path, "--strain-window", 3) == 2
    assert call("growth", tmp_path / "none.zarr") == 4


def test_results_without_a_surface_have_no_strain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing measured: maps without values, and the command says so."""
    store = store_of(tmp_path / "o.zarr")
    nothing = np.full((Y.size, X.size), Status.BORDER, np.uint8)
    for t in range(len(FRAMES)):
        empty = {name: empty_map(name, nothing.shape) for name in store.names}
        store.write_unit(t, t, slice(0, Y.size), empty, nothing)
    assert call("growth", store.path) == 0
    assert "no pixel has a strain" in capsys.readouterr().out
    assert np.isnan(ResultStore.open(store.path).read("area_rate")).all()


@pytest.mark.parametrize(("mean", "std", "advised"), [(0.3, 1.2, False), (0.2, 6.0, True), (-4.0, 0.9, True)])
def test_disagreement_is_said(mean: float, std: float, advised: bool) -> None:
    summary = GrowthSummary("out.zarr", 65, 1, 4, 600.0, {}, Agreement(900, mean, std))
    assert ("--deformation strain" in format_growth(summary)[-1]) == advised
