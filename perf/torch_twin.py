"""The three stages in PyTorch on the CPU: convolutions in single precision, ``linalg.eigh`` in double."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import conv2d

from leafflow_ti.plan import Plan
from leafflow_ti.sampling import column_noise
from perf.stage_tables import Tables, window_powers

Array = NDArray[Any]


@dataclass
class TorchTwin:
    """As ``NumbaTwin``; the stages take and give tensors of float32."""

    plan: Plan
    threads: int

    def __post_init__(self) -> None:
        torch.set_num_threads(self.threads)
        sampling, self.tables = self.plan.problem.sampling, Tables.of(self.plan)
        self._kernels = {
            d: torch.tensor(sampling.x.kernel(d), dtype=torch.float32) for d in (False, True)
        }  # fmt: skip
        self._cameras, self._time, self._y, self._x = (
            torch.from_numpy(window_powers(sampling.axis(a), 1)) for a in ("sx", "t", "y", "x")
        )
        columns = self.plan.problem.columns
        self._scale, self._k = torch.from_numpy(column_noise(sampling, columns) ** -0.5), columns.n_time_like

    def filter(self, frames: Array) -> Any:
        """Maps [maps, rows, cols] of the middle one of 5 frames [5, 9, rows + 4, cols + 4], float32."""
        over_t = {d: torch.tensordot(self._kernels[d], torch.from_numpy(frames), dims=1) for d in (False, True)}

        def across(image: Any, differentiate: bool) -> Any:
            taps = self._kernels[differentiate]
            return torch.stack([torch.tensordot(taps, image[s : s + 5], dims=1) for s in range(5)])

        grey, moved, turned = across(over_t[False], False), across(over_t[False], True), across(over_t[True], False)

        def inside(image: Any, y: bool, x: bool) -> Any:
            tall = conv2d(image[:, None], self._kernels[y][None, None, :, None])
            return conv2d(tall, self._kernels[x][None, None, None])[:, 0]

        channels = (
            inside(grey, False, True), inside(grey, True, False), inside(moved, False, False),
            inside(turned, False, False),
        )  # fmt: skip
        return torch.cat(
            [
                torch.tensordot(self._cameras[:n], channels[a] * channels[b], dims=1)
                for a, b, _, n in self.tables.pairs.tolist()
            ]
        )

    def stack(self, maps: list[Any]) -> Any:
        """The maps of several frames as one tensor."""
        return torch.stack(maps)

    def tensor(self, maps: Any) -> Any:
        """Packed tensors [entries, rows, cols] from the maps [5, maps, in_rows, in_cols] of 5 frames."""
        tables, stride = self.tables, self.plan.x.step
        out = torch.empty(len(self.plan.layout.entries), len(self.plan.y), len(self.plan.x))
        for i, (plane, q, n) in enumerate(tables.tall.tolist()):
            summed = torch.tensordot(self._time[q], maps[:, plane], dims=1)
            tall = conv2d(summed[None, None], self._y[n][None, None, :, None], stride=(stride, 1))
            wide = tables.wide[tables.first[i] : tables.first[i + 1]]
            kernels = self._x[torch.from_numpy(wide[:, 0])][:, None, None]
            out[torch.from_numpy(wide[:, 1])] = conv2d(tall, kernels, stride=(1, stride))[0]
        return out

    def solve(self, tensor: Any) -> Array:
        """Parameters [rows, cols, k, n_flow]."""
        n = len(self._scale)
        rows, cols = torch.tril_indices(n, n)
        entries = tensor[torch.from_numpy(self.tables.lower)].reshape(len(self.tables.lower), -1).T.double()
        full = torch.empty(len(entries), n, n, dtype=torch.float64)
        full[:, rows, cols] = full[:, cols, rows] = entries
        vectors = torch.linalg.eigh(full * torch.outer(self._scale, self._scale))[1][..., : self._k]
        vectors = vectors * self._scale[:, None]
        flow = n - self._k
        found = vectors[:, :flow] @ torch.linalg.inv(vectors[:, flow:])
        return np.asarray(found.mT.reshape(*tensor.shape[1:], self._k, flow))
