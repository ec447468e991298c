"""What a notebook shows of results: a table of their maps, what became of the pixels, small pictures.

Plain HTML with its styles inline, in the notebook's own colours; pictures only where matplotlib is installed.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.colours import STATUS_COLOURS, Scale, data_uri
from leafflow_ti.number_text import readable, to_digits_of
from leafflow_ti.status import ADVICE, Status

THUMBNAILS = (
    "growth_rate", "area_rate", "depth", "disparity", "velocity_x", "velocity_y", "velocity_z", "flow_x", "flow_y",
)  # fmt: skip
"""Maps whose pictures are shown, the first ``MOST`` that the results have."""
MOST = 4
_WIDTH = 150
_LINE = "border-bottom:1px solid color-mix(in srgb, currentColor 18%, transparent);padding:2px 12px 2px 0;"


@dataclass(frozen=True)
class Medians:
    """Median of a map's values, of their standard errors (None: not known), and share of pixels with a value."""

    value: float
    error: float | None
    valid: float

    @classmethod
    def of(cls, values: NDArray[np.floating], std: NDArray[np.floating] | None) -> Medians:
        """NaN where no pixel has a value."""
        known = np.isfinite(values)
        errors = np.empty(0) if std is None else std[known & np.isfinite(std)]
        return cls(
            float(np.median(values[known])) if known.any() else float("nan"),
            float(np.median(errors)) if errors.size else None,
            float(known.mean()) if known.size else 0.0,
        )


def results_html(
    title: str,
    maps: Mapping[str, NDArray[np.floating]],
    status: NDArray[np.uint8],
    unit_of: Callable[[str], str],
) -> str:
    """The maps [y, x] of one frame with their companions ``NAME_std``, and their status [y, x]."""
    shown = [n for n in maps if not n.endswith("_std") and maps[n].dtype.kind == "f" and np.isfinite(maps[n]).any()]
    rows = []
    for name in shown:
        medians = Medians.of(maps[name], maps.get(f"{name}_std"))
        unit = unit_of(name)
        rows.append(
            (
                name,
                "" if unit == "1" else unit,
                to_digits_of(medians.value, medians.error),
                "–" if medians.error is None else readable(medians.error, 2),
                f"{medians.valid:.0%}",
            )
        )
    table = table_html(("map", "unit", "median", "standard error", "valid"), rows)
    return f"<div><p><b>{escape(title)}</b></p>{status_html(status)}{_pictures(maps, shown, unit_of)}{table}</div>"


def table_html(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of texts, escaped; all columns but the first two hold numbers."""

    def row(kind: str, cells: Sequence[str]) -> str:
        aligned = ("left" if i < 2 else "right" for i in range(len(cells)))
        return "".join(
            f'<{kind} style="text-align:{side};{_LINE}">{escape(text)}</{kind}>'
            for side, text in zip(aligned, cells, strict=True)
        )

    header = f"<thead><tr>{row('th', head)}</tr></thead>" if head else ""
    body = "".join(f"<tr>{row('td', cells)}</tr>" for cells in rows)
    return f'<table style="border-collapse:collapse">{header}<tbody>{body}</tbody></table>'


def status_html(status: NDArray[np.uint8]) -> str:
    """A bar of the shares of the statuses, and these in words; advice on hovering."""
    codes, counts = np.unique(status, return_counts=True)
    shares = {Status(int(code)): n / status.size for code, n in zip(codes, counts, strict=True)}
    ordered = sorted(shares.items(), key=lambda item: -item[1])
    bar = "".join(
        f'<span style="width:{share:.3%};background:{STATUS_COLOURS[code]}"></span>' for code, share in ordered
    )
    words = " · ".join(
        f'<span title="{escape(ADVICE[code])}">{code.name.lower().replace("_", " ")} {share:.1%}</span>'
        for code, share in ordered
    )
    return f'<div style="display:flex;height:10px;max-width:640px;margin:4px 0">{bar}</div><p>{words}</p>'


def _pictures(maps: Mapping[str, NDArray[np.floating]], shown: Sequence[str], unit_of: Callable[[str], str]) -> str:
    if importlib.util.find_spec("matplotlib") is None:
        return ""
    pictures = []
    for name in [n for n in THUMBNAILS if n in shown][:MOST]:
        step = max(1, max(maps[name].shape) // (2 * _WIDTH))
        values = np.asarray(maps[name][::step, ::step])
        scale = Scale.of(values)
        span = f"{readable(scale.low)} to {readable(scale.high)} {unit_of(name)}"
        pictures.append(
            f'<div style="width:{_WIDTH}px"><img src="{data_uri(scale.image(values))}" alt="{escape(name)}" '
            f'style="width:100%;image-rendering:pixelated"><br><small>{escape(name)}<br>{escape(span)}</small></div>'
        )
    return f'<div style="display:flex;flex-wrap:wrap;gap:12px;margin:4px 0">{"".join(pictures)}</div>'
