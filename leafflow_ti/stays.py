"""One engine over one block of the images: frames in, named maps of the block's output pixels out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.aim import Aim
from leafflow_ti.engines import Engine
from leafflow_ti.field import MOTION_NAMES, with_std
from leafflow_ti.growth import DIFFERENCES, INPUTS
from leafflow_ti.identify import settle
from leafflow_ti.plan import Plan
from leafflow_ti.range_engine import Sample
from leafflow_ti.reading import Box, Mask, Reader
from leafflow_ti.refinement import starting
from leafflow_ti.stages.estimate import View
from leafflow_ti.stages.prefilter import Prefilter
from leafflow_ti.stages.tensor import Band
from leafflow_ti.status import Status
from leafflow_ti.trace import span

Maps = dict[str, NDArray[Any]]
Layer = Callable[[Box], Mask]
"""Of a block of the reference image, [rows, cols]: where the surface is that is measured."""
Hidden = Callable[[float, Box], Mask | None]
"""Of the time since the results [frames] and a block, [sy, sx, rows, cols]: where an image shows something else than
what is measured; None: nowhere."""


@dataclass(frozen=True)
class Stay:
    """An engine over one block.

    ``box``: the images that it needs, with the prefilter's margin; ``wide``: without it, as the refinement takes them;
    ``inner``: their part that the tensors take; ``block``: that part in the image. ``allowed`` [rows, cols] of it: what
    counts; None where that differs from frame to frame. ``centre``: pixels of the inner block at the output positions.
    ``frame``: from which ``aim`` counts time. ``hidden``: see ``Hidden``; ``layer`` [rows, cols] of ``wide``: where the
    surface is that is measured.
    """

    engine: Engine
    aim: Aim
    box: Box
    wide: Box
    block: Box
    inner: tuple[slice, slice]
    allowed: Mask | None
    centre: tuple[slice, slice]
    frame: int = 0
    layer: Mask | None = None
    hidden: Hidden | None = None


class Stays:
    """What is common to all stays of a plan."""

    def __init__(self, plan: Plan, reader: Reader):
        self.plan, self.reader = plan, reader
        # What a map's user is told depends on the standard errors of others, so all are there.
        inputs = INPUTS if plan.differences else ()
        started = starting(plan.refine) if plan.refine else ()
        wanted = with_std(n for n in (*plan.quantities, *started) if n != "growth_rate")
        self.names = tuple(dict.fromkeys((*wanted, *inputs)))
        self._measured = {*plan.measured, *inputs}

    def view(self, at: tuple[int, int], band: Band, pitch: int, aim: Aim) -> View:
        """The output grid whose first pixel is the image's pixel (x, y) ``at``."""
        geometry = self.plan.geometry
        offset, baseline = geometry.disparity_offset_px, geometry.baseline_mm
        shift: tuple[float, float] = (aim.shift[0] + offset[0], aim.shift[1] + offset[1])
        if self.reader.capture.positions_mm is not None:
            shift, baseline = geometry.along_both(shift), geometry.along_both(baseline)
        return View(
            geometry.f_px, geometry.principal_px, baseline, shift, *at, self.plan.x.step, band.rows, band.cols, pitch,
            (float(aim.motion[0]), float(aim.motion[1])),
        )  # fmt: skip

    def move(
        self, engine: Engine, band: Band, at: tuple[int, int], aim: Aim, first: int = 0, frame: int = 0,
        layer: Layer | None = None, hidden: Hidden | None = None,
    ) -> Stay:  # fmt: skip
        """Bring an engine, all frames forgotten, to the output pixels of a band, the first of which is (x, y) ``at``.

        ``first``: the next frame; ``frame``: from which ``aim`` counts time. ``layer``: where the surface is that is
        measured; None: everywhere. ``hidden``: see there.
        """
        engine.reset(first)
        engine.estimate.set_view(self.view(at, band, engine.tensor.out_pitch, aim))
        if engine.refine:
            engine.refine.set_view(engine.estimate.view)
        corner, centre = (at[1] - band.halo_y, at[0] - band.halo_x), _centres(band)
        if engine.ranges:
            band, corner = engine.ranges.outer, engine.ranges.move(engine.estimate.view, corner)
        block = Box(*corner, band.in_rows, band.in_cols)
        wide = block.widened(engine.widening)
        inner = (
            slice(engine.widening, engine.widening + block.rows),
            slice(engine.widening, engine.widening + block.cols),
        )
        shown = None if layer is None else layer(wide)
        if engine.refine:
            masked = self.reader.masked(wide)
            engine.refine.set_mask(masked if shown is None else shown if masked is None else shown & masked)
        allowed = self.reader.inside(block, aim) if layer is None and aim.motion == (0, 0) and not hidden else None
        margin = engine.prefilter.radius if engine.prefilter else 0
        return Stay(
            engine, aim, wide.widened(margin), wide, block, inner, allowed, centre, frame, shown, hidden
        )  # fmt: skip

    def sample(self, stay: Stay, t: int, block: NDArray[Any], finite: Mask, refining: bool = True) -> Sample:
        """What the tensor stages take of a frame, as it was read. ``refining``: whether the refinement takes it, too,
        at once."""
        return self._sample(stay, t, *self._prepared(stay, t, block, finite, refining))

    def refine_alone(self, stay: Stay, t: int, block: NDArray[Any], finite: Mask) -> None:
        """Add a frame for the refinement alone."""
        self._prepared(stay, t, block, finite)

    def _prepared(
        self, stay: Stay, t: int, block: NDArray[Any], finite: Mask, refining: bool = True
    ) -> tuple[NDArray[Any], Mask, Mask | None]:
        """One frame's images and where they are finite, prefiltered, as the tensors take them; what hides the surface
        in them. The refinement takes its wider ones."""
        engine = stay.engine
        if engine.prefilter:
            block, finite = self._prefiltered(stay, engine.prefilter, t, block, finite)
        hidden = stay.hidden(self.reader.elapsed(t, stay.frame), stay.wide) if stay.hidden else None
        if not engine.refine:
            return block, finite, hidden
        if refining:
            engine.refine.push(block, finite & self._seen(stay.wide, stay, t), hidden)
        within = (..., *stay.inner)
        return np.ascontiguousarray(block[within]), finite[within], None if hidden is None else hidden[within]

    def _seen(self, box: Box, stay: Stay, t: int) -> Mask:
        """Where the pixels of a block lie inside the images of each camera, [sy, sx, rows, cols]."""
        in_y, in_x = self.reader.seen(box, stay.aim, t, stay.frame)
        return in_y[:, None, :, None] & in_x[None, :, None, :]

    def _sample(self, stay: Stay, t: int, block: NDArray[Any], finite: Mask, hidden: Mask | None) -> Sample:
        """What the tensor stages take: one frame's images [sy, sx, rows, cols] of a stay."""
        engine, allowed = stay.engine, stay.allowed
        everywhere = np.asarray(finite.all(axis=(0, 1)))
        if allowed is None:
            allowed = self.reader.inside(stay.block, stay.aim, t, stay.frame)
            if stay.layer is not None:
                allowed &= stay.layer[stay.inner]
            if hidden is not None:
                allowed &= ~hidden.any(axis=(0, 1))
        if engine.ranges:
            return engine.ranges.sample(t, block, allowed & everywhere, everywhere)
        status = np.where(everywhere, np.uint8(Status.OK), np.uint8(Status.NOT_FINITE))
        return Sample(block, allowed & everywhere, status)

    def _prefiltered(
        self, stay: Stay, prefilter: Prefilter, t: int, block: NDArray[Any], finite: Mask
    ) -> tuple[NDArray[Any], Mask]:
        """The block without the prefilter's margin, and where it is finite."""
        with span("prefilter"):
            box = stay.box
            valid = finite & self._seen(box, stay, t)
            if self.plan.config.filters.prefilter == "homomorphic":
                self.reader.require_positive(block, valid, t, box, stay.aim, stay.frame)
            stack, r = (-1, box.rows, box.cols), prefilter.radius
            finite = finite[:, :, r : box.rows - r, r : box.cols - r]
            return prefilter(block.reshape(stack), valid.reshape(stack)).reshape(finite.shape), finite

    def maps(self, stay: Stay, tensors: Any, sample: Sample) -> tuple[Maps, NDArray[np.uint8]]:
        """Named maps and the status of the output pixels, of the frame that ``sample`` was of."""
        from leafflow_ti.kernels.maps import Output

        planes = stay.engine.estimate(tensors)
        status = planes[Output.STATUS].astype(np.uint8)
        reason = sample.status[stay.centre]
        status[reason != Status.OK] = reason[reason != Status.OK]
        maps = {}
        for name in self.names:
            base = name.removesuffix("_std")
            if base not in self._measured or name == "identified":
                continue
            if name in sample.maps:
                maps[name] = sample.maps[name][stay.centre].astype(np.float32)
            else:
                with np.errstate(over="ignore"):  # numbers of pixels that have no value
                    maps[name] = planes[plane_of(base) + (Output.STD if name != base else 0)].astype(np.float32)
        found = settle(maps, status, self.plan.limits)
        # Texture in all directions, and nothing determined: the window is too small, or degenerate.
        status[(status == Status.OK) & (found == 0)] = Status.NOT_CONVERGED
        return {**maps, "identified": found}, status


def without_images(sample: Sample) -> Sample:
    """What is needed of a frame once the engine has it."""
    return replace(sample, block=np.empty((0, 0, 0, 0), np.float32))


def plane_of(name: str) -> int:
    from leafflow_ti.kernels.maps import Output

    if name in MOTION_NAMES:
        return Output.MOTION + MOTION_NAMES.index(name)
    if name in DIFFERENCES:
        return Output.DIFFERENCES + DIFFERENCES.index(name)
    return int(Output[name.upper()])


def _centres(band: Band) -> tuple[slice, slice]:
    """The block's pixels at the output positions."""
    return (
        slice(band.halo_y, band.halo_y + (band.rows - 1) * band.stride + 1, band.stride),
        slice(band.halo_x, band.halo_x + (band.cols - 1) * band.stride + 1, band.stride),
    )
