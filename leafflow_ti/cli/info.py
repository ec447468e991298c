"""``info``: what a capture or a results store is, for people or as JSON."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from leafflow_ti.cli.info_store import damage_lines, store_facts, store_lines
from leafflow_ti.cli.options import Outside
from leafflow_ti.errors import InputError, UsageError

if TYPE_CHECKING:
    from leafflow_ti.capture import FileCapture
    from leafflow_ti.results import ResultStore


def info(
    path: Annotated[Path, typer.Argument(metavar="CAPTURE|OUT.zarr", help="A capture.toml or its folder, or results.")],
    outside: Outside = False,
    verify: Annotated[bool, typer.Option("--verify", help="Read every file of a results store: is it whole?")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Say what a capture, or a results store, is: how it came about, and what is missing and why."""
    from leafflow_ti.unit_marks import FOLDER

    if not os.path.exists(path):  # noqa: PTH110 - Path.exists raises for names that are too long
        raise InputError(f"{path}: does not exist; give a capture.toml, a folder that holds one, or an OUT.zarr")
    if (path / "zarr.json").is_file() or (path / FOLDER).is_dir():
        from leafflow_ti.results import ResultStore

        store = ResultStore.open(path)
        if verify:
            check_files(store, as_json)
        facts = store_facts(store) | ({"damaged": []} if verify else {})
        lines = store_lines(facts)
    elif verify:
        raise UsageError(f"--verify reads the files of a results store; {path} is none")
    else:
        from leafflow_ti.capture import open_capture

        facts = capture_facts(open_capture(path, outside=outside))
        lines = [*_capture_lines(facts), *(f"warning      {doubt}" for doubt in facts["warnings"])]
    typer.echo(json.dumps(facts, indent=2, ensure_ascii=False) if as_json else "\n".join(lines))


