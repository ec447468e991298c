"""Results stores for reports, as a run would leave them, filled with a bulging surface that grows."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

NAMES = (
    "depth", "depth_std", "slope_x", "slope_y", "velocity_x", "velocity_y", "velocity_z", "growth_rate",
    "growth_rate_std",
)  # fmt: skip
PLAN = {
    "model": "affine-scene-flow", "f_px": 600.0, "principal_px": [39.5, 29.5], "baseline_mm": [5.0, 0.0],
    "noise_correlation": {"x": [1.0, 0.5], "y": [1.0, 0.5], "t": [1.0]},
}  # fmt: skip
GROWTH, GROWTH_STD = 0.1, 0.02
"""Of all pixels, %/frame."""


def attributes(**more: Any) -> dict[str, Any]:
    """Attributes of a store that a run wrote."""
    return {
        "plan": PLAN, "device": "cpu (2 threads)", "leafflow_ti_version": "1.2.3", "versions": {"numpy": "2.0"},
        "config": '[model]\nname = "affine-scene-flow"\n[window]\nsize = 33\nsize_time = 3\nstride = 2\n',
        "input": {"files": 45, "names_and_sizes_sha256": "0123456789abcdef"},
        "timings": {"seconds": 12.0, "stages": {"filter": 2.0, "refine": 9.5}, "runs": 1},
    } | more  # fmt: skip


def make_store(
    path: Path,
    frames: Sequence[int] = (2, 3, 4),
    done: Iterable[int] | None = None,
    names: Sequence[str] = NAMES,
    size: tuple[int, int] = (30, 40),
    interval_s: float | None = 120.0,
    noise: float = 0.0,
    **attrs: Any,
) -> ResultStore:
    """A store of ``size`` (y, x) output pixels at a stride of 2, one unit per frame, with the frames ``done`` [all]."""
    rows, columns = size
    y, x = 2 * np.arange(rows), 2 * np.arange(columns)
    store = ResultStore.create(
        path, frames=frames, y=y, x=x, names=names, chunk=(1, rows, columns), attrs=attributes(**attrs),
        interval_s=interval_s,
    )  # fmt: skip
    rng = np.random.default_rng(1)
    for index in range(len(frames)) if done is None else done:
        maps, status = surface(size, index)
        maps = {n: (maps[n] * (1 + noise * rng.normal(size=size))).astype(np.float32) for n in names}
        store.write_unit(index, index, slice(0, rows), maps, status)
    return store


def surface(size: tuple[int, int], index: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Maps of a bulge, and a status with a border on the left; the bulge rises with the frames."""
    v, u = np.meshgrid(*(np.linspace(-1, 1, n) for n in size), indexing="ij")
    height = 20 + 4 * index
    depth = 500 - height * np.exp(-2 * (u**2 + v**2))
    maps = {
        "depth": depth, "slope_x": 0.3 * u, "slope_y": 0.3 * v,
        "velocity_x": 0.2 + 0.1 * u, "velocity_y": 0.1 * v, "velocity_z": -0.3 * np.ones(size),
        "growth_rate": np.full(size, GROWTH * (1 + index)), "growth_rate_std": np.full(size, GROWTH_STD),
        "flow_x": u, "flow_y": v,
    }  # fmt: skip
    maps |= {f"{name}_std": np.full(size, 0.01) for name in ("depth", "velocity_x", "velocity_y", "velocity_z")}
    status = np.full(size, Status.OK, np.uint8)
    status[:, :3] = Status.BORDER
    return {n: np.where(status == Status.BORDER, np.nan, values) for n, values in maps.items()}, status
