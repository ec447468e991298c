"""The estimators of the flow parameters, by name.

An estimator is a function of the solver ("fast" or "jacobi") that returns the stages of a solution: each with whether
it works on the tensor in raw units. They leave parameters, residual variances and the factor of the equilibrated
tensor in the workspace.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from leafflow_ti.stages.estimators.ols import ols
from leafflow_ti.stages.estimators.tls import tls, tls_equilibrated

Stages = list[tuple[Any, bool]]
ESTIMATORS: dict[str, Callable[[str], Stages]] = {
    "ols": ols,
    "tls": tls,
    "tls-equilibrated": tls_equilibrated,
}
