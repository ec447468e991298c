"""The rotating cube: under constant light, under a fixed spot, under a spot on the camera; and whether any pixel of
any scene is worse off than before."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from leafflow_ti.synthetic.cube import CubeScene
from leafflow_ti.synthetic.plane import noise_scene
from perf.cases import Options
from perf.dissertation import scenes
from perf.dissertation.chapter4 import CUBE_VIEW, SIZE
from perf.dissertation.chapter56 import FULL
from perf.dissertation.experiment import Scene
from perf.dissertation.measure import EDGE_PX
from perf.figures import Figure, Outcome
from perf.refinement.common import STANDARD, Pair, mean, measure, rms

QUALITIES = {"balanced": (3, 3, "f32"), "accurate": (8, 1, "f64")}
"""Most Gauss-Newton steps, thinning and precision as of the presets."""


@dataclass(frozen=True)
class Settings:
    """``steps``: most Gauss-Newton steps; the rest: options of ``estimate`` and the view of Table 5.1."""

    steps: int = 3
    thin: int = 3
    stride: int = CUBE_VIEW["stride"]
    deformation: str = "auto"
    precision: str = "f32"

    def options(self) -> dict[str, Any]:
        """Options of ``estimate``."""
        return {
            **CUBE_VIEW,
            "thin": self.thin,
            "stride": self.stride,
            "deformation": self.deformation,
            "precision": self.precision,
        }


def faces(pair: Pair, scene: CubeScene) -> dict[str, Any]:
    """Masks [y, x] of the pixels whose windows see one face, as in Table 5.1."""
    regions = scenes.regions(scene, STANDARD["window"] // 2 + EDGE_PX)
    return {name: mask[np.ix_(pair.refined.y, pair.refined.x)] for name, mask in regions.items()}


def _velocity_and_rotation(
    pair: Pair, label: str, inside: Any, goals: Mapping[str, float | None], digits: str = ""
) -> list[Figure]:
    before, after = pair.angles("start"), pair.angles()
    return [
        Figure(
            f"{label}: AAE of {symbol}{digits}", mean(after[name][inside]), "deg", goals.get(name),
            note=f"affine {mean(before[name][inside]):.4g}",
        )
        for name, symbol in (("velocity", "N"), ("rotation", "Omega"))
    ]  # fmt: skip


def _acceleration(pair: Pair, inside: Any) -> float:
    """Mean size of the acceleration's error over its size."""
    error, size = (
        np.sqrt(sum(values(f"acceleration_{axis}") ** 2 for axis in "xyz"))
        for values in (pair.error, lambda name: pair.true[name])
    )
    return mean((error / size)[inside])


def measure_cube(settings: Settings, quality: str) -> Outcome:
    """Both faces of the rotating cube, constant light."""
    scene = CubeScene(size=SIZE)
    pair = measure(scenes.capture(scene, 0), scenes.truth(scene), settings.steps, **settings.options())
    figures = []
    for face, inside in faces(pair, scene).items():
        side = f"{quality}, {face}"
        figures += _velocity_and_rotation(pair, side, inside, {"velocity": 0.025, "rotation": 0.0008})
        figures += [
            Figure(f"{side}: error of A over its size", _acceleration(pair, inside), "", 0.1),
            Figure(
                f"{side}: angle between normals", mean(pair.angles()["normal"][inside]), "deg", 0.06,
                note=f"affine {mean(pair.angles('start')['normal'][inside]):.4g}",
            ),
            Figure(
                f"{side}: depth", rms(pair.error("depth")[inside]), "mm", 0.01,
                note=f"affine {rms(pair.error('depth', 'start')[inside]):.4g}",
            ),
            Figure(f"{side}: growth rate (none)", rms(pair.error("growth_rate")[inside]), "%/frame"),
            Figure(f"{side}: pixels that kept the affine result", float(np.mean(pair.kept[inside])), ""),
        ]  # fmt: skip
    return Outcome(tuple(figures), asdict(settings))


LIGHTS: dict[str, dict[str, dict[str, float | None]]] = {
    "spot": {side: {"velocity": 0.04, "rotation": 0.001} for side in scenes.FACES},
    "spot-camera": {
        "left": {"velocity": 0.06, "rotation": 0.002, "depth": 0.03},
        "right": {"velocity": 0.02, "rotation": 0.002, "depth": 0.03},
    },
}
"""Light -> face -> goals."""


