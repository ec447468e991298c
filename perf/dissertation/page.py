"""The page: one HTML file that needs nothing else, and the same values as JSON."""

from __future__ import annotations

import base64
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import replace
from html import escape
from pathlib import Path

from perf.dissertation.cells import Cell, curve, diagram_cells, experiment_cells, goal_cells, number, table_cells
from perf.dissertation.experiment import Experiment, Table
from perf.dissertation.goals import EXPERIMENTS, GOALS
from perf.dissertation.measure import Result
from perf.dissertation.plots import pictures

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1a1a1a; max-width: 1240px; margin: 2em auto; padding: 0 1.5em; }
h1 { font-size: 1.6em; } h2 { font-size: 1.25em; margin-top: 2.4em; border-top: 1px solid #ccc; padding-top: .8em; }
table { border-collapse: collapse; margin: .8em 0; font-variant-numeric: tabular-nums; }
caption { text-align: left; font-weight: 600; padding: .3em 0; }
th, td { border: 1px solid #d5d5d5; padding: .3em .6em; text-align: left; vertical-align: top; }
th { background: #f4f4f4; font-weight: 600; } td small { display: block; color: #555; }
.good { background: #e1effa; } .bad { background: #fce8d8; }
td b { white-space: nowrap; } .good b { color: #004c7a; } .bad b { color: #8f3a00; }
img { max-width: 100%; height: auto; margin: .6em 0; display: block; }
.quiet { color: #555; } nav a { margin-right: 1em; }
"""


def write_page(folder: Path, results: Mapping[str, Result]) -> tuple[Path, Path]:
    """Write ``dissertation.html`` and ``dissertation.json`` of these results; returns both paths."""
    folder.mkdir(parents=True, exist_ok=True)
    page, values = folder / "dissertation.html", folder / "dissertation.json"
    page.write_text(_page(folder, results), encoding="utf-8")
    values.write_text(json.dumps(_values(results), ensure_ascii=False, indent=1), encoding="utf-8")
    return page, values


def _page(folder: Path, results: Mapping[str, Result]) -> str:
    shown = [e for e in EXPERIMENTS if e.name in results]
    missing = [e.name for e in EXPERIMENTS if e.name not in results]
    links = "".join(f'<a href="#{e.name}">{escape(e.title.partition(":")[0])}</a>' for e in shown)
    parts = [
        "<!DOCTYPE html>", '<html lang="en"><head><meta charset="utf-8">',
        "<title>leafflow-ti: tables and figures of Schuchert 2010</title>", f"<style>{STYLE}</style></head><body>",
        "<h1>Tables and figures of Schuchert 2010, measured again</h1>",
        "<p>T. Schuchert, <i>Plant Leaf Motion Estimation Using A 5D Affine Optical Flow Model</i>, RWTH Aachen 2010. "
        "Every number is measured by leafflow-ti on sequences made from the scenes described below. Beneath it stands "
        "what the dissertation prints, where that is known. Cells are marked "
        "<span class=good><b>better</b></span> (at most the printed value) or <span class=bad><b>worse</b></span>. "
        "Angular errors are the AAE (A.2) of the vectors (v, 1), mean ± standard deviation over the region; growth is "
        "judged by the root mean square of mean and spread.</p>",
        _summary(results), f"<nav>{links}</nav>", _goals(results),
        *(_experiment(folder, e, results[e.name]) for e in shown),
    ]  # fmt: skip
    if missing:
        parts.append(f"<p>Not run: {', '.join(missing)}.</p>")
    return "\n".join([*parts, "</body></html>\n"])


def _summary(results: Mapping[str, Result]) -> str:
    cells = [cell for e in EXPERIMENTS if e.name in results for cell in experiment_cells(e, results[e.name])]
    compared = [cell for cell in cells if cell.better is not None]
    better = sum(cell.better is True for cell in compared)
    quick = any(result.quick for result in results.values())
    versions = ", ".join(sorted({f"leafflow-ti {r.version} on {r.device}" for r in results.values() if r.device}))
    minutes = sum(result.seconds for result in results.values()) / 60.0
    return (
        f"<p><b>{better} of {len(compared)}</b> compared cells are at or below the printed value. "
        f"{escape(versions)}; {minutes:.1f} minutes in all.</p>"
        + ("<p><b>Quick version:</b> fewer pixels, points and sequences than the full one.</p>" if quick else "")
    )


def _goals(results: Mapping[str, Result]) -> str:
    groups = [(goal.text, goal_cells(goal, results)) for goal in GOALS]
    for experiment in (e for e in EXPERIMENTS if e.name in results):
        checks = diagram_cells(experiment, results[experiment.name])
        title = experiment.title.partition(":")[0]
        groups.append((f"Sinusoids, {title}: within the printed range", [replace(c, goal=c.reference) for c in checks]))
    rows = ["<h2>Goals of this project</h2><table><tr><th>value</th><th>measured</th><th>at most</th><th></th></tr>"]
    for text, cells in groups:
        rows += [f'<tr><th colspan="4">{escape(text)}</th></tr>'] if cells else []
        rows += [_goal_row(cell) for cell in cells]
    return "\n".join([*rows, "</table>"])


def _goal_row(cell: Cell) -> str:
    limit = number(math.nan if cell.goal is None else cell.goal)
    mark = '<td class="good"><b>met</b></td>' if cell.met else '<td class="bad"><b>not met</b></td>'
    note = f"<small>{escape(_remark(cell))}</small>" if _remark(cell) else ""
    name = ": ".join(filter(None, (cell.row, cell.column)))
    return f"<tr><td>{escape(name)}</td><td>{escape(f'{cell.text} {cell.unit}')}{note}</td><td>{limit}</td>{mark}</tr>"


def _experiment(folder: Path, experiment: Experiment, result: Result) -> str:
    parts = [
        f'<h2 id="{experiment.name}">{escape(experiment.title)}</h2>',
        f"<p>{escape(experiment.text)}</p>",
        f'<p class="quiet">{escape(experiment.known)}</p>',
        *(_table(table, result) for table in experiment.tables),
    ]
    checks = diagram_cells(experiment, result)
    if checks:
        body = "".join(f"<tr><td>{escape(c.row)}</td><td>{escape(c.column)}</td>{_td(c)}</tr>" for c in checks)
        parts.append(
            "<table><caption>worst point against the printed range</caption>"
            f"<tr><th>curve</th><th>quantity</th><th>measured</th></tr>{body}</table>"
        )
    for kind, data in pictures(folder, experiment, result):
        source = base64.b64encode(data).decode("ascii")
        parts.append(f'<img alt="{escape(experiment.title)}" src="data:{kind};base64,{source}">')
    worse = [cell for cell in experiment_cells(experiment, result) if cell.better is False or cell.met is False]
    parts += [f"<p>{escape(note)}</p>" for note in experiment.notes]
    parts += [_explanations(worse), _failures(result), f'<p class="quiet">Took {result.seconds:.0f} s.</p>']
    return "\n".join(parts)


def _table(table: Table, result: Result) -> str:
    head = "".join(f"<th>{escape(column)}</th>" for column in table.columns)
    rows = [
        f"<tr><th>{escape(row)}</th>{''.join(map(_td, cells))}</tr>"
        for row, cells in zip(table.rows, table_cells(table, result), strict=True)
    ]
    return f"<table><caption>{escape(table.title)}</caption><tr><th></th>{head}</tr>{''.join(rows)}</table>"


def _td(cell: Cell) -> str:
    better, worse, met, missed = ("better", "worse", "met", "not met") if cell.measured else ("not measured",) * 4
    verdicts = (("printed " + cell.printed, cell.better, better, worse), (_limit(cell), cell.met, met, missed))
    lines = [f"{escape(text)}: <b>{yes if ok else no}</b>" for text, ok, yes, no in verdicts if ok is not None]
    lines += [escape(cell.note)] if cell.note else []
    known = [ok for _, ok, _, _ in verdicts if ok is not None]
    kind = f' class="{"good" if all(known) else "bad"}"' if known else ""
    return f"<td{kind}>{escape(cell.text)}{''.join(f'<small>{line}</small>' for line in lines)}</td>"


def _limit(cell: Cell) -> str:
    return f"goal {cell.goal:g}" if cell.goal is not None else ""


def _explanations(worse: Iterable[Cell]) -> str:
    told = [(f"{cell.row}, {cell.column}", _remark(cell) or "not explained yet.") for cell in worse]
    lines = [f"<li>{escape(name)}: {escape(reason)}</li>" for name, reason in told]
    return f"<p>Worse than printed, or short of the goal:</p><ul>{''.join(lines)}</ul>" if lines else ""


def _remark(cell: Cell) -> str:
    return ": ".join(filter(None, (cell.note, cell.reason)))


def _failures(result: Result) -> str:
    found = Counter((failure.variant, failure.message) for failure in result.failures)
    lines = [f"<li>{escape(v)} ({n} scene{'s' * (n > 1)}): {escape(m)}</li>" for (v, m), n in found.items()]
    return f"<p>Not measured:</p><ul>{''.join(lines)}</ul>" if lines else ""


def _values(results: Mapping[str, Result]) -> dict[str, object]:
    shown = [e for e in EXPERIMENTS if e.name in results]
    return {
        "goals": [{"goal": g.text, "cells": [c.to_json() for c in goal_cells(g, results)]} for g in GOALS],
        "experiments": {e.name: _experiment_values(e, results[e.name]) for e in shown},
    }


def _experiment_values(experiment: Experiment, result: Result) -> dict[str, object]:
    tables = [[cell.to_json() for row in table_cells(t, result) for cell in row] for t in experiment.tables]
    checks = [cell.to_json() for cell in diagram_cells(experiment, result)]
    curves = [
        {
            "title": d.title, "quantity": d.quantity, "statistic": d.statistic, "region": d.region, "x": d.x_label,
            "curves": {label: curve(d, label, result) for label in d.curves},
        }
        for d in experiment.diagrams
    ]  # fmt: skip
    heading = {"title": experiment.title, "quick": result.quick, "seconds": round(result.seconds, 1)}
    return {**heading, "tables": tables, "checks": checks, "diagrams": curves}
