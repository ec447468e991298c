"""The per-pixel stages by number, and the kernel that runs them all."""

import functools
from typing import Any

from leafflow_ti.kernels.covariance import covariance_stages
from leafflow_ti.kernels.group import group_kernel
from leafflow_ti.kernels.maps import maps_stages
from leafflow_ti.kernels.null_space import null_space_stages
from leafflow_ti.kernels.numbers import Stage
from leafflow_ti.kernels.patch_fit import patch_fit_stages
from leafflow_ti.kernels.range_motion import range_motion_stages
from leafflow_ti.kernels.reweight import reweight_stages
from leafflow_ti.kernels.spec import KernelSpec
from leafflow_ti.kernels.weighted import weighted_stages


@functools.cache
def _functions(spec: KernelSpec) -> dict[Stage, Any]:
    makers = (
        null_space_stages, covariance_stages, range_motion_stages, patch_fit_stages, maps_stages, reweight_stages,
        weighted_stages,
    )  # fmt: skip
    made = {name: stage for make in makers for name, stage in vars(make(spec)).items()}
    return {stage: made[stage.name.lower()] for stage in Stage}


def stage_kernel(spec: KernelSpec, stage: Stage | None = None, reweighted: bool = False) -> Any:
    """The kernel of one stage, or of all (without ``reweighted`` up to EMIT): ``group.group_kernel``."""
    functions = _functions(spec)
    if stage is not None:
        return group_kernel(spec, (functions[stage],))
    last = max(Stage) if reweighted else Stage.EMIT
    return group_kernel(spec, tuple(functions[s] for s in Stage if s <= last))
