"""The scenes of the experiments: what is rendered once, the images with noise, the truth and the regions."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.metrics import Mask, erode
from leafflow_ti.synthetic import cube, plane
from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.plane import PlaneScene, sinusoid_scene
from perf.dissertation.experiment import Scene

Array = NDArray[Any]

FACES = {"left": 1, "right": 2}
"""Region -> label of the cube's face: left is inclined 60° to the image plane, right 30°."""

REGION_PX = 33
"""Side of the evaluated middle of a sinusoid."""

DIRECTION = np.array([2.0, 3.0, 2.0]) / math.sqrt(17.0)
"""Axis of the sinusoid's rotation."""


def sinusoid(windows: int = 1, shift_px: int = 14, rows: int = 1, **changes: Any) -> PlaneScene:
    """The sinusoid of section 5.3 with ``changes``, in images just large enough for the evaluated region.

    ``windows``: how many 65-pixel windows follow one another; ``shift_px``: preshift per camera step.
    """
    across = REGION_PX + 2 * (34 * windows + 8)
    along = across + 8 * abs(shift_px)
    return replace(sinusoid_scene(size=(along, along if rows > 1 else across)), n_rows=rows, **changes)


def middle(scene: Scene) -> tuple[int, int, int, int]:
    """The evaluated region x0, y0, x1, y1 of a sinusoid."""
    x, y = ((n - REGION_PX) // 2 for n in scene.size)
    return x, y, x + REGION_PX, y + REGION_PX


def rotation(degrees: float) -> tuple[float, float, float]:
    """Rotation vector [rad/frame] of the sinusoid, by its angle per frame."""
    x, y, z = (math.radians(degrees) * DIRECTION).tolist()
    return x, y, z


@lru_cache(maxsize=2)
def _clean(scene: Scene) -> Array:
    return plane.render(scene) if isinstance(scene, PlaneScene) else cube.render(scene)


def capture(scene: Scene, seed: int) -> Capture:
    """The images of a scene, rendered once without noise and real; every seed exposes them with its own."""
    clean, exposed = _clean(replace(scene, noise=0.0, seed=0, bits=None)), replace(scene, seed=seed)
    images = np.stack([exposed.expose(image, *at) for at, image in _each(clean)]).reshape(clean.shape)
    if scene.bits == 8:
        images = images.astype(np.uint8)
    step = (scene.baseline_mm[0], scene.baseline_mm[1] if scene.n_rows > 1 else 0.0)
    return capture_from_array(images, Geometry(scene.f_px, scene.principal, step), bits=scene.bits)


def _each(images: Array) -> list[tuple[tuple[int, int, int], Array]]:
    return [((t, row, col), images[t, row, col]) for t, row, col in np.ndindex(*images.shape[:3])]


@lru_cache(maxsize=4)
def _truth(scene: Scene) -> Mapping[str, Array]:
    found = cube.truth(scene) if isinstance(scene, CubeScene) else plane.truth(scene) | brightness(scene)
    known = np.isfinite(found["depth"])
    found["omega"] = np.where(known[..., None], found["omega"], np.nan)
    return found


def truth(scene: Scene) -> Mapping[str, Array]:
    """Maps [H, W, ...] of what the reference camera sees: those of ``metrics``, and the brightness of a plane by the
    names of the results."""
    return _truth(replace(scene, noise=0.0))


def brightness(scene: PlaneScene) -> dict[str, Array]:
    """Temporal brightness changes [H, W] of the material point seen at each pixel (4.27): ``h = g t + g2 t² + ...``"""
    offsets = scene.material(scene.intersect(scene.rays(), np.zeros(3), 0.0), 0.0)
    maps = {name: np.zeros(offsets.shape[:-1]) for name in ("t", "world_x", "world_y", "world_tt")}
    for term in scene.brightness:
        value = term.g + term.gx * offsets[..., 0] + term.gy * offsets[..., 1]
        if (term.axis, term.power) == ("t", 1):
            maps["t"] += value
            maps["world_x"] += term.gx
            maps["world_y"] += term.gy
        elif (term.axis, term.power) == ("t", 2):
            maps["world_tt"] += 2.0 * value
    return {f"brightness_{name}": values for name, values in maps.items()}


def regions(scene: Scene, margin_px: int) -> dict[str, Mask]:
    """Where errors are averaged, masks [H, W]: all of a plane; of a cube each face, ``margin_px`` inside its border."""
    if isinstance(scene, PlaneScene):
        return {"all": np.ones(scene.size[::-1], np.bool_)}
    return _faces(scene, margin_px)


@lru_cache(maxsize=8)
def _faces(scene: CubeScene, margin_px: int) -> dict[str, Mask]:
    face = truth(scene)["face"]
    return {name: erode(face == label, margin_px) for name, label in FACES.items()}
