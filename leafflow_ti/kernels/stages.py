"""The per-pixel stages by number, and the kernel that runs them all."""

import functools
from typing import Any

from leafflow_ti.kernels.covariance import covariance_stages
from leafflow_ti.kernels.cut import cut_stages
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
        weighted_stages, cut_stages,
    )  # fmt: skip
    made = {name: stage for make in makers for name, stage in vars(make(spec)).items()}
    return {stage: made[stage.name.lower()] for stage in Stage}


LASTS = (Stage.EMIT, Stage.UNWHITEN, max(Stage))
"""The last stages of the kernels that hold several: windows are whole, may be cut, are weighted anew."""


def stage_kernel(spec: KernelSpec, stage: Stage) -> Any:
    """The kernel of one stage: ``group.group_kernel``."""
    return group_kernel(spec, (_functions(spec)[stage],))


def stages_kernel(spec: KernelSpec, largest: Stage) -> Any:
    """The kernel of all stages up to the first of ``LASTS`` that is not before ``largest``."""
    functions, last = _functions(spec), next(s for s in LASTS if s >= largest)
    return group_kernel(spec, tuple(functions[s] for s in Stage if s <= last))
