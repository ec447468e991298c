"""Followed points: where they are in every frame, how surely, and what is known of them; as tables and data sets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import MissingExtra, UsageError
from leafflow_ti.interpolation import Reading
from leafflow_ti.tables import SUFFIXES, check_table_path, column_name, write_table
from leafflow_ti.whole import appearing

if TYPE_CHECKING:
    import xarray

Floats = NDArray[np.float64]

DATA_SETS = (".nc", ".zarr")
"""Suffixes of data sets, beside those of tables."""

VARIABLES: dict[str, tuple[str, str]] = {
    "x": ("px", "column in the image"),
    "y": ("px", "row in the image, downwards"),
    "X": ("mm", "position to the right of the reference camera"),
    "Y": ("mm", "position below the reference camera"),
    "Z": ("mm", "depth"),
    "drift": ("px", "bound on the distance from the true place in the image"),
    "closure": ("px", "distance between steps that look ahead alone and steps that look back alone"),
    "label": ("1", "label of the region"),
    "growth": ("%", "growth of the surface area since the start, by the growth rate along the way"),
    "area_growth": ("%", "growth of the surface area since the start, by the area rate along the way"),
    "place_growth": ("%", "growth of the surface area since the start, by the places of the points"),
    "strain_11": ("%", "Lagrangian strain since the start along the tangent in the plane of X and Z"),
    "strain_22": ("%", "Lagrangian strain since the start at right angles to that tangent"),
    "strain_12": ("%", "Lagrangian shear strain since the start, between the two"),
    "strain_1": ("%", "largest Lagrangian strain since the start"),
    "strain_2": ("%", "smallest Lagrangian strain since the start"),
    "strain_angle": ("rad", "direction of the largest strain, from the tangent in the plane of X and Z"),
    "along": ("mm", "place along the axis of the leaf at the start"),
    "across": ("mm", "distance from the axis of the leaf at the start, positive to its right"),
    "strain_along": ("%", "Lagrangian strain since the start along the axis of the leaf"),
    "strain_across": ("%", "Lagrangian strain since the start across the axis of the leaf"),
    "strain_shear": ("%", "Lagrangian shear strain since the start, between the two"),
}
"""Name -> (unit, long name). Growth has a companion ``NAME_std``, its standard error."""


class TrackStatus(IntEnum):
    """Why a track ends; the first four codes are those of ``interpolation.Reading``."""

    TRACKED = Reading.OK
    OUTSIDE = Reading.OUTSIDE
    UNMEASURED = Reading.UNMEASURED
    EDGE = Reading.EDGE
    DRIFTED = 4


REASONS: dict[TrackStatus, str] = {
    TrackStatus.TRACKED: "followed to the end",
    TrackStatus.OUTSIDE: "left the measured part of the image",
    TrackStatus.UNMEASURED: "came to where nothing is measured",
    TrackStatus.EDGE: "came to the edge between two surfaces",
    TrackStatus.DRIFTED: "its drift exceeded the limit",
}
"""One phrase for each status."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Points followed through the frames of a store, T frames and n points.

    ``frames`` [T]: indices of the frames; ``times_s`` [T]: when they are, None if unknown; ``start``: the frame in
    which the points were given. ``x``, ``y`` [T, n] px: where a point is in the image, NaN from where it is lost;
    ``position`` [T, n, 3] mm: where in space, NaN without depth. ``drift`` [T, n] px: bound on how far from the truth
    ``x``, ``y`` are, ``closure`` [T, n] px: see ``drift.py``. ``status`` [n]: why a
    track ends before the last frame; ``status_before`` [n]: why it begins after the first one; codes of
    ``TrackStatus``.

    ``variables``: what else is known of the points, [T, n] or [n], those of ``VARIABLES`` by their names.

    A point that was given where nothing is measured has its ``x``, ``y`` at the start and nothing else.
    """

    frames: NDArray[np.int64]
    times_s: Floats | None
    start: int
    x: Floats
    y: Floats
    position: Floats
    drift: Floats
    closure: Floats
    status: NDArray[np.uint8]
    status_before: NDArray[np.uint8]
    variables: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    @property
    def n_points(self) -> int:
        """Number of points."""
        return int(self.x.shape[1])

    @property
    def start_index(self) -> int:
        """Index along the first axis of the frame in which the points were given."""
        return int(np.flatnonzero(self.frames == self.start)[0])

    @property
    def known(self) -> NDArray[np.bool_]:
        """[T, n]: whether a point is known in a frame."""
        return np.isfinite(self.drift)

    @property
    def ways(self) -> tuple[list[int], list[int]]:
        """Indices of the frames from the start ahead, and from the start back."""
        at = self.start_index
        return list(range(at, len(self.frames))), list(range(at, -1, -1))

    def chosen(self, points: NDArray[np.bool_]) -> Tracks:
        """Some of the points [n]."""
        variables = {
            name: v[:, points] if v.shape[:2] == self.x.shape else v[points] for name, v in self.variables.items()
        }
        cut = {name: getattr(self, name)[:, points] for name in ("x", "y", "position", "drift", "closure")}
        cut |= {name: getattr(self, name)[points] for name in ("status", "status_before")}
        return replace(self, variables=variables, **cut)

    def having(self, variables: Mapping[str, NDArray[Any]]) -> Tracks:
        """The same with further ``variables``."""
        return replace(self, variables={**self.variables, **variables})

    def __repr__(self) -> str:
        whole = int(self.known.all(axis=0).sum())
        return (
            f"<Tracks of {self.n_points} points from frame {self.start} through {self.frames[0]}..{self.frames[-1]}: "
            f"{whole} in all frames>"
        )

    def __getitem__(self, name: str) -> NDArray[Any]:
        """A variable [T, n] or [n] by its name in ``VARIABLES``; KeyError, naming those there are, for others."""
        found = dict(self._named())
        if name not in found:
            raise KeyError(f"these tracks have no {name!r}; they have: {', '.join(found)}")
        return found[name]

    def _named(self) -> Iterator[tuple[str, NDArray[Any]]]:
        yield from (("x", self.x), ("y", self.y))
        yield from ((name, self.position[..., k]) for k, name in enumerate("XYZ"))
        yield from (("drift", self.drift), ("closure", self.closure))
        yield from ((name, v) for name, v in self.variables.items() if name.removesuffix("_std") in VARIABLES)

    def to_xarray(self) -> xarray.Dataset:
        """The tracks as a Dataset with the dimensions ``t, point``, the coordinates ``t`` (frame), ``time`` and CF
        attributes; MissingExtra where xarray is not installed."""
        try:
            import xarray
        except ImportError:
            raise MissingExtra("xarray", "xarray", "Tracks.to_xarray") from None
        flags: dict[str, Any] = {
            "flag_values": np.array([int(code) for code in TrackStatus], np.uint8),
            "flag_meanings": " ".join(code.name.lower() for code in TrackStatus),
            "comment": "; ".join(f"{code.name.lower()}: {text}" for code, text in REASONS.items()),
        }
        coordinates: dict[str, Any] = {
            "t": ("t", self.frames, {"long_name": "index of the frame", "units": "frame"}),
            "point": ("point", np.arange(self.n_points), {"long_name": "number of the point"}),
        }
        if self.times_s is not None:
            coordinates["time"] = ("t", self.times_s, {"long_name": "time of the frame", "units": "s"})
        variables: dict[str, Any] = {
            name: (("t", "point")[-v.ndim :], v, _attributes(name)) for name, v in self._named()
        }
        for name, values, when in (
            ("status", self.status, "why the track ends before the last frame"),
            ("status_before", self.status_before, "why the track begins after the first frame"),
        ):
            variables[name] = (("point",), values, {"long_name": when, **flags})
        attributes = {"Conventions": "CF-1.11", "start": self.start, "title": "points followed through a sequence"}
        return xarray.Dataset(variables, coordinates, attributes)

    def columns(self) -> dict[str, NDArray[Any]]:
        """A row for every point and frame in which it is known, point after point; units are in the names."""
        point, t = np.nonzero(self.known.T)
        found: dict[str, NDArray[Any]] = {"point": point, "frame": self.frames[t]}
        if self.times_s is not None:
            found["time_s"] = self.times_s[t]
        for name, values in self._named():
            found[column_name(name, _attributes(name)["units"])] = (
                values[t, point] if values.ndim == 2 else values[point]
            )
        names = np.array([code.name.lower() for code in TrackStatus])
        found["status"], found["status_before"] = names[self.status[point]], names[self.status_before[point]]
        return found

    def to_csv(self, path: str | Path, overwrite: bool = False) -> None:
        """Write ``columns`` as CSV; errors as of ``tables.write_table``."""
        write_table(self.columns(), path, overwrite)

    def save(self, path: str | Path, overwrite: bool = False) -> None:
        """Write CSV, Parquet, NetCDF or Zarr by the suffix of ``path``; what is there is replaced by ``overwrite``.

        Raises like ``check_path``, and RunError when it cannot be written.
        """
        path = check_path(path, overwrite)
        if path.suffix.lower() in SUFFIXES:
            write_table(self.columns(), path, overwrite)
            return
        data = self.to_xarray()
        with appearing(path) as scratch:
            if path.suffix.lower() == ".zarr":
                data.to_zarr(scratch, mode="w", zarr_format=3, consolidated=False)
            else:
                packed = {name: {"zlib": True, "complevel": 4} for name in data.data_vars}
                data.to_netcdf(scratch, engine="h5netcdf", encoding=packed)


def check_path(path: str | Path, overwrite: bool = False) -> Path:
    """The path of tracks that can be written.

    Raises UsageError for another suffix than those of tables and ``DATA_SETS``, or where ``path`` exists and may not
    be replaced; MissingExtra where a package is missing.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix in SUFFIXES:
        return check_table_path(path, overwrite)
    if suffix not in DATA_SETS:
        known = ", ".join((*SUFFIXES, *DATA_SETS))
        raise UsageError(f"{path}: the format is not clear: let the name end in one of {known}")
    if path.exists() and not overwrite:
        raise UsageError(f"{path} exists: give --overwrite to replace it, or another name")
    if path.exists() and not _is_tracks(path):
        raise UsageError(f"{path} exists and holds no tracks, so --overwrite leaves it alone: give another name")
    if suffix == ".nc":
        try:
            import h5netcdf  # noqa: F401
            import h5py  # noqa: F401
        except ImportError as error:
            raise MissingExtra(str(error.name).partition(".")[0], "netcdf", "writing NetCDF") from None
    return path


def _is_tracks(path: Path) -> bool:
    """Whether what exists may be replaced by tracks: a file, or a Zarr directory of tracks."""
    if path.suffix.lower() != ".zarr":
        return path.is_file()
    return (path / "closure" / "zarr.json").is_file()


def _attributes(name: str) -> dict[str, str]:
    unit, long_name = VARIABLES[name.removesuffix("_std")]
    return {"units": unit, "long_name": long_name if name in VARIABLES else f"standard error of the {long_name}"}
