"""``regions``: growth and motion of each leaf, over the frames and over the day."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from leafflow_ti.cli.log import with_log_file
from leafflow_ti.errors import UsageError


def _option(name: str, metavar: str, help: str) -> typer.models.OptionInfo:
    found: typer.models.OptionInfo = typer.Option(f"--{name}", metavar=metavar, help=help, show_default=False)
    return found


@with_log_file
def regions(
    result: Annotated[Path, typer.Argument(metavar="OUT.zarr", help="Results of 'leafflow-ti run'.")],
    labels: Annotated[Path, _option("labels", "FILE", "Label image (TIFF, PNG) of the images' size, 0 for none.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="T.csv|T.parquet", help="Table: a row per region and frame.")
    ],
    labels_frame: Annotated[
        int | None, _option("labels-frame", "T", "Frame that the label image shows [the middle one of the results].")
    ] = None,
    still: Annotated[
        bool, typer.Option("--still", help="Regions keep their place; else they follow the motion.")
    ] = False,
    start_time: Annotated[
        str | None, _option("start-time", "ISO", "Date and local time of frame 0, such as 2024-05-31T08:00.")
    ] = None,
    diel: Annotated[
        Path | None, _option("diel", "FILE.csv", "Growth folded on 24 hours: a row per region and bin.")
    ] = None,
    diel_figure: Annotated[Path | None, _option("diel-figure", "FILE.png", "The same as a figure.")] = None,
    bin_h: Annotated[float, typer.Option("--bin-h", metavar="HOURS", help="Bins of the diel curve.")] = 1.0,
    light: Annotated[
        str | None, _option("light", "ON-OFF", "Hours at which the light goes on and off: shades the night.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the files if they exist.")] = False,
) -> None:  # fmt: skip
    """Measure each region (one leaf, one label) in each frame, with standard errors.

    Area, depth, normal, velocity, rotation and growth, per frame and per hour: columns say their units, an empty cell
    is a missing value. A label image holds for one frame and follows the leaves through the others; a TIFF with one
    page per frame of the results holds for all.
    """
    from leafflow_ti.diel import check_figure_path, fold, parse_light, write_diel_figure
    from leafflow_ti.regions import measure_regions
    from leafflow_ti.tables import check_table_path

    hours = None if light is None else parse_light(light)
    if hours is not None and diel_figure is None:
        raise UsageError("--light shades the night in a figure: give --diel-figure FILE.png, too")
    wanted = [path for path in (output, diel, diel_figure) if path is not None]
    if len({path.absolute() for path in wanted}) < len(wanted):
        raise UsageError("the table, the diel curve and its figure are files of their own: give different names")
    for path in (output, diel):
        if path is not None:
            check_table_path(path, overwrite)
    if diel_figure is not None:
        check_figure_path(diel_figure, overwrite)
    table = measure_regions(result, labels, labels_frame=labels_frame, still=still, start_time=start_time)
    curves = None if diel is None and diel_figure is None else fold(table, bin_h)
    table.to_csv(output, overwrite)
    typer.echo("\n".join(table.summary()))
    for note in table.notes:
        typer.echo(f"note: {note}")
    typer.echo(f"table: {output}, {len(table)} rows")
    if curves is None:
        return
    typer.echo(curves.describe())
    if diel is not None:
        typer.echo(f"diel curve: {curves.to_csv(diel, overwrite)}")
    if diel_figure is not None:
        typer.echo(f"figure: {write_diel_figure(curves, diel_figure, hours, overwrite)}")
