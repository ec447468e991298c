"""What every kind of scene offers: one image of it, and its truth."""

from __future__ import annotations

from leafflow_ti.synthetic import cube, plane
from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.geometry import Array
from leafflow_ti.synthetic.plane import PlaneScene

Scene = PlaneScene | CubeScene


def render_image(scene: Scene, frame: int, row: int, col: int) -> Array:
    """One exposed image [H, W], as of the scene's own module."""
    if isinstance(scene, PlaneScene):
        return plane.render_image(scene, frame, row, col)
    return cube.render_image(scene, frame, row, col)


def truth(scene: Scene) -> dict[str, Array]:
    """What the middle camera sees at the middle frame, as of the scene's own module."""
    return plane.truth(scene) if isinstance(scene, PlaneScene) else cube.truth(scene)
