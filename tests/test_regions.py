"""Regions: labels of all kinds, followed leaves, means that are exact, standard errors that are true, tables."""

from __future__ import annotations

import csv
from collections.abc import Mapping
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
    leaf_maps,
    write_store,
)  # fmt: skip
from numpy.typing import NDArray

from leafflow_ti.cli.main import main
from leafflow_ti.correlation import NoiseCorrelation
from leafflow_ti.deformation import Gauge
from leafflow_ti.errors import InputError, MissingExtra, UsageError
from leafflow_ti.field import CORRELATIONS, Field, with_std
from leafflow_ti.following import spread
from leafflow_ti.labels import Labels, covered
from leafflow_ti.mesh import surface_points
from leafflow_ti.region_divergence import Adjoint, differenced, fitted
from leafflow_ti.region_noise import RegionNoise, mean_variance
from leafflow_ti.region_rows import certain, surface_area
from leafflow_ti.region_table import over_frames
from leafflow_ti.regions import RegionTable, measure_regions
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status
from leafflow_ti.surface_growth import strain_of

GROWTH, FLOW = 0.01, (2.5, -1.0)
MM2 = (DEPTH / F_PX) ** 2
"""Area of a pixel."""


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> ResultStore:
    """Frames 2 to 6; the leaf grows and moves, its origin lies at the principal point in the middle frame."""
    return write_store(tmp_path_factory.mktemp("leaf") / "out.zarr", LEAF, leaf_maps(GROWTH, FLOW))


def label_image(dtype: type = np.uint8) -> NDArray[Any]:
    """Regions 1 (a square about the principal point) and 5 (a disc beside it)."""
    image = np.zeros(SIZE[::-1], dtype)
    image[45:76, 65:96] = 1
    y, x = np.indices(image.shape)
    image[np.hypot(x - 115, y - 60) <= 12] = 5
    return image


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


# Standard errors.


def correlated_noise(kernels: tuple[NDArray[Any], NDArray[Any]], n: int, seed: int = 0) -> NDArray[np.float64]:
    """Fields [n, y, x] of white noise filtered along y and x, of variance 1."""
    ky, kx = (k / np.linalg.norm(k) for k in kernels)
    rng = np.random.default_rng(seed)
    white = rng.normal(size=(n, Y.size + ky.size - 1, X.size + kx.size - 1))
    for axis, kernel in ((1, ky), (2, kx)):
        white = np.apply_along_axis(np.convolve, axis, white, kernel, "valid")
    return white


def autocorrelation(kernel: NDArray[Any]) -> NDArray[np.float64]:
    found = np.correlate(kernel, kernel, "full")[kernel.size - 1 :]
    return np.asarray(found / found[0])


WINDOW = np.exp(-0.5 * (np.arange(-9, 10) / 3.0) ** 2)
RAMP = WINDOW * np.arange(-9, 10)


def noise_of_windows(**options: Any) -> RegionNoise:
    value, gradient = autocorrelation(WINDOW), autocorrelation(RAMP)
    return RegionNoise((value, value), (gradient, gradient), np.ones(1), refined=True, **options)


def calibration(errors: NDArray[Any], predicted: list[float]) -> float:
    """Standard deviation of (estimate - truth) / standard error over the realisations."""
    return float(np.std(errors / np.array(predicted)))


@pytest.mark.parametrize("name", ["depth", "velocity_x", "slope_x", "slope_y", "rotation_z", "growth_rate"])
@pytest.mark.parametrize("region", ["leaf", "whole", "few"])
def test_errors_of_means_are_those_of_the_noise(name: str, region: str) -> None:
    """Noise as windows make it: means of it (depth), differences along an axis (slopes), or both (growth)."""
    n = 300
    kernels = {"slope_x": [(WINDOW, RAMP)], "slope_y": [(RAMP, WINDOW)]}.get(name, [(WINDOW, WINDOW)])
    if name in ("rotation_z", "growth_rate"):
        kernels = [(WINDOW, RAMP), (RAMP, WINDOW)]
    noise = sum(correlated_noise(pair, n, seed) for seed, pair in enumerate(kernels)) / np.sqrt(len(kernels))
    y, x = np.indices((Y.size, X.size))
    mask = {"leaf": np.hypot((y - 15) / 9, (x - 20) / 14) < 1, "whole": y >= 0, "few": (y < 4) & (x < 5)}[region]
    std = 0.5 + x / X.size  # pixels are not equally sure
    weights = np.where(mask, 1 + 0.3 * np.sin(x), 0.0)
    weights /= weights.sum()
    terms = noise_of_windows().terms(name, {})
    predicted = np.sqrt(mean_variance(weights, std, terms))
    found = calibration((noise * std * weights).sum(axis=(1, 2)), [predicted] * n)
    assert 0.85 < found < 1.17  # of 300 realisations: 4 % by chance; the rest is that errors vary over the region


