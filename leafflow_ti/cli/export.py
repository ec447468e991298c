"""``export``: results in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def export(
    result: Annotated[Path, typer.Argument(metavar="OUT.zarr", help="Results of 'leafflow-ti run'.")],
    to: Annotated[str, typer.Option("--to", metavar="tiff|ome-tiff|netcdf|ply|vtk|csv", help="The format.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="PATH", help="File (.tif, .nc, .ply, .vtp, .csv), or folder.")
    ],
    frames: Annotated[
        str | None,
        typer.Option("--frames", metavar="A:B", help="Frame indices, B excluded [all].", show_default=False),
    ] = None,
    maps: Annotated[
        str | None,
        typer.Option(
            "--maps", metavar="NAME,...", help="Maps, by name or pattern such as 'velocity_*' [all].",
            show_default=False,
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace what is there, if it is an export.")] = False,
) -> None:  # fmt: skip
    """Write results for other programs.

    tiff: a folder of float32 stacks for ImageJ and Fiji, one per map. ome-tiff: one file, maps as channels. netcdf:
    one file by the CF conventions. ply, vtk: a folder with the surface of each frame as a mesh, all maps at its
    vertices; open series.pvd in ParaView. csv: a line per measured pixel. Names that end in a suffix are one file,
    other names a folder.
    """
    from leafflow_ti.exporters import export as write
    from leafflow_ti.results import ResultStore

    store = ResultStore.open(result)
    names = None if maps is None else [name.strip() for name in maps.split(",") if name.strip()]
    written = write(store, to, output, frames=frames, maps=names, overwrite=overwrite)
    size = sum(path.stat().st_size for path in written)
    files = "1 file" if len(written) == 1 else f"{len(written)} files"
    for remark in store.remarks:
        typer.echo(f"note: {remark}")
    typer.echo(f"{output}: {files}, {size / 2**20:.3g} MiB")
