"""Pixels whose grey values say nothing: saturated ones, and dead ones of the sensor. They are read as NaN."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.channels import Array
from leafflow_ti.capture.description import Images
from leafflow_ti.capture.files import Reach
from leafflow_ti.capture.images import read_gray
from leafflow_ti.capture.layout import Layout
from leafflow_ti.errors import ConfigError

Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Flaws:
    """``saturated``: grey value from which on a pixel does not count; ``dead``: for each camera row and column the dead
    pixels [y, x] of its sensor; None: none."""

    saturated: float | None = None
    dead: tuple[tuple[Mask, ...], ...] | None = None
    files: tuple[Path, ...] = ()

    def without(self, values: Array, sy: int, sx: int, y0: int, x0: int) -> Array:
        """Grey values of a window of one image that begins at row ``y0`` and column ``x0``, NaN where they are flawed;
        floats, the values themselves where nothing is."""
        height, width = values.shape
        flawed = np.zeros((height, width), np.bool_)
        if self.saturated is not None:
            flawed |= values >= self.saturated
        if self.dead is not None:
            flawed |= self.dead[sy][sx][y0 : y0 + height, x0 : x0 + width]
        if not flawed.any():
            return values
        found = values.astype(np.float64)
        found[flawed] = np.nan
        return found


def find_flaws(
    path: Path, images: Images, layout: Layout, reach: Reach, dtype: np.dtype[Any], bits: int
) -> Flaws | None:
    """What the description ``path`` says of flawed pixels; None if nothing.

    Raises ConfigError for "auto" with grey values that have no largest one, or a file of dead pixels of another size,
    InputError for one that cannot be read, or that lies outside.
    """
    saturated = None if images.saturated is None else _level(path, images.saturated, dtype, bits)
    pattern = images.dead_pattern
    if pattern is None:
        return None if saturated is None else Flaws(saturated)
    names = [[pattern.format({"sy": sy, "sx": sx}) for sx in layout.values["sx"]] for sy in layout.values["sy"]]
    found: Mapping[str, Mask] = {
        name: _dead(reach, name, layout) for name in dict.fromkeys(n for line in names for n in line)
    }
    dead = tuple(tuple(found[name] for name in line) for line in names)
    return Flaws(saturated, dead, tuple(reach.root / name for name in found))


def _level(path: Path, stated: float | str, dtype: np.dtype[Any], bits: int) -> float:
    if not isinstance(stated, str):
        return float(stated)
    if dtype.kind not in "ui":
        raise ConfigError(
            f'{path}: [images] saturated = "auto": grey values of type {dtype} have no largest one: give the value'
        )
    return float(2**bits - 1)


def _dead(reach: Reach, name: str, layout: Layout) -> Mask:
    path = reach.root / name
    reach.file(path)
    found: Mask = np.asarray(read_gray(path)) != 0
    wanted = (layout.info.height, layout.info.width)
    if found.shape != wanted:
        made, needed = (f"{shape[1]} x {shape[0]}" for shape in (found.shape, wanted))
        raise ConfigError(f"{path}: dead pixels of {made} px for images of {needed}: make it the same size")
    return found
