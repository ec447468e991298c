"""Material followed over 60 frames: where the points end, and how much their surface has grown, against exact scenes.

Once on the exact maps of every frame, which tests the tracking alone, and once on what is measured in images with
noise, rounded to 8 bits. Places, growth and strain of the scenes' material are exact at any time. Points are those
whose window shows one surface alone in the first and in the last frame.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.cumulative import track_growth
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status
from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.leaf import LeafScene
from leafflow_ti.synthetic.scene import render_image
from leafflow_ti.tracking import track
from leafflow_ti.tracks import Tracks
from perf.cases import Options
from perf.exact_stores import Array, Scene, exact_maps, exact_store, pixels, seen, surface_number
from perf.figures import Figure, Outcome

DRIFT_PX, GROWTH_PERCENT = 0.05, 1.0
"""Goals: distance from the true place [px]; error of the cumulative growth, in % of its value."""
MARGIN = 4
"""Frames at either end of a sequence that a measurement takes beyond its own."""


@dataclass(frozen=True)
class Settings:
    """``frames``: that are measured; the images are ``2 MARGIN`` more. The scenes' noise is ``noise`` grey values."""

    leaf: LeafScene
    cube: CubeScene
    frames: int = 60
    noise: float = 1.0
    window: int = 33
    stride: int = 10

    def scenes(self) -> dict[str, Scene]:
        """The scenes, as long as they are to be."""
        length: dict[str, Any] = {"n_frames": self.frames + 2 * MARGIN, "noise": self.noise}
        return {"growing leaf": replace(self.leaf, **length), "rotating cube": replace(self.cube, **length)}

    @property
    def measured(self) -> range:
        """Indices of the frames that are measured."""
        return range(MARGIN, MARGIN + self.frames)


@dataclass(frozen=True, eq=False)
class Errors:
    """Of the points that are known in the last frame: distance from the true place [n] px, the ``bound`` on it, growth
    of the area [n] %, as measured and as it is, with its standard error; the same by the places of the points."""

    distance: Array
    bound: Array
    growth: Array
    growth_std: Array
    by_places: Array
    true: Array


def errors(scene: Scene, store: ResultStore, tracks: Tracks) -> Errors:
    """The tracks against the scene's material, in the last frame."""
    begin, end = (scene.time(int(t)) for t in (tracks.start, tracks.frames[-1]))
    x, y = tracks.x[tracks.start_index], tracks.y[tracks.start_index]
    before = seen(scene, x, y, begin)
    true_x, true_y = pixels(scene, scene.follow(before, end, begin))
    maps = exact_maps(scene, x, y, begin)
    along = np.stack([np.ones_like(x), np.zeros_like(x), maps["slope_x"]], axis=-1)
    down = np.stack([np.zeros_like(x), np.ones_like(x), maps["slope_y"]], axis=-1)
    areas = [
        np.linalg.norm(np.cross(*(scene.follow(before + v, t, begin) - scene.follow(before, t, begin)
                                  for v in (along, down))), axis=-1)
        for t in (begin, end)
    ]  # fmt: skip
    known = tracks.known[-1] & np.isfinite(before[:, 2])
    found = track_growth(store, tracks).variables
    values = (
        np.hypot(tracks.x[-1] - true_x, tracks.y[-1] - true_y), tracks.drift[-1], found["growth"][-1],
        found["growth_std"][-1], found["place_growth"][-1], 100 * (areas[1] / areas[0] - 1),
    )  # fmt: skip
    return Errors(*(v[known] for v in values))


def measured_store(scene: Scene, path: Path, settings: Settings) -> ResultStore:
    """What is measured in the images of a scene."""
    from leafflow_ti.config import load_config
    from leafflow_ti.runs import run

    shape = (scene.n_frames, scene.n_rows, scene.n_cols, scene.size[1], scene.size[0])
    images = np.empty(shape, np.float32)
    for key in np.ndindex(shape[:3]):
        images[key] = render_image(scene, *key)
    capture = capture_from_array(images, Geometry(scene.f_px, scene.principal, scene.baseline_mm))
    run(capture, path, load_config(overrides={"window": settings.window, "stride": settings.stride}))
    return ResultStore.open(path)


