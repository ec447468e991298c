"""Whether the disk has room for what a run will write, asked before anything is written.

Values of pixels that have one hardly compress: stores of cubes and light fields whose pixels nearly all have values
take 0.70 and 0.85 of their uncompressed size, leaves with values at a fifth to six tenths of the pixels 0.15 to 0.22.
"""

from __future__ import annotations

import shutil
from pathlib import Path

from leafflow_ti.errors import RunError
from leafflow_ti.events import warn
from leafflow_ti.plan import Plan

LIKELY_SHARE = 0.5
"""Of the uncompressed size, what results take at least where half of the pixels have values; see above."""
BLOCK = 4096
"""Bytes in which file systems give room to a file or a folder."""
BLOCKS_PER_CHUNK = 3
"""What a chunk of an array takes beside its values: the rest of its last block, its folder, that of its frame."""
METADATA_BLOCKS = 8
"""Of one array, and its share of the store's own."""


def space_needed(plan: Plan, units_left: int) -> tuple[int, int]:
    """Bytes on the disk for so many units of a plan, and for the store: likely, and at most."""
    arrays = len(plan.names) + 1
    values = units_left * plan.band_rows * len(plan.x) * (4 * len(plan.names) + 1)
    beside = arrays * BLOCK * (METADATA_BLOCKS + BLOCKS_PER_CHUNK * units_left)
    return int(LIKELY_SHARE * values) + beside, values + beside


def check_space(path: Path, plan: Plan, units_left: int) -> None:
    """Ask whether the disk of ``path``, which need not exist, has room for ``units_left`` units.

    Warns where that depends on how well they compress. A store that a run from the beginning replaces counts as room.
    Raises RunError where it has not.
    """
    if not units_left or not plan.config.plan.check_disk:
        return
    likely, most = space_needed(plan, units_left)
    free = shutil.disk_usage(_nearest(path)).free
    if units_left == plan.n_units and path.is_dir():
        free += sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    if free >= most:
        return
    text = (
        f"{path}: {units_left} units take {_size(likely)} to {_size(most)} on the disk, which has {_size(free)} free: "
        "make room, name another disk, or write less (output.arrays, a stride, a roi)"
    )
    if free < likely:
        raise RunError(f"{text}; --set plan.check_disk=false runs all the same")
    warn(text, needed_bytes=most, likely_bytes=likely, free_bytes=free)


def _nearest(path: Path) -> Path:
    """The path itself, or the nearest folder above it that exists."""
    return next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())


def _size(n: int) -> str:
    """Bytes in words."""
    return f"{n / 2**30:.1f} GiB" if n >= 2**30 else f"{n / 2**20:.1f} MiB"
