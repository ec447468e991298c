"""The refinement's kernels: against the naive twin, their error bars, and what spoilt grey values do to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from refine_bench import SCENE, Case, X, Y, at_pixels, covariance, estimated

from leafflow_ti.field import PRINCIPAL_NAMES, STRAIN_NAMES
from leafflow_ti.refinement import _derived
from leafflow_ti.runtime import Device
from leafflow_ti.stages.refine import Refined
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.moving_patch import true_state
from leafflow_ti.synthetic.plane import truth

Start = Callable[[str], Device]

QUIET = replace(SCENE, noise=0.1)
"""Noise far below what moves a texture by a few hundredths of a pixel: robust weights are 1 but for a per mille."""
FLAT = replace(
    QUIET, n_cols=1, n_frames=7, zx=0.0, zy=0.0, velocity=(0.06, -0.04, 0.0), omega=(0.0, 0.0, 0.004),
    acceleration=(0.01, 0.005, 0.0), strain=(0.002, -0.001, 0.001),
)  # fmt: skip
"""One camera; a plane that moves within itself."""
LIGHT = (BrightnessTerm("t", 1, 0.01, 2e-4, -3e-4), BrightnessTerm("sx", 1, 0.001))

STEADY = (0.0, 0.0, 0.0)
PAIR = Case(replace(FLAT, acceleration=STEADY), flat=True, motion=6, modes=3, seen=(0, 1))
CASES = {
    "rigid": Case(QUIET),
    "translating": Case(replace(QUIET, omega=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, 0.0)), motion=3),
    "static": Case(replace(QUIET, n_frames=1), motion=0),
    "growing": Case(replace(QUIET, growth=0.002), modes=1),
    "straining": Case(replace(QUIET, strain=(0.002, -0.001, 0.001)), modes=3),
    "gains": Case(replace(QUIET, brightness=(BrightnessTerm("t", 1, 0.01),)), terms=1),
    "slopes": Case(replace(QUIET, brightness=LIGHT), terms=3),
    "curvatures": Case(replace(QUIET, brightness=LIGHT), terms=6, modes=1),
    "grid": Case(replace(QUIET, n_rows=3), modes=1, thin=3),
    "every pixel": Case(QUIET, size=21, sigma=6.0, thin=1, terms=3),
    "uneven times": Case(replace(QUIET, n_frames=9, growth=0.001), modes=1, seen=(-4, -1, 0, 2), interval=0.4),
    "flat": Case(FLAT, flat=True, modes=3),
    "flat, uneven times": Case(replace(FLAT, n_frames=9), flat=True, modes=3, seen=(-4, -1, 0, 2), interval=0.4),
    "flat, growing": Case(replace(FLAT, strain=(0.0, 0.0, 0.0), growth=0.002), flat=True, modes=1, terms=1),
    "flat, rigid": Case(replace(FLAT, strain=(0.0, 0.0, 0.0)), flat=True),
    "flat, translating": Case(
        replace(FLAT, strain=(0.0, 0.0, 0.0), omega=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, 0.0)), flat=True, motion=3
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_kernels_equal_the_twin(device: Start, precision: str, name: str) -> None:
    """The kernels end when a step is below a tenth of a standard error, and thus what is left well below that. They
    take the texture's derivatives from the moves at the window's centre. Their residual has lost less to the unknowns
    and to light than the twin's, which counts correlated noise there: .5 % of the error bars, 3 % where the samples are
    neighbours. Light changes correlations by its slopes' share of the texture, 1 %."""
    case = CASES[name]
    found, wanted = case.refine(device(precision)), case.twin()
    assert found.converged.all()
    errors = np.sqrt(np.diag(wanted.covariance))
    difference = estimated(found.parameters[0] - wanted.state, case) / errors
    assert np.abs(difference).max() < 0.03, difference
    ratio = np.sqrt(np.diag(covariance(found, case))) / errors
    np.testing.assert_allclose(ratio, 0.98 if case.thin == 1 else 0.997, atol=0.01)
    correlation = covariance(found, case) / np.outer(errors, errors) / np.outer(ratio, ratio)
    limit = 0.015 if case.terms or case.modes == 3 else 1e-3
    np.testing.assert_allclose(correlation, wanted.covariance / np.outer(errors, errors), atol=limit)
    others = np.setdiff1d(np.arange(15), case.plan.estimated)
    np.testing.assert_array_equal(found.parameters[0][others], case.start[others])


