"""Shifts that follow each pixel: exact scenes at any speed and disparity, what is chosen by itself, masks and gaps.

The scenes are tilted, turning, approaching planes with noise fixed to them. Residual flows are alike at all speeds, so
the errors must be, too: those of the affine parameters show whether the warp of the images was undone rightly.
"""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

import leafflow_ti as lf
from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.stages import estimate_tables
from leafflow_ti.status import Status
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.plane import PlaneScene, render, truth

Maps = dict[str, np.ndarray]
F_PX, DEPTH_MM = 900.0, 80.0
GRIDS = {"one": (1, 1), "row": (5, 1), "square": (3, 3)}
SIZE = (157, 93)
ROI = (66, 34, 92, 60)
"""Its windows stay within the images at 20 px/frame."""
OPTIONS: dict[str, object] = {
    "window": 27, "sigma": 8.0, "size_time": 3, "taps_time": "3", "stride": 4, "refine": 0, "precision": "f32",
    "border": "clip", "preshift": "adaptive", "roi": ROI,
}  # fmt: skip
SPEEDS = (0.1, 1.3, 3.3, 8.2, 20.3)
"""px/frame along x; at the last ones windows move over 80 px of the images."""
LIGHT = (BrightnessTerm("t", 1, 0.01, 0.004, -0.003), BrightnessTerm("t", 2, -0.001))


def scene_of(speed: float, grid: str = "row", baseline_mm: float = 0.7, **changes: object) -> PlaneScene:
    """A plane that moves ``speed`` px/frame along x and four tenths of it back along y, at 8 px/step."""
    across = speed * DEPTH_MM / F_PX
    cols, rows = GRIDS[grid]
    scene = PlaneScene(
        f_px=F_PX, baseline_mm=(baseline_mm, baseline_mm), n_cols=cols, n_rows=rows, n_frames=5, size=SIZE,
        centre=(0.3, -0.2, DEPTH_MM), zx=0.3, zy=-0.2, velocity=(across, -0.4 * across, 0.1),
        omega=(0.004, -0.006, 0.008), texture="noise", wavelengths_mm=(0.5, 1.8), offset=110.0, amplitude=30.0,
        noise=0.5, supersampling=2,
    )  # fmt: skip
    return replace(scene, **changes)


def capture_of(scene: PlaneScene) -> Capture:
    return capture_from_array(render(scene), Geometry(scene.f_px, scene.principal, scene.baseline_mm))


@functools.cache
def captured(scene: PlaneScene) -> Capture:
    """Rendered once for all models."""
    return capture_of(scene)


def exact(scene: PlaneScene) -> Maps:
    """Map -> its values [H, W]."""
    known = truth(scene)
    shape = known["depth"].shape
    maps = {"depth": known["depth"], "slope_x": known["zx"], "slope_y": known["zy"]}
    for name, key in (("flow",) * 2, ("velocity",) * 2, ("rotation", "omega"), ("acceleration",) * 2):
        vectors = np.broadcast_to(known[key], (*shape, known[key].shape[-1]))
        maps |= {f"{name}_{axis}": vectors[..., i] for i, axis in enumerate("xyz"[: vectors.shape[-1]])}
    if scene.brightness:
        slow, _ = scene.brightness
        points = scene.material(known["depth"][..., None] * scene.rays(), 0.0)
        maps["brightness_t"] = slow.g + slow.gx * points[..., 0] + slow.gy * points[..., 1]
        maps |= {f"brightness_world_{axis}": np.full(shape, g) for axis, g in (("x", slow.gx), ("y", slow.gy))}
    return {name: np.broadcast_to(values, shape) for name, values in maps.items()}


def errors(field: lf.Field, maps: Maps) -> Maps:
    """Map -> errors of the pixels that were measured."""
    there, ok = np.ix_(field.y, field.x), field.status == Status.OK
    return {name: (field[name] - values[there])[ok] for name, values in maps.items() if name in field}


def deviations(field: lf.Field, maps: Maps) -> dict[str, float]:
    """Map -> root mean square of the errors in standard errors."""
    ok = field.status == Status.OK
    found = errors(field, maps)
    return {name: float(np.sqrt(np.mean((e / field[f"{name}_std"][ok]) ** 2))) for name, e in found.items()}


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


MODELS: dict[str, tuple[str, dict[str, object]]] = {
    "flow-affine": ("one", {}),
    "affine": ("row", {}),
    "affine-4d": ("row", {"motion": "acceleration"}),
    "affine-5d": ("square", {"motion": "acceleration"}),
    "scene-flow": ("row", {}),
    "affine-scene-flow": ("row", {"motion": "acceleration"}),
}


