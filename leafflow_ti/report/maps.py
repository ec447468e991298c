"""The maps of a report: every panel as a figure, its frames as small images, all frames of a panel on one scale.

Panels, titles, colours and arrows are those of the quick looks (``panels``, ``colours``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from typing import Any

import numpy as np

from leafflow_ti.colours import STATUS_COLOURS, Scale, data_uri, normal_disc, rgba_png
from leafflow_ti.field import Field
from leafflow_ti.number_text import readable
from leafflow_ti.panels import PAGES, Panel, arrows_of, extent, panels_of
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

_STOPS = 17
"""Colours of a bar, between which the browser interpolates."""


@dataclass(frozen=True, eq=False)
class Shown:
    """The frames of a report (``indices`` along t), every ``thin``-th output pixel along x and y of them."""

    store: ResultStore
    indices: tuple[int, ...]
    thin: int
    fields: tuple[Field, ...]

    @classmethod
    def of(cls, store: ResultStore, indices: Sequence[int], thin: int) -> Shown:
        """Read the maps that are drawn, one at a time."""
        pages = panels_of(store.names, store.interval_s)
        needed = {name for panels in pages.values() for panel in panels for name in panel.needs}
        needed |= {name for name in store.names if name in ("velocity_z",)}
        cut = (slice(thin // 2, None, thin), slice(thin // 2, None, thin))
        y, x, attrs = store.y[cut[0]], store.x[cut[1]], store.attrs

        def read(name: str, t: int) -> Any:
            return np.ascontiguousarray(store.read(name, t)[cut])

        fields = tuple(
            Field({n: read(n, t) for n in store.names if n in needed}, read("status", t), y, x, store.frames[t], attrs)
            for t in indices
        )
        return cls(store, tuple(indices), thin, fields)

    @property
    def start(self) -> int:
        """The frame that the page shows first, as it counts them: the middle one."""
        return len(self.fields) // 2

    @cached_property
    def pages(self) -> dict[str, list[Panel]]:
        """Page -> panels that have a value in some frame."""
        pages = panels_of(self.store.names, self.store.interval_s)
        kept = {page: [p for p in panels if self._any(p)] for page, panels in pages.items() if page != "overview"}
        return {page: panels for page, panels in kept.items() if panels}

    def _any(self, panel: Panel) -> bool:
        return all(any(np.isfinite(field[name]).any() for field in self.fields) for name in panel.needs)

    @cached_property
    def scales(self) -> dict[str, Scale | None]:
        """Panel's key -> its scale of colours, None where it has none."""
        panels = [panel for panels in self.pages.values() for panel in panels]
        return {p.key: p.scale(self.fields) if p.kind in ("map", "arrows") else None for p in panels}

    @cached_property
    def images(self) -> dict[str, list[str]]:
        """Panel's key -> its image of every frame, as addresses."""
        panels = [panel for panels in self.pages.values() for panel in panels]
        return {p.key: [data_uri(p.image(field, self.scales[p.key])) for field in self.fields] for p in panels}

    @cached_property
    def arrows(self) -> dict[str, list[str]]:
        """Key of a panel with arrows -> these, of every frame, as path of an SVG drawing."""
        found = {}
        for panel in (p for panels in self.pages.values() for p in panels if p.kind == "arrows"):
            scale = self.scales[panel.key]
            assert scale is not None
            found[panel.key] = [_arrow_path(field, panel.key, scale.high) for field in self.fields]
        return found

    def data(self) -> dict[str, Any]:
        """What the slider changes, as JSON values; the images of the first frame shown are in the page already."""
        blank = {
            key: [None if i == self.start else uri for i, uri in enumerate(uris)] for key, uris in self.images.items()
        }
        return {"images": blank, "arrows": self.arrows}


def maps_section(shown: Shown) -> str:
    """All pages of panels."""
    parts = []
    for page, panels in shown.pages.items():
        figures = "".join(_figure(shown, panel) for panel in panels)
        parts.append(f'<h3>{escape(PAGES[page][0])}</h3>\n<div class="maps">{figures}</div>')
    note = (
        "All frames of a map share one scale, from the 2nd to the 98th percentile of its values; what lies beyond has "
        "the colour of the end. Hatched: no value, the status says why."
    )
    thinned = "" if shown.thin == 1 else f" Shown is one of {shown.thin} × {shown.thin} output pixels."
    return f'<h2>Maps</h2>\n<p class="note">{note}{thinned}</p>\n' + "\n".join(parts)


