"""``run``: a capture in, a results store and quick looks out."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from leafflow_ti.cli import options
from leafflow_ti.cli.progress import ProgressLine
from leafflow_ti.errors import UsageError
from leafflow_ti.number_text import duration

if TYPE_CHECKING:
    from leafflow_ti.progress import RunSummary


@options.with_settings()
def run(
    settings: Callable[[], Any],
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="capture.toml, or the folder that holds it.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="OUT.zarr", help="Results store to write.", show_default=False)
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan and stop.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing results store.")] = False,
    quicklook: Annotated[
        bool | None,
        typer.Option(
            "--quicklook/--no-quicklook",
            help="Pictures of the middle frame in OUT-quicklook [if matplotlib is installed].",
            show_default=False,
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print errors only.")] = False,
) -> None:
    """Measure depth, normals and 3D motion of a capture.

    Options win over --set, --set over --config. Results open with xarray.open_zarr(OUT.zarr, consolidated=False).
    """
    configuration = settings()
    if resume and overwrite:
        raise UsageError("--resume and --overwrite exclude each other: give the one that is meant")
    if out is None and not dry_run:
        raise UsageError("no results store is named: give -o OUT.zarr, or --dry-run")
    if quicklook is None:
        quicklook = importlib.util.find_spec("matplotlib") is not None

    from leafflow_ti.capture import open_capture

    opened = open_capture(capture)
    from leafflow_ti import api

    if dry_run:
        typer.echo(api.plan_run(opened, configuration).describe())
        return
    assert out is not None
    show = None if quiet else ProgressLine()
    try:
        summary = api.run(opened, out, configuration, resume=resume, overwrite=overwrite, progress=show)
    except KeyboardInterrupt:
        typer.echo(f"interrupted: the same command with --resume goes on with {out}", err=True)
        raise
    finally:
        if show is not None:
            show.close()
    pictures = write_pictures(out) if quicklook else None
    if not quiet:
        typer.echo(format_summary(summary, pictures))


def quicklook_folder(out: Path) -> Path:
    """Where the pictures of ``OUT.zarr`` go: ``OUT-quicklook`` beside it."""
    return out.with_name(f"{out.name.removesuffix('.zarr')}-quicklook")


def write_pictures(out: Path) -> Path:
    """Write the quick looks of the middle frame of a finished run; return their folder."""
    from leafflow_ti.quicklook import write_quicklooks
    from leafflow_ti.results import ResultStore

    store = ResultStore.open(out)
    folder = quicklook_folder(out)
    write_quicklooks(store, len(store.frames) // 2, folder)
    return folder


def format_summary(summary: RunSummary, pictures: Path | None) -> str:
    """Time, device, where the results are, and the shares of the statuses with advice."""
    lines = [
        f"done in {duration(summary.seconds)} on {summary.device} (compiling: {summary.compile_seconds:.1f} s)",
        *format_status(summary.status_counts),
        f"results: {summary.path}",
    ]
    if pictures is not None:
        lines.append(f"pictures: {pictures / 'overview.png'}")
    return "\n".join(lines)


def format_status(counts: dict[str, int]) -> list[str]:
    """One line per status that occurs: share of the pixels, name, advice; the commonest first."""
    from leafflow_ti.status import ADVICE, Status

    total = sum(counts.values())
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    return [f"{n / total:7.1%}  {name:<13}  {ADVICE[Status[name.upper()]]}" for name, n in ordered if n]
