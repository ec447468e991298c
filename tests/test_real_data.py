"""Real data, small: crops and strides of the light field, the Yosemite sequence and the growing seedling.

The thresholds are those of the whole images (``python -m perf``); where a part of the image is used, the reason stands
beside them. Skipped where the data, which does not belong to the project, is absent.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perf import cotton, hypocotyl, yosemite
from perf.inputs import absent


def needs(name: str) -> pytest.MarkDecorator:
    reason = absent(name)
    return pytest.mark.skipif(reason is not None, reason=reason or "")


COAT = (60, 300, 220, 460)
"""Part of the light field that lies on one surface, with fine texture: no occlusion in it."""


@needs(cotton.NAME)
def test_light_field_truth_agrees_with_the_geometry_of_the_capture(tmp_path: Path) -> None:
    capture, truth = cotton.open_cotton(tmp_path), cotton.Truth.read()
    assert capture.shape == (1, 9, 9, 512, 512)
    assert capture.geometry is not None
    offset = capture.geometry.disparity_offset_px[0]
    depth = cotton.FOCAL_PX * cotton.BASELINE_MM / (truth.disparity - offset)
    # The two truth files were resampled on their own: they differ at edges, and by less than .1 mm of 4 m elsewhere.
    assert np.median(np.abs(depth - truth.depth)) < 0.1


@needs(cotton.NAME)
def test_light_field_disparity_and_normals_of_one_surface(tmp_path: Path) -> None:
    field = cotton.estimate_cotton(cotton.open_cotton(tmp_path), cotton.Settings(stride=4, roi=COAT))
    disparity, tilt = cotton.errors_of(field, cotton.Truth.read())
    assert np.isfinite(disparity).all()
    # Goal for the median of the whole image: .01 px; without occlusions half of that.
    assert np.median(np.abs(disparity)) < 0.005
    # Against the slope of the true depth map between two pixels, which the window of 15 pixels smooths.
    assert np.median(tilt) < 12.0


@needs(cotton.NAME)
def test_light_field_is_measured_up_to_its_borders_and_better_with_three_preshifts(tmp_path: Path) -> None:
    settings = cotton.Settings(stride=8)
    capture, truth = cotton.open_cotton(tmp_path), cotton.Truth.read()
    fields = [cotton.estimate_cotton(capture, settings, preshift=(p, p)) for p in settings.preshifts_px]
    merged = cotton.merge(fields, settings.preshifts_px, cotton.OFFSET_PX)
    medians = []
    for field in (fields[1], merged):
        disparity, _ = cotton.errors_of(field, truth)
        assert np.isfinite(disparity).mean() > 0.97  # along depth edges the texture determines nothing
        medians.append(np.median(np.abs(disparity[np.isfinite(disparity)])))
    # The goal; and less residual disparity must mean less error of the filters.
    assert medians[0] < 0.01
    assert medians[1] < 0.85 * medians[0]


@needs(yosemite.NAME)
def test_yosemite_beats_the_printed_error(tmp_path: Path) -> None:
    field = yosemite.estimate_flow(tmp_path, **yosemite.PLAIN, stride=4)
    figures = yosemite.figures_of("here", field, yosemite.Truth.read())
    error, median, density = figures
    assert density.value > 99.0
    # 3.1 degrees are printed; every fourth pixel along x and y moves the mean by a tenth of a degree.
    assert error.met
    assert median.met


@needs(hypocotyl.NAME)
def test_seedling_flow_is_that_of_its_root_tip_and_hook(tmp_path: Path) -> None:
    settings = hypocotyl.Settings()
    found = hypocotyl.estimate_growth(tmp_path, settings)
    # Where the straight stem hides the motion along it there is no value.
    assert np.isfinite(found.flow[found.plant]).mean() > 0.95
    ends = hypocotyl.ends(found, settings)
    for flow, speed in ends.values():
        # The ends are seen to a binned pixel, over 15 frames; their speed is not constant.
        assert flow == pytest.approx(speed, abs=1.0)
    assert ends["root tip"][0] > 5.0
    assert ends["hook"][0] < -1.0
