"""The tables of ``Channels`` and ``Windows`` laid out for bands of one size: places in memory, steps, tiles, bytes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.channels import INVALID, INVALID_SEEN, POWERS, UNROLLED, Channels, MapKey, Pass, Plane
from leafflow_ti.stages.planes import Terms, round_up
from leafflow_ti.stages.windows import Windows, block_weights, taps, x_powers

Ints = list[int]
ALL_ROWS = 1 << 30
"""Slots of what keeps every row."""
SCRATCH_BYTES = 2 << 20
"""Most of one task on the CPU, in single precision: what a row works with then stays in a core's second cache (the
whole need not: measured, wider tiles with less overlap are worth more)."""
WIDEST, NARROWEST = 64, 8
"""Columns of a tile: as many as the scratch has room for."""


@dataclass(frozen=True)
class Band:
    """A block of output pixels: ``rows`` × ``cols`` at distance ``stride``, and the input block that it needs."""

    rows: int
    cols: int
    stride: int
    halo_y: int
    halo_x: int

    @classmethod
    def of(cls, sampling: Sampling, rows: int, cols: int, stride: int) -> Band:
        """The halo holds the window, the filters, and the filters once more for the texture's smoothness."""
        return cls(
            rows,
            cols,
            stride,
            sampling.y.radius + sampling.y.filter_radius,
            sampling.x.radius + sampling.x.filter_radius,
        )

    @property
    def in_rows(self) -> int:
        """Rows of the input block."""
        return (self.rows - 1) * self.stride + 1 + 2 * self.halo_y

    @property
    def in_cols(self) -> int:
        """Columns of the input block."""
        return (self.cols - 1) * self.stride + 1 + 2 * self.halo_x


@dataclass(frozen=True)
class Region:
    """Planes in scratch: plane p, row r lies at ``base + p plane + (r modulo slots) hop``."""

    base: int
    plane: int
    slots: int
    hop: int

    def at(self, plane: int) -> int:
        """Where a plane begins."""
        return self.base + plane * self.plane

    @property
    def rows(self) -> Region:
        """How rows are kept, wherever that is."""
        return Region(0, 0, self.slots, self.hop)


