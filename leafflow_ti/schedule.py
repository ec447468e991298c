"""Which units are computed next, which have failed, and which are given up: bookkeeping that every executor shares.

Units are handed out in batches that follow each other through the sequence, because windows in time are filled once per
batch. A unit is idempotent: whoever computes it writes the same bytes, so that one that may have been lost is simply
handed out again. One that fails too often is quarantined, and the run goes on without it.
"""

from __future__ import annotations

import logging
import math
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from leafflow_ti.errors import ConfigError, DeviceError, InputError, LeafflowError, RunError
from leafflow_ti.events import event

ATTEMPTS = 3
"""How often a unit is tried."""
SHARES = 2
"""A batch is the so-manieth part of what is left for each worker: long at first, as windows in time are filled once per
batch, and short at last, as workers wait for the last one to end."""
FILLS_PER_BATCH = 0.5
"""Least number of units of a batch for each further frame that its windows need. To read and filter that takes 0.02 to
0.09 of the time that a unit takes (measured; more where images are large and few of their pixels are measured)."""
_ERRORS = {kind.exit_code: kind for kind in (ConfigError, InputError, DeviceError, RunError)}


@dataclass(frozen=True)
class Batch:
    """Units that one worker computes, in this order."""

    units: tuple[int, ...]


@dataclass(frozen=True)
class Failure:
    """Why a unit was not computed. ``exit_code``: of the error that said so, None where it was no error of ours;
    ``cause``: the error, where it was raised in this process."""

    message: str
    exit_code: int | None = None
    cause: Exception | None = field(default=None, compare=False, repr=False)

    @classmethod
    def of(cls, error: Exception) -> Failure:
        """Of what computing a unit raised."""
        text = " ".join(str(error).split())
        if isinstance(error, LeafflowError):
            return cls(text, error.exit_code, error)
        return cls(f"unexpected {type(error).__name__}: {text}", cause=error)

    @property
    def repeats(self) -> bool:
        """Whether one cause may meet many units: a file that cannot be read."""
        return self.exit_code == InputError.exit_code

    @property
    def ends_all(self) -> bool:
        """Whether no other unit can do better: results cannot be written, the device or the configuration is wrong."""
        return self.exit_code is not None and not self.repeats

    def error(self) -> Exception:
        """The error again, or one with its exit code."""
        return self.cause or _ERRORS.get(self.exit_code or RunError.exit_code, RunError)(self.message)


@dataclass(frozen=True)
class Missing:
    """A unit that was given up."""

    unit: int
    failure: Failure
    attempts: int


class Schedule:
    """The units of a run that are still to be computed.

    ``sequences``: units that follow each other, for instance one band through all frames; a batch never holds units of
    two. ``finished`` is called for every unit that was computed and written. ``workers`` take batches side by side,
    which then are as long as guided self-scheduling has them: one alone takes whole sequences. ``fill``: further frames
    that the windows of a batch need. ``attempts``: how often a unit is tried.
    """

    def __init__(
        self,
        sequences: Iterable[Sequence[int]],
        finished: Callable[[int], None],
        workers: int = 1,
        fill: int = 0,
        attempts: int = ATTEMPTS,
    ) -> None:
        self._finished, self._attempts = finished, attempts
        self._workers, self._least = workers, max(1, math.ceil(FILLS_PER_BATCH * fill))
        self._waiting = deque(tuple(sequence) for sequence in sequences if sequence)
        self._left: dict[Batch, list[int]] = {}
        self._failed: Counter[int] = Counter()
        self._hopeless: set[str] = set()
        self.done = 0
        self.missing: list[Missing] = []

    @property
    def disturbed(self) -> bool:
        """Whether any unit has failed, or was lost with its worker."""
        return bool(self._failed)

    @property
    def over(self) -> bool:
        """Whether nothing waits and nobody works."""
        return not self._waiting and not self._left

    def take(self) -> Batch | None:
        """The next batch; None when none waits. Whoever takes it ends it by ``ended``, ``failed`` or ``lost``."""
        if not self._waiting:
            return None
        units = self._waiting.popleft()
        n = self._length(len(units))
        if units[n:]:
            self._waiting.appendleft(units[n:])
        batch = Batch(units[:n])
        self._left[batch] = list(batch.units)
        return batch

    def _length(self, n: int) -> int:
        """Units of a batch that begins a sequence of ``n``, of which no sliver shall be left."""
        if self._workers == 1:
            return n
        waiting = n + sum(map(len, self._waiting))
        wanted = max(self._least, math.ceil(waiting / (SHARES * self._workers)))
        return math.ceil(n / max(1, round(n / wanted)))

    def unit_done(self, batch: Batch, unit: int) -> None:
        """A unit of a batch was computed and written."""
        left = self._left.get(batch)
        if left is not None and unit in left:  # else it was handed out twice, and another one was quicker
            left.remove(unit)
            self.done += 1
            self._finished(unit)

    def ended(self, batch: Batch) -> None:
        """A batch has come to its end; what is left of it was not computed, without a reason."""
        if self._left.get(batch):
            self.lost(batch, "its worker did not compute it")
        self._left.pop(batch, None)

    def failed(self, batch: Batch, failure: Failure) -> bool:
        """Computing the first of the units that are left of a batch has failed; the others wait again, it first,
        unless it was tried too often. Returns whether it waits.

        Raises the failure where nothing else can be computed either.
        """
        if failure.ends_all:
            raise failure.error()
        return self._again(batch, failure, alone=False)

    def lost(self, batch: Batch, reason: str) -> None:
        """The worker of a batch is gone. Which unit it died of is not known for sure: the first of those that are left
        is tried alone."""
        self._again(batch, Failure(reason), alone=True)

    def _again(self, batch: Batch, failure: Failure, alone: bool) -> bool:
        left = self._left.pop(batch, [])
        if not left:
            return False
        first, rest = left[0], tuple(left[1:])
        self._failed[first] += 1
        attempts = self._failed[first]
        given_up = attempts >= self._attempts or failure.message in self._hopeless
        if given_up:
            if failure.repeats:
                self._hopeless.add(failure.message)
            self.missing.append(Missing(first, failure, attempts))
            event("quarantine", f"unit {first} is given up: {failure.message}", logging.ERROR, unit=first,
                  attempts=attempts, reason=failure.message)  # fmt: skip
            again = [rest] if rest else []
        else:
            event("retry", f"unit {first} is tried again: {failure.message}", unit=first, attempt=attempts + 1,
                  reason=failure.message)  # fmt: skip
            again = [(first,), rest] if alone else [(first, *rest)]
        self._waiting.extendleft(units for units in reversed(again) if units)
        return not given_up
