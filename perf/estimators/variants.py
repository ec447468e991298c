"""Estimators that only experiments need: printed starts and schedules, put in the place of the project's own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from leafflow_ti.engines import release
from leafflow_ti.kernels.numbers import AGAIN
from leafflow_ti.stages.estimators import ESTIMATORS, Estimator, Move
from leafflow_ti.stages.estimators.fns import FNS
from leafflow_ti.stages.estimators.moves import Stage, Weights, finished, null_space, rounds
from leafflow_ti.stages.estimators.robust import NARROW_ROUNDS, ROBUST_TLS, ROUNDS, TRANSLATION_ROUNDS


@contextmanager
def replaced(name: str, estimator: Estimator) -> Iterator[None]:
    """``estimator`` goes by ``name`` in here."""
    own = ESTIMATORS[name]
    release()  # kept stages have the moves of before
    ESTIMATORS[name] = estimator
    try:
        yield
    finally:
        release()
        ESTIMATORS[name] = own


def _from_raw(solver: str, cut: bool) -> list[Move]:
    """The fundamental scheme from total least squares at the local scale, instead of the equilibrated solution."""
    own = FNS.moves(solver, cut)
    behind = own[own.index(Move(Stage.BEGIN_WEIGHTS, Weights.NOISE)) :]
    return [Move(Stage.LOAD), *null_space(solver, raw=True), *behind]


def _joint(solver: str, cut: bool) -> list[Move]:
    """Robust total least squares for all parameters from the plain fit on: no translation first, no narrow window."""
    again = (Move(Stage.REWEIGHT, Weights.PENALTY), *null_space(solver, whitened=True))
    return [
        Move(Stage.LOAD), *null_space(solver), Move(Stage.BEGIN_WEIGHTS, Weights.PENALTY),
        *rounds(TRANSLATION_ROUNDS + NARROW_ROUNDS + ROUNDS, *again), *finished(factored=False),
    ]  # fmt: skip


def _unnarrowed(solver: str, cut: bool) -> list[Move]:
    """The translation first, the derivatives second, in the whole window all the time."""
    first, full = (null_space(solver, which=which, whitened=True) for which in (1, 0))
    reweight = Move(Stage.REWEIGHT, Weights.PENALTY)
    return [
        Move(Stage.LOAD), *null_space(solver), Move(Stage.BEGIN_WEIGHTS, Weights.PENALTY),
        *rounds(1, *first, Move(Stage.BEGIN_WEIGHTS, Weights.PENALTY + AGAIN)),
        *rounds(TRANSLATION_ROUNDS, reweight, *first),
        *rounds(NARROW_ROUNDS + ROUNDS, reweight, *full),
        *finished(factored=False),
    ]  # fmt: skip


FNS_FROM_RAW = replace(FNS, moves=_from_raw)
JOINT = replace(ROBUST_TLS, moves=_joint)
TRANSLATION_FIRST = replace(ROBUST_TLS, moves=_unnarrowed)
