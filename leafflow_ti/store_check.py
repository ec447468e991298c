"""Whether the files of a results store are whole: what a copy, a disk or a stray command has spoilt since a run."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from leafflow_ti.chunk_files import chunk_fault, writing
from leafflow_ti.events import warn
from leafflow_ti.results import UNFINISHED, ResultStore
from leafflow_ti.store_arrays import MEASURED
from leafflow_ti.unit_marks import marked_maps, unmark


@dataclass(frozen=True)
class Damage:
    """A file of a unit that is done is spoilt: ``rows`` are the pixels y of the unit's first and last row, ``array`` is
    the map, ``reason`` what is wrong with its file."""

    unit: int
    frame: int
    rows: tuple[int, int]
    array: str
    reason: str

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return asdict(self)


def damaged(store: ResultStore) -> list[Damage]:
    """Every file of the units that are done which is missing, was cut, or has changed since it was written; all are
    read. Where maps that were added later (growth) must have files is not known: those that they have are read."""
    found = []
    for unit in sorted(store.done()):
        t_index, band = divmod(unit, store.bands)
        rows = store.y[band * store.unit_rows :][: store.unit_rows]
        kept = marked_maps(store.path, unit)
        for name, array in store.maps():
            fault = chunk_fault(store.path, (t_index, band), name, array, name in kept)
            if fault:
                found.append(Damage(unit, store.frames[t_index], (int(rows[0]), int(rows[-1])), name, fault))
    return found


def mend(store: ResultStore) -> None:
    """Make damaged units undone, so that a run that goes on with the store computes them again; maps that were added to
    a damaged store are ``unfinished`` then. A warning names each file. Nobody else may be writing the store.

    Raises RunError when it cannot be written.
    """
    found = damaged(store)
    if not found:
        return
    for d in found:
        warn(
            f"{store.path}: {d.array} of unit {d.unit} (frame {d.frame}) {d.reason}; it is computed again", unit=d.unit
        )
    measured = {*store.attrs.get(MEASURED, store.names), "status"}
    with writing(store.path):
        unmark(store.path, {d.unit for d in found if d.array in measured})
    added = [name for name in store.names if name not in measured]
    if added:
        store.update_attrs({UNFINISHED: added})
