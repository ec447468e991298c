"""How high the bands of a run are, and the memory that one takes: arrays, frames read ahead, units not yet written.

The limit is one of the whole process. What that takes for itself is measured (``python -m perf memory``); the rest but
for a reserve, of which the allocator's gaps are a part, is the arrays'.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from leafflow_ti.config import RunConfig
from leafflow_ti.errors import ConfigError
from leafflow_ti.filters import gaussian_radius
from leafflow_ti.kernels.refine_tables import ADDRESSED
from leafflow_ti.models import TensorLayout
from leafflow_ti.range_plan import RangePlan
from leafflow_ti.refine_plan import Refinement
from leafflow_ti.runtime import DENSE_LANES, usable_threads
from leafflow_ti.search import peak_bytes
from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.stages.planes import round_up
from leafflow_ti.stages.prefilter import prefilter_bytes
from leafflow_ti.stages.problem import Problem
from leafflow_ti.stages.refine_tables import Workspaces, bytes_per_pixel
from leafflow_ti.stages.tensor import Band, band_bytes

BAND_PIXELS = 1 << 17
"""Output pixels of a unit where memory allows: large enough to amortise halos, small enough to answer an interrupt."""
TILE_PIXELS = 192
"""Image pixels along a side of a tile that is computed once per label: wide beside the halo, small beside a surface."""
LABELS_AT_ONCE = 12
"""Passes of a tile whose maps are held until its pixels have chosen, as they are planned for."""
MAPS_BESIDE = 16
HIDING_BYTES = 8
"""Of a pixel of a camera's block: marks of what hides it, as they are made and as they are used."""
READ_AHEAD = 2
"""Frames read before they are needed, where memory allows: one is decoded while the other is ready."""
INDEXED = 2**31 - 1
"""Numbers of a unit's arrays: kernels count them in 32 bits."""
WRITE_BEHIND = 2
"""Finished units that may wait to be written, beside the one that is being written."""
READERS = 16
"""Most threads that read: one for each image of a frame. While a kernel runs none of them gets the interpreter, and
between two kernels each gets it once, so that more threads than cores read faster."""
PROCESS_BYTES = 224 << 20
"""Of the interpreter, the packages, the engine and its kernels: 163 to 210 MiB measured, by model."""
COMPILING_BYTES = 336 << 20
"""The same while kernels are compiled: up to 320 MiB measured. Arrays come after that."""
ARRAYS_SHARE = 0.875
"""Of the rest, what arrays may take; the allocator's gaps and small things have taken up to a tenth."""


@dataclass(frozen=True)
class Demand:
    """What decides the memory of a unit. ``cols``: output columns; ``n_cameras`` are read, ``n_maps`` written.

    ``tile_cols``: of a tile where the images are shifted tile by tile, 0 elsewhere; ``image``: rows and columns of an
    image, where it is searched. ``margin``: output pixels that are computed around a unit. ``waiting``: frames that the
    model takes later than the refinement. ``reading``: bytes that one thread takes for the time of reading a window of
    so many rows and columns, beside the window.
    """

    config: RunConfig
    problem: Problem
    layout: TensorLayout
    ranges: RangePlan | None
    refine: Refinement | None
    n_cameras: int
    n_maps: int
    cols: int
    margin: int = 1
    tile_cols: int = 0
    image: tuple[int, int] = (0, 0)
    waiting: int = 0
    reading: Callable[[int, int], int] = lambda rows, cols: 0

    def coefficients(self, rows: int) -> int:
        """Spline coefficients of the refinement for units of ``rows`` rows."""
        if self.refine is None:
            return 0
        band = self._band(rows)
        widening = 2 * self.refine.widening(band.halo_y, band.halo_x)
        plane = (band.in_rows + widening) * round_up(band.in_cols + widening, 64)
        return len(self.refine.frames) * self.n_cameras * plane

    def bytes(self, rows: int, ahead: int) -> int:
        """Memory for units of ``rows`` rows while ``ahead`` frames are read ahead."""
        config, problem, ranges = self.config, self.problem, self.ranges
        itemsize = 4 if config.precision == "f32" else 8
        band = self._band(rows)
        own = problem.own_flows.requests if problem.own_flows else ()
        gpu = config.arch not in ("auto", "cpu")
        weighed = ESTIMATORS[problem.estimator].weighs
        mask = problem.mask_moments(self.layout)
        total = band_bytes(problem.columns, self.layout, problem.sampling, band, itemsize, own, gpu, weighed, mask)
        read = band
        if ranges and ranges.depth and ranges.layout:
            depth = ranges.depth
            read = Band.of(depth.sampling, band.in_rows, band.in_cols, 1)
            mask = depth.mask_moments(ranges.layout)
            total += band_bytes(depth.columns, ranges.layout, depth.sampling, read, itemsize, gpu=gpu, mask=mask)
        in_rows, in_cols = read.in_rows, read.in_cols
        if self.refine:
            widening = self.refine.widening(band.halo_y, band.halo_x)
            in_rows, in_cols = in_rows + 2 * widening, in_cols + 2 * widening
            planes = len(self.refine.frames) * self.n_cameras
            total += planes * in_rows * round_up(in_cols, 64) * itemsize
            total += self._refining(self.refine, itemsize, gpu) + band.rows * band.cols * bytes_per_pixel()
        margin = 0
        if config.filters.prefilter != "none":
            margin = gaussian_radius(config.filters.sigma_pre)
            total += prefilter_bytes(config.filters.sigma_pre, self.n_cameras, in_rows, in_cols, itemsize)
        # Grey values, and one byte that says whether each is finite.
        window = in_rows + 2 * margin, in_cols + 2 * margin
        block = self.n_cameras * window[0] * window[1] * (itemsize + 1)
        total += (min(self.n_cameras, READERS) if ahead else 1) * self.reading(*window)
        unit = rows * self.cols * (4 * self.n_maps + 1)
        if self.tile_cols:
            maps = 2 * self.n_maps + MAPS_BESIDE  # standard errors, and what growth is made of
            total += peak_bytes(self.image) + 4 * maps * (LABELS_AT_ONCE * band.rows * band.cols + rows * self.cols)
            total += self.n_cameras * in_rows * in_cols * HIDING_BYTES
        # One frame and one unit are worked on, and one unit is being written.
        return total + (1 + ahead + self.waiting) * block + (2 + WRITE_BEHIND) * unit

    def _band(self, rows: int) -> Band:
        """A unit with what is computed around it."""
        cols = self.tile_cols or self.cols + 2 * self.margin
        return Band.of(self.problem.sampling, rows + 2 * self.margin, cols, int(self.config.window.stride))

    def _refining(self, refine: Refinement, itemsize: int, gpu: bool) -> int:
        """Workspaces of the pixels that are refined at once."""
        count = self.config.plan.threads_each(usable_threads())
        return Workspaces.of(refine, 1 if gpu else DENSE_LANES["f64"], (itemsize, 8), gpu, count).bytes


