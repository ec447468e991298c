"""The estimators of the flow parameters, by name.

An estimator is a function of the stage and of the tables of a data vector that returns the solving of one batch: a
function that is given ``launch(kernel, value=None)`` and leaves parameters, residual variances and the factor of the
equilibrated tensor in the workspace.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from leafflow_ti.stages.estimators.ols import ols
from leafflow_ti.stages.estimators.tls import tls, tls_equilibrated

Launch = Callable[..., None]
ESTIMATORS: dict[str, Callable[[Any, Any], Callable[[Launch], None]]] = {
    "ols": ols,
    "tls": tls,
    "tls-equilibrated": tls_equilibrated,
}
