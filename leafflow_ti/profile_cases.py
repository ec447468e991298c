"""Synthetic captures for measurements of speed, as data: the same work on every machine, no input needed."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.plane import PlaneScene, render, sinusoid_scene

_WINDOW = 9
"""Frames that one measurement takes: 5 samples under filters of 5 taps."""
_OUTPUT = 300
_PIXELS = (506, 384)
"""Width and height of images that hold the output, windows of 65 pixels around it, and the preshift of nine cameras."""
_REGION = f"output.roi=[{(_PIXELS[0] - _OUTPUT) // 2}, {(_PIXELS[1] - _OUTPUT) // 2}, " \
          f"{(_PIXELS[0] + _OUTPUT) // 2}, {(_PIXELS[1] + _OUTPUT) // 2}]"  # fmt: skip
_COMMON = ("preshift=[-14, 0]", _REGION, "window.size=65")


@dataclass(frozen=True)
class Case:
    """One capture and the settings it is measured with: ``"a.b=v"``, as ``--set`` takes them."""

    summary: str
    scene: PlaneScene
    settings: tuple[str, ...]

    def capture(self, frames: int) -> Capture:
        """The scene in memory, with as many frames as ``frames`` measurements take; one frame if it is static."""
        scene = self.scene if self.scene.n_frames == 1 else replace(self.scene, n_frames=frames + _WINDOW - 1)
        images = render(scene).astype(np.float32)
        return capture_from_array(images, Geometry(scene.f_px, scene.principal, (scene.baseline_mm[0], 0.0)))


_SCENE = sinusoid_scene(noise=2.5, size=_PIXELS)

CASES: dict[str, Case] = {
    "affine-4d": Case(
        "nine cameras, windows of 65 px, 300 x 300 output pixels", _SCENE, ("model.name=affine-4d", *_COMMON)
    ),
    "affine-4d-stride4": Case(
        "the same, every fourth pixel", _SCENE, ("model.name=affine-4d", "window.stride=4", *_COMMON)
    ),
    "affine-scene-flow": Case(
        "the default model on the same capture, without its refinement",
        _SCENE,
        ("model.name=affine-scene-flow", "refine.steps=0", *_COMMON),
    ),
    "refined": Case(
        "the same with it: three steps at every sixteenth pixel, windows thinned by 3",
        _SCENE,
        ("model.name=affine-scene-flow", "refine.steps=3", "refine.thin=3", "window.stride=16", *_COMMON),
    ),
    "depth": Case(
        "depth and normals from one frame of it", replace(_SCENE, n_frames=1), ("model.name=depth", *_COMMON)
    ),
}


def find_case(name: str) -> Case:
    """The case of this name; raises UsageError for another."""
    if name not in CASES:
        raise UsageError(f"--case {name}: there is no such case; choose {', '.join(CASES)}")
    return CASES[name]
