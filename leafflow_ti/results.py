"""Results store: a Zarr v3 directory with one array ``[t, y, x]`` per map, filled unit by unit.

A unit is one band of output rows of one frame and exactly one chunk of every array, so units never share a file and
may be written in any order, by any number of writers. Its marker ``status/.done/UNIT`` is written last: a unit with a
marker is complete, one without is computed again. The markers lie inside an array's folder because readers of Zarr
list the folders of groups, where a foreign entry would be reported, but never those of arrays.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import zarr
from numpy.typing import ArrayLike, NDArray

from leafflow_ti import unit_marks
from leafflow_ti.chunk_files import (
    COMPRESSOR,
    flush,
    flush_tree,
    make_folders,
    own_token,
    reading,
    remove_scratch,
    replace_file,
    write_chunks,
    writing,
)
from leafflow_ti.display import results_html
from leafflow_ti.errors import InputError, MissingExtra, RunError, UsageError
from leafflow_ti.field import QUANTITIES, Field, quantity, with_std
from leafflow_ti.locks import alone, changing_attributes
from leafflow_ti.placing import put_in_place, remove_abandoned, whole_arrays
from leafflow_ti.store_arrays import (
    COORDINATES,
    MEASURED,
    METADATA,
    arrays_of,
    coordinate,
    create_map,
    is_ours,
    open_group,
)

if TYPE_CHECKING:
    import xarray

FORMAT = 1
"""Version of the layout, in the attribute ``leafflow_ti_format`` by which a store is recognised."""

UNFINISHED = "unfinished_maps"
"""Attribute: maps that are being added."""
FRAMES_PER_CHUNK = 1024
"""Of the coordinate t: so that it can grow without its chunks being cut anew."""

TIME: dict[str, Any] = {"long_name": "time of the results", "units": "s"}


@dataclass(frozen=True, eq=False, repr=False)
class ResultStore:
    """An open results store. ``frames``, ``y``, ``x``: coordinates of the axes t, y, x; ``names``: its maps, but for
    those that an interrupted ``leafflow-ti growth`` has left ``unfinished``."""

    path: Path
    frames: tuple[int, ...]
    y: NDArray[np.int64]
    x: NDArray[np.int64]
    names: tuple[str, ...]
    unfinished: tuple[str, ...]
    unit_rows: int
    _group: zarr.Group
    _arrays: Mapping[str, zarr.Array[Any]]

    @classmethod
    def create(
        cls,
        path: str | Path,
        *,
        frames: Sequence[int],
        y: ArrayLike,
        x: ArrayLike,
        names: Sequence[str],
        chunk: tuple[int, int, int],
        attrs: Mapping[str, Any],
        interval_s: float | None = None,
        time_offset: float = 0.0,
        times_s: Sequence[float] | None = None,
        overwrite: bool = False,
    ) -> Self:
        """A new store, every map preallocated with NaN and the status with ``NOT_COMPUTED``.

        ``y``, ``x``: pixel positions of the rows and columns; ``chunk``: ``(1, rows of a unit, len(x))``; ``attrs``:
        JSON values; ``interval_s``: time between frames [s]; ``time_offset``: where results lie between their frame and
        the next one, 0 to 1; ``times_s``: when that is, from measured stamps, kept as the coordinate ``time``. The
        store appears under its name only when it is whole.
        Raises UsageError when ``path`` exists (``overwrite`` replaces a results store, nothing else), RunError when it
        cannot be written.
        """
        path = Path(path)
        frames, names = tuple(int(t) for t in frames), tuple(names)
        coordinates = {"t": np.asarray(frames, np.int64), "y": np.asarray(y, np.int64), "x": np.asarray(x, np.int64)}
        shape = tuple(values.size for values in coordinates.values())
        if chunk[0] != 1 or not 1 <= chunk[1] <= shape[1] or chunk[2] != shape[2]:
            raise ValueError(f"chunk {chunk} must be (1, 1..{shape[1]}, {shape[2]}): whole rows of one frame")
        check_replaceable(path, overwrite)
        remove_abandoned(path)
        with writing(path):
            for parent in make_folders(path.parent):
                flush(parent)
            scratch = path.with_name(f".{path.name}.{own_token()}")
            (scratch / "status").mkdir(parents=True)
            try:
                with alone(scratch):
                    group = zarr.create_group(scratch, zarr_format=3)
                    own = {MEASURED: list(names), "leafflow_ti_format": FORMAT}
                    group.update_attributes({"Conventions": "CF-1.11", **attrs, **own})
                    for axis, values in coordinates.items():
                        attributes = dict(COORDINATES[axis])
                        if axis == "t" and interval_s is not None:
                            attributes["interval_s"] = float(interval_s)
                        if axis == "t" and time_offset:
                            attributes["time_offset"] = float(time_offset)
                        group.create_array(
                            axis, data=values, chunks=(FRAMES_PER_CHUNK if axis == "t" else values.size,),
                            dimension_names=[axis], attributes=attributes, compressors=COMPRESSOR, filters=None,
                        )  # fmt: skip
                    if times_s is not None:
                        times = np.asarray(times_s, np.float64)
                        group.create_array("time", data=times, dimension_names=["t"], attributes=TIME)
                    for name in (*names, "status"):
                        create_map(group, name, f"{name}_std" in names, shape, chunk)
                    (scratch / unit_marks.FOLDER).mkdir()
                    flush_tree(scratch)
                    if not put_in_place(scratch, path, overwrite):
                        check_replaceable(path, overwrite=False)
            except BaseException:
                shutil.rmtree(scratch, ignore_errors=True)
                raise
        return cls.open(path)

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """An existing store, to read or to go on writing; InputError when ``path`` is none."""
        path = Path(path)
        group = open_group(path)
        if group is None:
            raise InputError(f"{path}: no results store; give the OUT.zarr of a 'leafflow-ti run'")
        found = group.attrs["leafflow_ti_format"]
        if found != FORMAT:
            raise InputError(
                f"{path}: written in format {found}, this version reads {FORMAT}: run again with --overwrite"
            )
        with reading(path):
            arrays = arrays_of(path, group)
            t, y, x = (coordinate(arrays, axis) for axis in COORDINATES)
            unit_rows = arrays["status"].chunks[1]
        unfinished: Any = group.attrs.get(UNFINISHED, [])
        known = [n for n in with_std(QUANTITIES) if n in arrays]
        names, left = (tuple(n for n in known if (n in unfinished) == out) for out in (False, True))
        return cls(path, tuple(t.tolist()), y, x, names, left, unit_rows, group, arrays)

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes of the store as they are now: resolved configuration, versions, device, fingerprints, timings."""
        found: dict[str, Any] = json.loads((self.path / METADATA).read_text(encoding="utf-8"))["attributes"]
        return found

    def update_attrs(self, attrs: Mapping[str, Any]) -> None:
        """Set attributes, None removes one; whoever reads meanwhile, or after a kill, finds the old ones or the new
        ones.

        Raises RunError when the store cannot be written.
        """
        self.change_attrs(lambda found: found | dict(attrs))

    def change_attrs(self, change: Callable[[dict[str, Any]], Mapping[str, Any]]) -> None:
        """The same with attributes that follow from what they are now; nobody else changes them meanwhile."""
        with writing(self.path), changing_attributes(self.path):
            metadata = json.loads((self.path / METADATA).read_text(encoding="utf-8"))
            found = change(metadata["attributes"])
            metadata["attributes"] = {name: value for name, value in found.items() if value is not None}
            text = json.dumps(metadata, indent=2)
            replace_file(self.path / METADATA, text.encode(), self.path / unit_marks.FOLDER)

    @property
    def interval_s(self) -> float | None:
        """Time between frames [s], None when unknown."""
        value = self._arrays["t"].attrs.get("interval_s")
        return float(value) if isinstance(value, int | float) else None

    @property
    def times_s(self) -> NDArray[np.float64] | None:
        """When the results of each frame are [s]: by the measured stamps, else by the interval from frame 0 on.

        None where neither is known.
        """
        if "time" in self._arrays:
            return np.asarray(self._arrays["time"][...], np.float64)
        if self.interval_s is None:
            return None
        offset = float(self._arrays["t"].attrs.get("time_offset", 0.0))  # type: ignore[arg-type]
        return (np.array(self.frames) + offset) * self.interval_s

    @property
    def bands(self) -> int:
        """Units per frame; unit ``t_index * bands + band`` holds the rows from ``band * unit_rows``."""
        return -(-self.y.size // self.unit_rows)

    @property
    def n_units(self) -> int:
        """Units of the whole store."""
        return len(self.frames) * self.bands

    def write_unit(
        self, unit: int, t_index: int, y: slice, maps: Mapping[str, NDArray[np.floating]], status: NDArray[np.uint8]
    ) -> None:
        """Write one unit, then its marker, both forced to the disk.

        ``y``: the output rows of the unit; ``maps``: every map of the store, ``[rows, len(x)]``; ``status`` likewise.
        Raises RunError when the disk is full or not writable, ValueError when the arguments do not describe the unit.
        """
        frame, band = divmod(unit, self.bands)
        first = band * self.unit_rows
        rows = slice(first, min(first + self.unit_rows, self.y.size))
        if (
            not 0 <= unit < self.n_units
            or t_index != frame
            or (y.start, y.stop, y.step or 1) != (rows.start, rows.stop, 1)
        ):
            raise ValueError(f"unit {unit} is frame {frame}, rows {rows}; got frame {t_index}, rows {y}")
        shape = (rows.stop - rows.start, self.x.size)
        arrays: dict[str, NDArray[Any]] = {name: maps[name] for name in self.names} | {"status": status}
        wrong = [name for name, values in arrays.items() if values.shape != shape]
        if wrong:
            raise ValueError(f"unit {unit} needs the shape {shape}; {wrong[0]} has {arrays[wrong[0]].shape}")
        written = write_chunks(self.path, (t_index, band), self._arrays, arrays)
        with writing(self.path):
            unit_marks.mark(self.path, unit, written)

    def alone(self) -> contextlib.AbstractContextManager[None]:
        """Nobody else writes this store while the block runs; RunError when somebody does."""
        return alone(self.path)

    def remove_scratch(self, units: Collection[int]) -> None:
        """Remove what killed processes have left of units, and of the attributes; nobody else may be writing these
        units."""
        with writing(self.path):
            unit_marks.remove_scratch(self.path, units)
            with changing_attributes(self.path):  # so that nobody is writing them
                for left in (self.path / unit_marks.FOLDER).glob(f".{METADATA}.*"):
                    left.unlink(missing_ok=True)
            for unit in units:
                remove_scratch(self.path, divmod(unit, self.bands), self._arrays)

    def done(self) -> set[int]:
        """Units whose marker is written."""
        return {unit for unit in unit_marks.marked(self.path) if unit < self.n_units}

    def is_done(self, unit: int) -> bool:
        """Whether the marker of a unit is written."""
        return (self.path / "status" / ".done" / str(unit)).exists()

    def read(self, name: str, t_index: int | None = None) -> NDArray[Any]:
        """A map or ``"status"``: ``[t, y, x]``, or ``[y, x]`` of the frame with index ``t_index`` along t.

        Raises InputError for a name that the store does not have.
        """
        if name not in (*self.names, "status"):
            raise InputError(f"{self.path}: has no map {name!r}; it has: {', '.join(self.names)}")
        with reading(self.path, f"'leafflow-ti info {self.path} --verify' says which units are"):
            array = self._arrays[name]
            return np.asarray(array[: len(self.frames)] if t_index is None else array[t_index])

    def maps(self) -> list[tuple[str, zarr.Array[Any]]]:
        """The arrays ``[t, y, x]``, ``status`` included, by name."""
        return [(name, self._arrays[name]) for name in (*self.names, "status")]

    def field(self, t_index: int) -> Field:
        """All maps of the frame with index ``t_index`` along t."""
        maps = {name: self.read(name, t_index) for name in self.names}
        return Field(maps, self.read("status", t_index), self.y, self.x, self.frames[t_index], self.attrs)

    def to_xarray(self) -> xarray.Dataset:
        """All frames as a Dataset with dimensions ``t, y, x`` and CF attributes, read from disk as they are used.

        Raises MissingExtra where xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise MissingExtra("xarray", "xarray", "ResultStore.to_xarray") from None
        dataset: xarray.Dataset = xarray.open_zarr(self.path, consolidated=False, chunks=None)
        return dataset.drop_vars(self.unfinished)

    def _repr_html_(self) -> str:
        """The middle one of the frames that are done, and how many are."""
        done = sorted({unit // self.bands for unit in self.done()})
        title = f"{self.path.name} · {len(done)} of {len(self.frames)} frames · {self.y.size} x {self.x.size} (y, x)"
        if not done:
            return f"<p><b>{escape(title)}</b></p>"
        field = self.field(done[len(done) // 2])
        title = f"{title} · below: frame {field.frame}"
        return results_html(title, field.maps, field.status, lambda name: quantity(name)[0])

    def __repr__(self) -> str:
        names = ", ".join(name for name in self.names if not name.endswith("_std"))
        size = f"{len(self.frames)} x {self.y.size} x {self.x.size} (t, y, x)"
        return f"<ResultStore {self.path.name}, {size}, {len(self.done())} of {self.n_units} units done: {names}>"

    def add_maps(self, names: Sequence[str]) -> ResultStore:
        """The store with further maps, empty (those it has lose their values), to be filled by ``write_maps``.

        For what follows from the measured maps. They are ``unfinished``, and nobody's to read, until ``finish_maps``.
        Raises RunError when units are missing or the store cannot be written.
        """
        self._check_whole()
        array = self._arrays["status"]
        self.update_attrs({UNFINISHED: list(names)})
        with writing(self.path), whole_arrays(self.path, names) as scratch:
            group = zarr.create_group(scratch, zarr_format=3)
            for name in names:
                create_map(group, name, f"{name}_std" in names, array.shape, array.chunks)
        return ResultStore.open(self.path)

    def finish_maps(self, attrs: Mapping[str, Any]) -> ResultStore:
        """The store with the added maps among its ``names``; ``attrs`` say how they were made."""
        self.update_attrs({**attrs, UNFINISHED: None})
        return ResultStore.open(self.path)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What whoever uses the results must be told: units that are not done, maps that are ``unfinished``."""
        found = []
        missing = self.n_units - len(self.done())
        if missing:
            found.append(f"{missing} of {self.n_units} units of {self.path} are not done: their pixels have no values")
        if self.unfinished:
            found.append(
                f"'leafflow-ti growth {self.path}' did not come to its end, so its maps ({self.unfinished[0]} and "
                "others) are left out: run it again"
            )
        return tuple(found)

    def write_maps(self, t_index: int, maps: Mapping[str, NDArray[Any]]) -> None:
        """Write maps ``[y, x]`` of the frame with index ``t_index`` along t; RunError when that is impossible."""
        shape = (self.y.size, self.x.size)
        wrong = [name for name, values in maps.items() if values.shape != shape]
        if wrong:
            raise ValueError(f"{wrong[0]} needs the shape {shape}; got {maps[wrong[0]].shape}")
        for band in range(self.bands):
            rows = slice(band * self.unit_rows, (band + 1) * self.unit_rows)
            write_chunks(self.path, (t_index, band), self._arrays, {n: values[rows] for n, values in maps.items()})

    def _check_whole(self) -> None:
        missing = self.n_units - len(self.done())
        if missing:
            raise RunError(f"{self.path}: {missing} of {self.n_units} units are not done: run again with --resume")

    def finish(self, attrs: Mapping[str, Any]) -> None:
        """Set the attributes known at the end.

        Raises RunError when units are missing or the store cannot be written.
        """
        self._check_whole()
        self.update_attrs(attrs)


def check_replaceable(path: Path, overwrite: bool) -> None:
    """Raise UsageError where a new store may not take this place."""
    if not path.exists():
        return
    if not overwrite:
        raise UsageError(f"{path} exists: give --overwrite to replace it, --resume to continue it, or another name")
    if not is_ours(path) and open_group(path) is None:
        raise UsageError(f"{path} exists and is no results store, so --overwrite leaves it alone: give another name")
