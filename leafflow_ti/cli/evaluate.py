"""``evaluate``: a results store against the truth, for people or as JSON."""

from __future__ import annotations

import dataclasses
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from leafflow_ti.errors import InputError, UsageError

if TYPE_CHECKING:
    from leafflow_ti.metrics import RegionReport
    from leafflow_ti.results import ResultStore

UNITS = {"deg": "°", "mm": "mm", "px": "px", "percent": "%/frame"}


def evaluate(
    result: Annotated[Path, typer.Argument(metavar="OUT.zarr", help="Results of 'leafflow-ti run'.")],
    truth: Annotated[Path, typer.Option("--truth", metavar="truth.npz", help="The truth of one frame.")],
    frame: Annotated[
        int | None,
        typer.Option(
            "--frame", metavar="T", help="Frame to compare [the one that truth.npz names].", show_default=False
        ),
    ] = None,
    margin: Annotated[
        int | None,
        typer.Option(
            "--margin",
            metavar="PIXELS",
            help="Distance to other regions that 'interior' keeps [half the window of the run].",
            show_default=False,
        ),
    ] = None,
    interior: Annotated[
        bool, typer.Option("--interior", help="Tell of the regions without their borders alone.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Compare results with a known truth.

    Reports the average angular error (AAE) of velocity, rotation and acceleration, each as the angle between (v, 1)
    and its truth in mm/frame, rad/frame and mm/frame², errors of depth, slopes, growth and strain, and how well the
    standard errors describe them: (estimate - truth)/std should have mean 0 and standard deviation 1. Values of the
    coarse search, which have no standard errors, are left out. Labels of truth.npz (face, region) are reported apart,
    each whole and without its border.
    """
    if margin is not None and margin < 0:
        raise UsageError(f"--margin {margin}: must be 0 or more pixels")
    from leafflow_ti import metrics
    from leafflow_ti.results import ResultStore

    known = metrics.read_truth(truth)
    store = ResultStore.open(result)
    field = store.field(_frame_index(store, known, frame, truth)).measured()
    if margin is None:
        margin = window_size(store.attrs) // 2
    regions = {name: mask[field.y][:, field.x] for name, mask in metrics.label_regions(known, margin).items()}
    if interior:
        regions = {name: mask for name, mask in regions.items() if name.endswith(metrics.INTERIOR)}
        if not regions:
            raise UsageError(f"--interior: {truth} labels no regions, or the margin is 0: leave it out")
    reports = metrics.evaluate(field, metrics.sample_maps(known, field.y, field.x), regions)
    if as_json:
        facts = {
            "result": str(result),
            "truth": str(truth),
            "frame": field.frame,
            "margin_px": margin,
            "regions": {name: dataclasses.asdict(report) for name, report in reports.items()},
        }
        typer.echo(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        typer.echo(f"{result}, frame {field.frame}; interior: at least {margin} px from other regions")
        typer.echo("\n".join(format_reports(reports)))


def window_size(attrs: Mapping[str, Any]) -> int:
    """Side of the window [px] that a store's configuration names, 0 if it names none."""
    try:
        return int(tomllib.loads(attrs["config"])["window"]["size"])
    except (KeyError, TypeError, ValueError):
        return 0


def format_reports(reports: Mapping[str, RegionReport]) -> list[str]:
    """A table of errors and one of coverage for every region."""
    lines = []
    for region, report in reports.items():
        lines += ["", f"{region}: {report.pixels} px with truth"]
        lines.append(
            f"  {'error':<30}{'pixels':>9}{'mean':>12}{'std':>11}{'median':>12}{'median |.|':>12}{'95% |.|':>11}"
        )
        for name, e in report.errors.items():
            lines.append(
                f"  {title(name):<30}{e.n:>9}{e.mean:>12.4g}{e.std:>11.3g}{e.median:>12.4g}"
                f"{e.median_abs:>12.4g}{e.p95_abs:>11.3g}"
            )
        if report.coverage:
            lines.append(
                f"  {'(estimate - truth)/std':<30}{'pixels':>9}{'mean':>12}{'std':>11}{'within 1':>12}{'2 std':>12}"
            )
        for name, c in report.coverage.items():
            lines.append(f"  {name:<30}{c.n:>9}{c.mean:>12.3f}{c.std:>11.3f}{c.within_1:>12.1%}{c.within_2:>12.1%}")
    return lines


def title(name: str) -> str:
    """``velocity_aae_deg`` -> ``velocity AAE [°]``."""
    stem, _, unit = name.rpartition("_")
    return f"{stem.replace('_aae', ' AAE').replace('_endpoint', ' endpoint')} [{UNITS[unit]}]"


def _frame_index(store: ResultStore, truth: Mapping[str, Any], frame: int | None, path: Path) -> int:
    """Index along t of the frame to compare."""
    if frame is None and "frame" in truth:
        frame = int(truth["frame"])
    if frame is None:
        if len(store.frames) == 1:
            return 0
        raise UsageError(f"{path} does not say its frame, the results hold {len(store.frames)}: give --frame T")
    if frame not in store.frames:
        held = f"{store.frames[0]}..{store.frames[-1]}"
        raise InputError(f"{store.path}: holds frames {held}, not {frame}: run that one, or give --frame")
    return store.frames.index(frame)
