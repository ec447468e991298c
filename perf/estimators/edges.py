"""The cube within 20 px of its edges: the plain estimate beside the robust one, what it costs, and the interior.

Of the edge between the two faces windows see two surfaces; beside the border of the cube they see half a window of
texture and a background without any, which leaves one surface: nothing there for a robust estimator to choose.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.api import estimate
from leafflow_ti.field import Field
from leafflow_ti.metrics import Mask, aae, erode
from leafflow_ti.synthetic.cube import CubeScene
from perf.cases import Options
from perf.dissertation import scenes
from perf.dissertation.chapter4 import CUBE_VIEW, SIZE
from perf.dissertation.measure import EDGE_PX
from perf.fields import vectors
from perf.figures import Figure, Outcome
from perf.pictures import Panel, draw

Array = NDArray[np.float64]

WINDOW = {"window": 65, "sigma": 19.0}
PLAIN = {"estimator": "tls-equilibrated"}
ROBUST = {"estimator": "robust-tls", "penalty": "geman-mcclure"}
QUANTITIES = {"depth": "mm", "velocity": "deg"}


@dataclass(frozen=True)
class Settings:
    """``near`` px: width of the bands along the edges; ``stride`` and ``repeats`` of the timing."""

    models: tuple[str, ...] = ("affine-4d", "affine-scene-flow")
    near: int = 20
    stride: int = CUBE_VIEW["stride"]
    repeats: int = 3


def bands(scene: CubeScene, near: int) -> dict[str, Mask]:
    """Masks [y, x]: within ``near`` px of the edge between the faces; of the border of the cube but not of that edge;
    of either; and where windows see one face alone."""
    face = scenes.truth(scene)["face"]
    left, right = (face == label for label in scenes.FACES.values())
    band = {
        "edge between faces": (left & ~erode(~right, near)) | (right & ~erode(~left, near)),
        "border of the cube": (left | right) & ~erode(left | right, near),
    }
    band["border of the cube"] &= ~band["edge between faces"]
    band["all edges"] = band["edge between faces"] | band["border of the cube"]
    inside = scenes.regions(scene, WINDOW["window"] // 2 + EDGE_PX)
    return {**band, "interior": np.logical_or.reduce(list(inside.values()))}


def errors(field: Field, scene: CubeScene) -> dict[str, Array]:
    """Errors [y, x]: size of that of the depth in mm, angular error of the velocity in degrees."""
    there = np.ix_(field.y, field.x)
    true = scenes.truth(scene)
    return {
        "depth": np.abs(field["depth"] - true["depth"][there]),
        "velocity": aae(vectors(field, "velocity"), true["velocity"][there]),
    }


def timed(settings: Settings, scene: CubeScene, model: str, options: dict[str, Any]) -> tuple[Field, float]:
    """The field, and the median seconds of an ``estimate`` whose kernels are there."""
    capture, view = scenes.capture(scene, 0), {**CUBE_VIEW, **WINDOW, "stride": settings.stride, "refine": 0}
    field = estimate(capture, model=model, **view, **options)
    seconds = []
    for _ in range(settings.repeats):
        began = time.perf_counter()
        estimate(capture, model=model, **view, **options)
        seconds.append(time.perf_counter() - began)
    return field, median(seconds)


def _compare(model: str, plain: dict[str, Array], robust: dict[str, Array], masks: dict[str, Mask]) -> list[Figure]:
    """Mean errors of both, on the pixels that have both."""
    figures = []
    for band, mask in masks.items():
        for name, unit in QUANTITIES.items():
            known = mask & np.isfinite(plain[name]) & np.isfinite(robust[name])
            before, after = (float(error[name][known].mean()) for error in (plain, robust))
            high = {"edge between faces": 0.5, "interior": 1.05}.get(band)
            note = f"{before:.4g} to {after:.4g} {unit}, n = {known.sum()}"
            figures.append(Figure(f"{model}, {band}: {name}, robust over plain", after / before, "", high, note=note))
    return figures


def run_settings(settings: Settings, out: Path) -> Outcome:
    """All models."""
    scene = CubeScene(size=SIZE)
    figures, panels = [], []
    for model in settings.models:
        plain, robust = (timed(settings, scene, model, options) for options in (PLAIN, ROBUST))
        there = np.ix_(plain[0].y, plain[0].x)
        masks = {name: mask[there] for name, mask in bands(scene, settings.near).items()}
        before, after = (errors(field, scene) for field, _ in (plain, robust))
        figures += _compare(model, before, after, masks)
        anew = robust[0]["support"] < 1.0
        known = np.isfinite(before["depth"])
        figures += [
            Figure(f"{model}: share of the pixels that are estimated anew", float(np.mean(anew[known])), ""),
            Figure(f"{model}: time of the robust estimate over the plain one", robust[1] / plain[1], "x"),
        ]
        panels += [
            Panel(f"{model}, {label}: error of the depth [mm]", error["depth"], (0.0, 3.0), "magma")
            for label, error in (("plain", before), ("robust", after))
        ]
    return Outcome(tuple(figures), asdict(settings), (), (draw(out / "estimators-edges.png", panels, 2, 5.0),))


def run(options: Options) -> Outcome:
    """The case; quick: every sixteenth pixel, the affine model in 4D."""
    quick = Settings(("affine-4d",), stride=16, repeats=1)
    return run_settings(quick if options.quick else Settings(), options.out)
