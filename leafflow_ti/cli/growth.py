"""``growth``: surface strain and area rate from the motion in a results store, for people or as JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from leafflow_ti.cli.log import with_log_file
from leafflow_ti.cli.progress import counted
from leafflow_ti.errors import Interrupted

if TYPE_CHECKING:
    from leafflow_ti.surface_growth import GrowthSummary

DISAGREEMENT = 2.0
"""Root mean square of (growth_rate - area_rate) / standard error beyond which advice is given."""


@with_log_file
def growth(
    result: Annotated[Path, typer.Argument(metavar="OUT.zarr", help="Results of 'leafflow-ti run'.")],
    strain_window: Annotated[
        int | None,
        typer.Option(
            "--strain-window",
            metavar="PX",
            help="Side of the window, the virtual strain gauge [so large that it holds nine independent estimates].",
            show_default=False,
        ),
    ] = None,
    average: Annotated[
        int,
        typer.Option(
            "--average", metavar="FRAMES", help="Mean over so many frames around each, odd [1].", show_default=False
        ),
    ] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Measure growth from the motion on the curved surface.

    Adds maps to the results: area_rate and the Lagrangian strain surface_strain_11, _22, _12 with its principal values
    and their direction, each with its standard error, in % per frame. They rest on how the motion differs from place
    to place, the run's growth_rate on how each window deforms: the two must agree within their errors, and it is
    printed whether they do.
    """
    from leafflow_ti.surface_growth import measure_growth

    try:
        summary = measure_growth(result, strain_window, average, counted("frame"))
    except KeyboardInterrupt as interrupt:
        advice = "maps that are not whole are left out until the same command has run again"
        raise Interrupted.advised(interrupt, advice) from None
    if as_json:
        typer.echo(json.dumps(summary.to_json(), indent=2, ensure_ascii=False))
    else:
        typer.echo("\n".join(format_growth(summary)))


def format_growth(summary: GrowthSummary) -> list[str]:
    """What was measured, a line for each map, and the agreement with the run's growth rate."""
    import numpy as np

    from leafflow_ti.field import quantity
    from leafflow_ti.rates import per_hour

    over = f"s, means over {summary.average} frames" if summary.average > 1 else "s" * (summary.frames > 1)
    lines = [
        f"{summary.path}: strain in windows of {summary.window_px} px, {summary.frames} frame{over}",
        f"  {'median over pixels and frames':<30}{'value':>11}{'std error':>11}  {'unit':<10}{'pixels':>7}",
    ]
    for name, found in summary.maps.items():
        unit, factor = per_hour(quantity(name)[0], summary.interval_s)
        value, std = found.median * factor, found.median_std * factor
        lines.append(f"  {name:<30}{value:>11.4g}{std:>11.2g}  {unit:<10}{found.share:>7.1%}")
    if not summary.maps:
        lines.append("  no pixel has a strain: too little is measured around each; see the status map")
    if summary.agreement:
        a = summary.agreement
        lines.append(
            f"  (growth_rate - area_rate) / standard error: mean {a.mean:.2f}, standard deviation {a.std:.2f} "
            f"({a.pixels} pixels); 0 and 1 where both are right"
        )
        if np.hypot(a.mean, a.std) > DISAGREEMENT:
            lines.append(
                "  the two disagree: growth that differs by direction (run with --deformation strain), light that "
                "changes (--brightness), or windows that see two surfaces (smaller ones, --mask)"
            )
    return lines
