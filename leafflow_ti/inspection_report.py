"""What an inspection of a capture says: numbers with their standard errors, and sentences."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

from leafflow_ti.photometry import Texture


@dataclass(frozen=True)
class Advice:
    """``problem``: results will suffer or be missing; ``hint``: good to know."""

    kind: Literal["problem", "hint"]
    text: str


@dataclass(frozen=True)
class CameraCheck:
    """One camera of the grid: ``row``, ``col``; ``off_um`` and its error [µm] from where it is said to stand, (x, y),
    None where it cannot be told; ``roll_mrad`` against the reference; ``gain`` and ``offset`` of its grey values
    against those of the reference; ``noise`` and share of ``saturated`` pixels."""

    row: int
    col: int
    off_um: tuple[float, float] | None
    off_error_um: tuple[float, float] | None
    roll_mrad: tuple[float, float] | None
    gain: float | None
    gain_error: float | None
    offset: float | None
    noise: float
    saturated: float


@dataclass(frozen=True)
class Report:
    """What was found.

    ``cameras`` in the order of the grid; ``positions_mm`` of all of them, as ``[grid] positions_mm`` takes them, None
    where too few points were found; ``turn_mrad``: value and error of the angle by which the grid's line is turned
    against the rows of the images; ``residual_px``: scatter of single points. ``frame_gains``: grey values of some
    frames of the reference camera, relative to the middle one. ``noise``, ``texture``: of the reference camera's middle
    frame. ``defects``: rows and columns of pixels that do not work. ``disparity_px`` (lowest, highest) per step and
    ``motion_px`` (largest) per frame, in 98 % of the image; None without cameras or time.
    """

    cameras: tuple[CameraCheck, ...]
    positions_mm: tuple[tuple[float, float], ...] | None
    turn_mrad: tuple[float, float] | None
    residual_px: float | None
    points: int
    frame_gains: dict[int, float]
    noise: float
    texture: Texture
    defects: tuple[tuple[int, int], ...]
    disparity_px: tuple[float, float] | None
    motion_px: float | None
    advice: tuple[Advice, ...]

    @property
    def fine(self) -> bool:
        """Whether there is no problem."""
        return all(one.kind != "problem" for one in self.advice)

    @property
    def positions_line(self) -> str | None:
        """``positions_mm = [...]``, to be pasted below ``[grid]``."""
        if self.positions_mm is None:
            return None
        rounded = [[round(value, 5) + 0.0 for value in pair] for pair in self.positions_mm]  # + 0.0: no -0.0
        return f"positions_mm = {rounded}"

    def to_json(self) -> dict[str, Any]:
        """All values, those that are not finite as None."""
        return {**_plain(asdict(self)), "fine": self.fine, "positions_line": self.positions_line}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