def test_a_plane_that_faces_the_camera_is_found_in_pixels(device: Start, precision: str) -> None:
    """Whatever its distance; and whatever the times of its frames."""
    for name in ("flat", "flat, uneven times", "flat, growing"):
        case = CASES[name]
        found = case.refine(device(precision))
        error = estimated(found.parameters[0] - case.truth, case)
        assert np.abs(error / np.sqrt(np.diag(covariance(found, case)))).max() < 4, name
        # At noise of .1 error bars of flow and strain are below a third of these.
        assert np.abs(error[:2]).max() < 2e-3, name
        assert np.abs(error[-case.modes :]).max() < 1e-4, name


def test_two_images_are_enough(device: Start, precision: str) -> None:
    """Of one camera, as in digital image correlation. The twin's solution is one of the kernels; from further away they
    end a tenth of a standard error before it, which is more here than among many images. So few residuals tell their
    variance to 5 %: that much robust weights make of it."""
    case = PAIR
    wanted = case.twin()
    errors = np.sqrt(np.diag(wanted.covariance))
    for start, left in ((wanted.state, 0.01), (case.start, 0.25)):
        found = case.refine(device(precision), start)
        assert found.converged.all()
        assert np.abs(estimated(found.parameters[0] - wanted.state, case) / errors).max() < left
        np.testing.assert_allclose(np.sqrt(np.diag(covariance(found, case))) / errors, 1.0, atol=0.05)


def test_splines_of_either_degree_find_the_same(device: Start) -> None:
    """Waves of 7.5 px are misplaced by 2e-5 px at most; noise is read a little differently."""
    case = CASES["growing"]
    five, seven = case.refine(device("f64")), replace(case, degree=7).refine(device("f64"))
    assert seven.converged.all()
    errors = np.sqrt(np.diag(covariance(five, case)))
    difference = estimated(seven.parameters[0] - five.parameters[0], case) / errors
    assert 0 < np.abs(difference).max() < 0.15
    np.testing.assert_allclose(np.sqrt(np.diag(covariance(seven, case))) / errors, 1.0, atol=0.03)


@pytest.mark.parametrize("terms", [1, 3])
def test_bright_changes_of_light_are_no_noise(device: Start, terms: int) -> None:
    """5 % a frame, hundreds of times the noise: error bars and steps are those of constant light."""
    lit = Case(replace(QUIET, brightness=(BrightnessTerm("t", 1, 0.05),)), terms=terms)
    found, constant = lit.refine(device("f32")), Case(QUIET, terms=terms).refine(device("f32"))
    assert found.converged.all()
    assert found.passes[0] <= constant.passes[0] + 1
    errors = np.sqrt(np.diag(covariance(constant, lit)))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance(found, lit))) / errors, 1.0, atol=0.08)
    assert np.abs(estimated(found.parameters[0] - constant.parameters[0], lit) / errors).max() < 0.2


def test_robust_weights_cost_little_of_clean_images(device: Start) -> None:
    """Tukey's weights, 0 beyond six standard deviations, are 97.6 % efficient: estimates with and without them differ
    by .157 standard errors in the mean square, and error bars by 1.2 %."""
    differences, ratios = [], []
    for seed in range(5):
        case = Case(replace(SCENE, noise=4.0, seed=seed), motion=6)
        found, wanted = case.refine(device("f64")), case.twin()
        errors = np.sqrt(np.diag(wanted.covariance))
        differences.append(estimated(found.parameters[0] - wanted.state, case) / errors)
        ratios.append(np.sqrt(np.diag(covariance(found, case))) / errors)
    assert 0.02 < np.sqrt(np.mean(np.square(differences))) < 0.25
    assert np.mean(ratios) == pytest.approx(1.02, abs=0.025)


# --- error bars ------------------------------------------------------------------------------------------------------

WIDE = replace(SCENE, n_cols=5, n_frames=5, size=(199, 199), noise=0.0)
PIXELS = [(x, y) for y in (50, 83, 116, 149) for x in (50, 83, 116, 149)]
"""A window apart, so that their noise is independent."""


