"""Whole runs but for the computing: an executor whose units hold numbers drawn from their index. Milliseconds each."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, Self
from unittest import mock

import numpy as np

from leafflow_ti import chunk_files, runs
from leafflow_ti.capture import Capture, capture_from_array
from leafflow_ti.config import RunConfig, load_config
from leafflow_ti.executors import Executor
from leafflow_ti.plan import Plan
from leafflow_ti.results import ResultStore
from leafflow_ti.schedule import Failure, Schedule
from leafflow_ti.status import Status
from perf.kills.faulty_disk import Tree, read_tree

CAPTURE = capture_from_array(np.random.default_rng(0).integers(0, 255, (8, 1, 1, 16, 12)).astype(np.uint8))
BY_NATURE = {"timings", "runs"}
"""Attributes that tell how a run went."""
EMPTY_UNIT = 1
"""Holds nothing but fill values: its maps have no chunk."""


class Defect(Exception):
    """Results are not what they must be."""


def config(window: int = 5) -> RunConfig:
    """Two frames of two bands of one map: four units."""
    return load_config(
        overrides={
            "model": "flow", "window": window, "sigma": 1.0, "stride": 2, "plan.tile": 4, "output.arrays": ("flow_x",)
        }
    )  # fmt: skip


class Drawn(Executor):
    """Writes units of random numbers, the same every time."""

    label, device = "nobody", "nothing"

    def __init__(self, plan: Plan, capture: Capture) -> None:
        self._plan = plan

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None: ...

    @property
    def seconds(self) -> dict[str, float]:
        """None of any stage."""
        return {}

    def work(self, schedule: Schedule, store: ResultStore) -> None:
        """One unit after the other."""
        while (batch := schedule.take()) is not None:
            try:
                for index in batch.units:
                    self._write(store, index)
                    schedule.unit_done(batch, index)
            except Exception as error:
                schedule.failed(batch, Failure.of(error))
            else:
                schedule.ended(batch)

    def _write(self, store: ResultStore, index: int) -> None:
        unit = self._plan.unit(*divmod(index, self._plan.bands))
        shape = (unit.rows.stop - unit.rows.start, len(self._plan.x))
        drawn = np.random.default_rng(index).normal(size=shape).astype(np.float32)
        maps = {name: np.full_like(drawn, np.nan) if index == EMPTY_UNIT else drawn for name in store.names}
        store.write_unit(index, unit.t_index, unit.rows, maps, np.full(shape, Status.OK, np.uint8))


def run(out: Path, window: int = 5, **options: Any) -> None:
    """As ``leafflow-ti run`` in a process of its own; options and errors as of ``leafflow_ti.run``."""
    chunk_files._token.cache_clear()
    with mock.patch.object(runs, "Serial", Drawn):
        runs.run(CAPTURE, out, config(window), **options)


def comparable(folder: Path) -> Tree:
    """A folder with finished stores as a tree, without what differs by nature."""
    tree = read_tree(folder)
    for path in folder.glob("**/.done"):
        store = path.parents[1]
        here = tree
        for part in store.relative_to(folder).parts:
            here = here[part]
        attributes = ResultStore.open(store).attrs
        here["zarr.json"] = {name: value for name, value in attributes.items() if name not in BY_NATURE}
        here["status"].pop(".locks", None)
    return tree


def check_marked(store: ResultStore, whole: Tree) -> None:
    """Raise Defect if a unit that is marked as done is not as in a ``whole`` store."""
    for unit in sorted(store.done()):
        for name in (*store.names, "status"):
            chunk = Path(name, "c", *map(str, divmod(unit, store.bands)), "0")
            path, wanted = store.path / chunk, _file(whole, chunk)
            found = path.read_bytes() if path.exists() else None
            if found != wanted:
                raise Defect(f"unit {unit} is marked as done, but {chunk} is not whole")


def _file(tree: Tree, path: Path) -> bytes | None:
    for part in path.parts:
        tree = tree.get(part, {})
    return tree or None  # type: ignore[return-value]
