"""Results stores in napari: one image layer per map, one labels layer for the status.

napari finds the reader by the manifest ``napari.yaml``; nothing of napari is imported here. Layers have the axes t, y,
x of the store; their scale and position are those of the reference image in px, so that they lie on top of it whatever
the stride. Maps are read from the disk when they are shown, chunk by chunk.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zarr

from leafflow_ti.colours import Scale
from leafflow_ti.errors import InputError
from leafflow_ti.field import map_attributes, quantity
from leafflow_ti.panels import SIGNED
from leafflow_ti.results import ResultStore

LayerData = tuple[Any, dict[str, Any], str]
"""Data, options of the layer, and its kind, as napari takes them."""

SHOWN_FIRST = "depth"


def get_reader(path: str | list[str]) -> Callable[[str | list[str]], list[LayerData]] | None:
    """The reader of results stores; None for all else, which napari then offers to other readers."""
    if not isinstance(path, str):
        return None
    try:
        ResultStore.open(path)
    except InputError:
        return None
    return read_layers


def read_layers(path: str | list[str]) -> list[LayerData]:
    """The layers of a results store: the status, then every map and its standard error; one map is visible.

    Images [t, y, x] are named ``depth [mm]``; contrast limits are the 2nd and 98th percentile of the middle frame.
    Raises InputError when ``path`` is no results store.
    """
    store = ResultStore.open(Path(str(path)))
    arrays = zarr.open_group(store.path, mode="r")
    names = [name for name in store.names if name != "identified"]
    shown = SHOWN_FIRST if SHOWN_FIRST in names else names[0]
    place = _place(store)
    layers = [_status(store, arrays["status"], place)]
    for name in (*(name for name in names if name != shown), shown):  # the last one lies on top
        layers.append(_map(store, name, arrays[name], place | {"visible": name == shown}))
    return layers


def _place(store: ResultStore) -> dict[str, Any]:
    """Scale and position of a layer: frames along t, px of the reference image along y and x."""
    axes = (np.asarray(store.frames), store.y, store.x)
    return {
        "scale": tuple(float(axis[1] - axis[0]) if axis.size > 1 else 1.0 for axis in axes),
        "translate": tuple(float(axis[0]) for axis in axes),
    }


def _map(store: ResultStore, name: str, data: Any, options: dict[str, Any]) -> LayerData:
    scale = Scale.of(store.read(name, len(store.frames) // 2), signed=name in SIGNED, error=name.endswith("_std"))
    unit, long_name = quantity(name)
    facts = {"unit": unit, "long_name": long_name, "interval_s": store.interval_s}
    kept = options | {"contrast_limits": (scale.low, scale.high), "colormap": scale.colours, "metadata": facts}
    return data, {"name": name if unit == "1" else f"{name} [{unit}]", **kept}, "image"


def _status(store: ResultStore, data: Any, options: dict[str, Any]) -> LayerData:
    """Labels are the codes of the status; ``ok`` is 0 and therefore transparent. Pointing at a pixel tells its name."""
    facts = map_attributes("status")
    features = {"index": facts["flag_values"], "status": facts["flag_meanings"].split()}
    return data, {"name": "status", "features": features, "opacity": 0.5, "metadata": facts, **options}, "labels"
