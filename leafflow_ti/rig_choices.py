"""Which change of a camera rig, or of how its images are used, would gain most."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

from leafflow_ti.config import RunConfig
from leafflow_ti.errors import ConfigError
from leafflow_ti.models import MODELS
from leafflow_ti.rig import Prediction, Rig, plan_rig

CHOICES: dict[str, Callable[[Rig], Rig]] = {
    "twice the baseline": lambda r: replace(r, baseline_mm=(2 * r.baseline_mm[0], 2 * r.baseline_mm[1])),
    "four cameras more along each axis": lambda r: replace(
        r, cols=r.cols + 4 * (r.cols > 1), rows=r.rows + 4 * (r.rows > 1)
    ),
    "three rows of cameras": lambda r: replace(r, rows=3, baseline_mm=(r.baseline_mm[0], r.baseline_mm[0])),
    "twice the focal length (half the field of view)": lambda r: replace(
        r, f_px=2 * r.f_px, contrast=_contrast(r, 2.0), wavelengths_px=_wavelengths(r, 2.0)
    ),
    "half the distance (half the field of view)": lambda r: replace(
        r, distance_mm=r.distance_mm / 2, contrast=_contrast(r, 2.0), wavelengths_px=_wavelengths(r, 2.0)
    ),
    "half the noise (four exposures averaged, or four times the light)": lambda r: replace(r, noise=r.noise / 2),
    "four frames more": lambda r: replace(r, frames=r.frames + 4),
}
"""What may be changed about a rig; the surface and its texture stay as they are."""


def _wavelengths(rig: Rig, magnification: float) -> tuple[float, float]:
    return magnification * rig.wavelengths_px[0], magnification * rig.wavelengths_px[1]


def _contrast(rig: Rig, magnification: float) -> float:
    """Contrast of the images when pixels cover less of the surface."""
    larger = replace(rig, wavelengths_px=_wavelengths(rig, magnification), contrast=1.0)
    return rig.surface_contrast / larger.surface_contrast


@dataclass(frozen=True)
class Choice:
    """A change of the rig or of the windows, and by which factor each group of errors becomes smaller."""

    name: str
    better: Mapping[str, float]

    @property
    def overall(self) -> float:
        """Geometric mean of the factors."""
        return math.prod(self.better.values()) ** (1 / max(len(self.better), 1))


def improvements(before: Prediction, config: RunConfig | None = None) -> tuple[Choice, ...]:
    """What changes of rig and windows would gain, the largest gain first; those that cannot be run are left out."""
    config = config or RunConfig()
    rig, wide = before.rig, before.plan.config.window.size
    tried: list[tuple[str, Rig, RunConfig]] = [(name, change(rig), config) for name, change in CHOICES.items()]
    larger = wide + 2 * round(0.25 * wide)
    sigma = before.plan.config.window.sigma * larger / wide
    settings = config.window.model_copy(update={"size": larger, "sigma": sigma})
    tried.append((f"windows of {larger} px (coarser maps)", rig, config.model_copy(update={"window": settings})))
    if before.plan.refine is None and MODELS[before.plan.model].time:
        refine = config.refine.model_copy(update={"steps": 3})
        tried.append(("exact refinement (--refine 3)", rig, config.model_copy(update={"refine": refine})))
    return tuple(sorted(_choices(before, tried), key=lambda choice: -choice.overall))


def _choices(before: Prediction, tried: list[tuple[str, Rig, RunConfig]]) -> Iterator[Choice]:
    for name, rig, config in tried:
        try:
            after = plan_rig(rig, config).groups
        except ConfigError:  # too large for the images, or not a grid any more
            continue
        yield Choice(name, {group: error / after[group] for group, error in before.groups.items() if group in after})
