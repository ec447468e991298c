"""What moving points need of a results store, frame by frame: motion in the image with its errors, and depth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import InputError
from leafflow_ti.interpolation import Cells, Lattice, Surface, finite
from leafflow_ti.mesh import JUMP, Neighbours
from leafflow_ti.status import Status

if TYPE_CHECKING:
    from leafflow_ti.results import ResultStore

Floats = NDArray[np.float64]
Maps = dict[str, NDArray[Any]]

FLOW = ("flow_x", "flow_y")
VELOCITY = ("velocity_x", "velocity_y", "velocity_z")
ACCELERATION = ("acceleration_x", "acceleration_y", "acceleration_z")
SLOPES = ("slope_x", "slope_y")


@dataclass(frozen=True, eq=False)
class Samples:
    """What n points find in a frame: ``motion`` [2, n] px/frame with its standard error ``std``, ``acceleration``
    [2, n] px/frame² (NaN where it is not measured), ``depth`` [n] mm (NaN without depth)."""

    motion: Floats
    std: Floats
    acceleration: Floats
    depth: Floats

    def where(self, alive: NDArray[np.bool_]) -> Samples:
        """The same, NaN for points that are not ``alive`` [n]."""
        return Samples(
            *(np.where(alive, v, np.nan) for v in (self.motion, self.std, self.acceleration, self.depth))
        )


class FrameAtPoints:
    """The maps of one frame, to be read at image positions."""

    def __init__(self, lattice: Lattice, surface: Surface, stack: Floats):
        self._lattice, self._surface, self._stack = lattice, surface, stack

    def reading(self, at: Floats) -> NDArray[np.uint8]:
        """Codes of ``interpolation.Reading`` [n] at the positions ``at`` [2, n] px."""
        return self._surface.reading(Cells.at(self._lattice, *at))

    def motion(self, at: Floats) -> Floats:
        """Motion [2, n] px/frame; NaN where it has no value."""
        return Cells.at(self._lattice, *at).mean(self._stack[:2])

    def samples(self, at: Floats) -> Samples:
        """All that is read at the positions ``at`` [2, n] px."""
        found = Cells.at(self._lattice, *at).mean(self._stack)
        with np.errstate(divide="ignore"):
            return Samples(found[:2], found[2:4], found[4:6], 1 / found[6])
