"""The three stages in numba: what the library's kernels must not be slower than, stage by stage (``numba_kernels``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from leafflow_ti.plan import Plan
from leafflow_ti.sampling import column_noise
from perf.numba_kernels import TAPS, frame_maps, moment_windows, null_space
from perf.stage_tables import Tables, window_powers

Array = NDArray[Any]


@dataclass
class NumbaTwin:
    """The three stages on the frames of one plan, ready to be called and timed one by one."""

    plan: Plan
    threads: int

    def __post_init__(self) -> None:
        numba.set_num_threads(self.threads)
        sampling, self.tables = self.plan.problem.sampling, Tables.of(self.plan)
        self._d, self._b = (sampling.x.kernel(differentiate).astype(np.float32) for differentiate in (True, False))
        self._cameras, self._time = (window_powers(sampling.axis(a), 1) for a in ("sx", "t"))
        self._y, self._x = (window_powers(sampling.axis(a), TAPS) for a in ("y", "x"))
        columns = self.plan.problem.columns
        self._scale, self._k = column_noise(sampling, columns) ** -0.5, columns.n_time_like

    def filter(self, frames: Array) -> Array:
        """Maps [maps, rows, cols] of the middle one of 5 frames [5, 9, rows + 4, cols + 4], float32."""
        out = np.empty((self.tables.n_maps, frames.shape[2] - 4, frames.shape[3] - 4), np.float32)
        frame_maps(frames, self._d, self._b, self._cameras, self.tables.pairs, out)
        return out

    def stack(self, maps: list[Array]) -> Array:
        """The maps of several frames as one array."""
        return np.stack(maps)

    def tensor(self, maps: Array) -> Array:
        """Packed tensors [entries, rows, cols] from the maps of 5 frames."""
        t, plan = self.tables, self.plan
        out = np.empty((len(plan.layout.entries), len(plan.y), len(plan.x)), np.float32)
        stride = plan.x.step
        moment_windows(maps, self._time, self._y, self._x, t.tall, t.first, t.wide, stride, out)
        return out

    def solve(self, tensor: Array) -> Array:
        """Parameters [rows, cols, k, n_flow]."""
        pixels = tensor.shape[1] * tensor.shape[2]
        out = np.empty((pixels, self._k, len(self._scale) - self._k))
        null_space(tensor.reshape(len(tensor), pixels), self.tables.lower, self._scale, self._k, out)
        return out.reshape(*tensor.shape[1:], *out.shape[1:])
