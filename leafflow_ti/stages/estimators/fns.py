"""The fundamental numerical scheme (Schuchert 2010, section 2.3.4; Chojnacki et al. 2000).

The eigenvectors nearest to 0 of ``Σ w d d^T / p^T C p - Σ w (p^T d)² C / (p^T C p)²``: where it converges it minimises
the sum that Sampson's scheme only weighs by. Which eigenvectors these are depends on the units of the columns.
"""

from __future__ import annotations

from leafflow_ti.stages.estimators.moves import Estimator, Move, Stage, Weights, finished, null_space, rounds

ROUNDS = 6
"""Measured as for Sampson's scheme, the sixth changes the solution by less than a millionth of its standard error."""


def _moves(solver: str, cut: bool) -> list[Move]:
    begin = [Move(Stage.LOAD), *null_space(solver), Move(Stage.BEGIN_WEIGHTS, Weights.NOISE)]
    step = (Move(Stage.FUNDAMENTAL, raw=True), Move(Stage.PARAMETERS, raw=True))
    again = rounds(ROUNDS, Move(Stage.REWEIGHT, Weights.FUNDAMENTAL), *step)
    # Residuals are told from the noise of the weighted window.
    last = Move(Stage.REWEIGHT, Weights.NOISE, anew=True)
    return [*begin, *again, last, *finished(factored=False)]


FNS = Estimator(_moves, weighs=True, denoise=0.0)
