"""Prefilters: the stage against its twin, in the pipeline, and what they are for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference.prefilter import prefilter
from small_plane import OPTIONS, SCENE, assert_same, capture_of

import leafflow_ti as lf
from leafflow_ti.api import plan_run
from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.config import load_config
from leafflow_ti.errors import ConfigError, InputError
from leafflow_ti.filters import gaussian_radius
from leafflow_ti.stages.prefilter import PREFILTERS, Prefilter
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.plane import render, truth
from leafflow_ti.synthetic.write import write_scene

SIGMA = 2.3
KINDS = tuple(PREFILTERS)


def images() -> np.ndarray:
    """Three images [n, y, x] of positive values, with pixels that are not valid."""
    values = 100 + 40 * np.random.default_rng(3).random((3, 41, 77))
    values[0, 5:9, 30] = np.nan
    values[1, :, :12] = np.nan
    values[2, 20, 20] = np.inf
    return values


def assert_equals_twin(device: Any, kind: str, limit: float) -> None:
    """A block in the middle, one that reaches beyond the images, and another of the same size."""
    block = images()
    wanted = np.stack([prefilter(np.where(np.isfinite(i), i, np.nan), kind, SIGMA) for i in block])
    rows, cols, radius = 13, 30, gaussian_radius(SIGMA)
    stage = Prefilter(device, kind, SIGMA, rows, cols)
    outside = 60
    padded = np.pad(block, ((0, 0), (outside, outside), (outside, outside)), constant_values=np.nan)
    for top, left in ((12, 20), (-4, 60), (12, 20)):
        y, x = top - radius + outside, left - radius + outside
        part = padded[:, y : y + rows + 2 * radius, x : x + cols + 2 * radius].astype(device.real("storage"))
        valid = np.isfinite(part)
        found = stage(np.where(valid, part, 7.0).astype(part.dtype), valid)
        assert found.dtype == part.dtype
        here = padded[:, top + outside : top + outside + rows, left + outside : left + outside + cols]
        there = np.isfinite(here)
        assert there.any()
        assert not found[~there].any()
        shown = np.zeros_like(here)
        inner = np.pad(wanted, ((0, 0), (outside, outside), (outside, outside)))
        shown[:] = inner[:, top + outside : top + outside + rows, left + outside : left + outside + cols]
        scale = 140 if kind == "highpass" else 5  # log 140
        assert np.max(np.abs(found - shown)[there]) <= limit * scale


@pytest.mark.parametrize("kind", KINDS)
def test_prefilter_equals_the_twin(device: Callable, precision: str, kind: str) -> None:
    """Rounding: two passes of 21 terms each, a quotient and a difference; 1e-6 of the largest value in f32."""
    assert_equals_twin(device(precision), kind, {"f32": 1e-6, "f64": 2e-15}[precision])


@pytest.fixture(scope="module")
def holed() -> np.ndarray:
    """Images [t, sy, sx, y, x] with a few pixels that are not finite."""
    values = render(SCENE)
    values[3, 0, 1, 20, 25] = np.nan
    values[7, 0, 4, 30:33, 40] = np.inf
    return values


def capture_with(values: np.ndarray) -> Capture:
    return capture_from_array(values, Geometry(SCENE.f_px, SCENE.principal, SCENE.baseline_mm))


@pytest.mark.parametrize("kind", KINDS)
def test_running_with_a_prefilter_is_running_on_filtered_images(holed: np.ndarray, kind: str) -> None:
    """Filtered by the twin beforehand, each image as a whole, borders and holes included."""
    filtered = np.empty_like(holed)
    for index in np.ndindex(holed.shape[:3]):
        image = holed[index]
        filtered[index] = prefilter(np.where(np.isfinite(image), image, np.nan), kind, 2.5)
    options = {**OPTIONS, "precision": "f64", "border": "clip", "frames": "6:7", "noise": 0.3}
    found = lf.estimate(capture_with(holed), **options, prefilter=kind, sigma_pre=2.5)
    wanted = lf.estimate(capture_with(filtered), **options)
    np.testing.assert_array_equal(found.status, wanted.status)
    for name in wanted:
        if f"{name}_std" in wanted and name != "growth_rate" and not name.startswith("normal"):
            ok = np.isfinite(wanted[name])
            assert ok.sum() > 1000
            np.testing.assert_array_equal(np.isfinite(found[name]), ok)
            difference = np.abs(found[name] - wanted[name])[ok] / wanted[f"{name}_std"][ok]
            assert np.max(difference) < 1e-4, name  # maps are float32


@pytest.mark.parametrize("kind", KINDS)
def test_prefiltered_tiles_and_regions_equal_the_whole(holed: np.ndarray, kind: str) -> None:
    capture, options = capture_with(holed), {**OPTIONS, "prefilter": kind, "sigma_pre": 3.0}
    whole = lf.estimate(capture, 6, **options)
    assert_same(whole, lf.estimate(capture, 6, **options, tile=5))
    region = lf.estimate(capture, 6, **options, roi=(14, 8, 50, 40))
    assert_same(whole, region, (slice(8, 40), slice(14, 50)))


def test_prefiltered_runs_slide_through_time(holed: np.ndarray, tmp_path: Path) -> None:
    capture, options = capture_with(holed), {**OPTIONS, "prefilter": "homomorphic", "sigma_pre": 3.0, "tile": 20}
    lf.run(capture, tmp_path / "out.zarr", load_config(overrides={**options, "frames": "5:8"}))
    store = lf.ResultStore.open(tmp_path / "out.zarr")
    for index, frame in enumerate(store.frames):
        assert_same(store.field(index), lf.estimate(capture, frame, **options))


def test_prefilters_take_uneven_light_away() -> None:
    """Light that grows by 5 % per frame, which a model without brightness takes for motion."""
    light = (BrightnessTerm("t", 1, 0.05),)
    scene = replace(SCENE, noise=0.0, brightness=light, wavelengths_mm=(0.5, 0.5), size=(81, 71))
    exact = truth(scene)["velocity"]
    error = {}
    for kind in ("none", *KINDS):
        options = {**OPTIONS, "window": 21, "sigma": 6, "stride": 4, "prefilter": kind, "sigma_pre": 8.0}
        field = lf.estimate(capture_of(scene), 6, **options)
        ok = field.status == 0
        assert ok.sum() > 50
        v = np.stack([field[f"velocity_{a}"] for a in "xyz"], axis=-1)
        error[kind] = float(np.median(np.linalg.norm(v - exact[np.ix_(field.y, field.x)], axis=-1)[ok]))
    assert all(error[kind] < 0.05 * error["none"] for kind in KINDS), error


@pytest.mark.parametrize("value", [0, -3])
def test_homomorphic_names_the_pixel_without_a_logarithm(value: float) -> None:
    values = np.full((5, 1, 5, 43, 61), 50.0)
    values[2, 0, 3, 17, 22] = value
    options = {**OPTIONS, "prefilter": "homomorphic", "sigma_pre": 2.0}
    message = (
        rf"frame 2, camera row 0, column 3: grey value {value} at pixel x = 22, y = 17: .* choose prefilter highpass"
    )
    with pytest.raises(InputError, match=message):
        lf.estimate(capture_with(values), **options)


def test_homomorphic_names_the_file(tmp_path: Path) -> None:
    dark = replace(SCENE, offset=40.0, amplitude=50.0, bits=8, noise=0.0)
    write_scene(dark, tmp_path / "dark")
    options = {**OPTIONS, "prefilter": "homomorphic"}
    with pytest.raises(InputError, match=r"cam_\d\d/frame_\d\d\d\.tif: grey value 0 at pixel"):
        lf.estimate(tmp_path / "dark" / "capture.toml", **options)
    assert (lf.estimate(tmp_path / "dark" / "capture.toml", **{**options, "prefilter": "highpass"}).status == 0).any()


def test_highpass_leaves_no_grey_value_for_a_brightness_model() -> None:
    capture = capture_of(SCENE)

    def plan(**options: object) -> Any:
        return plan_run(capture, load_config(overrides={**OPTIONS, **options}))

    with pytest.raises(ConfigError, match="brightness 'temporal' is relative to the grey value"):
        plan(prefilter="highpass", brightness="temporal")
    for options in ({"prefilter": "homomorphic", "brightness": "camera"}, {"prefilter": "highpass"}):
        assert f"prefilter   {options['prefilter']}, sigma 8 px" in plan(**options).describe()
    assert plan(prefilter="highpass", sigma_pre=20).bytes > plan(prefilter="highpass").bytes > plan().bytes


@pytest.mark.parametrize(("key", "value"), [("prefilter", "lowpass"), ("sigma_pre", 0), ("sigma_pre", "inf")])
def test_settings_are_checked(key: str, value: object) -> None:
    with pytest.raises(ConfigError, match=rf"filters\.{key} = '{value}'"):
        load_config(overrides={key: value})
