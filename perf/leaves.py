"""Leaves at several depths over a ground, each with its own tilt and motion, in changing light: every leaf beside
itself alone.

What a leaf's pixels are measured to in the whole scene, where others hide it from some cameras and frames and windows
end at its outline, stands against the root mean square error of the same plane without an outline, windows full.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.field import Field
from leafflow_ti.status import Status
from leafflow_ti.synthetic.leaves import LeavesScene, render_image, truth
from leafflow_ti.synthetic.rig import rays_of
from perf.cases import Options
from perf.fields import Array
from perf.figures import Figure, Outcome
from perf.pictures import Panel, draw, status_colours

NAMES = ("depth", "velocity_x", "velocity_y", "velocity_z")
FACTOR = 3.0
"""Root mean square errors of the leaf alone within which a pixel counts as measured like it."""
GOAL = 90.0
"""Of the leaves' pixels [%]."""
HALF_ALONE = 48
"""Pixels around a leaf's middle that are measured of it alone."""
Render = Callable[[int, int, int], Array]


@dataclass(frozen=True)
class Settings:
    """The scene, and options of ``estimate`` beside the common ones."""

    scene: LeavesScene = field(default_factory=lambda: LeavesScene(n_cols=5, n_rows=5, n_frames=5, noise=1.0))
    window: int = 33
    stride: int = 8
    refine: int = 6

    @property
    def options(self) -> dict[str, Any]:
        """Of ``estimate``: five frames, as a window of three frames with filters of three taps needs them."""
        return {
            "model": "affine-scene-flow", "preshift": "adaptive", "brightness": "spatial", "border": "clip",
            "taps_time": "3", "size_time": 3, "window": self.window, "stride": self.stride, "refine": self.refine,
        }  # fmt: skip


def captured(scene: LeavesScene, render: Render) -> Capture:
    """The capture of all images ``render(frame, row, col)`` of a rig like that of the scene."""
    shape = (scene.n_frames, scene.n_rows, scene.n_cols, scene.size[1], scene.size[0])
    images = np.empty(shape, np.float32)
    for key in np.ndindex(shape[:3]):
        images[key] = render(*key)
    return capture_from_array(images, Geometry(scene.f_px, scene.principal, scene.baseline_mm))


def alone(scene: LeavesScene, label: int) -> Render:
    """Images of one leaf's whole plane, without outline, in the scene's light and noise."""
    surface = scene.surfaces[label]

    def render(frame: int, row: int, col: int) -> Array:
        camera, t = scene.camera_position(row, col), scene.time(frame)

        def shade(x: Array, y: Array) -> Array:
            points = surface.intersect(rays_of(x, y), camera, t)
            return np.asarray(np.exp(scene.log_light(points, t)) * surface.albedo(surface.material(points, t)))

        return scene.expose(scene.integrate(shade, scene.supersampling), frame, row, col)

    return render


def exact(scene: LeavesScene, label: int, measured: Field) -> dict[str, Array]:
    """Map -> what the plane of a leaf has at the pixels of a field, seen or not."""
    (px, py), f = scene.principal, scene.f_px
    x, y = np.broadcast_arrays((measured.x - px) / f, ((measured.y - py) / f)[:, None])
    surface = scene.surfaces[label]
    points = surface.intersect(np.stack([x, y, np.ones_like(x)], axis=-1), np.zeros(3), 0.0)
    velocity, _ = surface.point_motion(points)
    return {"depth": points[..., 2]} | {f"velocity_{axis}": velocity[..., i] for i, axis in enumerate("xyz")}


def measure(settings: Settings, out: Path) -> Outcome:
    """The whole scene, and every leaf of it alone."""
    from leafflow_ti.api import estimate

    scene, options = settings.scene, settings.options
    found = estimate(captured(scene, lambda *key: render_image(scene, *key)), **options)
    face = truth(scene)["face"][np.ix_(found.y, found.x)]
    relative = {name: np.full(face.shape, np.nan) for name in NAMES}
    figures = []
    for label in range(1, scene.leaves + 1):
        seen = face == label
        rows, cols = np.nonzero(seen)
        middle = int(np.median(found.x[cols])), int(np.median(found.y[rows]))
        low = [max(0, (n - HALF_ALONE) // settings.stride * settings.stride) for n in middle]
        high = [min(size, n + HALF_ALONE) for n, size in zip(middle, scene.size, strict=True)]
        single = estimate(captured(scene, alone(scene, label)), roi=(*low, *high), **options)
        ok, known, wanted = single.status == Status.OK, exact(scene, label, single), exact(scene, label, found)
        for name in NAMES:
            level = float(np.sqrt(np.nanmean((single[name] - known[name])[ok] ** 2)))
            relative[name][seen] = ((found[name] - wanted[name]) / level)[seen]
            unit = "mm" if name == "depth" else "mm/frame"
            figures.append(Figure(f"leaf {label}, {name}: error of the leaf alone, rms", level, unit))
            share = 100 * float(np.mean(np.abs(relative[name][seen]) <= FACTOR))
            figures.append(Figure(f"leaf {label}, {name}: pixels within {FACTOR:g} of that", share, "%"))
    leaf = face > 0
    for name in NAMES:
        share = 100 * float(np.mean(np.abs(relative[name][leaf]) <= FACTOR))
        note = f"pixels within {FACTOR:g} rms errors of their leaf alone; those without a value count as outside"
        figures.append(Figure(f"all leaves, {name}", share, "%", low=GOAL, note=note))
    every = np.all([np.abs(values[leaf]) <= FACTOR for values in relative.values()], axis=0)
    figures.append(Figure("all leaves, all four at once", 100 * float(every.mean()), "%"))
    for code in (Status.OK, Status.CONTESTED, Status.COARSE):
        figures.append(
            Figure(f"leaf pixels {code.name.lower()}", 100 * float(np.mean(found.status[leaf] == code)), "%")
        )
    panels = [
        Panel("leaves", face.astype(float)),
        Panel("status", status_colours(found.status)),
        Panel("depth [mm]", found["depth"], (float(np.nanmin(found["depth"][leaf])), float(found["depth"].max()))),
        *(Panel(f"{name}: error / rms alone", values, (-6, 6), "RdBu") for name, values in relative.items()),
    ]
    settings_shown = {**options, "scene": asdict(scene)}
    return Outcome(tuple(figures), settings_shown, (), (draw(out / "leaves.png", panels, 4),))


def run(options: Options) -> Outcome:
    """The case; quick: a small scene of three leaves before one row of cameras."""
    settings = Settings()
    if options.quick:
        scene = replace(settings.scene, n_rows=1, size=(161, 121), leaves=2, disparity_px=(3.0, 9.0), supersampling=1)
        settings = Settings(scene, window=21)
    return measure(settings, options.out)
