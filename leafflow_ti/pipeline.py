"""Execution of a plan: images in, maps of one unit after the other out.

The engine knows no files of results: what becomes of a unit's maps is the caller's business.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Capture
from leafflow_ti.capture.images import read_gray
from leafflow_ti.errors import ConfigError, InputError
from leafflow_ti.growth import DIFFERENCES, INPUTS, growth_maps
from leafflow_ti.plan import Plan, Unit
from leafflow_ti.range_engine import RangeEngine, Sample
from leafflow_ti.runtime import Device
from leafflow_ti.stages.estimate import EstimateStage, View
from leafflow_ti.stages.prefilter import Prefilter
from leafflow_ti.stages.tensor import Band, TensorStage
from leafflow_ti.status import HAS_VALUE, Status

Maps = dict[str, NDArray[np.float32]]


@dataclass
class Timings:
    """Seconds spent per stage."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Add the time of a block to one stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start


@dataclass
class _Engine:
    """The stages for bands of one height: prefilter, tensors of the reference model and of the own flows, estimate."""

    prefilter: Prefilter | None
    tensor: TensorStage
    estimate: EstimateStage
    ranges: RangeEngine | None = None

    def reset(self) -> None:
        """Forget all frames."""
        self.tensor.reset()

    def push(self, sample: Sample) -> tuple[Any, list[Any]] | None:
        """Add a frame of every camera; the tensors once the windows are full."""
        tensor = self.tensor.push(sample.block, sample.valid, sample.factors)
        return None if tensor is None else (tensor, self.tensor.tensors[1:])


