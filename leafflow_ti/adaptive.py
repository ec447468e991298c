"""Units of captures whose disparities or motions no single whole-pixel shift serves.

Each frame is searched coarsely first (``search``). Tiles of the output are then computed once for every label that
occurs in them (``surfaces``), each pass seeing its own surface alone, and every pixel takes the pass of its label; one
that has no value there takes that of another label around it which explains its window best. Where surfaces meet, the
status says ``contested``.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.aim import Aim
from leafflow_ti.capture import Capture
from leafflow_ti.field import empty_map
from leafflow_ti.plan import Plan, Unit
from leafflow_ti.reading import Mask
from leafflow_ti.refinement import Place, refine_maps, refined_from
from leafflow_ti.search import Extent, coarse_search
from leafflow_ti.stages.tensor import Band
from leafflow_ti.status import HAS_VALUE, Status
from leafflow_ti.stays import Maps, Stay, without_images
from leafflow_ti.surfaces import REACH, Surfaces, vector
from leafflow_ti.trace import span
from leafflow_ti.units import Units

Codes = NDArray[np.uint8]
BEYOND = (Status.BORDER, Status.INCOHERENT, Status.NOT_CONVERGED)
"""Statuses of pixels that the refinement may still have values for: not all images see all of their windows."""
STRAY = 0.75
"""Pixels per step or frame between a measured value and the search's, beyond which it is of another surface, or none:
the search is good to half a pixel where it is right, and there (Tsukuba) it is right nine times of ten."""
BEGUN_STEPS = 8
"""Least number of steps of a refinement that begins with what the search found, which is farther off than what a model
measures."""
UNDECIDED = -1
"""Instead of the number of a label: no pass gave a value."""


@dataclass(frozen=True)
class _Tile:
    """Part of a band's output pixels: rows and columns of the band, their place in the image, labels in it."""

    rows: slice
    cols: slice
    y: range
    x: range
    labels: tuple[int, ...]
    """The most frequent first."""

    @property
    def pixels(self) -> tuple[NDArray[np.intp], ...]:
        """The tile in maps of the whole image."""
        return np.ix_(self.y, self.x)

    def groups(self, surfaces: Surfaces, chosen: NDArray[np.int64]) -> list[list[int]]:
        """Its labels, and others that its pixels have ``chosen``, in groups of which all are within a pixel of the
        first: the refinement, which knows no filters, sees all of them in the images that the first one aims at."""
        found: list[list[int]] = []
        others = np.setdiff1d(chosen, (*self.labels, UNDECIDED)).tolist()
        for label in (*self.labels, *others):
            aim = vector(surfaces.aims[label])
            near = (g for g in found if np.abs(vector(surfaces.aims[g[0]]) - aim).max() <= 1)
            group = next(near, None)
            if group is None:
                found.append([label])
            else:
                group.append(label)
        return found

    @property
    def place(self) -> tuple[slice, slice]:
        """Of the tile in the band's maps."""
        return self.rows, self.cols