def standardised(device: Device, case: Case, noise: float, seeds: int) -> np.ndarray:
    """Errors over error bars [windows, n] of ``seeds`` times the windows around PIXELS."""
    states = np.array([case.truth_at(x, y) for x, y in PIXELS])
    begin = case.beside(states)
    found = []
    for seed in range(seeds):
        noisy = case.images + np.random.default_rng(seed).normal(0.0, noise, case.images.shape).astype(np.float32)
        refined = at_pixels(case.stage(device, noisy), case.scene, PIXELS, begin)
        assert refined.converged.all()
        for i, state in enumerate(states):
            error = estimated(refined.parameters[i] - state, case)
            found.append(error / np.sqrt(np.diag(covariance(refined, case, i))))
    return np.array(found)


FLAT_WIDE = replace(FLAT, n_frames=5, size=WIDE.size, noise=0.0)


@pytest.mark.parametrize(
    ("options", "noise"),
    [
        ({"scene": FLAT_WIDE, "flat": True, "modes": 3}, 0.5),
        ({"scene": FLAT_WIDE, "flat": True, "modes": 3}, 5.0),
        ({"scene": FLAT_WIDE, "flat": True, "modes": 3, "seen": (-2, -1, 2), "interval": 0.4}, 2.0),
        (
            {
                "scene": replace(FLAT_WIDE, acceleration=(0.0, 0.0, 0.0)),
                "flat": True,
                "motion": 6,
                "modes": 3,
                "seen": (0, 1),
            },
            2.0,
        ),
        ({"modes": 1, "terms": 3}, 0.5),
        ({"modes": 1, "terms": 3}, 10.0),
        ({"thin": 1}, 0.5),
        ({"thin": 1}, 10.0),
        # Strain and rotation out of the plane are told apart by perspective alone: in so small a window, the more noise
        # the less linear. Elsewhere error bars are right up to noise of 10.
        ({"modes": 3}, 0.5),
    ],
)
def test_error_bars_are_the_scatter(device: Start, options: dict[str, Any], noise: float) -> None:
    """160 windows know a standard deviation to 5.6 %: 3 of that where a dozen are looked at, less for all at once."""
    z = standardised(device("f32"), Case(**{"scene": WIDE, **options}), noise, 10)
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=0.17)
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.06)
    assert np.mean(np.abs(z) < 1.0) == pytest.approx(0.683, abs=0.05)
    assert np.mean(np.abs(z) < 1.96) == pytest.approx(0.95, abs=0.03)


def test_what_images_do_not_determine_has_no_error_bar(device: Start) -> None:
    """Growth from one moment: the rest is as without it, and the growth is not there."""
    still = replace(SCENE, n_frames=1)
    case, without = Case(still, motion=0, modes=3), Case(still, motion=0)
    found, wanted = case.refine(device("f64")), without.refine(device("f64"))
    assert found.converged.all()
    np.testing.assert_allclose(found.parameters[0], wanted.parameters[0], rtol=1e-9)
    np.testing.assert_allclose(covariance(found, case)[:3, :3], covariance(wanted, without), rtol=1e-6)
    assert (covariance(found, case)[3:] == -1).all()
    maps = _derived(case.plan, found.parameters, found.covariance, np.zeros((1, 2)), still.f_px)
    for name in ("growth_rate", *STRAIN_NAMES, *PRINCIPAL_NAMES):
        value, std = maps[name]
        assert np.isnan(value).all()
        assert np.isinf(std).all()
    assert np.isfinite(maps["depth"]).all()


def test_what_shows_nothing_is_not_refined(device: Start) -> None:
    """No texture at all; and motion that one moment does not show."""
    assert not Case(replace(SCENE, amplitude=0.0), modes=1).refine(device("f64")).converged.any()
    assert not Case(replace(SCENE, n_frames=1), motion=9).refine(device("f64")).converged.any()


# --- masks, holes, borders -------------------------------------------------------------------------------------------


def same(one: Refined, two: Refined) -> None:
    """Bit for bit."""
    assert one.converged.all()
    np.testing.assert_array_equal(one.passes, two.passes)
    np.testing.assert_array_equal(one.parameters, two.parameters)
    np.testing.assert_array_equal(one.covariance, two.covariance)


@pytest.fixture(scope="module")
def case() -> Case:
    return Case(replace(SCENE, n_frames=5))


