"""What every kind of scene offers: one image of it, and its truth."""

from __future__ import annotations

from types import ModuleType

from leafflow_ti.synthetic import cube, leaf, leaves, plane
from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.geometry import Array
from leafflow_ti.synthetic.leaf import LeafScene
from leafflow_ti.synthetic.leaves import LeavesScene
from leafflow_ti.synthetic.plane import PlaneScene

SingleScene = PlaneScene | CubeScene
"""One object, which stays where it is when another part of its image is looked at."""
Scene = SingleScene | LeafScene | LeavesScene

_MODULES: dict[type, ModuleType] = {PlaneScene: plane, CubeScene: cube, LeafScene: leaf, LeavesScene: leaves}


def render_image(scene: Scene, frame: int, row: int, col: int) -> Array:
    """One exposed image [H, W], as of the scene's own module."""
    image: Array = _MODULES[type(scene)].render_image(scene, frame, row, col)
    return image


def truth(scene: Scene) -> dict[str, Array]:
    """What the middle camera sees at the middle frame, as of the scene's own module."""
    maps: dict[str, Array] = _MODULES[type(scene)].truth(scene)
    return maps
