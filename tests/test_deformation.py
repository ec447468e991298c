"""The virtual strain gauge: exact cases, its twin, cut windows, what it cannot know; principal axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference import deformation as twin

from leafflow_ti.deformation import MOST_ACROSS, Gauge, MovingSurface, Strain, measure_strain
from leafflow_ti.field import SURFACE_NAMES
from leafflow_ti.principal import TOLD_APART, principal_axes
from leafflow_ti.synthetic.geometry import in_plane, tangent_axes

F_PX, PITCH, SHAPE = 900.0, 3, (13, 16)
ACROSS_SIGHT = np.array([[2.0, -0.5, 3.0], [-0.5, 1.5, 1.0], [3.0, 1.0, 60.0]]) * 1e-8
"""Covariance of the image's motion m: of the approach much more uncertain than of what goes across."""


def correlation(n: int) -> float:
    return float(np.exp(-0.5 * (n / 2.0) ** 2))


def between(gauge: Gauge) -> np.ndarray:
    points = np.arange(gauge.across) * gauge.thin
    return np.vectorize(correlation)(np.abs(np.subtract.outer(points, points)))


def scene(precision: type = np.float64) -> tuple[np.ndarray, np.ndarray]:
    """Points and rays of a bent surface, seen off the axis; depths rounded to a precision."""
    rows, cols = (np.arange(n) * PITCH for n in SHAPE)
    x, y = np.meshgrid((cols + 150) / F_PX, (rows - 20) / F_PX)
    depth = (80 + 30 * x - 20 * y + 400 * x * x + 300 * x * y).astype(precision).astype(np.float64)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    return rays * depth[..., None], rays


def surface(velocity: np.ndarray, known: np.ndarray | None = None, precision: type = np.float64) -> MovingSurface:
    points, rays = scene(precision)
    velocity = np.where(np.ones(SHAPE, bool)[..., None] if known is None else known[..., None], velocity, np.nan)
    M = np.broadcast_to(np.eye(3), (*SHAPE, 3, 3)).copy()
    M[..., :2, 2] = rays[..., :2]
    covariance = M @ ACROSS_SIGHT @ np.swapaxes(M, -1, -2)
    h, w = SHAPE
    below, beside = np.ones((h - 1, w), bool), np.ones((h, w - 1), bool)
    return MovingSurface(points, velocity.astype(precision).astype(np.float64), covariance, rays, below, beside, F_PX)


def gauge_of(window: int) -> Gauge:
    return Gauge.of(window, PITCH)


def measured(moving: MovingSurface, window: int = 13) -> Strain:
    gauge = gauge_of(window)
    return measure_strain(moving, gauge, between(gauge), between(gauge))


HOLES = np.ones(SHAPE, bool)
HOLES[2, 3] = HOLES[5, 5:8] = HOLES[6, 9] = HOLES[11:, :2] = False
HOLES[:, 12] = False
HOLES[9:, 14] = HOLES[10, 15] = False


@pytest.mark.parametrize("known", [None, HOLES], ids=["whole", "cut"])
def test_rigid_motion_is_no_strain(known: np.ndarray | None) -> None:
    """However fast the rotation, and whatever is cut; rounding of 1e-16 by 1e-2, in per cent."""
    points, _ = scene()
    velocity = np.array([0.4, -0.3, 1.0]) + np.cross([0.2, -0.2, 0.1], points - [3.0, 1.0, 80.0])
    found = measured(surface(velocity, known))
    finite = np.isfinite(found.area)
    assert finite.sum() > 100
    assert np.max(np.abs(found.tensor[finite])) < 1e-10
    assert np.max(np.abs(found.area[finite])) < 1e-10


@pytest.mark.parametrize("known", [None, HOLES], ids=["whole", "cut"])
@pytest.mark.parametrize("rate", [-0.01, 0.0005, 0.02])
def test_homogeneous_growth_is_its_rate(rate: float, known: np.ndarray | None) -> None:
    """On the curved surface, turning as it grows: lengths by (1 + g/2) / (1 - g/2)."""
    points, _ = scene()
    offset = points - [3.0, 1.0, 80.0]
    found = measured(surface(rate * offset + np.cross([0.0, 0.0, 1e-4], offset), known))
    stretch = (1 + rate / 2) / (1 - rate / 2)
    finite = np.isfinite(found.area)
    # The rotation's square is 1e-8.
    np.testing.assert_allclose(found.area[finite], 100 * (stretch**2 - 1), rtol=1e-5)
    np.testing.assert_allclose(found.tensor[finite][:, :2], 50 * (stretch**2 - 1), rtol=1e-5)
    np.testing.assert_allclose(found.tensor[finite][:, 2], 0, atol=1e-6)


