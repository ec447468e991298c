"""Where a camera and an output grid lie in the image."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class View:
    """Camera and output grid of one band: pixel (row, col) lies at (x + step col, y + step row)."""

    f_px: float
    principal_px: tuple[float, float]
    baseline_mm: tuple[float, float]
    shift_px: tuple[float, float]
    x: int
    y: int
    step: int
    rows: int
    cols: int
    pitch: int
    motion_px: tuple[float, float] = (0.0, 0.0)
    """Motion per frame that the images were shifted by, as ``shift_px`` is disparity."""
