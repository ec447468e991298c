"""Cameras at measured positions, frames at measured times: kernels, windows, and results that are not biased."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import estimate_bench
import numpy as np
import pytest
from reference import patch
from reference.measured import MeasuredScene, off_by
from test_kernels_estimate import assert_maps_equal

import leafflow_ti as lf
from leafflow_ti.capture import capture_from_array
from leafflow_ti.filters import FILTER_SETS, HALFWAY_SETS, filter_set
from leafflow_ti.models import MODELS, column_set
from leafflow_ti.sampling import AxisSampling
from leafflow_ti.status import Status
from leafflow_ti.synthetic.plane import render, truth
from leafflow_ti.uneven import UnevenGrid, UnevenSampling, adapted, tilted_weights

SCENE = MeasuredScene(
    f_px=1400.0,
    baseline_mm=(1.0, 1.0),
    n_cols=7,
    n_frames=5,
    size=(145, 101),
    centre=(0.3, -0.2, 100.0),
    zx=0.3,
    zy=-0.2,
    velocity=(0.021, -0.014, 0.04),
    omega=(0.001, -0.0015, 0.002),
    wavelengths_mm=(0.6, 0.75),
    alpha=0.4,
    beta=1.0,
)
"""Disparities of -14 px per step: 50 µm are .7 px."""
OPTIONS: dict[str, Any] = {"preshift": (-14, 0), "window": 31, "stride": 8, "border": "clip", "precision": "f64"}
IRREGULAR = (-3.0, -2.0, -1.0, 0.0, 3.0, 4.0, 5.0)


# Kernels


@pytest.mark.parametrize("name", [*FILTER_SETS, *HALFWAY_SETS])
def test_even_samples_have_the_even_set(name: str) -> None:
    filters = filter_set(name)
    for got, wanted in zip(
        adapted(filters, filters.offsets), (filters.kernel(True), filters.kernel(False)), strict=True
    ):
        assert np.array_equal(got, wanted)
    derivative, smooth = adapted(filters, 2 * filters.offsets)
    assert np.allclose(derivative, filters.kernel(True) / 2, 1e-15)
    assert np.array_equal(smooth, filters.kernel(False))


@pytest.mark.parametrize("name", ["2", "3", "4", "5", "7", "9"])
@pytest.mark.parametrize("spread", [0.03, 0.3])
def test_kernels_of_uneven_samples_fulfil_their_conditions(name: str, spread: float) -> None:
    filters = filter_set(name)
    s = filters.offsets + np.random.default_rng(1).uniform(-spread, spread, filters.taps)
    s -= 0.5 * (s[(filters.taps - 1) // 2] + s[filters.taps // 2])
    D, B = adapted(filters, s)
    assert D.sum() == pytest.approx(0, abs=1e-12)
    assert s @ D == pytest.approx(1, abs=1e-12)
    assert B.sum() == pytest.approx(1, abs=1e-12)
    assert s @ B == pytest.approx(0, abs=1e-12)
    if filters.taps > 2:
        assert s**2 @ D == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("positions", [(-2.1, -0.95, 0, 1.08, 1.97), (-2, -1, 0, 3, 4), (-3, -2, 0, 1, 3)])
def test_derivative_is_that_of_what_is_smoothed(positions: tuple[float, ...]) -> None:
    """The five taps' own gain error is 2.5e-4 up to 1.5 rad; across gaps only slow motion can be followed."""
    s = np.array(positions)
    D, B = adapted(filter_set("5"), s)
    ω = np.array([0.1, 0.3, 0.5, 0.8])
    waves = np.exp(1j * np.outer(ω, s))
    assert np.abs((waves @ D) / (1j * ω * (waves @ B)) - 1).max() < 4e-4


def test_window_weights_have_no_first_moment() -> None:
    offsets = np.array([-3.0, -1.0, 0.0, 0.5, 1.0])
    weights = tilted_weights(offsets, 1.5)
    assert weights.sum() == pytest.approx(1, abs=1e-14)
    assert weights @ offsets == pytest.approx(0, abs=1e-14)
    assert (weights > 0).all()