class Pipeline:
    """Computes the units of a plan on a device.

    ``timings`` holds the seconds of the stages ``compile``, ``read``, ``prefilter``, ``tensor`` and ``estimate``.
    Raises ConfigError for a mask that does not fit the images.
    """

    def __init__(self, plan: Plan, capture: Capture, device: Device):
        self.plan, self.capture, self.device = plan, capture, device
        self.timings = Timings()
        self._engines: dict[int, _Engine] = {}
        self._mask = _read_mask(plan.config.output.mask, capture)
        # Output pixels of the plan and those around them; rows and columns below count along these.
        self._y, self._x = (_widened(r, n, plan.margin) for r, n in ((plan.y, capture.height), (plan.x, capture.width)))
        self._rows = self._measurable("y", self._y, capture.height, 1)
        self._cols = self._measurable("x", self._x, capture.width, 0)
        inputs = INPUTS if plan.margin else ()
        self._names = tuple(dict.fromkeys((*(n for n in plan.names if not n.startswith("growth")), *inputs)))

    def warm_up(self) -> float:
        """Compile every kernel of the plan on a tiny band; the seconds that it took."""
        from leafflow_ti.kernels.engine import quick_front_end

        with self.timings.of("compile"), quick_front_end():
            plan = self.plan
            band = Band.of(plan.problem.sampling, 1, 1, plan.config.window.stride)
            engine = self._make_engine(band)
            shape = (len(plan.cameras[0]), len(plan.cameras[1]), band.in_rows, band.in_cols)
            if engine.ranges:
                shape = (*shape[:2], engine.ranges.outer.in_rows, engine.ranges.outer.in_cols)
                engine.ranges.move(engine.estimate.view, (0, 0))
            grey = np.random.default_rng(0).random(shape).astype(self.device.real("storage"))
            ok = np.ones(shape[2:], bool)
            sample = Sample(grey, ok, np.zeros(shape[2:], np.uint8))
            if engine.ranges:
                sample = engine.ranges.sample(plan.frames[0], grey, ok, ok)
            tensors = None
            while tensors is None:
                tensors = engine.push(sample)
            engine.estimate(*tensors)
            self.device.synchronize()
        return self.timings.seconds["compile"]

    def run(self, done: set[int], deliver: Callable[[Unit, Maps, NDArray[np.uint8]], None]) -> None:
        """Compute every unit that is not ``done`` and hand over its maps [rows, columns] and status."""
        for band in range(self.plan.bands):
            pending = [t for t in range(len(self.plan.frames)) if self.plan.unit(t, band).index not in done]
            for first, last in _runs(pending):
                for unit, maps, status in self._sequence(band, first, last):
                    deliver(unit, maps, status)

    def _make_engine(self, band: Band) -> _Engine:
        plan, problem = self.plan, self.plan.problem
        own = problem.own_flows.requests if problem.own_flows else ()
        tensor = TensorStage(self.device, problem.columns, plan.layout, problem.sampling, band, own)
        view = self._view((0, 0), band, tensor.out_pitch)
        ranges = RangeEngine(self.device, plan.ranges, problem.sampling, view, band) if plan.ranges else None
        read = ranges.outer if ranges else band
        filters = plan.config.filters
        prefilter = None
        if filters.prefilter != "none":
            prefilter = Prefilter(self.device, filters.prefilter, filters.sigma_pre, read.in_rows, read.in_cols)
        estimate = EstimateStage(self.device, problem, plan.layout, view, bool(plan.margin))
        return _Engine(prefilter, tensor, estimate, ranges)

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

    def _sequence(self, index: int, first: int, last: int) -> Iterator[tuple[Unit, Maps, NDArray[np.uint8]]]:
        """The units of one band for the output frames first..last, sliding through the sequence.

        Only the rectangle of measurable pixels is computed; what lies around it is border.
        """
        plan = self.plan
        whole = self._around(plan.band(index))
        rows = slice(max(whole.start, self._rows.start), min(whole.stop, self._rows.stop))
        cols = self._cols
        if rows.start >= rows.stop or cols.start >= cols.stop:
            for t_index in range(first, last + 1):
                yield plan.unit(t_index, index), *self._frame_of(index, {}, None, None)
            return
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
        allowed = self._inside(band, corner)
        place = (slice(rows.start - whole.start, rows.stop - whole.start), cols)
        latency = engine.tensor.latency
        samples: dict[int, Sample] = {}
        for t in range(plan.frames[first] - latency, plan.frames[last] + latency + 1):
            block, finite = self._read(t, band, corner, engine.prefilter)
            with self.timings.of("tensor"):
                if engine.ranges:
                    samples[t] = engine.ranges.sample(t, block, allowed & finite, finite)
                else:
                    status = np.where(finite, np.uint8(Status.OK), np.uint8(Status.NOT_FINITE))
                    samples[t] = Sample(block, allowed & finite, status)
                tensors = engine.push(samples[t])
                self.device.synchronize()
            frame = t - latency
            samples.pop(frame - 1, None)
            if tensors is None:
                continue
            with self.timings.of("estimate"):
                maps, status = self._maps(engine.estimate(*tensors), samples[frame], centre)
                unit = plan.unit(first + frame - plan.frames[first], index)
                result = self._frame_of(index, maps, status, place)
            yield unit, *result

    def _around(self, rows: slice) -> slice:
        """Rows of the plan, and those that are computed around them."""
        first, margin = int(self._y[0] != self.plan.y[0]), self.plan.margin
        return slice(max(0, rows.start + first - margin), min(len(self._y), rows.stop + first + margin))

    def _frame_of(
        self, band: int, maps: Maps, status: NDArray[np.uint8] | None, place: tuple[slice, slice] | None
    ) -> tuple[Maps, NDArray[np.uint8]]:
        """The unit's maps with the measured rectangle at ``place`` within the rows around it; border around that,
        masked where the mask says."""
        plan = self.plan
        whole = self._around(plan.band(band))
        y, x = self._y[whole], self._x
        shape = (len(y), len(x))
        codes = np.full(shape, Status.BORDER, np.uint8)
        framed = {name: np.full(shape, np.nan, np.float32) for name in self._names}
        if place is not None and status is not None:
            codes[place] = status
        if self._mask is not None:
            codes[~self._mask[np.ix_(y, x)]] = Status.MASKED
        if place is not None:
            empty = ~np.isin(codes[place], HAS_VALUE)
            for name, values in maps.items():
                values[empty] = np.nan
                framed[name][place] = values
        if plan.margin:
            geometry, sampling = plan.geometry, plan.problem.sampling
            growth = growth_maps(framed, y, x, geometry.f_px, geometry.principal_px, sampling)
            framed.update({name: values.astype(np.float32) for name, values in growth.items()})
        unit = plan.y[plan.band(band)]
        inner = slice(y.index(unit[0]), y.index(unit[-1]) + 1), slice(x.index(plan.x[0]), x.index(plan.x[-1]) + 1)
        return {n: framed[n][inner].copy() for n in plan.names}, codes[inner].copy()

    def _read(
        self, t: int, band: Band, corner: tuple[int, int], prefilter: Prefilter | None
    ) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Preshifted, prefiltered block [sy, sx, in_rows, in_cols], 0 where not finite, and where all were finite."""
        radius = prefilter.radius if prefilter else 0
        (y0, x0), (rows, cols) = (n - radius for n in corner), (n + 2 * radius for n in (band.in_rows, band.in_cols))
        with self.timings.of("read"):
            block = self.capture.block(
                [t], *self.plan.cameras, y0, y0 + rows, x0, x0 + cols, self.plan.preshift, self.device.real("storage")
            )[0]
            finite = np.isfinite(block)
        if prefilter:
            with self.timings.of("prefilter"):
                in_y, in_x = self._seen(y0 + np.arange(rows), x0 + np.arange(cols))
                valid = finite & in_y[:, None, :, None] & in_x[None, :, None, :]
                if self.plan.config.filters.prefilter == "homomorphic":
                    self._require_positive(block, valid, t, (y0, x0))
                stack = (-1, rows, cols)
                inner = slice(radius, rows - radius), slice(radius, cols - radius)
                finite = finite[:, :, *inner]
                block = prefilter(block.reshape(stack), valid.reshape(stack)).reshape(finite.shape)
        elif not finite.all():
            block = np.where(finite, block, 0)
        return block, finite.all(axis=(0, 1))

    def _require_positive(self, block: NDArray[Any], valid: NDArray[np.bool_], t: int, corner: tuple[int, int]) -> None:
        """Raise InputError for the first grey value that has no logarithm."""
        wrong = valid & (block <= 0)
        if not wrong.any():
            return
        j, k, row, col = (int(n) for n in np.argwhere(wrong)[0])
        sy, sx = self.plan.cameras[0][j], self.plan.cameras[1][k]
        x = corner[1] + col + self.plan.preshift[0] * (sx - self.capture.reference[1])
        y = corner[0] + row + self.plan.preshift[1] * (sy - self.capture.reference[0])
        raise InputError(
            f"{self.capture.image_name(t, sy, sx)}: grey value {block[j, k, row, col]:g} at pixel x = {x}, y = {y}: "
            "prefilter homomorphic takes logarithms and needs values above 0: choose prefilter highpass, or add an "
            "offset to the images"
        )

    def _seen(self, y: NDArray[np.intp], x: NDArray[np.intp]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which rows ``y`` [cameras along y, n] and columns ``x`` [cameras along x, n] of blocks lie inside images."""
        capture, shift = self.capture, self.plan.preshift
        rows, cols = (
            np.array(cameras)[:, None] - n for cameras, n in zip(self.plan.cameras, capture.reference, strict=True)
        )
        in_y, in_x = y + shift[1] * rows, x + shift[0] * cols
        return (in_y >= 0) & (in_y < capture.height), (in_x >= 0) & (in_x < capture.width)

    def _inside(self, band: Band, corner: tuple[int, int]) -> NDArray[np.bool_]:
        """Where every camera sees its image and the mask allows a measurement: [in_rows, in_cols]."""
        capture = self.capture
        y, x = corner[0] + np.arange(band.in_rows), corner[1] + np.arange(band.in_cols)
        in_y, in_x = (np.logical_and.reduce(seen) for seen in self._seen(y, x))
        inside = in_y[:, None] & in_x
        if self._mask is None:
            return np.asarray(inside)
        kept = self._mask[np.clip(y, 0, capture.height - 1)[:, None], np.clip(x, 0, capture.width - 1)]
        return np.asarray(inside & kept)

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
            if name in sample.maps:
                maps[name] = sample.maps[name][centre].astype(np.float32)
            else:
                maps[name] = planes[_plane_of(base) + (Output.STD if name != base else 0)].astype(np.float32)
        has_value = np.isin(status, HAS_VALUE)
        for values in maps.values():
            # A degenerate window can defeat the arithmetic: no NaN without a status that says so.
            status[has_value & ~np.isfinite(values)] = Status.NOT_CONVERGED
        return maps, status


def _plane_of(name: str) -> int:
    from leafflow_ti.kernels.maps import Output
    from leafflow_ti.plan import MOTION_NAMES

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


def _read_mask(path: Path | None, capture: Capture) -> NDArray[np.bool_] | None:
    if path is None:
        return None
    mask: NDArray[np.bool_] = np.asarray(read_gray(path)) != 0
    if mask.shape != (capture.height, capture.width):
        found, wanted = (f"{shape[1]} x {shape[0]}" for shape in (mask.shape, (capture.height, capture.width)))
        raise ConfigError(f"{path}: a mask of {found} pixels for images of {wanted}: make it the same size")
    return mask
