"""What moving points need of a results store, frame by frame: motion in the image with its errors, and depth."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.correlation import NoiseCorrelation
from leafflow_ti.errors import InputError
from leafflow_ti.field import CORRELATIONS, with_std
from leafflow_ti.interpolation import Cells, Joined, Lattice, Surface, finite, second_differences
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
UNKNOWN = 1e6
"""Standard error [px/frame] of a motion that is not determined: beyond any limit, but not infinite, which correlated
errors would turn into NaN when they are summed."""


@dataclass(frozen=True, eq=False)
class Samples:
    """What n points find in a frame: ``motion`` [2, n] px/frame with its standard error ``std``, ``acceleration``
    [2, n] px/frame² (NaN where it is not measured), ``depth`` [n] mm (NaN without depth). ``bend`` [2, n] px/frame: by
    how much the motion's second differences say that its bilinear mean is off, and the mean over a window."""

    motion: Floats
    std: Floats
    acceleration: Floats
    depth: Floats
    bend: Floats

    def where(self, alive: NDArray[np.bool_]) -> Samples:
        """The same, NaN for points that are not ``alive`` [n]."""
        return Samples(*(np.where(alive, getattr(self, one.name), np.nan) for one in fields(self)))


class FrameAtPoints:
    """The maps of one frame, to be read at image positions.

    ``spread`` [2]: second moments of a window along x and y, in squared steps of the lattice.
    """

    def __init__(self, lattice: Lattice, surface: Surface, stack: Floats, spread: tuple[float, float]):
        self._lattice, self._surface, self._stack, self._spread = lattice, surface, stack, spread
        self._bends = second_differences(stack[:2], surface)

    def reading(self, at: Floats) -> NDArray[np.uint8]:
        """Codes of ``interpolation.Reading`` [n] at the positions ``at`` [2, n] px."""
        return self._surface.reading(Cells.at(self._lattice, *at))

    def motion(self, at: Floats) -> Floats:
        """Motion [2, n] px/frame; NaN where it has no value."""
        return Cells.at(self._lattice, *at).mean(self._stack[:2])

    def samples(self, at: Floats) -> Samples:
        """All that is read at the positions ``at`` [2, n] px."""
        cells = Cells.at(self._lattice, *at)
        found = cells.mean(self._stack)
        bend = sum(
            0.5 * (part * (1 - part) + spread) * cells.mean(values)
            for part, spread, values in zip((cells.right, cells.down), self._spread, self._bends, strict=True)
        )
        with np.errstate(divide="ignore"):
            return Samples(found[:2], found[2:4], found[4:6], 1 / found[6], np.asarray(bend))


