"""One camera as a strain gauge: a rendered plate with known strain, and specimens that are made here.

Tolerances: goals are .003 px and 20 µε/frame; where noise decides, what the error bars amount to stands beside.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.status import Status
from perf import speckle
from perf.inputs import absent

reason = absent(speckle.NAME)
needs_plate = pytest.mark.skipif(reason is not None, reason=reason or "")
FEW = speckle.Settings(steps=(0.0, 0.3, 0.7, 1.0), seeds=2)


def test_images_show_the_same_specimen_wherever_it_is() -> None:
    """A shift by whole pixels is one of the pixels; the mean of what it shows over a pixel changes by its gradient."""
    whole, moved = speckle.speckle_image(0.0), speckle.speckle_image(3.0)
    np.testing.assert_allclose(moved[:, 3:], whole[:, :-3], atol=1e-9)
    assert 50 < whole.std() < 90
    assert 0 < whole.min() < whole.max() < 255
    little = (speckle.speckle_image(0.02) - speckle.speckle_image(-0.02)) / 0.04
    # What shows at x has been at x - shift: five-point derivative, along rows.
    gradient = (8 * (whole[:, 3:-1] - whole[:, 1:-3]) - (whole[:, 4:] - whole[:, :-4])) / 12
    assert np.corrcoef(little[:, 2:-2].ravel(), -gradient.ravel())[0, 1] > 0.98


@needs_plate
def test_strain_of_the_plate_from_three_frames(tmp_path: Path) -> None:
    field = speckle.measure_plate(tmp_path, 65, 8)
    assert (field.status == Status.OK).sum() > 200
    for name, error in speckle.plate_errors(field).items():
        # 8 bit alone: some 6 µε. The images are dilated by 1.2 µε a rendered frame more than stated, all over.
        assert np.abs(error).max() < speckle.GOAL_STRAIN + 5, name
        assert np.sqrt(np.mean(error**2)) < speckle.GOAL_STRAIN / 2, name
        assert error.std() == pytest.approx(1e4 * field[f"{name}_std"][field.status == Status.OK].mean(), rel=0.3)


@needs_plate
def test_a_fourth_frame_at_its_own_time_makes_the_strain_of_the_plate_better(tmp_path: Path) -> None:
    """Two and a half intervals instead of two, and one more image: scatter falls by a quarter."""
    three = speckle.measure_plate(tmp_path, 65, 16)
    four = speckle.measure_plate(tmp_path, 65, 16, **speckle.ALL_FRAMES)
    assert (four.status == Status.OK).sum() == (three.status == Status.OK).sum()
    before, after = (speckle.plate_errors(field) for field in (three, four))
    for name, error in after.items():
        assert np.sqrt(np.mean(error**2)) < speckle.GOAL_STRAIN / 2, name
        assert error.std() < 0.92 * before[name].std(), name


@pytest.mark.parametrize("label", ["refined", "refined, rigid"])
def test_a_rigid_series_has_no_bias(label: str) -> None:
    """Without noise: what interpolation leaves. With it: what the error bar says, at most the goal."""
    clean = speckle.measure_series(FEW, 0.0, 33, **speckle.METHODS[label])
    assert np.abs(clean.bias).max() < 0.001
    assert clean.scatter.max() < 0.001
    noisy = speckle.measure_series(FEW, 0.01, 65, **speckle.METHODS[label])
    assert np.abs(noisy.bias).max() < speckle.GOAL_PX / 2
    assert noisy.scatter.max() < speckle.GOAL_PX
    # Some ten windows that do not overlap, twice: they know it to a fifth.
    np.testing.assert_allclose(noisy.scatter, noisy.bar, rtol=0.5)


def test_the_affine_flow_is_biased_where_a_step_is_long() -> None:
    """Derivatives over one frame follow a speckle less and less: what the refinement is for."""
    series = speckle.measure_series(FEW, 0.0, 65)
    assert np.abs(series.bias[:2]).max() < 0.001
    assert 0.002 < abs(series.bias[-1]) < 0.02


def test_the_noise_floor_follows_the_window() -> None:
    """Twice the window: half the scatter of a displacement, a quarter of that of a strain."""
    one, two = (speckle.floor(FEW, window, "flow-affine") for window in (33, 65))
    assert one["flow_x"] / two["flow_x"] == pytest.approx(2.0, rel=0.35)
    assert one["strain_xx"] / two["strain_xx"] == pytest.approx(4.0, rel=0.5)
    assert two["flow_x"] < 0.004
    assert two["strain_xx"] < 150
