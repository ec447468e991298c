"""The sections of a report but for its maps, as HTML. Everything from outside is escaped."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from leafflow_ti.colours import STATUS_COLOURS
from leafflow_ti.number_text import duration, readable, to_digits_of, with_error
from leafflow_ti.panels import quantity_title
from leafflow_ti.report.charts import COLOURS, curves, stage_bars
from leafflow_ti.report.facts import Facts, Precision, Series
from leafflow_ti.report.maps import Shown, status_name, swatch
from leafflow_ti.results import ResultStore
from leafflow_ti.status import ADVICE
from leafflow_ti.trace import STAGES


def header(title: str, store: ResultStore, facts: Facts) -> str:
    """Title, what was measured in one line, and what is missing in a run that goes on."""
    frames, done = len(store.frames), int((facts.done == 1).sum())
    span = f"frames {store.frames[0]} to {store.frames[-1]}" if frames > 1 else f"frame {store.frames[0]}"
    every = "" if store.interval_s is None else f", one every {duration(store.interval_s)}"
    parts = [
        '<p class="eyebrow">leafflow-ti report</p>',
        f"<h1>{escape(title)}</h1>",
        f'<p class="soft">{span}{every} · {store.x.size} × {store.y.size} output pixels</p>',
    ]
    if done < frames:
        begun = len(facts.begun)
        some = f", {begun - done} in part" if begun > done else ""
        parts.append(
            f'<p class="warn"><b>This run is not finished:</b> {done} of {frames} frames are done{some}. The report '
            "shows what is there; <code>leafflow-ti run … --resume</code> goes on with the rest.</p>"
        )
    if store.unfinished:
        parts.append(
            '<p class="warn"><b>Growth from the motion is not finished,</b> and left out: '
            "<code>leafflow-ti growth …</code> measures it again.</p>"
        )
    return "\n".join(parts)


def tiles(store: ResultStore, facts: Facts, precision: Sequence[Precision]) -> str:
    """The few numbers that matter most: name, value, unit, and what they are."""
    found: list[tuple[str, str, str, str]] = []
    overall = facts.growth[0].overall() if facts.growth else None
    if overall is not None:
        name = f"mean {facts.growth[0].name} ± standard error"
        found.append(("Growth of the area", with_error(*overall), facts.growth_unit, name))
    by_name = {p.name: p for p in precision}
    distance = "depth" if "depth" in by_name else "disparity"
    for name, text in ((distance, distance.capitalize()), ("velocity_z", "Velocity away from the camera")):
        if name in by_name:
            unit, medians = by_name[name].unit, by_name[name].medians
            error = "" if medians.error is None else f"; standard error {readable(medians.error, 2)} {unit}"
            found.append((text, to_digits_of(medians.value, medians.error), unit, f"median{error}"))
    measured = facts.measured[np.isfinite(facts.measured)]
    found.append(("Measured", readable(100 * float(measured.mean())), "%", "of the pixels, with error bars"))
    found.append(("Frames", f"{int((facts.done == 1).sum())}", f"of {len(store.frames)}", "done"))
    cells = "".join(
        f'<div class="tile"><span class="name">{escape(name)}</span>'
        f"<b>{escape(value)} <small>{escape(unit)}</small></b><span>{escape(note)}</span></div>"
        for name, value, unit, note in found
    )
    return f'<div class="tiles">{cells}</div>'


def growth_section(facts: Facts, regions: Sequence[Series], region_unit: str, shown: Shown) -> str:
    """Growth over the frames: of all pixels, by each measure, and of regions."""
    if not facts.growth and not regions:
        return ""
    marks = _marks(shown)
    charts = []
    for series in facts.growth:
        what = "of the exact refinement" if series.name == "growth rate" else "from the motion in a window"
        overall = series.overall()
        words = "" if overall is None else f"; mean {with_error(*overall)} {facts.growth_unit}"
        chart = curves([series], "frame", facts.growth_unit, f"{series.name} over the frames{words}", marks)
        note = (
            f"{what}: mean over the surface, uncertain pixels counting less; band: its standard error; grey: the "
            "middle 68 % of the pixels"
        )
        charts.append(
            f"<figure><figcaption><b>{escape(series.name)}</b><span>{note}</span></figcaption>{chart}</figure>"
        )
    if regions:
        chart = curves(regions, "frame", region_unit, "growth of each region over the frames", marks)
        items = "".join(f'<span><i class="s{i % COLOURS}"></i>{escape(s.name)}</span>' for i, s in enumerate(regions))
        charts.append(
            "<figure><figcaption><b>regions</b><span>mean growth of each region, band: its standard error</span>"
            f'</figcaption>{chart}<div class="legend">{items}</div></figure>'
        )
    return f'<h2>Growth over time</h2>\n<div class="pair">{"".join(charts)}</div>'


def surface_section(shown: Shown) -> str:
    """The place of the 3D view; its tools work once the script has found WebGL."""
    preferred = ("growth_rate", "area_rate", "depth")
    panels = [p for panels in shown.pages.values() for p in panels if p.kind != "arrows"]
    first = next((key for key in preferred if any(p.key == key for p in panels)), panels[0].key)
    options = "".join(
        f'<option value="{escape(p.key)}"{" selected" * (p.key == first)}>{escape(p.title)}</option>' for p in panels
    )
    arrows = (
        '<label><input type="checkbox" id="arrows" checked> Motion</label>'
        '<label>Length <input type="range" id="stretch" min="-3" max="3" step="0.25" value="0" '
        'aria-label="length of the arrows"></label><span class="soft" id="stretch-text"></span>'
        if "velocity_z" in shown.fields[0]
        else ""
    )
    return f"""<h2>The surface</h2>
