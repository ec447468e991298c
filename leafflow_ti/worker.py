"""What computes units of a run and writes them into its store: the same in every process, on every machine."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.background import Behind
from leafflow_ti.bands import WRITE_BEHIND
from leafflow_ti.capture import Capture, open_capture
from leafflow_ti.config import RunConfig
from leafflow_ti.errors import ConfigError, RunError
from leafflow_ti.pipeline import Pipeline
from leafflow_ti.plan import Plan, Unit, make_plan
from leafflow_ti.provenance import differences, provenance
from leafflow_ti.results import ResultStore
from leafflow_ti.runtime import Device, start, usable_threads
from leafflow_ti.stays import Maps
from leafflow_ti.trace import active, span


@dataclass(frozen=True)
class Job:
    """A run as text, for workers in other processes: capture and results store by their absolute paths, and the
    configuration as TOML, with the height of the bands and one worker's share of the machine decided; ``outside``: as
    of ``open_capture``."""

    capture: str
    out: str
    config: str
    outside: bool = False

    def to_json(self) -> str:
        """On one line."""
        return json.dumps(asdict(self))

    @classmethod
    def of(cls, plan: Plan, capture: Capture, out: str | Path, threads: int | None = None) -> Self:
        """What a plan wants done; ConfigError for images in memory, which other processes do not see.

        ``threads``: of a worker, None: as the plan has it.
        """
        if capture.path is None:
            raise ConfigError(
                "images in memory cannot be shared with other processes: leave plan.workers at 1, or write them as "
                "files with a capture.toml"
            )
        decided = {"tile": plan.band_rows} | ({} if threads is None else {"threads": threads})
        config = plan.config.model_copy(update={"plan": plan.config.plan.model_copy(update=decided)})
        return cls(str(capture.path.absolute()), str(Path(out).absolute()), config.to_toml(), capture.outside)

    @classmethod
    def of_json(cls, text: str) -> Self:
        """From that."""
        return cls(**json.loads(text))


class Worker:
    """Computes units of a plan on the device that its configuration asks for, and writes them into a results store.

    Making it starts the device. Raises DeviceError, ConfigError for a mask that does not fit.
    """

    def __init__(self, plan: Plan, capture: Capture) -> None:
        capture.keep_decoded(plan.cache_bytes)
        self.plan, self.capture, self.device = plan, capture, start_device(plan.config)
        self._pipeline = Pipeline(plan, capture, self.device)

    @classmethod
    def of(cls, job: Job) -> Self:
        """In a process of its own; raises what opening and planning raise, too."""
        capture = open_capture(job.capture, outside=job.outside)
        return cls(make_plan(capture, RunConfig.model_validate(tomllib.loads(job.config))), capture)

    def open(self, out: str | Path) -> ResultStore:
        """The store of the run; RunError where it is not made for what this worker sees."""
        store = ResultStore.open(out)
        changed = differences(store.attrs, provenance(self.plan, self.capture))
        if changed:
            raise RunError(f"{out}: a worker sees another run than the one that began it: {'; '.join(changed)}")
        return store

    @property
    def seconds(self) -> dict[str, float]:
        """Per stage, of all that was computed so far."""
        return self._pipeline.trace.seconds

    def warm_up(self) -> float:
        """Compile all kernels; the seconds that it took."""
        return self._pipeline.warm_up()

    def compute(self, store: ResultStore, units: Collection[int], done: Callable[[int], None]) -> None:
        """Compute and write units; ``done`` is called for each when it is on the disk, by the thread that writes.

        Raises what reading, computing or writing the first of those that are not done raises; all before it are done.
        """

        def write(result: tuple[Unit, Maps, NDArray[np.uint8]]) -> None:
            unit, maps, status = result
            with span("write", f"unit {unit.index}"):
                store.write_unit(unit.index, unit.t_index, unit.rows, maps, status)
            done(unit.index)

        failed: Exception | None = None
        with active(self._pipeline.trace), Behind(write, WRITE_BEHIND) as writer:
            try:
                self._pipeline.run(lambda *result: writer.put(result), set(units))
            except Exception as error:  # what is computed is still written
                failed = error
        if failed is not None:
            raise failed


def start_device(config: RunConfig) -> Device:
    """The device that a configuration asks for; raises DeviceError."""
    return start(config.arch, config.precision, config.plan.threads_each(usable_threads()))
