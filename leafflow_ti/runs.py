"""A whole run: plan, results store, executor, and what is said and written down about it."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from leafflow_ti.capture import Capture, capture_doubts, open_capture
from leafflow_ti.config import RunConfig
from leafflow_ti.disk import check_space
from leafflow_ti.errors import UsageError
from leafflow_ti.events import warn, warnings_said
from leafflow_ti.executors import Executor
from leafflow_ti.executors.cluster import Dask
from leafflow_ti.executors.processes import Processes
from leafflow_ti.executors.serial import Serial
from leafflow_ti.filling import Filling
from leafflow_ti.locks import alone, as_shard
from leafflow_ti.plan import Plan, make_plan
from leafflow_ti.progress import Progress, RunSummary
from leafflow_ti.provenance import provenance
from leafflow_ti.results import ResultStore, check_replaceable
from leafflow_ti.run_store import as_decided, create_store, open_store, take_new_input, with_bands_of
from leafflow_ti.store_check import mend

if TYPE_CHECKING:
    from distributed import Client

Shard = tuple[int, int]


def run(
    capture: Capture | str | Path,
    out: str | Path,
    config: RunConfig | None = None,
    *,
    resume: bool = False,
    verify: bool = False,
    overwrite: bool = False,
    shard: Shard | None = None,
    dask: str | Client | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> RunSummary:
    """Measure every frame of a capture into a results store.

    ``resume`` goes on with an interrupted run of the same configuration and input; with ``verify`` all files of earlier
    results are read first, and damaged units are computed again. ``shard`` (k, n): only the k-th of n parts,
    1 <= k <= n, in the store that all of them share; whichever comes first makes it. ``dask``: compute on
    a Dask cluster, that of a scheduler's address or of a ``distributed.Client``, or "local", one of ``plan.workers``
    processes for this run. ``progress`` is called after every unit, by the thread that writes.

    A unit that cannot be computed (its images cannot be read, its worker dies) is tried again, then left out.
    Raises ConfigError, InputError, DeviceError, RunError; UsageError if ``out`` exists and neither option is given;
    PartlyDone, at the end, if units were left out: ``resume`` tries them again.
    """
    began, out = time.perf_counter(), Path(out)
    _check_shard(shard, overwrite)
    if shard and dask is not None:
        raise UsageError("--shard and --dask exclude each other: a cluster's workers share all units")
    with warnings_said() as said, contextlib.ExitStack() as inside:
        if not isinstance(capture, Capture):
            capture = open_capture(capture)
        for doubt in capture_doubts(capture):
            warn(doubt)
        config = config or RunConfig()
        if shard and not out.exists():
            _make_shared(out, capture, config, shard)
        found, changed = (resume or shard is not None) and out.exists(), False
        plan = make_plan(capture, with_bands_of(as_decided(config, out), out) if found else config)
        attrs = provenance(plan, capture)
        left = set(_part(plan, shard))
        if found:
            store, changed = open_store(out, plan, attrs, capture)
            if verify:
                with alone(out):
                    mend(store)
                store = ResultStore.open(out)
            left -= store.done()
        else:
            check_replaceable(out, overwrite)
        check_space(out, plan, len(left))
        executor = _executor(plan, capture, out, dask)
        if not found or left:
            inside.enter_context(executor)
        if not found:
            store = create_store(out, plan, attrs, capture, overwrite)
        inside.enter_context(as_shard(out, *shard) if shard else alone(out))
        if changed:
            store = take_new_input(store, plan, attrs)
        filling = Filling(executor, progress, said, began)
        with filling.recorded(store):
            filling.fill(plan, store, _part(plan, shard), resumed=found)
        return filling.summary()


def _executor(plan: Plan, capture: Capture, out: Path, dask: str | Client | None) -> Executor:
    """What computes a plan; ConfigError where it cannot."""
    workers = plan.config.plan.workers
    if dask is not None:
        return Dask(plan, capture, out, dask)
    return Processes(plan, capture, out, workers) if workers > 1 else Serial(plan, capture)


def _check_shard(shard: Shard | None, overwrite: bool) -> None:
    if shard is None:
        return
    number, count = shard
    if not 1 <= number <= count:
        raise UsageError(f"shard {number}/{count}: the parts of n are 1/n to n/n; number the jobs of an array from 1")
    if overwrite:
        raise UsageError("--shard and --overwrite exclude each other: remove the old results, or give another output")


def _make_shared(out: Path, capture: Capture, config: RunConfig, shard: Shard) -> None:
    """Make the store of all shards, unless another one has meanwhile: whoever has not made it plans as that one has."""
    plan = make_plan(capture, config)
    check_space(out, plan, len(_part(plan, shard)))
    with contextlib.suppress(UsageError):
        create_store(out, plan, provenance(plan, capture), capture, overwrite=False)


def _part(plan: Plan, shard: Shard | None) -> list[int]:
    """The units of a shard, or all, in the order in which they are computed: near ones share most of their images."""
    units = [unit.index for unit in plan.units()]
    if plan.adaptive:
        units.sort()  # the bands of a frame share its search
    if shard is None:
        return units
    number, count = shard
    return units[(number - 1) * len(units) // count : number * len(units) // count]
