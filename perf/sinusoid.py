"""The sinusoid of Schuchert 2010, section 5.3: motion of a tilted plane from a row of nine cameras and nine frames.

Noise free in single and double precision, and with noise of 2.5 % of the grey range; over independent seeds the ratio
of error to standard error tells whether the error bars are true.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import RunError
from leafflow_ti.metrics import Maps, aae, coverage
from leafflow_ti.synthetic.plane import PlaneScene, truth
from perf.cases import Options
from perf.dissertation.scenes import capture, middle, sinusoid
from perf.figures import Figure, Outcome

COVERED = ("depth", "slope_x", "slope_y", "velocity_x", "velocity_y", "velocity_z")
TRUE_NAMES = {"depth": "depth", "slope_x": "zx", "slope_y": "zy"}


@dataclass(frozen=True)
class Settings:
    """Every ``stride``-th pixel in the middle of the image; ``noise`` in grey values of a range of 100."""

    size_px: int = 221
    stride: int = 8
    window: int = 65
    sigma: float = 19.0
    noise: float = 2.5
    seeds: int = 40


def estimate_region(
    plane: PlaneScene, settings: Settings, precision: str
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Maps of the region, and the truth there by the same names as ``truth``."""
    from leafflow_ti.api import estimate

    field = estimate(
        capture(plane, plane.seed), model="affine-4d", motion="rotation", preshift=(-14, 0), window=settings.window,
        sigma=settings.sigma, stride=settings.stride, roi=middle(plane), precision=precision,
    )  # fmt: skip
    there = np.ix_(field.y, field.x)
    true = {name: values if values.ndim == 1 else values[there] for name, values in truth(plane).items()}
    return dict(field), true


def _errors(maps: Maps, true: Maps) -> dict[str, float]:
    """Mean angular errors [deg] of velocity and rotation, and the largest relative depth error."""
    velocity, rotation = (np.stack([maps[f"{q}_{a}"] for a in "xyz"], axis=-1) for q in ("velocity", "rotation"))
    return {
        "velocity": float(aae(velocity, true["velocity"]).mean()),
        "rotation": float(aae(rotation, np.broadcast_to(true["omega"], rotation.shape)).mean()),
        "depth": float(np.abs(maps["depth"] / true["depth"] - 1).max()),
    }


def _true_map(true: Maps, name: str) -> NDArray[Any]:
    if name in TRUE_NAMES:
        return true[TRUE_NAMES[name]]
    return np.asarray(true["velocity"][..., "xyz".index(name[-1])])


def measure(settings: Settings) -> Outcome:
    """Noise-free accuracy in both precisions, accuracy and coverage with noise."""
    size = (settings.size_px, settings.size_px)
    figures = []
    for precision in ("f64", "f32"):
        found = _errors(*estimate_region(sinusoid(size=size), settings, precision))
        figures += [
            Figure(f"AAE of N, noise free, {precision}", found["velocity"], "deg", 3e-4),
            Figure(f"AAE of Omega, noise free, {precision}", found["rotation"], "deg", 2e-5),
            Figure(f"largest relative depth error, noise free, {precision}", found["depth"], "", 5e-6),
        ]
    exact, single = figures[:3], figures[3:]
    for one, other in zip(exact, single, strict=True):
        figures.append(Figure(f"{one.name.split(',')[0]}, f32 over f64", other.value / one.value, "", 1.1))
    noisy = []
    for seed in range(settings.seeds):
        noisy.append(estimate_region(sinusoid(size=size, noise=settings.noise, seed=seed), settings, "f32"))
    means: Mapping[str, float] = {
        name: float(np.mean([_errors(maps, true)[name] for maps, true in noisy])) for name in ("velocity", "rotation")
    }
    label = f"noise {settings.noise:g}"
    figures += [
        Figure(f"AAE of N, {label}", means["velocity"], "deg", 0.06),
        Figure(f"AAE of Omega, {label}", means["rotation"], "deg", 0.002),
    ]
    for name in COVERED:
        values, std = (np.stack([maps[key] for maps, _ in noisy]) for key in (name, f"{name}_std"))
        spread = coverage(values, np.stack([_true_map(true, name) for _, true in noisy]), std)
        if spread is None:
            raise RunError(f"{name}: no pixel has a value and an error bar; check the window and the preshift")
        note = f"mean {spread.mean:+.2f}, within 1 std {spread.within_1:.0%}, within 2 {spread.within_2:.0%}"
        figures.append(Figure(f"std of error over error bar, {name}", spread.std, "", 1.25, low=0.8, note=note))
    return Outcome(tuple(figures), asdict(settings), (f"noise: over {settings.seeds} independent sequences",))


def run(options: Options) -> Outcome:
    """The case; quick: four seeds."""
    return measure(Settings(seeds=4) if options.quick else Settings())
