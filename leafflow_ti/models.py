"""The models as a table: which data columns they have, and which image parameters they yield.

Conventions. Axes are named ``x, y`` (pixel, right and down), ``sx, sy`` (camera index from the reference) and ``t``
(frame index from the reference); a monomial is the tuple of its exponents over these five axes. A *channel* is a
filtered image: its derivative along one axis (``x``, ``y``, ``sx``, ``sy``, ``t``), or the smoothed image itself
(``i``). A *column* of the data vector ``d`` is a sum of terms, channel times monomial of the offset from the window
centre (Schuchert 2010, Eqs. (2.3)-(2.8), (3.38), (3.39), (4.15), (4.27), (5.24), (6.10)). The time-like columns stand
last. An *offset* names a monomial: ``1``, an axis, or two axes of one letter (``xx``, ``xt``).

Squares are made orthogonal to the constant: ``Δx² - m`` with m the second moment of the window, so that the noise of
different columns stays uncorrelated. The parameter of the constant is then a mean over the window; ``at_centre``
leads from there to the value at the centre.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product

from leafflow_ti.errors import ConfigError

AXES = ("x", "y", "sx", "sy", "t")
TIME_LIKE = ("sx", "sy", "t")
ONE = (0, 0, 0, 0, 0)


def monomial(offset: str) -> tuple[int, ...]:
    """Exponents of the monomial that ``offset`` names."""
    factors = (offset,) if offset in AXES else tuple(offset.replace("1", ""))
    return tuple(factors.count(a) for a in AXES)


@dataclass(frozen=True)
class Model:
    """One row of the table of models.

    ``offsets``: the axes along which the flow varies inside a window, ``"s"`` standing for every camera axis.
    ``cameras``: ``"reference"`` (one camera), ``"line"`` (the row or column through the reference camera) or
    ``"grid"``. ``curvature``: further flow columns, (channel, offset). ``motions``: what the 3D fit may solve for, the
    default first. ``own_flows``: every camera's own flow (6.15) enters the fit; ``reference_rows``: so do the rows of
    the reference camera. ``ranges``: measures on maps of the range too; its columns are those of ``range_flow``.
    """

    offsets: tuple[str, ...]
    cameras: str
    time: bool
    summary: str
    curvature: tuple[tuple[str, str], ...] = ()
    motions: tuple[str, ...] = ()
    own_flows: bool = False
    reference_rows: bool = True
    ranges: bool = False


ANY_MOTION = ("rotation", "translation", "acceleration")
OWN_FLOW = Model(("x", "y", "t"), "reference", True, "flow of one camera of the affine scene flow model, 13 columns")
MODELS: dict[str, Model] = {
    "flow": Model((), "reference", True, "optical flow, constant in the window (2.3)"),
    "flow-affine": Model(("x", "y"), "reference", True, "optical flow, affine in the window (2.6)"),
    "flow-quadratic": Model(
        ("x", "y"), "reference", True, "optical flow, quadratic in the window (2.7)",
        (("x", "xx"), ("x", "xy"), ("y", "xy"), ("y", "yy")),
    ),
    "depth": Model(("x", "y", "s"), "grid", False, "depth and normals of a static scene"),
    "affine-translation": Model(
        (), "grid", True, "disparity and flow, constant in the window", motions=("translation",)
    ),
    "affine": Model(("x", "y"), "grid", True, "depth, normals and motion (3.38), (3.39)", motions=ANY_MOTION),
    "affine-4d": Model(("x", "y", "s", "t"), "line", True, "4D affine model (5.24)", motions=ANY_MOTION),
    "affine-5d": Model(("x", "y", "s", "t"), "grid", True, "5D affine model (6.10)", motions=ANY_MOTION),
    "scene-flow": Model(
        ("x", "y", "s", "t"), "grid", True, "velocity from the flow of every camera (3.4)",
        motions=("translation",), own_flows=True, reference_rows=False,
    ),
    "affine-scene-flow": Model(
        ("x", "y", "s", "t"), "grid", True, "4D or 5D affine model and the affine flow of every camera (6.15)",
        motions=ANY_MOTION, own_flows=True,
    ),
    "range-flow": Model(
        (), "grid", True, "velocity from range and intensity (3.9)-(3.18), (4.20)-(4.25)",
        motions=("translation",), ranges=True,
    ),
}  # fmt: skip
"""``flow-quadratic``: the flow of a plane has ``(q1 x² + q2 xy, q1 xy + q2 y²)`` (2.8); here the four coefficients are
independent."""

BRIGHTNESS: dict[str, tuple[str, ...]] = {
    "none": (),
    "temporal": ("1", "t"),
    "spatial": ("1", "x", "y", "t"),
    "camera": ("1", "x", "y", "s", "t"),
}
"""Offsets of the intensity columns: constancy, Haussecker-Fleet (4.15), spatially varying (4.27), full (6.1)."""

BRIGHTNESS_TERMS: dict[str, tuple[str, ...]] = {
    "none": (),
    "time": ("tt", "xt", "yt"),
    "space": ("xx", "xy", "yy"),
    "both": ("tt", "xt", "yt", "xx", "xy", "yy"),
}
"""Offsets of the optional intensity columns of second order. ``xt`` and ``yt`` need a model with ``x`` and ``y``."""

ROW_AXES: dict[str, tuple[str, ...]] = {"u": (), "2d": ("x", "y"), "as": ("sx", "sy"), "at": ("t",)}
"""Which offsets of the motion each group of rows uses, besides the motion itself (section 5.2)."""


@dataclass(frozen=True)
class Term:
    """``factor`` times channel times monomial, in the data vector number ``vector`` of those that share columns."""

    channel: str
    exponents: tuple[int, ...] = ONE
    factor: float = 1.0
    vector: int = 0


@dataclass(frozen=True)
class Column:
    """One entry of the data vector: a sum of terms, of which the first gives it its name."""

    terms: tuple[Term, ...]

    @classmethod
    def of(cls, channel: str, offset: str = "1", moments: Mapping[str, float] | None = None) -> Column:
        """``channel`` times the monomial of ``offset``; a square is centred by ``moments`` (axis -> Σ w Δ²)."""
        own = Term(channel, monomial(offset))
        if max(own.exponents) < 2:
            return cls((own,))
        assert moments is not None
        return cls((own, Term(channel, ONE, -moments[offset[0]])))

    @property
    def channel(self) -> str:
        """Channel of the first term."""
        return self.terms[0].channel

    @property
    def offset(self) -> str:
        """Offset of the first term."""
        axes = [a for a, e in zip(AXES, self.terms[0].exponents, strict=True) for _ in range(e)]
        return "".join(axes) or "1"


@dataclass(frozen=True)
class Derived:
    """A channel that is made of a stack of images: the derivative along ``axis`` of one of them, times a plane.

    ``axis`` ``i`` is the smoothed image, ``1`` a constant; ``image`` and ``factor`` count in the stacks of images and
    of factor planes (None: no factor). ``gain``: noise variance per variance of the image noise.
    """

    image: int
    axis: str
    factor: int | None
    gain: float


@dataclass(frozen=True)
class ColumnSet:
    """The data vector of one model on one sampling: ``columns`` with the ``n_time_like`` time-like ones last.

    ``derived``: how each channel is made where the images of a frame are a stack of several kinds, the intensity first.
    """

    columns: tuple[Column, ...]
    n_time_like: int
    derived: Mapping[str, Derived] = field(default_factory=dict, hash=False)

    @property
    def n(self) -> int:
        """Length N of the data vector."""
        return len(self.columns)

    @property
    def n_flow(self) -> int:
        """Number of columns that are not time-like."""
        return len(self.columns) - self.n_time_like

    @property
    def solutions(self) -> tuple[str, ...]:
        """The axis of each solution (null vector), in the order of the time-like columns."""
        return tuple(c.channel for c in self.columns[self.n_flow :])

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """The distinct channels, in order of first use."""
        return tuple(dict.fromkeys(t.channel for c in self.columns for t in c.terms))

    @cached_property
    def _names(self) -> dict[tuple[str, tuple[int, ...]], int]:
        return {(c.terms[0].channel, c.terms[0].exponents): i for i, c in enumerate(self.columns)}

    def index(self, channel: str, offset: str = "1") -> int | None:
        """Position of the column ``channel`` times ``offset``; None if the model has no such column."""
        return self._names.get((channel, monomial(offset)))

    @cached_property
    def at_centre(self) -> tuple[tuple[int, int, float], ...]:
        """What centred squares add to the parameter of a constant: (its column, the square's column, factor)."""
        return tuple(
            (self._names[term.channel, ONE], i, term.factor)
            for i, column in enumerate(self.columns)
            if max(column.terms[0].exponents) > 1
            for term in column.terms[1:]
        )


@dataclass(frozen=True)
class Moment:
    """The window moment ``Σ w Δ^exponents a b`` of the product of two channels."""

    channels: tuple[str, str]
    exponents: tuple[int, ...]


Entry = tuple[tuple[Moment, float], ...]
"""One distinct entry of the structure tensor: moments and their factors."""


@dataclass(frozen=True)
class TensorLayout:
    """Packed structure tensor: the distinct entries, and where each pair (i >= j) of columns finds its own.

    Because offsets are relative to the window centre, J[i, j] depends on the pairs of channels and on the sums of
    the exponents only (model contract, section 4). It is summed over the data vectors that share the columns.
    """

    entries: tuple[Entry, ...]
    lower: tuple[int, ...]

    @classmethod
    def of(cls, columns: ColumnSet) -> TensorLayout:
        """Layout for a set of columns; ``lower`` runs over the rows of the lower triangle."""
        order = {c: k for k, c in enumerate(columns.channels)}
        entries: dict[Entry, int] = {}
        lower = []
        for i, a in enumerate(columns.columns):
            for b in columns.columns[: i + 1]:
                found: dict[Moment, float] = {}
                for p, q in product(a.terms, b.terms):
                    if p.vector == q.vector:
                        first, second = sorted((p.channel, q.channel), key=order.__getitem__)
                        total = tuple(m + n for m, n in zip(p.exponents, q.exponents, strict=True))
                        moment = Moment((first, second), total)
                        found[moment] = found.get(moment, 0.0) + p.factor * q.factor
                lower.append(entries.setdefault(tuple(found.items()), len(entries)))
        return cls(tuple(entries), tuple(lower))

    @cached_property
    def moments(self) -> tuple[Moment, ...]:
        """The distinct moments, in order of first use."""
        return tuple(dict.fromkeys(moment for entry in self.entries for moment, _ in entry))


def column_set(
    model: Model,
    brightness: str,
    camera_axes: tuple[str, ...],
    sampled: Mapping[str, float],
    brightness_terms: str = "none",
) -> ColumnSet:
    """Columns of ``model`` on a given sampling.

    ``camera_axes``: the camera axes with a derivative (subset of ``("sx", "sy")``). ``sampled``: the axes along which
    the window holds more than one sample, with its second moment; an offset along any other axis is identically zero
    and its column is dropped. ``brightness``, ``brightness_terms``: keys of ``BRIGHTNESS``, ``BRIGHTNESS_TERMS``.
    Raises ConfigError where they do not fit the model.
    """
    time_like = camera_axes + (("t",) if model.time else ())

    def expand(offsets: tuple[str, ...]) -> list[str]:
        axes = [b for a in offsets for b in (camera_axes if a == "s" else (a,))]
        return [a for a in axes if all(e == 0 or b in sampled for b, e in zip(AXES, monomial(a), strict=True))]

    if not model.time and (brightness == "temporal" or brightness_terms in ("time", "both")):
        choice = "brightness 'temporal'" if brightness == "temporal" else f"brightness_terms '{brightness_terms}'"
        instead = "none, spatial or camera" if brightness == "temporal" else "none or space"
        raise ConfigError(f"{choice} needs a sequence in time; choose {instead} for a static capture")
    first = BRIGHTNESS[brightness]
    if not first and brightness_terms != "none":
        raise ConfigError(
            f"brightness_terms '{brightness_terms}' adds to a brightness model, and brightness is 'none': choose "
            "temporal, spatial or camera"
        )
    second = [o for o in BRIGHTNESS_TERMS[brightness_terms] if o not in ("xt", "yt") or o[0] in first]
    columns = [Column.of(c, o) for c in ("x", "y") for o in ["1", *expand(model.offsets)]]
    columns += [Column.of(c, o, sampled) for c, o in model.curvature if expand((o,))]
    columns += [Column.of("i", o, sampled) for o in expand((*first, *second))]
    columns += [Column.of(c) for c in time_like]
    return ColumnSet(tuple(columns), len(time_like))


def flow_offsets(columns: ColumnSet) -> tuple[str, ...]:
    """What a model without a 3D fit measures of the flow: itself (offset "1"), and its derivatives along x and y."""
    return ("1", *(o for o in ("x", "y") if "t" in columns.solutions and columns.index("x", o) is not None))


def parse_rows(rows: str, model: str, motion: str, columns: ColumnSet) -> tuple[tuple[str, ...], bool]:
    """Which motion offsets enter the 3D fit, and whether the range constraint (b5) does.

    Returns the offsets (``"1"`` first) and the flag. ``auto`` takes everything that the motion model explains: ``a_t``
    only where the acceleration is estimated (section 5.3), the range constraint wherever the model measures it.
    """
    have = {a for a in AXES if columns.index("x", a) is not None}
    has_range = "t" in have and any(s in columns.solutions for s in ("sx", "sy"))
    if rows == "auto":
        groups = [g for g, axes in ROW_AXES.items() if have & set(axes)]
        if motion != "acceleration" and "at" in groups:
            groups.remove("at")
        use_range = has_range
    else:
        groups = rows.split("+")
        for g in groups:
            measured = has_range if g == "b5" else not ROW_AXES[g] or bool(have & set(ROW_AXES[g]))
            if not measured:
                raise ConfigError(
                    f"rows '{rows}': model '{model}' does not measure group '{g}' on this capture; leave it out"
                )
        use_range = "b5" in groups
    offsets = ("1", *(a for g in ROW_AXES if g in groups for a in ROW_AXES[g] if a in have))
    return offsets, use_range
