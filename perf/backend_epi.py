"""Disparity of nine views: ``backend.epi_disparity`` beside the ``structure-tensor`` package on the same noisy views.

Of the package, the disparity is the slope of the eigenvector of the smallest eigenvalue at the middle view, of the 3D
tensor of the stack, or of the 2D tensors of all epipolar plane images. Every sigma and rho of a grid is tried and the
one of least error taken, by the truth; what it finds beyond 2 px/view is cut off, as outliers would decide otherwise.
Ours has the window of its default; beside it stands the Gaussian of the package's best rho. Errors are those of the
pixels at least ``BORDER`` px from the image border.
"""

from __future__ import annotations

import importlib
import importlib.util
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from leafflow_ti.synthetic.affine_images import affine_images
from perf.cases import Options
from perf.fields import Array
from perf.figures import Figure, Outcome

GOAL = 0.004
VIEWS = 9
BORDER = 12
LIMIT = 2.0
SIGMAS, RHOS = (0.5, 0.7, 1.0, 1.5), (1.0, 1.5, 2.0, 3.0, 4.0, 6.0)


@dataclass(frozen=True)
class Settings:
    """``shape`` of a view; ``noise`` as a part of 255 grey values, the texture's standard deviation being 40."""

    shape: tuple[int, int] = (256, 256)
    noise: float = 0.01
    repeats: int = 5


@dataclass(frozen=True)
class Scene:
    """Disparity [px/view] in the middle, and how it changes along x from border to border."""

    name: str
    disparity: float
    ramp: float


SCENES = (Scene("facing the cameras", 0.37, 0.0), Scene("slanted, -1 to 1 px/view", 0.0, 2.0))


def made(scene: Scene, settings: Settings) -> tuple[Array, Array]:
    """Views [s, y, x], float32, and the disparity [y, x] of the middle one."""
    levers = np.arange(float(VIEWS)) - VIEWS // 2
    slope = scene.ramp / settings.shape[1]
    gradient = np.array([[slope, 0.0], [0.0, 0.0]])
    views, flow = affine_images(settings.shape, levers, (scene.disparity, 0.0), gradient, settings.noise)
    return views.astype(np.float32), flow[0]


def rmse(found: Array, truth: Array) -> float:
    """Of the inner pixels; disparities beyond LIMIT are cut off, what is not a number counts as 0."""
    inner = (slice(BORDER, -BORDER), slice(BORDER, -BORDER))
    error = np.clip(np.nan_to_num(found, posinf=LIMIT, neginf=-LIMIT), -LIMIT, LIMIT) - truth
    return float(np.sqrt(np.mean(np.square(error[inner], dtype=np.float64))))


def of_stack(views: Array, sigma: float, rho: float) -> Array:
    """By the 3D tensor; its eigenvectors are (x, y, s)."""
    package: Any = importlib.import_module("structure_tensor")
    _, vector = package.eig_special_3d(package.structure_tensor_3d(views, sigma, rho))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((vector[0] / vector[2])[VIEWS // 2])


def of_slices(views: Array, sigma: float, rho: float) -> Array:
    """By the 2D tensor of every epipolar plane image; its eigenvectors are (s, x)."""
    package: Any = importlib.import_module("structure_tensor")
    rows = []
    for y in range(views.shape[1]):
        _, vector = package.eig_special_2d(package.structure_tensor_2d(views[:, y], sigma, rho))
        with np.errstate(divide="ignore", invalid="ignore"):
            rows.append((vector[1] / vector[0])[VIEWS // 2])
    return np.stack(rows)


WAYS: dict[str, Callable[[Array, float, float], Array]] = {"3D": of_stack, "2D by slices": of_slices}


def least(run: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Least wall and CPU seconds of a call that has run before."""
    found = []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        run()
        found.append((time.perf_counter() - wall, time.process_time() - cpu))
    return min(w for w, _ in found), min(c for _, c in found)


def measure(settings: Settings) -> Outcome:
    """Errors and times of both, scene by scene."""
    from leafflow_ti.backend.flow import epi_disparity

    figures: list[Figure] = []
    for scene in SCENES:
        views, truth = made(scene, settings)
        disparity, std = epi_disparity(views, errors=True)
        figures.append(Figure(f"ours, RMSE, {scene.name}", rmse(disparity, truth), "px/view", GOAL))
        stated = float(np.sqrt(np.mean(np.square(std[BORDER:-BORDER, BORDER:-BORDER], dtype=np.float64))))
        ratio = rmse(disparity, truth) / stated
        figures.append(Figure(f"ours, RMSE over its standard error, {scene.name}", ratio, "", 1.25, low=0.8))
        _, ours = least(partial(epi_disparity, views), settings.repeats)
        figures.append(Figure(f"ours, CPU time, {scene.name}", 1e3 * ours, "ms"))
        for way, find in WAYS.items():
            errors = {pair: rmse(find(views, *pair), truth) for pair in product(SIGMAS, RHOS)}
            best = min(errors, key=errors.__getitem__)
            note = f"best of {len(errors)}: sigma {best[0]:g}, rho {best[1]:g}"
            figures.append(Figure(f"structure-tensor {way}, RMSE, {scene.name}", errors[best], "px/view", note=note))
            matched = rmse(epi_disparity(views, sigma=best[1]), truth)
            figures.append(Figure(f"ours with that rho, {scene.name}", matched, "px/view", errors[best]))
            _, theirs = least(partial(find, views, *best), settings.repeats)
            figures.append(Figure(f"structure-tensor {way}, CPU time, {scene.name}", 1e3 * theirs, "ms"))
            figures.append(Figure(f"ours over it, CPU time, {scene.name}", ours / theirs, "x", 1.0))
    return Outcome(tuple(figures), asdict(settings))


def run(options: Options) -> Outcome:
    """The case; quick: small views, two repetitions."""
    if importlib.util.find_spec("structure_tensor") is None:
        return Outcome(skipped="structure-tensor is not installed")
    return measure(Settings((64, 96), repeats=2) if options.quick else Settings())
