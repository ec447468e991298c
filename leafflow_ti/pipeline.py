"""Execution of a plan: images in, maps of one unit after the other out.

The engine knows no files of results: what becomes of a unit's maps is the caller's business.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.adaptive import Adaptive
from leafflow_ti.aim import Aim
from leafflow_ti.capture import Capture
from leafflow_ti.memory import give_back
from leafflow_ti.plan import Plan, Unit
from leafflow_ti.range_engine import Sample
from leafflow_ti.refinement import Place, refine_maps, refine_middle
from leafflow_ti.runtime import Device
from leafflow_ti.search import warm_up
from leafflow_ti.stages.tensor import Band
from leafflow_ti.stays import Maps, Stay, without_images
from leafflow_ti.trace import Trace, active, span
from leafflow_ti.units import Units


class Pipeline(Units):
    """Computes the units of a plan on a device.

    ``trace`` holds the seconds of the stages; ``apart``: with the stages ``solve`` and ``fit`` instead of ``estimate``,
    which is both in one go. Raises ConfigError for a mask that does not fit the images.
    """

    def __init__(self, plan: Plan, capture: Capture, device: Device, trace: Trace | None = None, apart: bool = False):
        super().__init__(plan, capture, device, apart)
        self.trace = trace or Trace()

    def warm_up(self) -> float:
        """Compile every kernel of the plan on a tiny band; the seconds that it took."""
        from leafflow_ti.kernels.engine import quick_front_end

        # The work on the tiny band is no stage of its own: it all counts as compiling.
        with active(None), self.trace.span("compile"), quick_front_end():
            self._one_pixel(None)
            if self.plan.adaptive:
                warm_up(self.device)
        give_back()
        return self.trace.seconds["compile"]

    def least_seconds(self) -> dict[str, float]:
        """Seconds per stage of one more frame of a band of one pixel, kernels compiled: launches and little else."""
        trace = Trace(barrier=self.device.synchronize)
        self._one_pixel(trace)
        return trace.seconds

    def _one_pixel(self, trace: Trace | None) -> None:
        """Compute one pixel from random images until its windows are full, then one frame more for the trace."""
        plan = self.plan
        band = Band.of(plan.problem.sampling, 1, 1, plan.x.step)
        engine = self._make_engine(band)
        read = engine.ranges.outer if engine.ranges else band
        if engine.ranges:
            engine.ranges.move(engine.estimate.view, (0, 0))
        halo, shape = engine.widening, (len(plan.cameras[0]), len(plan.cameras[1]), read.in_rows, read.in_cols)
        wide = np.random.default_rng(0).random((*shape[:2], shape[2] + 2 * halo, shape[3] + 2 * halo))
        wide = wide.astype(self.device.real("storage"))
        grey = np.ascontiguousarray(wide[:, :, halo : halo + shape[2], halo : halo + shape[3]])
        ok = np.ones(shape[2:], bool)

        def one_more() -> Any:
            if engine.refine:
                engine.refine.push(wide, np.ones(wide.shape, bool))
            sample = Sample(grey, ok, np.zeros(shape[2:], np.uint8))
            if engine.ranges:
                sample = engine.ranges.sample(plan.frames[0], grey, ok, ok)
            return engine.push(sample)

        def estimate(tensors: Any) -> None:
            engine.estimate(tensors)
            if engine.refine:
                refine_middle(engine.refine)

        if engine.refine:  # it may look farther than the model
            for _ in range(sum(plan.around)):
                engine.refine.push(wide, np.ones(wide.shape, bool))
        while (tensors := one_more()) is None:
            pass
        estimate(tensors)
        if trace is not None:
            with active(trace):
                estimate(one_more())
        self.device.synchronize()

    def run(
        self, deliver: Callable[[Unit, Maps, NDArray[np.uint8]], None], wanted: Collection[int] | None = None
    ) -> None:
        """Compute the units ``wanted`` (None: all) and hand over the maps [rows, columns] and the status of each."""
        wanted = range(self.plan.n_units) if wanted is None else wanted
        if self.plan.adaptive:
            self._run_adaptive(wanted, deliver)
            return
        for band in range(self.plan.bands):
            pending = [t for t in range(len(self.plan.frames)) if self.plan.unit(t, band).index in wanted]
            for first, last in _runs(pending):
                with active(self.trace), contextlib.closing(self._sequence(band, first, last)) as units:
                    for unit, maps, status in units:
                        deliver(unit, maps, status)

    def _run_adaptive(self, wanted: Collection[int], deliver: Callable[[Unit, Maps, NDArray[np.uint8]], None]) -> None:
        """Frame by frame: the bands of a frame share what its search has found."""
        adaptive, bands = Adaptive(self), range(self.plan.bands)
        for t_index in range(len(self.plan.frames)):
            pending = [b for b in bands if self.plan.unit(t_index, b).index in wanted]
            if pending:
                with active(self.trace):
                    for unit, maps, status in adaptive.units(t_index, pending):
                        deliver(unit, maps, status)

    def _sequence(
        self, index: int, first: int, last: int
    ) -> Generator[tuple[Unit, Maps, NDArray[np.uint8]], None, None]:
        """The units of one band for the output frames first..last, sliding through the sequence.

        Only the rectangle of measurable pixels is computed; what lies around it is border.
        """
        plan = self.plan
        rows, cols = self.extent(index)
        if rows.start == rows.stop or cols.start == cols.stop:
            for t_index in range(first, last + 1):
                yield plan.unit(t_index, index), *self.cut(index, *self.framed(index))
            return
        time, (before, after) = plan.problem.sampling.t, plan.around
        frames = range(plan.frames[first] - before, plan.frames[last] + after + 1)
        begin = plan.frames[first] - time.before  # the refinement may look farther than the model, to both sides
        stay, aim = self._move(index, begin), Aim(plan.preshift)
        ahead: deque[Sample] = deque()
        waiting: deque[Sample] = deque(maxlen=time.after + 1)
        with contextlib.closing(self.reader.blocks(frames, stay.box, aim)) as blocks:
            for t in frames:
                with span("host", f"frame {t}"):
                    ahead.append(self.stays.sample(stay, t, *next(blocks)))
                    if len(ahead) <= after - time.after:
                        continue
                    sample = ahead.popleft()
                    if t - (after - time.after) < begin:
                        continue
                    tensors = stay.engine.push(sample)
                    waiting.append(without_images(sample))
                    del sample
                    if tensors is None:
                        continue
                    self.device.synchronize()
                    stay.engine.set_frame(t - after)
                    maps, codes = self.framed(index, *self.stays.maps(stay, tensors, waiting[0]))
                    if stay.engine.refine and plan.refine:
                        y, x = self.around(index)
                        place = Place(y, x, (stay.wide.y, stay.wide.x), plan.geometry)
                        self.effort += refine_maps(
                            stay.engine.refine, plan.refine, maps, codes, place,
                            curvature=self.curvature(index, maps, codes), wanted=self.wanted(index),
                        )  # fmt: skip
                        self.settle(maps, codes)
                    result = self.cut(index, maps, codes)
                yield plan.unit(first + t - after - plan.frames[first], index), *result

    def _move(self, index: int, first: int = 0) -> Stay:
        """Bring an engine, all frames forgotten, to the measurable rectangle of a band; ``first``: the next frame."""
        plan, (rows, cols) = self.plan, self.extent(index)
        band = Band.of(plan.problem.sampling, rows.stop - rows.start, cols.stop - cols.start, plan.x.step)
        at = self._x[cols.start], self._y[rows.start]
        return self.stays.move(self.engine(band), band, at, Aim(plan.preshift), first)

    def read_alone(self, index: int, frames: range) -> dict[str, float]:
        """Seconds of reading and of decoding a band's images of these frames while nothing else goes on."""
        trace, box, aim = Trace(), self._move(index).box, Aim(self.plan.preshift)
        with active(trace), contextlib.closing(self.reader.blocks(frames, box, aim, ahead=0)) as blocks:
            for _ in blocks:
                pass
        return trace.seconds


def _runs(indices: list[int]) -> Iterator[tuple[int, int]]:
    """First and last of every run of consecutive numbers."""
    start = 0
    for i in range(1, len(indices) + 1):
        if i == len(indices) or indices[i] != indices[i - 1] + 1:
            yield indices[start], indices[i - 1]
            start = i
