"""The per-pixel stages by number, and the kernel that runs them all."""

import functools
from enum import IntEnum, auto
from typing import Any

from leafflow_ti.kernels.covariance import covariance_stages
from leafflow_ti.kernels.group import group_kernel
from leafflow_ti.kernels.maps import maps_stages
from leafflow_ti.kernels.null_space import null_space_stages
from leafflow_ti.kernels.patch_fit import patch_fit_stages
from leafflow_ti.kernels.range_motion import range_motion_stages
from leafflow_ti.kernels.spec import KernelSpec


class Stage(IntEnum):
    """Number of each stage."""

    LOAD = 0
    SCALE = auto()
    FACTORISE = auto()
    LEAST_SQUARES = auto()
    ACCEPT = auto()
    INVERSE_ITERATION = auto()
    JACOBI = auto()
    PARAMETERS = auto()
    RESIDUALS = auto()
    CENTRE = auto()
    CLEAN = auto()
    ROW_COVARIANCE = auto()
    ADD_CAMERA = auto()
    GEOMETRY = auto()
    RANGE_MOTION = auto()
    PATCH_FIT = auto()
    MEASURED = auto()
    MOTION = auto()
    EMIT = auto()


@functools.cache
def _functions(spec: KernelSpec) -> dict[Stage, Any]:
    makers = (null_space_stages, covariance_stages, range_motion_stages, patch_fit_stages, maps_stages)
    made = {name: stage for make in makers for name, stage in vars(make(spec)).items()}
    return {stage: made[stage.name.lower()] for stage in Stage}


def stage_kernel(spec: KernelSpec, stage: Stage | None = None) -> Any:
    """The kernel of one stage, or of all: ``group.group_kernel``."""
    functions = _functions(spec)
    return group_kernel(spec, tuple(functions.values()) if stage is None else (functions[stage],))
