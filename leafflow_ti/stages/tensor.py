"""Structure tensors of one band of the image, from raw frames, frame by frame.

``J = Σ w d d^T`` as moments of products (2.17, 2.20). For every new frame the band's images are filtered along t,
sy, sx, y and x, the products of channels are summed over the camera samples and over the pixels of blocks, and the
result is kept as this frame's *maps*. A tensor is a weighted sum of the maps of the frames of its window, convolved
with moment windows along x and y. Nothing is computed twice when the window moves on by a frame, and what several
tensors have in common is computed once.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.models import ColumnSet, TensorLayout
from leafflow_ti.runtime import MOMENT_LANES, Device
from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.cells import Cells, SourcePlanes
from leafflow_ti.stages.channels import EXTRA_PLANES, FACTOR_PLANES, UNROLLED, Channels, Request
from leafflow_ti.stages.mask_moments import MaskMoments
from leafflow_ti.stages.planes import Terms
from leafflow_ti.stages.tensor_tables import Band, Lowered, padded_tables
from leafflow_ti.stages.windows import Windows, taps
from leafflow_ti.trace import span

__all__ = ["EXTRA_PLANES", "FACTOR_PLANES", "OUTPUT_PLANES", "Band", "Request", "TensorStage", "band_bytes"]
OUTPUT_PLANES = 70
_WEIGHT = 7
"""Place of the linear terms' weights among the tables of the filters."""
TASKS = 32
"""Tasks of a launch that the memory plan allows for."""


@functools.lru_cache(maxsize=4)
def _tables(requests: tuple[Request, ...], mask: MaskMoments | None) -> tuple[Channels, list[Windows]]:
    """What does not depend on the band; the windows of the mask stand behind those of the requests."""
    windows = [Windows(r, n) for n, r in enumerate(requests)]
    return Channels(requests), windows + ([Windows(requests[0], 0, mask)] if mask else [])