def measure_light(settings: Settings, quality: str) -> Outcome:
    """Both faces of the rotating cube under either spot, with all photometric terms."""
    figures = []
    for light, goals in LIGHTS.items():
        scene = CubeScene(size=SIZE, light=light)  # type: ignore[arg-type]
        options = {**settings.options(), **FULL}
        pair = measure(scenes.capture(scene, 0), scenes.truth(scene), settings.steps, **options)
        for side, inside in faces(pair, scene).items():
            label = f"{quality}, {light}, {side}"
            figures += _velocity_and_rotation(pair, label, inside, goals[side])
            figures += [
                Figure(
                    f"{label}: depth", rms(pair.error("depth")[inside]), "mm", goals[side].get("depth"),
                    note=f"affine {rms(pair.error('depth', 'start')[inside]):.4g}",
                ),
                Figure(f"{label}: pixels that kept the affine result", float(np.mean(pair.kept[inside])), ""),
            ]  # fmt: skip
    return Outcome(tuple(figures), asdict(settings))


def worse(pair: Pair, name: str) -> tuple[int, int]:
    """Pixels whose error of ``name`` has grown by more than a standard error of both estimates, and all with both."""
    before, after = np.abs(pair.error(name, "start")), np.abs(pair.error(name))
    std = np.hypot(pair.start[f"{name}_std"], pair.refined[f"{name}_std"])
    known = np.isfinite(before) & np.isfinite(after) & np.isfinite(std) & ~pair.kept
    return int(np.count_nonzero(known & (after > before + std))), int(np.count_nonzero(np.isfinite(before + after)))


def by_chance(pair: Pair, names: Iterable[str], draws: int = 100) -> float:
    """The share that independent, normal errors of the sizes that the error bars state would give."""
    rng, shares = np.random.default_rng(0), []
    for name in names:
        before, after = (field[f"{name}_std"][~pair.kept] for field in (pair.start, pair.refined))
        known = np.isfinite(before) & np.isfinite(after)
        one, two = (rng.standard_normal((draws, known.sum())) * std[known] for std in (before, after))
        shares.append(np.mean(np.abs(two) > np.abs(one) + np.hypot(before[known], after[known])))
    return float(np.mean(shares))


def every_scene(quick: bool) -> dict[str, tuple[Scene, dict[str, Any]]]:
    """Scenes and views of which all pixels count: borders between faces, too."""
    sinusoid = scenes.sinusoid(windows=2)
    noise = replace(noise_scene(sinusoid.size), bits=8)
    plane = {"preshift": (-14, 0), "roi": scenes.middle(sinusoid), "stride": 8}
    cube = {**CUBE_VIEW, "stride": 16 if quick else 4}
    found: dict[str, tuple[Scene, dict[str, Any]]] = {
        "cube": (CubeScene(size=SIZE), cube),
        "cube under a spot": (CubeScene(size=SIZE, light="spot-camera"), {**cube, **FULL}),
        "sinusoid": (sinusoid, plane),
        "sinusoid, noise 2.5": (replace(sinusoid, noise=2.5), plane),
        "plane": (noise, plane),
        "growing plane, noise 2.5": (replace(noise, growth=5e-4, noise=2.5), plane),
    }
    return {name: found[name] for name in ("cube", "plane")} if quick else found


def measure_worse(settings: Settings, quick: bool) -> Outcome:
    """The share of pixels, over all unknowns that both have, that lost by the refinement."""
    figures = []
    for label, (scene, view) in every_scene(quick).items():
        options = {**settings.options(), **view}
        pair = measure(scenes.capture(scene, 0), scenes.truth(scene), settings.steps, **options)
        counts = {
            name: worse(pair, name)
            for name in pair.true
            if f"{name}_std" in pair.start and f"{name}_std" in pair.refined
        }
        lost, n = (sum(count[i] for count in counts.values()) for i in (0, 1))
        worst = max(counts, key=lambda name: counts[name][0])
        note = (
            f"most of them {worst}: {counts[worst][0]} of {counts[worst][1]}; by chance {by_chance(pair, counts):.3g}"
        )
        figures += [
            Figure(f"{label}: worse by more than a standard error", lost / n, "", 0.01, note=note),
            Figure(f"{label}: pixels that kept the affine result", float(np.mean(pair.kept)), ""),
        ]
    return Outcome(tuple(figures), asdict(settings), ("standard error: that of both estimates together",))


def _qualities(of: Callable[[Settings, str], Outcome], quick: bool) -> Outcome:
    stride = 16 if quick else CUBE_VIEW["stride"]
    outcomes = [
        of(Settings(steps, thin, stride, precision=precision), name)
        for name, (steps, thin, precision) in QUALITIES.items()
    ]
    return Outcome(tuple(figure for one in outcomes for figure in one.figures), {"stride": stride, **QUALITIES})


def run_cube(options: Options) -> Outcome:
    """The case; quick: every sixteenth pixel."""
    return _qualities(measure_cube, options.quick)


def run_light(options: Options) -> Outcome:
    """The case; quick: every sixteenth pixel."""
    return _qualities(measure_light, options.quick)


def run_worse(options: Options) -> Outcome:
    """The case; quick: cube and plane, every sixteenth pixel of the cube."""
    return measure_worse(Settings(steps=8), options.quick)
