"""``run``: a capture in, a results store and quick looks out."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from leafflow_ti.cli import options
from leafflow_ti.cli.log import with_log_file
from leafflow_ti.cli.progress import ProgressLine, write_line
from leafflow_ti.errors import Interrupted, UsageError
from leafflow_ti.number_text import duration

if TYPE_CHECKING:
    from leafflow_ti.progress import RunSummary


@options.with_settings()
@with_log_file
def run(
    settings: Callable[[], Any],
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="capture.toml, or the folder that holds it.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="OUT.zarr", help="Results store to write.", show_default=False)
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan and stop.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run.")] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="With --resume: compute what is damaged again, all files are read.")
    ] = False,
    shard: Annotated[
        str | None,
        typer.Option(
            "--shard", metavar="K/N", help="Only the K-th of N parts, for one job of an array.", show_default=False
        ),
    ] = None,
    dask: Annotated[
        str | None,
        typer.Option(
            "--dask",
            metavar="ADDRESS|local",
            help="Compute on the Dask cluster of a scheduler, or on a local one of --workers processes.",
            show_default=False,
        ),
    ] = None,
    follow: Annotated[
        bool, typer.Option("--follow", help="Measure the frames of a capture as they arrive, until none does any more.")
    ] = False,
    follow_timeout: Annotated[
        float | None,
        typer.Option(
            "--follow-timeout",
            metavar="SECONDS",
            min=0,
            help="How long to wait for what arrives next [10 intervals, 60 at least; 600 without an interval].",
            show_default=False,
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing results store.")] = False,
    quicklook: Annotated[
        bool | None,
        typer.Option(
            "--quicklook/--no-quicklook",
            help="Pictures of the middle frame in OUT-quicklook [if matplotlib is installed].",
            show_default=False,
        ),
    ] = None,
    outside: options.Outside = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print warnings and errors only.")] = False,
) -> None:
    """Measure depth, normals and 3D motion of a capture.

    Options win over --set, --set over --config. Results open with xarray.open_zarr(OUT.zarr, consolidated=False).
    """
    configuration = settings()
    if resume and overwrite:
        raise UsageError("--resume and --overwrite exclude each other: give the one that is meant")
    if verify and not resume:
        raise UsageError("--verify reads the files of earlier results: give --resume, too")
    if out is None and not dry_run:
        raise UsageError("no results store is named: give -o OUT.zarr, or --dry-run")
    part = None if shard is None else parse_shard(shard)
    if quicklook is None:
        quicklook = importlib.util.find_spec("matplotlib") is not None

    if follow and (shard is not None or dask is not None or verify or dry_run):
        raise UsageError("--follow works alone: leave out --shard, --dask, --verify and --dry-run")
    if follow_timeout is not None and not follow:
        raise UsageError("--follow-timeout is for captures that are followed: give --follow, too")
    show = None if quiet else ProgressLine()
    try:
        if follow:
            from leafflow_ti import arriving

            assert out is not None, "no dry run"
            summary = arriving.follow(
                capture, out, configuration, resume=resume, overwrite=overwrite, timeout_s=follow_timeout,
                outside=outside, progress=show, waiting=None if quiet else lambda text: write_line(f"waiting: {text}"),
            )  # fmt: skip
        else:
            from leafflow_ti import api, runs
            from leafflow_ti.capture import open_capture

            opened = open_capture(capture, outside=outside)
            if dry_run:
                typer.echo(api.plan_run(opened, configuration).describe())
                return
            assert out is not None, "no dry run"
            summary = runs.run(
                opened, out, configuration, resume=resume, verify=verify, overwrite=overwrite, shard=part, dask=dask,
                progress=show,
            )  # fmt: skip
    except KeyboardInterrupt as interrupt:
        raise Interrupted.advised(interrupt, f"the same command with --resume goes on with {out}") from None
    finally:
        if show is not None:
            show.close()
    # A shard that ends before the others has not all of the middle frame.
    pictures = write_pictures(out) if quicklook and part is None else None
    if not quiet:
        typer.echo(format_summary(summary, pictures))


def parse_shard(text: str) -> tuple[int, int]:
    """K and N of "K/N"; UsageError for anything else."""
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if found is None:
        raise UsageError(f"--shard {text}: must be K/N, for instance 3/16 for the third of sixteen parts")
    return int(found[1]), int(found[2])


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
