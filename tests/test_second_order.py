"""Columns of second order: brightness and flow that vary quadratically in the window, and brightness in the world."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from reference import chain
from test_kernels_estimate import assert_maps_equal
from test_kernels_tensor import relative_error
from tolerances import tolerance

import leafflow_ti as lf
from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.errors import ConfigError
from leafflow_ti.filters import filter_set
from leafflow_ti.models import MODELS, column_set
from leafflow_ti.stages.thresholds import DENOISE
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.plane import PlaneScene, render

GRID = {"reference": "single", "line": "line-x", "grid": "square"}
COMBINATIONS = [
    (model, brightness, terms, "line-x" if row.own_flows else GRID[row.cameras])
    for model, row in MODELS.items()
    for brightness in ("temporal", "spatial", "camera")
    for terms in ("time", "space", "both")
    if row.time or (brightness != "temporal" and terms == "space")
    if not row.ranges
]
SINGLE = [("flow-quadratic", "spatial", "both"), ("affine-4d", "spatial", "time"), ("affine-5d", "camera", "both")]
"""Compared in single precision too."""


def check(bench: Callable, model: str, brightness: str, terms: str, grid: str, precision: str) -> None:
    """Tensor, parameters and maps of one model are those of the twin."""
    b = bench(model, brightness, grid, precision, terms=terms)
    limit = tolerance(b.device)
    moving = MODELS[model].time and grid != "single"
    found = b.estimate(MODELS[model].motions[0] if moving else None)
    # Own flows use the workspace after the parameters of the reference model, which are those of the 4D model.
    for pixel in ((0, 0), (2, 4)) if not found.problem.own_flows else ():
        J, rho = b.reference(*pixel)
        assert relative_error(b.tensor(*pixel), J) <= limit.tensor
        P, variance = chain.solve(J, b.columns, b.sampling, "tls-equilibrated")
        cov = chain.covariances(J, variance, b.columns, b.sampling, rho, DENOISE["tls-equilibrated"])
        P, cov = chain.at_centre(P, cov, b.columns)
        std = np.sqrt([np.diag(cov[k, k]) for k in range(b.columns.n_time_like)])
        assert np.max(np.abs(found.parameters[pixel] - P.T) / std) <= limit.parameters
    assert_maps_equal(b, found)


@pytest.mark.parametrize(("model", "brightness", "terms", "grid"), COMBINATIONS)
def test_equals_the_twin(bench: Callable, model: str, brightness: str, terms: str, grid: str) -> None:
    check(bench, model, brightness, terms, grid, "f64")


@pytest.mark.parametrize(("model", "brightness", "terms"), SINGLE)
def test_equals_the_twin_in_single_precision(bench: Callable, model: str, brightness: str, terms: str) -> None:
    check(bench, model, brightness, terms, GRID[MODELS[model].cameras], "f32")


def test_number_of_columns() -> None:
    """The largest model: 21 columns of (6.10), and six of second order; the quadratic flow model has 11."""
    moments = dict.fromkeys(("x", "y", "sx", "sy", "t"), 1.0)
    assert column_set(MODELS["affine-5d"], "camera", ("sx", "sy"), moments, "both").n == 27
    assert column_set(MODELS["flow-quadratic"], "none", (), moments).n == 11


def test_terms_that_fit_no_model_are_refused() -> None:
    with pytest.raises(ConfigError, match="brightness_terms 'space' adds to a brightness model"):
        column_set(MODELS["flow"], "none", (), {"x": 1.0, "y": 1.0, "t": 1.0}, "space")
    with pytest.raises(ConfigError, match="brightness_terms 'both' needs a sequence in time; choose none or space"):
        column_set(MODELS["depth"], "spatial", ("sx",), {"x": 1.0, "y": 1.0, "sx": 1.0}, "both")


SIZE, CENTRE = 61, 30
PIXEL = {"window": 31, "sigma": 9.0, "precision": "f64", "roi": (CENTRE, CENTRE, CENTRE + 1, CENTRE + 1)}


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Long waves: derivative filters are off by less than 1e-3 of the derivative."""
    return 100 + 20 * np.cos(0.35 * x) * np.cos(0.3 * y) + 10 * np.sin(0.25 * x + 0.3 * y)


def sequence(image: Callable[[np.ndarray, np.ndarray, float], np.ndarray]) -> np.ndarray:
    """Nine frames [t, 1, 1, y, x] of ``image(x, y, t)``, offsets from the middle."""
    y, x = np.mgrid[-CENTRE : CENTRE + 1, -CENTRE : CENTRE + 1].astype(float)
    return np.array([image(x, y, t) for t in range(-4, 5)])[:, None, None]


def at_centre(images: np.ndarray, **options: object) -> dict[str, float]:
    field = lf.estimate(capture_from_array(images), **PIXEL, **options)
    return {name: float(field[name][0, 0]) for name in field}


