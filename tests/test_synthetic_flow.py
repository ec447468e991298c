"""The flow equations against an exact moving plane: all 18 parameters, with and without preshift."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from reference.flow_model import predict, preshift

from leafflow_ti.synthetic.exact_flow import flow_parameters, optical_flow, preshifted_flow_parameters
from leafflow_ti.synthetic.plane import PlaneScene, sinusoid_scene, truth

MOVING = PlaneScene(
    f_px=900.0,
    baseline_mm=(0.7, -0.4),
    n_rows=5,
    centre=(1.0, -2.0, 80.0),
    zx=0.7,
    zy=-0.45,
    velocity=(0.31, -0.22, 0.47),
    omega=(0.011, -0.017, 0.008),
    acceleration=(0.013, 0.021, -0.017),
)
FAR_PIVOT = replace(MOVING, rotation_centre=(6.0, 3.0, 95.0))
CASES = [
    pytest.param(MOVING, id="moving"),
    pytest.param(FAR_PIVOT, id="rotation about another point"),
    pytest.param(sinusoid_scene(), id="sinusoid"),
]
PIXELS = [(0.0, 0.0), (120.0, -75.0), (-140.0, 60.0)]


def closed_form(scene: PlaneScene, x: float, y: float) -> dict[str, np.ndarray]:
    point = scene.intersect(np.array([x / scene.f_px, y / scene.f_px, 1.0]), np.zeros(3), 0.0)
    N, A = scene.point_motion(point)
    return predict(x, y, scene.f_px, float(point[2]), scene.zx, scene.zy, N, scene.omega, A)


def assert_equal_parameters(found: Mapping[str, Any], wanted: Mapping[str, Any], rel: float) -> None:
    """Entry by entry; the absolute floor only serves entries that nearly vanish."""
    for name, value in wanted.items():
        np.testing.assert_allclose(found[name], value, rtol=rel, atol=1e-3 * rel * np.abs(value).max(), err_msg=name)


@pytest.mark.parametrize("scene", CASES)
@pytest.mark.parametrize(("x", "y"), PIXELS)
def test_closed_form_agrees_with_differences(scene: PlaneScene, x: float, y: float) -> None:
    assert_equal_parameters(flow_parameters(scene, x, y), closed_form(scene, x, y), rel=1e-8)


@pytest.mark.parametrize("scene", [MOVING, FAR_PIVOT])
def test_flow_of_growing_material_is_its_projected_velocity(scene: PlaneScene) -> None:
    scene = replace(scene, growth=0.02, size=(3, 3), principal_px=(1.0, 1.0))
    at = np.array([-1.0, 1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(optical_flow(scene, at), truth(scene)["flow"][2, 0], rtol=1e-8)


@pytest.mark.parametrize("scene", CASES)
@pytest.mark.parametrize("nu0", [(-14.0, 0.0), (0.0, 9.0), (-8.0, 5.0)])
def test_preshift_mixes_camera_and_pixel_columns(scene: PlaneScene, nu0: tuple[float, float]) -> None:
    x, y = 120.0, -75.0
    wanted = preshift(closed_form(scene, x, y), scene.baseline_mm, nu0)
    assert_equal_parameters(preshifted_flow_parameters(scene, x, y, nu0), wanted, rel=1e-8)