def usable_memory(config: RunConfig) -> int:
    """Bytes of the limit that a worker's arrays may take."""
    return max(0, int(ARRAYS_SHARE * (config.plan.memory_each - PROCESS_BYTES)))


def least_limit(needed: int) -> int:
    """The least limit [bytes] of a process under which arrays of ``needed`` bytes fit."""
    return max(COMPILING_BYTES, PROCESS_BYTES + math.ceil(needed / ARRAYS_SHARE))


def choose_bands(demand: Demand, rows: int, depths: Iterable[int]) -> tuple[int, int, int]:
    """Rows of a unit of ``rows`` output rows, its memory, and the first of ``depths`` to read ahead that fits.

    Raises ConfigError when nothing fits.
    """
    plan, limit = demand.config.plan, usable_memory(demand.config)
    if plan.memory_each < COMPILING_BYTES:
        limit = 0
    addressed = INDEXED * (4 if demand.config.precision == "f32" else 8)

    def indexed(rows: int) -> bool:
        return demand.bytes(rows, 0) <= addressed and demand.coefficients(rows) <= ADDRESSED

    for ahead in depths:
        if plan.tile != "auto":
            chosen = min(int(plan.tile), rows)
        else:
            chosen = int(np.clip(BAND_PIXELS // demand.cols, 16, rows)) if rows > 16 else rows
            if demand.tile_cols:
                chosen = min(rows, demand.tile_cols)
            while chosen > 1 and not (demand.bytes(chosen, ahead) <= limit and indexed(chosen)):
                chosen = max(1, chosen * 3 // 4)
            # Bands of equal height: the last one should not be a sliver.
            chosen = -(-rows // -(-rows // chosen))
        needed = demand.bytes(chosen, ahead)
        if needed <= limit and indexed(chosen):
            return chosen, needed, ahead
    if needed <= limit:
        splines = demand.coefficients(chosen)
        raise ConfigError(
            f"a unit of {chosen} rows needs {needed / 2**20:.0f} MiB and {splines} spline coefficients; kernels take "
            f"{addressed / 2**20:.0f} MiB and {ADDRESSED} of these: lower plan.tile, or use a roi, a smaller window"
        )
    least, shared = plan.memory_for_all(least_limit(needed)), f" in {plan.workers} workers" * (plan.workers > 1)
    raise ConfigError(
        f"plan.max_memory = {_mebibytes(plan.max_memory)} is too little: the program and a unit of {chosen} rows need "
        f"{_mebibytes(least)}{shared}: raise it, or need less with a lower plan.tile, a stride, a roi, a smaller window"
    )


def _mebibytes(n: int) -> str:
    """As the option takes it, rounded up."""
    return f"{-(-n // 2**20)}M"
