"""Calibrations that are possible but hardly meant: lengths in another unit, a principal point beside the image.

Nothing is refused here. Each doubt is one line: the value, what is plausible, what was probably meant.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from leafflow_ti.capture.capture import Capture
from leafflow_ti.capture.sources import FileCapture

FIELD_OF_VIEW = (0.1, 140.0)
"""Degrees along the longer side: from a part of a tele lens' image to the widest lens that keeps lines straight."""
PIXEL_PITCH_MM = (0.0004, 0.1)
"""From the finest sensors of telephones to the coarsest thermal ones."""
DEPTH_MM = (5.0, 1e5)
"""From a macro lens to a crop seen from a crane."""
SEEN_PX = 0.05
"""Disparity per step [px] below which no depth is measured."""
INTERVAL_S = (1e-7, 7 * 86400.0)
"""From the fastest cameras to weekly photographs."""
SQUARE = 0.05
"""Difference of the two focal lengths of a calibration, relative: pixels are squares."""
_UNITS = {60.0: "minutes", 3600.0: "hours", 86400.0: "days"}
"""Seconds of what an interval may have been given in; not of shorter ones: copies are written quickly."""
_STEADY = 0.1
"""Scatter, relative, of the times between files that follow a clock; and by how much they may miss a unit."""


def plausibility(capture: Capture) -> list[str]:
    """Doubts about the calibration and the times of a capture, from what is stated alone: no image is read."""
    camera = [*_of_camera(capture), *_of_lenses(capture)]
    return [*camera, *([] if camera else _of_grid(capture)), *_of_time(capture)]  # depths follow from both


def depth_doubts(capture: Capture, disparity_px: tuple[float, float]) -> list[str]:
    """Doubts about the depth that a disparity (x, y) [px/step] seen in the images stands for."""
    g = capture.geometry
    if g is None:
        return []
    axis = 0 if abs(g.baseline_mm[0]) >= abs(g.baseline_mm[1]) else 1
    total = abs(disparity_px[axis] + g.disparity_offset_px[axis])
    if not g.baseline_mm[axis] or total < SEEN_PX:
        return []
    depth = g.f_px * abs(g.baseline_mm[axis]) / total
    if DEPTH_MM[0] <= depth <= DEPTH_MM[1]:
        return []
    return [
        f"the images show {total:.3g} px of disparity per step, which is {_length(depth)} of depth; "
        f"{_length(DEPTH_MM[0])} to {_length(DEPTH_MM[1])} are plausible: is [grid] baseline_mm = "
        f"{g.baseline_mm[axis]:g} in mm?"
    ]


def _of_camera(capture: Capture) -> Iterator[str]:
    g = capture.geometry
    if g is None:
        return
    camera = capture.description.camera if capture.description else None
    pitch = camera.pixel_pitch_mm if camera else None
    side = max(capture.width, capture.height)
    angle = math.degrees(2 * math.atan(side / 2 / g.f_px))
    if pitch is not None and not PIXEL_PITCH_MM[0] <= pitch <= PIXEL_PITCH_MM[1]:
        mm, unit = (1e-3 * pitch, "µm") if pitch > PIXEL_PITCH_MM[1] else (1e3 * pitch, "m")
        yield (
            f"[camera] pixel_pitch_mm = {pitch:g}; {PIXEL_PITCH_MM[0]:g} to {PIXEL_PITCH_MM[1]:g} mm are plausible: is "
            f"it in {unit}? then {mm:g}"
        )
    elif not FIELD_OF_VIEW[0] <= angle <= FIELD_OF_VIEW[1]:
        meant = (
            "is it in mm? then focal_length_mm and pixel_pitch_mm" if angle > FIELD_OF_VIEW[1] else "is it in pixels?"
        )
        yield (
            f"[camera] a focal length of {g.f_px:g} px sees {angle:.3g}° with {side} px; {FIELD_OF_VIEW[0]:g}° to "
            f"{FIELD_OF_VIEW[1]:g}° are plausible: {meant}"
        )
    for axis, at, count in zip("xy", g.principal_px, (capture.width, capture.height), strict=True):
        if not -0.5 <= at <= count - 0.5:
            yield (
                f"[camera] the principal point is at {axis} = {at:g} px, beside an image of {count} px: is it that of "
                "another image size, or in mm?"
            )


