"""The lenses of a capture, from the calibration files that it names, and the rectified camera that they share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from leafflow_ti.capture.calibration import WAY_OUT, Calibration, read_calibration
from leafflow_ti.capture.description import Camera
from leafflow_ti.capture.files import Reach
from leafflow_ti.capture.layout import Layout
from leafflow_ti.capture.lens import Lens
from leafflow_ti.errors import ConfigError

_SAME_PX = 1e-6
"""Up to which two statements of one length agree [px]."""


@dataclass(frozen=True, eq=False)
class Rectification:
    """``lenses`` for each camera row and column; all images become those of one pinhole camera."""

    lenses: tuple[tuple[Lens, ...], ...]
    f_px: float
    principal_px: tuple[float, float]


def find_rectification(path: Path, camera: Camera | None, layout: Layout, reach: Reach) -> Rectification | None:
    """Read the calibrations that the description ``path`` names; None if it names none.

    The rectified camera is that of the projection matrices, which must agree; without these the mean of all cameras.
    Raises InputError for files that cannot be read or lie outside, ConfigError for what is missing or contradictory.
    """
    pattern = camera.calibration_pattern if camera else None
    if camera is None or pattern is None:
        return None
    rows, cols = layout.values["sy"], layout.values["sx"]
    names = [[pattern.format({"sy": sy, "sx": sx}) for sx in cols] for sy in rows]
    found = {name: _read(reach, name, layout) for name in dict.fromkeys(n for line in names for n in line)}
    # Every camera counts, also where several share a file.
    f_px, principal = _pinhole([found[name] for line in names for name in line])
    _check_stated(path, camera, f_px, principal)
    lenses = tuple(tuple(Lens(found[name], f_px, principal) for name in line) for line in names)
    return Rectification(lenses, f_px, principal)


def _read(reach: Reach, name: str, layout: Layout) -> Calibration:
    path = reach.root / name
    reach.file(path, WAY_OUT)
    found, size = read_calibration(path), (layout.info.width, layout.info.height)
    if found.size not in (None, size):
        made, wanted = (f"{w} x {h}" for w, h in (found.size or size, size))
        raise ConfigError(f"{path}: made for images of {made} px, these have {wanted}: calibrate at this size")
    return found


def _pinhole(calibrations: list[Calibration]) -> tuple[float, tuple[float, float]]:
    stated = next((c for c in calibrations if c.projection is not None), None)
    if stated is not None:
        for one in calibrations:
            if one.projection is None or not np.allclose(one.projection, stated.pinhole, rtol=0, atol=_SAME_PX):
                raise ConfigError(
                    f"{one.path}: projection_matrix is not that of {stated.path}: rectify all cameras to the same one"
                )
    f, cx, cy = (float(value) for value in np.mean([c.pinhole for c in calibrations], axis=0))
    return f, (cx, cy)


def _check_stated(path: Path, camera: Camera, f_px: float, principal: tuple[float, float]) -> None:
    """What the description says beside the calibration must be the same."""
    said = [("focal length", camera.f_px, f_px)]
    if camera.principal_point_px is not None:
        pairs = zip("xy", camera.principal_point_px, principal, strict=True)
        said += [(f"principal point along {axis}", value, found) for axis, value, found in pairs]
    for name, value, found in said:
        if value is not None and abs(value - found) > _SAME_PX:
            raise ConfigError(
                f"{path}: [camera] {name} is {value:.10g} px, the calibration says {found:.10g}: leave it out, or "
                "correct it"
            )
