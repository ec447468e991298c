"""Total least squares (Schuchert 2010, Eq. (2.17)): the null space of the structure tensor.

In raw units, or equilibrated: with the columns scaled to equal noise it minimises ``p^T J p / p^T C p``, whatever
their units. The null space comes from a block inverse iteration that starts at the least-squares solution, or from
a full cyclic Jacobi.
"""

from __future__ import annotations

from typing import Any


def tls_equilibrated(solver: str) -> list[tuple[Any, bool]]:
    """The k smallest eigenvectors of ``C^-1/2 J C^-1/2``."""
    return _null_space(solver, False)


def tls(solver: str) -> list[tuple[Any, bool]]:
    """The k smallest eigenvectors of J itself; depends on the units of the columns (section 2.3.3)."""
    return _null_space(solver, True)


def _null_space(solver: str, raw: bool) -> list[tuple[Any, bool]]:
    from leafflow_ti.kernels.stages import Stage

    # Jacobi takes all pixels, or those whose gap is too small for the iteration.
    fast = [Stage.INVERSE_ITERATION] if solver == "fast" else []
    search = [Stage.SCALE, Stage.FACTORISE, Stage.LEAST_SQUARES, *fast, Stage.JACOBI, Stage.PARAMETERS]
    # Residuals and covariances are worked out on the equilibrated tensor.
    again = [Stage.SCALE, Stage.FACTORISE] if raw else []
    steps = [(Stage.LOAD, False), *((stage, raw) for stage in search)]
    return steps + [(stage, False) for stage in (*again, Stage.RESIDUALS, Stage.CENTRE)]
