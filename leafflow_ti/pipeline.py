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
from leafflow_ti.errors import ConfigError
from leafflow_ti.models import TensorLayout
from leafflow_ti.plan import Plan, Unit
from leafflow_ti.runtime import Device
from leafflow_ti.stages.estimate import EstimateStage, View
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
    """The stages for bands of one height: tensor of the reference model, tensors of the own flows, estimate.

    ``inner``: the cameras of a block under the filters and window of the reference model; ``own_cameras``: place of
    each own flow's camera in a block.
    """

    tensor: TensorStage
    own: list[TensorStage]
    estimate: EstimateStage
    inner: tuple[slice, slice]
    own_cameras: list[tuple[slice, slice]]

    def reset(self) -> None:
        """Forget all frames."""
        for stage in (self.tensor, *self.own):
            stage.reset()

    def push(self, block: NDArray[Any], valid: NDArray[np.bool_]) -> tuple[Any, list[Any]] | None:
        """Add a frame [sy, sx, rows, cols] of every camera; the tensors once the windows are full."""
        tensor = self.tensor.push(block[self.inner], valid)
        own = [stage.push(block[at], valid) for stage, at in zip(self.own, self.own_cameras, strict=True)]
        return None if tensor is None else (tensor, own)


class Pipeline:
    """Computes the units of a plan on a device.

    ``timings`` holds the seconds of the stages ``compile``, ``read``, ``tensor`` and ``estimate``.
    Raises ConfigError for a mask that does not fit the images.
    """

    def __init__(self, plan: Plan, capture: Capture, device: Device):
        self.plan, self.capture, self.device = plan, capture, device
        self.timings = Timings()
        self._engines: dict[int, _Engine] = {}
        self._mask = _read_mask(plan.config.output.mask, capture)
        self._rows = self._measurable("y", plan.y, capture.height, 1)
        self._cols = self._measurable("x", plan.x, capture.width, 0)

    def warm_up(self) -> float:
        """Compile every kernel of the plan on a tiny band; the seconds that it took."""
        from leafflow_ti.kernels.engine import quick_front_end

        with self.timings.of("compile"), quick_front_end():
            plan = self.plan
            band = Band.of(plan.problem.sampling, 1, 1, plan.config.window.stride)
            engine = self._make_engine(band)
            shape = (len(plan.cameras[0]), len(plan.cameras[1]), band.in_rows, band.in_cols)
            grey = np.random.default_rng(0).random(shape).astype(self.device.real("storage"))
            tensors = None
            while tensors is None:
                tensors = engine.push(grey, np.ones(shape[2:], bool))
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
        tensor = TensorStage(self.device, problem.columns, plan.layout, problem.sampling, band)
        view = self._view((0, 0), band, tensor.out_pitch)
        own = problem.own_flows
        stages: list[TensorStage] = []
        places: list[tuple[slice, slice]] = []
        first = [cameras[0] - at for cameras, at in zip(plan.cameras, self.capture.reference, strict=True)]
        if own:
            layout = TensorLayout.of(own.columns)
            stages = [TensorStage(self.device, own.columns, layout, own.sampling, band) for _ in own.steps]
            for x, y in own.steps:
                places.append((slice(y - first[0], y - first[0] + 1), slice(x - first[1], x - first[1] + 1)))
        sy, sx = (slice(-f - axis.radius, -f + axis.radius + 1) for f, axis in zip(
            first, (problem.sampling.sy, problem.sampling.sx), strict=True
        ))  # fmt: skip
        return _Engine(tensor, stages, EstimateStage(self.device, problem, plan.layout, view), (sy, sx), places)

    def _measurable(self, axis: str, positions: range, size: int, pair: int) -> slice:
        """Output rows or columns whose window (``border`` "full") or centre ("clip") lies inside all images.

        ``pair``: where the axis stands in pairs (x, y); cameras are (rows, columns).
        """
        plan = self.plan
        reach = plan.problem.sampling.axis(axis).radius if plan.config.window.border == "full" else 0
        shifts = [plan.preshift[pair] * (k - self.capture.reference[1 - pair]) for k in plan.cameras[1 - pair]]
        first, last = reach - min(shifts), size - 1 - reach - max(shifts)
        inside = [i for i, p in enumerate(positions) if first <= p <= last]
        return slice(inside[0], inside[-1] + 1) if inside else slice(0, 0)

    def _view(self, corner: tuple[int, int], band: Band, pitch: int) -> View:
        """The output grid whose first pixel is (row, column) ``corner`` of the plan."""
        plan, geometry = self.plan, self.plan.geometry
        offset = geometry.disparity_offset_px
        shift = (plan.preshift[0] + offset[0], plan.preshift[1] + offset[1])
        return View(
            geometry.f_px, geometry.principal_px, geometry.baseline_mm, shift,
            plan.x[corner[1]], plan.y[corner[0]], plan.x.step, band.rows, band.cols, pitch,
        )  # fmt: skip

    def _sequence(self, index: int, first: int, last: int) -> Iterator[tuple[Unit, Maps, NDArray[np.uint8]]]:
        """The units of one band for the output frames first..last, sliding through the sequence.

        Only the rectangle of measurable pixels is computed; what lies around it is border.
        """
        plan = self.plan
        whole = plan.band(index)
        rows = slice(max(whole.start, self._rows.start), min(whole.stop, self._rows.stop))
        cols = self._cols
        if rows.start >= rows.stop or cols.start >= cols.stop:
            for t_index in range(first, last + 1):
                yield plan.unit(t_index, index), *self._frame_of(whole, {}, None, None)
            return
        band = Band.of(plan.problem.sampling, rows.stop - rows.start, cols.stop - cols.start, plan.x.step)
        if band.rows not in self._engines:
            self._engines[band.rows] = self._make_engine(band)
        engine = self._engines[band.rows]
        engine.reset()
        engine.estimate.set_view(self._view((rows.start, cols.start), band, engine.tensor.out_pitch))
        corner = (plan.y[rows.start] - band.halo_y, plan.x[cols.start] - band.halo_x)
        inside, kept = self._inside(band, corner)
        centre = _centres(band)
        place = (slice(rows.start - whole.start, rows.stop - whole.start), cols)
        latency = engine.tensor.latency
        finite: dict[int, NDArray[np.bool_]] = {}
        for t in range(plan.frames[first] - latency, plan.frames[last] + latency + 1):
            with self.timings.of("read"):
                block, finite[t] = self._read(t, band, corner)
            with self.timings.of("tensor"):
                tensors = engine.push(block, inside & kept & finite[t])
                self.device.synchronize()
            frame = t - latency
            finite.pop(frame - 1, None)
            if tensors is None:
                continue
            with self.timings.of("estimate"):
                maps, status = self._maps(engine.estimate(*tensors), finite[frame][centre])
                unit = plan.unit(first + frame - plan.frames[first], index)
                result = self._frame_of(whole, maps, status, place)
            yield unit, *result

    def _frame_of(
        self, rows: slice, maps: Maps, status: NDArray[np.uint8] | None, place: tuple[slice, slice] | None
    ) -> tuple[Maps, NDArray[np.uint8]]:
        """The measured rectangle at ``place`` within the unit's rows; border around it, masked where the mask says."""
        plan = self.plan
        shape = (rows.stop - rows.start, len(plan.x))
        codes = np.full(shape, Status.BORDER, np.uint8)
        framed = {name: np.full(shape, np.nan, np.float32) for name in plan.names}
        if place is not None and status is not None:
            codes[place] = status
        if self._mask is not None:
            codes[~self._mask[np.ix_(plan.y[rows], plan.x)]] = Status.MASKED
        if place is not None:
            empty = ~np.isin(codes[place], HAS_VALUE)
            for name, values in maps.items():
                values[empty] = np.nan
                framed[name][place] = values
        return framed, codes

    def _read(self, t: int, band: Band, corner: tuple[int, int]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Preshifted block [sy, sx, in_rows, in_cols] with non-finite values replaced by 0, and where it was finite."""
        y0, x0 = corner
        block = self.capture.block(
            [t], *self.plan.cameras, y0, y0 + band.in_rows, x0, x0 + band.in_cols, self.plan.preshift,
            self.device.real("storage"),
        )[0]  # fmt: skip
        finite = np.isfinite(block)
        if finite.all():
            return block, np.ones(block.shape[2:], bool)
        return np.where(finite, block, 0), finite.all(axis=(0, 1))

    def _inside(self, band: Band, corner: tuple[int, int]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Where every camera sees its image, and where the mask allows a measurement: [in_rows, in_cols]."""
        plan, capture = self.plan, self.capture
        y, x = corner[0] + np.arange(band.in_rows), corner[1] + np.arange(band.in_cols)
        in_y, in_x = np.ones(y.size, bool), np.ones(x.size, bool)
        for k in plan.cameras[0]:
            shifted = y + plan.preshift[1] * (k - capture.reference[0])
            in_y &= (shifted >= 0) & (shifted < capture.height)
        for k in plan.cameras[1]:
            shifted = x + plan.preshift[0] * (k - capture.reference[1])
            in_x &= (shifted >= 0) & (shifted < capture.width)
        inside = in_y[:, None] & in_x
        if self._mask is None:
            return inside, np.ones_like(inside)
        kept = self._mask[np.clip(y, 0, capture.height - 1)[:, None], np.clip(x, 0, capture.width - 1)]
        return inside, kept

    def _maps(self, planes: NDArray[Any], finite: NDArray[np.bool_]) -> tuple[Maps, NDArray[np.uint8]]:
        """Named maps and the status of the measured rectangle."""
        from leafflow_ti.kernels.maps import Output

        status = planes[Output.STATUS].astype(np.uint8)
        status[~finite] = Status.NOT_FINITE
        maps = {}
        for name in self.plan.names:
            base = name.removesuffix("_std")
            plane = _plane_of(base) + (Output.STD if name != base else 0)
            maps[name] = planes[plane].astype(np.float32)
        has_value = np.isin(status, HAS_VALUE)
        for values in maps.values():
            # A degenerate window can defeat the arithmetic: no NaN without a status that says so.
            status[has_value & np.isnan(values)] = Status.NOT_CONVERGED
        return maps, status


def _plane_of(name: str) -> int:
    from leafflow_ti.kernels.maps import Output
    from leafflow_ti.plan import MOTION_NAMES

    if name in MOTION_NAMES:
        return Output.MOTION + MOTION_NAMES.index(name)
    return int(Output[name.upper()])


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