def followed(scene: Scene, store: ResultStore, window: int) -> Tracks:
    """All pixels with the status ok of the first frame, followed to the last; of these, points whose window shows one
    surface alone in both."""
    rows, cols = np.nonzero(store.read("status", 0) == Status.OK)
    x, y = store.x[cols].astype(float), store.y[rows].astype(float)
    begin, end = (scene.time(store.frames[k]) for k in (0, -1))
    tracks = track(store, x, y)
    last = pixels(scene, scene.follow(seen(scene, x, y, begin), end, begin))
    return tracks.chosen(_alone(scene, x, y, begin, window // 2) & _alone(scene, *last, end, window // 2))


def _alone(scene: Scene, x: Array, y: Array, t: float, half: int) -> NDArray[np.bool_]:
    """Which of the image positions [n] have the same surface ``half`` px around them, as far as the image goes."""

    def surface(dx: int, dy: int) -> NDArray[np.int64]:
        places = (np.clip(np.rint(np.nan_to_num(at + by)), 0, n - 1) for at, by, n in
                  ((x, dx, scene.size[0]), (y, dy, scene.size[1])))  # fmt: skip
        return surface_number(scene, *places, t)

    here = surface(0, 0)
    around = ((half, 0), (-half, 0), (0, half), (0, -half))
    return np.asarray((here > 0) & np.all([surface(*by) == here for by in around], axis=0))


def figures(name: str, e: Errors) -> list[Figure]:
    """Of one scene; what grows by nothing has no relative error."""
    grown = float(np.mean(e.true))
    scale, unit = (100 / grown, "% of it") if abs(grown) > 1e-6 else (1.0, "%")
    miss = (e.growth - e.true) * scale
    known = np.isfinite(miss)
    limit = GROWTH_PERCENT if abs(grown) > 1e-6 else None
    found = [
        Figure(f"{name}: points followed to the end", e.distance.size),
        Figure(f"{name}: distance from the true place, median", float(np.median(e.distance)), "px"),
        Figure(f"{name}: 95 % of the points", float(np.quantile(e.distance, 0.95)), "px", DRIFT_PX),
        Figure(f"{name}: all points", float(e.distance.max()), "px"),
        Figure(f"{name}: bound on it, median", float(np.median(e.bound)), "px"),
        Figure(f"{name}: true growth of the area", grown, "%"),
        Figure(f"{name}: growth by the rates, median error", float(np.median(np.abs(miss[known]))), unit, limit),
        Figure(f"{name}: 95 % of the points", float(np.quantile(np.abs(miss[known]), 0.95)), unit),
        Figure(f"{name}: mean over the points", abs(float(miss[known].mean())), unit, limit),
    ]
    by_places = ((e.by_places - e.true) * scale)[np.isfinite(e.by_places)]
    found.append(Figure(f"{name}: growth by the places, median error", float(np.median(np.abs(by_places))), unit))
    return found


def noise_figures(name: str, e: Errors) -> list[Figure]:
    """Whether bounds and standard errors are true, of one scene that was measured."""
    within = 100 * float(np.mean(e.distance <= e.bound))
    z = (e.growth - e.true) / e.growth_std
    return [
        Figure(f"{name}: points within their bound", within, "%", low=95.0),
        Figure(f"{name}: growth within its standard error", 100 * float(np.mean(np.abs(z[np.isfinite(z)]) <= 1)), "%"),
    ]


def measure(settings: Settings) -> Outcome:
    """All scenes, on exact maps and on images."""
    found: list[Figure] = []
    with tempfile.TemporaryDirectory() as folder:
        for number, (name, scene) in enumerate(settings.scenes().items()):
            store = exact_store(scene, Path(folder) / f"exact-{number}.zarr", settings.measured, settings.stride)
            found += figures(f"{name}, exact maps", errors(scene, store, followed(scene, store, settings.window)))
            store = measured_store(scene, Path(folder) / f"measured-{number}.zarr", settings)
            e = errors(scene, store, followed(scene, store, settings.window))
            found += [*figures(f"{name}, images", e), *noise_figures(f"{name}, images", e)]
    shown = {name: f"{scene.size[0]} x {scene.size[1]} px, {scene.n_cols} cameras, {scene.n_frames} images each"
             for name, scene in settings.scenes().items()}  # fmt: skip
    rest = {name: getattr(settings, name) for name in ("frames", "noise", "window", "stride")}
    return Outcome(tuple(found), shown | rest)


def run(options: Options) -> Outcome:
    """The case; quick: a few frames."""
    leaf = LeafScene(
        size=(281, 221), half_mm=(4.2, 3.2), n_cols=5, velocity=(0.015, -0.012, 0.02), omega=(0.0015, 0.002, 0.0015)
    )
    cube = CubeScene(size=(321, 121), n_cols=5, velocity=(0.0, 0.0, 0.0), supersampling=3)
    settings = Settings(leaf, cube)
    if options.quick:
        settings = replace(settings, leaf=replace(leaf, supersampling=2), cube=replace(cube, supersampling=2), frames=4)
    return measure(settings)
