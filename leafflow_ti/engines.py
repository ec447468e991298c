"""The stages for bands of one size, and the one set of them that is kept from one estimate to the next.

Tables, and memory that has to be fetched from the system page by page, cost as much as measuring a small region.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from leafflow_ti.plan import Plan
from leafflow_ti.range_engine import RangeEngine, Sample
from leafflow_ti.runtime import Device
from leafflow_ti.stages.estimate import EstimateStage, View
from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.stages.prefilter import Prefilter
from leafflow_ti.stages.refine import RefineStage
from leafflow_ti.stages.tensor import Band, TensorStage

KEPT_BYTES = 512 << 20
"""Largest plan whose stages are kept."""


@dataclass
class Engine:
    """The stages for bands of one size: prefilter, tensors of the reference model and of the own flows, estimate.

    ``key``: what they depend on; ``around``: frames before and behind the reference that the refinement takes;
    ``widening``: pixels that the refinement needs around the block of the tensors.
    """

    key: tuple[Any, ...]
    prefilter: Prefilter | None
    tensor: TensorStage
    estimate: EstimateStage
    ranges: RangeEngine | None = None
    refine: RefineStage | None = None
    widening: int = 0
    around: tuple[int, int] = (0, 0)

    @classmethod
    def of(cls, device: Device, plan: Plan, band: Band, view: Callable[[int], View], apart: bool) -> Engine:
        """The kept stages if they are the ones, else new ones. ``view``: of an output of a given pitch."""
        problem, filters = plan.problem, plan.config.filters
        key = (
            device, replace(problem, noise=0.0), plan.layout, band, plan.differences, filters.prefilter,
            filters.sigma_pre, apart, plan.refine, plan.around,
        )  # fmt: skip
        kept = _take(key)
        if kept is not None and not plan.ranges:
            kept.estimate.set_noise(problem.noise)
            return kept
        own = problem.own_flows.requests if problem.own_flows else ()
        weighed = ESTIMATORS[problem.estimator].weighs
        tensor = TensorStage(
            device,
            problem.columns,
            plan.layout,
            problem.sampling,
            band,
            own,
            weighed,
            problem.mask_moments(plan.layout),
        )
        first = view(tensor.out_pitch)
        ranges = RangeEngine(device, plan.ranges, problem.sampling, first, band) if plan.ranges else None
        read = ranges.outer if ranges else band
        # The refinement sees the same block as the tensors, on every side this much wider.
        widening = plan.refine.widening(band.halo_y, band.halo_x) if plan.refine else 0
        rows, cols = read.in_rows + 2 * widening, read.in_cols + 2 * widening
        refine = RefineStage(device, plan.refine, first, rows, cols) if plan.refine else None
        prefilter = None
        if filters.prefilter != "none":
            prefilter = Prefilter(device, filters.prefilter, filters.sigma_pre, rows, cols)
        estimate = EstimateStage(device, problem, plan.layout, first, plan.differences, apart, tensor.sources)
        return cls(key, prefilter, tensor, estimate, ranges, refine, widening, plan.around)

    def reset(self, first: int = 0) -> None:
        """Forget all frames; the next one pushed is the frame ``first``."""
        self.tensor.reset(first)
        if self.refine:
            self.refine.reset()

    def set_frame(self, frame: int) -> None:
        """Go on to the reference ``frame``: where frames are uneven, each has tables of its own."""
        self.estimate.set_frame(frame)
        t = self.estimate.problem.sampling.t
        if self.refine and t.uneven:
            self.refine.set_frames(tuple(t.around(*self.around).tolist()))

    def push(self, sample: Sample) -> Any | None:
        """Add a frame of every camera; the tensors once the windows are full."""
        return self.tensor.push(sample.block, sample.valid, sample.factors)


_kept: list[Engine] = []
_lock = threading.Lock()


def _take(key: tuple[Any, ...]) -> Engine | None:
    """The kept stages if they are the ones. Either way they are no longer kept: two estimates never share them, and
    what does not fit gives its memory to the new ones."""
    with _lock:
        engine = _kept.pop() if _kept else None
    return engine if engine is not None and engine.key == key else None


def keep(engine: Engine, plan: Plan) -> None:
    """Keep the stages of an estimate that has ended for the next one; large ones, and those of range flow, are not."""
    if engine.ranges is None and plan.bytes <= KEPT_BYTES:
        with _lock:
            _kept[:] = [engine]


def release() -> None:
    """Give back the memory that was kept for the next ``estimate``."""
    with _lock:
        _kept.clear()