def test_strain_of_a_tilted_plane_has_the_axes_of_the_tangents() -> None:
    """Anisotropic strain in a plane with slopes (.6, -.4)."""
    zx, zy, rates = 0.6, -0.4, np.array([0.004, 0.001, -0.0007])
    _, rays = scene()
    points = rays * (100.0 / (1 - zx * rays[..., 0] - zy * rays[..., 1]))[..., None]
    moving = replace(surface(points @ in_plane(zx, zy, rates).T), points=points)
    found = measured(moving)
    E = tangent_axes(zx, zy).T @ in_plane(zx, zy, rates) @ tangent_axes(zx, zy)
    before, after = (np.eye(2) + half * E for half in (-0.5, 0.5))
    F = after @ np.linalg.inv(before)
    wanted = 50 * (F.T @ F - np.eye(2))
    np.testing.assert_allclose(found.tensor, np.broadcast_to(wanted[[0, 1, 0], [0, 1, 1]], (*SHAPE, 3)), rtol=1e-6)
    maps = found.maps()
    np.testing.assert_allclose(maps["surface_principal_1"] + maps["surface_principal_2"], wanted.trace(), rtol=1e-9)
    np.testing.assert_allclose(maps["surface_angle"], 0.5 * np.arctan2(-2 * 0.0007, 0.003), rtol=2e-3)


def some_motion() -> np.ndarray:
    points, _ = scene()
    return np.asarray(0.004 * np.sin(points[..., [1, 2, 0]] / 4) + 1e-3 * points[..., [0, 0, 1]] / 20)


@pytest.mark.parametrize("precision", [np.float64, np.float32])
@pytest.mark.parametrize(("half", "thin"), [(2, 1), (1, 2), (1, 1)])
def test_the_gauge_equals_its_twin(half: int, thin: int, precision: type) -> None:
    """Values in both precisions of the maps: depths are rounded to 8e-6 mm, positions count times the strain.

    The errors leave out that they depend on the strain itself, of some .1 %.
    """
    moving = surface(some_motion(), HOLES, precision)
    moving.below[6, 2:6] = False
    moving.beside[1:5, 8] = False
    links = {frozenset(((i, j), (i + 1, j))) for i, j in np.argwhere(moving.below)}
    links |= {frozenset(((i, j), (i, j + 1))) for i, j in np.argwhere(moving.beside)}
    links = {pair for pair in links if all(HOLES[p] for p in pair)}
    gauge = Gauge(half, thin, PITCH)
    found = measure_strain(moving, gauge, between(gauge), between(gauge))
    at = np.argwhere(moving.known)[::5]
    wanted = twin.strain(
        at, moving.points, moving.velocity, ACROSS_SIGHT, moving.rays, moving.known, links, half, thin, PITCH,
        correlation,
    )  # fmt: skip
    values = np.concatenate([found.tensor, found.area[..., None]], axis=-1)[tuple(at.T)]
    errors = np.sqrt(np.diagonal(found.covariance, axis1=-2, axis2=-1))
    errors = np.concatenate([errors, found.area_std[..., None]], axis=-1)[tuple(at.T)]
    assert np.isinf(wanted[1]).any()
    np.testing.assert_array_equal(np.isinf(errors), np.isinf(wanted[1]))
    np.testing.assert_allclose(values, wanted[0], rtol=1e-9, atol=1e-9)
    finite = np.isfinite(wanted[1])
    np.testing.assert_allclose(errors[finite], wanted[1][finite], rtol=0.02)


def test_a_jump_of_depth_is_not_reached_across() -> None:
    """Two halves that move apart: each is rigid for itself."""
    velocity = np.zeros((*SHAPE, 3))
    velocity[:, 8:] = [0.3, 0.1, 0.0]
    apart = surface(velocity)
    assert np.nanmax(np.abs(measured(apart).tensor)) > 1
    apart.beside[:, 7] = False
    assert np.nanmax(np.abs(measured(apart).tensor)) < 1e-10


