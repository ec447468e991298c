"""The cases of growth, on results that are made up: what they compare, and when their goals are met."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from leafflow_ti import metrics
from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.leaf import truth
from perf import leaf_growth
from perf.refinement import rigid

RNG = np.random.default_rng(0)


def made_up(scatter: float, bar: float, shift: float = 0.0) -> leaf_growth.Measured:
    """.1 %/frame along axis 1, with normal errors of this scatter and error bars."""
    shape = (40, 50)
    strain = np.broadcast_to([0.1, 0.0, 0.0], (*shape, 3))
    maps = {}
    for area, _, strains, _ in leaf_growth.MEASURES.values():
        for name, value in zip((area, *strains), (0.1, 0.1, 0.0, 0.0), strict=True):
            maps[name] = value + shift + scatter * RNG.standard_normal(shape)
            maps[f"{name}_std"] = np.full(shape, bar)
    maps["surface_angle"] = np.full(shape, 0.05)
    known = {"growth_rate": np.full(shape, 0.1), "strain_rate": strain, "surface_strain": strain}
    return leaf_growth.Measured(maps, known, np.ones(shape, np.bool_))


def figures_of(found: leaf_growth.Measured) -> dict[str, bool | None]:
    both = leaf_growth.Measured.together([found, found])
    assert both.inside.shape == (80, 50)
    report = metrics.evaluate(both.maps, both.truth, {"leaf": both.inside})["leaf"]
    variant = leaf_growth.Settings().variants[1]
    return {
        figure.name.removeprefix(f"{variant.label}, noise 1, "): figure.met
        for figure in leaf_growth.figures(report, variant, 1.0)
    }


def test_goals_of_growth() -> None:
    met = figures_of(made_up(0.003, 0.003))
    assert all(met.values())
    assert met["from motion: principal direction, rms error"]
    assert len(met) == 13
    met = figures_of(made_up(0.003, 0.009, shift=0.01))
    assert met["refined: area, |mean error|"] is False
    assert met["from motion: area, |mean error|"] is True
    assert met["growth_rate: within one error bar"] is False


@pytest.mark.parametrize("variant", leaf_growth.Settings().variants, ids=lambda variant: variant.deformation)
def test_the_leaf_stays_in_all_images(variant: leaf_growth.Variant) -> None:
    """Of every camera and frame: no pixel of the leaf touches the border."""
    scene = leaf_growth.Settings().scene(variant)
    assert (scene.n_cols - 1) * scene.baseline_mm[0] == leaf_growth.BASE_MM
    known = truth(scene)
    assert known["region"].sum() > 30000
    y, x = np.nonzero(known["region"])
    points = scene.seen(x, y)
    for frame in (0, scene.n_frames - 1):
        moved = scene.follow(points, scene.time(frame))
        for row, col in ((0, 0), (scene.n_rows - 1, scene.n_cols - 1)):
            seen = scene.pixels(moved, scene.camera_position(row, col))
            assert (seen > 2.0).all()
            assert (seen < np.array(scene.size) - 3.0).all()


def test_rigid_scenes_do_not_grow() -> None:
    for label, (scene, view) in rigid.every_scene(quick=False).items():
        assert ("brightness" in view) == ("spot" in label)
        if isinstance(scene, CubeScene):
            assert (scene.omega == (0.0, 0.0, 0.0)) == ("translating" in label)
        else:
            assert scene.growth_rate == 0.0
            assert np.degrees(np.linalg.norm(scene.omega)) > 0.002
        assert replace(scene, noise=0.0, bits=8) == scene