def test_kernels_of_a_grid_have_the_moments_of_straight_rows_and_columns() -> None:
    x, y = (np.array(off_by(5, 5, 1.0, 50))[..., k] for k in (0, 1))
    axes = [
        UnevenSampling.of(filter_set("3"), 3, 1.0, tuple(mean.tolist()), 2) for mean in (x.mean(axis=0), y.mean(axis=1))
    ]
    grid = UnevenGrid(
        tuple(map(tuple, x.tolist())), tuple(map(tuple, y.tolist())), *axes, (2, 2),
        tuple(x.mean(axis=0).tolist()), tuple(y.mean(axis=1).tolist()),
    )  # fmt: skip
    for row, col in ((0, 0), (-1, 1)):
        under = np.s_[1 + row : 4 + row, 1 + col : 4 + col]
        along_x = grid.kernel(("b", "d"), row, col)
        assert along_x.sum() == pytest.approx(0, abs=1e-12)
        assert (along_x * x[under]).sum() == pytest.approx(1, abs=1e-12)
        assert (along_x * y[under]).sum() == pytest.approx(0, abs=1e-12)
        smooth = grid.kernel(("b", "b"), row, col)
        assert smooth.sum() == pytest.approx(1, abs=1e-12)
        assert (smooth * x[under]).sum() == pytest.approx(axes[0].offsets[1 + col], abs=1e-12)
        assert (smooth * y[under]).sum() == pytest.approx(axes[1].offsets[1 + row], abs=1e-12)


def test_noise_of_an_uneven_axis_is_that_of_its_samples() -> None:
    """Responses and gains against the matrix that leads from unfiltered samples to filtered ones."""
    axis = UnevenSampling.of(filter_set("3"), 3, 1.0, (-2.1, -1.0, 0.1, 0.9, 2.0), 2)
    for differentiate in (True, False):
        H = np.zeros((3, 5))
        for i in range(3):
            H[i, i : i + 3] = axis.kernel(differentiate, i - 1)
        for power in (0, 1, 2):
            assert np.allclose(axis.response(differentiate, power), axis.window(power) @ H, atol=1e-15)
        assert np.allclose(axis.gains(differentiate), np.diag(H @ H.T))


# Twin


TIMES = (0.0, 1.0, 2.1, 3.0, 3.95, 5.0, 6.1)


