"""Total least squares (Schuchert 2010, Eq. (2.17)): the null space of the structure tensor.

In raw units, or equilibrated: with the columns scaled to equal noise it minimises ``p^T J p / p^T C p``, whatever
their units. The null space comes from a block inverse iteration that starts at the least-squares solution, or from
a full cyclic Jacobi.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

Solve = Callable[[Callable[..., None]], None]


def tls_equilibrated(stage: Any, tables: Any) -> Solve:
    """The k smallest eigenvectors of ``C^-1/2 J C^-1/2``."""
    return _null_space(stage, None)


def tls(stage: Any, tables: Any) -> Solve:
    """The k smallest eigenvectors of J itself; depends on the units of the columns (section 2.3.3)."""
    return _null_space(stage, stage.device.array(stage.unscaled(tables.value), "algebra"))


def _null_space(stage: Any, value: Any) -> Solve:
    from leafflow_ti.kernels.null_space import null_space_kernels

    kernels = null_space_kernels(stage.device.dense)

    def solve(launch: Callable[..., None]) -> None:
        launch(kernels.load, value=value)
        launch(kernels.least_squares, value=value)
        if stage.problem.solver == "fast":
            launch(kernels.inverse_iteration, value=value)
        if stage.unsolved():
            # All pixels, or those whose gap is too small for the iteration.
            launch(kernels.jacobi, value=value)
        launch(kernels.parameters, value=value)
        if value is not None:
            # Residuals and covariances are worked out on the equilibrated tensor.
            launch(kernels.load)
            launch(kernels.factorise)
        launch(kernels.residuals)
        launch(kernels.centre)

    return solve
