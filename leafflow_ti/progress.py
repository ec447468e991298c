"""What a run tells while it works and when it ends: plain values, nothing imported."""

from __future__ import annotations

from dataclasses import dataclass


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


@dataclass(frozen=True, slots=True)
class RunSummary:
    """What a finished run was: seconds (wall clock), device, pixels per status name, seconds per stage, path."""

    seconds: float
    compile_seconds: float
    device: str
    status_counts: dict[str, int]
    stage_seconds: dict[str, float]
    path: str
