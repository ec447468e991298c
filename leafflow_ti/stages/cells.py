"""The cells of windows that are weighted anew, as tables: see ``kernels.reweight``.

A cell's tensor is made of block sums: with Δ = B + δ, the middle of the block and the offset from it, its moments are
``Σ_i C(m, i) B^(m-i) δ^i``. The covariance of its columns' noise (Schuchert 2010, Eq. (2.24)) is a polynomial of the
offsets, averaged over the samples of the cell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.blocks import Blocks
from leafflow_ti.models import AXES, Entry
from leafflow_ti.stages.channels import MASS, MapKey, Request
from leafflow_ti.stages.mask_moments import noise_terms
from leafflow_ti.stages.windows import BlockMap

Array = NDArray[np.float64]
NARROW = 0.3
"""Width of a narrow window's further weights, per width of the window."""
Source = tuple[BlockMap, int]
"""A block sum, and the power of the frames' offsets that it is weighted by over time."""
_X, _Y, _T = (AXES.index(a) for a in ("x", "y", "t"))
_SX, _SY = (AXES.index(a) for a in ("sx", "sy"))


@dataclass(frozen=True)
class SourcePlanes:
    """Where the planes of a request's sources lie among the tensors: first element, distance of planes and of rows;
    cells from one output pixel to the next along x and y."""

    start: int
    plane: int
    pitch: int
    step_x: int
    step_y: int


class Cells:
    """Tables of one request, the ``number``-th of a tensor stage."""

    def __init__(self, request: Request, number: int = 0):
        self.request, self._number = request, number
        self._sources: dict[Source, int] = {}
        self.entries = [self._entry(entry) for entry in request.layout.entries]
        self.mass = self._source(MASS, 0, 0, 0)
        self.monomials: dict[tuple[int, int], int] = {}
        self.noises = self._noises()

    @property
    def sources(self) -> list[Source]:
        """The planes that cells are made of."""
        return list(self._sources)

    def _source(self, key: MapKey, x: int, y: int, t: int) -> int:
        return self._sources.setdefault((BlockMap(key, x, y), t), len(self._sources))

    def _entry(self, entry: Entry) -> list[tuple[int, int, int, float]]:
        """Terms of one entry of the tensor: source, powers of the block's middle along x and y, factor."""
        sampling = self.request.sampling
        found: dict[tuple[int, int, int], float] = {}
        for moment, factor in entry:
            e = moment.exponents
            key = MapKey(self._number, moment.channels, (e[_SY], e[_SX]))
            inner = [range(e[a] + 1) if s.blocked.length > 1 else (0,) for a, s in ((_X, sampling.x), (_Y, sampling.y))]
            for i, j in product(*inner):
                term = (self._source(key, i, j, e[_T]), e[_X] - i, e[_Y] - j)
                found[term] = found.get(term, 0.0) + factor * math.comb(e[_X], i) * math.comb(e[_Y], j)
        return [(*term, factor) for term, factor in found.items()]

    def _noises(self) -> list[tuple[int, int, int, float]]:
        """Terms of the noise's covariance: row and column of the lower triangle, monomial of (x, y), factor."""
        found: dict[tuple[int, int, int], float] = {}
        for r, c, (x, y), factor in noise_terms(self.request.columns, self.request.sampling, ("x", "y")):
            monomial = self.monomials.setdefault((x, y), len(self.monomials))
            found[r, c, monomial] = found.get((r, c, monomial), 0.0) + factor
        return [(*term, factor) for term, factor in found.items()]

    @cached_property
    def degrees(self) -> int:
        """Powers of the offsets that are needed, from 0 on."""
        powers = [max(x, y) for entry in self.entries for _, x, y, _ in entry]
        return 1 + max(*powers, *(max(m) for m in self.monomials))

    @property
    def lists(self) -> list[int]:
        """What the table ``number`` gets: the number of powers; first terms of the entries; of each term source and
        powers; of each noise row, column and monomial; of each monomial its powers. ``CELL_LISTS`` is behind the first.
        """
        terms = [term[:3] for entry in self.entries for term in entry]
        first = np.cumsum([0, *map(len, self.entries)]).tolist()
        groups = (terms, [noise[:3] for noise in self.noises], list(self.monomials))
        return [self.degrees, *first, *(n for group in groups for item in group for n in item)]

    @property
    def values(self) -> Array:
        """What the table ``value`` gets: factors of terms and noises; along x, then along y the weights of the cells
        and further ones of a narrow window, powers of their middles, and mean powers of their samples' offsets."""
        factors = [[term[3] for entry in self.entries for term in entry], [noise[3] for noise in self.noises]]
        blocks = (self.request.sampling.x.blocked, self.request.sampling.y.blocked)
        return np.concatenate([*factors, *(self._along(b) for b in blocks)])

    def _along(self, blocks: Blocks) -> Array:
        powers = np.arange(self.degrees)[:, None]
        samples = (blocks.centres[:, None] + blocks.inner) ** powers[..., None]
        means = samples @ np.array(blocks.shape) / sum(blocks.shape)
        narrow = np.exp(-0.5 * blocks.centres**2 / (NARROW**2 * blocks.moment))
        return np.concatenate([blocks.weights, narrow, (blocks.centres**powers).ravel(), means.ravel()])
