"""Execution of a plan: images in, maps of one unit after the other out.

The engine knows no files of results: what becomes of a unit's maps is the caller's business.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Capture
from leafflow_ti.engines import Engine, keep
from leafflow_ti.field import MOTION_NAMES, empty_map, with_std
from leafflow_ti.growth import DIFFERENCES, INPUTS, growth_maps
from leafflow_ti.identify import settle
from leafflow_ti.plan import Plan, Unit
from leafflow_ti.range_engine import Sample
from leafflow_ti.reading import Box, Reader
from leafflow_ti.refine_plan import Effort
from leafflow_ti.refinement import PARAMETERS, Place, refine_maps, refine_middle
from leafflow_ti.runtime import Device
from leafflow_ti.stages.estimate import View
from leafflow_ti.stages.prefilter import Prefilter
from leafflow_ti.stages.tensor import Band
from leafflow_ti.status import HAS_VALUE, Status
from leafflow_ti.trace import Trace, active, span

Maps = dict[str, NDArray[Any]]
_NO_IMAGES: NDArray[Any] = np.empty((0, 0, 0, 0), np.float32)


@dataclass(frozen=True)
class _Stay:
    """An engine over one band. ``box``: block of images that it needs, with the prefilter's margin; ``wide``: without
    it, as the refinement takes it; ``inner``: its part that the tensors take; ``allowed`` [rows, cols] of that: pixels
    that may count; ``place``: of the computed rectangle among the rows around the band; ``centre``: pixels of the inner
    block at the output positions."""

    engine: Engine
    box: Box
    wide: Box
    inner: tuple[slice, slice]
    allowed: NDArray[np.bool_]
    place: tuple[slice, slice]
    centre: tuple[slice, slice]


class Pipeline:
    """Computes the units of a plan on a device.

    ``trace`` holds the seconds of the stages; ``apart``: with the stages ``solve`` and ``fit`` instead of ``estimate``,
    which is both in one go. Raises ConfigError for a mask that does not fit the images.
    """

    def __init__(self, plan: Plan, capture: Capture, device: Device, trace: Trace | None = None, apart: bool = False):
        self._apart = apart
        self.plan, self.capture, self.device = plan, capture, device
        self.trace = trace or Trace()
        self._reader = Reader(plan, capture, device.real("storage"))
        self._engines: dict[int, Engine] = {}
        # Output pixels of the plan and those around them; rows and columns below count along these.
        self._y, self._x = (_widened(r, n, plan.margin) for r, n in ((plan.y, capture.height), (plan.x, capture.width)))
        self._rows = self._measurable("y", self._y, capture.height, 1)
        self._cols = self._measurable("x", self._x, capture.width, 0)
        # What a map's user is told depends on the standard errors of others, so all are there.
        wanted = with_std(n for n in (*plan.quantities, *(PARAMETERS if plan.refine else ())) if n != "growth_rate")
        self._names = tuple(dict.fromkeys((*wanted, *(INPUTS if plan.differences else ()))))
        self.effort = Effort()
        """Of the refinement in all units so far."""
        self._measured = {*plan.measured, *(INPUTS if plan.differences else ())}

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
        for band in range(self.plan.bands):
            pending = [t for t in range(len(self.plan.frames)) if self.plan.unit(t, band).index not in done]
            for first, last in _runs(pending):
                with active(self.trace), contextlib.closing(self._sequence(band, first, last)) as units:
                    for unit, maps, status in units:
                        deliver(unit, maps, status)

    def _make_engine(self, band: Band) -> Engine:
        return Engine.of(self.device, self.plan, band, lambda pitch: self._view((0, 0), band, pitch), self._apart)

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
        reach = plan.reach(axis) if plan.config.window.border == "full" else 0
        shifts = [plan.preshift[pair] * (k - self.capture.reference[1 - pair]) for k in plan.cameras[1 - pair]]
        first, last = reach - min(shifts), size - 1 - reach - max(shifts)
        inside = [i for i, p in enumerate(positions) if first <= p <= last]
        return slice(inside[0], inside[-1] + 1) if inside else slice(0, 0)

    def _view(self, corner: tuple[int, int], band: Band, pitch: int) -> View:
        """The output grid whose first pixel is (row, column) ``corner``."""
        plan, geometry = self.plan, self.plan.geometry
        offset = geometry.disparity_offset_px
        shift = (plan.preshift[0] + offset[0], plan.preshift[1] + offset[1])
        return View(
            geometry.f_px, geometry.principal_px, geometry.baseline_mm, shift,
            self._x[corner[1]], self._y[corner[0]], plan.x.step, band.rows, band.cols, pitch,
        )  # fmt: skip

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
                yield plan.unit(t_index, index), *self._frame_of(index, {}, None, None)
            return
        stay = self._move(index)
        engine, latency = stay.engine, stay.engine.tensor.latency
        frames = range(plan.frames[first] - latency, plan.frames[last] + latency + 1)
        waiting: deque[Sample] = deque(maxlen=latency + 1)
        with contextlib.closing(self._reader.blocks(frames, stay.box)) as blocks:
            for t in frames:
                with span("host", f"frame {t}"):
                    sample = self._sample(stay, t, *self._prepared(stay, t, *next(blocks)))
                    tensors = engine.push(sample)
                    waiting.append(replace(sample, block=_NO_IMAGES))  # its images may go
                    del sample
                    if tensors is None:
                        continue
                    self.device.synchronize()
                    maps, status = self._maps(engine.estimate(tensors), waiting[0], stay.centre)
                    result = self._frame_of(index, maps, status, stay)
                yield plan.unit(first + t - latency - plan.frames[first], index), *result

    def _move(self, index: int) -> _Stay:
        """Bring an engine, all frames forgotten, to the measurable rectangle of a band."""
        plan = self.plan
        whole, (rows, cols) = self._around(plan.band(index)), self.extent(index)
        band = Band.of(plan.problem.sampling, rows.stop - rows.start, cols.stop - cols.start, plan.x.step)
        if band.rows not in self._engines:
            self._engines.clear()  # bands come in order: one engine's memory at a time
            self._engines[band.rows] = self._make_engine(band)
        engine = self._engines[band.rows]
        engine.reset()
        engine.estimate.set_view(self._view((rows.start, cols.start), band, engine.tensor.out_pitch))
        corner = (self._y[rows.start] - band.halo_y, self._x[cols.start] - band.halo_x)
        centre = _centres(band)
        if engine.ranges:
            band, corner = engine.ranges.outer, engine.ranges.move(engine.estimate.view, corner)
        inner = Box(*corner, band.in_rows, band.in_cols)
        wide = inner.widened(engine.widening)
        if engine.refine:
            engine.refine.set_mask(self._reader.masked(wide))
        margin = engine.prefilter.radius if engine.prefilter else 0
        place = (slice(rows.start - whole.start, rows.stop - whole.start), cols)
        within = (
            slice(engine.widening, engine.widening + inner.rows),
            slice(engine.widening, engine.widening + inner.cols),
        )
        return _Stay(engine, wide.widened(margin), wide, within, self._reader.inside(inner), place, centre)

    def read_alone(self, index: int, frames: range) -> dict[str, float]:
        """Seconds of reading and of decoding a band's images of these frames while nothing else goes on."""
        trace, box = Trace(), self._move(index).box
        with active(trace), contextlib.closing(self._reader.blocks(frames, box, ahead=0)) as blocks:
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

    def _frame_of(
        self, band: int, maps: Maps, status: NDArray[np.uint8] | None, stay: _Stay | None
    ) -> tuple[Maps, NDArray[np.uint8]]:
        """The unit's maps with the measured rectangle at its place within the rows around it; border around that,
        masked where the mask says."""
        plan = self.plan
        whole = self._around(plan.band(band))
        y, x = self._y[whole], self._x
        shape = (len(y), len(x))
        codes = np.full(shape, Status.BORDER, np.uint8)
        framed: Maps = {name: empty_map(name, shape) for name in self._names}
        if stay is not None and status is not None:
            codes[stay.place] = status
        if self._reader.mask is not None:
            codes[~self._reader.mask[np.ix_(y, x)]] = Status.MASKED
        if stay is not None:
            empty = ~np.isin(codes[stay.place], HAS_VALUE)
            for name, values in maps.items():
                values[empty] = empty_map(name, ())
                framed[name][stay.place] = values
        if plan.differences:
            geometry, sampling = plan.geometry, plan.problem.sampling
            growth = growth_maps(framed, y, x, geometry.f_px, geometry.principal_px, sampling)
            framed.update({name: values.astype(np.float32) for name, values in growth.items()})
        if stay is not None and stay.engine.refine and plan.refine:
            place = Place(y, x, (stay.wide.y, stay.wide.x), plan.geometry)
            self.effort += refine_maps(stay.engine.refine, plan.refine, framed, codes, place)
            framed["identified"] = settle(framed, codes, plan.limits)
        unit = plan.y[plan.band(band)]
        inner = slice(y.index(unit[0]), y.index(unit[-1]) + 1), slice(x.index(plan.x[0]), x.index(plan.x[-1]) + 1)
        return {n: framed[n][inner].copy() for n in plan.names}, codes[inner].copy()

    def _prepared(
        self, stay: _Stay, t: int, block: NDArray[Any], finite: NDArray[np.bool_]
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """One frame's images and where they are finite, prefiltered, as the tensors take them; the refinement takes
        its wider ones."""
        engine = stay.engine
        if engine.prefilter:
            block, finite = self._prefiltered(engine.prefilter, t, block, finite, stay.box)
        if not engine.refine:
            return block, finite
        engine.refine.push(block, finite & self._seen(stay.wide))
        within = (..., *stay.inner)
        return np.ascontiguousarray(block[within]), finite[within]

    def _seen(self, box: Box) -> NDArray[np.bool_]:
        """Where the pixels of a block lie inside the images of each camera, [sy, sx, rows, cols]."""
        in_y, in_x = self._reader.seen(box.y + np.arange(box.rows), box.x + np.arange(box.cols))
        return in_y[:, None, :, None] & in_x[None, :, None, :]

    def _sample(self, stay: _Stay, t: int, block: NDArray[Any], finite: NDArray[np.bool_]) -> Sample:
        """What the tensor stages take: one frame's images [sy, sx, rows, cols] of a stay."""
        engine, allowed = stay.engine, stay.allowed
        everywhere = np.asarray(finite.all(axis=(0, 1)))
        if engine.ranges:
            return engine.ranges.sample(t, block, allowed & everywhere, everywhere)
        status = np.where(everywhere, np.uint8(Status.OK), np.uint8(Status.NOT_FINITE))
        return Sample(block, allowed & everywhere, status)

    def _prefiltered(
        self, prefilter: Prefilter, t: int, block: NDArray[Any], finite: NDArray[np.bool_], box: Box
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """The block without the prefilter's margin, and where it is finite."""
        with span("prefilter"):
            valid = finite & self._seen(box)
            if self.plan.config.filters.prefilter == "homomorphic":
                self._reader.require_positive(block, valid, t, box)
            stack, r = (-1, box.rows, box.cols), prefilter.radius
            finite = finite[:, :, r : box.rows - r, r : box.cols - r]
            return prefilter(block.reshape(stack), valid.reshape(stack)).reshape(finite.shape), finite

    def _maps(
        self, planes: NDArray[Any], sample: Sample, centre: tuple[slice, slice]
    ) -> tuple[Maps, NDArray[np.uint8]]:
        """Named maps and the status of the measured rectangle."""
        from leafflow_ti.kernels.maps import Output

        status = planes[Output.STATUS].astype(np.uint8)
        reason = sample.status[centre]
        status[reason != Status.OK] = reason[reason != Status.OK]
        maps = {}
        for name in self._names:
            base = name.removesuffix("_std")
            if base not in self._measured or name == "identified":
                continue
            if name in sample.maps:
                maps[name] = sample.maps[name][centre].astype(np.float32)
            else:
                maps[name] = planes[plane_of(base) + (Output.STD if name != base else 0)].astype(np.float32)
        found = settle(maps, status, self.plan.limits)
        # Texture in all directions, and nothing determined: the window is too small, or degenerate.
        status[(status == Status.OK) & (found == 0)] = Status.NOT_CONVERGED
        return {**maps, "identified": found}, status


def plane_of(name: str) -> int:
    from leafflow_ti.kernels.maps import Output

    if name in MOTION_NAMES:
        return Output.MOTION + MOTION_NAMES.index(name)
    if name in DIFFERENCES:
        return Output.DIFFERENCES + DIFFERENCES.index(name)
    return int(Output[name.upper()])


def _widened(positions: range, size: int, margin: int) -> range:
    """The positions, and up to ``margin`` more on each side where these lie within 0..size - 1."""
    step, last = positions.step, positions[-1]
    before, behind = min(margin, positions.start // step), min(margin, (size - 1 - last) // step)
    return range(positions.start - step * before, last + step * behind + 1, step)


def _centres(band: Band) -> tuple[slice, slice]:
    """The block's pixels at the output positions."""
    return (
        slice(band.halo_y, band.halo_y + (band.rows - 1) * band.stride + 1, band.stride),
        slice(band.halo_x, band.halo_x + (band.cols - 1) * band.stride + 1, band.stride),
    )


def _runs(indices: list[int]) -> Iterator[tuple[int, int]]:
    """First and last of every run of consecutive numbers."""
    start = 0
    for i in range(1, len(indices) + 1):
        if i == len(indices) or indices[i] != indices[i - 1] + 1:
            yield indices[start], indices[i - 1]
            start = i
