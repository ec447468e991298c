"""Results stores that hold the exact maps of a synthetic scene in every frame, as if a run had measured them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation  # type: ignore[import-untyped]

from leafflow_ti.field import MOTION_NAMES, with_std
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status
from leafflow_ti.synthetic import cube
from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.geometry import rotation_matrix, tangent_axes
from leafflow_ti.synthetic.leaf import LeafScene
from leafflow_ti.synthetic.plane import PlaneScene

Array = NDArray[np.float64]
Scene = PlaneScene | LeafScene | CubeScene

NAMES = ("depth", "slope_x", "slope_y", *MOTION_NAMES[:3], *MOTION_NAMES[6:], "flow_x", "flow_y", "growth_rate")
STEP = 0.01
"""Frames between the positions whose differences are velocity and acceleration."""


def seen(scene: Scene, x: Array, y: Array, t: float) -> Array:
    """World points [..., 3] mm that the middle camera sees at whole pixels ``x``, ``y`` at ``t`` frames; NaN: none."""
    if isinstance(scene, LeafScene):
        return scene.seen(x, y, t)
    rays = np.stack(
        [(x - scene.principal[0]) / scene.f_px, (y - scene.principal[1]) / scene.f_px, np.ones_like(x)], axis=-1
    )
    if isinstance(scene, PlaneScene):
        return scene.intersect(rays, np.zeros(3), t)
    depth = cube.truth(_turned(scene, t))["depth"][y.astype(int), x.astype(int)]
    return np.asarray(depth[..., None] * rays)


def surface_number(scene: Scene, x: Array, y: Array, t: float) -> NDArray[np.int64]:
    """Which smooth surface the middle camera sees at whole pixels ``x``, ``y`` [...] of the image; 0: none."""
    if isinstance(scene, CubeScene):
        return cube.truth(_turned(scene, t))["face"][y.astype(int), x.astype(int)].astype(np.int64)
    return np.isfinite(seen(scene, x, y, t)[..., 2]).astype(np.int64)


def _turned(scene: CubeScene, t: float) -> CubeScene:
    """The scene whose frame in the middle is that at ``t``."""
    rotation, shift = scene.pose(t)
    turned = Rotation.from_matrix(rotation @ rotation_matrix(scene.orientation)).as_rotvec()
    return replace(scene, centre=tuple(rotation @ scene.centre + shift), orientation=tuple(turned))


def pixels(scene: Scene, points: Array) -> tuple[Array, Array]:
    """Where the middle camera sees world points [..., 3], px."""
    px, py = scene.principal
    return px + scene.f_px * points[..., 0] / points[..., 2], py + scene.f_px * points[..., 1] / points[..., 2]


def exact_maps(scene: Scene, x: Array, y: Array, t: float) -> dict[str, Array]:
    """The maps ``NAMES`` [...] at the pixels ``x``, ``y`` [...] at ``t`` frames, NaN where the camera sees nothing."""
    here = seen(scene, x, y, t)
    before, behind = (scene.follow(here, t + h, t) for h in (-STEP, STEP))
    velocity = (behind - before) / (2 * STEP)
    acceleration = (behind - 2 * here + before) / STEP**2
    forward = velocity[..., 2:] * here[..., :2] / here[..., 2:]
    flow = scene.f_px * (velocity[..., :2] - forward) / here[..., 2:]
    zx, zy = _slopes(scene, here, t)
    values = np.concatenate(
        [here[..., 2:], np.stack([zx, zy], axis=-1), velocity, acceleration, flow,
         _growth(scene, here, zx, zy, t)[..., None]], axis=-1,
    )  # fmt: skip
    return {name: values[..., k] for k, name in enumerate(NAMES)}


def _slopes(scene: Scene, points: Array, t: float) -> tuple[Array, Array]:
    """Of the surface at world points [..., 3]: normals that are carried along with the material."""
    if isinstance(scene, CubeScene):
        whole = cube.truth(_turned(scene, t))
        x, y = (np.nan_to_num(np.rint(at)).astype(int) for at in pixels(scene, points))
        return whole["zx"][y, x], whole["zy"][y, x]
    if isinstance(scene, LeafScene):
        at = scene.slopes((scene.material(points, t) @ scene.axes)[..., :2])
    else:
        at = tuple(np.full(points.shape[:-1], slope) for slope in (scene.zx, scene.zy))
    normal = np.stack([-at[0], -at[1], np.ones_like(at[0])], axis=-1)
    turned = normal @ np.linalg.inv(scene.deformation(t)) @ scene.pose(t)[0].T
    return -turned[..., 0] / turned[..., 2], -turned[..., 1] / turned[..., 2]


def _growth(scene: Scene, points: Array, zx: Array, zy: Array, t: float) -> Array:
    """Growth of the area [...] in %/frame, from half a frame before to half a frame after."""
    axes = np.moveaxis(tangent_axes(zx, zy), -1, 0)
    areas = [
        np.linalg.norm(np.cross(*(scene.follow(points + axis, t + h, t) - scene.follow(points, t + h, t)
                                  for axis in axes)), axis=-1)
        for h in (-0.5, 0.5)
    ]  # fmt: skip
    return np.asarray(100 * (areas[1] / areas[0] - 1))


def exact_store(
    scene: Scene, path: Path, frames: Sequence[int], stride: int = 4, std: float = 1e-6, **options: Any
) -> ResultStore:
    """A finished store of the exact maps of ``frames``, at every ``stride``-th pixel; all standard errors ``std``."""
    x, y = (np.arange(0, n, stride) for n in scene.size)
    across, down = (a.astype(float) for a in np.meshgrid(x, y))
    names = with_std(NAMES)
    plan = {"f_px": scene.f_px, "principal_px": list(scene.principal), "baseline_mm": list(scene.baseline_mm),
            "noise_correlation": {axis: [1.0] for axis in "xyt"}}  # fmt: skip
    store = ResultStore.create(
        path, frames=frames, y=y, x=x, names=names, chunk=(1, y.size, x.size), attrs={"plan": plan}, **options
    )
    for index, frame in enumerate(frames):
        maps = exact_maps(scene, across, down, scene.time(frame))
        known = np.isfinite(maps["depth"])
        values = {name: maps[name].astype(np.float32) for name in NAMES}
        errors = {f"{name}_std": np.where(known, std, np.nan).astype(np.float32) for name in NAMES}
        status = np.where(known, Status.OK, Status.NO_STRUCTURE).astype(np.uint8)
        store.write_unit(index, index, slice(0, y.size), values | errors, status)
    return store
