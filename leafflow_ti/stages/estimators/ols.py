"""Ordinary least squares (Schuchert 2010, Eq. (2.15)): all the noise is in the time-like derivatives."""

from __future__ import annotations

from typing import Any


def ols(solver: str) -> list[tuple[Any, bool]]:
    """``J_ff p = -J_f,time`` for every solution, by one Cholesky factor."""
    from leafflow_ti.kernels.stages import Stage

    stages = (
        Stage.LOAD, Stage.SCALE, Stage.FACTORISE, Stage.LEAST_SQUARES, Stage.ACCEPT, Stage.PARAMETERS,
        Stage.RESIDUALS, Stage.CENTRE,
    )  # fmt: skip
    return [(stage, False) for stage in stages]
