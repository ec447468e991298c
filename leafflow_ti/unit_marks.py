"""Markers of the units of a results store that are done: a file each, written last.

It lists the maps of which the unit has a file; one without values has none.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

from leafflow_ti.chunk_files import flush, replace_file

FOLDER = Path("status") / ".done"
"""In an array's folder, where readers of Zarr do not look."""


def mark(store: Path, unit: int, names: Iterable[str]) -> None:
    """Say that a unit is done, with files of these maps."""
    folder = store / FOLDER
    replace_file(folder / str(unit), "".join(f"{name}\n" for name in names).encode(), folder)


def unmark(store: Path, units: Iterable[int]) -> None:
    """Units are not done any more."""
    for unit in units:
        (store / FOLDER / str(unit)).unlink(missing_ok=True)
    flush(store / FOLDER)


def marked(store: Path) -> set[int]:
    """Units that are done."""
    return {int(entry.name) for entry in (store / FOLDER).iterdir() if entry.name.isdecimal()}


def marked_maps(store: Path, unit: int) -> frozenset[str]:
    """Maps of which a unit that is done must have a file."""
    return frozenset((store / FOLDER / str(unit)).read_text(encoding="utf-8").split())


def remove_scratch(store: Path, units: Collection[int]) -> None:
    """Remove what killed processes have left of the markers of these units."""
    for left in (store / FOLDER).glob(".*"):
        of = left.name.split(".")[1]
        if of.isdecimal() and int(of) in units:
            left.unlink(missing_ok=True)