class Adaptive:
    """Computes the units of an adaptive plan, frame by frame."""

    def __init__(self, common: Units):
        self.common, self.plan, self.capture = common, common.plan, common.capture
        margin = 2 * self.plan.margin
        self._band = Band.of(
            self.plan.problem.sampling, self.plan.band_rows + margin, self.plan.tile_cols, self.plan.x.step
        )

    def units(self, t_index: int, bands: Iterable[int]) -> Iterator[tuple[Unit, Maps, Codes]]:
        """The units of some bands of one frame."""
        plan, common = self.plan, self.common
        frame = plan.frames[t_index]
        with span("search", f"frame {frame}"):
            surfaces = self._surfaces(frame)
        edges = surfaces.near_edges()
        for index in bands:
            with span("host", f"frame {frame}"):
                y, x = common.around(index)
                tiles = self._tiles(y, x, surfaces)
                maps, codes, chosen = self._measured(tiles, (len(y), len(x)), frame, surfaces)
                joined = _joined(surfaces.shown[np.ix_(range(4), y, x)])
                maps, codes = common.framed(index, maps, codes, joined)
                if plan.refine:
                    self._refine(index, tiles, surfaces, frame, maps, codes, chosen)
                    self._drop_strays(maps, codes, surfaces, y, x)
                    common.settle(maps, codes)
                codes[(codes == Status.OK) & edges[np.ix_(y, x)]] = Status.CONTESTED
                self._fill_in(maps, codes, surfaces, y, x)
                result = common.cut(index, maps, codes)
            yield plan.unit(t_index, index), *result

    def _surfaces(self, frame: int) -> Surfaces:
        """What a frame shows, by the coarse search."""
        plan, capture = self.plan, self.capture
        search = plan.config.search
        disparities = None if isinstance(search.disparity_range, str) else search.disparity_range
        motions = None if isinstance(search.motion_range, str) else search.motion_range
        extent = extent_of(plan, self.capture)

        def image(t: int, sy: int, sx: int) -> NDArray[np.float32]:
            return capture.read(t, sy, sx, 0, capture.height, 0, capture.width)

        coarse = coarse_search(
            self.common.device, image, extent, reference=capture.reference, frame=frame,
            moving="t" in plan.problem.columns.solutions, disparity_range=disparities, motion_range=motions,
            mask=self.common.mask,
        )  # fmt: skip
        after = -self.common.reader.elapsed(frame, frame)  # that results lie behind the frame that was searched
        if after:
            coarse = coarse.later(after, extent.toward)
        return Surfaces(self.common.device, coarse, extent, plan.cameras, capture.reference)

    def _strays(self, maps: Maps, surfaces: Surfaces, y: range, x: range) -> Mask:
        """Pixels whose values lie farther from what the search found than a pass can see: they follow something else,
        or nothing."""
        there = np.ix_(y, x)
        strays = np.zeros((len(y), len(x)), np.bool_)
        for name, values in self._shown(surfaces, there).items():
            if name in maps:
                with np.errstate(invalid="ignore"):
                    strays |= np.abs(maps[name] - values) > STRAY
        return strays

    def _drop_strays(self, maps: Maps, codes: Codes, surfaces: Surfaces, y: range, x: range) -> None:
        """Take their values from pixels that strayed."""
        strays = self._strays(maps, surfaces, y, x) & np.isin(codes, HAS_VALUE)
        codes[strays] = Status.INCOHERENT
        for name, values in maps.items():
            values[strays] = empty_map(name, ())

    def _fill_in(self, maps: Maps, codes: Codes, surfaces: Surfaces, y: range, x: range) -> None:
        """What the search found, where nothing better is known."""
        there = np.ix_(y, x)
        empty = np.isin(codes, BEYOND) & surfaces.known[there]
        if self.common.mask is not None:
            empty &= self.common.mask[there]
        found = self._shown(surfaces, there)
        if "disparity" in found:
            geometry, axis = self.plan.geometry, surfaces.axis
            with np.errstate(divide="ignore"):
                depth = -geometry.f_px * geometry.baseline_mm[axis] / found["disparity"]
            found["depth"] = depth
            empty &= np.isfinite(depth) & (depth > 0)
        for name, values in found.items():
            if name in maps:
                maps[name][empty] = values[empty]
        codes[empty] = Status.COARSE

    def _shown(self, surfaces: Surfaces, there: tuple[NDArray[np.intp], ...]) -> dict[str, NDArray[np.float32]]:
        """The maps that the search itself gives, at some pixels."""
        found, offset = {}, self.plan.geometry.disparity_offset_px
        if self.plan.problem.camera_axes:
            found["disparity"] = surfaces.shown[surfaces.axis][there] + np.float32(offset[surfaces.axis])
        if "t" in self.plan.problem.columns.solutions:
            found |= {"flow_x": surfaces.shown[2][there], "flow_y": surfaces.shown[3][there]}
        return found

    def _tiles(self, y: range, x: range, surfaces: Surfaces) -> list[_Tile]:
        found = []
        for first in range(0, len(x), self.plan.tile_cols):
            cols = slice(first, min(first + self.plan.tile_cols, len(x)))
            labels, counts = np.unique(surfaces.number[np.ix_(y, x[cols])], return_counts=True)
            order = np.argsort(-counts, kind="stable")
            found.append(_Tile(slice(0, len(y)), cols, y, x[cols], tuple(int(n) for n in labels[order])))
        return found

    def _stay(self, tile: _Tile, surfaces: Surfaces, group: Sequence[int], frame: int) -> Stay:
        """The engine at a tile, aimed at the first of some labels, to see their surface alone."""
        common, aims = self.common, [surfaces.aims[label] for label in group]
        first = frame - self.plan.problem.sampling.t.before
        return common.stays.move(
            common.engine(self._band), self._band, (tile.x[0], tile.y[0]), aims[0], first, frame,
            partial(surfaces.layer, aims), partial(surfaces.hidden, aims[0]),
        )  # fmt: skip

    def _feed(
        self, stay: Stay, around: tuple[int, int], each: Callable[[int, NDArray[np.float32], Mask], None]
    ) -> None:
        """So many frames before and behind that of a stay, in turn; its engine then speaks of that."""
        frames = range(stay.frame - around[0], stay.frame + around[1] + 1)
        with contextlib.closing(self.common.reader.blocks(frames, stay.box, stay.aim, stay.frame)) as blocks:
            for t in frames:
                each(t, *next(blocks))
        stay.engine.set_frame(stay.frame)

    def _pass(self, tile: _Tile, surfaces: Surfaces, label: int, frame: int) -> tuple[Maps, Codes]:
        """Maps and status of a tile as one label sees them."""
        stays, samples = self.common.stays, []
        stay = self._stay(tile, surfaces, (label,), frame)
        tensors = None

        def push(t: int, block: NDArray[np.float32], finite: Mask) -> None:
            nonlocal tensors
            sample = stays.sample(stay, t, block, finite, refining=False)
            tensors = stay.engine.push(sample)
            if t == frame:
                samples.append(without_images(sample))

        time = self.plan.problem.sampling.t
        self._feed(stay, (time.before, time.after), push)
        self.common.device.synchronize()
        maps, status = stays.maps(stay, tensors, samples[0])
        inner = (slice(0, len(tile.y)), slice(0, len(tile.x)))
        maps, status = {name: values[inner] for name, values in maps.items()}, status[inner]
        status[self._strays(maps, surfaces, tile.y, tile.x) & np.isin(status, HAS_VALUE)] = Status.INCOHERENT
        return maps, status

    def _passes(
        self, tile: _Tile, frame: int, surfaces: Surfaces
    ) -> tuple[dict[int, tuple[Maps, Codes]], NDArray[np.int64]]:
        """Maps and status of a tile by label, and the label that each pixel takes: its own, or where that has no value,
        of those offered to it the one with the highest confidence."""
        passes = {label: self._pass(tile, surfaces, label, frame) for label in tile.labels}
        which, mask = surfaces.number[tile.pixels].astype(np.int64), self.common.mask
        missing = np.ones(which.shape, np.bool_) if mask is None else mask[tile.pixels].copy()
        for label, (_, status) in passes.items():
            missing[(which == label) & np.isin(status, HAS_VALUE)] = False
        best = np.full(which.shape, -1.0)
        for label, offered in surfaces.offered(tile.y, tile.x):
            wanted = offered & missing
            if not wanted.any():
                continue
            if label not in passes:
                passes[label] = self._pass(tile, surfaces, label, frame)
            maps, status = passes[label]
            confidence = np.where(wanted & np.isin(status, HAS_VALUE), np.nan_to_num(maps["confidence"]), -1.0)
            better = confidence > best
            which[better], best[better] = label, confidence[better]
        return passes, which

    def _measured(
        self, tiles: list[_Tile], shape: tuple[int, int], frame: int, surfaces: Surfaces
    ) -> tuple[Maps, Codes, NDArray[np.int64]]:
        """Maps and status of a band's tiles, and the label that each pixel took."""
        maps: Maps = {}
        codes, chosen = np.full(shape, Status.BORDER, np.uint8), np.full(shape, UNDECIDED)
        for tile in tiles:
            passes, which = self._passes(tile, frame, surfaces)
            chosen[tile.place] = which
            for label, (found, status) in passes.items():
                mine = which == label
                codes[tile.place][mine] = status[mine]
                for name, values in found.items():
                    maps.setdefault(name, empty_map(name, shape))[tile.place][mine] = values[mine]
        return maps, codes, chosen

    def _refine(
        self, index: int, tiles: list[_Tile], surfaces: Surfaces, frame: int, maps: Maps, codes: Codes,
        chosen: NDArray[np.int64],
    ) -> None:  # fmt: skip
        """Refine a band's pixels; those that no pass has values for from what the search found around them."""
        curvature, needed = self.common.curvature(index, maps, codes), self.common.wanted(index)
        for tile in tiles:
            taken, status = chosen[tile.place], np.where(needed, codes, Status.NOT_COMPUTED)[tile.place]
            bent = None if curvature is None else curvature[tile.place]
            wanted = surfaces.known[tile.pixels] & np.isin(status, BEYOND)
            for group in tile.groups(surfaces, taken):
                mine = np.isin(taken, group) & (status == Status.OK)
                begun = np.isin(surfaces.number[tile.pixels], group) & wanted
                if mine.any() or begun.any():
                    self._refine_group(tile, surfaces, group, frame, maps, codes, mine, begun, bent)

    def _refine_group(
        self, tile: _Tile, surfaces: Surfaces, group: list[int], frame: int, maps: Maps, codes: Codes, mine: Mask,
        begun: Mask, curvature: NDArray[np.float64] | None,
    ) -> None:  # fmt: skip
        """Refine the pixels ``mine`` and ``begun`` of a tile with the images that a group of labels aims at, in place.

        ``begun`` have no values yet: they keep none where the refinement does not converge. ``curvature``: as of
        ``refine_maps``. The model needs every camera and frame to see a pixel; the refinement takes the images that do.
        """
        plan, aims = self.plan, [surfaces.aims[label] for label in group]
        stay = self._stay(tile, surfaces, group, frame)
        self._feed(stay, plan.around, partial(self.common.stays.refine_alone, stay))
        assert stay.engine.refine is not None
        assert plan.refine is not None
        part = {name: values[tile.place].copy() for name, values in maps.items()}
        place = Place(tile.y, tile.x, (stay.wide.y, stay.wide.x), plan.geometry)
        for some, steps in ((mine, None), (begun, max(plan.refine.steps, BEGUN_STEPS))):
            status = np.where(some, np.uint8(Status.OK), np.uint8(Status.NOT_COMPUTED))
            if some is begun and begun.any():
                start = coarse_start(surfaces, aims, (tile.y, tile.x), plan)
                for name in part.keys() & start.keys():
                    part[name][begun] = start[name][begun]
                status[begun & ~refined_from(plan.refine, part, status)] = Status.NOT_COMPUTED
            self.common.effort += refine_maps(stay.engine.refine, plan.refine, part, status, place, steps, curvature)
            found = mine if some is mine else begun & (status == Status.OK)
            codes[tile.place][found] = status[found]
            for name, values in part.items():
                maps[name][tile.place][found] = values[found]


