"""The plan of the refinement: what is refined where, what is refused, and maps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.config import load_config, resolve
from leafflow_ti.errors import ConfigError
from leafflow_ti.field import PRINCIPAL_NAMES
from leafflow_ti.plan import Plan, make_plan
from leafflow_ti.refine_plan import Refinement, plan_refinement
from leafflow_ti.splines import filter_radius


def capture(frames: int = 9, rows: int = 1, cols: int = 9, size: tuple[int, int] = (96, 128)) -> Capture:
    images = np.zeros((frames, rows, cols, *size), np.float32)
    return capture_from_array(images, Geometry(1000.0, ((size[1] - 1) / 2, (size[0] - 1) / 2), (1.0, 1.0)))


def plan(of: Capture | None = None, **options: Any) -> Plan:
    return make_plan(of or capture(), load_config(overrides={"preshift": (0, 0), "window": 33, **options}))


def refined(of: Capture | None = None, **options: Any) -> Refinement:
    found = plan(of, **options).refine
    assert found is not None
    return found


def test_default_is_refined_with_all_images_of_the_window() -> None:
    found = refined()
    assert (found.steps, found.size, found.thin, found.across) == (3, 33, 1, 33)
    assert found.sigma == pytest.approx(33 * 19 / 65)
    assert found.frames == tuple(range(-4, 5))
    assert found.cameras == tuple((x, 0) for x in range(-4, 5))
    assert (found.motion, found.modes, found.terms, found.unknowns) == (9, 1, 0, 13)
    # Half the window; four camera steps, two pixels for each of four frames, four besides; the spline and its filter.
    assert found.reach == 4 + 2 * 4 + 4
    assert found.halo == 16 + found.reach + 3 + filter_radius(5)


def test_cameras_stand_in_the_order_of_the_block() -> None:
    planned = plan(capture(rows=3, cols=5, frames=7))
    assert planned.refine is not None
    rows, cols = planned.cameras
    assert planned.refine.cameras == tuple((x - 2, y - 1) for y in rows for x in cols)
    # The 4D model reads the line of cameras through the reference.
    assert refined(capture(rows=3, cols=5), model="affine-4d", refine=3).cameras == tuple((x, 0) for x in range(-2, 3))


def test_a_window_of_its_own_keeps_the_shape() -> None:
    found = refined(window=33, sigma=8.0, refine_window=65, thin=4)
    assert (found.size, found.sigma, found.across) == (65, pytest.approx(8.0 * 65 / 33), 17)


@pytest.mark.parametrize(
    ("options", "motion", "modes"),
    [
        ({"motion": "translation"}, 3, 1),
        ({"motion": "rotation"}, 9, 1),
        ({"motion": "acceleration", "deformation": "none"}, 9, 0),
        ({"deformation": "strain"}, 9, 3),
        ({"deformation": "growth", "model": "affine-4d"}, 9, 1),
        ({"deformation": "growth", "model": "scene-flow"}, 9, 1),
        ({"model": "scene-flow"}, 9, 1),
        ({"model": "affine-translation", "motion": "auto"}, 9, 1),
        ({"model": "range-flow", "motion": "auto"}, 9, 1),
    ],
)
def test_unknowns_and_maps(options: dict[str, Any], motion: int, modes: int) -> None:
    planned = plan(**{"refine": 2, **options})
    assert planned.refine is not None
    assert (planned.refine.motion, planned.refine.modes) == (motion, modes)
    assert planned.refine.unknowns == 3 + motion + modes
    names = planned.quantities
    assert len(set(names)) == len(names)
    assert {"disparity", *planned.refine.names} <= set(names)
    assert ("rotation_z" in names, "acceleration_z" in names) == (motion >= 6, motion == 9)
    assert ("growth_rate" in names, "strain_rate_12" in names) == (modes > 0, modes == 3)
    # Where the surface's curvature comes from, and a neighbour of those that are refined for their own sake.
    assert planned.margin == 1 + (planned.around_curved.reach if planned.around_curved else 0)
    assert (planned.around_curved is None) == (planned.model == "affine-translation")
    # Pixels that keep the model's values keep its growth.
    assert planned.differences == ("growth_rate" in planned.measured and modes > 0)


def test_static_scenes_have_no_motion() -> None:
    for still in (capture(frames=1, cols=5), capture(cols=5)):
        found = plan(still, model="depth", refine=3)
        assert found.refine is not None
        assert (found.refine.frames, found.refine.unknowns) == ((0,), 3)
        assert found.quantities == ("disparity", "depth", "slope_x", "slope_y", "confidence", "identified")


@pytest.mark.parametrize(
    ("brightness", "terms", "photometric"),
    [
        ("none", "none", 0), ("temporal", "none", 1), ("temporal", "space", 6), ("spatial", "none", 3),
        ("spatial", "time", 3), ("spatial", "space", 6), ("spatial", "both", 6), ("camera", "none", 6),
    ],
)  # fmt: skip
def test_photometric_terms_follow_the_brightness(brightness: str, terms: str, photometric: int) -> None:
    assert refined(brightness=brightness, brightness_terms=terms).terms == photometric


@pytest.mark.parametrize("model", ["affine-scene-flow", "affine-4d", "scene-flow"])
def test_without_refinement_the_plan_is_that_of_the_model(model: str) -> None:
    found = plan(model=model, refine=0)
    assert found.refine is None
    assert "growth_rate" in found.quantities
    assert "acceleration_x" not in found.quantities
    assert (found.margin, found.differences) == (1, True)
    assert "refinement" not in found.describe()


def test_the_plan_says_what_was_decided() -> None:
    text = plan(window=65, deformation="strain").describe()
    assert "refinement  at most 3 steps, window of 65 px thinned by 3 (441 samples), 9 frames of 9 cameras" in text
    assert "15 unknowns" in text
    assert "stride 4:" in text


GRADIENT, STRAIN = ("flow_xx", "flow_xy", "flow_yx", "flow_yy"), ("strain_xx", "strain_yy", "strain_xy")


@pytest.mark.parametrize("model", ["flow", "flow-affine", "flow-quadratic"])
@pytest.mark.parametrize(
    ("options", "estimated", "without"),
    [
        ({}, (3, 4, 8, 9, 10, 12, 13, 14), ()),
        ({"motion": "acceleration", "deformation": "growth"}, (3, 4, 8, 9, 10, 12), ("strain_xy",)),
        ({"deformation": "none"}, (3, 4, 8, 9, 10), ("flow_xx", "flow_yy", *STRAIN)),
        ({"motion": "translation", "deformation": "strain"}, (3, 4, 12, 13, 14), ()),
        ({"motion": "translation", "deformation": "none"}, (3, 4), (*GRADIENT, *STRAIN)),
    ],
)
def test_one_camera_sees_a_flat_patch(
    model: str, options: dict[str, Any], estimated: tuple[int, ...], without: tuple[str, ...]
) -> None:
    """What is taken to be 0 has no map; what the model alone would have, the refinement has instead."""
    planned = plan(capture(rows=3), model=model, refine=3, **options)
    found = planned.refine
    assert found is not None
    assert (found.flat, found.cameras, found.estimated) == (True, ((0, 0),), estimated)
    wanted = {n for n in ("flow_x", "flow_y", *GRADIENT, *STRAIN) if n not in without}
    axes = set(PRINCIPAL_NAMES) if found.modes == 3 else set()
    assert set(found.names) == wanted | axes
    assert axes <= set(planned.quantities)
    assert {n for n in planned.quantities if n.startswith(("flow", "strain"))} == wanted
    assert f"{len(estimated)} unknowns (flow" in planned.describe()


def test_the_window_of_one_camera_is_thinned_little() -> None:
    thins = [refined(model="flow-affine", refine=3, window=w).thin for w in (33, 65, 85)]
    assert thins == [1, 2, 2]
    assert refined(model="flow-affine", refine=3, window=65, thin=4).thin == 4
    assert refined(model="affine-4d", refine=3, window=65).thin == 3


def test_refining_the_flow_must_be_asked_for() -> None:
    for preset in ("fast", "balanced", "accurate"):
        assert plan(capture(cols=1), preset=preset).refine is None


def test_range_flow_of_one_camera_is_not_flat() -> None:
    config = load_config(overrides={"model": "range-flow", "refine": 2, "window": 33})
    with pytest.raises(ConfigError, match=r"refine\.steps = 2: model 'range-flow' reads one camera.*flow-affine"):
        plan_refinement(resolve(config, 9, 1, 1), range(-2, 3), [(0, 0)], (96, 128))


def test_times_need_not_be_whole() -> None:
    found = replace(refined(model="flow-affine", refine=3), frames=(-2.3, 0.0, 0.4))
    assert found.reach == 5 + 4


@pytest.mark.parametrize(
    ("of", "options", "message"),
    [
        ({}, {"model": "flow-affine", "motion": "rotation"}, "model 'flow-affine' does not have it"),
        ({}, {"model": "flow-affine", "deformation": "none"}, "only the refinement has a choice: give --refine 3"),
        ({}, {"model": "flow", "deformation": "growth"}, "only the refinement has a choice: give --refine 3"),
        ({}, {"model": "flow-quadratic", "deformation": "strain"}, "only the refinement has a choice: give --refine 3"),
        ({}, {"deformation": "strain", "refine": 0}, "'strain' is measured by the refinement alone: give --refine 3"),
        ({}, {"deformation": "strain", "preset": "fast"}, "'strain' is measured by the refinement alone"),
        ({}, {"deformation": "growth", "refine": 0, "model": "affine-4d"}, "choose affine-scene-flow, or a refinement"),
        ({}, {"deformation": "growth", "refine": 0, "model": "scene-flow"}, "rows that begin with 2d"),
        ({"frames": 1}, {"deformation": "strain", "refine": 3}, "model 'depth' is static: choose deformation none"),
        ({}, {"refine_window": 97}, "refine.window = 97: the images have 128 x 96 pixels.*at most 95"),
        ({"size": (97, 99)}, {"refine_window": 99}, "the images have 99 x 97 pixels.*at most 97"),
        ({}, {"thin": 5}, "refine.thin = 5 leaves 7 samples across a window of 33 px, 9 are needed: choose --thin 4"),
        ({}, {"refine_frames": (3, 4)}, "refine.frames = 3,4: the model looks at 4 frames before and 4 behind already"),
        (
            {},
            {"refine_frames": 5, "model": "affine-4d", "refine": 3},
            "from 5 frames before to 5 behind, so frames 5:4",
        ),
        (
            {},
            {"refine_frames": "1,2,3"},
            "refine.frames = '1,2,3' .option.: must be frames before and behind, N or A,B",
        ),
        ({"frames": 1}, {"refine_frames": 1, "refine": 3}, "refine.frames: model 'depth' is static: leave it out"),
        ({}, {"model": "range-flow", "refine": 3, "refine_frames": 4}, "model 'range-flow' is refined with the frames"),
    ],
)
def test_refusals_name_value_limit_and_way_out(of: dict[str, Any], options: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        plan(capture(**of), **options)
    assert "\n" not in str(caught.value)


def test_frames_beside_those_of_the_model() -> None:
    """They stand around the reference frame, and shorten the sequence that can be measured, as a window does."""
    few = {"taps_time": "3", "size_time": 1, "model": "affine-4d", "refine": 3}
    own, more = plan(**few), plan(refine_frames="2,3", **few)
    assert (own.around, own.frames) == ((1, 1), tuple(range(1, 8)))
    assert (more.around, more.frames) == ((2, 3), tuple(range(2, 6)))
    assert more.refine is not None
    assert more.refine.frames == (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
    assert more.bytes > own.bytes
    between = refined(refine_frames=(1, 2), **{**few, "taps_time": "2"})
    assert between.frames == (-1.5, -0.5, 0.5, 1.5)
    assert plan(refine_frames=3, **{**few, "refine": 0}).around == (1, 1)


def test_the_largest_thinning_is_allowed() -> None:
    assert refined(thin=4).across == 9
    assert refined(window=65, thin=8).across == 9