def test_what_is_not_known_says_so() -> None:
    """A line of pixels, single ones, ones without a motion or without its error."""
    known = np.zeros(SHAPE, bool)
    known[2, :6] = known[9, 9] = known[6:9, 12:15] = True
    moving = surface(some_motion(), known)
    moving.covariance[7, 13] = np.inf
    found = measured(moving).maps()
    line = np.zeros(SHAPE, bool)
    line[2, :6] = line[9, 9] = True
    around = np.zeros(SHAPE, bool)
    around[6:9, 12:15] = True
    around[7, 13] = False
    for name in SURFACE_NAMES:
        values, std = found[name], found[f"{name}_std"]
        assert np.isnan(values[~around]).all(), name
        assert np.isinf(std[line]).all(), name
        assert np.isnan(std[~line & ~around]).all(), name
        if name != "surface_angle":
            assert (np.isfinite(values) & np.isfinite(std))[around].all(), name


def test_sizes_of_the_gauge() -> None:
    assert (Gauge.of(57, 4).side, Gauge.of(57, 4).across, Gauge.of(57, 4).thin) == (57, 15, 1)
    assert Gauge.of(60, 4).side == 57
    assert Gauge.of(3, 1) == Gauge(1, 1, 1)
    for window in (35, 65, 129, 301):
        gauge = Gauge.of(window, 1)
        assert gauge.across <= MOST_ACROSS
        assert window - 2 * gauge.thin < gauge.side <= window


def test_errors_are_those_of_random_motions() -> None:
    """200 motions with errors as assumed know their spread to 5 %; whole windows, cut ones at the edge and in corners,
    where standard errors are larger by half."""
    rng = np.random.default_rng(3)
    still = surface(np.zeros((*SHAPE, 3)))
    h, w = SHAPE
    roots = [
        np.linalg.cholesky(np.vectorize(correlation)(np.abs(np.subtract.outer(range(n), range(n)))) + 1e-10 * np.eye(n))
        for n in (h, w)
    ]
    m = np.einsum("yi,xj,kl,nijl->nyxk", *roots, np.linalg.cholesky(ACROSS_SIGHT), rng.normal(size=(200, h, w, 3)))
    m[..., :2] += still.rays[..., :2] * m[..., 2:]
    found = [measured(replace(still, velocity=one)) for one in m]
    spread = np.std([np.concatenate([f.tensor, f.area[..., None]], axis=-1) for f in found], axis=0)
    wanted = np.sqrt(np.diagonal(found[0].covariance, axis1=-2, axis2=-1))
    wanted = np.concatenate([wanted, found[0].area_std[..., None]], axis=-1)
    np.testing.assert_allclose(spread, wanted, rtol=0.2)
    assert wanted[0, 0, 3] > 1.5 * wanted[6, 8, 3]


def test_principal_axes_and_their_errors() -> None:
    """Of random errors around a tensor whose axes are told apart: 20000 samples."""
    truth, C = np.array([0.5, 0.1, 0.2]), np.array([[4.0, 1.0, 0.5], [1.0, 3.0, -0.4], [0.5, -0.4, 1.0]]) * 1e-5
    values, std = principal_axes(truth, C)
    r = np.hypot(0.2, 0.2)
    np.testing.assert_allclose(values, [0.3 + r, 0.3 - r, np.pi / 8], rtol=1e-12)
    samples = np.random.default_rng(0).multivariate_normal(truth, C, 20000)
    found, _ = principal_axes(samples, np.broadcast_to(C, (20000, 3, 3)))
    np.testing.assert_allclose(found.std(axis=0), std, rtol=0.03)


def test_isotropic_strain_has_no_direction() -> None:
    """Noise lifts the larger value: its standard error is the root mean square of that, and of the mean's."""
    rng = np.random.default_rng(0)
    samples = rng.multivariate_normal([0.4, 0.4, 0.0], np.eye(3) * 1e-4, 20000)
    values, std = principal_axes(samples, np.broadcast_to(np.eye(3) * 1e-4, (20000, 3, 3)))
    undetermined = np.isnan(values[:, 2])
    assert undetermined.mean() > 1 - 2 * np.exp(-0.5 * TOLD_APART**2)
    assert np.isinf(std[undetermined, 2]).all()
    rms = np.sqrt(np.mean((values[:, :2] - 0.4) ** 2, axis=0))
    np.testing.assert_allclose(np.median(std[:, :2], axis=0), rms, rtol=0.05)


@pytest.mark.parametrize(("tensor", "angle"), [((1.0, 0.0, 0.0), 0.0), ((0.0, 1.0, 0.0), -np.pi / 2)])
def test_angles_of_the_axes(tensor: tuple[float, float, float], angle: float) -> None:
    values, _ = principal_axes(np.array(tensor), np.eye(3) * 1e-6)
    assert values[2] == pytest.approx(angle)
    assert values[0] == 1.0
