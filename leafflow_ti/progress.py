"""What a run tells while it works and when it ends: plain values, nothing imported."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Self


@dataclass(frozen=True, slots=True)
class Progress:
    """State of a run after a unit was finished; ``seconds`` count from the start of this run.

    Units that an earlier, interrupted run had finished are not counted: the totals are what this run has to do.
    """

    done_units: int
    total_units: int
    pixels_done: int
    pixels_total: int
    seconds: float

    @property
    def pixels_per_second(self) -> float | None:
        """Output pixels per second so far; None before anything is measured."""
        return self.pixels_done / self.seconds if self.pixels_done and self.seconds > 0 else None

    @property
    def seconds_left(self) -> float | None:
        """Estimated time left [s] at the mean speed so far; None before anything is measured."""
        rate = self.pixels_per_second
        return None if rate is None else (self.pixels_total - self.pixels_done) / rate


def add_seconds(total: dict[str, float], more: Mapping[str, float]) -> None:
    """Add seconds per stage to those that are known."""
    for stage, seconds in more.items():
        total[stage] = total.get(stage, 0.0) + seconds


@dataclass(frozen=True, slots=True)
class Timings:
    """What units have cost: ``seconds`` on the clock and per stage, all runs that worked on a results store together.

    ``stages``: those of ``trace.STAGES``; what happens beside the computing (reading, decoding, writing) overlaps it
    and waits between two steps while kernels run, so that the stages' sum may exceed ``seconds``. ``units`` and
    ``pixels`` are those that the seconds belong to, so that a run that was killed does not spoil the speed.
    ``frames``: ``units`` in whole frames. ``device``: of the latest run.
    """

    seconds: float = 0.0
    stages: dict[str, float] = field(default_factory=dict)
    units: int = 0
    pixels: int = 0
    frames: float = 0.0
    runs: int = 0
    device: str = ""

    @property
    def pixels_per_second(self) -> float:
        """Output pixels per second on the clock, compiling included; 0 before anything is measured."""
        return self.pixels / self.seconds if self.seconds > 0 else 0.0

    def __add__(self, later: Timings) -> Timings:
        stages = dict(self.stages)
        add_seconds(stages, later.stages)
        return Timings(
            self.seconds + later.seconds, stages, self.units + later.units, self.pixels + later.pixels,
            self.frames + later.frames, self.runs + later.runs, later.device or self.device,
        )  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """As an attribute of a results store."""
        return {**asdict(self), "pixels_per_second": self.pixels_per_second}

    @classmethod
    def of(cls, attribute: dict[str, Any] | None) -> Self:
        """From that attribute; nothing measured where there is none."""
        return cls(**{k: v for k, v in (attribute or {}).items() if k != "pixels_per_second"})


@dataclass(frozen=True, slots=True)
class RunSummary:
    """What a finished run was: seconds (wall clock), device, pixels per status name, seconds per stage, path.

    The seconds are those of this run alone; the results store holds those of all runs that worked on it.
    """

    seconds: float
    compile_seconds: float
    device: str
    status_counts: dict[str, int]
    stage_seconds: dict[str, float]
    path: str
