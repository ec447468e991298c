"""What this machine can do at best, measured: multiply-adds per second, and bytes per second from memory and cache."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from leafflow_ti.runtime import Device

ENOUGH_S = 0.01
"""A measurement is repeated with more steps until it takes this long: a launch costs a hundredth of it."""
REPEATS = 6
"""The best of these counts: nothing makes a processor faster than it is, much makes it slower."""
VECTORS = (16, 32)
"""Lanes that are tried on the CPU."""
GPU_THREADS = 1 << 16
MEMORY_BYTES = 64 << 20
"""Of each array that does not fit into a cache."""
CACHE_BYTES = 128 << 10
"""Of each array of one thread that does: three of them lie in the second-level cache of a core."""


@dataclass(frozen=True)
class Ceilings:
    """``gflops_f32``, ``gflops_f64``: 10^9 flops/s of multiply-adds, a multiply-add being two (NaN where the device has
    no double precision). ``gbytes``: 10^9 bytes/s read and written by ``a = b + f c`` in memory, ``gbytes_cache``: in
    the second-level cache (NaN on a GPU)."""

    gflops_f32: float
    gflops_f64: float
    gbytes: float
    gbytes_cache: float

    def gflops(self, precision: str) -> float:
        """The ceiling of one precision, "f32" or "f64"."""
        return self.gflops_f32 if precision == "f32" else self.gflops_f64


def measure_ceilings(device: Device) -> Ceilings:
    """Measure for all threads of the device; takes about half a second, and 200 MB of memory for its time."""
    from leafflow_ti.kernels.engine import quick_front_end

    with quick_front_end():
        return Ceilings(
            _multiply_adds(device, "f32"),
            math.nan if device.algebra == "f32" else _multiply_adds(device, "f64"),
            _triad(device, MEMORY_BYTES),
            math.nan if device.gpu else _triad(device, CACHE_BYTES * device.threads),
        )


def _rate(launch: Callable[[int], None], work: float) -> float:
    """Work per second of ``launch(n_steps)``, given the work of a step."""

    def seconds(n: int) -> float:
        began = time.perf_counter()
        launch(n)
        return time.perf_counter() - began

    n_steps = 1
    launch(n_steps)  # compiles
    while (last := seconds(n_steps)) < ENOUGH_S:
        n_steps *= 2 if last > ENOUGH_S / 4 else 4
    return work * n_steps / min(last, *(seconds(n_steps) for _ in range(REPEATS)))


def _multiply_adds(device: Device, precision: str) -> float:
    """10^9 flops/s: the best over the widths of vectors."""
    from leafflow_ti.kernels.ceilings import CHAINS, fma_kernel

    own = replace(device, storage=precision)
    tasks = GPU_THREADS if device.gpu else device.threads

    def of(lanes: int) -> float:
        kernel = fma_kernel(replace(own.planes, lanes=lanes))
        start = own.vectors(own.array(np.repeat([0.5, 0.25], lanes)), lanes)
        result = own.vectors(own.empty(tasks * lanes), lanes)

        def launch(n_steps: int) -> None:
            kernel(tasks, n_steps, start, result)
            own.synchronize()

        return _rate(launch, 2 * CHAINS * lanes * tasks) / 1e9

    return max(of(lanes) for lanes in ((1,) if device.gpu else VECTORS))


def _triad(device: Device, n_bytes: int) -> float:
    """10^9 bytes/s with arrays of ``n_bytes`` each, all threads together."""
    from leafflow_ti.kernels.ceilings import triad_kernel

    own = replace(device, storage="f32")
    lanes = 1 if device.gpu else VECTORS[-1]
    tasks = 1 if device.gpu else device.threads
    size = n_bytes // 4 // lanes // tasks
    kernel = triad_kernel(replace(own.planes, lanes=lanes))
    arrays = [own.empty(tasks * size * lanes) for _ in range(3)]
    for array in arrays:
        array.fill(1.0)
    a, b, c = (own.vectors(array, lanes) for array in arrays)

    def launch(n_steps: int) -> None:
        if device.gpu:
            for _ in range(n_steps):
                kernel(tasks, size, 1, b, c, a)
        else:
            kernel(tasks, size, n_steps, b, c, a)
        own.synchronize()

    return _rate(launch, 3 * 4 * tasks * size * lanes) / 1e9
