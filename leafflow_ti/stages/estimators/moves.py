"""What an estimator is made of: moves of all pixels of a group, in order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from leafflow_ti.kernels.numbers import Stage, Weights

__all__ = ["Estimator", "Move", "Stage", "Weights", "equilibrated", "finished", "null_space", "rounds"]


@dataclass(frozen=True)
class Move:
    """A stage and its argument. ``raw``: on the tensor in raw units; ``anew``: only for groups of pixels of which one's
    window is weighted anew."""

    stage: Stage
    which: int = 0
    raw: bool = False
    anew: bool = False


@dataclass(frozen=True)
class Estimator:
    """``moves``: a function of the solver ("fast" or "jacobi"), and of whether windows may be cut. They leave
    parameters, residual variances and the factor of the equilibrated tensor in the workspace.

    ``biased``: the noise of the columns pulls solutions towards 0, which counts among their errors.
    ``weighs``: windows are weighted anew; ``robust``: by their residuals. ``denoise``: share of the gradients' own
    noise that the covariances take out of J_ff; none where J_ff is divided by as it is, or where the residual is no
    bound for the eigenvalues of the equilibrated tensor. What noise adds to J_ff is no structure: taking nearly all of
    it leaves the matrix definite where there is nothing else, and makes the standard errors there ten times larger.
    """

    moves: Callable[[str, bool], list[Move]]
    weighs: bool = False
    denoise: float = 0.9
    robust: bool = False
    biased: bool = False


def null_space(solver: str, raw: bool = False, which: int = 0, whitened: bool = False) -> list[Move]:
    """The eigenvectors of the smallest eigenvalues of the scaled tensor, as parameters.

    By block inverse iteration from the least-squares solution, and full cyclic Jacobi for the pixels whose gap is too
    small for it; by Jacobi alone with the solver "jacobi". ``which`` = 1: columns with an offset are left out.
    ``whitened``: eigenvectors of the tensor against the noise of the weighted window.
    """
    before, behind = [Stage.SCALE], [Stage.PARAMETERS]
    if whitened:
        before, behind = [*before, Stage.WHITEN], [Stage.UNWHITEN, *behind]
    fast = [Stage.INVERSE_ITERATION] if solver == "fast" else []
    search = [*before, Stage.FACTORISE, Stage.LEAST_SQUARES, *fast, Stage.JACOBI, *behind]
    return [Move(stage, which, raw) for stage in search]


def rounds(number: int, *moves: Move) -> list[Move]:
    """Moves again and again, for windows that are weighted anew alone."""
    return [replace(move, anew=True) for move in moves] * number


def equilibrated(solver: str, cut: bool) -> list[Move]:
    """The k smallest eigenvectors of ``C^-1/2 J C^-1/2``; of ``cut`` windows those of J against the noise of its
    columns. The equilibrated tensor is left factored."""
    found = [Move(Stage.LOAD), *null_space(solver)]
    if cut:
        anew = rounds(1, *null_space(solver, whitened=True), Move(Stage.SCALE), Move(Stage.FACTORISE))
        found += [Move(Stage.CUT_WINDOWS), *anew]
    return found


def finished(factored: bool, cut: bool = False) -> list[Move]:
    """Residuals and the values at the window's centre; on the equilibrated tensor, unless it is ``factored``.

    ``cut``: windows may be, which nothing before has looked at.
    """
    again = [] if factored else [Move(Stage.SCALE), Move(Stage.FACTORISE)]
    again += [Move(Stage.CUT_WINDOWS)] if cut else []
    return [*again, Move(Stage.RESIDUALS), Move(Stage.CENTRE)]
