"""Refined growth of a curved leaf that grows while it moves, tilts and changes its light, against its exact truth."""

from __future__ import annotations

from typing import Any

import numpy as np

import leafflow_ti as lf
from leafflow_ti import metrics
from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.synthetic.leaf import LeafScene, isotropic, render, truth
from leafflow_ti.synthetic.material import BrightnessTerm

LEAF: dict[str, Any] = {
    "f_px": 900.0,
    "n_frames": 7,
    "centre": (0.0, 0.0, 80.0),
    "velocity": (0.02, -0.015, 0.05),
    "omega": (0.002, -0.003, 0.004),
    "curvature": (-0.008, 0.016, 0.004),
    "half_mm": (8.0, 6.0),
    "wavelengths_mm": (0.6, 3.0),
    "brightness": (BrightnessTerm("t", 1, 0.01, 0.001, -0.001),),
    "supersampling": 2,
}
OPTIONS: dict[str, Any] = {
    "model": "affine-scene-flow",
    "brightness": "spatial",
    "window": 31,
    "refine": 6,
    "refine_window": 31,
    "thin": 2,
    "stride": 8,
}


def report(scene: LeafScene, **options: Any) -> metrics.RegionReport:
    """Of the windows that lie on the leaf."""
    known = truth(scene)
    y, x = np.nonzero(known["region"])
    step = (scene.baseline_mm[0], scene.baseline_mm[1] if scene.n_rows > 1 else 0.0)
    capture = capture_from_array(render(scene).astype(np.uint8), Geometry(scene.f_px, scene.principal, step), bits=8)
    roi = (int(x.min()), int(y.min()), int(x.max()) + 1, int(y.max()) + 1)
    found = lf.estimate(capture, 3, roi=roi, **{**OPTIONS, **options}).measured()
    inside = metrics.erode(known["region"] == 1, 20)[np.ix_(found.y, found.x)]
    assert inside.sum() > 60
    return metrics.evaluate(found, metrics.sample_maps(known, found.y, found.x), {"leaf": inside})["leaf"]


def test_growth_alike_in_all_directions() -> None:
    """.1 %/frame of the area, noise of one grey value."""
    scene = LeafScene(n_cols=5, baseline_mm=(0.6, 0.6), size=(261, 181), growth=isotropic(0.1), noise=1.0, **LEAF)
    found = report(scene, preshift=(-7, 0), deformation="growth")
    error, bars = found.errors["growth_rate_percent"], found.coverage["growth_rate"]
    # Error bars are .013; the leaf holds some fifteen windows that do not overlap.
    assert abs(error.mean) < 0.008
    assert error.std < 0.02
    assert 0.5 < bars.std < 1.5
    assert abs(bars.mean) < 0.6


def test_growth_along_one_axis() -> None:
    """.2 %/frame of lengths along the leaf, none across; images are rounded to 8 bits, without further noise."""
    scene = LeafScene(n_cols=3, n_rows=3, baseline_mm=(1.2, 1.2), size=(261, 221), growth=(2e-3, 0.0, 0.0), **LEAF)
    found = report(scene, preshift=(-13, -13), deformation="strain")
    # A window of 31 px sees the leaf bend, which a plane patch would take for some .007 %/frame of shrinking.
    assert abs(found.errors["growth_rate_percent"].mean) < 0.004
    for name in ("growth_rate", "strain_rate_11", "strain_rate_22", "strain_rate_12", "principal_rate_1"):
        assert found.errors[f"{name}_percent"].std < 0.03, name
        assert 0.5 < found.coverage[name].std < 1.6, name
    angle = found.errors["principal_angle_deg"]
    assert np.hypot(angle.mean, angle.std) < 5.0
