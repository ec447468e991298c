"""What a profile says: costs of the stages, what limits them, and the whole run."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from leafflow_ti.ceilings import Ceilings
from leafflow_ti.refine_plan import Effort


@dataclass(frozen=True)
class StageCost:
    """One stage for one unit in the middle of a sequence.

    ``seconds``; ``us_per_pixel`` of the unit; ``share`` of the time on the clock (stages beside the computing may hide
    behind it). Where the stage's work is counted: ``flops_per_pixel``, what it reached, ``gflops`` [10^9/s] and
    ``gbytes`` [10^9 bytes/s], and their shares of what the machine can do. ``limit``: "launches" where a single pixel
    takes half as long, else the ceiling that is nearer, "compute" or "memory"; "disk" or "decoding" beside the
    computing.
    """

    stage: str
    seconds: float
    us_per_pixel: float
    share: float
    limit: str
    flops_per_pixel: float | None = None
    gflops: float | None = None
    gbytes: float | None = None
    share_of_flops: float | None = None
    share_of_bytes: float | None = None


@dataclass(frozen=True)
class Prediction:
    """The whole run: ``frames`` of output, each in ``bands``, together ``units``; ``seconds``: with compiling.

    ``frames_read``: blocks of images that are read and filtered, those that fill the windows of each band included.
    """

    frames: int
    bands: int
    units: int
    frames_read: int
    seconds: float


@dataclass(frozen=True)
class Profile:
    """What was measured. ``unit``: rows and columns of output pixels; ``seconds_per_unit`` on the clock, in the middle
    of a sequence; ``fill_seconds``: for the frames that fill the windows before the first unit; ``overlap``: share of
    reading, decoding and writing that computing does not wait for, None where they cost nothing; ``planned_bytes`` of
    the arrays, ``peak_bytes`` of the process, measurement included (None where the system does not tell); ``effort`` of
    the refinement per output pixel, None without one.

    ``searched``: every frame is searched for what each of its pixels needs. A unit is then a whole frame, its work
    depends on what it shows and is not counted, and ``limit`` names the longest stage where it is not "disk" or
    "decoding".
    """

    model: str
    device: str
    unit: tuple[int, int]
    frames_measured: int
    compile_seconds: float
    seconds_per_unit: float
    pixels_per_second: float
    fill_seconds: float
    stages: tuple[StageCost, ...]
    limit: str
    overlap: float | None
    planned_bytes: int
    peak_bytes: int | None
    ceilings: Ceilings
    prediction: Prediction
    effort: Effort | None
    searched: bool = False

    def to_json(self) -> dict[str, Any]:
        """As JSON values; what is not known is null."""
        found: dict[str, Any] = _without_nan(asdict(self))
        return found


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(inner) for inner in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