class Linear:
    """Linear outputs, in the order of the steps that make them."""

    def __init__(self) -> None:
        self.terms: list[list[tuple[tuple[int, int], float]]] = []
        self.column: Ints = []
        self.blocks: Ints = []
        self.trim: Ints = []

    def add(self, terms: list[tuple[tuple[int, int], float]], column: int, width: int, trim: int = 0) -> None:
        """An output of ``width`` columns from ``column`` on; terms are ((offset, row), weight)."""
        self.terms.append(terms)
        self.column.append(column)
        self.blocks.append(-(-width // UNROLLED))
        self.trim.append(trim)


class Geometry:
    """Sizes: ``lanes`` vectors of rows a distance ``segment`` apart, columns in tiles; one tile for one lane (GPU)."""

    def __init__(self, sampling: Sampling, band: Band, halo: tuple[int, int], lanes: int, tile: int):
        self.lanes, self.halo = lanes, halo
        self.x, self.y = sampling.x.blocked, sampling.y.blocked
        assert band.stride % self.x.step == 0
        assert band.stride % self.y.step == 0
        self.step_x, self.step_y = band.stride // self.x.step, band.stride // self.y.step
        self.block_rows = (band.rows - 1) * self.step_y + taps(self.y)
        self.block_cols = (band.cols - 1) * self.step_x + taps(self.x)
        self.block_segment = -(-self.block_rows // lanes)
        self.segment = self.block_segment * self.y.step
        self.map_rows = (self.block_segment - 1) * self.y.step + self.y.length
        self.tall = self.map_rows + 2 * halo[0]
        whole = round_up(self.block_cols, UNROLLED)
        widest = whole if lanes == 1 else round_up(max(1, tile // self.x.step), UNROLLED)
        # Tiles of equal width: the last one should not be a sliver.
        self.n_tiles = -(-whole // widest)
        self.map_tile = round_up(-(-whole // self.n_tiles), UNROLLED)
        self.map_pitch = self.n_tiles * self.map_tile
        self.map_plane = self.block_segment * self.map_pitch
        self.tile = self.map_tile * self.x.step
        self.inner = (self.map_tile - 1) * self.x.step + self.x.length
        self.width = round_up(self.inner + 2 * halo[1], UNROLLED) + UNROLLED
        self.out_pitch = round_up(band.cols, 64)


class Lowered:
    """All tables of a band's stage, and the memory that it needs."""

    def __init__(self, channels: Channels, windows: list[Windows], band: Band, lanes: int):
        self.channels, self.windows, self.band = channels, windows, band
        self.gpu = lanes == 1
        tile = WIDEST
        self._lay_out(Geometry(channels.sampling, band, channels.halo, lanes, tile))
        while not self.gpu and tile > NARROWEST and 4 * lanes * self.scratch > SCRATCH_BYTES:
            tile //= 2
            self._lay_out(Geometry(channels.sampling, band, channels.halo, lanes, tile))

    def _region(self, n: int, early: bool, slots: int = 1, width: int | None = None) -> Region:
        """Room for ``n`` planes, of which a CPU keeps ``slots`` rows."""
        g = self.geometry
        width = width or g.width
        if self.gpu:
            rows = g.tall if early else g.map_rows
            region = Region(self.scratch, rows * g.width, ALL_ROWS, g.width)
        else:
            region = Region(self.scratch, slots * width, slots, width)
        self.scratch += n * region.plane
        return region

    def _step(self, n: int, source: Region | None, target: Region, column_step: int = 1, products: int = 0) -> None:
        """The next ``n`` outputs (or groups): made in one step."""
        first = self._n_groups if products else self._n_linear
        if products:
            self._n_groups += n
        else:
            self._n_linear += n
        slots, hop = (source.slots, source.hop) if source else (1, 0)
        widest = 0 if products else max(self.linear.blocks[first : first + n])
        outputs = [target.base, target.plane, target.slots, target.hop]
        self.steps.append([products, first, first + n, slots, hop, column_step, *outputs, widest])
        self._about_invalid.append(0)

    def _lay_out(self, geometry: Geometry) -> None:
        self.geometry = geometry
        # Filters look a little to the left of what a tile needs: room for that before the first plane.
        self.scratch = self.geometry.width if self.gpu else 0
        self.steps: list[Ints] = []
        self._about_invalid: Ints = []
        self.linear = Linear()
        self.over_time: list[tuple[int, str]] = []
        """Linear outputs that are made along time, and the names of their kernels."""
        self._n_linear = self._n_groups = 0
        self._lay_out_blocks(*self._lay_out_products(self._lay_out_filters()))
        self.zero = self.scratch
        self.scratch += 2 * self.geometry.width

    def _lay_out_filters(self) -> dict[Plane, int]:
        """Steps of the passes along t, y, x and the camera axes; the places of the channels.

        What the pass along y reads is kept for the rows from the first that it looks at to the newest one, all else
        for the row that is worked on.
        """
        channels = self.channels
        active = [p for p in channels.passes if p.axis in "ty" or any(getattr(o, p.axis) != "1" for o in p.outputs)]
        y = [p.axis for p in active].index("y")
        reaches = [ry for ry, _ in active[y - 1].outputs.values()]
        halo = self.geometry.halo[0]
        rings = {ry: self._region(reaches.count(ry), True, halo + ry + 1) for ry in sorted(set(reaches))}
        base = end = self.scratch
        raw = Region(0, 0, channels.sampling.t.taps, self.frame_size)
        places: dict[Plane, tuple[int, Region]] = {}
        for one in channels.passes:
            k = active.index(one) if one in active else -1
            if k == y:
                # Rows on the way into the rings are not needed any more: later ones take their place.
                self.n_early, end, self.scratch = len(self.steps), self.scratch, base
            before, places = places, {}
            todo: dict[tuple[Region, Region | None], list[Plane]] = {}
            for plane, (ry, _) in one.outputs.items():
                at, source = before.get(channels.terms(one.axis, plane)[0][0], (0, raw))
                # A plane that a pass leaves alone stays where it is; only out of a ring it must be copied.
                if k < 0 or (k > y and getattr(plane, one.axis) == "1"):
                    places[plane] = at, source
                else:
                    todo.setdefault((source.rows, rings[ry] if k == y - 1 else None), []).append(plane)
            if k == 1:
                self.n_raw = len(self.steps)
            rows = self._region(sum(len(p) for (_, ring), p in todo.items() if ring is None), k < y)
            for (source, ring), planes in todo.items():
                target = ring or rows
                self._filter(one, planes, before, source, target, early=k < y)
                places |= {plane: (target.at(n), target) for n, plane in enumerate(planes)}
                rows = replace(rows, base=target.at(len(planes))) if ring is None else rows
        self.scratch = max(self.scratch, end)
        return {plane: at for plane, (at, _) in places.items()}

    def _filter(
        self, one: Pass, planes: list[Plane], before: dict[Plane, tuple[int, Region]], source: Region, target: Region,
        early: bool,
    ) -> None:  # fmt: skip
        """One step: some planes of a pass, whose sources keep equally many rows."""
        channels, g = self.channels, self.geometry
        for plane in planes:
            if one.axis == "t":
                self.over_time.append((len(self.linear.terms), plane.t))
            terms = []
            for origin, shift, w in channels.terms(one.axis, plane):
                if one.axis == "t":
                    place = (channels.image(origin) * g.width, filter_radius(channels, "t") + shift)
                else:
                    across, down = (shift, 0) if one.axis == "x" else (0, shift)
                    row = g.halo[0] + down if one.axis == "y" else 0
                    place = (before[origin][0] + across, row % source.slots)
                terms.append((place, w))
            ry, rx = one.outputs[plane]
            self.linear.add(terms, g.halo[1] - rx, g.inner + 2 * rx, g.halo[0] - ry if early else 0)
        self._step(len(planes), source, target)
        self._about_invalid[-1] = n = sum(plane.row == INVALID for plane in planes)
        assert all(plane.row == INVALID for plane in planes[:n])

    @property
    def steps_without_invalid(self) -> list[Ints]:
        """The steps without the outputs that count invalid pixels, which come first: where there are none, the plane
        of zeros at ``zero`` stands for them."""
        found = []
        for (products, first, last, slots, hop, column_step, target, plane, *rest), n in zip(
            self.steps, self._about_invalid, strict=True
        ):
            found.append([products, first + n, last, slots, hop, column_step, target + n * plane, plane, *rest])
        return found

    def _lay_out_products(self, places: dict[Plane, int]) -> tuple[dict[MapKey, int], Region]:
        """Derived channels, then maps; the places of the maps."""
        channels = self.channels
        operands: dict[Any, int] = dict(places)
        groups: list[tuple[list[tuple[int, int]], list[tuple[float, ...]], float, int]] = []
        pairs = {name: pair for name, pair in channels.derived.items() if pair[1] is not None}
        operands |= {name: places[pair[0]] for name, pair in channels.derived.items() if pair[1] is None}
        if pairs:
            target = self._region(POWERS * len(pairs), False)
            for n, (name, (one, two)) in enumerate(pairs.items()):
                assert two is not None
                groups.append(([(places[one], places[two])], [(1.0, 0.0, 0.0)], 0.0, places[INVALID_SEEN]))
                operands[name] = target.at(POWERS * n)
            self._step(len(pairs), None, target, products=1)
        target = self._region(POWERS * len(channels.groups), False)
        maps: dict[MapKey, int] = {}
        for n, group in enumerate(channels.groups):
            weights = [w + (0.0,) * (POWERS - len(w)) for w in group.weights]
            both = [(operands[a], operands[b]) for a, b in group.pairs]
            groups.append((both, weights, group.constant, places[group.invalid]))
            maps |= {key: target.at(POWERS * n + p) for p, key in enumerate(group.maps)}
        self._step(len(channels.groups), None, target, products=1)
        self.groups = groups
        return maps, target

    def _lay_out_blocks(self, maps: dict[MapKey, int], source: Region) -> None:
        """Sums over the columns of blocks, then over their rows: the maps that are kept of each frame."""
        g = self.geometry
        halo = g.halo[1]
        self.block_maps = list(dict.fromkeys(b for w in self.windows for b in w.block_maps))
        begin = {(key, 0): at + halo for key, at in maps.items()}
        if g.x.length > 1 or g.y.length > 1:
            sums = x_powers(self.block_maps)
            target = self._region(len(sums), False, g.y.length, g.map_tile)
            for key, power in sums:
                weights = block_weights(g.x, power).tolist()
                self.linear.add([((maps[key] + halo + u, 0), w) for u, w in enumerate(weights) if w], 0, g.map_tile)
            begin = {one: target.at(n) for n, one in enumerate(sums)}
            self._step(len(sums), source, target, g.x.step)
            source = target
        for block in self.block_maps:
            weights = block_weights(g.y, block.y).tolist()
            self.linear.add([((begin[block.key, block.x], v), w) for v, w in enumerate(weights) if w], 0, g.map_tile)
        self._step(len(self.block_maps), source, Region(0, g.map_plane, ALL_ROWS, g.map_pitch))

    @property
    def raw_row(self) -> int:
        """Vectors of one row of all raw planes, in one tile."""
        return self.channels.n_images * self.geometry.width

    @property
    def frame_size(self) -> int:
        """Vectors of all raw planes of a frame, tile by tile, row by row."""
        return self.geometry.n_tiles * self.geometry.tall * self.raw_row

    @property
    def slot_size(self) -> int:
        """Vectors of the maps of a frame."""
        return len(self.block_maps) * self.geometry.map_plane

    @property
    def strips(self) -> int:
        """Strips of ``lanes`` output columns."""
        return -(-self.band.cols // self.geometry.lanes)

    @property
    def source_pitch(self) -> int:
        """Columns of the sums over frames: windows of the last outputs look a little beyond what counts."""
        g = self.geometry
        last = round_up(self.band.cols, UNROLLED) - 1
        return max(round_up(last * g.step_x + taps(g.x), UNROLLED), g.map_pitch) + UNROLLED

    @property
    def sums_size(self) -> int:
        """Vectors of a task's sums over frames, and of a row of wide planes."""
        sources = max(len(w.sources(s)) for w in self.windows for s in w.sets)
        return sources * self.source_pitch + self.strips * self.geometry.lanes

    @property
    def wide_plane(self) -> int:
        """Vectors of a plane between the windows along x and those along y."""
        return self.geometry.block_rows * (self.geometry.out_pitch if self.gpu else self.strips)

    def sizes(self, tiling: int, tasks: int) -> list[int]:
        """Vectors of raw frames, scratch, maps, sums, wide planes and of every tensor.

        ``tiling``, ``tasks``: into how many tasks a CPU cuts the filters and the windows.
        """
        g, windows = self.geometry, self.windows
        n_t = self.channels.sampling.t.size
        sums = tasks * self.sums_size
        if self.gpu:
            sums = max(w.n_sums for w in windows) * g.map_plane
        # What windows look at beyond the last row.
        beyond = UNROLLED * max(g.step_x, g.step_y) + g.width
        return [
            self.channels.sampling.t.taps * self.frame_size + beyond,
            min(tiling, g.n_tiles) * self.scratch + g.width,
            n_t * self.slot_size + beyond,
            sums + beyond,
            max(len(w.wides) for w in windows) * self.wide_plane + beyond,
            *(len(w.entries) * self.band.rows * g.out_pitch // g.lanes for w in windows),
        ]


def filter_radius(channels: Channels, axis: str) -> int:
    """Halo of the filters along an axis."""
    return channels.sampling.axis(axis).filter_radius


def padded_tables(
    outputs: list[list[tuple[int, NDArray[np.float64]]]], step: int
) -> tuple[Ints, Ints, Ints, NDArray[np.float64]]:
    """Windows of outputs, lists of (offset, weights), as first terms, offsets, places of weights, and the weights.

    Equal weights are kept once, between as many zeros as outputs that are made together reach beyond them.
    """
    zeros = np.zeros((UNROLLED - 1) * step)
    kept: dict[bytes, int] = {}
    parts: list[NDArray[np.float64]] = []
    size = 0
    numbered: list[list[tuple[Any, float]]] = []
    for output in outputs:
        terms: list[tuple[Any, float]] = []
        for offset, weights in output:
            name = weights.tobytes()
            if name not in kept:
                kept[name] = size + zeros.size
                parts += [zeros, weights]
                size += zeros.size + weights.size
            terms.append(((offset, kept[name]), 0.0))
        numbered.append(terms)
    found = Terms.of(numbered)
    return found.first, [s[0] for s in found.source], [s[1] for s in found.source], np.concatenate([*parts, zeros])
