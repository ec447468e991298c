"""Run an experiment: every scene measured in every way, errors summarised per region into records."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti import __version__
from leafflow_ti.errors import LeafflowError
from leafflow_ti.field import Field
from leafflow_ti.metrics import Summary, aae, evaluate, sample_maps, summarise
from perf.dissertation import scenes
from perf.dissertation.experiment import QUANTITIES, STANDARD, Experiment, Panel, Point, Statistic, Variant
from perf.fields import vectors

Array = NDArray[Any]
EDGE_PX = 13
"""What filters, disparity and motion add to half a window beside the border of a face."""


@dataclass(frozen=True)
class Record:
    """Errors of one quantity in one region, over all sequences: mean and standard deviation of ``n`` values.

    ``share``: part of the region's pixels that have a value.
    """

    panel: str
    variant: str
    region: str
    x: float
    quantity: str
    n: int
    share: float
    mean: float
    std: float

    def statistic(self, name: Statistic) -> float:
        """The mean, the standard deviation, or the root mean square of both."""
        return {"mean": self.mean, "std": self.std, "rms": math.hypot(self.mean, self.std)}[name]


@dataclass(frozen=True)
class Failure:
    """Why a variant could not be measured at an abscissa."""

    panel: str
    variant: str
    x: float
    message: str


@dataclass
class Result:
    """What an experiment found; ``maps``: error of N [h, w] and velocity [h, w, 3] per (panel, variant) that keeps
    them."""

    experiment: str
    quick: bool
    seconds: float = 0.0
    version: str = __version__
    device: str = ""
    records: list[Record] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)
    maps: dict[tuple[str, str], dict[str, Array]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """All but the maps as plain values."""
        return {key: value for key, value in asdict(self).items() if key != "maps"}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Result:
        """The result that ``to_json`` wrote, without its maps."""
        lists = {"records": Record, "failures": Failure}
        return cls(**{k: [lists[k](**row) for row in v] if k in lists else v for k, v in values.items()})


def run(experiment: Experiment, quick: bool = False) -> Result:
    """Measure every panel. A variant that cannot be measured is a failure of the result; it does not end it."""
    result, began = Result(experiment.name, quick), time.perf_counter()
    for panel in experiment.panels:
        chosen = panel.quick() if quick else panel
        for point in chosen.points:
            _run_point(result, chosen, point)
    result.seconds = time.perf_counter() - began
    return result


def _run_point(result: Result, panel: Panel, point: Point) -> None:
    from leafflow_ti.api import estimate

    found: dict[tuple[str, str, str], list[tuple[Summary, int]]] = {}
    failed: set[str] = set()
    for seed in range(panel.seeds if point.scene.noise > 0.0 else 1):
        capture = scenes.capture(point.scene, seed)
        for variant in panel.variants:
            if variant.label in failed:
                continue
            options = _options(panel, point, variant)
            try:
                measured = estimate(capture, **options)
            except LeafflowError as error:
                result.failures.append(Failure(panel.name, variant.label, point.x, str(error)))
                failed.add(variant.label)
                continue
            result.device = str(measured.attrs["device"])
            margin = options["window"] // 2 + EDGE_PX if panel.margin_px is None else panel.margin_px
            for region, quantity, summary, pixels in errors(measured, point, margin):
                found.setdefault((variant.label, region, quantity), []).append((summary, pixels))
            if panel.keep_maps:
                result.maps[panel.name, variant.label] = _maps(measured, point)
    for (label, region, quantity), parts in found.items():
        result.records.append(_pooled(panel.name, label, region, point.x, quantity, parts))


def _options(panel: Panel, point: Point, variant: Variant) -> dict[str, Any]:
    view: dict[str, Any] = {"preshift": panel.preshift, "roi": panel.roi, "stride": panel.stride}
    return {**STANDARD, **view, **point.options, **variant.options}


def errors(measured: Field, point: Point, margin_px: int) -> Iterator[tuple[str, str, Summary, int]]:
    """(region, quantity, summary of the errors, pixels of the region) of everything that was measured and is known."""
    true = scenes.truth(point.scene)
    there = np.ix_(measured.y, measured.x)
    regions = {name: mask[there] for name, mask in scenes.regions(point.scene, margin_px).items()}
    reports = evaluate(measured, sample_maps(true, measured.y, measured.x), regions)
    for region, mask in regions.items():
        for name, quantity in QUANTITIES.items():
            summary = reports[region].errors.get(quantity.key) if region in reports else None
            if quantity.key in measured and quantity.key in true:  # a map by its own name
                summary = summarise((measured[quantity.key] - true[quantity.key][there])[mask])
            if summary is not None:
                yield region, name, summary, int(np.count_nonzero(mask))


def _pooled(panel: str, label: str, region: str, x: float, quantity: str, parts: list[tuple[Summary, int]]) -> Record:
    n = sum(part.n for part, _ in parts)
    mean = sum(part.n * part.mean for part, _ in parts) / n
    square = sum(part.n * (part.std**2 + (part.mean - mean) ** 2) for part, _ in parts) / n
    share = n / sum(pixels for _, pixels in parts)
    return Record(panel, label, region, x, quantity, n, share, mean, math.sqrt(square))


def _maps(measured: Field, point: Point) -> dict[str, Array]:
    velocity = vectors(measured, "velocity")
    true = scenes.truth(point.scene)["velocity"][np.ix_(measured.y, measured.x)]
    return {"error": aae(velocity, true), "velocity": velocity, "truth": true}