def coarse_start(surfaces: Surfaces, aims: Sequence[Aim], at: tuple[range, range], plan: Plan) -> Maps:
    """What the surface of some labels looks like around the pixels at rows and columns ``at``, as the refinement can
    start from it: the plane and the motion that fit the search's values within its window. NaN where there are none."""
    refine, geometry, axis = plan.refine, plan.geometry, surfaces.axis
    assert refine is not None
    fitted, along_x, along_y = surfaces.planes(aims, at, refine.size // 2)
    if refine.flat:
        return {"flow_x": fitted[2], "flow_y": fitted[3]}
    f, disparity = geometry.f_px, fitted[axis] + geometry.disparity_offset_px[axis]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -f * geometry.baseline_mm[axis] / disparity
        # Disparities of a plane are linear: d ~ 1 - ZX x/f - ZY y/f.
        tilt_x, tilt_y = (f * slope[axis] / disparity for slope in (along_x, along_y))
    ray_y, ray_x = ((np.array(n) - c) / f for n, c in zip(at, geometry.principal_px[::-1], strict=True))
    slant = 1.0 / (1.0 - tilt_x * ray_x - tilt_y * ray_y[:, None])
    depth[~(np.isfinite(depth) & (depth > 0.0) & (slant > 0.0))] = np.nan
    start = {"depth": depth, "disparity": disparity, "slope_x": -tilt_x * slant, "slope_y": -tilt_y * slant}
    return start | {f"velocity_{name}": fitted[2 + k] * depth / f for k, name in enumerate("xy")}


def extent_of(plan: Plan, capture: Capture) -> Extent:
    """How the search sees a capture; along axes that the model does not read there is one camera."""
    read = [len(cameras) > 1 for cameras in plan.cameras]
    rows, cols = (n if several else 1 for n, several in zip((capture.n_rows, capture.n_cols), read, strict=True))
    geometry = plan.geometry
    return Extent(
        capture.n_frames, rows, cols, capture.height, capture.width, geometry.baseline_mm,
        geometry.disparity_offset_px, capture.frame_times,
    )  # fmt: skip


def _joined(shown: NDArray[np.float32]) -> tuple[Mask, Mask]:
    """Whether pixels [4, rows, cols] show one surface with their neighbours: [rows - 1, cols], [rows, cols - 1]."""
    down, across = (np.abs(np.diff(shown, axis=axis)).max(axis=0) <= REACH for axis in (1, 2))
    return down, across