def test_masked_samples_do_not_count(device: Start) -> None:
    case = Case(QUIET)
    mask = np.ones(SCENE.size[::-1], bool)
    mask[:, X + 3 :] = False
    mask[Y - 7, X - 8 : X] = False
    found = case.refine(device("f64"), mask=mask)
    window = case.window()
    window.weights = window.weights * mask[tuple((window.offsets + np.array([X, Y])).astype(int).T[::-1])]
    wanted = case.twin(window=window)
    assert 0.5 < window.weights.sum() / case.window().weights.sum() < 0.7
    errors = np.sqrt(np.diag(wanted.covariance))
    assert np.abs(estimated(found.parameters[0] - wanted.state, case) / errors).max() < 0.03
    np.testing.assert_allclose(np.sqrt(np.diag(covariance(found, case))) / errors, 0.995, atol=0.015)


def test_a_mask_that_leaves_nothing_leaves_no_result(device: Start, case: Case) -> None:
    mask = np.zeros(SCENE.size[::-1], bool)
    mask[:5] = True
    assert not case.refine(device("f32"), mask=mask).converged.any()


@pytest.mark.parametrize("where", ["pixel", "row", "image edge", "whole image"])
def test_what_is_no_grey_value_does_not_count(device: Start, case: Case, where: str) -> None:
    """Whatever stands there: the result is the same, bit for bit, and near the one of whole images."""
    valid = np.ones(case.images.shape, bool)
    if where == "pixel":
        valid[2, 1, Y - 3, X + 4] = False
        valid[0, 2, Y + 9, X - 5] = False
    elif where == "row":
        valid[:, 0, Y + 4] = False
    elif where == "image edge":
        valid[3:, 2, :, : X - 6] = False
    else:
        valid[4, 0] = False
    results = []
    for garbage in (0.0, 255.0):
        images = np.where(valid, case.images, np.float32(0.0))
        results.append(case.refine(device("f32"), images=np.where(valid, images, garbage), valid=valid))
    same(*results)
    whole = case.refine(device("f32"))
    errors = np.sqrt(np.diag(covariance(results[0], case)))
    assert (np.diag(covariance(results[0], case)) > np.diag(covariance(whole, case))).mean() > 0.7
    assert np.abs(estimated(results[0].parameters[0] - whole.parameters[0], case) / errors).max() < 2.5


def test_samples_beyond_the_block_do_not_count(device: Start, case: Case) -> None:
    """A pixel near the block's corner: what its window lacks there is left out."""
    stage = case.stage(device("f32"))
    maps = truth(case.scene)
    for x, y in ((20, Y), (X, 18), (80, 78)):
        state = true_state(maps, x, y)
        begin = state + (case.start - case.truth)
        begin[9:] = 0.0
        found = at_pixels(stage, case.scene, [(x, y)], begin)
        assert found.converged.all()
        z = estimated(found.parameters[0] - state, case)[:6] / np.sqrt(np.diag(covariance(found, case)))[:6]
        assert np.abs(z).max() < 4


# --- images that do not show the patch alone -------------------------------------------------------------------------


def broken_frame(images: np.ndarray) -> None:
    images[1, 2] = 0.0


def occluded(images: np.ndarray) -> None:
    """Something dark before a quarter of the window, in a third of the images."""
    images[:, 0, Y - 14 : Y - 2, X - 14 : X + 1] = 40.0


def specular(images: np.ndarray) -> None:
    """Highlights that each image has elsewhere."""
    random = np.random.default_rng(3)
    for image in images.reshape(-1, *images.shape[2:]):
        for y, x in random.integers((Y - 15, X - 15), (Y + 15, X + 15), (3, 2)):
            image[y - 1 : y + 2, x - 1 : x + 2] = 255.0


@pytest.mark.parametrize("spoil", [broken_frame, occluded, specular])
def test_outliers_do_not_count(device: Start, case: Case, spoil: Callable[[np.ndarray], None]) -> None:
    """Robust weights keep the errors within a few error bars of clean images; the twin, without them, loses by far."""
    images = case.images.copy()
    spoil(images)
    found = case.refine(device("f32"), images=images)
    assert found.converged.all()
    errors = np.sqrt(np.diag(covariance(case.refine(device("f32")), case)))
    robust = np.abs(estimated(found.parameters[0] - case.truth, case) / errors).max()
    plain = np.abs(estimated(case.twin(images, steps=90).state - case.truth, case) / errors).max()
    assert robust < 5
    assert plain > 4 * robust
