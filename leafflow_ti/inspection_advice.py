"""What the numbers of an inspection mean, in plain words, and what to change."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from leafflow_ti.capture import Capture
from leafflow_ti.inspection_report import Advice, Report
from leafflow_ti.positions import Positions

SURE = 5.0
"""Standard errors from which a deviation is taken for one."""
LEAST_MISPLACED_PX = 0.01
"""Deviation of a camera, in the image, that is worth a word."""
LEAST_GAIN, LEAST_SATURATED, MOST_SATURATED = 0.01, 1e-3, 1e-2
LEAST_SHARE, FAIR_SHARE = 0.5, 0.9
"""Share of windows with texture below which measuring makes no sense; below which much is lost."""
LEAST_CONTRAST = 5.0
"""Contrast of the texture, in standard deviations of the noise."""
ONE_PASS_PX = 2.0
"""Range of disparities that one preshift covers [px/step]."""
SLOW_PX = 1.0
"""Motion that filters along time follow [px/frame]."""
WIDEST = 0.25
"""Displacement of the outermost camera, as a share of the image, beyond which little is seen by all."""


def advice(found: Report, capture: Capture, places: Positions | None) -> tuple[Advice, ...]:
    """What the numbers mean, problems first."""
    every = [*_about_light(found), *_about_texture(found), *_about_ranges(found, capture)]
    if places is not None:
        every += _about_positions(found, places)
    elif len(found.cameras) > 2 and capture.geometry is not None:
        every.append(
            Advice("hint", "too few points are seen by all cameras to say whether these stand where they should")
        )
    return tuple(sorted(every, key=lambda one: one.kind != "problem"))


def _about_positions(found: Report, places: Positions) -> Iterator[Advice]:
    for camera in found.cameras:
        if camera.off_um is None or camera.off_error_um is None:
            continue
        for axis, off, error in zip("xy", camera.off_um, camera.off_error_um, strict=True):
            shift = 1e-3 * abs(off) * places.px_per_mm
            if abs(off) > SURE * error and shift > LEAST_MISPLACED_PX:
                yield Advice(
                    "problem",
                    f"camera (row {camera.row}, column {camera.col}) stands {off:.1f} ± {error:.1f} µm off along "
                    f"{axis}, {shift:.2f} px in the image: paste the line positions_mm below [grid], or "
                    "correct the stage",
                )
    if found.turn_mrad is not None:
        turn, error = found.turn_mrad
        reach = float(np.nanmax(np.abs(places.measured_mm))) * places.px_per_mm
        if abs(turn) > SURE * error and 1e-3 * abs(turn) * reach > 0.05:
            yield Advice(
                "problem",
                f"the line of cameras is turned by {turn:.2f} ± {error:.2f} mrad against the rows of the images, "
                f"{1e-3 * abs(turn) * reach:.2f} px at the outermost: paste the line positions_mm below [grid]",
            )
    for camera in found.cameras:
        if camera.roll_mrad is not None and abs(camera.roll_mrad[0]) > max(SURE * camera.roll_mrad[1], 0.1):
            yield Advice(
                "problem",
                f"camera (row {camera.row}, column {camera.col}) is turned about its axis by "
                f"{camera.roll_mrad[0]:.2f} ± {camera.roll_mrad[1]:.2f} mrad: calibrate, with a "
                "rectification_matrix of its own",
            )


def _about_light(found: Report) -> Iterator[Advice]:
    worst = max(found.cameras, key=lambda camera: camera.saturated)
    if worst.saturated > LEAST_SATURATED:
        yield Advice(
            "problem" if worst.saturated > MOST_SATURATED else "hint",
            f"{worst.saturated:.1%} of the pixels of camera (row {worst.row}, column {worst.col}) are saturated: lower "
            "the exposure or the light",
        )
    unequal = [c for c in found.cameras if c.gain is not None and c.gain_error is not None
               and abs(c.gain - 1) > max(LEAST_GAIN, SURE * c.gain_error)]  # fmt: skip
    if unequal:
        one = max(unequal, key=lambda camera: abs(float(camera.gain or 1) - 1))
        yield Advice(
            "hint",
            f"{len(unequal)} camera(s) differ in gain, most of all (row {one.row}, column {one.col}) by "
            f"{float(one.gain or 1) - 1:+.1%}: use --brightness camera, or --prefilter homomorphic",
        )
    change = max((abs(gain - 1) for gain in found.frame_gains.values()), default=0.0)
    if change > LEAST_GAIN:
        yield Advice(
            "hint",
            f"brightness changes by up to {change:.1%} between frames: use --brightness temporal, or a steady light",
        )
    if found.defects:
        row, col = found.defects[0]
        yield Advice(
            "hint",
            f"{len(found.defects)} pixel(s) do not follow the scene, the first at x = {col}, y = {row}: leave them out "
            "with --mask, or replace them before",
        )


def _about_texture(found: Report) -> Iterator[Advice]:
    texture = found.texture
    if texture.contrast < LEAST_CONTRAST * found.noise:
        yield Advice(
            "problem" if texture.contrast < found.noise else "hint",
            f"the texture's contrast of {texture.contrast:.1f} is only {texture.contrast / found.noise:.1f} times the "
            f"noise of {found.noise:.2f}: more light, longer or averaged exposures, or a projected pattern",
        )
    if texture.share < FAIR_SHARE:
        yield Advice(
            "problem" if texture.share < LEAST_SHARE else "hint",
            f"windows of {texture.window} px hold too little texture in {1 - texture.share:.0%} of the image: choose "
            "larger windows, a mask, or give the surface a texture",
        )


def _about_ranges(found: Report, capture: Capture) -> Iterator[Advice]:
    if found.disparity_px is not None:
        low, high = found.disparity_px
        if high - low > ONE_PASS_PX:
            yield Advice(
                "hint",
                f"disparities span {low:.1f} to {high:.1f} px per step, more than one preshift covers: --preshift auto "
                "computes several passes",
            )
        steps = max(capture.n_cols, capture.n_rows) // 2
        most = steps * max(abs(low), abs(high))
        size = capture.width if capture.n_cols >= capture.n_rows else capture.height
        if most > WIDEST * size:
            yield Advice(
                "problem",
                f"the outermost camera sees points {most:.0f} px away, of {size}: little of the scene is in all "
                "images; move the cameras closer together, or use fewer",
            )
    if found.motion_px is not None and found.motion_px > SLOW_PX:
        yield Advice(
            "hint",
            f"motions reach {found.motion_px:.1f} px per frame, more than filters along time follow: --preshift auto "
            "takes whole pixels out; a shorter interval is better",
        )
