"""Which filtered planes, products and sums of one frame the tensors are made of: pure tables, no arrays, no engine.

A *plane* is named by the image that it comes from and by the kernel that was applied along each axis. Passes along one
axis after the other lead from raw images to the channels; every plane that two tensors need is made once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.models import AXES, ColumnSet, TensorLayout
from leafflow_ti.sampling import Sampling

Array = NDArray[np.float64]
FACTOR_PLANES = 4
"""Planes that derived channels may be multiplied by."""
EXTRA_PLANES = 4
"""Behind the tensor's entries: window mass, energies of the gradient, of it smoothed once more, of the image."""
POWERS = 3
"""Sums that are made of the same products at a time; the same number as ``kernels.moments.POWERS``."""
UNROLLED = 4
"""Outputs that a CPU kernel makes at a time; the same number as ``kernels.moments.BLOCK``."""
INVALID, FACTOR = -1, -2
"""In the place of an image's row: the plane of invalid pixels, factor planes."""
CAMERA_AXES = ("sy", "sx")
EXTRAS = ("mass", "energy", "smooth", "level")


class Plane(NamedTuple):
    """An image [row, col] of a frame and the kernel that was applied along each axis, "" where none was yet.

    Kernels: "b" smoothing, "d" derivative, "1" none, "n" counts; "bb", "db" and "nn" with smoothing once more.
    """

    row: int
    col: int
    t: str = ""
    sy: str = ""
    sx: str = ""
    y: str = ""
    x: str = ""


INVALID_SEEN = Plane(INVALID, 0, "n", "1", "1", "n", "n")
"""How many invalid pixels the filters see."""
INVALID_SEEN_TWICE = INVALID_SEEN._replace(y="nn", x="nn")
"""The same for filters that are followed by smoothing in the image once more."""


@dataclass(frozen=True)
class Request:
    """A tensor that is wanted: its columns and sampling, and its camera in (row, column) steps from the reference."""

    columns: ColumnSet
    layout: TensorLayout
    sampling: Sampling
    step: tuple[int, int] = (0, 0)

    def reach(self, pair: int) -> tuple[int, int]:
        """First and last row (``pair`` 0) or column (1) of cameras that it needs, counted from the reference."""
        radius = self.sampling.axis(CAMERA_AXES[pair]).radius
        return self.step[pair] - radius, self.step[pair] + radius


class MapKey(NamedTuple):
    """A sum of products over camera samples: of which request, of which channels, weighted by which offsets."""

    request: int
    what: tuple[str, ...]
    powers: tuple[int, int] = (0, 0)


MASS = MapKey(0, (EXTRAS[0],))
"""The window mass is that of the valid pixels, the same for all requests."""


@dataclass
class Group:
    """Up to ``POWERS`` maps of the same products: pairs of planes, and a weight for each map. ``constant`` is added.

    Pixels that do not count are those where the plane ``invalid`` is not 0.
    """

    maps: list[MapKey]
    pairs: list[tuple[Plane | str, Plane | str]]
    weights: list[tuple[float, ...]]
    constant: float = 0.0
    invalid: Plane = INVALID_SEEN


def packed(groups: list[Group]) -> list[Group]:
    """The same maps in fewer groups: what leaves weights unused is filled with the pairs of others."""
    found: list[Group] = []
    for group in sorted(groups, key=lambda g: -len(g.maps)):
        room = POWERS - len(group.maps)
        alike = (o for o in found if o.invalid == group.invalid and not o.constant and not group.constant)
        other = next((o for o in alike if len(o.maps) <= room), None)
        if other is None:
            copied = list(group.maps), list(group.pairs), list(group.weights)
            found.append(Group(*copied, group.constant, group.invalid))
            continue
        before = (0.0,) * len(other.maps)
        other.weights += [before + w for w in group.weights]
        other.pairs += group.pairs
        other.maps += group.maps
    return found


@dataclass
class Pass:
    """One pass along ``axis``: the planes that it makes, and how far beyond the maps (rows, columns) each is needed."""

    axis: str
    outputs: dict[Plane, tuple[int, int]]


