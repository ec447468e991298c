"""Orientation of fibres in a volume: ``python examples/orientation_3d.py``.

Only the import differs from a program that uses the package structure-tensor itself.
"""

import numpy as np

from leafflow_ti.backend.compat.structure_tensor import eig_special_3d, structure_tensor_3d

# A bundle of fibres along a known direction (x, y, z), 6 voxels apart, with noise; yours comes from a scanner.
direction = np.array([0.6, 0.48, 0.64])
across = np.linalg.svd(direction[None])[2][1:]  # two directions perpendicular to it
z, y, x = np.mgrid[:48, :48, :48].astype(np.float32)
phases = [2 * np.pi / 6 * (a[0] * x + a[1] * y + a[2] * z) for a in across]
volume = np.cos(phases[0]) + np.cos(phases[1]) + 0.1 * np.random.default_rng(0).standard_normal(x.shape)

tensors = structure_tensor_3d(volume.astype(np.float32), sigma=1.0, rho=3.0)
values, vectors = eig_special_3d(tensors)  # the vector of the smallest eigenvalue points along the fibres, [x, y, z]

inner = (slice(None), *[slice(12, -12)] * 3)
cosine = np.abs(np.tensordot(direction, vectors[inner], 1)).clip(0, 1)
error = np.rad2deg(np.arccos(cosine))
anisotropy = 1 - values[2][inner[1:]] / values[0][inner[1:]]
print(f"direction of the fibres: mean error {error.mean():.2f}, largest {error.max():.2f} degrees")
print(f"anisotropy of the tensors: {anisotropy.mean():.3f}")
raise SystemExit(int(error.max() > 2))
