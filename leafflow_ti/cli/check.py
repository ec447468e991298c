"""``check``: whether a capture can be measured, and what to change."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from leafflow_ti.cli.options import Outside

if TYPE_CHECKING:
    from leafflow_ti.inspection_report import CameraCheck, Report

PROBLEMS = 4
"""Exit code where there are problems: that of input that does not do."""


def check(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="capture.toml, or the folder that holds it.")],
    outside: Outside = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Estimate position errors of the cameras, brightness, noise, saturation, texture, disparities and motions.

    Says what will not work and what to change. Exit code 0: fine, or hints only; 4: problems.
    """
    from leafflow_ti.capture import open_capture
    from leafflow_ti.inspection import check as look

    found = look(open_capture(capture, outside=outside))
    typer.echo(json.dumps(found.to_json(), indent=2) if as_json else "\n".join(format_report(found)))
    if not found.fine:
        raise typer.Exit(PROBLEMS)


def format_report(found: Report) -> list[str]:
    """The cameras as a table, the rest in lines, then what to do."""
    texture = found.texture
    lines = ["camera       off x, y [µm]                      roll [mrad]      gain   offset   noise  saturated"]
    lines += [_camera_line(camera) for camera in found.cameras]
    if found.residual_px is not None:
        lines.append(f"points       {found.points}, each found to {found.residual_px:.4f} px")
    if found.turn_mrad is not None:
        lines.append(f"turn         {found.turn_mrad[0]:.3f} ± {found.turn_mrad[1]:.3f} mrad, of the line of cameras")
    gains = ", ".join(f"{t}: {gain:.3f}" for t, gain in found.frame_gains.items())
    lines += [
        f"frames       brightness {gains}",
        f"noise        {found.noise:.3g} grey values",
        f"texture      {texture.share:.0%} of the windows of {texture.window} px hold enough; contrast "
        f"{texture.contrast:.3g} grey values, typical wavelength {texture.wavelength_px:.3g} px",
        f"defects      {len(found.defects)} pixel(s)",
    ]
    if found.disparity_px is not None:
        lines.append(f"disparity    {found.disparity_px[0]:.2f} to {found.disparity_px[1]:.2f} px per step")
    if found.motion_px is not None:
        lines.append(f"motion       up to {found.motion_px:.2f} px per frame")
    lines += [f"{one.kind:<12} {one.text}" for one in found.advice] or ["fine         nothing to change"]
    if found.positions_line is not None and any("positions_mm" in one.text for one in found.advice):
        lines += ["[grid]", found.positions_line]
    return lines


def _camera_line(camera: CameraCheck) -> str:
    name = f"{camera.row}, {camera.col}"
    off = "unknown"
    if camera.off_um is not None and camera.off_error_um is not None:
        off = ", ".join(
            f"{value:.2f} ± {error:.2f}" for value, error in zip(camera.off_um, camera.off_error_um, strict=True)
        )
    roll = "" if camera.roll_mrad is None else f"{camera.roll_mrad[0]:.3f} ± {camera.roll_mrad[1]:.3f}"
    gain = "" if camera.gain is None else f"{camera.gain:.4f}"
    offset = "" if camera.offset is None else f"{camera.offset:.2f}"
    return f"  {name:<10} {off:<34} {roll:<16} {gain:<6} {offset:>7} {camera.noise:>7.3g} {camera.saturated:>9.2%}"
