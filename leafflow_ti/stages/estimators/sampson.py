"""Sampson's scheme (Schuchert 2010, section 2.3.4): total least squares with samples weighted by their own noise.

``Σ w p^T d d^T p / p^T C p`` with the denominator of the solution before, and the smallest eigenvectors in raw units:
these depend on the units, and noise in the columns biases them, as in plain total least squares.
"""

from __future__ import annotations

from leafflow_ti.stages.estimators.moves import Estimator, Move, Stage, Weights, finished, null_space, rounds

ROUNDS = 6
"""Weights follow the solution: measured with noise of 10 at a contrast of 25 and strong divergence, the sixth changes
it by less than a thousandth of its standard error."""


def _moves(solver: str, cut: bool) -> list[Move]:
    begin = [Move(Stage.LOAD), *null_space(solver), Move(Stage.BEGIN_WEIGHTS, Weights.NOISE)]
    again = rounds(ROUNDS, Move(Stage.REWEIGHT, Weights.NOISE), *null_space(solver, raw=True))
    return [*begin, *again, *finished(factored=False)]


SAMPSON = Estimator(_moves, weighs=True, denoise=0.0)
