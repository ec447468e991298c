"""What the cases have in common: the start and the refined field of one capture, and their errors by unknown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.api import estimate
from leafflow_ti.capture import Capture
from leafflow_ti.field import Field
from leafflow_ti.metrics import Mask, aae, normal_error
from leafflow_ti.status import Status
from perf.fields import vectors

Array = NDArray[Any]

STANDARD: dict[str, Any] = {"model": "affine-scene-flow", "motion": "rotation", "window": 65, "sigma": 19.0}

UNKNOWNS = {
    "depth": ("depth", None),
    "slope_x": ("zx", None),
    "slope_y": ("zy", None),
    **{
        f"{name}_{axis}": (key, k)
        for name, key in (("velocity", "velocity"), ("rotation", "omega"), ("acceleration", "acceleration"))
        for k, axis in enumerate("xyz")
    },
    "growth_rate": ("growth_rate", None),
    **{f"strain_rate_{pair}": ("strain_rate", k) for k, pair in enumerate(("11", "22", "12"))},
}
"""Map of a result -> key of the truth and its component."""


@dataclass(frozen=True)
class Pair:
    """One frame measured by the affine model alone, ``start``, and ``refined``; ``true`` by the maps' names [y, x]."""

    start: Field
    refined: Field
    true: Mapping[str, Array]

    @property
    def kept(self) -> Mask:
        """Where the refined field has taken over the start, [y, x]."""
        return np.asarray(self.refined.status == Status.UNREFINED)

    def error(self, name: str, which: str = "refined") -> Array:
        """Estimate minus truth of the map ``name`` [y, x]; ``which``: start or refined."""
        return np.asarray(getattr(self, which)[name] - self.true[name])

    def angles(self, which: str = "refined") -> dict[str, Array]:
        """Angular errors [y, x] in degrees: of (velocity, 1), of (rotation, 1) and of the normal."""
        field: Field = getattr(self, which)
        found = {
            name: aae(vectors(field, name), vectors(self.true, name)) for name in ("velocity", "rotation")
        }  # fmt: skip
        true = self.true["slope_x"], self.true["slope_y"]
        return {**found, "normal": normal_error(field["slope_x"], field["slope_y"], *true)}


def true_maps(truth: Mapping[str, Array], y: Array, x: Array) -> dict[str, Array]:
    """Truth of every unknown at rows y and columns x; rotations of one vector are spread over the pixels."""
    there = np.ix_(y, x)
    found = {}
    for name, (key, component) in UNKNOWNS.items():
        if key not in truth:
            continue
        values = truth[key]
        if component is None:
            found[name] = values[there]
        elif values.ndim == 1:
            found[name] = np.full((y.size, x.size), values[component])
        else:
            found[name] = values[there][..., component]
    return found


def measure(capture: Capture, truth: Mapping[str, Array], steps: int, **options: Any) -> Pair:
    """Start and refined field of the middle frame; ``steps``: most Gauss-Newton steps."""
    given = {**STANDARD, **options}
    coarse = {key: value for key, value in given.items() if key not in ("thin", "refine_window")}
    if coarse.get("deformation") == "strain":  # the refinement alone measures it
        coarse["deformation"] = "growth"
    start = estimate(capture, refine=0, **coarse)
    refined = estimate(capture, refine=steps, **given)
    return Pair(start, refined, true_maps(truth, refined.y, refined.x))


def rms(values: Array) -> float:
    """Root mean square of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def mean(values: Array) -> float:
    """Mean of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(np.mean(finite)) if finite.size else float("nan")