def test_flow_of_second_order() -> None:
    """``dx/dt = a (x + c)²``, solved in closed form: the affine model takes the window's mean for the centre's flow."""
    a, c = 2e-4, 20.0
    images = sequence(lambda x, y, t: texture((x + c) / (1 + a * (x + c) * t) - c, y))
    affine, quadratic = (at_centre(images, model=m)["flow_x"] for m in ("flow-affine", "flow-quadratic"))
    assert quadratic == pytest.approx(a * c**2, rel=2e-3)
    assert affine == pytest.approx(a * (c**2 + 9.0**2), rel=0.1)


def test_brightness_of_second_order_in_space() -> None:
    """``dh/dt = g + gxx x² + gxy xy + gyy y²`` on a still texture."""
    g, gxx, gxy, gyy = 0.01, 1e-4, -5e-5, -4e-5
    images = sequence(lambda x, y, t: texture(x, y) * np.exp(t * (g + gxx * x * x + gxy * x * y + gyy * y * y)))
    options = {"model": "flow-affine", "brightness": "spatial"}
    without, with_terms = (at_centre(images, brightness_terms=t, **options) for t in ("none", "space"))
    assert with_terms["brightness_t"] == pytest.approx(g, rel=5e-3)
    assert with_terms["brightness_tx"] == pytest.approx(0, abs=2e-6)
    assert abs(without["brightness_t"] - g) > 0.2 * g


def test_brightness_of_second_order_in_time() -> None:
    """``h = g1 t + g2 t² + g3 t³``: without the quadratic term the mean of ``3 g3 t²`` is taken for g1."""
    g1, g2, g3 = 0.01, -0.002, 4e-4
    images = sequence(lambda x, y, t: texture(x, y) * np.exp(g1 * t + g2 * t**2 + g3 * t**3))
    options = {"model": "flow-affine", "brightness": "temporal"}
    without, with_terms = (at_centre(images, brightness_terms=t, **options) for t in ("none", "time"))
    # The derivative filter, exact for t, sees this of t³ at its centre.
    cubic = float(np.sum(filter_set("5").kernel(True) * np.arange(-2, 3.0) ** 3))
    assert with_terms["brightness_t"] == pytest.approx(g1 + abs(cubic) * g3, rel=1e-2)
    assert with_terms["brightness_tt"] == pytest.approx(2 * g2, rel=2e-2)
    assert without["brightness_t"] - with_terms["brightness_t"] > 1.5 * g3


LAMP = PlaneScene(
    f_px=900.0,
    baseline_mm=(0.3, 0.3),
    n_cols=7,
    n_frames=9,
    size=(121, 101),
    centre=(0.3, -0.2, 80.0),
    zx=0.4,
    zy=-0.3,
    velocity=(0.03, -0.02, 0.04),
    omega=(0.001, -0.002, 0.002),
    wavelengths_mm=(1.3, 1.1),
    alpha=0.4,
)
"""Long waves again, on a surface that moves and turns."""


def test_brightness_in_the_world() -> None:
    """(4.28): from the image's slopes and trend to those of ``h = g t + (gx X + gy Y) t + g2 t²`` on the material.

    The slopes must be told from the image's by the inclination, the trend from the motion past the pixel.
    """
    g, gx, gy, g2 = 0.01, 0.02, -0.015, 0.0004
    light = (BrightnessTerm("t", 1, g, gx, gy), BrightnessTerm("t", 2, g2))
    scene = replace(LAMP, brightness=light)
    capture = capture_from_array(render(scene), Geometry(scene.f_px, scene.principal, scene.baseline_mm))
    field = lf.estimate(
        capture, model="affine-4d", brightness="spatial", brightness_terms="time", preshift=(-3, 0), window=41,
        sigma=12, precision="f64", roi=(50, 40, 71, 61), stride=5,
    )  # fmt: skip
    assert (field.status == 0).all()
    x, y = np.meshgrid(field.x - scene.principal[0], field.y - scene.principal[1])
    depth = field["depth"]
    on_surface = g + gx * (x * depth / scene.f_px - scene.centre[0]) + gy * (y * depth / scene.f_px - scene.centre[1])
    # Smoothing does not commute with a flow that diverges (1e-3 per frame here): a tenth of it looks like brightness.
    np.testing.assert_allclose(field["brightness_t"], on_surface, atol=1.5e-4)
    np.testing.assert_allclose(field["brightness_world_x"], gx, rtol=0.02)
    np.testing.assert_allclose(field["brightness_world_y"], gy, rtol=0.02)
    np.testing.assert_allclose(field["brightness_world_tt"], 2 * g2, rtol=0.05)
    # What moves past the pixel is no small part of the change there.
    assert np.min(np.abs(field["brightness_tt"] - 2 * g2)) > 0.5 * 2 * g2
