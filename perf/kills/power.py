"""``power-loss``: the power fails, or the disk is full, at every step of making a store, filling it, replacing it.

Whole runs, but for the computing, on a disk that is a model: see ``faulty_disk``. What is left must open, what is
marked as done must be whole, and a resumed run must end with the bytes of an undisturbed one.
"""

from __future__ import annotations

import contextlib
import os
import random
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar
from unittest import mock

import numpy as np

from leafflow_ti import locks
from leafflow_ti.errors import RunError
from leafflow_ti.results import ResultStore
from perf.cases import Options
from perf.figures import Figure, Outcome
from perf.kills import stand_in
from perf.kills.faulty_disk import (
    SURVIVALS,
    Died,
    Recorder,
    Refusing,
    Survival,
    Tree,
    differences,
    read_tree,
    write_tree,
)
from perf.kills.stand_in import Defect, check_marked, comparable

Item = TypeVar("Item")

OUT = Path("results", "out.zarr")
OTHER_WINDOW = 7
SHOWN = 20
"""Defects in words."""


@dataclass(frozen=True)
class Scenario:
    """``prepare`` makes what is there before; ``act``, in which the power fails; ``recover`` then leads to the end.
    All are given the folder. ``stays``: whether the store is there at any moment."""

    prepare: Callable[[Path], None]
    act: Callable[[Path], None]
    recover: Callable[[Path], None]
    stays: bool = False


def _nothing(folder: Path) -> None: ...


def _run(folder: Path) -> None:
    stand_in.run(folder / OUT)


def _resume(folder: Path) -> None:
    stand_in.run(folder / OUT, resume=True)


def _other(folder: Path) -> None:
    stand_in.run(folder / OUT, OTHER_WINDOW)


def _replace(folder: Path) -> None:
    stand_in.run(folder / OUT, overwrite=True)


def _replace_or_resume(folder: Path) -> None:
    """What a user does who finds the old store, or the new one."""
    try:
        _resume(folder)
    except RunError:
        _replace(folder)


def _add(folder: Path) -> None:
    """As ``leafflow-ti growth`` does."""
    store = ResultStore.open(folder / OUT).add_maps(("area_rate",))
    for t_index in range(len(store.frames)):
        values = np.random.default_rng(t_index).normal(size=(store.y.size, store.x.size)).astype(np.float32)
        store.write_maps(t_index, {"area_rate": values})
    store.finish_maps({"growth": {"window": 5}})


SCENARIOS = {
    "new store": Scenario(_nothing, _run, _resume),
    "replaced store": Scenario(_other, _replace, _replace_or_resume),
    "added maps": Scenario(_run, _add, _add, stays=True),
}


class Trial:
    """One scenario, again and again in new folders of ``root``.

    Every method raises Defect, or what the program raises.
    """

    def __init__(self, scenario: Scenario, root: Path) -> None:
        self._scenario, self._root, self._count = scenario, root, 0
        folder = self._folder()
        scenario.prepare(folder)
        self._before = comparable(folder)
        self._start = read_tree(folder)
        scenario.act(folder)
        self._after = comparable(folder)

    def _folder(self, tree: Tree | None = None) -> Path:
        self._count += 1
        folder = self._root / str(self._count)
        write_tree(self._start if tree is None and self._count > 1 else tree or {}, folder)
        return folder

    def recorded(self) -> Recorder:
        """The scenario's whole course."""
        folder = self._folder()
        with Recorder(folder) as recorder:
            self._scenario.act(folder)
        return recorder

    def check(self, tree: Tree) -> None:
        """What is left opens, is whole where it says so, and leads to the end."""
        folder = self._folder(tree)
        self._check_store(folder)
        self._recover(folder)

    def _check_store(self, folder: Path) -> None:
        if not (folder / OUT).exists() and not self._scenario.stays:
            return
        store, old, new = ResultStore.open(folder / OUT), _inside(self._before), _inside(self._after)
        check_marked(store, new if store.attrs["config"] == new["zarr.json"]["config"] else old)

    def _recover(self, folder: Path) -> None:
        with mock.patch.object(locks, "FORGOTTEN_S", -1.0):  # as if an hour had passed
            self._scenario.recover(folder)
        self._check_end(folder, left_over=False)

    def _check_end(self, folder: Path, left_over: bool) -> None:
        told = differences(comparable(folder), self._after)
        told = [text for text in told if not (left_over and text.endswith("left over"))]
        if told:
            raise Defect("; ".join(told))

    def die_twice(self, at: int) -> None:
        """The program is killed before a step, the recovery ends, then the power fails: nothing is lost, though what
        was removed may be there again."""
        folder = self._folder()
        with Recorder(folder, every_moment=False, dies_at=at) as recorder:
            with contextlib.suppress(Died):
                self._scenario.act(folder)
            recorder.revive()
            self._scenario.recover(folder)
        left = self._folder(recorder.moments[-1].tree(SURVIVALS["what was synced"]))
        self._check_end(left, left_over=True)

    def refuse(self, n: int, for_good: bool) -> None:
        """A step fails; the program says so, or has no need of it, and goes on when there is room again."""
        folder = self._folder()
        with Refusing(n, for_good):
            try:
                self._scenario.act(folder)
            except RunError as error:
                if "No space left" not in str(error):
                    raise
        self._check_store(folder)
        self._recover(folder)


