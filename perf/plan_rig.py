"""The rig planner against simulation: predicted standard errors beside the scatter of estimates from noisy images.

A textured plane before each rig is rendered once, noise is added anew for every repetition; the scatter of each
window's estimates about their mean is pooled over windows and repetitions, so that what models leave out, which is the
same each time, does not count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from leafflow_ti.api import estimate
from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.config import load_config
from leafflow_ti.field import MOTION_NAMES
from leafflow_ti.rig import Rig, plan_rig
from leafflow_ti.synthetic.plane import PlaneScene, render, truth
from perf.cases import Options
from perf.figures import Figure, Outcome

GROUPS = {
    "depth": ("depth",), "normals": ("slope_x", "slope_y"), "velocity_xy": MOTION_NAMES[:2],
    "velocity_z": MOTION_NAMES[2:3], "growth": ("growth_rate",),
}  # fmt: skip
"""What is compared: maps whose ratios of scatter and prediction are averaged (squares)."""
WINDOWS = 3
"""Windows along each axis in which estimates are compared."""
WITHIN = 0.2


@dataclass(frozen=True)
class Trial:
    """A rig and how it is used: ``options`` of ``run``, ``seeds`` of noise."""

    name: str
    rig: Rig
    options: dict[str, Any] = field(default_factory=dict)
    seeds: int = 12


SMALL = {"window": 33, "sigma": 9.6}
_TABLE = Rig(
    f_px=2700.0, baseline_mm=(0.51, 0.51), distance_mm=100.0, cols=5, frames=5, size=(225, 193), noise=2.0,
    wavelengths_px=(4.0, 12.0), slopes=(0.3, -0.2), velocity=(0.005, -0.004, 0.02),
)  # fmt: skip
TRIALS = (
    Trial("affine-4d", _TABLE, {"model": "affine-4d", **SMALL}),
    Trial("affine-scene-flow", _TABLE, {"refine": 0, **SMALL}),
    Trial("refined", _TABLE, {"refine": 3, **SMALL}),
    Trial("depth, 3x3 cameras", replace(_TABLE, rows=3, cols=3, frames=1), {"model": "depth", **SMALL}),
    Trial(
        "tobacco rig, window 65",
        replace(_TABLE, f_px=25 / 0.0044, baseline_mm=(1.0, 1.0), distance_mm=250.0, cols=9, frames=9, size=(521, 333),
                noise=1.0, contrast=30.0, wavelengths_px=(6.0, 18.0), slopes=(0.0, 0.5), velocity=(0.01, 0.0, 0.0)),
        {"refine": 0},
    ),
    Trial("far, little noise", replace(_TABLE, distance_mm=1000.0, baseline_mm=(5.1, 5.1), noise=0.5,
                                       velocity=(0.1, 0.05, 0.0)), {"refine": 0, **SMALL}),
)  # fmt: skip


def simulate(trial: Trial) -> tuple[dict[str, float], dict[str, float]]:
    """Of each map the scatter, and the median of the program's own error bars, over the predicted standard error."""
    rig, options = trial.rig, {"preshift": trial.rig.preshift, "noise": trial.rig.noise, **trial.options}
    apart = int(options.get("window", 65)) // 4 * 4  # windows side by side
    left, top = ((n - 1) // 2 - apart * (WINDOWS // 2) for n in rig.size)
    options |= {"stride": apart, "roi": (left, top, left + apart * (WINDOWS - 1) + 1, top + apart * (WINDOWS - 1) + 1)}
    scene = surface(rig)
    clean = render(scene)
    geometry = Geometry(
        rig.f_px, scene.principal, (rig.baseline_mm[0] * (rig.cols > 1), rig.baseline_mm[1] * (rig.rows > 1))
    )
    fields = []
    for seed in range(trial.seeds):
        noise = np.random.default_rng(seed).standard_normal(clean.shape)
        fields.append(estimate(capture_from_array(clean + rig.noise * noise, geometry), **options))
    y, x = np.meshgrid(fields[0].y, fields[0].x, indexing="ij")
    depth = truth(scene)["depth"]
    predicted: dict[str, list[float]] = {}
    for row, col in zip(y.ravel(), x.ravel(), strict=True):
        here = moved(rig, (col - scene.principal[0], row - scene.principal[1]), depth[row, col])
        for name, error in plan_rig(here, load_config(overrides=options)).errors.items():
            predicted.setdefault(name, []).append(error)
    scatter, bars = {}, {}
    for name, errors in predicted.items():
        expected = np.reshape(errors, y.shape)
        ratio = np.array([one[name] for one in fields], np.float64) / expected
        whole = np.isfinite(ratio).all(axis=0)
        scatter[name] = float(np.sqrt(np.mean(np.var(ratio[:, whole], axis=0, ddof=1))))
        bars[name] = float(np.median([(one[f"{name}_std"] / expected)[whole] for one in fields]))
    return scatter, bars


def moved(rig: Rig, at: tuple[float, float], distance_mm: float) -> Rig:
    """The rig with the same surface, for another pixel, where it is ``distance_mm`` away."""
    scale = rig.distance_mm / distance_mm
    wavelengths = (scale * rig.wavelengths_px[0], scale * rig.wavelengths_px[1])
    return replace(rig, at=at, distance_mm=distance_mm, wavelengths_px=wavelengths)


def surface(rig: Rig) -> PlaneScene:
    """The textured plane that the rig was planned for."""
    shortest, longest = (length * rig.mm_per_px for length in rig.wavelengths_px)
    return replace(
        rig.scene, size=rig.size, texture="noise", offset=rig.mean, amplitude=rig.surface_contrast,
        wavelengths_mm=(shortest, longest),
    )  # fmt: skip


def ratios(trial: Trial) -> dict[str, tuple[float, float]]:
    """For each group, scatter and error bars over the prediction."""
    found, result = simulate(trial), {}
    for group, names in GROUPS.items():
        measured = [name for name in names if name in found[0]]
        if measured:
            scatter, bars = (math.sqrt(sum(of[name] ** 2 for name in measured) / len(measured)) for of in found)
            result[group] = (scatter, bars)
    return result


def run(options: Options) -> Outcome:
    """All rigs; quick: two of them, with fewer repetitions."""
    figures = []
    for trial in TRIALS[:2] if options.quick else TRIALS:
        found = ratios(replace(trial, seeds=4) if options.quick else trial)
        for group, (scatter, bars) in found.items():
            name = f"{trial.name}: {group}"
            note = f"error bars over predicted {bars:.2f}"
            figures.append(Figure(name, scatter, reference=1 + WITHIN, low=1 - WITHIN, note=note))
    return Outcome(tuple(figures), notes=("scatter of estimates over the predicted standard error",))
