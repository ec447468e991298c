"""A run beside the cameras: frames are measured as they arrive.

What is decided from images (their noise, how they are shifted) is decided once, from the first frames that suffice for
a measurement, and kept as if it had been given: a run over the whole capture with that configuration, which ``info``
prints, gives the same bytes.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from leafflow_ti.capture import SETTLE_S, Arrivals, FileCapture, capture_doubts
from leafflow_ti.config import RunConfig
from leafflow_ti.errors import ConfigError, InputError, PartlyDone
from leafflow_ti.events import event, warn, warnings_said
from leafflow_ti.executors.serial import Serial
from leafflow_ti.filling import Filling
from leafflow_ti.locks import alone
from leafflow_ti.plan import Plan, make_plan
from leafflow_ti.progress import Progress, RunSummary
from leafflow_ti.provenance import provenance
from leafflow_ti.results import ResultStore, check_replaceable
from leafflow_ti.run_store import FOLLOWED, as_decided, create_store, open_store, take_new_input, with_bands_of

INTERVALS = 10.0
"""Time-out in intervals between frames, where these are stated."""
LEAST_TIMEOUT_S, UNKNOWN_TIMEOUT_S = 60.0, 600.0
MANY = 1000
"""Frames of a capture of which the end is not known: more than any window in time."""
POLL_S = 2.0
"""Between two looks at the folder."""
LOOKS_SHARE = 10.0
"""Looking takes a tenth of the time at most."""
TRIES = 3
"""Rounds in which a unit that cannot be computed is tried."""


def follow(
    capture: str | Path,
    out: str | Path,
    config: RunConfig | None = None,
    *,
    resume: bool = False,
    overwrite: bool = False,
    timeout_s: float | None = None,
    settle_s: float = SETTLE_S,
    outside: bool = False,
    progress: Callable[[Progress], None] | None = None,
    waiting: Callable[[str], None] | None = None,
) -> RunSummary:
    """Measure the frames of a capture that is still being taken into a results store, each when it can be.

    It ends when the frames of ``output.frames`` are done, or when nothing has arrived for ``timeout_s`` (default: ten
    intervals, 60 s at least; 600 s where no interval is stated). ``settle_s``: how long a file must not have changed.
    ``waiting`` is called with what the next frame lacks, whenever that changes; the rest as of ``run``.

    Raises what ``run`` raises, ConfigError for captures and configurations that cannot be followed; PartlyDone at the
    end where a frame has remained incomplete.
    """
    began = time.perf_counter()
    with warnings_said() as said, contextlib.ExitStack() as inside:
        following = _Following(Arrivals(Path(capture), outside, settle_s), config or RunConfig(), timeout_s, waiting)
        store, plan, first = following.begin(Path(out), resume, overwrite)
        inside.enter_context(alone(store.path))
        filling = Filling(Serial(plan, first), progress, said, began)
        with filling.recorded(store):
            following.rounds(store, filling)
            lacking = following.arrivals.lacking
        if not lacking:
            return filling.summary()
        with contextlib.suppress(PartlyDone):
            filling.summary()
        raise PartlyDone(
            f"nothing has arrived for {following.timeout_s:g} s, and {lacking}; it and the frames behind it are not "
            f"measured: add what is missing, then run again with --resume (frames up to here are in {store.path})"
        )


class _Following:
    """Waits for frames, and says with which plan they are measured."""

    def __init__(
        self, arrivals: Arrivals, config: RunConfig, timeout_s: float | None, waiting: Callable[[str], None] | None
    ) -> None:
        self.arrivals, self._given, self._waiting = arrivals, config, waiting
        if config.filters.prefilter == "homomorphic":
            raise ConfigError(
                "prefilter 'homomorphic' is scaled by the middle frame, which a capture that is being taken does not "
                "have: choose another prefilter, or run when it has ended"
            )
        if config.plan.workers > 1:
            raise ConfigError(
                f"plan.workers = {config.plan.workers}: one process follows a capture, frame by frame: leave it 1"
            )
        interval = arrivals.interval_s
        expected = UNKNOWN_TIMEOUT_S if interval is None else max(LEAST_TIMEOUT_S, INTERVALS * interval)
        self.timeout_s = expected if timeout_s is None else timeout_s
        self._config, self._said = config, ""
        first, _, last = (config.output.frames or ":").partition(":")
        self._first, self._last = int(first or 0), int(last) if last else None

    def begin(self, out: Path, resume: bool, overwrite: bool) -> tuple[ResultStore, Plan, FileCapture]:
        """The store, new or resumed, with the plan and the capture of its first frames."""
        if resume and out.exists():
            self._config = with_bands_of(as_decided(self._given, out), out)
            store = ResultStore.open(out)
            capture = self.arrivals.capture(self._enough(store.frames[-1] + 1))
            return store, self._plan(capture), capture
        check_replaceable(out, overwrite)
        capture = self.arrivals.capture(self._enough())
        for doubt in capture_doubts(capture):
            warn(doubt)
        self._config = _decided(self._plan(capture), self._given)
        plan = self._plan(capture)
        return create_store(out, plan, self._provenance(plan, capture), capture, overwrite), plan, capture

    def rounds(self, store: ResultStore, filling: Filling) -> None:
        """Measure what arrives, until the end."""
        tries: dict[int, int] = {}
        while True:
            n_frames = len(self.arrivals.complete)
            capture = self.arrivals.capture(n_frames)
            plan = self._plan(capture)
            attrs = self._provenance(plan, capture)
            store, changed = open_store(store.path, plan, attrs, capture)
            if changed:
                store = take_new_input(store, plan, attrs)
            executor = Serial(plan, capture)
            part = [unit.index for unit in plan.units() if tries.get(unit.index, 0) < TRIES]
            if not set(part) <= store.done():
                with executor:
                    filling.use(executor)
                    filling.fill(plan, store, part, resumed=True)
                for unit in filling.missing:
                    tries[unit] = tries.get(unit, 0) + 1
            if self._all_done(plan) or not self._wait(n_frames + 1):
                return

    def _enough(self, least: int = 1) -> int:
        """Waits for so many frames that one can be measured as it will be when all are there, and how many that are."""
        n_frames = least
        while True:
            if not self._wait(n_frames):
                raise InputError(
                    f"{self.arrivals.path}: nothing has arrived for {self.timeout_s:g} s, and {n_frames} frames are "
                    f"needed, of which {len(self.arrivals.complete)} are complete: "
                    f"{self.arrivals.lacking or 'no further one has begun'}; add them or give a longer "
                    "--follow-timeout, or run without --follow, which fits its windows in time to fewer frames"
                )
            capture = self.arrivals.capture(n_frames)
            lasting = self._rehearsed(replace(capture, n_frames=MANY))
            before, after = lasting.around
            if n_frames > max(self._first, before) + after:
                now = self._rehearsed(capture)
                if (now.problem.sampling, now.around) == (lasting.problem.sampling, lasting.around):
                    return n_frames
            n_frames += 1

    def _rehearsed(self, capture: FileCapture) -> Plan:
        """A plan of all frames that looks at no image."""
        given = self._given
        kept = {
            "preshift": "adaptive" if given.preshift == "adaptive" else (0, 0),
            "model": given.model.model_copy(update={"noise": 1.0}),
            "output": given.output.model_copy(update={"frames": None}),
        }
        return make_plan(capture, given.model_copy(update=kept))

    def _plan(self, capture: FileCapture) -> Plan:
        """Of the frames that are there."""
        last = capture.n_frames if self._last is None else min(self._last, capture.n_frames)
        output = self._config.output.model_copy(update={"frames": f"{self._first}:{last}"})
        return make_plan(capture, self._config.model_copy(update={"output": output}))

    def _provenance(self, plan: Plan, capture: FileCapture) -> dict[str, Any]:
        """As of a run over the whole capture."""
        config = plan.config.model_copy(update={"output": self._given.output})
        return {**provenance(plan, capture), "config": config.to_toml(), FOLLOWED: True}

    def _all_done(self, plan: Plan) -> bool:
        return self._last is not None and plan.frames[-1] >= self._last - 1

    def _wait(self, n_frames: int) -> bool:
        """Wait until so many frames are complete; False where nothing has arrived for too long."""
        while True:
            began = time.monotonic()
            if self.arrivals.look() >= n_frames:
                return True
            now = time.monotonic()
            if now - self.arrivals.changed_s > self.timeout_s:
                return False
            said = self.arrivals.lacking or f"frame {len(self.arrivals.complete)} has not begun"
            if said != self._said:
                self._said = said
                event("waiting", said)
                if self._waiting:
                    self._waiting(said)
            time.sleep(max(min(POLL_S, self.arrivals.settle_s), LOOKS_SHARE * (now - began)))


def _decided(plan: Plan, given: RunConfig) -> RunConfig:
    """A configuration with what a plan has decided from images."""
    model = given.model.model_copy(update={"noise": plan.noise})
    return given.model_copy(update={"model": model, "preshift": "adaptive" if plan.adaptive else plan.preshift})