@dataclass(frozen=True, eq=False)
class PointMaps:
    """The maps of a store that points need. ``noise``: how the errors of its motion hang together."""

    store: ResultStore
    lattice: Lattice
    f_px: float
    principal: Floats  # [2] px
    names: tuple[str, ...]
    noise: NoiseCorrelation

    @classmethod
    def of(cls, store: ResultStore) -> PointMaps:
        """Of a results store; InputError where it holds no motion, or pixels that are not a regular lattice."""
        lattice = Lattice.of(store.x, store.y)
        has = set(store.names)
        if not (has >= set(FLOW) or has >= {"depth", *VELOCITY}):
            raise InputError(
                f"{store.path}: holds no motion, neither {FLOW[0]} nor {VELOCITY[0]} and depth: measure with time, and "
                "a model other than depth"
            )
        if "plan" not in store.attrs:
            raise InputError(f"{store.path}: does not say the camera's geometry: measure again with this version")
        plan = store.attrs["plan"]
        wanted = (*with_std((*FLOW, *VELOCITY)), *CORRELATIONS[1:], "depth", *SLOPES, *ACCELERATION)
        return cls(
            store,
            lattice,
            float(plan["f_px"]),
            np.array(plan["principal_px"], float),
            tuple(name for name in wanted if name in has),
            NoiseCorrelation.of(store),
        )

    def frame(self, index: int) -> FrameAtPoints:
        """What the frame with this index along t holds."""
        maps = {name: self.store.read(name, index).astype(np.float64) for name in self.names}
        measured = self.store.read("status", index) != Status.COARSE
        image = self._image_motion(maps)
        depth = maps.get("depth", np.full(measured.shape, np.nan))
        known = measured & finite([*image[:2], *([depth] if "depth" in maps else [])])
        with np.errstate(divide="ignore"):
            stack = np.concatenate([image, 1 / depth[None]])
        spread = window_moment(self.noise.x), window_moment(self.noise.y)
        return FrameAtPoints(self.lattice, Surface(known, self._joined(maps)), stack, spread)

    def in_space(self, at: Floats, depth: Floats) -> Floats:
        """Positions [..., n, 3] mm of the image positions ``at`` [..., 2, n] px at the depths [..., n] mm."""
        rays = (at - self.principal[:, None]) / self.f_px
        return np.stack([rays[..., 0, :] * depth, rays[..., 1, :] * depth, depth], axis=-1)

    def _rays(self) -> Floats:
        """Viewing rays (x/f, y/f) of the pixels, [2, h, w]."""
        x, y = ((at - c) / self.f_px for at, c in zip((self.store.x, self.store.y), self.principal, strict=True))
        return np.stack(np.broadcast_arrays(x, y[:, None]))

    def _image_motion(self, maps: Maps) -> Floats:
        """Motion in the image, its standard error, its acceleration along the way, [6, h, w]; px and frames."""
        motion, std = self._flow(maps)
        acceleration = np.full(motion.shape, np.nan)
        if all(name in maps for name in (*ACCELERATION, "depth", "velocity_z")):
            # The second derivative of f X/Z of a moving point.
            ahead = maps["velocity_z"] / maps["depth"]
            for k, (name, ray) in enumerate(zip(ACCELERATION[:2], self._rays(), strict=True)):
                pull = maps[name] - ray * maps[ACCELERATION[2]]
                acceleration[k] = self.f_px * pull / maps["depth"] - 2 * motion[k] * ahead
        return np.concatenate([motion, std, acceleration])

    def _flow(self, maps: Maps) -> tuple[Floats, Floats]:
        """Motion in the image and its standard error, [2, h, w] px/frame: as measured, else that of the velocity."""
        if all(name in maps for name in FLOW):
            motion, std = (np.stack([maps[f"{name}{end}"] for name in FLOW]) for end in ("", "_std"))
        else:
            scale, rays = self.f_px / maps["depth"], self._rays()
            ahead, ahead_std = maps["velocity_z"], maps["velocity_z_std"]
            motion, variance = np.empty_like(rays), np.empty_like(rays)
            for k, (name, ray) in enumerate(zip(VELOCITY[:2], rays, strict=True)):
                one, two = maps[f"{name}_std"], -ray * ahead_std
                # Older stores do not say the correlation: the worst.
                both = maps.get(CORRELATIONS[1 + k], np.sign(one * two)) * one * two
                motion[k] = scale * (maps[name] - ray * ahead)
                variance[k] = scale**2 * (one**2 + two**2 + 2 * both)
            std = np.sqrt(np.maximum(variance, 0))
        return motion, np.nan_to_num(std, nan=UNKNOWN, posinf=UNKNOWN)

    def _joined(self, maps: Maps) -> Joined | None:
        if "depth" not in maps:
            return None
        points = np.moveaxis(np.concatenate([self._rays(), np.ones((1, *maps["depth"].shape))]), 0, -1)
        slopes = (maps[SLOPES[0]], maps[SLOPES[1]]) if all(name in maps for name in SLOPES) else None
        return Neighbours(points * maps["depth"][..., None], slopes, JUMP).joined


def window_moment(correlation: Floats) -> float:
    """Second moment of a window, from the ``correlation`` of errors at 0, 1, 2, ... steps: the window's with itself, of
    twice the moment."""
    distance = np.arange(len(correlation))
    both = np.where(distance > 0, 2.0, 1.0) * correlation
    return float(0.5 * np.sum(both * distance**2) / np.sum(both))
