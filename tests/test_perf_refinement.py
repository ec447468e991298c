"""The cases of the exact refinement, on fields that are made from the truth: what they compare, and what they count."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from leafflow_ti.capture import Capture
from leafflow_ti.field import Field
from leafflow_ti.status import Status
from leafflow_ti.synthetic.plane import noise_scene
from perf.dissertation import scenes
from perf.refinement import common, coverage, cube, growth, sinusoid, timing

SCENE = replace(noise_scene((40, 30)), growth=5e-4, n_cols=2, n_frames=1, supersampling=1)
Y, X = np.arange(4, 24, 2), np.arange(6, 36, 3)
RNG = np.random.default_rng(0)


def field_of(true: dict[str, Any], scatter: float, bar: float, status: int = 0) -> Field:
    """The truth with normal errors of ``scatter`` and error bars of ``bar``."""
    maps = {name: np.asarray(v + scatter * RNG.standard_normal(v.shape), np.float64) for name, v in true.items()}
    maps |= {f"{name}_std": np.full(v.shape, bar) for name, v in true.items()}
    return Field(maps, np.full((Y.size, X.size), status, np.uint8), Y, X, 0)


def pair(start: float, refined: float, bar: float = 0.1) -> common.Pair:
    true = common.true_maps(scenes.truth(SCENE), Y, X)
    return common.Pair(field_of(true, start, bar), field_of(true, refined, bar), true)


def test_truth_has_the_names_of_the_results() -> None:
    true = common.true_maps(scenes.truth(SCENE), Y, X)
    assert set(true) == set(common.UNKNOWNS)
    exact = scenes.truth(SCENE)
    np.testing.assert_array_equal(true["velocity_y"], exact["velocity"][np.ix_(Y, X)][..., 1])
    np.testing.assert_array_equal(true["rotation_z"], np.full((10, 10), SCENE.omega[2]))
    np.testing.assert_allclose(true["growth_rate"], 0.1, rtol=1e-3)
    np.testing.assert_allclose(true["strain_rate_22"], 0.05)


def test_errors_are_those_of_the_field_that_is_named() -> None:
    one = pair(0.0, 0.01)
    for name, angles in one.angles("start").items():
        np.testing.assert_allclose(angles, 0.0, atol=1e-5, err_msg=name)
        assert one.angles()[name].min() > 1e-3
    assert common.rms(one.error("depth")) == pytest.approx(0.01, rel=0.3)
    assert np.isnan(common.rms(np.full(3, np.nan)))


def test_worse_counts_what_has_lost_a_standard_error() -> None:
    one = pair(0.0, 0.0)
    one.refined["depth"][0, :3] += 0.15  # of two error bars of .1 together .141
    one.refined["depth"][1, :5] += 0.13
    assert cube.worse(one, "depth") == (3, 100)
    kept = replace(one, refined=replace(one.refined, status=np.full((10, 10), Status.UNREFINED, np.uint8)))
    assert cube.worse(kept, "depth") == (0, 100)
    assert kept.kept.all()


def test_coverage_leaves_out_what_kept_the_affine_result() -> None:
    pairs = [pair(0.0, 0.1) for _ in range(20)]
    spoilt = pair(0.0, 5.0)
    spoilt.refined.status[:] = Status.UNREFINED
    for name, spread in coverage.covered([*pairs, spoilt]).items():
        assert spread.n == 2000, name
        assert spread.within_1 == pytest.approx(0.683, abs=0.05)
        assert spread.std == pytest.approx(1.0, abs=0.07)
    figures = {figure.name: figure for figure in coverage._figures(1.0, pairs)}
    assert figures["noise 1: share within 1 error bar, least of all unknowns"].met
    doubled = [replace(p, refined=field_of(dict(p.true), 0.2, 0.1)) for p in pairs]
    least = next(f for f in coverage._figures(1.0, doubled) if "within 1 error bar, least" in f.name)
    assert least.met is False


def test_the_start_is_not_refined_and_has_no_strain(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def estimate(capture: Capture, **options: Any) -> Field:
        calls.append(options)
        return field_of(common.true_maps(scenes.truth(SCENE), Y, X), 0.0, 1.0)

    monkeypatch.setattr(common, "estimate", estimate)
    options = {"deformation": "strain", "thin": 2, "stride": 4}
    common.measure(scenes.capture(SCENE, 0), scenes.truth(SCENE), 3, **options)
    start, refined = calls
    assert (start["refine"], start["deformation"]) == (0, "growth")
    assert "thin" not in start
    assert (refined["refine"], refined["deformation"], refined["thin"]) == (3, "strain", 2)
    assert start["stride"] == refined["stride"] == 4


def test_images_of_a_scene_are_exposed_by_seed() -> None:
    noisy = replace(SCENE, noise=2.0, bits=8)
    images = [scenes.capture(noisy, seed).block([0], [0], [0, 1], 0, 30, 0, 40, (0, 0), np.float32) for seed in (0, 1)]
    images = [np.asarray(found[0]).reshape(2, 30, 40) for found in images]
    for seed, found in enumerate(images):
        direct = np.stack([scenes.plane.render_image(replace(noisy, seed=seed), 0, 0, col) for col in (0, 1)])
        np.testing.assert_array_equal(found, direct)
    assert (images[0] != images[1]).mean() > 0.5


def test_bounds_of_the_cases_are_finite() -> None:
    settings = growth.Settings(out_px=9)
    leaf = replace(growth.leaf(settings, (0.4, -0.3), noise=1.0), n_frames=3, n_cols=3)
    rates = growth._bound(leaf, 3)
    assert rates is not None
    assert (rates > 0.0).all()
    still = replace(leaf, n_frames=1)
    assert growth._bound(still, 1) is None
    plane = replace(scenes.sinusoid(noise=2.5), n_frames=3, n_cols=3)
    unweighted, weighted = (sinusoid.bound(plane, sinusoid.Settings(), sigma) for sigma in (None, 19.0))
    assert unweighted.shape == (13,)
    assert (unweighted < weighted).all()


def test_jobs_of_the_timing_differ_by_the_refinement_alone() -> None:
    settings = timing.Settings(timing.Scene(out_px=16, cameras=3, frames=5, window=21, sigma=6.0))
    capture, options = timing._job(settings, settings.scene, reach=33)
    assert options["window"] == 21
    assert options["refine"] == 0
    x0, y0, x1, y1 = options["roi"]
    assert (x1 - x0, y1 - y0) == (16, 16)
    assert min(y0, capture.height - y1) >= 33 // 2 + timing.MARGIN_PX
    assert timing._pixels(settings) == 1
