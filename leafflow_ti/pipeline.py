"""Execution of a plan: images in, maps of one unit after the other out.

The engine knows no files of results: what becomes of a unit's maps is the caller's business.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Generator, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.aim import Aim
from leafflow_ti.capture import Capture
from leafflow_ti.engines import Engine, keep
from leafflow_ti.field import empty_map
from leafflow_ti.growth import growth_maps
from leafflow_ti.identify import settle
from leafflow_ti.plan import Plan, Unit
from leafflow_ti.range_engine import Sample
from leafflow_ti.reading import Mask, Reader
from leafflow_ti.refine_plan import Effort
from leafflow_ti.refinement import Place, refine_maps, refine_middle
from leafflow_ti.runtime import Device
from leafflow_ti.stages.tensor import Band
from leafflow_ti.status import HAS_VALUE, Status
from leafflow_ti.stays import Maps, Stay, Stays, without_images
from leafflow_ti.trace import Trace, active, span


class Pipeline:
    """Computes the units of a plan on a device.

    ``trace`` holds the seconds of the stages; ``apart``: with the stages ``solve`` and ``fit`` instead of ``estimate``,
    which is both in one go. Raises ConfigError for a mask that does not fit the images.
    """

    def __init__(self, plan: Plan, capture: Capture, device: Device, trace: Trace | None = None, apart: bool = False):
        self._apart = apart
        self.plan, self.capture, self.device = plan, capture, device
        self.trace = trace or Trace()
        self.reader = Reader(plan, capture, device.real("storage"))
        self.stays = Stays(plan, self.reader)
        self._engines: dict[Band, Engine] = {}
        # Output pixels of the plan and those around them; rows and columns below count along these.
        self._y, self._x = (_widened(r, n, plan.margin) for r, n in ((plan.y, capture.height), (plan.x, capture.width)))
        self._rows = self._measurable("y", self._y, capture.height, 1)
        self._cols = self._measurable("x", self._x, capture.width, 0)
        self.effort = Effort()
        """Of the refinement in all units so far."""

    def warm_up(self) -> float:
        """Compile every kernel of the plan on a tiny band; the seconds that it took."""
        from leafflow_ti.kernels.engine import quick_front_end

        # The work on the tiny band is no stage of its own: it all counts as compiling.
        with active(None), self.trace.span("compile"), quick_front_end():
            self._one_pixel(None)
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

        while (tensors := one_more()) is None:
            pass
        estimate(tensors)
        if trace is not None:
            with active(trace):
                estimate(one_more())
        self.device.synchronize()

    def run(self, done: set[int], deliver: Callable[[Unit, Maps, NDArray[np.uint8]], None]) -> None:
        """Compute every unit that is not ``done`` and hand over its maps [rows, columns] and status."""
        if self.plan.adaptive:
            self._run_adaptive(done, deliver)
            return
        for band in range(self.plan.bands):
            pending = [t for t in range(len(self.plan.frames)) if self.plan.unit(t, band).index not in done]
            for first, last in _runs(pending):
                with active(self.trace), contextlib.closing(self._sequence(band, first, last)) as units:
                    for unit, maps, status in units:
                        deliver(unit, maps, status)

    def _run_adaptive(self, done: set[int], deliver: Callable[[Unit, Maps, NDArray[np.uint8]], None]) -> None:
        """Frame by frame: the bands of a frame share what its search has found."""
        from leafflow_ti.adaptive import Adaptive

        adaptive, bands = Adaptive(self), range(self.plan.bands)
        for t_index in range(len(self.plan.frames)):
            pending = [b for b in bands if self.plan.unit(t_index, b).index not in done]
            if pending:
                with active(self.trace):
                    for unit, maps, status in adaptive.units(t_index, pending):
                        deliver(unit, maps, status)

    def _make_engine(self, band: Band) -> Engine:
        first, aim = (self._x[0], self._y[0]), Aim(self.plan.preshift)
        return Engine.of(self.device, self.plan, band, lambda n: self.stays.view(first, band, n, aim), self._apart)

    @property
    def mask(self) -> Mask | None:
        """Pixels [height, width] that may be measured; None: all."""
        return self.reader.mask

    def keep(self) -> None:
        """Keep the stages of the last bands for the next estimate."""
        for engine in self._engines.values():
            keep(engine, self.plan)

    def release(self) -> None:
        """Give back the memory of the stages; they are made again when needed."""
        self._engines.clear()

    def _measurable(self, axis: str, positions: range, size: int, pair: int) -> slice:
        """Output rows or columns whose window (``border`` "full") or centre ("clip") lies inside all images.

        ``pair``: where the axis stands in pairs (x, y); cameras are (rows, columns).
        """
        plan = self.plan
        if plan.adaptive:
            return slice(0, len(positions))  # what is left of a window decides, pass by pass
        reach = plan.reach(axis) if plan.config.window.border == "full" else 0
        shifts = [plan.preshift[pair] * (k - self.capture.reference[1 - pair]) for k in plan.cameras[1 - pair]]
        first, last = reach - min(shifts), size - 1 - reach - max(shifts)
        inside = [i for i, p in enumerate(positions) if first <= p <= last]
        return slice(inside[0], inside[-1] + 1) if inside else slice(0, 0)

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
        stay, aim = self._move(index), Aim(plan.preshift)
        latency = stay.engine.tensor.latency
        frames = range(plan.frames[first] - latency, plan.frames[last] + latency + 1)
        waiting: deque[Sample] = deque(maxlen=latency + 1)
        with contextlib.closing(self.reader.blocks(frames, stay.box, aim)) as blocks:
            for t in frames:
                with span("host", f"frame {t}"):
                    sample, tensors = self.stays.push(stay, t, *next(blocks))
                    waiting.append(without_images(sample))
                    del sample
                    if tensors is None:
                        continue
                    self.device.synchronize()
                    maps, codes = self.framed(index, *self.stays.maps(stay, tensors, waiting[0]))
                    if stay.engine.refine and plan.refine:
                        y, x = self.around(index)
                        place = Place(y, x, (stay.wide.y, stay.wide.x), plan.geometry)
                        self.effort += refine_maps(stay.engine.refine, plan.refine, maps, codes, place)
                    result = self.cut(index, maps, codes)
                yield plan.unit(first + t - latency - plan.frames[first], index), *result

    def _move(self, index: int) -> Stay:
        """Bring an engine, all frames forgotten, to the measurable rectangle of a band."""
        plan, (rows, cols) = self.plan, self.extent(index)
        band = Band.of(plan.problem.sampling, rows.stop - rows.start, cols.stop - cols.start, plan.x.step)
        at = self._x[cols.start], self._y[rows.start]
        return self.stays.move(self.engine(band), band, at, Aim(plan.preshift))

    def engine(self, band: Band) -> Engine:
        """The stages for a band of this size; those for the last one are kept."""
        if band not in self._engines:
            self._engines.clear()  # bands come in order: one engine's memory at a time
            self._engines[band] = self._make_engine(band)
        return self._engines[band]

    def read_alone(self, index: int, frames: range) -> dict[str, float]:
        """Seconds of reading and of decoding a band's images of these frames while nothing else goes on."""
        trace, box, aim = Trace(), self._move(index).box, Aim(self.plan.preshift)
        with active(trace), contextlib.closing(self.reader.blocks(frames, box, aim, ahead=0)) as blocks:
            for _ in blocks:
                pass
        return trace.seconds

    def extent(self, index: int) -> tuple[slice, slice]:
        """Rows and columns of a band that are computed, those for the sake of others included; empty: all border."""
        whole = self._around(self.plan.band(index))
        first = max(whole.start, self._rows.start)
        return slice(first, max(first, min(whole.stop, self._rows.stop))), self._cols

    def _around(self, rows: slice) -> slice:
        """Rows of the plan, and those that are computed around them."""
        first, margin = int(self._y[0] != self.plan.y[0]), self.plan.margin
        return slice(max(0, rows.start + first - margin), min(len(self._y), rows.stop + first + margin))

    def around(self, index: int) -> tuple[range, range]:
        """Image rows and columns of a band's output pixels and of those that are computed around them."""
        return self._y[self._around(self.plan.band(index))], self._x

    def framed(
        self,
        index: int,
        maps: Maps | None = None,
        status: NDArray[np.uint8] | None = None,
        joined: tuple[Mask, Mask] | None = None,
    ) -> tuple[Maps, NDArray[np.uint8]]:
        """Maps and status of a band and what is computed around it, with what was measured at its place.

        Border around that, masked where the mask says; growth from the velocity's differences between pixels that are
        ``joined`` (as of ``growth_maps``).
        """
        plan, (y, x) = self.plan, self.around(index)
        shape = (len(y), len(x))
        codes = np.full(shape, Status.BORDER, np.uint8)
        framed: Maps = {name: empty_map(name, shape) for name in self.stays.names}
        whole, (rows, cols) = self._around(plan.band(index)), self.extent(index)
        place = (slice(rows.start - whole.start, rows.stop - whole.start), cols)
        if status is not None:
            codes[place] = status
        if self.reader.mask is not None:
            codes[~self.reader.mask[np.ix_(y, x)]] = Status.MASKED
        empty = ~np.isin(codes[place], HAS_VALUE)
        for name, values in (maps or {}).items():
            values[empty] = empty_map(name, ())
            framed[name][place] = values
        if plan.differences:
            geometry, sampling = plan.geometry, plan.problem.sampling
            growth = growth_maps(framed, y, x, geometry.f_px, geometry.principal_px, sampling, joined)
            framed.update({name: values.astype(np.float32) for name, values in growth.items()})
        return framed, codes

    def cut(self, index: int, maps: Maps, codes: NDArray[np.uint8]) -> tuple[Maps, NDArray[np.uint8]]:
        """The maps of a band alone, and its status."""
        plan, (y, x) = self.plan, self.around(index)
        if plan.refine:
            maps["identified"] = settle(maps, codes, plan.limits)
        unit = plan.y[plan.band(index)]
        inner = slice(y.index(unit[0]), y.index(unit[-1]) + 1), slice(x.index(plan.x[0]), x.index(plan.x[-1]) + 1)
        return {n: maps[n][inner].copy() for n in plan.names}, codes[inner].copy()


def _widened(positions: range, size: int, margin: int) -> range:
    """The positions, and up to ``margin`` more on each side where these lie within 0..size - 1."""
    step, last = positions.step, positions[-1]
    before, behind = min(margin, positions.start // step), min(margin, (size - 1 - last) // step)
    return range(positions.start - step * before, last + step * behind + 1, step)


def _runs(indices: list[int]) -> Iterator[tuple[int, int]]:
    """First and last of every run of consecutive numbers."""
    start = 0
    for i in range(1, len(indices) + 1):
        if i == len(indices) or indices[i] != indices[i - 1] + 1:
            yield indices[start], indices[i - 1]
            start = i
