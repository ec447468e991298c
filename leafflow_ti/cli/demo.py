"""``demo``: the whole way without any input, each step shown as the command that does it."""

from __future__ import annotations

import importlib.util
import shlex
from pathlib import Path
from typing import Annotated

import typer

from leafflow_ti.cli.run import quicklook_folder
from leafflow_ti.errors import UsageError

SMALL: tuple[list[str], list[str]] = (["--size", "400x260"], ["--window", "41"])
FULL: tuple[list[str], list[str]] = (["--size", "301x301"], [])
"""Options of ``simulate cube`` and of ``run``; the full one has the window and image size of the
dissertation. All else is the default, refinement included."""
Step = tuple[str, list[str]]
"""What is done, and the command line that does it."""


def demo(
    folder: Annotated[Path, typer.Argument(metavar="OUTDIR", help="Folder to create.")] = Path("leafflow-demo"),
    full: Annotated[bool, typer.Option("--full", help="Images of 301 x 301 px, window of 65 px.")] = False,
) -> None:
    """Simulate a rotating cube, measure it, compare with the truth, export its surface, write a report.

    Nine cameras see nine frames of a textured cube that turns by 0.4 degrees and moves by 1 mm per frame.
    """
    from leafflow_ti.cli.main import invoke

    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} exists and is not empty: remove it, or name another folder")
    scene, settings = FULL if full else SMALL
    pictures = importlib.util.find_spec("matplotlib") is not None
    capture, out, mesh, page = (folder / name for name in ("cube", "cube.zarr", "cube-vtk", "cube.html"))
    steps: list[Step] = [
        ("A synthetic capture with its exact truth", ["simulate", "cube", str(capture), *scene]),
        (
            "Depth, normals, 3D motion and growth, refined on the exact patch",
            ["run", str(capture), "-o", str(out), *settings],
        ),
        ("Growth once more, from the motion on the surface: a cube does not grow", ["growth", str(out)]),
        (
            "Compared with the truth, away from the cube's edges",
            ["evaluate", str(out), "--truth", str(capture / "truth.npz"), "--interior"],
        ),
        ("The surface for ParaView", ["export", str(out), "--to", "vtk", "-o", str(mesh)]),
    ]
    if pictures:
        steps.append(("All of it on one page", ["report", str(out), "-o", str(page)]))
    for title, arguments in steps:
        typer.echo(f"\n# {title}\n$ leafflow-ti {shlex.join(arguments)}")
        invoke(arguments)
    typer.echo("\n# Look at")
    typer.echo(f"{out}  (leafflow-ti info {shlex.quote(str(out))})\n{mesh / 'series.pvd'}  (in ParaView)")
    if pictures:
        typer.echo(f"{quicklook_folder(out) / 'overview.png'}\n{page}  (in any browser)")
    else:
        typer.echo("no report, no pictures: they need matplotlib (pip install 'leafflow-ti[plot]')")
