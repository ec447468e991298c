"""The twin of the exact refinement and the bound of its error: against truth, differences, scatter, and each other."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from reference import refine as twin

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.bound import cramer_rao, light_terms
from leafflow_ti.synthetic.geometry import plane_axes
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.moving_patch import Views, directions, pulled_back, true_state, warp, window
from leafflow_ti.synthetic.plane import PlaneScene, render, render_image, truth

SCENE = PlaneScene(
    f_px=1500.0,
    baseline_mm=(4.0, 4.0),
    n_cols=3,
    n_frames=3,
    size=(121, 81),
    centre=(0.0, 0.0, 400.0),
    zx=0.4,
    zy=-0.3,
    velocity=(0.3, -0.2, 0.5),
    omega=(0.002, -0.003, 0.004),
    rotation_centre=(150.0, -80.0, 500.0),
    texture="noise",
    wavelengths_mm=(2.0, 9.0),
    offset=120.0,
    amplitude=27.0,
)
"""A patch whose waves are 7.5 px long at least."""

X, Y = 66, 44


def images(scene: PlaneScene) -> np.ndarray:
    """All images [K, H, W], frames, then camera rows, then columns."""
    width, height = scene.size
    return render(scene).reshape(-1, height, width)


def window_of(scene: PlaneScene, **options: Any) -> twin.Window:
    return twin.Window(Views.of(scene, X, Y), scene.principal, **{"size": 33, "sigma": 10.0, "thin": 2, **options})


def beside(state: np.ndarray, motion: int = 9) -> np.ndarray:
    """A start as an affine model gives it: a little wrong, without acceleration and growth."""
    start = state + np.array([0.3, 0.01, 0.01, *[0.01] * 3, *[1e-4] * 3, *[0.0] * 6])
    start[3 + min(motion, 6) :] = 0.0
    return start


# --- the exact image of a patch --------------------------------------------------------------------------------------


def test_warp_follows_the_material_of_a_scene() -> None:
    """A scene that moves about the point seen at the pixel: its own motion is the state of the patch."""
    scene = replace(SCENE, strain=(0.02, -0.01, 0.015), growth=0.003, n_rows=3, principal_px=(X, Y))
    views, offsets = Views.of(scene, X, Y), window(21, 5)
    state = true_state(truth(scene), X, Y)
    rays = np.column_stack([offsets / scene.f_px, np.ones(len(offsets))])
    material = scene.material(scene.intersect(rays, np.zeros(3), 0.0), 0.0)
    for k in (0, 7, 13, 26):
        points = scene.place(material, float(views.times[k]))
        wanted = scene.f_px * (points[:, :2] - views.cameras[k]) / points[:, 2:]
        np.testing.assert_allclose(warp(views, state, offsets, k), wanted, atol=1e-9)
    assert {tuple(c) for c in views.cameras} == {(x, y) for x in (-4.0, 0.0, 4.0) for y in (-4.0, 0.0, 4.0)}


def test_a_shift_over_the_texture_has_its_closed_form() -> None:
    """At the reference only depth and slopes move the patch, and there the texture is fixed to the rays: nothing moves.
    One frame later a velocity along an axis of the plane moves the window back over the texture by itself."""
    views, offsets = Views.of(SCENE, X, Y), window(9, 4)
    state = np.zeros(15)
    state[0], state[1:3] = 400.0, (0.4, -0.3)
    reference, later = (3 * frame + 1 for frame in (1, 2))
    np.testing.assert_allclose(pulled_back(views, state, offsets, reference, directions(9, 3)), 0.0, atol=1e-6)
    shift = pulled_back(views, state, np.zeros((1, 2)), later, directions(3, 0))[0, :, 3:]
    centre = np.array([X - 60.0, Y - 40.0, SCENE.f_px])
    # The ray through the pixel meets the moved plane at another place of the texture, along the plane.
    normal = plane_axes(0.4, -0.3)[:, 2]
    along = np.eye(3) - np.outer(centre, normal) / (centre @ normal)
    projected = SCENE.f_px / 400.0 * (along[:2] - centre[:2, None] / centre[2] * along[2])
    projected_velocity = SCENE.f_px / 400.0 * (np.eye(3)[:2] - np.outer(centre[:2] / centre[2], [0, 0, 1]))
    np.testing.assert_allclose(shift, projected_velocity, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(projected, projected_velocity, atol=1e-9)


# --- the twin --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "options"),
    [
        pytest.param({}, {}, id="rigid"),
        pytest.param({"growth": 0.002}, {"modes": 1}, id="growing"),
        pytest.param({"strain": (0.002, -0.001, 0.001)}, {"modes": 3}, id="straining"),
        pytest.param({"brightness": (BrightnessTerm("t", 1, 0.02, 0.0003, 0.0001),)}, {"terms": 3}, id="lit"),
    ],
)
def test_twin_finds_the_truth_without_noise(change: dict[str, Any], options: dict[str, Any]) -> None:
    """What is left is the interpolation's and the blur's error, some hundredths of a grey value, which biases each
    unknown less than noise of a tenth of one would scatter it. (Light of slope h per px moves smoothed texture by
    σ_p² h: slopes in light are kept small.)"""
    scene = replace(SCENE, **change)
    state = true_state(truth(scene), X, Y)
    w = window_of(scene, **options)
    found = twin.refine(twin.coefficients(images(scene)), w, beside(state))
    assert found.steps < 12
    assert found.noise < 0.03
    error = np.linalg.lstsq(w.along, found.state - state, rcond=None)[0]
    np.testing.assert_allclose(w.along @ error, found.state - state, atol=1e-15)
    scatter = 0.1 * np.sqrt(np.diag(found.covariance)) / found.noise
    assert (np.abs(error) < scatter).all(), error / scatter


def test_jacobian_is_that_of_the_residual() -> None:
    """Differences of the residual at the truth; the mean gradient stands for that of each image, which differs from it
    by how each image blurs the texture: a few hundredths, the largest where images differ most."""
    scene = replace(SCENE, zx=0.2, zy=-0.1)
    state = true_state(truth(scene), X, Y)
    w = window_of(scene, modes=3)
    splines, light = twin.coefficients(images(scene)), np.zeros((9, 0))
    _, gradient, _, gain = twin.evaluate(splines, w, state, light)
    found = twin.eliminate(twin.jacobian(w, state, gradient, gain), np.ones(len(w.offsets)), w.light, w.weights, gain)
    for i, direction in enumerate(w.along.T):
        h = 1e-4 * (400.0 if i in (0, 3, 4, 5, 9, 10, 11) else 1.0)
        h *= 0.02 / max(np.sqrt(np.mean(found[..., i] ** 2)) * h, 0.02)  # a small change of grey values
        ends = [twin.evaluate(splines, w, state + sign * h * direction, light)[2] for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * h)
        assert np.linalg.norm(found[..., i] - difference) < 0.05 * np.linalg.norm(difference), i


def test_error_bars_are_the_scatter() -> None:
    """Depth and slopes from three cameras: sixty sequences know each standard deviation to 9 %."""
    scene = replace(SCENE, n_frames=1, noise=2.0)
    clean = images(replace(scene, noise=0.0))
    state = true_state(truth(scene), X, Y)
    w = window_of(scene, motion=0, thin=3)
    states, errors, noises = [], [], []
    for seed in range(60):
        noisy = replace(scene, seed=seed)
        seen = np.stack([noisy.expose(image, 0, 0, col) for col, image in enumerate(clean)])
        found = twin.refine(twin.coefficients(seen), w, beside(state, motion=0))
        states.append(found.state[:3])
        errors.append(np.sqrt(np.diag(found.covariance)))
        noises.append(found.noise)
    assert np.mean(noises) == pytest.approx(2.0, rel=0.03)
    np.testing.assert_allclose(np.std(states, axis=0) / np.mean(errors, axis=0), 1.0, atol=0.25)
    np.testing.assert_allclose(np.mean(states - state[:3], axis=0) / np.mean(errors, axis=0), 0.0, atol=0.4)


def test_noise_of_samples_is_correlated_as_predicted() -> None:
    """White noise through prefilter and spline, read between the pixels: 40000 values know a covariance to 1 %."""
    noise = np.random.default_rng(0).normal(size=(1, 240, 240))
    spline = twin.coefficients(noise)[0]
    y, x = np.mgrid[10:230, 10:230].reshape(2, -1)
    at = np.stack([x, y], axis=1) + np.random.default_rng(1).uniform(size=(x.size, 2))
    value = twin.sample(spline, at)
    for apart in (0.0, 1.0, 1.5, 3.0):
        found = np.mean(value * twin.sample(spline, at + np.array([apart, 0.0])))
        wanted = twin.noise_correlation(np.array([apart]))[0] * twin.noise_correlation(np.array([0.0]))[0]
        assert found == pytest.approx(wanted, abs=0.03 * twin.noise_correlation(np.array([0.0]))[0] ** 2)


# --- the bound -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("terms", [0, 3])
def test_bound_is_that_of_all_unknowns_at_once(terms: int) -> None:
    """The state's part of the inverse of the whole information, texture and light among its unknowns.

    Light common to all images cannot be told from texture; the pseudo-inverse leaves it out.
    """
    scene = replace(SCENE, size=(41, 41))
    size, x, y = 11, 20, 22
    offsets, views = window(size), Views.of(scene, x, y)
    state, along = true_state(truth(scene), x, y), directions(6, 1)
    h = 1e-3
    crop = replace(scene, size=(size, size))
    at = np.array(scene.principal) - (x, y) + size // 2

    def grey(dx: float, dy: float) -> np.ndarray:
        return render_image(replace(crop, principal_px=(at[0] - dx, at[1] - dy)), 1, 0, 1).reshape(-1)

    gradient = np.stack([(grey(h, 0) - grey(-h, 0)) / (2 * h), (grey(0, h) - grey(0, -h)) / (2 * h)], axis=1)
    lit = grey(0, 0)[:, None] * light_terms(offsets, size, terms)
    rows = []
    for k in range(9):
        moved = np.einsum("si,sij->sj", gradient, pulled_back(views, state, offsets, k, along))
        own = np.zeros((len(offsets), 9 * terms))
        own[:, k * terms : (k + 1) * terms] = lit
        rows.append(np.hstack([moved, np.eye(len(offsets)), own]))
    whole = np.concatenate(rows)
    scale = np.linalg.norm(whole, axis=0)
    whole = whole / scale
    inverse = np.linalg.pinv(whole.T @ whole, rcond=1e-13, hermitian=True) / np.outer(scale, scale)
    n = along.shape[1]
    found = cramer_rao(scene, x, y, size, motion=6, modes=1, terms=terms)
    errors = np.sqrt(np.diag(found))
    np.testing.assert_allclose(found / np.outer(errors, errors), inverse[:n, :n] / np.outer(errors, errors), atol=1e-5)


def test_no_estimate_is_better_than_the_bound() -> None:
    """The twin on every second pixel of smoothed images, against every pixel of the window."""
    scene = replace(SCENE, noise=1.0)
    state = true_state(truth(scene), X, Y)
    found = twin.refine(twin.coefficients(images(scene)), window_of(scene), beside(state))
    bound = np.sqrt(np.diag(cramer_rao(scene, X, Y, 33)))
    ratio = np.sqrt(np.diag(found.covariance)) / bound
    assert (ratio > 1.0).all()
    assert (ratio < 2.5).all()
    assert (np.diag(cramer_rao(scene, X, Y, 33, terms=6)) > bound**2).all()
    assert (np.diag(cramer_rao(scene, X, Y, 33, sigma=10.0)) > bound**2).all()


def test_what_images_do_not_determine_has_no_bound() -> None:
    still = replace(SCENE, n_frames=1)
    assert cramer_rao(still, X, Y, 21, motion=0).shape == (3, 3)
    with pytest.raises(UsageError, match="do not determine all unknowns"):
        cramer_rao(still, X, Y, 21, motion=3)
