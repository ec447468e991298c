"""Stores that are filled by one life of a run after the other, most of them killed."""

from __future__ import annotations

import contextlib
import io
import os
import random
import signal
import tempfile
import threading
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import zarr

from leafflow_ti.cli.main import invoke
from leafflow_ti.results import ResultStore
from perf.kills.captures import Variant
from perf.kills.faulty_disk import Tree, differences
from perf.kills.processes import Life
from perf.kills.stand_in import Defect, check_marked, comparable
from perf.kills.ways import Victim, Way

OUT = Path("results", "out.zarr")
MOMENTS = ("any time", "making", "units", "end")
"""When a run is killed: at any time of its life, as the store appears, while units are written, when all are done."""
MAKING_S, UNIT_S, END_S = 0.05, 0.05, 0.3
"""Seconds after the beginning of these over which moments are drawn."""
KILLS_PER_STORE = (2, 6)
LIVES_PER_STORE = 30
"""More are not needed to fill a store, if resuming is of use."""
_ONE_AT_A_TIME = threading.Lock()
"""For what is printed, which all threads share."""


@dataclass
class Tally:
    """What happened, counted by several threads; ``kills``: how many are wanted; ``life_s``: of an undisturbed run."""

    kills: int
    life_s: float = 4.0
    counts: Counter[str] = field(default_factory=Counter)
    defects: list[str] = field(default_factory=list)

    @property
    def enough(self) -> bool:
        """Whether so many were killed."""
        return self.counts["kills"] >= self.kills

    def defect(self, kind: str, text: str) -> None:
        """``kind``: the count to which it belongs."""
        self.counts[kind] += 1
        self.defects.append(f"{kind}: {text}")


@dataclass(frozen=True)
class Place:
    """``root``: the folder that holds captures and stores; ``cache``: of compiled kernels, which all runs share."""

    root: Path
    cache: Path

    @property
    def environment(self) -> dict[str, str]:
        """Of the runs."""
        return {**os.environ, "LEAFFLOW_TI_CACHE": str(self.cache)}

    def command(self, out: Path, variant: Variant) -> list[str]:
        """Arguments of ``leafflow-ti`` that begin a run or go on with it."""
        return ["run", str(self.root / variant.folder), "-o", str(out), "--resume", *variant.options]


@dataclass(frozen=True)
class Reference:
    """A variant of capture and options, and the ``folder`` of an undisturbed run, ``without_resources``."""

    variant: Variant
    folder: Tree


def without_resources(tree: Tree) -> Tree:
    """A folder as of ``comparable``, but for what depends on who computed it: device, workers, threads."""
    store = tree[OUT.parts[0]][OUT.parts[1]]
    attributes = {name: value for name, value in store["zarr.json"].items() if name != "device"}
    attributes["config"] = {k: v for k, v in tomllib.loads(attributes["config"]).items() if k != "plan"}
    return {**tree, OUT.parts[0]: {**tree[OUT.parts[0]], OUT.parts[1]: {**store, "zarr.json": attributes}}}


def fill_stores(way: Way, place: Place, references: Sequence[Reference], tally: Tally, seed: int) -> None:
    """Fill one store after the other in folders of their own, until there were enough kills."""
    rng = random.Random(seed)
    while not tally.enough:
        fill_store(way, place, rng.choice(references), tally, rng, rng.randint(*KILLS_PER_STORE))


def fill_store(way: Way, place: Place, reference: Reference, tally: Tally, rng: random.Random, kills: int = 0) -> None:
    """Fill one, killing that often; all that is wrong is a defect of the tally."""
    with tempfile.TemporaryDirectory(dir=place.root, ignore_cleanup_errors=True) as name:
        _Filling(way, place, Path(name), reference, tally, rng).run(kills)


