"""The models as a table: which data columns they have, and which image parameters they yield.

Conventions. Axes are named ``x, y`` (pixel, right and down), ``sx, sy`` (camera index from the reference) and ``t``
(frame index from the reference); a monomial is the tuple of its exponents over these five axes. A *channel* is a
filtered image: its derivative along one axis (``x``, ``y``, ``sx``, ``sy``, ``t``), or the smoothed image itself
(``i``). A *column* of the data vector ``d`` is a channel times a monomial of the offset from the window centre
(Schuchert 2010, Eqs. (2.3)-(2.6), (3.38), (3.39), (4.15), (4.27), (5.24), (6.10)). The time-like columns stand
last.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from leafflow_ti.errors import ConfigError

AXES = ("x", "y", "sx", "sy", "t")
TIME_LIKE = ("sx", "sy", "t")
ONE = (0, 0, 0, 0, 0)


def monomial(axis: str) -> tuple[int, ...]:
    """Exponents of the linear monomial along ``axis``; of the constant for ``"1"``."""
    return ONE if axis == "1" else tuple(int(a == axis) for a in AXES)


@dataclass(frozen=True)
class Model:
    """One row of the table of models.

    ``offsets``: the axes along which the flow varies inside a window, ``"s"`` standing for every camera axis.
    ``cameras``: ``"reference"`` (one camera), ``"line"`` (the row or column through the reference camera) or
    ``"grid"``. ``motions``: what the 3D fit may solve for, the default first. ``own_flows``: every camera's own flow
    (6.15) enters the fit; ``reference_rows``: so do the rows of the reference camera.
    """

    offsets: tuple[str, ...]
    cameras: str
    time: bool
    summary: str
    motions: tuple[str, ...] = ()
    own_flows: bool = False
    reference_rows: bool = True


ANY_MOTION = ("rotation", "translation", "acceleration")
OWN_FLOW = Model(("x", "y", "t"), "reference", True, "flow of one camera of the affine scene flow model, 13 columns")
MODELS: dict[str, Model] = {
    "flow": Model((), "reference", True, "optical flow, constant in the window (2.3)"),
    "flow-affine": Model(("x", "y"), "reference", True, "optical flow, affine in the window (2.6)"),
    "depth": Model(("x", "y", "s"), "grid", False, "depth and normals of a static scene"),
    "affine-translation": Model((), "grid", True, "disparity and flow, constant in the window", ("translation",)),
    "affine": Model(("x", "y"), "grid", True, "depth, normals and motion (3.38), (3.39)", ANY_MOTION),
    "affine-4d": Model(("x", "y", "s", "t"), "line", True, "4D affine model (5.24)", ANY_MOTION),
    "affine-5d": Model(("x", "y", "s", "t"), "grid", True, "5D affine model (6.10)", ANY_MOTION),
    "scene-flow": Model(
        ("x", "y", "s", "t"), "grid", True, "velocity from the flow of every camera (3.4)", ("translation",), True, False
    ),
    "affine-scene-flow": Model(
        ("x", "y", "s", "t"), "grid", True, "4D or 5D affine model and the affine flow of every camera (6.15)",
        ANY_MOTION, True,
    ),
}

BRIGHTNESS: dict[str, tuple[str, ...]] = {
    "none": (),
    "temporal": ("1", "t"),
    "spatial": ("1", "x", "y", "t"),
    "camera": ("1", "x", "y", "s", "t"),
}
"""Offsets of the intensity columns: constancy, Haussecker-Fleet (4.15), spatially varying (4.27), full (6.1)."""

ROW_AXES: dict[str, tuple[str, ...]] = {"u": (), "2d": ("x", "y"), "as": ("sx", "sy"), "at": ("t",)}
"""Which offsets of the motion each group of rows uses, besides the motion itself (section 5.2)."""


@dataclass(frozen=True)
class Column:
    """One entry of the data vector: channel times monomial."""

    channel: str
    exponents: tuple[int, ...] = ONE

    @property
    def offset(self) -> str:
        """``"1"`` or the axis of the (linear) monomial."""
        return next((a for a, e in zip(AXES, self.exponents, strict=True) if e), "1")


@dataclass(frozen=True)
class ColumnSet:
    """The data vector of one model on one sampling: ``columns`` with the ``n_time_like`` time-like ones last."""

    columns: tuple[Column, ...]
    n_time_like: int

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
        return tuple(dict.fromkeys(c.channel for c in self.columns))

    def index(self, channel: str, offset: str = "1") -> int | None:
        """Position of the column ``channel`` times ``offset``; None if the model has no such column."""
        wanted = Column(channel, monomial(offset))
        return self.columns.index(wanted) if wanted in self.columns else None


@dataclass(frozen=True)
class Entry:
    """One distinct entry of the structure tensor: moment ``exponents`` of the product of two channels."""

    channels: tuple[str, str]
    exponents: tuple[int, ...]


@dataclass(frozen=True)
class TensorLayout:
    """Packed structure tensor: the distinct entries, and where each pair (i >= j) of columns finds its own.

    Because offsets are relative to the window centre, J[i, j] depends on the pair of channels and on the sum of
    the exponents only (model contract, section 4).
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
                first, second = sorted((a.channel, b.channel), key=order.__getitem__)
                total = tuple(p + q for p, q in zip(a.exponents, b.exponents, strict=True))
                lower.append(entries.setdefault(Entry((first, second), total), len(entries)))
        return cls(tuple(entries), tuple(lower))


def column_set(model: Model, brightness: str, camera_axes: tuple[str, ...], sampled: tuple[str, ...]) -> ColumnSet:
    """Columns of ``model`` on a given sampling.

    ``camera_axes``: the camera axes with a derivative (subset of ``("sx", "sy")``). ``sampled``: the axes along which
    the window holds more than one sample; an offset along any other axis is identically zero and its column is dropped.
    """
    time_like = camera_axes + (("t",) if model.time else ())

    def expand(offsets: tuple[str, ...]) -> list[str]:
        axes = [b for a in offsets for b in (camera_axes if a == "s" else (a,))]
        return [a for a in axes if a == "1" or a in sampled]

    if brightness == "temporal" and not model.time:
        raise ConfigError(
            "brightness 'temporal' needs a sequence in time; choose none, spatial or camera for a static capture"
        )
    flow = ["1", *expand(model.offsets)]
    columns = [Column(c, monomial(o)) for c in ("x", "y") for o in flow]
    columns += [Column("i", monomial(o)) for o in expand(BRIGHTNESS[brightness])]
    columns += [Column(c) for c in time_like]
    return ColumnSet(tuple(columns), len(time_like))


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
