"""The noise level of the images: estimated, given, and under prefilters."""

from __future__ import annotations

import numpy as np
import pytest
from moving_texture import Moving, checks, half, plain, stripes
from scipy.ndimage import gaussian_filter

from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.config import load_config
from leafflow_ti.errors import ConfigError
from leafflow_ti.noise import noise_level, white_noise
from leafflow_ti.plan import make_plan
from leafflow_ti.stages.prefilter import Prefilter


def _smooth(sigma: float) -> np.ndarray:
    texture = gaussian_filter(np.random.default_rng(5).normal(size=(160, 160)), sigma)
    return 110 + 35 * texture / texture.std()


def _sampled(texture: object) -> np.ndarray:
    return Moving(texture, 0.0, size=(160, 160), n_cameras=1, n_frames=1).images()[0, 0, 0]  # type: ignore[arg-type]


TEXTURES = {
    "plain": _sampled(plain),
    "checks": _sampled(checks),
    "stripes": _sampled(stripes(0.4)),
    "half": _sampled(half),
    "smooth-1.5": _smooth(1.5),
    "smooth-3": _smooth(3.0),
    "edges": 60 + 80.0 * ((np.arange(160) // 23 + np.arange(160)[:, None] // 19) % 2),
}


@pytest.mark.parametrize(
    ("sigma", "rounded"), [(0.3, False), (0.5, True), *((s, r) for s in (1.0, 3.0, 10.0) for r in (True, False))]
)
@pytest.mark.parametrize("name", TEXTURES)
def test_noise_is_found_within_15_percent(name: str, sigma: float, rounded: bool) -> None:
    clean = TEXTURES[name]
    noisy = clean + np.random.default_rng(1).normal(0, sigma, clean.shape)
    noisy = np.round(noisy) if rounded else noisy
    assert white_noise(noisy, rounded) == pytest.approx(float(np.std(noisy - clean)), rel=0.15)


def test_saturated_parts_do_not_hide_the_noise() -> None:
    image = 100 + np.random.default_rng(1).normal(0, 2.0, (96, 96))
    image[:, :60] = 255.0
    image[3, 3] = np.nan
    assert white_noise(np.round(image), True) == pytest.approx(2.0, rel=0.2)  # thirty blocks are left
    assert white_noise(np.full((40, 40), 7.0), True) == pytest.approx(12**-0.5)
    assert 0 < white_noise(np.full((40, 40), 7.0), False) < 1e-3


def capture(noise: float, seed: int = 0):
    images = Moving(checks, noise, size=(120, 100), n_cameras=1, seed=seed).images()
    return capture_from_array(images, Geometry(900.0, (59.5, 49.5), (1.0, 1.0)))


def test_plan_knows_it_and_says_so() -> None:
    config = load_config(overrides={"model": "flow"})
    plan = make_plan(capture(2.0), config)
    assert plan.noise == pytest.approx(2.0, rel=0.15)
    assert plan.problem.noise == plan.noise
    assert f"noise       {plan.noise:.3g} grey values, estimated" in plan.describe()
    part = make_plan(capture(2.0), load_config(overrides={"model": "flow", "roi": "30,30,60,60", "frames": "3:4"}))
    assert part.noise == plan.noise  # wherever it measures
    given = make_plan(capture(2.0), load_config(overrides={"model": "flow", "noise": "0.5"}))
    assert given.noise == 0.5
    assert "noise       0.5 grey values, given" in given.describe()


@pytest.mark.parametrize("value", ["-1", "nan", "inf", "loud"])
def test_unsuitable_levels_are_refused(value: str) -> None:
    with pytest.raises(ConfigError, match=r"model\.noise = .* must be a number of grey values >= 0, or \"auto\"$"):
        load_config(overrides={"noise": value})


@pytest.mark.parametrize("given", ["auto", 2.0])
@pytest.mark.parametrize("kind", ["highpass", "homomorphic"])
def test_noise_under_prefilters(device, kind: str, given: object) -> None:
    """What the filters leave of the noise of flat images, against the level that the plan gives."""
    random, radius = np.random.default_rng(2), Prefilter(device("f64"), kind, 4.0, 8, 8).radius
    images = 80 + random.normal(0, 2.0, (1, 90 + 2 * radius, 90 + 2 * radius))
    filtered = Prefilter(device("f64"), kind, 4.0, 90, 90)(images, np.ones(images.shape, bool))
    flat = capture_from_array(images[:, None, None], Geometry(900.0, (50.0, 50.0), (1.0, 1.0)))
    config = load_config(overrides={"prefilter": kind, "sigma_pre": 4.0, "noise": given})
    assert noise_level(flat, config) == pytest.approx(float(filtered.std()), rel=0.1)
