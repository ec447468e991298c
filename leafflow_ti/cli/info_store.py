"""``info`` of a results store: its maps, how it came about, what is missing and why."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from leafflow_ti.cli.progress import format_rate
from leafflow_ti.cli.run import format_status

if TYPE_CHECKING:
    from leafflow_ti.results import ResultStore
    from leafflow_ti.store_check import Damage

LISTED = 9
"""Most numbers of a list that are printed."""
TABLED = ("timings", "runs", "missing", "warnings", "measured_maps")
"""Attributes that are shown as tables and sentences."""
PACKED = ("input_files",)
"""Attributes that only programs read: ``--json`` has them."""


def store_facts(store: ResultStore) -> dict[str, Any]:
    """Extent, attributes, statuses of all frames, and unit and range of each map in the middle frame."""
    import numpy as np

    from leafflow_ti.field import quantity, status_counts

    middle = len(store.frames) // 2
    maps: dict[str, Any] = {}
    for name in store.names:
        values = store.read(name, middle)
        finite = values[np.isfinite(values)]
        low, median, high = (float(v) for v in np.percentile(finite, (0, 50, 100))) if finite.size else (None,) * 3
        maps[name] = {"units": quantity(name)[0], "min": low, "median": median, "max": high}
    counts: dict[str, int] = {}
    for t_index in range(len(store.frames)):
        for name, n in status_counts(store.read("status", t_index)).items():
            counts[name] = counts.get(name, 0) + n
    return {
        "path": str(store.path),
        "frames": list(store.frames),
        "rows": store.y.size,
        "columns": store.x.size,
        "x_px": [int(store.x[0]), int(store.x[-1])],
        "y_px": [int(store.y[0]), int(store.y[-1])],
        "interval_s": store.interval_s,
        "units_done": len(store.done()),
        "units": store.n_units,
        "remarks": list(store.remarks),
        "maps_of_frame": store.frames[middle],
        "maps": maps,
        "status": counts,
        "attributes": store.attrs,
    }


def store_lines(facts: dict[str, Any]) -> list[str]:
    """The facts for people: what there is first, then what went wrong, then how it came about."""
    first, last = facts["frames"][0], facts["frames"][-1]
    done, units, attributes = facts["units_done"], facts["units"], facts["attributes"]
    lines = [
        f"results      {facts['path']}",
        f"frames       {len(facts['frames'])} ({_range([first, last])})",
        f"maps         {facts['rows']} x {facts['columns']} (y, x), "
        f"pixels x {_range(facts['x_px'])}, y {_range(facts['y_px'])}",
        f"units        {done} of {units} done" + ("" if done == units else ": go on with run --resume"),
        *(["files        all that the units have written is whole"] if facts.get("damaged") == [] else []),
        *(f"note         {remark}" for remark in facts["remarks"]),
        *_warning_lines(attributes.get("warnings", [])),
        *_timing_lines(attributes.get("timings")),
        *_missing_lines(attributes.get("missing", [])),
        *_run_lines(attributes.get("runs", [])),
        "",
        f"status of the pixels of {'all frames' if len(facts['frames']) > 1 else 'the frame'}",
        *format_status(facts["status"]),
        "",
        f"{'frame ' + str(facts['maps_of_frame']):<22} {'unit':<12} {'min':>12} {'median':>12} {'max':>12}",
    ]
    for name, row in facts["maps"].items():
        numbers = " ".join(
            f"{'-' if row[key] is None else format(row[key], '.6g'):>12}" for key in ("min", "median", "max")
        )
        lines.append(f"{name:<22} {row['units']:<12} {numbers}")
    for key, value in attributes.items():
        if key not in (*TABLED, *PACKED):
            lines += ["", key, *_indented(value)]
    return lines


def damage_lines(damages: list[Damage]) -> list[str]:
    """Units whose files are damaged, as a table."""
    rows = [[str(d.unit), str(d.frame), _range(d.rows), f"{d.array} {d.reason}"] for d in damages]
    return table([["unit", "frame", "rows", "what is damaged"], *rows])


def table(rows: list[list[str]]) -> list[str]:
    """Indented columns, each as wide as its widest cell."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]


def _warning_lines(warnings: list[str]) -> list[str]:
    """What was said while the runs worked."""
    more = len(warnings) - LISTED
    return [f"warning      {text}" for text in warnings[:LISTED]] + (
        [f"warning      ... {more} more: see --json"] if more > 0 else []
    )


def _missing_lines(missing: list[dict[str, Any]]) -> list[str]:
    """Units that were given up, and why."""
    if not missing:
        return []
    rows = [[str(m["unit"]), str(m["frame"]), _range(m["rows"]), str(m["attempts"]), m["reason"]] for m in missing]
    return ["", "units that were given up", *table([["unit", "frame", "rows", "attempts", "reason"], *rows])]


def _run_lines(runs: list[dict[str, Any]]) -> list[str]:
    """One row for each run that worked on the store."""
    if not runs:
        return []
    rows = [["started", "executor", "device", "units", "seconds", "ended"]]
    for run in runs:
        t = run["timings"]
        ended = run["ended"] or "works, or was killed"
        rows.append([run["started"], run["executor"], t["device"], str(t["units"]), f"{t['seconds']:.4g}", ended])
    versions = {json.dumps(run["versions"], sort_keys=True) for run in runs}
    note = ["  (not all with the same versions of Python and packages: see --json)"] if len(versions) > 1 else []
    return ["", "runs", *table(rows), *note]


def _timing_lines(timings: dict[str, Any] | None) -> list[str]:
    """What the units have cost so far, on the clock and by stage."""
    if not timings:
        return []
    runs = "one run" if timings["runs"] == 1 else f"{timings['runs']} runs"
    stages = ", ".join(f"{stage} {seconds:.4g} s" for stage, seconds in timings["stages"].items())
    return [
        f"time         {timings['seconds']:.4g} s in {runs} on {timings['device']}: {timings['units']} units, "
        f"{format_rate(timings['pixels_per_second'])}",
        f"stages       {stages} (reading, decoding and writing go on beside the rest)",
    ]


def _range(ends: list[int] | tuple[int, int]) -> str:
    return f"{ends[0]} to {ends[1]}"


def _indented(value: object) -> list[str]:
    """An attribute as indented lines: text as it is, tables key by key."""
    if isinstance(value, dict):
        return [
            line
            for key, inner in value.items()
            for line in (
                [f"  {key}", *(f"  {x}" for x in _indented(inner))]
                if isinstance(inner, dict)
                else [f"  {key}: {_brief(inner)}"]
            )
        ]
    return [f"  {line}" for line in str(value).splitlines()]


def _brief(value: object) -> object:
    """A value of an attribute; of a long list the first numbers, --json has them all."""
    if isinstance(value, list) and len(value) > LISTED:
        return f"[{', '.join(str(one) for one in value[:LISTED])}, ... {len(value)} in all]"
    return value
