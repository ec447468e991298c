"""A run's work on its results store: what is computed, written down about it, and said at the end."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator

from leafflow_ti.errors import PartlyDone, RunError
from leafflow_ti.events import event
from leafflow_ti.executors import Executor
from leafflow_ti.field import status_counts
from leafflow_ti.number_text import spans
from leafflow_ti.plan import Plan
from leafflow_ti.progress import Progress, RunSummary, Timings, add_seconds
from leafflow_ti.results import ResultStore
from leafflow_ti.run_store import Record, missing_units
from leafflow_ti.schedule import Missing, Schedule

RECORD_S = 5.0
"""Seconds between two records of how far a run is."""


class _Stopped(BaseException):
    """The caller's function for the progress has failed: that is no failure of a unit."""

    def __init__(self, error: Exception) -> None:
        super().__init__(error)
        self.error = error


class Filling:
    """Fills a store, in one round or, while frames arrive, in several.

    ``progress`` is called after every unit; ``said``: warnings of the run so far; ``began``: when it did, by
    ``time.perf_counter``. ``missing``: units that were given up, by number.
    """

    def __init__(
        self, executor: Executor, progress: Callable[[Progress], None] | None, said: list[str], began: float
    ) -> None:
        self._executor, self._progress, self._said, self._began = executor, progress, said, began
        self._record = Record.begin(executor.label, time.perf_counter() - began)
        self._recorded = began
        self._stages: dict[str, float] = {}
        self._done = self._pixels = 0
        self._frames = 0.0
        self._computing: float | None = None
        self._todo: dict[int, int] = {}
        self._plan: Plan
        self._store: ResultStore
        self.missing: dict[int, Missing] = {}
        self._had = False

    @contextlib.contextmanager
    def recorded(self, store: ResultStore) -> Iterator[None]:
        """Write down how the block ended, whatever that was; an error of the block is not hidden by one of that."""
        self._store = store
        self._had = bool(store.done())
        try:
            yield
        except BaseException as error:
            with contextlib.suppress(RunError):
                self._write_record("interrupted" if isinstance(error, KeyboardInterrupt) else "stopped by an error")
            raise
        self._write_record("partly done" if self.missing else "done")

    def fill(self, plan: Plan, store: ResultStore, part: list[int], resumed: bool) -> None:
        """Compute what is not done of some units; raises what stops all of them.

        ``resumed``: others have worked at them, and may have been killed.
        """
        self._plan, self._store = plan, store
        done = store.done()
        left = [unit for unit in part if unit not in done]
        self._todo = {unit: len(plan.y[plan.band(unit % plan.bands)]) * len(plan.x) for unit in left}
        self._total = self._done + len(left), self._pixels + sum(self._todo.values())
        for unit in left:
            self.missing.pop(unit, None)
        fill = 0 if plan.adaptive else sum(plan.around)  # there, every frame reads those around it anew
        schedule = Schedule(_sequences(plan, left), self._unit_done, self._executor.workers, fill)
        event("run", f"{len(left)} of {len(part)} units are to be computed: {self._executor.label}, "
              f"{self._executor.device}", units=len(left), config=plan.config.to_toml())  # fmt: skip
        self._computing = self._computing or time.perf_counter()
        try:
            if left:
                self._executor.work(schedule, store)
        except _Stopped as stopped:
            raise stopped.error from None
        finally:
            self.missing |= {m.unit: m for m in schedule.missing}
        if resumed or schedule.disturbed:
            store.remove_scratch(part)

    def use(self, executor: Executor) -> None:
        """Go on with another executor, the one so far having ended its work."""
        self._stages, self._executor = self._timings.stages, executor

    def summary(self) -> RunSummary:
        """What the run was; raises PartlyDone where units are missing, or, if nothing at all is done, their error."""
        if self.missing:
            raise self._partly_done() if self._had or self._done else next(iter(self.missing.values())).failure.error()
        now, counts = self._timings, dict[str, int]()
        for t in sorted({unit // self._plan.bands for unit in self._store.done()}):
            for name, n in status_counts(self._store.read("status", t)).items():
                counts[name] = counts.get(name, 0) + n
        event("finished", f"{self._done} units in {now.seconds:.1f} s", units=self._done, seconds=now.seconds,
              status=counts)  # fmt: skip
        compiling = self._executor.compile_seconds
        return RunSummary(now.seconds, compiling, self._executor.device, counts, now.stages, str(self._store.path))

    @property
    def _timings(self) -> Timings:
        stages = dict(self._stages)
        add_seconds(stages, self._executor.seconds)
        seconds, device = time.perf_counter() - self._began, self._executor.device
        return Timings(seconds, stages, self._done, self._pixels, self._frames, 1, device)

    def _unit_done(self, unit: int) -> None:
        self._done, self._pixels = self._done + 1, self._pixels + self._todo[unit]
        self._frames = self._done / self._plan.bands
        now = time.perf_counter()
        event("unit", f"unit {unit} is done", unit=unit, frame=self._plan.frames[unit // self._plan.bands])
        if now - self._recorded > RECORD_S:
            self._recorded = now
            self._write_record("")
        if self._progress and self._computing is not None:
            state = Progress(self._done, self._total[0], self._pixels, self._total[1], now - self._computing)
            try:
                self._progress(state)
            except Exception as error:
                raise _Stopped(error) from error

    def _write_record(self, ended: str) -> None:
        missing = missing_units(self._plan, list(self.missing.values())) if self.missing else []
        self._record.write(self._store, self._timings, self._said, missing, ended)

    def _partly_done(self) -> PartlyDone:
        frames = sorted({self._plan.frames[unit // self._plan.bands] for unit in self.missing})
        reasons = dict.fromkeys(m.failure.message for m in self.missing.values())
        more = f" (and {len(reasons) - 1} other reasons)" if len(reasons) > 1 else ""
        return PartlyDone(
            f"{len(self.missing)} of {self._store.n_units} units are missing in {self._store.path}, of frames "
            f"{spans(frames)}: {next(iter(reasons))}{more}; mend that, then run again with --resume"
        )


def _sequences(plan: Plan, units: list[int]) -> Iterator[list[int]]:
    """Units that follow each other: frames of a band, or bands of a frame."""

    def follows(unit: int, last: int) -> bool:
        return unit // plan.bands == last // plan.bands if plan.adaptive else unit == last + plan.bands

    sequence: list[int] = []
    for unit in units:
        if sequence and not follows(unit, sequence[-1]):
            yield sequence
            sequence = []
        sequence.append(unit)
    if sequence:
        yield sequence