def naive_variance(weights: NDArray[Any], std: NDArray[Any], r: NDArray[Any]) -> float:
    """Pixel by pixel."""
    at = np.argwhere(weights != 0)
    total = 0.0
    for i in at:
        for j in at:
            dy, dx = np.abs(i - j)
            if dy < r.size and dx < r.size:
                total += weights[tuple(i)] * std[tuple(i)] * weights[tuple(j)] * std[tuple(j)] * r[dy] * r[dx]
    return float(total)


def test_variance_of_a_mean_against_its_double_sum() -> None:
    rng = np.random.default_rng(3)
    weights = np.where(rng.random((7, 9)) < 0.7, rng.random((7, 9)), 0.0)
    std = np.where(weights > 0, rng.random((7, 9)), np.nan)  # what does not count may have no error
    r = autocorrelation(WINDOW)[::3]
    (term,) = RegionNoise((r, r), None, np.ones(1), True).terms("depth", {})
    np.testing.assert_allclose(mean_variance(weights, std, (term,)), naive_variance(weights, np.nan_to_num(std), r))


MOVING = (*with_std(("depth", "slope_x", "slope_y", "velocity_x", "velocity_y", "velocity_z", "growth_rate",
                     "area_rate")), *CORRELATIONS)  # fmt: skip


def noisy_motion(seed: int) -> Mapping[str, NDArray[Any]]:
    """Maps of a slanted plane at rest, with noise of the motion as windows make it, and growth that follows from it."""
    zx, zy = 0.6, -0.5
    rx, ry = np.meshgrid((X - PRINCIPAL[0]) / F_PX, (Y - PRINCIPAL[1]) / F_PX)
    rays = np.stack([rx, ry, np.ones_like(rx)], -1)
    one, two, three = (correlated_noise((WINDOW, WINDOW), 1, 3 * seed + k)[0] for k in range(3))
    sigma = np.array([0.004, 0.004, 0.02])
    m = np.stack([one, two, 0.6 * one + 0.8 * three], -1) * sigma  # across the line of sight, and approach
    covariance = np.diag(sigma**2)
    covariance[0, 2] = covariance[2, 0] = 0.6 * sigma[0] * sigma[2]
    to_n = np.broadcast_to(np.eye(3), (*rx.shape, 3, 3)).copy()
    to_n[..., :2, 2] = rays[..., :2]
    c = to_n @ covariance @ np.swapaxes(to_n, -1, -2)
    n, std = np.einsum("...ij,...j->...i", to_n, m), np.sqrt(np.einsum("...ii->...i", c))
    found: dict[str, NDArray[Any]] = {name: np.full(rx.shape, 1e-3) for name in MOVING}
    found |= {"depth": DEPTH / (1 - zx * rx - zy * ry), "slope_x": np.full(rx.shape, zx),
              "slope_y": np.full(rx.shape, zy)}  # fmt: skip
    for k, axis in enumerate("xyz"):
        found[f"velocity_{axis}"], found[f"velocity_{axis}_std"] = n[..., k], std[..., k]
    for name, (i, j) in zip(CORRELATIONS, ((0, 1), (0, 2), (1, 2)), strict=True):
        found[name] = c[..., i, j] / (std[..., i] * std[..., j])
    return found


def run_attributes(gauge: Gauge) -> dict[str, Any]:
    """As of a run with the windows ``WINDOW`` [output pixels], 4 px apart."""
    r, gradient = (np.repeat(autocorrelation(k), 4).tolist() for k in (WINDOW, RAMP))
    plan = attributes()["plan"] | {"noise_correlation": {"x": r, "y": r, "x_gradient": gradient, "y_gradient": gradient,
                                                         "t": [1.0]}}  # fmt: skip
    return attributes(refined=False) | {"plan": plan, "growth": {"strain_window_px": gauge.side, "average_frames": 1}}


@pytest.fixture(scope="module")
def still_plane(tmp_path_factory: pytest.TempPathFactory) -> ResultStore:
    """Thirty frames of a plane at rest, each with its own noise, and growth as it follows from the motion."""
    gauge = Gauge.of(29, 4)
    noise = NoiseCorrelation(autocorrelation(WINDOW), autocorrelation(WINDOW), np.ones(1))

    def maps(t: int) -> Mapping[str, NDArray[Any]]:
        found = dict(noisy_motion(t))
        as_f4 = {name: values.astype(np.float32) for name, values in found.items()}
        field = Field(as_f4, np.zeros((Y.size, X.size), np.uint8), Y, X, t, run_attributes(gauge))
        strain = strain_of(field, gauge, noise).maps()
        return found | {name: strain[name] for name in ("area_rate", "area_rate_std")}

    path = tmp_path_factory.mktemp("still") / "out.zarr"
    return write_store(path, MOVING, maps, frames=range(30), attrs=run_attributes(gauge))


