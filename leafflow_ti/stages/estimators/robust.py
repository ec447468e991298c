"""Robust least squares and total least squares (Schuchert 2010, Eqs. (2.35)-(2.44)): residuals count by a penalty.

σ of the penalty is graduated: it begins where everything counts and shrinks round by round to what noise explains.
The translation comes first, the derivatives second: at discontinuities the joint fit has local minima (Fig. 2.8).
Only pixels whose plain fit failed are estimated anew, unless all are asked for.
"""

from __future__ import annotations

from leafflow_ti.kernels.numbers import AGAIN, NARROW
from leafflow_ti.stages.estimators.moves import Estimator, Move, Stage, Weights, finished, null_space, rounds
from leafflow_ti.stages.estimators.ols import least_squares

TRANSLATION_ROUNDS = 4
NARROW_ROUNDS = 4
ROUNDS = 4
SWEEPS = 8
"""Of over-relaxation, per round of weights."""


def _graduated(weights: Weights, start: list[Move], first: list[Move], full: list[Move]) -> list[Move]:
    """Plain solution ``start``, then rounds for the translation, then for everything.

    At first the middle of the window counts most: where two surfaces meet, the one that the pixel lies on must win,
    not the one that fills more of the window or has more texture.
    """
    near, far = Move(Stage.REWEIGHT, weights + NARROW), Move(Stage.REWEIGHT, weights)
    return [
        Move(Stage.LOAD), *start, Move(Stage.BEGIN_WEIGHTS, weights),
        *rounds(1, Move(Stage.REWEIGHT, Weights.NOISE + NARROW), *first, Move(Stage.BEGIN_WEIGHTS, weights + AGAIN)),
        *rounds(TRANSLATION_ROUNDS, near, *first),
        *rounds(NARROW_ROUNDS, near, *full),
        *rounds(ROUNDS, far, *full),
        *finished(factored=False),
    ]  # fmt: skip


def _ols(solver: str, cut: bool) -> list[Move]:
    """Iteratively reweighted least squares."""
    return _graduated(Weights.PENALTY_PLAIN, least_squares(), least_squares(which=1), least_squares())


def _sor(solver: str, cut: bool) -> list[Move]:
    """Successive over-relaxation: the derivatives start at the translation."""
    sweeps = [Move(Stage.SCALE), Move(Stage.RELAX, SWEEPS)]
    return _graduated(Weights.PENALTY_PLAIN, least_squares(), least_squares(which=1), sweeps)


def _tls(solver: str, cut: bool) -> list[Move]:
    first, full = (null_space(solver, which=which, whitened=True) for which in (1, 0))
    return _graduated(Weights.PENALTY, null_space(solver), first, full)


ROBUST_OLS = Estimator(_ols, weighs=True, denoise=0.0, robust=True, biased=True)
ROBUST_OLS_SOR = Estimator(_sor, weighs=True, denoise=0.0, robust=True, biased=True)
ROBUST_TLS = Estimator(_tls, weighs=True, robust=True)
