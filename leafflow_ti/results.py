"""Results store: a Zarr v3 directory with one array ``[t, y, x]`` per map, filled unit by unit.

A unit is one band of output rows of one frame and exactly one chunk of every array, so units never share a file and
may be written in any order, by any number of writers. Its marker ``status/.done/UNIT`` is written last: a unit with a
marker is complete, one without is computed again. The markers lie inside an array's folder because readers of Zarr
list the folders of groups, where a foreign entry would be reported, but never those of arrays.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import zarr
from numpy.typing import ArrayLike, NDArray
from zarr.errors import NodeNotFoundError

from leafflow_ti.chunk_files import COMPRESSOR, flush, write_chunks, writing
from leafflow_ti.display import results_html
from leafflow_ti.errors import InputError, MissingExtra, RunError, UsageError
from leafflow_ti.field import QUANTITIES, Field, empty_map, map_attributes, quantity, with_std

if TYPE_CHECKING:
    import xarray

FORMAT = 1
"""Version of the layout, in the attribute ``leafflow_ti_format`` by which a store is recognised."""

_UNFINISHED = "unfinished_maps"
"""Attribute: maps that are being added."""
_METADATA = "zarr.json"
"""The group's metadata file, attributes included (Zarr v3)."""

COORDINATES: dict[str, dict[str, Any]] = {
    "t": {"long_name": "index of the reference frame", "units": "frame"},
    "y": {"long_name": "row in the reference image, downwards", "units": "px"},
    "x": {"long_name": "column in the reference image, to the right", "units": "px"},
}

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
        _check_replaceable(path, overwrite)
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            scratch = path.with_name(f".{path.name}.{os.getpid()}")
            try:
                group = zarr.create_group(scratch, zarr_format=3)
                group.update_attributes({"Conventions": "CF-1.11", **attrs, "leafflow_ti_format": FORMAT})
                for axis, values in coordinates.items():
                    attributes = dict(COORDINATES[axis])
                    if axis == "t" and interval_s is not None:
                        attributes["interval_s"] = float(interval_s)
                    if axis == "t" and time_offset:
                        attributes["time_offset"] = float(time_offset)
                    group.create_array(axis, data=values, dimension_names=[axis], attributes=attributes)
                if times_s is not None:
                    times = np.asarray(times_s, np.float64)
                    group.create_array("time", data=times, dimension_names=["t"], attributes=TIME)
                for name in (*names, "status"):
                    _create_map(group, name, f"{name}_std" in names, shape, chunk)
                (scratch / "status" / ".done").mkdir()
                if path.exists():
                    shutil.rmtree(path)
                scratch.rename(path)
            except BaseException:
                shutil.rmtree(scratch, ignore_errors=True)
                raise
        return cls.open(path)

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """An existing store, to read or to go on writing; InputError when ``path`` is none."""
        path = Path(path)
        group = _open_group(path)
        if group is None:
            raise InputError(f"{path}: no results store; give the OUT.zarr of a 'leafflow-ti run'")
        found = group.attrs["leafflow_ti_format"]
        if found != FORMAT:
            raise InputError(
                f"{path}: written in format {found}, this version reads {FORMAT}: run again with --overwrite"
            )
        arrays = dict(group.arrays())
        t, y, x = (np.asarray(arrays[axis][...], np.int64) for axis in ("t", "y", "x"))
        unfinished: Any = group.attrs.get(_UNFINISHED, [])
        known = [n for n in with_std(QUANTITIES) if n in arrays]
        names, left = (tuple(n for n in known if (n in unfinished) == out) for out in (False, True))
        return cls(path, tuple(t.tolist()), y, x, names, left, arrays["status"].chunks[1], group, arrays)

    @property
    def attrs(self) -> dict[str, Any]:
        """Attributes of the store as they are now: resolved configuration, versions, device, fingerprints, timings."""
        found: dict[str, Any] = json.loads((self.path / _METADATA).read_text(encoding="utf-8"))["attributes"]
        return found

    def update_attrs(self, attrs: Mapping[str, Any]) -> None:
        """Set attributes, None removes one; whoever reads meanwhile, or after a kill, finds the old ones or the new
        ones.

        Raises RunError when the store cannot be written.
        """
        with writing(self.path):
            metadata = json.loads((self.path / _METADATA).read_text(encoding="utf-8"))
            found = metadata["attributes"] | dict(attrs)
            metadata["attributes"] = {name: value for name, value in found.items() if value is not None}
            scratch = self.path / "status" / ".done" / f".{_METADATA}"
            scratch.write_text(json.dumps(metadata, indent=2), encoding="utf-8")
            flush(scratch)
            scratch.replace(self.path / _METADATA)

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
        write_chunks(self.path, (t_index, band), self._arrays, arrays)
        with writing(self.path):
            self._mark(unit)

    def _mark(self, unit: int) -> None:
        folder = self.path / "status" / ".done"
        scratch = folder / f".{unit}.{os.getpid()}"
        scratch.touch()
        flush(scratch)
        scratch.replace(folder / str(unit))
        flush(folder)

    def done(self) -> set[int]:
        """Units whose marker is written."""
        return {int(entry.name) for entry in (self.path / "status" / ".done").iterdir() if entry.name.isdecimal()}

    def read(self, name: str, t_index: int | None = None) -> NDArray[Any]:
        """A map or ``"status"``: ``[t, y, x]``, or ``[y, x]`` of the frame with index ``t_index`` along t.

        Raises InputError for a name that the store does not have.
        """
        if name not in (*self.names, "status"):
            raise InputError(f"{self.path}: has no map {name!r}; it has: {', '.join(self.names)}")
        return np.asarray(self._arrays[name][... if t_index is None else t_index])

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
        self.update_attrs({_UNFINISHED: list(names)})
        with writing(self.path):
            for name in names:
                _create_map(self._group, name, f"{name}_std" in names, array.shape, array.chunks)
        return ResultStore.open(self.path)

    def finish_maps(self, attrs: Mapping[str, Any]) -> ResultStore:
        """The store with the added maps among its ``names``; ``attrs`` say how they were made."""
        self.update_attrs({**attrs, _UNFINISHED: None})
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


def _create_map(group: zarr.Group, name: str, has_std: bool, shape: tuple[int, ...], chunk: tuple[int, ...]) -> None:
    attributes = map_attributes(name) | ({"ancillary_variables": f"{name}_std status"} if has_std else {})
    group.create_array(
        name,
        shape=shape,
        chunks=chunk,
        dtype=empty_map(name, ()).dtype,
        fill_value=empty_map(name, ()).item(),
        dimension_names=list(COORDINATES),
        attributes=attributes,
        compressors=COMPRESSOR,
        filters=None,
        overwrite=True,
    )


def _open_group(path: Path) -> zarr.Group | None:
    """The group of a results store; None for anything else."""
    try:
        group = zarr.open_group(path, mode="r+", zarr_format=3)
    except (NodeNotFoundError, OSError, ValueError):
        return None
    return group if "leafflow_ti_format" in group.attrs else None


def _check_replaceable(path: Path, overwrite: bool) -> None:
    if not path.exists():
        return
    if not overwrite:
        raise UsageError(f"{path} exists: give --overwrite to replace it, --resume to continue it, or another name")
    if _open_group(path) is None:
        raise UsageError(f"{path} exists and is no results store, so --overwrite leaves it alone: give another name")
