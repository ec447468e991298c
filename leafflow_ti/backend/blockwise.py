"""Structure tensors and their eigensolutions of large volumes, block by block, with bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any, Literal

import numpy as np

from leafflow_ti.backend.boundary import ArrayError
from leafflow_ti.backend.eigen import eig_special_3d, eigenvalues_3d
from leafflow_ti.backend.tensors import structure_tensor_3d
from leafflow_ti.errors import ConfigError

Block = tuple[slice, ...]


def parallel_structure_tensor_analysis(
    volume: Any,
    sigma: float,
    rho: float,
    eigenvectors: Any = np.float32,
    eigenvalues: Any = np.float32,
    structure_tensor: Any = None,
    truncate: float = 4.0,
    block_size: int = 128,
    include_all_eigenvectors: bool = False,
    eigenvalue_order: Literal["desc", "asc"] = "desc",
    devices: Sequence[str] | None = None,
    progress_callback_fn: Callable[[int, int], None] | None = None,
    fallback_to_cpu: bool = True,
    pool_type: Literal["process", "thread"] = "thread",
) -> tuple[Any, Any, Any]:
    """Structure tensors [6, ...], eigenvalues [3, ...] and eigenvectors [3, ...] (with ``include_all_eigenvectors`` [3,
    3, ...]) of a ``volume`` [z, y, x] (an array or memmap) in blocks of ``block_size`` voxels across.

    ``structure_tensor``, ``eigenvalues``, ``eigenvectors``: each an array (or memmap) to write into, a type for a new
    one, or None: not wanted, and None in what is returned. ``sigma``, ``rho``, ``truncate``, ``eigenvalue_order`` as in
    ``structure_tensor_3d`` and ``eig_special_3d``, to whose results these are equal within rounding.
    ``progress_callback_fn`` is called with the number of blocks done and of all.

    Everything runs in this process, on all threads of its engine: ``pool_type`` and ``fallback_to_cpu`` have no effect,
    and ``devices`` may name "cpu" alone; ``LEAFFLOW_TI_ARCH`` chooses the device.

    Raises ArrayError for other shapes, ConfigError for options out of range.
    """
    if np.ndim(volume) != 3:
        raise ArrayError(f"the volume has the shape {np.shape(volume)}: it must have 3 axes")
    if block_size < 1:
        raise ConfigError(f"block_size is {block_size}: it must be 1 voxel or more")
    if any(device.lower() != "cpu" for device in devices or ()):
        raise ConfigError(
            f"devices is {list(devices or ())}: only 'cpu' can be named; LEAFFLOW_TI_ARCH=cuda is for GPUs"
        )
    if eigenvectors is None and eigenvalues is None and structure_tensor is None:
        raise ConfigError(
            "nothing is asked for: give a type or an array for eigenvectors, eigenvalues or structure_tensor"
        )
    shape = volume.shape
    rows = (3, 3) if include_all_eigenvectors else (3,)
    tensors = _target("structure_tensor", structure_tensor, (6, *shape))
    values = _target("eigenvalues", eigenvalues, (3, *shape))
    vectors = _target("eigenvectors", eigenvectors, (*rows, *shape))
    halo = int(truncate * sigma + 0.5) + int(truncate * rho + 0.5)
    blocks = list(_blocks(shape, block_size, halo))
    for number, (wide, inner, block) in enumerate(blocks):
        part = np.asarray(volume[wide])
        found = structure_tensor_3d(part, sigma, rho, truncate=truncate)[(slice(None), *inner)]
        if tensors is not None:
            tensors[(slice(None), *block)] = found
        if vectors is not None:
            own, turned = eig_special_3d(found, include_all_eigenvectors, eigenvalue_order)
            vectors[(..., *block)] = turned
        elif values is not None:
            own = eigenvalues_3d(found, eigenvalue_order)
        if values is not None:
            values[(slice(None), *block)] = own
        if progress_callback_fn is not None:
            progress_callback_fn(number + 1, len(blocks))
    return tensors, values, vectors


def _target(name: str, wanted: Any, shape: tuple[int, ...]) -> Any:
    if wanted is None:
        return None
    if not isinstance(wanted, np.ndarray):
        return np.empty(shape, wanted)
    if wanted.shape != shape or not wanted.flags.writeable:
        raise ArrayError(f"{name} has the shape {wanted.shape}: it must be {shape}, and writable")
    return wanted


def _blocks(shape: tuple[int, ...], size: int, halo: int) -> Iterator[tuple[Block, Block, Block]]:
    """What a block reads, where it lies in that, and where in the volume."""
    for begin in product(*(range(0, n, size) for n in shape)):
        block = tuple(slice(b, min(b + size, n)) for b, n in zip(begin, shape, strict=True))
        wide = tuple(slice(max(0, s.start - halo), min(n, s.stop + halo)) for s, n in zip(block, shape, strict=True))
        inner = tuple(slice(s.start - w.start, s.stop - w.start) for s, w in zip(block, wide, strict=True))
        yield wide, inner, block
