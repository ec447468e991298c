"""Orientation of the structure in an image: fast where a backend is installed, and the same without one."""

from __future__ import annotations

from functools import cache
from importlib.metadata import entry_points
from types import ModuleType

import numpy as np

GROUP = "leafflow.backends"


@cache
def implementation() -> ModuleType:
    """What has ``structure_tensor_2d`` and ``eig_special_2d``: what is registered in the group, else ``own``.

    One that is registered and cannot be imported is an error of the installation, which is not hidden.
    """
    for entry in entry_points(group=GROUP, name="structure_tensor"):
        return entry.load()
    from leafflow_consumer import own

    return own


def orientation(image: np.ndarray, sigma: float, rho: float) -> np.ndarray:
    """Angle [rad, in 0 .. pi, from the x axis towards y] along which an image [y, x] changes least, in every pixel.

    ``sigma``, ``rho``: scales [px] of the derivatives, and of the neighbourhood.
    """
    backend = implementation()
    _, along = backend.eig_special_2d(backend.structure_tensor_2d(image, sigma, rho))
    return np.arctan2(along[0], along[1]) % np.pi  # the first axis of an array is y
