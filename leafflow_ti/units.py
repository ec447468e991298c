"""What all ways of computing a plan's units share: the output grid, engines for bands of it, a unit's maps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.aim import Aim
from leafflow_ti.capture import Capture
from leafflow_ti.curvature import surface_curvature
from leafflow_ti.engines import Engine, keep
from leafflow_ti.field import CORRELATIONS, coarsened, empty_map
from leafflow_ti.growth import growth_maps
from leafflow_ti.identify import settle
from leafflow_ti.plan import Plan
from leafflow_ti.reading import Mask, Reader
from leafflow_ti.refine_plan import Effort
from leafflow_ti.runtime import Device
from leafflow_ti.stages.tensor import Band
from leafflow_ti.status import HAS_VALUE, Status
from leafflow_ti.stays import Maps, Stays


class Units:
    """The units of a plan on a device, and what computes them; raises ConfigError for a mask that does not fit.

    ``apart``: with the stages ``solve`` and ``fit`` instead of ``estimate``, which is both in one go.
    """

    def __init__(self, plan: Plan, capture: Capture, device: Device, apart: bool = False):
        self._apart = apart
        self.plan, self.capture, self.device = plan, capture, device
        self.reader = Reader(plan, capture, device.real("storage"))
        self.stays = Stays(plan, self.reader)
        self._engines: dict[Band, Engine] = {}
        # Output pixels of the plan and those around them; rows and columns below count along these.
        self._y, self._x = (_widened(r, n, plan.margin) for r, n in ((plan.y, capture.height), (plan.x, capture.width)))
        self._rows = self._measurable("y", self._y, capture.height, 1)
        self._cols = self._measurable("x", self._x, capture.width, 0)
        self.effort = Effort()
        """Of the refinement in all units so far."""

    @property
    def mask(self) -> Mask | None:
        """Pixels [height, width] that may be measured; None: all."""
        return self.reader.mask

    def _make_engine(self, band: Band) -> Engine:
        first, aim = (self._x[0], self._y[0]), Aim(self.plan.preshift)
        return Engine.of(self.device, self.plan, band, lambda n: self.stays.view(first, band, n, aim), self._apart)

    def engine(self, band: Band) -> Engine:
        """The stages for a band of this size; those for the last one are kept."""
        if band not in self._engines:
            self._engines.clear()  # bands come in order: one engine's memory at a time
            self._engines[band] = self._make_engine(band)
        return self._engines[band]

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
        read, cameras = self.capture.pixels_read(plan.preshift), list(plan.cameras[1 - pair])
        lowest, highest = (n[cameras] for n in (read[2:] if pair == 0 else read[:2]))
        first, last = reach - int(lowest.min()), size - 1 - reach - int(highest.max())
        inside = [i for i, p in enumerate(positions) if first <= p <= last]
        return slice(inside[0], inside[-1] + 1) if inside else slice(0, 0)

    def extent(self, index: int) -> tuple[slice, slice]:
        """Rows and columns of a band that are computed, those for the sake of others included; empty: all border."""
        whole = self._around(self.plan.band(index))
        first = max(whole.start, self._rows.start)
        return slice(first, max(first, min(whole.stop, self._rows.stop))), self._cols

    def _around(self, rows: slice) -> slice:
        """Rows of the plan, and those that are computed around them."""
        first, margin = self._y.index(self.plan.y[0]), self.plan.margin
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

    def curvature(self, index: int, maps: Maps, codes: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """That of the surface, of a band and what is computed around it, for the refinement; None: it takes planes."""
        around = self.plan.around_curved
        if around is None:
            return None
        return surface_curvature(maps, codes, *self.around(index), self.plan.geometry, around)

    def wanted(self, index: int) -> Mask:
        """Pixels of a band and what is computed around it that are refined: its own, and their neighbours, from which
        they may start."""
        plan, (y, x) = self.plan, self.around(index)
        rows, step = plan.y[plan.band(index)], plan.y.step
        down = (np.array(y) >= rows[0] - step) & (np.array(y) <= rows[-1] + step)
        across = (np.array(x) >= plan.x[0] - plan.x.step) & (np.array(x) <= plan.x[-1] + plan.x.step)
        return np.asarray(down[:, None] & across)

    def settle(self, maps: Maps, codes: NDArray[np.uint8]) -> None:
        """What is identified once a refinement has changed values and standard errors."""
        maps["identified"] = settle(maps, codes, self.plan.limits)

    def cut(self, index: int, maps: Maps, codes: NDArray[np.uint8]) -> tuple[Maps, NDArray[np.uint8]]:
        """The maps of a band alone, and its status."""
        plan, (y, x) = self.plan, self.around(index)
        unit = plan.y[plan.band(index)]
        inner = slice(y.index(unit[0]), y.index(unit[-1]) + 1), slice(x.index(plan.x[0]), x.index(plan.x[-1]) + 1)
        cut = {n: maps[n][inner].copy() for n in plan.names}
        return {n: coarsened(m) if n in CORRELATIONS else m for n, m in cut.items()}, codes[inner].copy()


def _widened(positions: range, size: int, margin: int) -> range:
    """The positions, and up to ``margin`` more on each side where these lie within 0..size - 1."""
    step, last = positions.step, positions[-1]
    before, behind = min(margin, positions.start // step), min(margin, (size - 1 - last) // step)
    return range(positions.start - step * before, last + step * behind + 1, step)
