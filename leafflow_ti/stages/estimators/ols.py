"""Ordinary least squares (Schuchert 2010, Eq. (2.15)): all the noise is in the time-like derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


def ols(stage: Any, tables: Any) -> Callable[[Callable[..., None]], None]:
    """``J_ff p = -J_f,time`` for every solution, by one Cholesky factor."""
    from leafflow_ti.kernels.null_space import null_space_kernels

    kernels = null_space_kernels(stage.device.dense)

    def solve(launch: Callable[..., None]) -> None:
        launch(kernels.load)
        launch(kernels.least_squares)
        launch(kernels.accept)
        launch(kernels.parameters)
        launch(kernels.residuals)
        launch(kernels.centre)

    return solve
