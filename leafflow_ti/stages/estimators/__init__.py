"""The estimators of the flow parameters, by name."""

from __future__ import annotations

from leafflow_ti.stages.estimators.fns import FNS
from leafflow_ti.stages.estimators.for3 import FOR3
from leafflow_ti.stages.estimators.moves import Estimator, Move
from leafflow_ti.stages.estimators.ols import OLS
from leafflow_ti.stages.estimators.robust import ROBUST_OLS, ROBUST_OLS_SOR, ROBUST_TLS
from leafflow_ti.stages.estimators.sampson import SAMPSON
from leafflow_ti.stages.estimators.tls import TLS, TLS_EQUILIBRATED

__all__ = ["ESTIMATORS", "Estimator", "Move"]
ESTIMATORS: dict[str, Estimator] = {
    "ols": OLS,
    "tls": TLS,
    "tls-equilibrated": TLS_EQUILIBRATED,
    "sampson": SAMPSON,
    "fns": FNS,
    "for3": FOR3,
    "robust-ols": ROBUST_OLS,
    "robust-ols-sor": ROBUST_OLS_SOR,
    "robust-tls": ROBUST_TLS,
}
