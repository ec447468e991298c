"""The experiments of chapter 2: their patterns move as they say, and small versions show what the whole ones do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.synthetic.cube import CubeScene
from perf import yosemite
from perf.curves import Curves, draw_curves
from perf.dissertation import scenes
from perf.estimators import coverage, discontinuity, edges, filters, scale
from perf.estimators.patterns import MEAN, AffineFlow, Scene, angular_errors, measure
from perf.estimators.variants import FNS_FROM_RAW, replaced
from perf.figures import Figure, Outcome
from perf.inputs import absent

FLOW = AffineFlow((0.6, -0.4), ((0.01, -0.02), (0.02, 0.005)))


def figure(outcome: Outcome, *words: str) -> Figure:
    """The figure of the shortest name that has all words."""
    return min((f for f in outcome.figures if all(word in f.name for word in words)), key=lambda f: len(f.name))


def test_points_move_with_the_flow() -> None:
    x, y = np.array([10.0, -7.0]), np.array([3.0, 20.0])
    step = 1e-4
    before = np.stack(FLOW.origin(x, y, step), axis=-1)
    np.testing.assert_allclose((np.stack([x, y], axis=-1) - before) / step, FLOW.at(x, y), rtol=1e-4)
    there = FLOW.origin(*FLOW.origin(x, y, 2.5), -2.5)
    np.testing.assert_allclose(there, (x, y), atol=1e-12)


def test_two_patterns_meet_left_of_the_middle_pixel() -> None:
    other = AffineFlow((-1.0, 0.5))
    scene = Scene(FLOW, other, size=21, n_frames=5)
    np.testing.assert_allclose(scene.truth[10, 10], other.velocity)
    np.testing.assert_allclose(scene.truth[10, 9], FLOW.at(np.array(-1.0), np.array(0.0)))
    one, two = Scene(FLOW, size=21, n_frames=5).images()[2], scene.images()[2]
    assert np.abs(one[:, :9] - two[:, :9]).max() < 15.0 < np.abs(one[:, 11:] - two[:, 11:]).max()


def test_noise_has_its_size_and_its_seed() -> None:
    clean = Scene(FLOW, size=65, n_frames=5)
    noisy = replace(clean, noise=3.0, seed=4)
    np.testing.assert_array_equal(noisy.images(), noisy.images())
    assert np.std(noisy.images() - clean.images()) == pytest.approx(3.0, rel=0.02)
    assert clean.images().mean() == pytest.approx(MEAN, abs=10.0)


def test_the_flow_of_a_pattern_is_measured() -> None:
    scene = Scene(FLOW, size=45)
    field = measure(scene.images(), model="flow-affine", window=21, precision="f64")
    error = angular_errors(field, scene.truth)
    assert np.nanmax(error) < 0.1  # quantities of second order in the flow are left out by the model
    assert np.isfinite(error).any()


def test_an_estimator_is_replaced_for_a_while() -> None:
    own = ESTIMATORS["fns"]
    with replaced("fns", FNS_FROM_RAW):
        assert ESTIMATORS["fns"] is FNS_FROM_RAW
    with pytest.raises(ZeroDivisionError), replaced("fns", FNS_FROM_RAW):
        raise ZeroDivisionError
    assert ESTIMATORS["fns"] is own


def test_scale_tells_who_depends_on_it(tmp_path: Path) -> None:
    outcome = scale.run_settings(scale.Settings((1e-3, 1.0), ("large",), seeds=1, across=3), tmp_path)
    for estimator in ("ols", "tls-equilibrated", "for3"):
        assert figure(outcome, "noise 10", f": {estimator},").value == pytest.approx(1.0, abs=1e-3)
    for estimator in ("tls", "sampson"):
        assert figure(outcome, "noise 10", f": {estimator},").value > 1.5
    assert outcome.pictures[0].is_file()


def test_robust_estimates_hold_up_to_a_discontinuity(tmp_path: Path) -> None:
    settings = discontinuity.Settings(noise=0.5, reach=20, rows=3, seeds=1)
    outcome = discontinuity.run_settings(settings, tmp_path)
    plain, own = (figure(outcome, f"line: {label}").value for label in ("TLS", "Geman-McClure"))
    joint, first = (figure(outcome, f"Geman-McClure, {label}").value for label in discontinuity.SCHEDULES)
    assert max(own, first) < 0.5 * min(plain, joint)
    assert figure(outcome, "Geman-McClure, joint").low == first
    assert outcome.pictures[0].is_file()


def test_bands_of_the_cube_do_not_overlap() -> None:
    scene = CubeScene(size=(301, 161), supersampling=1, n_cols=1, n_frames=1)
    bands = edges.bands(scene, 10)
    face = scenes.truth(scene)["face"]
    between, border = bands["edge between faces"], bands["border of the cube"]
    assert not (between & border).any()
    np.testing.assert_array_equal(bands["all edges"], between | border)
    assert not (bands["interior"] & bands["all edges"]).any()
    y = 80
    (edge,) = np.flatnonzero((face[y, :-1] == 1) & (face[y, 1:] == 2))
    assert between[y, edge - 9 : edge + 11].all()
    assert not between[y, edge - 10]
    assert not between[y, edge + 11]


def test_share_of_errors_is_judged_by_the_farthest_map(tmp_path: Path) -> None:
    settings = coverage.Settings(("tls-equilibrated",), (2.5,), across=2, seeds=2)
    outcome = coverage.run_settings(settings, tmp_path)
    assert len(outcome.figures) == 2 * len(coverage.MODELS)
    for found in outcome.figures:
        assert 0.2 <= found.value <= 1.0
        assert found.low is not None
    assert "n = 8" in figure(outcome, "affine-4d", "within 1").note


def test_curves_are_drawn_with_one_legend(tmp_path: Path) -> None:
    panel = Curves("title", "x", "y", (1.0, 10.0), {"one": (1.0, 2.0), "two": (2.0, 3.0)}, x_log=True, y_log=True)
    path = draw_curves(tmp_path / "new" / "curves.svg", [panel, replace(panel, limits=(0.0, 4.0), y_log=False)])
    assert path.read_text().count('id="legend_') == 1


def test_density_errors_take_the_best_pixels_first() -> None:
    error = np.arange(100.0).reshape(10, 10)
    means = yosemite.density_errors(error, -error)
    assert means == sorted(means)
    assert means[0] == pytest.approx(4.5)
    assert means[-1] == pytest.approx(49.5)
    error[0, 0] = np.nan
    assert yosemite.density_errors(error, -error)[-1] == pytest.approx(50.0)


def test_pixels_without_a_value_take_the_nearest() -> None:
    flow = np.full((3, 5, 2), np.nan)
    flow[1, 1], flow[1, 4], flow[0, 0] = (1.0, 2.0), (3.0, 4.0), (9.0, 9.0)
    ground = np.ones((3, 5), np.bool_)
    ground[0] = False  # values there are not taken either
    full = yosemite.filled(flow, ground)
    assert np.isnan(full[0]).all()
    np.testing.assert_array_equal(full[1:, :3], np.broadcast_to([1.0, 2.0], (2, 3, 2)))
    np.testing.assert_array_equal(full[1:, 3:], np.broadcast_to([3.0, 4.0], (2, 2, 2)))


@pytest.mark.skipif(absent(yosemite.NAME) is not None, reason="the sequence is not there")
def test_filters_and_best_of_yosemite(tmp_path: Path) -> None:
    table = filters.run_settings(filters.Settings(("tls-equilibrated",), 8), tmp_path)
    assert figure(table, "7 taps").value < figure(table, "3x1x1 taps").value
    best = yosemite.measure(yosemite.Settings(8, ("tls-equilibrated", "best")), tmp_path)
    assert figure(best, "AAE without sky, best").met
    assert figure(best, "AAE without sky, best").value < figure(best, "AAE without sky, tls").value