class _Filling:
    """One store, from nothing to the end."""

    def __init__(
        self, way: Way, place: Place, folder: Path, reference: Reference, tally: Tally, rng: random.Random
    ) -> None:
        self._way, self._place, self._folder = way, place, folder
        self._variant, self._reference = reference.variant, reference.folder
        self._tally, self._rng = tally, rng
        self._out = folder / OUT
        self._whole = self._reference[OUT.parts[0]][OUT.parts[1]]
        self._n_units = sum(name.isdecimal() for name in self._whole["status"][".done"])

    def run(self, kills: int) -> None:
        """Live until the end."""
        for life in range(LIVES_PER_STORE):
            try:
                finished = self._live(kill=life < kills and not self._tally.enough)
            except TimeoutError as error:
                self._tally.defect("hangs", f"{self._variant.name}: {error}")
                return
            self._check_store()
            if finished:
                self._check_end()
                self._tally.counts["stores"] += 1
                return
        self._tally.defect("wrong exits", f"{self._variant.name}: not at the end after {LIVES_PER_STORE} runs")

    def _live(self, kill: bool) -> bool:
        """One life of a run; whether all of its commands came to their end."""
        errors = self._folder.with_suffix(".txt")
        arguments = self._place.command(self._out, self._variant)
        began = time.perf_counter()
        life = Life([[*arguments, *more] for more in self._way.commands], self._place.environment, errors)
        victim = self._kill(life) if kill else None
        codes, orphans = life.end()
        self._tally.counts["runs"] += 1
        if orphans:
            self._tally.defect("orphans", f"{self._variant.name}: {orphans} processes outlive {victim}")
        killed = victim not in (None, "worker")  # who loses a worker goes on
        if not set(codes) <= ({0, -signal.SIGKILL} if killed else {0}):
            said = errors.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            text = f"{self._variant.name}, killed: {victim}: exit codes {codes}: {' '.join(said[-1:])}"
            self._tally.defect("wrong exits", text)
        if victim is None and not any(codes):
            self._tally.life_s = time.perf_counter() - began
        return not any(codes)

    def _kill(self, life: Life) -> Victim | None:
        """Kill somebody at a drawn moment; who it was, None where the life was over before."""
        if not self._wait(life, self._rng.choice(MOMENTS)):
            return None
        phase, victim = self._phase(), self._rng.choice(self._way.victims)
        if victim == "worker" and not life.kill_worker(self._rng):
            return None
        if victim == "all":
            life.kill_all()
        elif victim == "one":
            life.kill_one(self._rng)
        elif victim == "parent":
            life.kill_parent()
        self._tally.counts.update(("kills", f"phase {phase}", f"victim {victim}"))
        return victim

    def _wait(self, life: Life, moment: str) -> bool:
        done = self._done
        left = self._n_units - done
        wanted = done + self._rng.randint(min(1, left), max(left - 1, min(1, left)))
        begins: dict[str, tuple[Callable[[], bool], float]] = {
            "any time": (lambda: True, self._tally.life_s),
            "making": (lambda: any(self._folder.glob(f"{OUT.parent}/*{OUT.name}*")), MAKING_S),
            "units": (lambda: self._done >= wanted, UNIT_S),
            "end": (lambda: self._done >= self._n_units, END_S),
        }
        begun, last = begins[moment]
        return life.wait_for(begun, self._rng.uniform(0, last))

    @property
    def _done(self) -> int:
        """Units that are marked as done, counted without opening the store."""
        try:
            return sum(name.isdecimal() for name in os.listdir(self._out / "status" / ".done"))  # noqa: PTH208
        except FileNotFoundError:
            return 0

    def _phase(self) -> str:
        if not self._out.exists():
            return "making" if any(self._folder.glob(f"{OUT.parent}/*")) else "before"
        return {0: "no unit", self._n_units: "end"}.get(self._done, "units")

    def _check_store(self) -> None:
        """After every life: the store opens, if there is one, and what is marked is whole."""
        if not self._out.exists():
            return
        try:
            store = ResultStore.open(self._out)
            tuple(zarr.open_group(self._out, mode="r").members(max_depth=None))
            with _ONE_AT_A_TIME, contextlib.redirect_stdout(io.StringIO()):
                invoke(["info", str(self._out)])
        except Exception as error:
            self._tally.defect("not opened", f"{self._variant.name}: {type(error).__name__} {error}")
            return
        try:
            check_marked(store, self._whole)
        except Defect as error:
            self._tally.defect("not whole", f"{self._variant.name}: {error}")

    def _check_end(self) -> None:
        for text in differences(without_resources(comparable(self._folder)), self._reference):
            kind = "left over" if text.endswith("left over") else "differences"
            self._tally.defect(kind, f"{self._variant.name}: {text}")
