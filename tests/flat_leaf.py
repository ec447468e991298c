"""A results store without an estimation: a flat leaf that faces the camera, moves and grows exactly, by known maps."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.field import with_std
from leafflow_ti.results import ResultStore

F_PX, PRINCIPAL = 1000.0, (80.0, 60.0)
SIZE = (160, 120)
"""Width and height of the images."""
DEPTH = 500.0
Y, X = np.arange(0, SIZE[1], 4), np.arange(0, SIZE[0], 4)
CORRELATION = {
    **{axis: np.exp(-((np.arange(24) / 12.0) ** 2)).tolist() for axis in "xy"},
    **{f"{axis}_gradient": ((1 - 2 * (np.arange(24) / 12.0) ** 2) * np.exp(-((np.arange(24) / 12.0) ** 2))).tolist()
       for axis in "xy"},
    "t": [1.0, 0.4, -0.2],
}  # fmt: skip
"""Of Gaussian windows, at 0, 1, 2, ... px or frames."""
Maps = dict[str, NDArray[Any]]


def attributes(refined: bool = True) -> dict[str, Any]:
    return {
        "config": f"[refine]\nsteps = {3 if refined else 0}\n[window]\nsize = 33\n",
        "plan": {"f_px": F_PX, "principal_px": list(PRINCIPAL), "image_px": list(SIZE), "time_offset": 0.0,
                 "baseline_mm": [10.0, 0.0],
                 "noise_correlation": CORRELATION},
    }  # fmt: skip


def write_store(
    path: Path,
    names: Sequence[str],
    maps: Callable[[int], Mapping[str, NDArray[Any]]],
    frames: Sequence[int] = (2, 3, 4, 5, 6),
    interval_s: float | None = 1800.0,
    attrs: Mapping[str, Any] | None = None,
    y: NDArray[np.int64] = Y,
    x: NDArray[np.int64] = X,
) -> ResultStore:
    """A finished store; ``maps(t)`` gives those of the frame with index t, ``status`` among them where it is not ok."""
    store = ResultStore.create(
        path, frames=frames, y=y, x=x, names=names, chunk=(1, y.size, x.size),
        attrs=attributes() if attrs is None else attrs, interval_s=interval_s,
    )  # fmt: skip
    for t in range(len(frames)):
        found = dict(maps(t))
        status = found.pop("status", np.zeros((y.size, x.size), np.uint8))
        bare = (status != 0) & (status != 8)
        values = {name: np.where(bare, np.nan, found[name]).astype(np.float32) for name in names}
        store.write_unit(t, t, slice(0, y.size), values, status)
    store.finish({})
    return store


LEAF = with_std(("depth", "slope_x", "slope_y", "velocity_x", "velocity_y", "velocity_z", "flow_x", "flow_y",
                 "rotation_z", "growth_rate"))  # fmt: skip


def leaf_maps(growth: float = 0.0, flow: tuple[float, float] = (0.0, 0.0)) -> Callable[[int], Maps]:
    """The leaf's lengths grow by the factor exp(growth) per frame about the principal point, which moves by ``flow``
    px/frame; the centre lies there at index 2."""

    def maps(t: int) -> Maps:
        x, y = np.meshgrid(X - PRINCIPAL[0] - flow[0] * (t - 2), Y - PRINCIPAL[1] - flow[1] * (t - 2))
        u, v = flow[0] + growth * x, flow[1] + growth * y
        area = 100 * (np.exp(2 * growth) - 1)
        found: Maps = {name: np.zeros(x.shape) for name in LEAF}
        found |= {"depth": np.full(x.shape, DEPTH), "flow_x": u, "flow_y": v, "growth_rate": np.full(x.shape, area)}
        found |= {"velocity_x": u * DEPTH / F_PX, "velocity_y": v * DEPTH / F_PX}
        errors = {"depth": 0.1, "slope_x": 0.01, "slope_y": 0.01, "rotation_z": 1e-4, "growth_rate": 0.02}
        return found | {f"{n}_std": np.full(x.shape, errors.get(n, 1e-3)) for n in LEAF if not n.endswith("_std")}

    return maps


def label_image(dtype: type = np.uint8) -> NDArray[Any]:
    """Regions 1 (a square about the principal point) and 5 (a disc beside it)."""
    image = np.zeros(SIZE[::-1], dtype)
    image[45:76, 65:96] = 1
    y, x = np.indices(image.shape)
    image[np.hypot(x - 115, y - 60) <= 12] = 5
    return image