@pytest.mark.parametrize("model", list(MODELS))
def test_every_model_is_as_exact_at_any_speed(model: str) -> None:
    """In standard errors: filters and interpolation leave up to 2.9 at a tenth of a pixel per frame, too."""
    grid, options = MODELS[model]
    still = {"omega": (0.0, 0.0, 0.0)} if model == "scene-flow" else {}
    seen = {}
    for speed in SPEEDS:
        scene = scene_of(speed, grid, **still)
        field = lf.estimate(captured(scene), model=model, **options, **OPTIONS)
        assert (field.status == Status.OK).all()
        maps = exact(scene)
        seen[speed] = errors(field, maps)
        for name, size in deviations(field, maps).items():
            assert size < 3.5, (name, speed)
    for speed in SPEEDS[1:]:
        for name in ("flow_x", "flow_y"):
            assert rms(seen[speed][name]) < 3 * rms(seen[SPEEDS[0]][name]) + 5e-4, (name, speed)
        if "slope_x" in seen[speed]:
            # Where depth is concerned a faster scene is another one, of the same kind.
            for name in ("depth", "slope_x", "slope_y"):
                assert rms(seen[speed][name]) < 4 * rms(seen[SPEEDS[0]][name]), (name, speed)


def test_constant_flow_at_any_speed() -> None:
    """``flow`` takes a mean over the window, whatever the speed: its errors are the flow's own gradient."""
    seen = []
    for speed in SPEEDS:
        scene = scene_of(speed, "one")
        field = lf.estimate(captured(scene), model="flow", **OPTIONS)
        assert (field.status == Status.OK).all()
        seen.append([rms(e) for e in errors(field, exact(scene)).values()])
    assert np.max(seen) < 2 * np.max(seen[0]) < 0.05


@pytest.mark.parametrize("speed", [8.2, 20.3])
def test_derivatives_are_those_of_a_place_that_stands_still(speed: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the test above is worth: with derivatives along time left as the moved images have them it fails."""
    monkeypatch.setattr(estimate_tables, "_sheared", lambda columns: [])
    scene = scene_of(speed)
    options = {**OPTIONS, "window": 29}  # tables of their own, not those that another test left
    field = lf.estimate(captured(scene), model="affine-4d", motion="acceleration", **options)
    lf.release()
    found = deviations(field, exact(scene))
    assert max(found["acceleration_x"], found["acceleration_y"]) > 10


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("model", ["affine-4d", "affine-scene-flow"])
def test_changing_light_at_any_speed(model: str, speed: float) -> None:
    scene = scene_of(speed, brightness=LIGHT)
    maps = exact(scene)
    field = lf.estimate(captured(scene), model=model, brightness="spatial", **OPTIONS)
    found = deviations(field, maps)
    assert {"brightness_t", "brightness_world_x", "brightness_world_y"} <= set(found)
    assert max(found.values()) < 4.0
    assert rms(errors(field, maps)["brightness_t"]) < 2e-4


@pytest.mark.parametrize(("grid", "baseline_mm"), [("row", 0.2), ("row", 1.3), ("row", 2.6), ("square", 1.3)])
def test_depth_at_any_disparity(grid: str, baseline_mm: float) -> None:
    """2 to 29 px per step."""
    scene = scene_of(0.0, grid, baseline_mm, size=(201, 151), n_frames=1)
    roi = (60, 50, 120, 100)
    field = lf.estimate(captured(scene), model="depth", **{**OPTIONS, "roi": roi})
    assert (field.status == Status.OK).all()
    found = errors(field, exact(scene))
    # Half a hundredth of a pixel of disparity, whose size is f b / Z.
    assert rms(found["depth"]) < 0.005 * DEPTH_MM**2 / (F_PX * baseline_mm)
    # A tenth of a pixel, across as many pixels as the focal length has.
    for name in ("slope_x", "slope_y"):
        assert rms(found[name]) < 0.1 * DEPTH_MM / (F_PX * baseline_mm) + 0.003


def test_refined_values_at_any_speed() -> None:
    for speed in (0.1, 8.2):
        scene = scene_of(speed)
        field = lf.estimate(captured(scene), model="affine-scene-flow", **{**OPTIONS, "refine": 4, "stride": 8})
        assert (field.status == Status.OK).all()
        for name, size in deviations(field, exact(scene)).items():
            assert size < 3.5, (name, speed)


def test_stated_offsets_are_part_of_depths() -> None:
    """Images moved by 5.4 px from camera to camera: labels follow what is seen, depths what is stated; also those of
    the search, beside the images' border."""
    offset, scene = -5.4, scene_of(0.0, baseline_mm=1.3, n_frames=1)
    (x, y), images = scene.principal, []
    for col in range(scene.n_cols):
        moved = replace(scene, principal_px=(x - offset * (col - scene.n_cols // 2), y))
        images.append(render(moved, cameras=([0], [col])))
    geometry = Geometry(F_PX, scene.principal, scene.baseline_mm, (offset, 0.0))
    capture = capture_from_array(np.concatenate(images, axis=2), geometry)
    field = lf.estimate(capture, model="depth", **{**OPTIONS, "roi": (0, 0, *SIZE)})
    true = exact(scene)["depth"][np.ix_(field.y, field.x)]
    ok, coarse = (field.status == code for code in (Status.OK, Status.COARSE))
    assert ok.mean() > 0.5
    assert rms((field["depth"] / true - 1)[ok]) < 5e-4
    assert coarse.sum() > 20
    # A quarter of a pixel of 14.6.
    assert np.median(np.abs(field["depth"] / true - 1)[coarse]) < 0.02
