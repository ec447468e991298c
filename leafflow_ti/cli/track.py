"""``track``: points followed through a sequence, with growth and strain since the start."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from leafflow_ti.cli.log import with_log_file
from leafflow_ti.errors import InputError, UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from leafflow_ti.results import ResultStore
    from leafflow_ti.tracks import Tracks

    Points = tuple[NDArray[np.float64], NDArray[np.float64]]

GROWTHS = {
    "growth": "by the growth rate",
    "area_growth": "by the area rate",
    "place_growth": "by the places of the points",
}
"""Variable -> how the summary calls it."""


def _option(name: str, metavar: str, help: str) -> Any:
    return typer.Option(f"--{name}", metavar=metavar, help=help, show_default=False)


@with_log_file
def track(
    result: Annotated[Path, typer.Argument(metavar="OUT.zarr", help="Results of 'leafflow-ti run'.")],
    out: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="TRACKS.csv|.parquet|.nc|.zarr", help="Tracks to write; the name says how."
        ),
    ],
    points: Annotated[
        Path | None, _option("points", "FILE.csv", "Points to follow: columns x, y in px [those of --grid].")
    ] = None,
    grid: Annotated[
        int | None, _option("grid", "PX", "Follow measured pixels that are about so far apart [4 times the stride].")
    ] = None,
    labels: Annotated[
        Path | None, _option("labels", "FILE", "Label image (TIFF, PNG) of the frame of --start: regions.")
    ] = None,
    start: Annotated[int | None, _option("start", "T", "Frame in which the points are given [the first].")] = None,
    axis: Annotated[
        str | None,
        _option(
            "axis", "x0,y0,x1,y1[,...]|auto",
            "Axis of the leaf: positions in px in that frame, or the longest principal axis of each region.",
        ),
    ] = None,
    max_drift: Annotated[
        float | None, _option("max-drift", "PX", "Give a point up where its drift may exceed this [1].")
    ] = None,
    gauge: Annotated[
        float | None,
        _option("gauge", "PX", "Points at most half of this apart at the start tell a strain [three estimates]."),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace existing tracks.")] = False,
) -> None:  # fmt: skip
    """Follow points through all frames, and tell how the material around them has grown since the start.

    Each point has its place in the image and in space, a bound on its drift, and why it was lost. Growth is told by
    the rates along its way, with standard errors, and by the places of its neighbours, then and now.
    """
    from leafflow_ti.cumulative import track_growth
    from leafflow_ti.leaf_axes import leaf_coordinates
    from leafflow_ti.results import ResultStore
    from leafflow_ti.tracking import MAX_DRIFT
    from leafflow_ti.tracking import track as follow
    from leafflow_ti.tracks import check_path

    if points is not None and grid is not None:
        raise UsageError("--points and --grid exclude each other: give the one that is meant")
    way = None if axis is None else _axis(axis)
    check_path(out, overwrite)
    store = ResultStore.open(result)
    if len(store.frames) == 1:
        raise InputError(f"{store.path}: holds one frame, so there is nothing to follow: measure a sequence")
    start = store.frames[0] if start is None else start
    x, y = _grid(store, grid, start) if points is None else _read_points(points)
    tracks = follow(store, x, y, start, max_drift=MAX_DRIFT if max_drift is None else max_drift)
    if not tracks.known[tracks.start_index].any():
        raise InputError(f"{points}: none of these points is measured in frame {start}: give points on the leaves")
    if labels is not None:
        tracks = _labelled(tracks, store, labels)
    tracks = track_growth(store, tracks, gauge)
    if way is not None:
        tracks = leaf_coordinates(store, tracks, way)
    tracks.save(out, overwrite)
    notes = (f"note: {remark}" for remark in store.remarks)
    typer.echo("\n".join([*format_tracks(tracks, store.interval_s), *notes, f"tracks: {out}"]))


def _axis(text: str) -> str | list[tuple[float, float]]:
    """The value of --axis: "auto", or positions."""
    if text == "auto":
        return text
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) < 4 or len(numbers) % 2:
        raise UsageError(f"--axis {text}: give x0,y0,x1,y1 and further pairs, in px, or auto")
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def _grid(store: ResultStore, spacing: int | None, start: int) -> Points:
    """Output pixels of the frame ``start`` with a value, ``spacing`` px apart or the next less that the stride allows.

    Raises UsageError for a spacing below 1 or a frame that the store does not hold.
    """
    import numpy as np

    from leafflow_ti.status import HAS_VALUE, Status

    if spacing is not None and spacing < 1:
        raise UsageError(f"--grid {spacing}: must be 1 px or more")
    if start not in store.frames:
        held = f"{store.frames[0]}..{store.frames[-1]}"
        raise UsageError(f"--start {start}: the results hold the frames {held}: choose one of them")
    stride = int(store.x[1] - store.x[0]) if store.x.size > 1 else 1
    every = 4 if spacing is None else max(1, spacing // stride)
    measured = np.isin(store.read("status", store.frames.index(start)), [c for c in HAS_VALUE if c != Status.COARSE])
    if not measured.any():
        raise InputError(f"{store.path}: frame {start} has no measured pixel: choose another --start")
    rows, cols = np.nonzero(measured[::every, ::every])
    if not rows.size:
        raise UsageError(f"--grid {spacing}: pixels so far apart miss all that is measured: choose less")
    return store.x[cols * every].astype(float), store.y[rows * every].astype(float)


def _read_points(path: Path) -> Points:
    """Columns x and y of a CSV file with a line of names; InputError for anything else."""
    import csv

    import numpy as np

    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
        found = np.array([(float(row["x"]), float(row["y"])) for row in rows])
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: no table of points: give a first line x,y and one position in px a line") from error
    if not found.size or not np.isfinite(found).all():
        raise InputError(f"{path}: {len(found)} points, not all finite: give at least one, and finite ones only")
    return found[:, 0], found[:, 1]


def _labelled(tracks: Tracks, store: ResultStore, path: Path) -> Tracks:
    """The tracks of the points on a label, with the ``label`` [n] of each."""
    import numpy as np

    from leafflow_ti.labels import Labels, looked_up

    image = Labels.of(path, store, tracks.start).image(0)
    at = tracks.start_index
    found = looked_up(image, np.stack([tracks.x[at], tracks.y[at]]))
    if not (found > 0).any():
        raise InputError(f"{path}: none of the points lies on a label: give points on the leaves, or a finer --grid")
    return tracks.chosen(found > 0).having({"label": found[found > 0]})


def format_tracks(tracks: Tracks, interval_s: float | None) -> list[str]:
    """How many points, how many were lost and why, drift, and growth of every region from the first frame to the
    last."""
    import numpy as np

    whole = int(tracks.known.all(axis=0).sum())
    first, last = tracks.frames[0], tracks.frames[-1]
    lines = [f"points      {tracks.n_points} from frame {tracks.start}, {whole} in all frames {first}..{last}"]
    lines += _losses(tracks)
    for k, where in ((0, "first"), (-1, "last")):
        drift = tracks.drift[k][tracks.known[k]]
        if drift.size and tracks.frames[k] != tracks.start:
            lines.append(
                f"drift       at most {np.median(drift):.4f} px to the {where} frame (median; 95 % of points: "
                f"{np.quantile(drift, 0.95):.4f} px)"
            )
    label = tracks.variables.get("label")
    groups = {"": np.ones(tracks.n_points, bool)}
    if label is not None:
        groups = {f"region {v}": label == v for v in np.unique(label)}
    for name, members in groups.items():
        lines += [f"{name:<12}{line}" for line in _growth(tracks.chosen(members), interval_s)]
    return lines


def _losses(tracks: Tracks) -> list[str]:
    """One line per reason for which points were lost."""
    import numpy as np

    from leafflow_ti.tracks import REASONS, TrackStatus

    lines = []
    for codes, way in ((tracks.status, "ahead"), (tracks.status_before, "back")):
        for code, count in zip(*np.unique(codes, return_counts=True), strict=True):
            if code != TrackStatus.TRACKED:
                lines.append(f"lost        {count} on the way {way}: {REASONS[TrackStatus(int(code))]}")
    return lines


def _growth(tracks: Tracks, interval_s: float | None) -> list[str]:
    """Median growth of the points from the start to either end, by every measure."""
    import numpy as np

    from leafflow_ti.rates import per_hour

    lines = []
    for k in (0, len(tracks.frames) - 1):
        span = int(tracks.frames[k] - tracks.start)
        for name, by in GROWTHS.items():
            values = tracks.variables.get(name)
            if span == 0 or values is None or not np.isfinite(values[k]).any():
                continue
            known = np.isfinite(values[k])
            growth = float(np.median(values[k][known]))
            unit, factor = per_hour("%/frame", interval_s)
            rate = 100 * float(np.log1p(growth / 100)) / span * factor
            std = tracks.variables.get(f"{name}_std")
            error = "" if std is None else f" ± {float(np.median(std[k][known])):.3g} (of a point)"
            lines.append(
                f"growth to frame {tracks.frames[k]} {growth:.4g} %{error} {by}, {rate:.4g} {unit}, "
                f"{int(known.sum())} points"
            )
    return lines
