"""Total least squares (Schuchert 2010, Eq. (2.17)): the null space of the structure tensor.

In raw units, or equilibrated: with the columns scaled to equal noise it minimises ``p^T J p / p^T C p``, whatever
their units.
"""

from __future__ import annotations

from leafflow_ti.stages.estimators.moves import Estimator, Move, Stage, finished, null_space


def _equilibrated(solver: str) -> list[Move]:
    """The k smallest eigenvectors of ``C^-1/2 J C^-1/2``."""
    return [Move(Stage.LOAD), *null_space(solver), *finished(factored=True)]


def _raw(solver: str) -> list[Move]:
    """The k smallest eigenvectors of J itself; depends on the units of the columns (section 2.3.3)."""
    return [Move(Stage.LOAD), *null_space(solver, raw=True), *finished(factored=False)]


TLS_EQUILIBRATED = Estimator(_equilibrated)
TLS = Estimator(_raw, denoise=0.0)
