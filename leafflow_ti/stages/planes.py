"""Host side of the plane kernels: sparse tables of terms, and launches over stacks of planes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from leafflow_ti.runtime import Device


@dataclass
class Terms:
    """A sparse table: for each output plane, a list of (offset or pair of planes, weight)."""

    first: list[int]
    source: list[Any]
    weight: list[float]

    @classmethod
    def of(cls, outputs: list[list[tuple[Any, float]]]) -> Terms:
        """From one list of terms per output plane."""
        first = np.cumsum([0] + [len(o) for o in outputs]).tolist()
        return cls(first, [s for o in outputs for s, _ in o], [w for o in outputs for _, w in o])


class Filtering:
    """One launch of the plane filter with its tables on the device."""

    def __init__(
        self,
        device: Device,
        outputs: list[list[tuple[int, float]]],
        rows: int,
        pitch: int,
        row_step: int,
        col_step: int = 1,
    ):
        terms = Terms.of(outputs)
        self.device, self.rows, self.pitch, self.row_step, self.col_step = device, rows, pitch, row_step, col_step
        self.n_planes = len(outputs)
        self.size = self.n_planes * rows * pitch
        self._tables = (
            device.array(terms.first, "int"), device.array(terms.source, "int"), device.array(terms.weight),
        )  # fmt: skip

    def __call__(self, src: Any, dst: Any, to: int = 0) -> None:
        """``dst`` gets ``n_planes`` planes of [rows, pitch] from element ``to`` on."""
        from leafflow_ti.kernels.planes import filter_planes_kernel

        spec = self.device.planes
        groups = self.n_planes * self.rows * self.pitch // spec.lanes
        filter_planes_kernel(spec, self.col_step)(
            self.n_planes, self.rows, self.pitch, self.row_step, to, self.device.tasks(groups), *self._tables, src, dst
        )  # fmt: skip


def round_up(n: int, multiple: int) -> int:
    """The next multiple."""
    return -(-n // multiple) * multiple