@pytest.mark.parametrize(
    ("model", "brightness", "grid", "estimator"),
    [("affine-4d", "spatial", "line-x", "tls-equilibrated"), ("affine-4d", "none", "line-x", "for3"),
     ("affine-scene-flow", "none", "line-x", "tls-equilibrated"), ("affine-5d", "none", "square", "ols"),
     ("flow-affine", "temporal", "single", "tls-equilibrated")],
)  # fmt: skip
def test_stages_agree_with_the_twin(
    bench: Callable[..., estimate_bench.Bench], model: str, brightness: str, grid: str, estimator: str
) -> None:
    """Images of even cameras and frames taken for uneven ones: tensors, maps and error bars against direct sums."""
    even = bench(model, brightness, grid, "f64")
    rows, cols = estimate_bench.GRIDS[grid]
    x, y = (np.array(off_by(rows, cols, 1.0, 50))[..., k] for k in (0, 1))
    s = even.sampling
    assert s.t.filters is not None
    changed = {"t": UnevenSampling.of_frames(s.t.filters, 3, 1.0, TIMES, 3)}
    for name, places in (("sx", x.mean(axis=0)), ("sy", y.mean(axis=1))):
        if (filters := s.axis(name).filters) is not None:
            changed[name] = UnevenSampling.of(filters, 3, 1.0, tuple(places.tolist()), len(places) // 2)
    sampling = replace(s, **changed)
    if grid == "square":
        rigid = [tuple(map(tuple, a.tolist())) for a in (x, y)]
        means = [tuple(m.tolist()) for m in (x.mean(axis=0), y.mean(axis=1))]
        sampling = replace(sampling, grid=UnevenGrid(*rigid, sampling.sx, sampling.sy, (2, 2), *means))
    steps = even.steps if MODELS[model].own_flows else ()
    places = tuple((float(x[j + rows // 2, i + cols // 2]), float(y[j + rows // 2, i + cols // 2])) for i, j in steps)
    b = replace(even, sampling=sampling, places=places)
    J, _ = b.reference(0, 0)
    assert np.allclose(b.tensor(0, 0), J, rtol=1e-9, atol=1e-9 * np.abs(J).max())
    motion = MODELS[model].motions[0] if grid != "single" else None
    found = b.estimate(motion, estimator=estimator)
    if estimator != "for3":
        assert_maps_equal(b, found)
        return
    # What constants and slopes share where samples are not equally noisy is left out of the cells' noise.
    solved, own = b.solved(0, 0, found.problem)
    for name, (value, std) in patch.measure(solved, found.problem, b.view, *b.position(0, 0), own).items():
        assert abs(found.map(name)[0][0, 0] - value) < 1e-3 * std, name
        assert found.map(name)[1][0, 0] == pytest.approx(std, rel=1e-4), name


@pytest.mark.parametrize(("taps", "size"), [("2", 1), ("2", 3), ("4", 3)])
@pytest.mark.parametrize("irregular", [False, True])
def test_results_between_frames_agree_with_the_twin(
    bench: Callable[..., estimate_bench.Bench], taps: str, size: int, irregular: bool
) -> None:
    """An even number of taps along time: there are more frames behind the reference frame than before it."""
    even = bench("affine-4d", "none", "line-x", "f64")
    t = AxisSampling.gaussian(filter_set(taps), size, 1.0)
    if irregular:
        t = UnevenSampling.of_frames(filter_set(taps), size, 1.0, TIMES, t.before)
    sampling = replace(even.sampling, t=t)
    columns = column_set(MODELS["affine-4d"], "none", sampling.camera_axes, sampling.sampled)
    images = even.images[: t.before + 1 + t.after]
    b = replace(even, images=images, sampling=sampling, columns=columns)
    assert_maps_equal(b, b.estimate("translation"))


# Whole measurements


@functools.cache
def images_of(scene: MeasuredScene) -> np.ndarray:
    return render(scene)


def errors(scene: MeasuredScene, frame: int, positions: bool = True, stamps: bool = True, **options: Any) -> Any:
    """Mean errors of depth [mm] and velocity [mm/frame] over the pixels whose windows are whole."""
    field = lf.estimate(scene.capture(images_of(scene), positions, stamps), frame, **{**OPTIONS, **options})
    wanted = truth(scene)
    inner = np.ix_(field.y, field.x)
    good = field.status == Status.OK
    good[:3], good[-3:], good[:, :3], good[:, -3:] = False, False, False, False
    assert good.sum() >= 15
    depth = float(np.mean((field["depth"] - wanted["depth"][inner])[good]))
    if "velocity_x" not in field.maps:
        return depth, np.zeros(3)
    velocity = np.stack([field[f"velocity_{a}"] for a in "xyz"], axis=-1) - wanted["velocity"][inner]
    return depth, velocity[good].mean(axis=0)


CASES = [
    ("depth", 1, {}, 1e-3),
    ("affine-4d", 1, {}, 1e-3),
    ("affine-scene-flow", 1, {"refine": 0}, 1e-3),
    ("affine-scene-flow", 1, {"refine": 3}, 1e-3),
    ("affine-5d", 5, {"taps": "3"}, 3e-3),
]
"""Model, camera rows, options, largest mean error of the depth [mm of 100]: with even cameras it is 1e-5 (refined
1e-6), with three taps 9e-4. What interpolation leaves at -14 px per step comes on top."""


@pytest.mark.parametrize(("model", "rows", "options", "most"), CASES)
@pytest.mark.parametrize("off", [10, 50])
def test_depth_is_unbiased_where_positions_are_given(
    model: str, rows: int, options: dict[str, Any], most: float, off: int
) -> None:
    cols = 7 if rows == 1 else 5
    scene = replace(SCENE, n_rows=rows, n_cols=cols, places=off_by(rows, cols, 1.0, off))
    preshift = (-14, -14 if rows > 1 else 0)
    depth, velocity = errors(scene, 2, preshift=preshift, model=model, **options)
    assert abs(depth) < most
    assert np.abs(velocity).max() < 6e-4


@pytest.mark.parametrize(("off", "least"), [(10, 5e-3), (50, 5e-2)])
@pytest.mark.parametrize("model", ["depth", "affine-4d"])
def test_without_positions_depth_is_biased(model: str, off: int, least: float) -> None:
    scene = replace(SCENE, places=off_by(1, 7, 1.0, off))
    depth, _ = errors(scene, 2, positions=False, model=model)
    assert abs(depth) > least


@pytest.mark.parametrize(("model", "options"), [("affine-4d", {}), ("affine-scene-flow", {"refine": 3})])
def test_velocity_is_unbiased_where_stamps_are_irregular(model: str, options: dict[str, Any]) -> None:
    """A gap of three frames: without stamps half of the velocity is missing, or too much."""
    scene = replace(SCENE, n_frames=7, times=IRREGULAR)
    chosen = {"taps_time": "5", "size_time": 1, "model": model, **options}
    _, velocity = errors(scene, 3, **chosen)
    assert np.abs(velocity).max() < 5e-5
    if model == "affine-4d":
        _, velocity = errors(scene, 3, stamps=False, **chosen)
        assert np.abs(velocity[:2]).min() > 5e-3


def test_results_count_in_the_stated_interval() -> None:
    """Frames every 10 s and an interval of 20 s: velocities are twice as large per frame."""
    scene = replace(SCENE, n_cols=5)
    images, options = images_of(scene), {**OPTIONS, "model": "affine-4d", "stride": 16}
    stamps = [10.0 * t for t in range(5)]
    one, two = (
        lf.estimate(capture_from_array(images, scene.geometry, interval, stamps_s=stamps), 2, **options)
        for interval in (10.0, 20.0)
    )
    good = (one.status == Status.OK) & (two.status == Status.OK)
    assert good.any()
    # A window of 1 nominal step is two frames then, so that values agree as estimates do, not bit for bit.
    assert np.allclose(two["velocity_x"][good], 2 * one["velocity_x"][good], rtol=2e-3)


def test_sliding_over_irregular_frames_equals_single_ones(tmp_path: Any) -> None:
    """Kernels and windows belong to frames: wherever a run begins, each frame has the same maps, bit for bit."""
    scene = replace(SCENE, n_cols=5, n_frames=7, times=IRREGULAR)
    capture = scene.capture(images_of(scene))
    options = {**OPTIONS, "model": "affine-4d", "taps": "3", "size_time": 3}
    lf.run(capture, tmp_path / "out.zarr", lf.load_config(overrides=options))
    store = lf.ResultStore.open(tmp_path / "out.zarr")
    assert store.frames == (2, 3, 4)
    for i, frame in enumerate(store.frames):
        alone = lf.estimate(capture, frame, **options)
        for name in store.names:
            assert np.array_equal(store.read(name, i), alone[name], equal_nan=True), (name, frame)


@pytest.mark.parametrize(
    ("times", "frame", "taps", "most"),
    [((-0.5, 0.5), 0, "auto", 4e-4), ((-1.0, 0.0, 1.0), 1, "auto", 8e-5), ((-1.5, -0.5, 0.5, 1.5), 1, "4", 1e-5),
     ((-2.0, -1.0, 0.0, 1.0), 2, "auto", 8e-5)],
)  # fmt: skip
def test_short_sequences(times: tuple[float, ...], frame: int, taps: str, most: float) -> None:
    """Of .4 px/frame, two taps miss 1 % and three .2 % of the velocity across the line of sight; refined, nothing."""
    scene = replace(SCENE, n_frames=len(times), times=times)
    _, velocity = errors(scene, frame, stamps=False, model="affine-scene-flow", taps_time=taps, refine=0)
    assert np.abs(velocity[:2]).max() < most
    depth, velocity = errors(scene, frame, stamps=False, model="affine-scene-flow", taps_time=taps, refine=3)
    assert abs(depth) < 1e-4
    assert np.abs(velocity[:2]).max() < 2e-6
    assert abs(velocity[2]) < 3e-5


def test_results_of_two_frames_say_where_they_lie(tmp_path: Any) -> None:
    scene = replace(SCENE, n_frames=2, times=(0.0, 1.0))
    capture = scene.capture(images_of(scene))
    config = lf.load_config(overrides={**OPTIONS, "model": "affine-4d", "stride": 16})
    lf.run(capture, tmp_path / "out.zarr", config)
    store = lf.ResultStore.open(tmp_path / "out.zarr")
    assert store.frames == (0,)
    assert store._arrays["t"].attrs["time_offset"] == 0.5
    assert np.array_equal(store._arrays["time"][...], [5.0])
    assert store.attrs["plan"]["time_offset"] == 0.5


@pytest.mark.parametrize("irregular", [False, True])
def test_error_bars_at_uneven_places_and_times(irregular: bool) -> None:
    """Errors over error bars, over 8 seeds of noise and the pixels of two independent windows or so: the root mean
    square of 16 numbers is known to 18 %, so .6 to 1.5 is about three of these."""
    places = off_by(1, 7, 1.0, 50)
    times = (-2.0, -1.0, 0.0, 3.0, 4.0) if irregular else (-2.05, -1.0, 0.0, 0.96, 2.03)
    scene = replace(SCENE, places=places, times=times, velocity=(0.01, -0.007, 0.0), omega=(0.0, 0.0, 0.0))
    clean, wanted = images_of(scene), truth(scene)
    scores: dict[str, list[float]] = {"depth": [], "velocity_x": [], "velocity_y": []}
    for seed in range(8):
        noise = np.random.default_rng(seed).normal(0, 2, clean.shape)
        field = lf.estimate(
            scene.capture(clean + noise), 2, **{**OPTIONS, "model": "affine-4d", "size_time": 1, "noise": 2.0}
        )
        inner = np.ix_(field.y, field.x)
        good = field.status == Status.OK
        for name, found in scores.items():
            true = wanted["depth"] if name == "depth" else wanted["velocity"][..., "xy".index(name[-1])]
            score = (field[name] - true[inner]) / field[f"{name}_std"]
            found += score[good].tolist()
    for name, found in scores.items():
        assert 0.6 < np.sqrt(np.mean(np.square(found))) < 1.5, name


@pytest.mark.parametrize(("option", "value"), [("blur_time", 2.0), ("size_time", 13), ("taps_time", "11")])
def test_averaging_over_time_lowers_noise_as_predicted(option: str, value: Any) -> None:
    """Still texture under noise: error bars shrink, and errors with them. Windows of 21 px and 40 x 40 pixels hold some
    16 independent errors of each of two components and six seeds: known to 5 %."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:72, :72]
    still = 100 + 25 * np.cos(0.9 * x + 0.2 * y) * np.cos(0.8 * y - 0.3 * x)
    spread, predicted = {}, {}
    for averaged in (False, True):
        chosen = {"taps_time": "5", "size_time": 1, **({option: value} if averaged else {})}
        found, stds = [], []
        for _ in range(6):
            images = still + rng.normal(0, 4, (17, 1, 1, *still.shape))
            field = lf.estimate(
                lf.capture_from_array(images),
                8,
                model="flow",
                window=21,
                stride=8,
                noise=4.0,
                precision="f64",
                **chosen,
            )
            good = field.status == Status.OK
            for a in "xy":
                found += field[f"flow_{a}"][good].tolist()
                stds += field[f"flow_{a}_std"][good].tolist()
        spread[averaged], predicted[averaged] = np.std(found), np.sqrt(np.mean(np.square(stds)))
        assert 0.75 < spread[averaged] / predicted[averaged] < 1.33
    assert predicted[True] < 0.65 * predicted[False]
    assert spread[True] < 0.75 * spread[False]
