"""The report: one HTML page that shows what a run measured, how well, and the surface in 3D.

The page holds all it needs, asks for nothing over the network (its content policy forbids it), and stays below
``LIMIT`` bytes.
"""

from __future__ import annotations

import base64
import hashlib
import json
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from leafflow_ti import __version__
from leafflow_ti.errors import InputError, RunError, UsageError
from leafflow_ti.number_text import duration
from leafflow_ti.panels import panels_of
from leafflow_ti.report.facts import Facts, precision_of, spread_evenly
from leafflow_ti.report.maps import Shown, maps_section
from leafflow_ti.report.regions_table import RegionCurves, read_region_curves
from leafflow_ti.report.sections import (
    frame_numbers,
    growth_section,
    header,
    quality_section,
    run_section,
    surface_section,
    tiles,
)
from leafflow_ti.report.surface import has_surface, packed_surfaces
from leafflow_ti.results import ResultStore
from leafflow_ti.whole import appearing

LIMIT = 4_800_000
"""Largest page, in bytes."""
FRAMES = 12
"""Most frames whose maps a page holds; its curves show all."""
PIXELS = 160_000
"""Most pixels of an image: more cannot be seen."""

_GENERATOR = "leafflow-ti"
_TYPICAL_BYTES = 0.45
"""Bytes of a page per pixel of an image, at least."""


def write_report(
    store: ResultStore | str | Path,
    path: str | Path,
    *,
    regions: str | Path | None = None,
    title: str | None = None,
    frames: int = FRAMES,
) -> Path:
    """Write the report of a results store, finished or not, to ``path``.

    ``regions``: table of ``leafflow-ti regions`` (CSV) whose growth is shown, too; ``title``: else the store's name;
    ``frames``: most frames whose maps are shown, at even distances. An earlier report at ``path`` is replaced.

    Raises UsageError where ``path`` is something else that exists, InputError where nothing is measured yet or the
    table cannot be read, MissingExtra where matplotlib is not installed, RunError when the page cannot be written.
    """
    store = store if isinstance(store, ResultStore) else ResultStore.open(store)
    path = Path(path)
    if frames < 1:
        raise UsageError(f"{frames} frames: a report shows at least 1")
    _check_replaceable(path)
    curves = None if regions is None else read_region_curves(Path(regions))
    page = report_page(store, curves, title or store.path.name.removesuffix(".zarr"), frames)
    with appearing(path) as scratch:
        scratch.write_text(page, encoding="utf-8")
    return path


def report_page(store: ResultStore, regions: RegionCurves | None, title: str, frames: int = FRAMES) -> str:
    """The page of a store, of less than ``LIMIT`` bytes: maps are shown with as many pixels as fit.

    Raises InputError where nothing is measured yet, MissingExtra where matplotlib is not installed.
    """
    facts = Facts.of(store)
    if not facts.begun:
        raise InputError(f"{store.path}: nothing is measured yet; the report can be written after the first unit")
    indices = spread_evenly(facts.begun, frames)
    thin = _finest(store, len(indices))
    while True:
        page = _page(store, facts, regions, title, Shown.of(store, indices, thin))
        size = len(page.encode())
        if size <= LIMIT:
            return page
        if thin >= max(store.x.size, store.y.size):
            raise RunError(f"{store.path}: the report exceeds {LIMIT} bytes even without maps: show fewer --frames")
        thin = max(thin + 1, round(thin * (size / LIMIT) ** 0.5))


def _finest(store: ResultStore, n_frames: int) -> int:
    """The least thinning that could keep the page below its limit."""
    panels = sum(len(panels) for page, panels in panels_of(store.names).items() if page != "overview")
    pixels = min(PIXELS, LIMIT / _TYPICAL_BYTES / (panels * n_frames))
    return max(1, int((store.x.size * store.y.size / pixels) ** 0.5))


def _page(store: ResultStore, facts: Facts, regions: RegionCurves | None, title: str, shown: Shown) -> str:
    precision = precision_of(store, shown.indices)
    with_surface = has_surface(shown.fields[0])
    region_series, region_unit = (regions.series, regions.unit) if regions else ((), "")
    body = [
        header(title, store, facts),
        tiles(store, facts, precision),
        surface_section(shown) if with_surface else "",
        growth_section(facts, region_series, region_unit, shown),
        maps_section(shown),
        quality_section(store, facts, precision, shown),
        run_section(store),
        _footer(store, shown),
    ]
    data = {
        "start": shown.start,
        "labels": _labels(store, shown),
        "surface": packed_surfaces(shown.fields) if with_surface else None,
        **shown.data(),
    }
    script = "\n".join(_asset(name) for name in ("matrix.js", "view.js", "page.js"))
    return Template(_asset("page.html")).substitute(
        policy=_policy(script),
        generator=f"{_GENERATOR} {__version__}",
        title=escape(f"{title} · leafflow-ti"),
        style=_asset("style.css"),
        body="\n".join(part for part in body if part),
        slider=_slider(shown),
        data=_json(data),
        script=script,
    )


def _slider(shown: Shown) -> str:
    if len(shown.fields) < 2:
        return ""
    return (
        '<div class="frames" id="frames"><div><button type="button" id="play">Play</button>'
        f'<input type="range" id="frame" min="0" max="{len(shown.fields) - 1}" value="{shown.start}" '
        'aria-label="frame shown"><output id="frame-label" for="frame"></output></div></div>'
    )


def _labels(store: ResultStore, shown: Shown) -> list[str]:
    """What the slider calls each frame, with the time since the first of the store where that is known."""
    times = store.times_s
    return [
        f"frame {store.frames[t]}" + ("" if times is None else f" · {duration(float(times[t] - times[0]))}")
        for t in shown.indices
    ]


def _footer(store: ResultStore, shown: Shown) -> str:
    n = len(store.frames)
    numbers = frame_numbers([field.frame for field in shown.fields])
    of = f" Maps and surface show {numbers}, the curves all {n}." if len(shown.fields) < n else ""
    return (
        f"<footer>Written by leafflow-ti {escape(__version__)} from <code>{escape(store.path.name)}</code>.{of} "
        "x right, y down, Z away from the camera; errors are standard errors.</footer>"
    )


def _policy(script: str) -> str:
    """Nothing but what the page holds: images within it, its own script, recognised by its checksum."""
    checksum = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    own = f"img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{checksum}'"
    return f"default-src 'none'; {own}; base-uri 'none'; form-action 'none'"


def _json(value: Any) -> str:
    """JSON that may stand within a script element: nothing in it can end that, or begin a comment."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c").replace(">", "\\u003e")


def _asset(name: str) -> str:
    return files(__package__).joinpath(name).read_text(encoding="utf-8").strip()


def _check_replaceable(path: Path) -> None:
    """An earlier report may be replaced, nothing else."""
    if not path.exists():
        return
    marker = f'<meta name="generator" content="{_GENERATOR} '.encode()
    if not path.is_file() or marker not in _head(path):
        raise UsageError(f"{path} exists and is no report, so it is left alone: give another name")


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(2000)
    except OSError as error:
        raise UsageError(f"{path} exists and cannot be read ({error.strerror}): give another name") from error
