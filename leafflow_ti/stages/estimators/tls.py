"""Total least squares (Schuchert 2010, Eq. (2.17)): the null space of the structure tensor.

In raw units, or equilibrated: with the columns scaled to equal noise it minimises ``p^T J p / p^T C p``, whatever
their units.
"""

from __future__ import annotations

from leafflow_ti.stages.estimators.moves import Estimator, Move, Stage, equilibrated, finished, null_space


def _equilibrated(solver: str, cut: bool) -> list[Move]:
    return [*equilibrated(solver, cut), *finished(factored=True)]


def _raw(solver: str, cut: bool) -> list[Move]:
    """The k smallest eigenvectors of J itself; depends on the units of the columns (section 2.3.3)."""
    return [Move(Stage.LOAD), *null_space(solver, raw=True), *finished(factored=False, cut=cut)]


TLS_EQUILIBRATED = Estimator(_equilibrated)
TLS = Estimator(_raw, denoise=0.0)
