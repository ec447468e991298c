"""The rig planner: spectrum and tensor against rendered textures, errors against the scatter of noisy estimates."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from leafflow_ti.cli.app import make_app
from leafflow_ti.config import load_config
from leafflow_ti.errors import ConfigError, UsageError
from leafflow_ti.rig import Rig, plan_rig
from leafflow_ti.rig_choices import improvements
from leafflow_ti.synthetic.plane import render
from perf.plan_rig import TRIALS, WITHIN, ratios, surface

RIG = Rig(f_px=2700.0, baseline_mm=(0.51, 0.51), distance_mm=100.0, cols=5, frames=5, size=(300, 300))
SMALL = {"window": 33, "sigma": 9.6, "refine": 0}


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.8, -0.4)])
def test_spectrum_is_that_of_rendered_textures(slopes: tuple[float, float]) -> None:
    """Contrast and gradients of an image of the synthetic noise: several hundred waves of it, hence 5 %."""
    rig = replace(RIG, slopes=slopes, wavelengths_px=(4.0, 16.0), contrast=15.0, cols=1, frames=1)
    image = render(surface(rig))[0, 0, 0]
    spectrum = rig.spectrum
    assert np.std(image) == pytest.approx(spectrum.contrast, rel=0.05)
    for k in (0, 1):
        half = np.pi * spectrum.omega[:, k]  # of a central difference, whose transfer is sin ω
        expected = np.sqrt(np.sum(spectrum.power * np.sin(half / np.pi) ** 2))
        found = np.std((np.roll(image, -1, 1 - k) - np.roll(image, 1, 1 - k))[2:-2, 2:-2] / 2)
        assert found == pytest.approx(expected, rel=0.05)
    if slopes == (0.0, 0.0):
        assert spectrum.contrast == pytest.approx(rig.contrast)


@pytest.mark.parametrize("name", ["affine-4d", "affine-scene-flow", "refined", "depth, 3x3 cameras"])
def test_errors_are_those_of_simulated_estimates(name: str) -> None:
    """Nine windows side by side, twelve noises: the scatter itself is known to 7 % (one standard error)."""
    trial = next(t for t in TRIALS if t.name == name)
    for group, (scatter, bars) in ratios(trial).items():
        assert scatter == pytest.approx(1.0, abs=WITHIN), group
        assert bars == pytest.approx(1.0, abs=WITHIN), group


def test_errors_follow_noise_and_contrast() -> None:
    """Errors are in proportion to noise over contrast as long as there is little noise."""
    config = load_config(overrides=SMALL)
    one, noisy, strong = (plan_rig(r, config).errors for r in (
        RIG, replace(RIG, noise=2.0), replace(RIG, contrast=40.0, noise=2.0)
    ))  # fmt: skip
    for name, error in one.items():
        assert noisy[name] == pytest.approx(2 * error, rel=0.02)
        assert strong[name] == pytest.approx(error, rel=0.02)


def test_geometry_of_a_rig() -> None:
    rig = replace(RIG, rows=3, baseline_mm=(0.5, -1.0))
    assert rig.disparity == (-13.5, 27.0)
    assert rig.preshift == (-14, 27)
    low, high = rig.depth_range_mm
    assert (low, high) == (pytest.approx(2700 / 28), pytest.approx(2700 / 26))
    assert rig.mm_per_px == pytest.approx(100 / 2700)
    assert replace(RIG, cols=1).disparity == (0.0, 0.0)


def test_choices_are_what_geometry_says() -> None:
    config = load_config(overrides=SMALL)
    found = improvements(plan_rig(RIG, config), config)
    better = {choice.name: choice.better for choice in found}
    assert 1.8 < better["twice the baseline"]["depth"] < 2.2  # another fraction of a pixel remains
    halved = next(values for name, values in better.items() if name.startswith("half the noise"))
    assert all(value == pytest.approx(2.0, rel=0.03) for value in halved.values())
    assert [c.overall for c in found] == sorted((c.overall for c in found), reverse=True)
    assert any("refine" in name for name in better)


def test_an_upright_surface_is_determined() -> None:
    """Its exact tensor has no rotation about X and Y in it; the smallest slope has."""
    errors = plan_rig(replace(RIG, slopes=(0.0, 0.0)), load_config(overrides=SMALL)).errors
    assert all(np.isfinite(list(errors.values())))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"noise": 0.0}, "noise = 0: must be positive"),
        ({"distance_mm": -1.0}, "distance = -1: must be positive"),
        ({"wavelengths_px": (1.0, 8.0)}, "wavelengths 1 to 8 px: give the shortest, at least 2 px"),
        ({"wavelengths_px": (8.0, 4.0)}, "then a longer one"),
        ({"baseline_mm": (0.0, 1.0)}, "baseline along x = 0 mm with 5 cameras"),
        ({"interval_s": 0.0}, "interval = 0 s"),
    ],
)
def test_senseless_rigs(changes: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        replace(RIG, **changes)


def test_models_without_cameras_are_refused() -> None:
    with pytest.raises(ConfigError, match="model 'flow-affine': rigs are planned for models that measure depth"):
        plan_rig(RIG, load_config(overrides={"model": "flow-affine"}))


COMMAND = ["plan-rig", "--f-mm", "12", "--pitch", "0.0044", "--distance", "100", "--baseline", "0.51", "--cameras", "5",
           "--frames", "5", "--window", "33", "--refine", "0", "--size", "400x300"]  # fmt: skip


def test_command() -> None:
    found = CliRunner().invoke(make_app(), [*COMMAND, "--interval", "60"])
    assert found.exit_code == 0, found.output
    assert "are taken out: depths of" in found.output
    assert "growth_rate" in found.output
    assert "%/h" in found.output
    assert "twice the baseline" in found.output
    values = json.loads(CliRunner().invoke(make_app(), [*COMMAND, "--json"]).output)
    assert values["standard_errors"]["depth"] > 0
    assert values["preshift_px"] == [-14, 0]
    assert len(values["choices"]) > 5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cameras", "3x3x3"], "--cameras 3x3x3: give two numbers"),
        (["--f-px", "100"], "the focal length is given once"),
        (["--slopes", "steep"], "--slopes steep: give two numbers"),
    ],
)
def test_command_refuses(options: list[str], message: str) -> None:
    found = CliRunner().invoke(make_app(), [*COMMAND, *options])
    assert isinstance(found.exception, UsageError)
    assert message in str(found.exception)