<p class="note">The measured surface in its true proportions, as seen along parallel lines, so that the ruler holds
everywhere. Grey: no value of the map chosen. Values of the coarse search are left out.</p>
<div class="view" id="view">
<div class="stage"><canvas id="surface" tabindex="0" role="img" aria-label="3D view of the measured surface. Arrow keys
turn it, plus and minus zoom, 0 returns to the start."></canvas><div class="ruler" id="ruler" hidden></div>
<p class="fallback" id="no-webgl">The 3D view needs JavaScript and WebGL 2, which this browser does not offer. All maps
are shown below.</p></div>
<div class="tools"><label>Colour <select id="colour">{options}</select></label>
<div class="scale" id="scale"></div>{arrows}<button type="button" id="home">Reset view</button></div>
</div>
<p class="note hint">Drag to turn, with Shift or two fingers to move; after a click, the wheel zooms. Keys: arrows,
+ and −, 0.</p>"""


def quality_section(store: ResultStore, facts: Facts, precision: Sequence[Precision], shown: Shown) -> str:
    """What became of the pixels, coverage of the frames, and medians of the standard errors."""
    total = sum(facts.statuses.values())
    ordered = sorted(facts.statuses.items(), key=lambda item: -item[1])
    stack = "".join(
        f'<span style="width:{n / total:.3%};background:{STATUS_COLOURS[code]}" '
        f'title="{status_name(code)} {n / total:.1%}"></span>'
        for code, n in ordered
    )
    rows = "".join(
        f'<tr><td class="what">{swatch(code)}{status_name(code)}</td>'
        f'<td class="n">{n / total:.1%}</td><td>{escape(ADVICE[code])}</td></tr>'
        for code, n in ordered
    )
    words = ", ".join(f"{status_name(code)} {n / total:.1%}" for code, n in ordered)
    coverage = Series("measured", np.array(store.frames, float), 100 * facts.measured, np.zeros(len(store.frames)))
    said = "share of the pixels measured in each frame"
    chart = curves([coverage], "frame", "% of the pixels", said, _marks(shown), (0, 100))
    accuracy = "".join(
        f'<tr><td>{escape(quantity_title(p.name))}</td><td class="n">{to_digits_of(m.value, m.error)}</td>'
        f'<td class="n">{"–" if m.error is None else readable(m.error, 2)}</td>'
        f'<td>{escape("" if p.unit == "1" else p.unit)}</td><td class="n">{m.valid:.1%}</td></tr>'
        for p in precision
        for m in (p.medians,)
    )
    listed = frame_numbers([field.frame for field in shown.fields])
    return f"""<h2>Quality</h2>
