"""Followed points against exact scenes, why they are lost, and the bound on their drift."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.cumulative import track_growth
from leafflow_ti.drift import accumulated, closure
from leafflow_ti.errors import InputError, UsageError
from leafflow_ti.field import with_std
from leafflow_ti.neighbourhood import pairs_within
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status
from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.leaf import LeafScene
from leafflow_ti.synthetic.plane import PlaneScene, linear_growth, noise_scene, render
from leafflow_ti.synthetic.rig import rays_of
from leafflow_ti.tracking import Tracks, TrackStatus, track
from perf.exact_stores import NAMES, Scene, exact_store, pixels, seen

PLANE = PlaneScene(
    f_px=2700.0, baseline_mm=(0.5, 0.5), size=(121, 101), n_frames=31, zx=0.6, zy=-0.5, velocity=(0.02, -0.01, 0.06),
    omega=(0.002, 0.003, 0.004), growth=0.001, strain=(0.001, 0.0, 0.0005),
)  # fmt: skip
SCENES: dict[str, Scene] = {
    "plane": PLANE,
    "leaf": LeafScene(size=(221, 161), n_frames=31, half_mm=(3.6, 2.6), velocity=(0.01, -0.01, 0.02)),
    "cube": CubeScene(size=(141, 61), n_frames=31, velocity=(0.0, 0.0, 0.0), orientation=(0.0, 0.0, 0.0)),
}
EXACT_PX = 1e-3
"""What bilinear reading of maps at every fourth pixel adds up to in 15 frames: found 1e-4."""


def misplaced(scene: Scene, tracks: Tracks) -> tuple[np.ndarray, np.ndarray]:
    """Distance of tracks from where their material is, in the image [T, n] px and in space [T, n] mm."""
    begin = scene.time(tracks.start)
    given = seen(scene, tracks.x[tracks.start_index], tracks.y[tracks.start_index], begin)
    there = np.array([scene.follow(given, scene.time(int(t)), begin) for t in tracks.frames])
    x, y = pixels(scene, there)
    return np.hypot(tracks.x - x, tracks.y - y), np.linalg.norm(tracks.position - there, axis=-1)


def all_pixels(store: ResultStore) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(store.x, store.y)
    return x.ravel(), y.ravel()


@pytest.fixture(scope="module", params=SCENES)
def exact(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Scene, ResultStore]:
    """A scene and the store of its exact maps."""
    scene = SCENES[request.param]
    return scene, exact_store(scene, tmp_path_factory.mktemp("exact") / "o.zarr", range(scene.n_frames))


def test_points_stay_on_their_material(exact: tuple[Scene, ResultStore]) -> None:
    scene, store = exact
    tracks = track(store, *all_pixels(store), start=15)
    off_px, off_mm = misplaced(scene, tracks)
    known = tracks.known
    assert known[0].sum() > 100
    assert known[-1].sum() > 100
    assert off_px[known].max() < EXACT_PX
    assert off_mm[known].max() < 1e-2
    assert np.mean(off_px[known] <= tracks.drift[known]) > 0.9


def test_tracks_return_to_where_they_began(exact: tuple[Scene, ResultStore]) -> None:
    _, store = exact
    ahead = track(store, *all_pixels(store))
    whole = ahead.known[-1]
    back = track(store, ahead.x[-1, whole], ahead.y[-1, whole], start=store.frames[-1])
    known = back.known[0]
    apart = np.hypot(back.x[0] - ahead.x[0, whole], back.y[0] - ahead.y[0, whole])[known]
    assert known.mean() > 0.8  # those that began on the outermost pixels return beside them
    assert apart.max() < EXACT_PX


def test_growth_and_strain_since_the_start_are_exact(tmp_path: Path) -> None:
    store = exact_store(PLANE, tmp_path / "o.zarr", range(PLANE.n_frames))
    tracks = track_growth(store, track(store, *all_pixels(store), start=5))
    begin, end = (PLANE.time(t) for t in (5, PLANE.n_frames - 1))
    # The material's own map, from the start to the end, in the tangent frame of the start.
    turned = PLANE.pose(begin)[0]
    gradient = PLANE.deformation(end) @ np.linalg.inv(PLANE.deformation(begin)) @ turned.T
    given = seen(PLANE, *(at[5] for at in (tracks.x, tracks.y)), begin)
    slopes = (given[:, 2] - given[:, 2].mean(), given[:, :2] - given[:, :2].mean(axis=0))
    zx, zy = np.linalg.lstsq(slopes[1], slopes[0], rcond=None)[0]
    one = np.array([1.0, 0.0, zx]) / np.hypot(1.0, zx)
    two = np.cross([-zx, -zy, 1.0], one)
    axes = np.stack([one, two / np.linalg.norm(two)], axis=1)
    metric = axes.T @ gradient.T @ gradient @ axes
    area = 100 * (np.sqrt(np.linalg.det(metric)) - 1)
    strain = 50 * (metric - np.eye(2))
    assert area > 5  # it does grow
    # The rates of every frame are those from half a frame before it to half a frame behind.
    np.testing.assert_allclose(tracks["growth"][-1][tracks.known[-1]], area, atol=1e-4 * area)
    known = np.isfinite(tracks["place_growth"][-1])
    assert known.sum() > 100
    for name, value in (("place_growth", area), ("strain_11", strain[0, 0]), ("strain_22", strain[1, 1]),
                        ("strain_12", strain[0, 1])):  # fmt: skip
        np.testing.assert_allclose(tracks[name][-1][known], value, atol=2e-3, err_msg=name)
    first, second = np.linalg.eigvalsh(strain)[::-1]
    np.testing.assert_allclose(tracks["strain_1"][-1][known], first, atol=2e-3)
    np.testing.assert_allclose(tracks["strain_2"][-1][known], second, atol=2e-3)
    angle = 0.5 * np.arctan2(2 * strain[0, 1], strain[0, 0] - strain[1, 1])
    np.testing.assert_allclose(tracks["strain_angle"][-1][known], angle, atol=2e-3)


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[PlaneScene, ResultStore]:
    """A growing, turning plane, measured in noisy images: nine frames of results."""
    from leafflow_ti.config import load_config
    from leafflow_ti.runs import run

    scene = replace(
        noise_scene(size=(121, 101)), n_frames=17, n_cols=5, noise=1.0, bits=8, growth=linear_growth(0.3),
        velocity=(-0.01, 0.005, 0.02), omega=tuple(np.radians((0.05, 0.1, 0.05))),
    )  # fmt: skip
    capture = capture_from_array(render(scene), Geometry(scene.f_px, scene.principal, scene.baseline_mm))
    path = tmp_path_factory.mktemp("measured") / "o.zarr"
    run(capture, path, load_config(overrides={"window": 27, "stride": 6, "preshift": (-14, 0)}))
    return scene, ResultStore.open(path)


def test_measured_points_keep_within_their_bound(measured: tuple[PlaneScene, ResultStore]) -> None:
    scene, store = measured
    assert len(store.frames) == 9
    tracks = track(store, *all_pixels(store))
    off_px, _ = misplaced(scene, tracks)
    known = tracks.known[-1]
    assert known.sum() >= 30
    off, drift = off_px[-1][known], tracks.drift[-1][known]
    assert np.quantile(off, 0.95) < 0.05
    assert np.mean(off <= drift) >= 0.95
    # The mean distance of noise alone is 1.25 standard errors of a component, the bound 2.8 of them.
    assert np.median(drift) < 4 * np.median(off)


def test_measured_growth_adds_up(measured: tuple[PlaneScene, ResultStore]) -> None:
    scene, store = measured
    tracks = track_growth(store, track(store, *all_pixels(store)))
    begin, end = (np.linalg.det(scene.deformation(scene.time(t))) for t in (store.frames[0], store.frames[-1]))
    true = 100 * (end / begin - 1)
    known = np.isfinite(tracks["growth"][-1])
    z = (tracks["growth"][-1] - true)[known] / tracks["growth_std"][-1][known]
    assert abs(np.mean(tracks["growth"][-1][known]) / true - 1) < 0.02
    # Some five independent windows: the scatter of a standard deviation is a third.
    assert 0.4 < np.sqrt(np.mean(z**2)) < 2.0


def flat_store(
    path: Path, n: int = 4, flow: tuple[float, float] = (2.0, 0.0), std: float = 1e-3, frames: tuple[int, ...] = ()
) -> tuple[ResultStore, dict[str, np.ndarray], np.ndarray]:
    """A store to be filled, of 40 x 30 px that move by ``flow``; maps [y, x] and status of every frame."""
    y, x = np.arange(0, 30, 2), np.arange(0, 40, 2)
    names = with_std(NAMES)
    maps = {name: np.zeros((y.size, x.size), np.float32) for name in names}
    maps["depth"][:] = 100.0
    maps["flow_x"][:], maps["flow_y"][:] = flow
    maps["flow_x_std"][:] = maps["flow_y_std"][:] = std
    plan = {"f_px": 1000.0, "principal_px": [20.0, 15.0], "noise_correlation": {axis: [1.0] for axis in "xyt"}}
    store = ResultStore.create(
        path, frames=frames or range(n), y=y, x=x, names=names, chunk=(1, y.size, x.size), attrs={"plan": plan}
    )
    return store, maps, np.zeros((y.size, x.size), np.uint8)


def fill(store: ResultStore, maps: dict[str, np.ndarray], status: np.ndarray) -> ResultStore:
    for k in range(len(store.frames)):
        store.write_unit(k, k, slice(0, store.y.size), maps, status)
    return store


def test_points_are_lost_for_a_reason(tmp_path: Path) -> None:
    store, maps, status = flat_store(tmp_path / "o.zarr")
    hole = (slice(9, 12), slice(12, 14))
    maps["flow_x"][hole] = maps["flow_y"][hole] = np.nan
    status[hole] = Status.NO_STRUCTURE
    coarse = (slice(13, 15), slice(12, 14))
    status[coarse] = Status.COARSE
    maps["depth"][:6, 12:] = 50.0  # another surface, far before the first
    maps["flow_x_std"][6, :] = np.inf  # not determined
    fill(store, maps, status)
    start = [(35.0, 16.0), (21.0, 20.0), (21.0, 28.0), (21.0, 6.0), (5.0, 12.0), (5.0, 16.0), (24.5, 20.0)]
    tracks = track(store, *np.array(start).T)
    assert [TrackStatus(int(code)) for code in tracks.status] == [
        TrackStatus.OUTSIDE, TrackStatus.UNMEASURED, TrackStatus.UNMEASURED, TrackStatus.EDGE, TrackStatus.DRIFTED,
        TrackStatus.TRACKED, TrackStatus.UNMEASURED,
    ]  # fmt: skip
    assert tracks.known.sum(axis=0).tolist() == [2, 1, 1, 1, 1, 4, 0]
    np.testing.assert_allclose(tracks.x[:, 5], [5, 7, 9, 11], atol=1e-6)
    np.testing.assert_allclose(tracks.position[0, 5], [-1.5, 0.1, 100.0], atol=1e-5)
    assert tracks.x[0, 6] == 24.5
    assert np.isnan(tracks.x[1:, 6]).all()


def test_motion_in_the_image_follows_from_that_in_space(tmp_path: Path) -> None:
    scene = replace(PLANE, n_frames=9)
    whole = exact_store(scene, tmp_path / "whole.zarr", range(9))
    names = [n for n in whole.names if not n.startswith("flow")]
    attrs = {"plan": whole.attrs["plan"]}
    bare = ResultStore.create(
        tmp_path / "bare.zarr", frames=range(9), y=whole.y, x=whole.x, names=names, attrs=attrs,
        chunk=(1, whole.y.size, whole.x.size),
    )  # fmt: skip
    for k in range(9):
        field = whole.field(k)
        bare.write_unit(k, k, slice(0, whole.y.size), {n: field[n] for n in names}, field.status)
    one, two = (track(store, *all_pixels(whole)) for store in (whole, bare))
    np.testing.assert_allclose(two.x, one.x, atol=1e-4)
    np.testing.assert_allclose(two.y, one.y, atol=1e-4)


def test_what_cannot_be_followed_is_refused(tmp_path: Path) -> None:
    store = fill(*flat_store(tmp_path / "gap.zarr", frames=(0, 1, 3)))
    with pytest.raises(InputError, match="between the frames 1 and 3"):
        track(store, [10], [10])
    store = fill(*flat_store(tmp_path / "o.zarr"))
    for arguments, message in (
        (([10], [10, 12]), "as many finite x as y"),
        (([np.nan], [10]), "as many finite x as y"),
        (([10], [10], 9), "the store holds the frames 0..3"),
    ):
        with pytest.raises(UsageError, match=message):
            track(store, *arguments)
    with pytest.raises(UsageError, match="max_drift = 0"):
        track(store, [10], [10], max_drift=0)
    with pytest.raises(UsageError, match="gauge = -1"):
        track_growth(store, track(store, [10], [10]), -1)
    still = ResultStore.create(
        tmp_path / "still.zarr", frames=(0,), y=[0, 2], x=[0, 2], names=("depth",), chunk=(1, 2, 2), attrs={"plan": {}}
    )
    with pytest.raises(InputError, match="holds no motion"):
        track(still, [1], [1])


def test_noise_adds_up_as_the_correlation_says() -> None:
    rng = np.random.default_rng(1)
    std, correlation = rng.uniform(0.5, 2.0, (12, 3)), np.array([1.0, 0.6, -0.1, -0.4])
    steps = rng.uniform(0.5, 1.5, 11)
    first = np.zeros(12)
    first[:4] = correlation
    R = first[np.abs(np.subtract.outer(np.arange(12), np.arange(12)))]
    found = accumulated(std, correlation, steps)
    for n in range(12):
        weights = np.zeros(12)
        weights[:n] += steps[:n] / 2
        weights[1 : n + 1] += steps[:n] / 2
        e = weights[:, None] * std
        variance = np.einsum("ip,ij,jp->p", e, R, e)
        np.testing.assert_allclose(found[n], np.sqrt(np.maximum(variance, 0)), atol=1e-12)


def test_noise_follows_a_simulation() -> None:
    """Velocities are slopes over nine images: what adds up is the noise of the first and the last images only."""
    weights = np.arange(-4, 5) / 60
    noise = np.random.default_rng(2).standard_normal((4000, 48))
    velocity = np.stack([noise[:, k : k + 9] @ weights for k in range(40)])
    way = np.concatenate([np.zeros((1, 4000)), np.cumsum(0.5 * (velocity[1:] + velocity[:-1]), axis=0)])
    shared = np.correlate(weights, weights, "full")[8:]
    std = np.full((40, 1), np.sqrt(shared[0]))
    found = accumulated(std, shared / shared[0], np.ones(39))[:, 0]
    np.testing.assert_allclose(found[1:], way[1:].std(axis=1), rtol=0.05)
    assert found[-1] < 1.1 * found[12]


def test_closure_is_what_frames_say_against_each_other() -> None:
    t = np.array([0.0, 1.0, 2.5, 3.0, 4.0])
    motion = np.stack([0.3 * t, 1 - 0.2 * t], axis=1)[:, :, None]
    constant = np.broadcast_to(np.array([0.3, -0.2])[:, None], motion.shape)
    assert closure(motion, constant, np.diff(t)).max() < 1e-12
    assert closure(motion, np.full(motion.shape, np.nan), np.diff(t)).max() < 1e-12
    # An acceleration that is missed by (0.1, 0) leads 0.1 t² / ... apart: the sum of h² 0.1.
    apart = closure(motion, constant + np.array([0.1, 0.0])[:, None], np.diff(t))
    np.testing.assert_allclose(apart[1:, 0], 0.1 * np.cumsum(np.diff(t) ** 2), atol=1e-12)


def test_pairs_are_all_that_are_near() -> None:
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-20, 30, (2, 300))
    x[7] = np.nan
    i, j = pairs_within(x, y, 4.0)
    near = np.hypot(np.subtract.outer(x, x), np.subtract.outer(y, y)) <= 4.0
    assert sorted(zip(i.tolist(), j.tolist(), strict=True)) == list(
        zip(*(n.tolist() for n in np.nonzero(near)), strict=True)
    )
    assert (np.diff(i) >= 0).all()
    assert pairs_within(np.array([np.nan]), np.array([0.0]), 1.0)[0].size == 0


def test_rays_of_the_plane_are_those_of_its_pixels() -> None:
    """The oracle of these tests: points that are seen at pixels are seen there."""
    x, y = np.array([3.0, 77.0]), np.array([5.0, 90.0])
    back = pixels(PLANE, seen(PLANE, x, y, 4.0))
    np.testing.assert_allclose(back, (x, y), atol=1e-9)
    assert rays_of(x, y).shape == (2, 2, 3)


def test_what_a_window_takes_from_a_bent_motion_is_in_the_bound(tmp_path: Path) -> None:
    """Motion that grows with the square of x: its mean over a Gaussian window is off by σ² times the coefficient."""
    store, maps, status = flat_store(tmp_path / "o.zarr", n=6, flow=(0.0, 0.0), std=1e-9)
    sigma, coefficient = 5.0, 1e-4
    maps["flow_x"][:] = coefficient * (store.x - 20.0) ** 2
    distance = np.arange(0, 40)
    plan = store.attrs["plan"]
    plan["noise_correlation"]["x"] = np.exp(-(distance**2) / (4 * sigma**2)).tolist()
    store.update_attrs({"plan": plan})
    fill(store, maps, status)
    tracks = track(store, [20.0], [14.0])
    np.testing.assert_allclose(tracks.drift[:, 0], sigma**2 * coefficient * np.arange(6), rtol=0.01, atol=1e-6)