class TensorStage:
    """Turns a stream of frames of one band into structure tensors.

    ``push`` takes one frame's block [n_sy, n_sx, in_rows, in_cols] (preshifted) of the cameras that the sampling and
    the ``own`` requests need, and its validity. Once the window is full it returns ``tensors``, one flat
    device array: the packed tensor [n_entries + EXTRA_PLANES, rows, out_pitch], then those of the own requests, then
    the moments of the ``mask`` (undefined while all pixels of the window's frames are valid), then, if ``weighed``, the
    ``sources`` of their cells; valid until the next call. For ``derived`` columns the block is a stack of images
    [1, n_images, ...] with its factors.
    """

    def __init__(
        self,
        device: Device,
        columns: ColumnSet,
        layout: TensorLayout,
        sampling: Sampling,
        band: Band,
        own: Sequence[Request] = (),
        weighed: bool = False,
        mask: MaskMoments | None = None,
    ):
        self.device, self.band, self.sampling = device, band, sampling
        requests = (Request(columns, layout, sampling), *own)
        lowered = Lowered(*_tables(requests, mask), band, device.moments.lanes)
        self._lowered, self._n_requests = lowered, len(requests)
        self.n_taps = sampling.t.taps
        geometry = lowered.geometry
        self.out_pitch = geometry.out_pitch
        self._n_tiling = min(geometry.n_tiles, 4 * device.threads)
        lanes = geometry.lanes
        sizes = lowered.sizes(self._n_tiling, 8 * device.threads)
        self._raw, self._scratch, self._maps, self._sums, self._wide = (self._zeros(n * lanes) for n in sizes[:5])
        self._starts = np.cumsum([0, *sizes[5:]]) * lanes
        self._cells = cells = [Cells(r, n) for n, r in enumerate(requests)] if weighed else []
        self.sources = source_planes(lowered, cells, int(self._starts[-1]))
        """Of each request, where windows are weighted anew."""
        self.tensors = self._zeros(int(self._starts[-1]) + source_size(lowered, cells))
        self._source_tables = [self._device_sources(c) for c in cells]
        self._filter_tables = self._device_tables(lowered)
        self._clean_tables = self._tables_without_invalid(lowered)
        self._window_tables = [self._device_windows(w) for w in lowered.windows]
        self._spoilt = np.zeros(self.n_taps, bool)
        self._cut = np.zeros(sampling.t.size, bool)
        self.reset()

    def _zeros(self, size: int) -> Any:
        """Nothing that a kernel reads may be infinite, not even where the result does not count."""
        return self.device.zeros(size)

    def reset(self, first: int = 0) -> None:
        """Forget all frames: the next one pushed starts a new window; it is the frame ``first`` of the sequence."""
        self._pushed = self._n_maps = 0
        self._first = first

    @property
    def latency(self) -> int:
        """Frames between the newest one pushed and the one that the tensor belongs to."""
        return self.sampling.t.after

    def _device_tables(self, lowered: Lowered) -> tuple[Any, ...]:
        """Steps, linear passes, products."""
        linear, array = lowered.linear, self.device.array
        terms = Terms.of(linear.terms)
        groups = lowered.groups
        first = np.cumsum([0] + [len(pairs) for pairs, *_ in groups])
        pairs = [p for some, *_ in groups for p in some]
        return (
            array(lowered.steps, "int"), array(terms.first, "int"), array(linear.column, "int"),
            array(linear.blocks, "int"), array(linear.trim, "int"), array([s[0] for s in terms.source], "int"),
            array([s[1] for s in terms.source], "int"), array(terms.weight), array(first, "int"),
            array([p[0] for p in pairs], "int"), array([p[1] for p in pairs], "int"),
            array([w for _, weights, *_ in groups for w in weights]), array([c for *_, c, _ in groups]),
            array([i for *_, i in groups], "int"),
        )  # fmt: skip

    def _set_filters(self, middle: int) -> None:
        """Frames that are uneven in time: enter the filters of the frame ``middle`` of the sequence."""
        lowered, t = self._lowered, self.sampling.t
        sample = middle - t.reference
        terms = Terms.of(lowered.linear.terms)
        weights = np.array(terms.weight)
        for output, name in lowered.over_time:
            if name in "db":
                weights[terms.first[output] : terms.first[output + 1]] = t.kernel(name == "d", sample)
        table = self.device.array(weights)
        for name in ("_filter_tables", "_clean_tables"):
            tables = getattr(self, name)
            setattr(self, name, (*tables[:_WEIGHT], table, *tables[_WEIGHT + 1 :]))

    def _set_windows(self, frame: int) -> None:
        """Likewise: enter the windows along time about the reference ``frame``."""
        t = self.sampling.t.about(frame)
        for number, windows in enumerate(self._lowered.windows):
            weights = [w for s in windows.sets for _ in windows.sources(s) for w in t.window(s.t)]
            sums, across, down, n_sets = self._window_tables[number]
            self._window_tables[number] = ((*sums[:-1], self.device.array(weights)), across, down, n_sets)
        for number, cells in enumerate(self._cells):
            weights = [w for _, power in cells.sources for w in t.window(power)]
            n, tables = self._source_tables[number]
            self._source_tables[number] = (n, (*tables[:-1], self.device.array(weights)))

    def _tables_without_invalid(self, lowered: Lowered) -> tuple[Any, ...]:
        """The same for frames without invalid pixels."""
        array = self.device.array
        zeros = [lowered.zero] * len(lowered.groups)
        return (array(lowered.steps_without_invalid, "int"), *self._filter_tables[1:-1], array(zeros, "int"))

    def _device_windows(self, windows: Windows) -> tuple[tuple[Any, ...], tuple[Any, ...], tuple[Any, ...], int]:
        """Of one request: sums over frames with their sets, windows along x, windows along y, the number of sets."""
        lowered, array, t = self._lowered, self.device.array, self.sampling.t
        g = lowered.geometry
        number = {b: n for n, b in enumerate(lowered.block_maps)}
        sums: list[list[tuple[tuple[int, int], float]]] = []
        across: list[list[tuple[int, NDArray[np.float64]]]] = []
        first_sum, first_wide = [0], [0]
        for wide_set in windows.sets:
            weights = t.window(wide_set.t).tolist()
            begin = len(sums)
            for source in windows.sources(wide_set):
                at = number[source] * g.map_plane
                sums.append([((at, i), w) for i, w in enumerate(weights) if w or t.uneven])
            for wide in windows.wides:
                if wide[0] == wide_set:
                    source_at = [begin * g.map_plane + i * g.map_plane for i, _ in windows.across(wide)]
                    if not lowered.gpu:
                        source_at = [i * lowered.source_pitch for i, _ in windows.across(wide)]
                    across.append([(at, w) for at, (_, w) in zip(source_at, windows.across(wide), strict=True)])
            first_sum.append(len(sums))
            first_wide.append(len(across))
        terms = Terms.of(sums)
        down = [[(windows.wides[w] * lowered.wide_plane, table) for w, table in entry] for entry in windows.entries]
        return (
            (
                array(first_sum, "int"), array(first_wide, "int"), array(terms.first, "int"),
                array([s[0] for s in terms.source], "int"), array([s[1] for s in terms.source], "int"),
                array(terms.weight),
            ),
            self._padded(across, g.step_x), self._padded(down, g.step_y), len(windows.sets),
        )  # fmt: skip

    def _padded(self, outputs: list[list[tuple[int, NDArray[np.float64]]]], step: int) -> tuple[Any, ...]:
        first, offset, table, weights = padded_tables(outputs, step)
        array = self.device.array
        return array(first, "int"), array(offset, "int"), array(table, "int"), array(weights)

    def push(self, block: NDArray[Any], valid: NDArray[np.bool_], factors: NDArray[Any] | None = None) -> Any | None:
        """Add the next frame; the tensors of the frame ``latency`` before it, or None while the window fills.

        ``valid`` [in_rows, in_cols]: pixels at which every camera has a finite grey value inside its image;
        ``factors`` [FACTOR_PLANES, in_rows, in_cols]: what derived channels are multiplied by.
        """
        with span("filter"):
            if not self._add_frame(block, valid, factors):
                return None
        with span("tensor"):
            if self.sampling.t.uneven:
                self._set_windows(self._first + self._pushed - 1 - self.latency)
            for number in range(len(self._window_tables)):
                if number < self._n_requests or self._cut.any():
                    self._make_tensor(number)
            for number in range(len(self._source_tables)):
                self._make_sources(number)
        return self.tensors

    def _add_frame(self, block: NDArray[Any], valid: NDArray[np.bool_], factors: NDArray[Any] | None) -> bool:
        """Filter the next frame into its maps; whether the window is full."""
        images = self._lowered.channels.images
        assert block.shape == (*images, self.band.in_rows, self.band.in_cols)
        slot, n = self._pushed % self.n_taps, images[0] * images[1]
        self._arrange(block.reshape(n, *block.shape[2:]), slot, 0)
        spoilt = not valid.all()
        if spoilt or self._spoilt[slot]:
            self._arrange(~valid[None], slot, n)
        self._spoilt[slot] = spoilt
        if factors is not None:
            self._arrange(factors, slot, n + 1)
        self._pushed += 1
        if self._pushed < self.n_taps:
            return False
        if self.sampling.t.uneven:
            self._set_filters(self._first + self._pushed - 1 - self.n_taps // 2)
        self._make_maps()
        return self._n_maps >= self.sampling.t.size

    def _arrange(self, images: NDArray[Any], slot: int, number: int) -> None:
        """Images [n, in_rows, in_cols] into the vectors of a frame, from image ``number`` on."""
        from leafflow_ti.kernels.moments import arrange_kernel

        device, lowered = self.device, self._lowered
        g = lowered.geometry
        host = np.ascontiguousarray(images, device.real("storage")).reshape(-1)
        n, rows, cols = images.shape
        arrange_kernel(device.moments)(
            n, rows, cols, g.segment, g.tall, g.n_tiles, g.tile, g.width, lowered.channels.n_images,
            slot * lowered.frame_size + number * g.width, device.tasks(n * g.tall),
            device.array(host) if device.gpu else host, self._raw,
        )  # fmt: skip

    def _make_maps(self) -> None:
        """Filter the frames of the ring, and sum the products of the middle one over cameras and blocks."""
        slot = self._n_maps % self.sampling.t.size
        self._cut[slot] = self._spoilt.any()
        if self.device.gpu:
            self._make_maps_by_planes(slot * self._lowered.slot_size)
        else:
            self._make_maps_by_tiles(slot * self._lowered.slot_size)
        self._n_maps += 1

    def _make_maps_by_tiles(self, maps_at: int) -> None:
        from leafflow_ti.kernels.moments_by_tiles import tile_kernel

        device, lowered = self.device, self._lowered
        g = lowered.geometry
        arrays = (device.vectors(a, g.lanes) for a in (self._raw, self._scratch, self._maps))
        tables = self._filter_tables if self._spoilt.any() else self._clean_tables
        tile_kernel(device.moments)(
            len(lowered.steps), lowered.n_raw, lowered.n_early, g.n_tiles, self._n_tiling, lowered.raw_row,
            g.map_rows, g.halo[0], self._pushed % self.n_taps, g.y.step, g.y.length, g.map_tile, maps_at,
            lowered.scratch, g.halo[1], -(-g.inner // UNROLLED), *tables, *arrays,
        )  # fmt: skip

    def _device_sources(self, cells: Cells) -> tuple[int, tuple[Any, ...]]:
        """Sums over the frames of the window of every source of a request's cells: their number, and the tables."""
        lowered, array, t = self._lowered, self.device.array, self.sampling.t
        number = {b: n for n, b in enumerate(lowered.block_maps)}
        plane = lowered.geometry.map_plane
        terms = Terms.of([
            [((number[block] * plane, i), w) for i, w in enumerate(t.window(power).tolist()) if w or t.uneven]
            for block, power in cells.sources
        ])  # fmt: skip
        return len(cells.sources), (
            array(terms.first, "int"), array([s[0] for s in terms.source], "int"),
            array([s[1] for s in terms.source], "int"), array(terms.weight),
        )  # fmt: skip

    def _make_sources(self, number: int) -> None:
        """The planes of the cells of one request from the maps of the frames of its window."""
        from leafflow_ti.kernels.sources import sources_kernel

        device, lowered = self.device, self._lowered
        g, n_t, planes = lowered.geometry, self.sampling.t.size, self.sources[number]
        n, tables = self._source_tables[number]
        sources_kernel(device.moments)(
            n, device.tasks(n * g.block_segment), g.block_segment, g.block_rows, g.block_cols, g.map_pitch,
            self._n_maps % n_t, n_t, lowered.slot_size, planes.start, planes.plane, planes.pitch, *tables,
            device.vectors(self._maps, g.lanes), self.tensors,
        )  # fmt: skip

    def _make_tensor(self, number: int) -> None:
        """The tensor of one request from the maps of the frames of its window."""
        if self.device.gpu:
            self._make_tensor_by_planes(number)
            return
        from leafflow_ti.kernels.moments_by_tiles import across_kernel, down_kernel

        device, lowered = self.device, self._lowered
        g, spec = lowered.geometry, self.device.moments
        sums, across, down, n_sets = self._window_tables[number]
        n_t = self.sampling.t.size
        tensor = self.tensors[self._starts[number] : self._starts[number + 1]]
        maps, scratch, wide, tensor = (
            device.vectors(a, g.lanes) for a in (self._maps, self._sums, self._wide, tensor)
        )  # fmt: skip
        across_kernel(spec)(
            n_sets, device.tasks(n_sets * g.block_segment), g.block_segment, g.block_rows, g.map_pitch, self.band.cols,
            g.step_x, taps(g.x), lowered.strips, self._n_maps % n_t, n_t, lowered.slot_size, lowered.source_pitch,
            lowered.sums_size, *sums, *across, maps, scratch, self._sums, self._wide,
        )  # fmt: skip
        n_planes = len(lowered.windows[number].entries)
        down_kernel(spec)(
            n_planes, device.tasks(n_planes * lowered.strips), g.block_rows, self.band.rows, g.step_y, taps(g.y),
            lowered.strips, g.out_pitch // g.lanes, *down, wide, tensor,
        )  # fmt: skip

    def _make_maps_by_planes(self, maps_at: int) -> None:
        """On a GPU: every step over whole planes."""
        from leafflow_ti.kernels.moments import Step
        from leafflow_ti.kernels.moments_by_planes import linear_kernel, products_kernel

        device, lowered = self.device, self._lowered
        g, spec = lowered.geometry, device.moments
        _, first, _, _, _, offset, ring, weight, *products = self._filter_tables
        for number, step in enumerate(lowered.steps):
            begin, n = step[Step.FIRST], step[Step.LAST] - step[Step.FIRST]
            to, plane, pitch = step[Step.TARGET], step[Step.TARGET_PLANE], step[Step.TARGET_HOP]
            if step[Step.PRODUCTS]:
                products_kernel(spec)(n, begin, g.map_rows, g.width, to, plane, *products, self._scratch)
                continue
            raw, last = number < lowered.n_raw, number == len(lowered.steps) - 1
            rows = g.tall if number < lowered.n_early else g.block_segment if last else g.map_rows
            linear_kernel(spec)(
                n, begin, rows, g.map_tile if last or step[Step.COLUMN_STEP] > 1 else g.width,
                g.y.step if last else 1, step[Step.COLUMN_STEP], 0, lowered.raw_row if raw else 0, int(not raw),
                self._pushed % self.n_taps if raw else 0, step[Step.SLOTS], step[Step.HOP],
                maps_at if last else to, plane, pitch, first, offset, ring, weight,
                self._raw if raw else self._scratch, self._maps if last else self._scratch,
            )  # fmt: skip

    def _make_tensor_by_planes(self, number: int) -> None:
        """On a GPU: sums over frames, windows along x, windows along y, each over whole planes."""
        from leafflow_ti.kernels.moments_by_planes import linear_kernel, window_kernel

        lowered, spec = self._lowered, self.device.moments
        g, windows, n_t = lowered.geometry, lowered.windows[number], self.sampling.t.size
        sums, across, down, _ = self._window_tables[number]
        linear_kernel(spec)(
            windows.n_sums, 0, g.block_rows, g.map_pitch, 1, 1, 0, g.map_pitch, 0, self._n_maps % n_t, n_t,
            lowered.slot_size, 0, g.map_plane, g.map_pitch, *sums[2:], self._maps, self._sums,
        )  # fmt: skip
        window_kernel(spec)(
            len(windows.wides), g.block_rows, self.band.cols, g.map_pitch, g.step_x, 1, taps(g.x), g.out_pitch, 0,
            *across, self._sums, self._wide,
        )  # fmt: skip
        window_kernel(spec)(
            len(windows.entries), self.band.rows, self.band.cols, g.step_y * g.out_pitch, 1, g.out_pitch, taps(g.y),
            g.out_pitch, self._starts[number], *down, self._wide, self.tensors,
        )  # fmt: skip


def source_planes(lowered: Lowered, cells: list[Cells], start: int) -> tuple[SourcePlanes, ...]:
    """Where the planes of the requests' cells lie, from element ``start`` on."""
    g, found = lowered.geometry, []
    # Lanes beyond the last column of a row look at cells, too.
    pitch = (g.out_pitch - 1) * g.step_x + taps(g.x)
    for one in cells:
        found.append(SourcePlanes(start, g.block_rows * pitch, pitch, g.step_x, g.step_y))
        start += len(one.sources) * g.block_rows * pitch
    return tuple(found)


def source_size(lowered: Lowered, cells: list[Cells]) -> int:
    """Elements of all these planes."""
    planes = source_planes(lowered, cells, 0)
    return planes[-1].start + len(cells[-1].sources) * planes[-1].plane if cells else 0


@functools.lru_cache(maxsize=64)
def band_bytes(
    columns: ColumnSet, layout: TensorLayout, sampling: Sampling, band: Band, itemsize: int,
    own: tuple[Request, ...] = (), gpu: bool = False, weighed: bool = False, mask: MaskMoments | None = None,
) -> int:  # fmt: skip
    """Memory of the arrays of one band, from raw frames to output maps; a GPU keeps whole planes of every step."""
    requests = (Request(columns, layout, sampling), *own)
    lowered = Lowered(*_tables(requests, mask), band, 1 if gpu else MOMENT_LANES)
    lanes = lowered.geometry.lanes
    output = OUTPUT_PLANES * band.rows * lowered.geometry.out_pitch
    sources = source_size(lowered, [Cells(r, n) for n, r in enumerate(requests)] if weighed else [])
    return itemsize * (lanes * sum(lowered.sizes(TASKS, TASKS)) + output + sources)
