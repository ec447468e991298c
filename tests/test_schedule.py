"""The bookkeeping of a run's units: whatever workers do, each unit ends once, done or given up."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from leafflow_ti.errors import DeviceError, InputError, RunError
from leafflow_ti.schedule import ATTEMPTS, Batch, Failure, Schedule

BROKEN = Failure("frame_003.tif: cut off", InputError.exit_code)
ODD = Failure("unexpected KeyError: 'x'")


class Workers(RuleBasedStateMachine):
    """Workers that compute, fail and die as they like; what the schedule says of it is counted here once more."""

    @initialize(
        lengths=st.lists(st.integers(0, 12), min_size=1, max_size=4),
        workers=st.integers(1, 4),
        fill=st.integers(0, 12),
    )
    def begin(self, lengths: list[int], workers: int, fill: int) -> None:
        ends = [sum(lengths[: i + 1]) for i in range(len(lengths))]
        sequences = [range(end - n, end) for end, n in zip(ends, lengths, strict=True)]
        self.sequence = {unit: i for i, units in enumerate(sequences) for unit in units}
        self.done: Counter[int] = Counter()
        self.schedule = Schedule(sequences, lambda unit: self.done.update([unit]), workers, fill)
        self.computing: list[tuple[Batch, list[int]]] = []
        self.failures: Counter[int] = Counter()
        self.alone: set[int] = set()

    @rule()
    def take(self) -> None:
        batch = self.schedule.take()
        if batch is None:
            return
        assert list(batch.units) == sorted(set(batch.units))
        assert len({self.sequence[u] for u in batch.units}) == 1
        if batch.units[0] in self.alone:  # a worker may have died of it
            assert len(batch.units) == 1
        self.computing.append((batch, list(batch.units)))

    @precondition(lambda self: self.computing)
    @rule(data=st.data())
    def compute(self, data: st.DataObject) -> None:
        batch, left = data.draw(st.sampled_from(self.computing))
        if left:
            self.schedule.unit_done(batch, left.pop(0))

    @precondition(lambda self: self.computing)
    @rule(data=st.data(), what=st.sampled_from(["ended", "broken", "odd", "lost"]))
    def end(self, data: st.DataObject, what: str) -> None:
        index = data.draw(st.integers(0, len(self.computing) - 1))
        batch, left = self.computing.pop(index)
        if left:
            self.failures[left[0]] += 1
            self.alone.discard(left[0])
        if what in ("ended", "lost"):
            self.alone |= set(left[:1])
        if what == "ended":
            self.schedule.ended(batch)
        elif what == "lost":
            self.schedule.lost(batch, "its worker died")
        else:
            waits = self.schedule.failed(batch, BROKEN if what == "broken" else ODD)
            assert waits == bool(left and left[0] not in self.given_up)
        # What comes late from a worker that was thought lost changes nothing.
        for unit in left:
            self.schedule.unit_done(batch, unit)

    @property
    def given_up(self) -> set[int]:
        return {m.unit for m in self.schedule.missing}

    @invariant()
    def every_unit_ends_once(self) -> None:
        if not hasattr(self, "schedule"):
            return
        assert set(self.done.values()) <= {1}
        assert self.schedule.done == len(self.done)
        assert len(self.given_up) == len(self.schedule.missing)
        assert not self.given_up & self.done.keys()
        for m in self.schedule.missing:
            assert m.attempts == self.failures[m.unit] <= ATTEMPTS
        assert all(n < ATTEMPTS for u, n in self.failures.items() if u not in self.given_up)
        assert self.schedule.disturbed == bool(self.failures)
        if self.schedule.over:
            assert self.done.keys() | self.given_up == self.sequence.keys()
            assert self.schedule.take() is None

    def teardown(self) -> None:
        """Whatever came before, workers that work end the run."""
        if not hasattr(self, "schedule"):
            return
        for batch, left in self.computing:
            for unit in left:
                self.schedule.unit_done(batch, unit)
            self.schedule.ended(batch)
        while (batch := self.schedule.take()) is not None:
            for unit in batch.units:
                self.schedule.unit_done(batch, unit)
            self.schedule.ended(batch)
        assert self.schedule.over
        assert self.done.keys() | self.given_up == self.sequence.keys()


TestWorkers = Workers.TestCase
TestWorkers.settings = settings(max_examples=80, stateful_step_count=30, deadline=None)


def batches(lengths: list[int], workers: int, fill: int) -> list[int]:
    """Lengths of the batches of sequences of these lengths, in the order in which they are taken."""
    schedule, found = Schedule([range(n) for n in lengths], lambda unit: None, workers, fill), []
    while (batch := schedule.take()) is not None:
        found.append(len(batch.units))
    return found


def makespan(lengths: list[int], workers: int, fill: float) -> float:
    """When the last of equal workers is ready that take batches as soon as they can [time of a unit]."""
    ready = [0.0] * workers
    for n in lengths:
        first = ready.index(min(ready))
        ready[first] += fill + n
    return max(ready)


def test_one_worker_takes_whole_sequences() -> None:
    assert batches([40, 3, 0, 7], 1, 8) == [40, 3, 7]


@pytest.mark.parametrize(("frames", "bands"), [(22, 1), (100, 1), (1000, 1), (11, 3), (60, 4)])
@pytest.mark.parametrize("workers", [2, 3, 8])
def test_batches_keep_workers_busy(frames: int, bands: int, workers: int) -> None:
    """Filling windows of nine frames takes as long as 0.7 units, at most, of those that were measured."""
    found = batches([frames] * bands, workers, 8)
    ideal = frames * bands / workers
    assert min(found) >= 3
    assert makespan(found, workers, 0.7) <= max(1.25 * ideal, ideal + 5)


def test_what_spoils_every_unit_is_raised() -> None:
    schedule = Schedule([range(3)], lambda unit: None)
    batch = schedule.take()
    assert batch is not None
    with pytest.raises(RunError, match="disk is full"):
        schedule.failed(batch, Failure.of(RunError("the disk is full")))
    assert isinstance(Failure("no such device", DeviceError.exit_code).error(), DeviceError)


def test_a_file_that_could_not_be_read_is_not_tried_for_every_unit() -> None:
    schedule, tries = Schedule([range(5)], lambda unit: None), 0
    while (batch := schedule.take()) is not None:
        schedule.failed(batch, BROKEN)
        tries += 1
    assert [m.attempts for m in schedule.missing] == [ATTEMPTS, 1, 1, 1, 1]
    assert tries == ATTEMPTS + 4