def legend(panel: Panel, scale: Scale | None) -> str:
    """What the colours of a panel mean."""
    if scale is not None:
        return colour_bar(scale, panel.unit)
    if panel.kind == "normals":
        disc = data_uri(rgba_png(normal_disc(64)))
        return (
            f'<div class="disc"><img src="{disc}" width="44" height="44" alt="disc of colours">'
            "<span>All directions: the disc's middle faces the camera, its rim is seen edge-on.</span></div>"
        )
    return ""


def colour_bar(scale: Scale, unit: str) -> str:
    """A bar with the numbers of its ends and middle."""
    stops = ", ".join(f"rgb({r} {g} {b})" for r, g, b in scale.palette(_STOPS).tolist())
    middle = (scale.low + scale.high) / 2
    low, mid, high = (readable(v) for v in (scale.low, 0.0 if abs(middle) < 1e-9 * scale.high else middle, scale.high))
    unit = "" if unit == "1" else f" {escape(unit)}"
    return (
        f'<div class="bar" style="background:linear-gradient(90deg, {stops})"></div>'
        f'<div class="ticks"><span>{low}</span><span>{mid}</span><span>{high}{unit}</span></div>'
    )


def status_swatches(codes: Sequence[Status]) -> str:
    """Colours of statuses and their names."""
    items = "".join(f"<span>{swatch(code)}{status_name(code)}</span>" for code in codes)
    return f'<div class="swatches">{items}</div>'


def swatch(code: Status) -> str:
    """A spot of a status's colour."""
    return f'<i class="swatch" style="background:{STATUS_COLOURS[code]}"></i>'


def status_name(code: Status) -> str:
    """``no structure``."""
    return code.name.lower().replace("_", " ")


def _figure(shown: Shown, panel: Panel) -> str:
    scale, field = shown.scales[panel.key], shown.fields[shown.start]
    rows, columns = field.shape
    overlay = ""
    if panel.kind == "arrows":
        (left, right), (top, bottom) = extent(field.x), extent(field.y)
        path = shown.arrows[panel.key][shown.start]
        overlay = (
            f'<svg viewBox="{left:g} {top:g} {right - left:g} {bottom - top:g}" aria-hidden="true">'
            f'<path class="under" d="{path}"/><path class="over" d="{path}"/></svg>'
        )
    if panel.kind == "status":
        codes = sorted({Status(int(c)) for f in shown.fields for c in np.unique(f.status)})
        key = status_swatches(codes)
    else:
        key = legend(panel, scale)
    span = f", {readable(scale.low)} to {readable(scale.high)} {panel.unit}" if scale is not None else ""
    alt = escape(
        f"Map: {panel.long_name}{span}; x {field.x[0]} to {field.x[-1]} px, y {field.y[0]} to {field.y[-1]} px"
    )
    return (
        f'<figure data-panel="{escape(panel.key)}"><figcaption><b>{escape(panel.title)}</b>'
        f"<span>{escape(panel.long_name)}</span></figcaption>"
        f'<div class="plate"><img src="{shown.images[panel.key][shown.start]}" width="{columns}" height="{rows}" '
        f'alt="{alt}">{overlay}</div><div class="key">{key}</div></figure>'
    )


def _arrow_path(field: Field, key: str, longest: float) -> str:
    """Shafts and heads of the arrows, in pixels of the image."""
    arrows = arrows_of(field, key, longest)
    u, v = arrows.u, arrows.v
    parts = []
    # The head's two strokes go back from the tip by a third of the arrow, spread by half of that.
    for x, y, a, b in zip(arrows.x - u / 2, arrows.y - v / 2, u, v, strict=True):
        left, right = (-a / 3 - b / 6, -b / 3 + a / 6), (-a / 3 + b / 6, -b / 3 - a / 6)
        tip = (x + a, y + b)
        parts.append(
            f"M{x:.1f} {y:.1f}l{a:.1f} {b:.1f}l{left[0]:.1f} {left[1]:.1f}"
            f"M{tip[0]:.1f} {tip[1]:.1f}l{right[0]:.1f} {right[1]:.1f}"
        )
    return "".join(parts)
