"""The kernels as plain functions on arrays, for other programs: NumPy in, NumPy out; torch tensors in, tensors out.

    from leafflow_ti import backend
    flow = backend.optical_flow(frames)

Importing it starts no compute engine and loads no heavy module; the names below load theirs when first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from leafflow_ti.backend.boundary import ArrayError, ArrayTypeError
    from leafflow_ti.backend.eigen import (
        eig_special_2d,
        eig_special_3d,
        eigenvalues_2d,
        eigenvalues_3d,
        eigh,
        null_space,
    )
    from leafflow_ti.backend.filters import derivatives, gaussian, gaussian_moments
    from leafflow_ti.backend.flow import epi_disparity, optical_flow
    from leafflow_ti.backend.prefilters import highpass, homomorphic
    from leafflow_ti.backend.tensors import structure_tensor, structure_tensor_2d, structure_tensor_3d
    from leafflow_ti.backend.warming import warm_up

_HOME = {
    "ArrayError": "boundary", "ArrayTypeError": "boundary",
    "eigh": "eigen", "null_space": "eigen", "eig_special_2d": "eigen", "eig_special_3d": "eigen",
    "eigenvalues_2d": "eigen", "eigenvalues_3d": "eigen",
    "derivatives": "filters", "gaussian": "filters", "gaussian_moments": "filters",
    "optical_flow": "flow", "epi_disparity": "flow",
    "highpass": "prefilters", "homomorphic": "prefilters",
    "structure_tensor": "tensors", "structure_tensor_2d": "tensors", "structure_tensor_3d": "tensors",
    "warm_up": "warming",
}  # fmt: skip
__all__ = [
    "ArrayError", "ArrayTypeError", "derivatives", "eig_special_2d", "eig_special_3d", "eigenvalues_2d",
    "eigenvalues_3d", "eigh", "epi_disparity", "gaussian", "gaussian_moments", "highpass", "homomorphic",
    "null_space", "optical_flow",
    "structure_tensor", "structure_tensor_2d", "structure_tensor_3d", "warm_up",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'leafflow_ti.backend' has no attribute '{name}'")
    return getattr(import_module(f"leafflow_ti.backend.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