def _inside(tree: Tree) -> Tree:
    for part in OUT.parts:
        tree = tree.get(part, {})
    return tree


def states(recorder: Recorder, mixtures: int, seed: int) -> list[tuple[str, Tree]]:
    """Every different state of the disk that the recorded moments may leave, and where it comes from.

    ``mixtures``: random states at every moment, beside the ends of the range.
    """
    rng, found = random.Random(seed), dict[str, tuple[str, Tree]]()

    def mixture(_: str) -> float:
        return rng.choice((0.0, 0.5, 1.0))

    survivals: dict[str, Survival] = SURVIVALS | {f"mixture {n}": mixture for n in range(mixtures)}
    for moment in recorder.moments:
        for name, survives in survivals.items():
            tree = moment.tree(survives)
            found.setdefault(repr(tree), (f"power fails before {moment.before}, {name} survives", tree))
    return list(found.values())


@dataclass
class Sweep:
    """How many trials there were of each kind, and their defects in words."""

    states: int = 0
    deaths: int = 0
    refusals: int = 0
    defects: list[str] = field(default_factory=list)

    @contextlib.contextmanager
    def _trial(self, what: str) -> Iterator[None]:
        try:
            yield
        except (Died, Exception) as error:
            self.defects.append(f"{what}: {type(error).__name__} {error}")


def sweep(scenario: Scenario, most: int | None = None, mixtures: int = 2, seed: int = 0) -> Sweep:
    """Every state of the disk, every step to die at, every step to fail; or at most so many of each, evenly spread."""
    found = Sweep()
    # Outside the blocks that watch the disk, too, nothing is really forced to it.
    with tempfile.TemporaryDirectory() as folder, mock.patch.object(os, "fsync"):
        trial = Trial(scenario, Path(folder))
        recorder = trial.recorded()
        words = [moment.before for moment in recorder.moments[:-1]]
        for why, tree in _spread(states(recorder, mixtures, seed), most):
            with found._trial(why):
                found.states += 1
                trial.check(tree)
        for at in _spread(range(len(words)), most):
            with found._trial(f"killed before {words[at]}, power fails in the end"):
                found.deaths += 1
                trial.die_twice(at)
        for n, at in enumerate(_spread(range(len(words)), most)):
            for_good = n % 2 == 0
            with found._trial(f"disk full at {words[at]}, {'for good' if for_good else 'once'}"):
                found.refusals += 1
                trial.refuse(at, for_good)
    return found


def _spread(items: Sequence[Item], most: int | None) -> Sequence[Item]:
    """At most so many items, the last one among them: then the course is at its end."""
    return items[:: -max(1, -(-len(items) // most))] if most else items


def run(options: Options) -> Outcome:
    """The case; quick: twenty of each."""
    figures, notes = [], []
    for name, scenario in SCENARIOS.items():
        found = sweep(scenario, 20 if options.quick else None, seed=options.seed)
        trials = f"{found.states} states after a power loss, {found.deaths} kills, {found.refusals} full disks"
        figures.append(Figure(f"{name}: defects", len(found.defects), reference=0, note=trials))
        notes += [f"{name}: {text}" for text in found.defects[:SHOWN]]
    return Outcome(tuple(figures), {"scenarios": len(SCENARIOS), "seed": options.seed}, tuple(notes))
