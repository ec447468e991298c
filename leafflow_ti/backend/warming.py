"""Compiling beforehand what a program is going to call.

The first call of a function with a new structure (its kind of numbers, how many columns, which order) compiles its
kernels, for seconds; where they are kept from an earlier process they are loaded, for tenths of a second.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from leafflow_ti.errors import ConfigError

Make = Callable[..., NDArray[Any]]
"""``make(4, 5)``: numbers of that shape, of the kind that is warmed up."""

CALLS: dict[str, Callable[[Any, Make], object]] = {
    "derivatives": lambda backend, make: backend.derivatives(make(9, 10)),
    "gaussian": lambda backend, make: backend.gaussian(make(9, 10), 1.0),
    "gaussian_moments": lambda backend, make: backend.gaussian_moments(make(9, 10), 1.0, [(0, 0)]),
    "structure_tensor": lambda backend, make: backend.structure_tensor(make(2, 9, 10), 1.0),
    "structure_tensor_2d": lambda backend, make: backend.structure_tensor_2d(make(9, 10), 1.0, 1.0),
    "structure_tensor_3d": lambda backend, make: backend.structure_tensor_3d(make(8, 9, 10), 1.0, 1.0),
    "eigh": lambda backend, make: backend.eigh(_symmetric(make(4, 3, 3))),
    "null_space": lambda backend, make: backend.null_space(_symmetric(make(4, 3, 3)), 1),
    "eig_special_2d": lambda backend, make: backend.eig_special_2d(make(3, 4, 5)),
    "eig_special_3d": lambda backend, make: backend.eig_special_3d(make(6, 3, 4, 5)),
    "eigenvalues_2d": lambda backend, make: backend.eigenvalues_2d(make(3, 4, 5)),
    "eigenvalues_3d": lambda backend, make: backend.eigenvalues_3d(make(6, 3, 4, 5)),
    "highpass": lambda backend, make: backend.highpass(make(9, 10), 1.0),
    "homomorphic": lambda backend, make: backend.homomorphic(1.0 + make(9, 10) ** 2, 1.0),
    "optical_flow": lambda backend, make: backend.optical_flow(make(3, 32, 33)),
    "epi_disparity": lambda backend, make: backend.epi_disparity(make(5, 32, 33)),
}
"""Function -> the smallest call that compiles what its usual calls need."""


def warm_up(*names: str, dtype: DTypeLike | Iterable[DTypeLike] = "float32") -> dict[str, float]:
    """Compile what the named functions of ``leafflow_ti.backend`` need, and say how many seconds each took.

    ``names``: such as "optical_flow"; none: all of them. ``dtype``: one kind of numbers, or several, in which
    the program is going to call them. The engine is started, if it does not run. Afterwards threads may call these
    functions at the same time without waiting for a compiler; what is asked for in another structure, such as matrices
    of another size, is still compiled when it is called.

    Raises ConfigError for a name that does not exist, DeviceError where no engine starts.
    """
    unknown = [name for name in names if name not in CALLS]
    if unknown:
        raise ConfigError(f"there is nothing to warm up for '{unknown[0]}'; choose from {', '.join(sorted(CALLS))}")
    backend = import_module("leafflow_ti.backend")
    kinds = [dtype] if isinstance(dtype, str | type | np.dtype) else list(dtype)  # type: ignore[arg-type]
    seconds = {}
    for name in names or CALLS:
        begin = time.perf_counter()
        for kind in kinds:
            CALLS[name](backend, _maker(np.dtype(kind)))
        seconds[name] = time.perf_counter() - begin
    return seconds


def _maker(kind: np.dtype[Any]) -> Make:
    random = np.random.default_rng(0)
    return lambda *shape: random.standard_normal(shape).astype(kind)


def _symmetric(matrices: NDArray[Any]) -> NDArray[Any]:
    result: NDArray[Any] = matrices + matrices.swapaxes(-1, -2)
    return result
