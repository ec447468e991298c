"""Growth of what does not grow: refined cubes, turning or not, under every light, and turning planes.

The mean over a face is the bias, the standard deviation over it what a single window is mistaken by; the printed
standard deviations are .04 %/frame at best.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.plane import noise_scene
from perf.cases import Options
from perf.dissertation import scenes
from perf.dissertation.chapter4 import CUBE_VIEW, SIZE, SPOT
from perf.dissertation.chapter56 import FULL
from perf.dissertation.experiment import Scene
from perf.figures import Figure, Outcome
from perf.refinement.common import Pair, measure
from perf.refinement.cube import QUALITIES, faces

MEAN, SCATTER = 0.001, 0.005
"""Goals [%/frame]: size of the mean over a face, standard deviation over it."""


def every_scene(quick: bool) -> dict[str, tuple[Scene, dict[str, Any]]]:
    """Label -> scene and options of ``estimate``; images of 8 bits without further noise."""
    cube = {**CUBE_VIEW, "stride": 16 if quick else CUBE_VIEW["stride"]}
    still = CubeScene(size=SIZE, omega=(0.0, 0.0, 0.0))
    sinusoid = scenes.sinusoid(windows=2)
    plane = {"preshift": (-14, 0), "roi": scenes.middle(sinusoid), "stride": 8}
    found: dict[str, tuple[Scene, dict[str, Any]]] = {
        "cube, turning": (CubeScene(size=SIZE), cube),
        "cube, translating": (still, cube),
        "cube, translating, fixed spot": (SPOT, {**cube, **FULL}),
        "cube, turning, fixed spot": (CubeScene(size=SIZE, light="spot"), {**cube, **FULL}),
        "cube, turning, spot on the camera": (CubeScene(size=SIZE, light="spot-camera"), {**cube, **FULL}),
        **{
            f"plane, turning {degrees:g}°/frame": (
                replace(noise_scene(sinusoid.size), bits=8, omega=scenes.rotation(degrees)),
                plane,
            )
            for degrees in (0.003, 0.1, 0.3)
        },
    }
    return {label: found[label] for label in ("cube, turning", "plane, turning 0.1°/frame")} if quick else found


def _regions(pair: Pair, scene: Scene) -> dict[str, Any]:
    if isinstance(scene, CubeScene):
        return faces(pair, scene)
    return {"all": np.ones(pair.refined.status.shape, np.bool_)}


def _figures(label: str, pair: Pair, scene: Scene) -> Iterator[Figure]:
    for side, inside in _regions(pair, scene).items():
        error = pair.error("growth_rate")[inside & ~pair.kept]
        error = error[np.isfinite(error)]
        left = f"{np.mean(pair.kept[inside]):.3g} of {inside.sum()} px kept the affine result"
        where = f"{label}, {side}"
        yield Figure(f"{where}: |mean|", abs(float(error.mean())), "%/frame", MEAN, note=left)
        yield Figure(
            f"{where}: standard deviation", float(error.std()), "%/frame", SCATTER,
            note=f"largest {np.abs(error).max():.2g}",
        )  # fmt: skip


def run(options: Options) -> Outcome:
    """The case; quick: one cube and one plane, every sixteenth pixel of the cube."""
    figures: list[Figure] = []
    for quality, (steps, thin, precision) in QUALITIES.items():
        for label, (scene, view) in every_scene(options.quick).items():
            pair = measure(scenes.capture(scene, 0), scenes.truth(scene), steps, thin=thin, precision=precision, **view)
            figures += _figures(f"{quality}, {label}", pair, scene)
    return Outcome(tuple(figures), {"qualities (steps, thinning, precision)": QUALITIES})