@dataclass
class Channels:
    """Passes and products for a list of requests, the first of which has every camera axis there is.

    ``images``: rows and columns of the images of a frame; ``reference``: the reference camera among them.
    """

    requests: tuple[Request, ...]
    groups: list[Group] = field(default_factory=list)
    derived: dict[str, tuple[Plane, Plane | None]] = field(default_factory=dict)
    _terms: dict[tuple[str, Plane], list[tuple[Plane, int, float]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.sampling = self.requests[0].sampling
        derived = self.requests[0].columns.derived
        reach = [[r.reach(pair) for r in self.requests] for pair in (0, 1)]
        first, last = ([f(n[i] for n in pair) for pair in reach] for i, f in enumerate((min, max)))
        self.reference = (-first[0], -first[1])
        self.images = (last[0] - first[0] + 1, last[1] - first[1] + 1)
        if derived:
            self.images = (1, 1 + max(d.image for d in derived.values()))
        for axis in ("t", "y", "x"):
            assert all(r.sampling.axis(axis) == self.sampling.axis(axis) for r in self.requests)
        for r, request in enumerate(self.requests):
            self._plan_products(r, request)
        self.groups = packed(self.groups)

    @property
    def n_images(self) -> int:
        """Raw planes of one frame: images, the invalid pixels, factors."""
        return self.images[0] * self.images[1] + 1 + (FACTOR_PLANES if self.derived else 0)

    def image(self, plane: Plane) -> int:
        """Number of the raw plane that an unfiltered plane is."""
        n = self.images[0] * self.images[1]
        if plane.row >= 0:
            return plane.row * self.images[1] + plane.col
        return n if plane.row == INVALID else n + 1 + plane.col

    def kernel(self, axis: str, name: str, sample: int = 0) -> Array:
        """The kernel of a name; ``sample``, from the reference: where samples are uneven, each has its own."""
        sampling = self.sampling.axis(axis)
        if name == "1":
            return np.ones(1)
        if name in ("n", "nn"):
            return np.ones(len(name) * (sampling.taps - 1) + 1)
        once = sampling.kernel(name[0] == "d", sample)
        return np.convolve(once, sampling.kernel(False)) if len(name) == 2 else once

    def channel(self, request: Request, derivative: str | None, row: int, col: int) -> Plane:
        """An image smoothed along every axis but one, along which it is differentiated."""
        names = [
            "1" if request.sampling.axis(a).filters is None else "d" if a == derivative else "b"
            for a in ("t", "sy", "sx", "y", "x")
        ]
        return Plane(row, col, *names)

    def _plan_products(self, r: int, request: Request) -> None:
        columns, sampling = request.columns, request.sampling
        at = [AXES.index("sy"), AXES.index("sx")]
        for name, d in columns.derived.items():
            image = None if d.axis == "1" else self.channel(request, None if d.axis == "i" else d.axis, 0, d.image)
            factor = None if d.factor is None else Plane(FACTOR, d.factor, *"11111")
            one, two = (image, factor) if image else (factor, None)
            assert one is not None
            self.derived[name] = (one, two)
        centre = (self.reference[0] + request.step[0], self.reference[1] + request.step[1])
        powers: dict[tuple[str, ...], list[tuple[int, int]]] = {}
        for moment in request.layout.moments:
            found = powers.setdefault(moment.channels, [])
            both = (moment.exponents[at[0]], moment.exponents[at[1]])
            if both not in found:
                found.append(both)
        for what, wanted in powers.items():
            for first in range(0, len(wanted), POWERS):
                some = wanted[first : first + POWERS]
                group = Group([MapKey(r, what, p) for p in some], [], [])
                half = (sampling.sy.size // 2, sampling.sx.size // 2)
                for iy, ix in product(range(sampling.sy.size), range(sampling.sx.size)):
                    w = tuple(float(sampling.sy.window(p)[iy] * sampling.sx.window(q)[ix]) for p, q in some)
                    where = (centre[0] + iy - half[0], centre[1] + ix - half[1])
                    if any(w):
                        operands = [self._operand(request, channel, where) for channel in what]
                        group.pairs.append((operands[0], operands[1]))
                        group.weights.append(w)
                self.groups.append(group)
        gx, gy = (self.channel(request, a, *centre) for a in ("x", "y"))
        grey = Plane(*centre, *"11111")
        extra = Group([MapKey(r, (name,)) for name in EXTRAS[1:]], [], [], invalid=INVALID_SEEN_TWICE)
        for k, planes in enumerate(((gx, gy), (gx._replace(y="bb", x="db"), gy._replace(y="db", x="bb")), (grey,))):
            for plane in planes:
                extra.pairs.append((plane, plane))
                extra.weights.append(tuple(float(k == p) for p in range(POWERS)))
        self.groups.append(extra)
        if r == 0:
            self.groups.append(Group([MASS], [], [], 1.0))

    def _operand(self, request: Request, channel: str, where: tuple[int, int]) -> Plane | str:
        """A factor of a product: a filtered plane, or the name of a derived channel."""
        if request.columns.derived:
            return channel
        return self.channel(request, None if channel == "i" else channel, *where)

    @cached_property
    def finals(self) -> list[Plane]:
        """The planes that products are made of."""
        found: dict[Plane, None] = {INVALID_SEEN: None, INVALID_SEEN_TWICE: None}
        operands: Iterable[Plane | str | None] = [p for g in self.groups for pair in g.pairs for p in pair]
        operands = [*operands, *(p for pair in self.derived.values() for p in pair)]
        found.update({p: None for p in operands if isinstance(p, Plane)})
        return list(found)

    @cached_property
    def passes(self) -> list[Pass]:
        """The passes in order: cameras are combined as early as possible, unless single ones are needed, too."""
        late = len(self.requests) > 1
        order = ("t", "y", "x", "sy", "sx") if late else ("t", "sy", "sx", "y", "x")
        need = dict.fromkeys(self.finals, (0, 0))
        found = []
        for axis in reversed(order):
            # Planes of one image follow each other: their sources are then in the cache. Invalid pixels come first.
            found.append(Pass(axis, dict(sorted(need.items(), key=lambda item: (item[0].row != INVALID, item[0])))))
            before: dict[Plane, tuple[int, int]] = {}
            for plane, (ry, rx) in need.items():
                r = len(self.kernel(axis, getattr(plane, axis))) // 2
                reach = (ry + r * (axis == "y"), rx + r * (axis == "x"))
                for source, _, _ in self.terms(axis, plane):
                    have = before.get(source, (0, 0))
                    before[source] = (max(have[0], reach[0]), max(have[1], reach[1]))
            need = before
        return found[::-1]

    def terms(self, axis: str, plane: Plane) -> list[tuple[Plane, int, float]]:
        """What a plane is made of along one axis: sources, their offsets along t, y or x, weights."""
        known = self._terms.get((axis, plane))
        if known is not None:
            return known
        if axis == "sx" and self.sampling.grid and "1" not in (plane.sy, plane.sx):
            return self._grid_terms(plane)
        at = {"sy": plane.row - self.reference[0], "sx": plane.col - self.reference[1]}.get(axis, 0)
        kernel = self.kernel(axis, getattr(plane, axis), at)
        names = ["" if a == axis else name for a, name in zip(Plane._fields[2:], plane[2:], strict=True)]
        source = Plane(plane.row, plane.col, *names)
        found = []
        for i, w in enumerate(kernel.tolist()):
            shift = i - len(kernel) // 2
            if axis == "t" and self.sampling.t.uneven:
                found.append((source, shift, w))  # 0 here need not be 0 at the next frame
            elif w and axis == "sy":
                found.append((Plane(plane.row + shift, plane.col, *names), 0, w))
            elif w and axis == "sx":
                found.append((Plane(plane.row, plane.col + shift, *names), 0, w))
            elif w:
                found.append((source, shift, w))
        self._terms[axis, plane] = found
        return found

    def _grid_terms(self, plane: Plane) -> list[tuple[Plane, int, float]]:
        """The same for both camera axes at once, in the pass along sx; the one along sy leaves the sources alone."""
        assert self.sampling.grid is not None
        row, col = plane.row - self.reference[0], plane.col - self.reference[1]
        kernel = self.sampling.grid.kernel((plane.sy, plane.sx), row, col)
        found = []
        for (i, j), w in np.ndenumerate(kernel):
            at = plane.row + i - kernel.shape[0] // 2, plane.col + j - kernel.shape[1] // 2
            found.append((Plane(*at, plane.t, "1", "", plane.y, plane.x), 0, float(w)))
        self._terms["sx", plane] = found
        return found

    @property
    def halo(self) -> tuple[int, int]:
        """Rows and columns of raw images around the maps."""
        return (2 * self.sampling.y.filter_radius, 2 * self.sampling.x.filter_radius)
