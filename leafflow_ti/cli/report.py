"""``report``: one HTML page of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    result: Annotated[Path, typer.Argument(metavar="OUT.zarr", help="Results of 'leafflow-ti run', finished or not.")],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="PAGE.html", help="Page to write.")],
    regions: Annotated[
        Path | None,
        typer.Option(
            "--regions", metavar="T.csv", help="Table of 'leafflow-ti regions': growth of each.", show_default=False
        ),
    ] = None,
    title: Annotated[
        str | None, typer.Option("--title", metavar="TEXT", help="Title [the store's name].", show_default=False)
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option("--frames", metavar="N", help="Most frames whose maps are shown [12].", show_default=False),
    ] = None,
) -> None:
    """Write one HTML page: maps, growth over time, quality, settings, and the surface in 3D.

    The page holds all it needs (at most 5 MB) and opens in any browser, without network. An earlier report of the same
    name is replaced.
    """
    from leafflow_ti.report import FRAMES, write_report

    written = write_report(result, out, regions=regions, title=title, frames=FRAMES if frames is None else frames)
    typer.echo(f"report: {written} ({written.stat().st_size / 1e6:.1f} MB)")