def check_files(store: ResultStore, as_json: bool) -> None:
    """Read all files of a store; prints those that are damaged and raises InputError, if there are any."""
    from leafflow_ti.store_check import damaged

    found = damaged(store)
    if not found:
        return
    if as_json:
        facts = {"path": str(store.path), "damaged": [damage.to_json() for damage in found]}
        typer.echo(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        typer.echo("\n".join(damage_lines(found)))
    units = len({damage.unit for damage in found})
    raise InputError(
        f"{store.path}: {units} of {store.n_units} units are damaged; 'run --resume --verify' with the same capture "
        "and options computes them again"
    )


def capture_facts(capture: FileCapture) -> dict[str, Any]:
    """Files, grid, images, calibration and working distance of a capture, as JSON values."""
    facts: dict[str, Any] = {
        "path": str(capture.path),
        "files": len(capture.layout.paths),
        "frames": capture.n_frames,
        "grid": {"rows": capture.n_rows, "columns": capture.n_cols},
        "image": {
            "width_px": capture.width,
            "height_px": capture.height,
            "dtype": str(capture.dtype),
            "bits": capture.bits,
        },
        "frame_interval_s": capture.frame_interval_s,
        "bytes": capture.dtype.itemsize
        * capture.n_frames
        * capture.n_rows
        * capture.n_cols
        * capture.height
        * capture.width,
        "geometry": None,
        "working_distance": None,
    }
    if capture.stamps_s is not None and capture.frame_interval_s is not None:
        steps = [b - a for a, b in zip(capture.stamps_s, capture.stamps_s[1:], strict=False)]
        facts["steps_between_stamps_s"] = [min(steps, default=0.0), max(steps, default=0.0)]
    if capture.geometry is not None:
        g = capture.geometry
        facts["geometry"] = {
            "focal_length_px": g.f_px,
            "principal_point_px": list(g.principal_px),
            "baseline_mm": list(g.baseline_mm),
            "disparity_offset_px": list(g.disparity_offset_px),
            "calibration": capture.description.camera.calibration
            if capture.description and capture.description.camera
            else None,
        }
        if capture.positions_mm is not None:
            facts["geometry"]["largest_deviation_mm"] = _largest_deviation(capture)
        if capture.n_rows * capture.n_cols > 1:
            facts["working_distance"] = _working_distance(capture)
    facts["warnings"] = _doubts(capture, facts["working_distance"])
    return facts


def _doubts(capture: FileCapture, distance: dict[str, Any] | None) -> list[str]:
    """What a run would warn of, and a depth that can hardly be meant."""
    from leafflow_ti.capture import capture_doubts
    from leafflow_ti.capture.plausibility import depth_doubts

    seen = distance["preshift_px"] if distance else None
    return [*capture_doubts(capture), *(depth_doubts(capture, (seen[0], seen[1])) if seen else ())]


def _largest_deviation(capture: FileCapture) -> dict[str, Any]:
    """The camera that stands farthest from its nominal place: its row and column, and by how much along x and y, mm."""
    import numpy as np

    assert capture.geometry is not None
    assert capture.positions_mm is not None
    row0, col0 = capture.reference
    (bx, by), (rows, cols) = capture.geometry.baseline_mm, capture.positions_mm.shape[:2]
    nominal = np.stack(np.meshgrid((np.arange(cols) - col0) * bx, (np.arange(rows) - row0) * by), axis=-1)
    off = capture.positions_mm - nominal
    row, col = (int(i) for i in np.unravel_index(np.hypot(off[..., 0], off[..., 1]).argmax(), (rows, cols)))
    return {"row": row, "column": col, "xy": off[row, col].round(9).tolist()}


def _working_distance(capture: FileCapture) -> dict[str, Any]:
    """Preshift found in the images, whether it serves all they show, and the depths [mm] that it and one pixel more or
    less of disparity mean.

    Z = -f b / nu (Schuchert 2010, Eq. (6.13)), along the axis with the larger baseline.
    """
    from leafflow_ti.capture import UnclearDisparity, find_preshift, one_preshift_serves

    assert capture.geometry is not None
    try:
        preshift = find_preshift(capture)
    except InputError as error:
        searched = isinstance(error, UnclearDisparity)
        return {"preshift_px": None, "reason": str(error), "searched": searched}
    baselines = capture.geometry.baseline_mm
    axis = 0 if abs(baselines[0]) >= abs(baselines[1]) else 1
    lever = capture.geometry.f_px * abs(baselines[axis])
    total = abs(preshift[axis] + capture.geometry.disparity_offset_px[axis])
    return {
        "preshift_px": list(preshift),
        "serves_all": one_preshift_serves(capture, preshift, capture.n_frames > 1),
        "depth_mm": lever / total if total else None,
        "depth_one_pixel_nearer_mm": lever / (total + 1),
        "depth_one_pixel_farther_mm": lever / (total - 1) if total > 1 else None,
        "mm_per_px": lever / total**2 if total else None,
    }


def _capture_lines(facts: dict[str, Any]) -> list[str]:
    grid, image, geometry, distance = (facts[key] for key in ("grid", "image", "geometry", "working_distance"))
    cameras = grid["rows"] * grid["columns"]
    interval = "interval not stated" if facts["frame_interval_s"] is None else f"every {facts['frame_interval_s']:g} s"
    lines = [
        f"capture      {facts['path']}",
        f"cameras      {cameras} ({grid['rows']} row(s) x {grid['columns']} column(s))",
        f"frames       {facts['frames']}, {interval}",
        f"images       {facts['files']} file(s), {image['width_px']} x {image['height_px']} px, "
        f"{image['bits']} bit in {image['dtype']}, {facts['bytes'] / 2**20:.4g} MiB of pixels",
    ]
    if "steps_between_stamps_s" in facts:
        shortest, longest = facts["steps_between_stamps_s"]
        lines.append(f"stamps       measured; steps from {shortest:g} to {longest:g} s")
    if geometry is None:
        return [*lines, "geometry     not calibrated: optical flow in pixels only"]
    lines += [
        f"geometry     focal length {geometry['focal_length_px']:g} px, "
        f"principal point {_pair(geometry['principal_point_px'])} px",
        f"grid step    {_pair(geometry['baseline_mm'])} mm (x, y)",
    ]
    if "largest_deviation_mm" in geometry:
        most = geometry["largest_deviation_mm"]
        lines.append(
            f"positions    measured; farthest from its nominal place: camera row {most['row']}, column "
            f"{most['column']}, by {_pair(most['xy'])} mm (x, y)"
        )
    if geometry["calibration"]:
        lines.append(
            f"calibration  {geometry['calibration']}: images are undistorted and rectified while they are read"
        )
    if any(geometry["disparity_offset_px"]):
        lines.append(
            f"offset       {_pair(geometry['disparity_offset_px'])} px of disparity per step, added to what is seen"
        )
    if distance is not None and distance["preshift_px"] is None:
        instead = "; left out (--preshift auto), every frame is searched pixel by pixel" if distance["searched"] else ""
        lines.append(f"distance     unknown: {distance['reason']}{instead}")
    elif distance is not None:
        lines.append(f"preshift     {_pair(distance['preshift_px'])} px per step, found in the images")
        farther = distance["depth_one_pixel_farther_mm"]
        if distance["depth_mm"] is not None:
            lines.append(
                f"depth        {distance['depth_mm']:.5g} mm at this preshift; "
                f"1 px of disparity is {distance['mm_per_px']:.4g} mm"
            )
        if not distance["serves_all"]:
            lines.append(
                "             it does not fit all that the images show, or motions exceed a pixel: --preshift auto "
                "searches every frame"
            )
        lines.append(
            f"depth range  {distance['depth_one_pixel_nearer_mm']:.5g} mm to "
            f"{'infinity' if farther is None else f'{farther:.5g} mm'} within 1 px of disparity"
        )
    return lines


def _pair(values: list[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)
