"""Functions of the package structure-tensor: ``from leafflow_ti.backend.compat.structure_tensor import ...``.

Results are equal within rounding, but where the package's depend on what it cannot know: eigenvectors of tensors with
repeated eigenvalues, and of integer images, which it computes in integers and these functions in floats.
"""

from leafflow_ti.backend.blockwise import parallel_structure_tensor_analysis
from leafflow_ti.backend.eigen import eig_special_2d, eig_special_3d
from leafflow_ti.backend.tensors import structure_tensor_2d, structure_tensor_3d

__all__ = [
    "eig_special_2d", "eig_special_3d", "parallel_structure_tensor_analysis", "structure_tensor_2d",
    "structure_tensor_3d",
]  # fmt: skip
