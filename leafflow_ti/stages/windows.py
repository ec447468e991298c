"""From maps of single frames to packed tensors: sums over frames, windows along x, then along y, as tables.

A moment ``Σ w(Δ) Δ^m p`` is summed block by block: with Δ = B + δ, the middle of the block and the offset from it,
``Δ^m = Σ_i C(m, i) B^(m-i) δ^i``, so that sums of ``δ^i p`` over blocks are all that a window needs.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.blocks import Blocks
from leafflow_ti.models import AXES
from leafflow_ti.stages.channels import EXTRAS, MASS, MapKey, Request
from leafflow_ti.stages.mask_moments import MaskMoments

Array = NDArray[np.float64]


class BlockMap(NamedTuple):
    """A map times powers of the offsets from the middle of a block, summed over the block."""

    key: MapKey
    x: int
    y: int


class WideSet(NamedTuple):
    """Wide planes of one map: weighted by a power of the frame's offset, times a power of the block's rows.

    ``squared``: windows along x and y are those of the squared weights.
    """

    key: MapKey
    y: int
    t: int
    squared: bool = False


Wide = tuple[WideSet, int]
"""A wide plane: its set, and the power of x that it is a moment of."""


def power_table(blocks: Blocks, power: int, inner: int, squared: bool = False) -> Array:
    """Window weights (or these ``squared``) over blocks of the sums of ``δ^inner`` in a moment of ``power``."""
    weights = np.array(blocks.weights) ** (2 if squared else 1)
    found = math.comb(power, inner) * weights * blocks.centres ** (power - inner)
    return np.asarray(found)


@dataclass
class Windows:
    """Tables of one request, or of the moments of the valid part of its window where ``mask`` is given.

    ``sets`` gives each set the powers of x of the block sums that it is made of; ``wides`` lists (set, power of x).
    ``entries``: for every plane of the tensor, its wide planes (numbers) and their windows along y.
    """

    request: Request
    number: int
    mask: MaskMoments | None = None
    sets: dict[WideSet, int] = field(default_factory=dict)
    wides: dict[Wide, int] = field(default_factory=dict)
    entries: list[list[tuple[Wide, Array]]] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.mask:
            self._plan_mask(self.mask)
        else:
            self._plan_tensor()
        # The wide planes of one set stand together.
        ordered = [(s, e) for s in self.sets for e in range(self.sets[s] + 1) if (s, e) in self.wides]
        self.wides = {w: i for i, w in enumerate(ordered)}

    def _plan_mask(self, mask: MaskMoments) -> None:
        for x, y, t in mask.plain:
            self.entries.append([])
            self._add(MASS, t, x, y)
        for x, y in mask.squared:
            self.entries.append([])
            self._add(MASS, 0, x, y, squared=True)

    def _plan_tensor(self) -> None:
        at = {a: AXES.index(a) for a in AXES}
        for entry in self.request.layout.entries:
            self.entries.append([])
            for moment, factor in entry:
                e = moment.exponents
                key = MapKey(self.number, moment.channels, (e[at["sy"]], e[at["sx"]]))
                self._add(key, e[at["t"]], e[at["x"]], e[at["y"]], factor)
        for name in EXTRAS:
            self.entries.append([])
            self._add(MASS if name == EXTRAS[0] else MapKey(self.number, (name,)), 0, 0, 0)

    def _add(self, key: MapKey, t: int, x: int, y: int, factor: float = 1.0, squared: bool = False) -> None:
        """Add a moment to the last entry."""
        windows, blocks = dict(self.entries[-1]), self.request.sampling.y.blocked
        for n in range(y + 1) if blocks.length > 1 else (0,):
            wide_set = WideSet(key, n, t, squared)
            self.sets[wide_set] = max(self.sets.get(wide_set, 0), x)
            wide = (wide_set, x)
            self.wides.setdefault(wide, len(self.wides))
            windows[wide] = windows.get(wide, np.zeros(1)) + factor * power_table(blocks, y, n, squared)
        self.entries[-1] = list(windows.items())

    def sources(self, wide_set: WideSet) -> list[BlockMap]:
        """The block sums that a set is made of."""
        last = self.sets[wide_set] if self.request.sampling.x.blocked.length > 1 else 0
        return [BlockMap(wide_set.key, i, wide_set.y) for i in range(last + 1)]

    def across(self, wide: Wide) -> list[tuple[int, Array]]:
        """Windows along x of a wide plane: numbers of sources and weights."""
        blocks = self.request.sampling.x.blocked
        squared = wide[0].squared
        return [(i, power_table(blocks, wide[1], i, squared)) for i in range(wide[1] + 1 if blocks.length > 1 else 1)]

    @property
    def n_sums(self) -> int:
        """Sums over frames of all sets."""
        return sum(len(self.sources(s)) for s in self.sets)

    @property
    def block_maps(self) -> list[BlockMap]:
        """All block sums of one frame that are needed."""
        return list(dict.fromkeys(b for s in self.sets for b in self.sources(s)))


@functools.cache
def block_weights(blocks: Blocks, power: int) -> Array:
    """Weights of the samples of a block in the sum of ``δ^power p``."""
    return np.asarray(np.array(blocks.shape) * blocks.inner**power)


def x_powers(maps: list[BlockMap]) -> list[tuple[MapKey, int]]:
    """The sums along x that block sums are made of."""
    return list(dict.fromkeys((m.key, m.x) for m in maps))


def taps(blocks: Blocks) -> int:
    """Blocks of a window."""
    return len(blocks.weights)
