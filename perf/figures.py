"""What a case reports: figures beside the printed values or goals, and how they are shown.

A figure is met when it is at most its reference and at least its ``low``, as far as it has them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

Kind = Literal["printed", "goal"]


@dataclass(frozen=True)
class Figure:
    """One measured number.

    ``reference``: the upper limit, a value ``printed`` in the dissertation or a ``goal`` of this project; None where
    there is none. ``low``: the lower limit likewise. ``note``: what else belongs to the number.
    """

    name: str
    value: float
    unit: str = ""
    reference: float | None = None
    kind: Kind = "goal"
    low: float | None = None
    note: str = ""

    @property
    def met(self) -> bool | None:
        """Whether both limits are kept; None without any. A value that is not finite keeps none."""
        if self.reference is None and self.low is None:
            return None
        below = self.reference is None or self.value <= self.reference
        return math.isfinite(self.value) and below and (self.low is None or self.value >= self.low)

    def to_json(self) -> dict[str, Any]:
        """The figure as plain values; a value that is not finite becomes None, which JSON can hold."""
        return {**asdict(self), "value": self.value if math.isfinite(self.value) else None, "met": self.met}


@dataclass(frozen=True)
class Outcome:
    """What a case found; ``skipped`` says why nothing was measured."""

    figures: tuple[Figure, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    pictures: tuple[Path, ...] = ()
    skipped: str | None = None


def to_json(name: str, outcome: Outcome, seconds: float) -> str:
    """The outcome as one JSON object."""
    return json.dumps(
        {
            "case": name,
            "seconds": round(seconds, 3),
            "skipped": outcome.skipped,
            "settings": dict(outcome.settings),
            "figures": [figure.to_json() for figure in outcome.figures],
            "notes": list(outcome.notes),
            "pictures": [str(path) for path in outcome.pictures],
        },
        ensure_ascii=False,
        indent=1,
    )


def to_text(name: str, outcome: Outcome, seconds: float) -> str:
    """The outcome as a table, one figure a line."""
    if outcome.skipped is not None:
        return f"{name}: skipped: {outcome.skipped}"
    lines = [name, *(f"  {key} = {value}" for key, value in outcome.settings.items()), ""]
    rows = [("", "measured", "reference", "", ""), *(_row(figure) for figure in outcome.figures)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        cells = (
            row[0].ljust(widths[0]),
            row[1].rjust(widths[1]),
            row[2].rjust(widths[2]),
            row[3].ljust(widths[3]),
            row[4],
        )
        lines.append("  ".join(cells).rstrip())
    with_reference = [figure for figure in outcome.figures if figure.met is not None]
    if with_reference:
        met = sum(figure.met is True for figure in with_reference)
        lines += ["", f"{met} of {len(with_reference)} met or beaten"]
    lines += [*outcome.notes, *(f"picture: {path}" for path in outcome.pictures), f"took {seconds:.1f} s"]
    return "\n".join(lines)


def _row(figure: Figure) -> tuple[str, str, str, str, str]:
    reference = ""
    if figure.reference is not None:
        reference = f"{figure.kind} {figure.reference:g}"
        if figure.low is not None:
            reference = f"{figure.kind} {figure.low:g} to {figure.reference:g}"
    elif figure.low is not None:
        reference = f"{figure.kind} >= {figure.low:g}"
    verdict = {None: "", True: "met", False: "NOT MET"}[figure.met]
    return figure.name, f"{figure.value:.4g} {figure.unit}".rstrip(), reference, verdict, figure.note