<h3>What became of the pixels</h3>
<div class="stack" role="img" aria-label="{escape(words)}">{stack}</div>
<div class="scroll"><table><thead><tr><th>Status</th><th class="n">Share</th><th>What it means</th></tr></thead>
<tbody>{rows}</tbody></table></div>
<div class="pair"><div><h3>Pixels measured in each frame</h3>{chart}</div>
<div><h3>Values and their standard errors</h3>
<div class="scroll"><table><thead><tr><th>Map</th><th class="n">Median</th><th class="n">Standard error</th>
<th>Unit</th><th class="n">Valid</th></tr></thead><tbody>{accuracy}</tbody></table></div>
<p class="note">Medians over the pixels of {listed}. Confidence, from 0 to 1, is the residual of a window against what
noise explains, times how far its texture stands out.</p></div></div>"""


def run_section(store: ResultStore) -> str:
    """Settings, input, versions, device, and where the time went."""
    attrs = store.attrs
    config = _config(attrs.get("config"))
    facts = [(name, text) for name, text in _settings(config, attrs) if text]
    items = "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in facts)
    timings: Mapping[str, Any] = attrs.get("timings") or {}
    stages = [(s, float(v)) for s, v in (timings.get("stages") or {}).items()]
    bars = ""
    if stages:
        named = [(name, seconds, duration(seconds)) for name, seconds in stages]
        meanings = "; ".join(f"{name}: {STAGES[name]}" for name, _ in stages if name in STAGES)
        bars = (
            f"<div><h3>Time of each stage</h3>{stage_bars(named, 'seconds per stage')}"
            f'<p class="note">{duration(float(timings.get("seconds", 0.0)))} on the clock; reading, decoding and '
            f"writing go on beside the rest.</p><details><summary>What the stages do</summary>"
            f'<p class="note">{escape(meanings)}.</p></details></div>'
        )
    text = attrs.get("config")
    folded = (
        f"<details><summary>Configuration</summary><pre>{escape(text)}</pre></details>" if isinstance(text, str) else ""
    )
    return f"""<h2>The run</h2>
<div class="pair"><div><h3>Settings</h3><dl>{items}</dl>{folded}</div>{bars}</div>"""


def _marks(shown: Shown) -> list[float]:
    return [float(field.frame) for field in shown.fields]


def frame_numbers(frames: Sequence[int]) -> str:
    """``frames 3 to 9`` or ``frames 3, 7 and 12``."""
    if len(frames) == 1:
        return f"frame {frames[0]}"
    if frames[-1] - frames[0] == len(frames) - 1:
        return f"frames {frames[0]} to {frames[-1]}"
    return f"frames {', '.join(str(f) for f in frames[:-1])} and {frames[-1]}"


def _config(text: object) -> dict[str, Any]:
    try:
        return tomllib.loads(text) if isinstance(text, str) else {}
    except tomllib.TOMLDecodeError:
        return {}


def _settings(config: Mapping[str, Any], attrs: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and value of what one asks first; what the store does not say is empty."""
    model, window, refine = (config.get(section, {}) for section in ("model", "window", "refine"))
    plan, given, versions = (attrs.get(key) or {} for key in ("plan", "input", "versions"))
    side, frames = window.get("size"), window.get("size_time")
    refined = f"{refine.get('steps')} steps, window {refine.get('window')} px" if refine.get("steps") else "none"
    camera = ""
    if "f_px" in plan:
        steps = " and ".join(f"{b:g} mm along {axis}" for b, axis in zip(plan["baseline_mm"], "xy", strict=True) if b)
        camera = f"focal length {plan['f_px']:g} px, camera step {steps}"
    files = f"{given['files']} files" if "files" in given else ""
    checksum = str(given.get("names_and_sizes_sha256", ""))[:12]
    packages = {"leafflow-ti": attrs.get("leafflow_ti_version", "")} | dict(versions)
    return [
        ("Model", str(plan.get("model", model.get("name", "")))),
        ("Estimator", str(model.get("estimator", ""))),
        ("Window", f"{side} × {side} px, {frames} frames, stride {window.get('stride')}" if side else ""),
        ("Refinement", refined if config else ""),
        ("Brightness", str(model.get("brightness", ""))),
        ("Preset", str(config.get("preset", ""))),
        ("Camera", camera),
        ("Images", files + (f", names and sizes SHA-256 {checksum}…" if checksum else "")),
        ("Device", str(attrs.get("device", ""))),
        ("Versions", ", ".join(f"{name} {version}" for name, version in packages.items() if version)),
    ]