def _of_lenses(capture: Capture) -> Iterator[str]:
    width, height = capture.width, capture.height
    u, v = np.array([0.0, width - 1.0, 0.0, width - 1.0]), np.array([0.0, 0.0, height - 1.0, height - 1.0])
    calibrations = {lens.calibration.path: lens for row in capture.lenses or () for lens in row}
    for path, lens in calibrations.items():
        fx, fy = lens.calibration.matrix[0, 0], lens.calibration.matrix[1, 1]
        if abs(fx - fy) > SQUARE * max(fx, fy):
            yield f"{path}: focal lengths of {fx:g} and {fy:g} px: pixels are mostly square, are they mixed up?"
        x, y = lens.source(u, v)
        off = np.hypot(x - u, y - v)
        if not (off < max(width, height) / 2).all():
            moved = "beyond what the lens model reaches" if not np.isfinite(off).all() else f"by {off.max():.4g} px"
            yield (
                f"{path}: its distortion or rotation moves a corner of the image {moved}, more than half of its side: "
                "is it the calibration of these images?"
            )


def _of_grid(capture: Capture) -> Iterator[str]:
    g = capture.geometry
    if g is None:
        return
    for axis, step, offset, count in zip(
        "xy", g.baseline_mm, g.disparity_offset_px, (capture.width, capture.height), strict=True
    ):
        if not step:
            continue
        nearest, farthest = g.f_px * abs(step) / count, g.f_px * abs(step) / SEEN_PX
        if farthest < DEPTH_MM[0] or nearest > DEPTH_MM[1]:
            yield (
                f"[grid] baseline_mm = {step:g} along {axis}: with the focal length of {g.f_px:g} px depths from "
                f"{_length(nearest)} to {_length(farthest)} could be seen; {_length(DEPTH_MM[0])} to "
                f"{_length(DEPTH_MM[1])} are plausible: is it in mm?"
            )
        if offset * step > 0:
            yield (
                f"[grid] disparity_offset_px = {offset:g} along {axis} has the sign of baseline_mm: for images that "
                f"were shifted towards each other it is {-offset:g}"
            )


def _of_time(capture: Capture) -> Iterator[str]:
    interval = capture.frame_interval_s
    if interval is None:
        return
    if not INTERVAL_S[0] <= interval <= INTERVAL_S[1]:
        low, high = INTERVAL_S
        yield f"[time] the interval is {interval:g} s; {low:g} to {high:g} s are plausible: is it in s?"
        return
    written = _interval_of_files(capture)
    if written is None:
        return
    for factor, unit in _UNITS.items():
        if abs(written / (interval * factor) - 1) < _STEADY:
            yield (
                f"[time] the interval is {interval:g} s, the files were written every {written:g} s: is it in {unit}? "
                f"then interval_s = {interval * factor:g}"
            )


def _interval_of_files(capture: Capture) -> float | None:
    """Median time between the files of successive frames [s]; None where these do not follow a clock: copies, and files
    that hold several frames."""
    if not isinstance(capture, FileCapture) or capture.n_frames < 4:
        return None
    row, col = capture.reference
    files = capture.layout.file[:, row, col]
    if len(set(files.tolist())) != capture.n_frames:
        return None
    steps = np.diff([capture.layout.states[index].mtime_ns for index in files]) * 1e-9
    median = float(np.median(steps))
    if median <= 0 or np.median(np.abs(steps - median)) > _STEADY * median:
        return None
    return median


def _length(mm: float) -> str:
    return f"{mm / 1000:.3g} m" if mm >= 1000 else f"{mm:.3g} mm"