@pytest.mark.parametrize("region", ["inside", "at the border"])
def test_errors_of_mean_growth_from_the_motion(region: str, still_plane: ResultStore) -> None:
    """(Estimate - truth) / standard error over thirty noise realisations, of fits that overlap much."""
    image = np.zeros(SIZE[::-1], int)
    image[(slice(30, 90), slice(40, 120)) if region == "inside" else (slice(0, 80), slice(0, 90))] = 1
    rows = measure_regions(still_plane, image, still=True).of(1)
    pull = rows["area_rate_percent_per_frame"] / rows["area_rate_se_percent_per_frame"]
    assert 0.75 < np.std(pull) < 1.3  # 13 % by chance
    # As values that do not cancel, errors would be as large as this:
    assert rows["area_rate_se_percent_per_frame"].mean() < 0.5 * rows["area_rate_sd_percent_per_frame"].mean()


@pytest.mark.parametrize("adjoint", [differenced, fitted((2, 3))])
def test_weights_of_velocities_are_those_of_their_derivatives(adjoint: Adjoint) -> None:
    """``Σ along · D v = Σ adjoint(along) v`` for derivatives by hand, pixel by pixel, with gaps."""
    rng = np.random.default_rng(5)
    known = rng.random((8, 9)) < 0.8
    values, along_x, along_y = rng.normal(size=(3, 8, 9))
    along_x, along_y = (np.where(known, along, 0.0) for along in (along_x, along_y))
    total = 0.0
    for y, x in np.argwhere(known):
        if adjoint is differenced:
            slopes = []
            for dy, dx in ((0, 1), (1, 0)):
                ends = [(y + s * dy, x + s * dx) for s in (-1, 1)]
                ends = [e if 0 <= e[0] < 8 and 0 <= e[1] < 9 and known[e] else (y, x) for e in ends]
                span = sum(abs(ends[1][k] - ends[0][k]) for k in (0, 1))
                slopes.append((values[ends[1]] - values[ends[0]]) / span if span else 0.0)
        else:
            at = [(i, j) for i, j in np.argwhere(known) if abs(i - y) <= 2 and abs(j - x) <= 3]
            plane = np.array([[1, j, i] for i, j in at])
            slopes = np.linalg.lstsq(plane, np.array([values[i, j] for i, j in at]))[0][1:]
        total += along_x[y, x] * slopes[0] + along_y[y, x] * slopes[1]
    np.testing.assert_allclose((adjoint(along_x, along_y, known) * values).sum(), total, rtol=1e-9)


def test_old_stores_count_errors_as_the_same_throughout_a_window(tmp_path: Path) -> None:
    attrs = attributes()
    del attrs["plan"]["noise_correlation"]
    store = write_store(tmp_path / "o.zarr", LEAF, leaf_maps(), attrs=attrs)
    table = measure_regions(store, label_image())
    assert "does not state how errors hang together" in table.notes[0]
    np.testing.assert_allclose(table.of(1)["growth_se_percent_per_frame"], 0.02, rtol=1e-5)  # the pixel's own


def test_pixels_as_good_as_the_median_count_alike() -> None:
    weights = certain(np.array([[1.0, 2.0, 2.0], [4.0, np.nan, np.inf]]))
    assert weights == pytest.approx(np.array([[1.0, 1.0, 1.0], [0.25, 0.0, 0.0]]))
    assert not certain(np.full((2, 2), np.nan)).any()


def test_means_over_frames_know_what_frames_share() -> None:
    rng = np.random.default_rng(0)
    kernel = np.array([1.0, 0.5, -0.5])
    series = np.apply_along_axis(np.convolve, 1, rng.normal(size=(2000, 14)), kernel / np.linalg.norm(kernel), "valid")
    errors = np.full(12, 0.3)
    errors[4] = np.nan  # a frame in which the region was not seen
    found = [over_frames(np.where(errors > 0, 0.3 * s, np.nan), errors, tuple(autocorrelation(kernel))) for s in series]
    pulls = [mean / se for mean, se in found]
    assert 0.95 < np.std(pulls) < 1.05
    assert np.isnan(over_frames(np.full(3, np.nan), np.ones(3), (1.0,))).all()


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
