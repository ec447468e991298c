"""The case: all experiments or one, then the page of everything that the folder holds."""

from __future__ import annotations

import sys

from perf.cases import Options
from perf.dissertation import goals, measure, store
from perf.dissertation.cells import experiment_cells
from perf.dissertation.page import write_page
from perf.figures import Outcome

ALL, REDRAW = "dissertation", "dissertation-page"
"""Names of the cases that run every experiment, and none."""


def run(options: Options) -> Outcome:
    """Run the experiment called ``options.case`` (``ALL``: every one, ``REDRAW``: none) and write the page."""
    folder = options.out / "dissertation"
    names = [experiment.name for experiment in goals.EXPERIMENTS]
    chosen = {ALL: names, REDRAW: []}.get(options.case, [options.case])
    for name in chosen:
        result = measure.run(goals.find(name), options.quick)
        store.save(folder, result)
        print(f"{name}: {result.seconds:.0f} s", file=sys.stderr, flush=True)
    results = store.load(folder, names)
    written = write_page(folder, results)
    shown = chosen or list(results)
    figures = [
        figure
        for name in shown
        for cell in experiment_cells(goals.find(name), results[name])
        for figure in cell.figures(name)
    ]
    failed = sorted({f"{f.variant}: {f.message}" for name in shown for f in results[name].failures})
    settings = {name: goals.find(name).text for name in shown} if len(shown) == 1 else {}
    return Outcome(tuple(figures), settings, tuple(f"not measured: {text}" for text in failed), written)
