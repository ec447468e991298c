"""Ordinary least squares (Schuchert 2010, Eq. (2.15)): all the noise is in the time-like derivatives."""

from __future__ import annotations

from leafflow_ti.stages.estimators.moves import Estimator, Move, Stage, finished


def least_squares(which: int = 0) -> list[Move]:
    """``J_ff p = -J_f,time`` for every solution, by one Cholesky factor; ``which`` = 1: without columns that have an
    offset."""
    stages = (Stage.SCALE, Stage.FACTORISE, Stage.LEAST_SQUARES, Stage.ACCEPT, Stage.PARAMETERS)
    return [Move(stage, which) for stage in stages]


def _moves(solver: str, cut: bool) -> list[Move]:
    return [Move(Stage.LOAD), *least_squares(), *finished(factored=True, cut=cut)]


OLS = Estimator(_moves, denoise=0.0, biased=True)
