"""The moments of the valid part of windows, and what they replace where a mask or a border cuts a window.

Of a whole window everything is known beforehand: the noise covariance of its columns is diagonal, odd moments vanish.
Of the valid samples of a cut one (v = 1) the moments ``Σ w v Δ^e`` say it, pixel by pixel: planes behind the tensors,
the same for all tensors of a pixel. ``kernels.cut`` works with them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.models import AXES, Column, ColumnSet
from leafflow_ti.sampling import Sampling, channel_noise, noise_ratio, pixel_factor
from leafflow_ti.stages.channels import Request

Array = NDArray[np.float64]
Exponents = tuple[int, ...]
CURVED_DEGREE = 3
"""Of moments in x and y that the second-order part of the flow, projected on 1, x, y, needs; 2 on 1 alone."""


def noise_terms(
    columns: ColumnSet, sampling: Sampling, axes: Sequence[str]
) -> Iterator[tuple[int, int, Exponents, float]]:
    """The covariance of the columns' noise (2.24), summed over a window, as a polynomial of offsets along ``axes``.

    Yields row and column of the lower triangle, exponents along ``axes``, factor; over the other axes it is summed.
    """
    kept = [AXES.index(a) for a in axes]
    others = [a for a in AXES if a not in axes]
    for r, one in enumerate(columns.columns):
        for c, two in enumerate(columns.columns[: r + 1]):
            for p, q in product(one.terms, two.terms):
                e = tuple(m + n for m, n in zip(p.exponents, q.exponents, strict=True))
                rest = math.prod(sampling.axis(a).moment(e[AXES.index(a)]) for a in others)
                if (p.channel, p.vector) == (q.channel, q.vector) and rest:
                    gain = channel_noise(sampling, columns, p.channel, e)
                    yield r, c, tuple(e[i] for i in kept), p.factor * q.factor * gain * rest


@dataclass(frozen=True)
class MaskMoments:
    """Which moments of a window's valid part are kept: exponents (x, y, t) of ``plain`` ones, with the weights w, and
    (x, y) of ``squared`` ones, with w² along x and y.

    The plain ones begin with those in x and y by ascending degree, then falling power of x: up to degree 3 where
    derivatives along x and y are measured (``affine``), else 2.
    """

    plain: tuple[tuple[int, int, int], ...]
    squared: tuple[tuple[int, int], ...]
    affine: bool

    @classmethod
    def of(cls, requests: Sequence[Request]) -> MaskMoments:
        """What the tensors of ``requests`` need."""
        affine = all(r.columns.index("x", a) is not None for r in requests for a in ("x", "y"))
        degree = CURVED_DEGREE if affine else CURVED_DEGREE - 1
        plain = {(n - j, j, 0): None for n in range(degree + 1) for j in range(n + 1)}
        squared: dict[tuple[int, int], None] = {}
        for request in requests:
            terms = noise_terms(request.columns, request.sampling, ("x", "y", "t"))
            plain |= {(e[0], e[1], e[2]): None for *_, e, _ in terms}
            for one, two in product(shapes_of(request.columns), repeat=2):
                for both, _ in _product(one, two):
                    plain[*both, 0] = None
                    squared[both] = None
        return cls(tuple(plain), tuple(squared), affine)

    @property
    def n_planes(self) -> int:
        """Planes of one pixel: the plain moments, then the squared ones."""
        return len(self.plain) + len(self.squared)


Polynomial = tuple[tuple[tuple[int, int], float], ...]
"""A polynomial of x and y: exponents and factors."""


def shape_of(column: Column) -> Polynomial:
    """What a column depends on x and y by; of range flow, whose columns mix channels, nothing."""
    others = column.terms[0].exponents[2:]
    alike = [t for t in column.terms if t.exponents[2:] == others]
    if len({t.channel for t in column.terms}) > 1:
        return (((0, 0), 1.0),)
    return tuple(((t.exponents[0], t.exponents[1]), t.factor) for t in alike)


def shapes_of(columns: ColumnSet) -> list[Polynomial]:
    """The different shapes of the columns that are not time-like, the constant first."""
    return list(dict.fromkeys([(((0, 0), 1.0),), *(shape_of(c) for c in columns.columns[: columns.n_flow])]))


def _product(one: Polynomial, two: Polynomial) -> Polynomial:
    return tuple(((p[0] + q[0], p[1] + q[1]), f * g) for (p, f), (q, g) in product(one, two))


@dataclass(frozen=True)
class CutTables:
    """Tables of one data vector for ``kernels.cut``, see there."""

    columns: ColumnSet
    sampling: Sampling
    moments: MaskMoments

    @cached_property
    def noises(self) -> list[tuple[int, int, int, float]]:
        """Row, column, plane, factor of the terms of the noise covariance."""
        number = {e: n for n, e in enumerate(self.moments.plain)}
        found: dict[tuple[int, int, int], float] = {}
        for r, c, e, factor in noise_terms(self.columns, self.sampling, ("x", "y", "t")):
            term = (r, c, number[e[0], e[1], e[2]])
            found[term] = found.get(term, 0.0) + factor
        return [(*term, factor) for term, factor in found.items()]

    @cached_property
    def shapes(self) -> list[Polynomial]:
        """As ``shapes_of`` has them."""
        return shapes_of(self.columns)

    @cached_property
    def products(self) -> list[tuple[int, int, int, float]]:
        """Element of the packed triangle of shapes, plane of the plain and of the squared moment, factor: the terms of
        the shapes' products over the window."""
        plain, squared, found = self.moments.plain, self.moments.squared, []
        pairs = [(one, two) for i, one in enumerate(self.shapes) for two in self.shapes[: i + 1]]
        for element, (one, two) in enumerate(pairs):
            for e, factor in _product(one, two):
                found.append((element, plain.index((*e, 0)), len(plain) + squared.index(e), factor))
        return found

    @property
    def lists(self) -> list[int]:
        """What the table ``number`` gets: row, column and plane of the noise's terms; element and planes of the terms
        of the shapes' products; of each column that is not time-like its shape and its family, the columns that differ
        from it in shape alone; and whether a term of ``noise_ratio`` is of squares in the image."""
        flow = self.columns.columns[: self.columns.n_flow]
        kinds = [(c.channel, c.terms[0].exponents[2:]) for c in flow]
        of = [
            n for c, kind in zip(flow, kinds, strict=True) for n in (self.shapes.index(shape_of(c)), kinds.index(kind))
        ]
        square = [max(c.terms[0].exponents[:2]) > 1 for c in flow]
        _, terms = noise_ratio(self.sampling, self.columns, self.columns.solutions[0])
        noises = [n for term in self.noises for n in term[:3]]
        return [
            *noises,
            *(n for term in self.products for n in term[:3]),
            *of,
            *(square[t.a] or square[t.b] for t in terms),
        ]

    @property
    def values(self) -> Array:
        """What the table ``value`` gets: factors of the noise's terms and of the products'; for each pair of shapes
        (packed) the ratio of the moments of w² and w of a whole window, of the constant's to its own."""
        whole = [
            math.prod(
                pixel_factor(axis, m, n)
                for axis, m, n in zip((self.sampling.x, self.sampling.y), one[0][0], two[0][0], strict=True)
            )
            for i, one in enumerate(self.shapes)
            for two in self.shapes[: i + 1]
        ]
        factors = (*(term[3] for term in self.noises), *(term[3] for term in self.products))
        return np.array([*factors, whole[0], *(whole[0] / w for w in whole)])
