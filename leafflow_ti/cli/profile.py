"""``profile``: what a run costs on this machine, stage by stage, and how long the whole will take."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from leafflow_ti.cli import options
from leafflow_ti.cli.progress import format_rate
from leafflow_ti.errors import UsageError
from leafflow_ti.number_text import duration
from leafflow_ti.trace import BACKGROUND_STAGES, STAGES

if TYPE_CHECKING:
    from leafflow_ti.profile_report import Profile, StageCost


@options.with_settings(without=("frames", "workers"))
def profile(
    settings: Callable[..., Any],
    capture: Annotated[
        Path | None, typer.Argument(metavar="[CAPTURE]", help="capture.toml, or the folder that holds it.")
    ] = None,
    case: Annotated[
        str | None,
        typer.Option(
            "--case",
            metavar="NAME",
            help="A built-in synthetic capture instead: affine-4d, affine-4d-stride4, affine-scene-flow, "
            "refined, depth.",
            show_default=False,
        ),
    ] = None,
    frames: Annotated[int, typer.Option("--frames", metavar="N", min=1, help="Frames to measure.")] = 5,
    trace: Annotated[
        Path | None,
        typer.Option(
            "--trace", metavar="FILE", help="Write a trace for Perfetto or about:tracing.", show_default=False
        ),
    ] = None,
    outside: options.Outside = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Measure the stages of a run on a few frames, and say how long the whole will take.

    Takes the options of run; the frames of the whole are those of --set output.frames=A:B. Nothing is written but FILE.
    """
    if (capture is None) == (case is None):
        raise UsageError("one capture is profiled: give CAPTURE or --case NAME")
    if capture is not None:
        configuration = settings()
        from leafflow_ti.capture import open_capture

        opened: Any = open_capture(capture, outside=outside)
    else:
        from leafflow_ti.profile_cases import find_case

        chosen = find_case(str(case))
        configuration = settings(*chosen.settings)
        opened = chosen.capture(frames)

    from leafflow_ti.profiling import profile as measure

    found = measure(opened, configuration, frames, trace)
    typer.echo(json.dumps(found.to_json(), indent=2) if as_json else "\n".join(format_profile(found)))


def format_profile(found: Profile) -> list[str]:
    """The stages as a table, then the whole."""
    ceilings, whole = found.ceilings, found.prediction
    peak = "" if found.peak_bytes is None else f", peak of the process {found.peak_bytes / 2**20:.0f} MiB"
    unit, before = "unit", f"after {found.fill_seconds:.2f} s to fill the windows"
    parts = "for every band: filling the windows + frames x unit, by rows"
    if found.searched:
        unit, before = "frame", "each searched for what its pixels need"
        parts = "frames x frame; others may show more surfaces, or fewer"
    overlap = "" if found.overlap is None else f", {found.overlap:.0%} of it hidden behind the computing"
    return [
        f"model       {found.model}",
        f"device      {found.device}; compiling or loading the kernels: {found.compile_seconds:.1f} s",
        f"ceilings    {ceilings.gflops_f32:.0f} GFLOP/s f32, {ceilings.gflops_f64:.0f} GFLOP/s f64, "
        f"{ceilings.gbytes:.1f} GB/s from memory",
        f"measured    {found.frames_measured} {unit}s of {found.unit[0]} x {found.unit[1]} pixels, {before}",
        "",
        f"{'stage':<10} {f'ms/{unit}':>9} {'us/px':>8} {'of time':>8} {'flops/px':>9} {'GFLOP/s':>8} {'of peak':>8} "
        f"{'GB/s':>7} {'of peak':>8}  limit",
        *(_row(cost) for cost in found.stages),
        f"{unit:<10} {1e3 * found.seconds_per_unit:9.1f} "
        f"{1e6 / found.pixels_per_second:8.3f} {1:8.0%}{'':46}  {found.limit}",
        "",
        *(f"{c.stage:<10} {STAGES[c.stage]}" for c in found.stages),
        "",
        *_effort(found),
        f"Read, decode and write go on beside the computing: what they cost alone{overlap}.",
        f"speed       {format_rate(found.pixels_per_second)}, limited by {found.limit}",
        f"memory      {found.planned_bytes / 2**20:.0f} MiB planned{peak}",
        f"whole       {whole.units} units ({whole.frames} frames x {whole.bands} bands, {whole.frames_read} frames "
        f"read): about {duration(whole.seconds)}",
        f"            = compiling + {parts}",
    ]


def _effort(found: Profile) -> list[str]:
    """Of the refinement, in a line."""
    if not found.effort:
        return []
    e = found.effort
    return [
        f"An output pixel was refined {e.refined:.2f} times (twice where the first failed) in {e.passes:.2f} steps, "
        f"in {e.samplings:.2f} of which the images were interpolated anew."
    ]


def _row(cost: StageCost) -> str:
    def number(value: float | None, form: str, width: int) -> str:
        return f"{'' if value is None else format(value, form):>{width}}"

    name = f"({cost.stage})" if cost.stage in BACKGROUND_STAGES else cost.stage
    return (
        f"{name:<10} {1e3 * cost.seconds:9.1f} {cost.us_per_pixel:8.3f} {cost.share:8.0%} "
        f"{number(cost.flops_per_pixel, '.3g', 9)} {number(cost.gflops, '.1f', 8)} "
        f"{number(cost.share_of_flops, '.1%', 8)} {number(cost.gbytes, '.2f', 7)} "
        f"{number(cost.share_of_bytes, '.1%', 8)}  {cost.limit}"
    )
