"""Results in the formats of other programs: one table of formats, one file of code each.

A format's writer takes a ``Selection`` and a path that does not exist yet (a folder does, empty) and returns what it
wrote. It reads one frame at a time, so that memory does not grow with the sequence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Protocol, cast

from leafflow_ti.errors import InputError, UsageError
from leafflow_ti.exporters.selection import Selection
from leafflow_ti.results import ResultStore
from leafflow_ti.whole import appearing

Writer = Callable[[Selection, Path], list[Path]]


class _Count(Protocol):
    def __call__(self, selection: Selection) -> int: ...


def _one(selection: Selection) -> int:
    return 1


def _frames(selection: Selection) -> int:
    return len(selection.indices)


def _maps(selection: Selection) -> int:
    return len(selection.all_names)


@dataclass(frozen=True)
class Format:
    """A format. ``suffixes``: of its files; ``file``, ``folder``: its writers, as ``module:function`` of this package,
    into one file and into a folder; ``parts``: how many files one file stands for, which it can only if that is 1;
    ``surface``: whether it needs a depth.
    """

    suffixes: tuple[str, ...]
    file: str | None
    folder: str | None
    parts: _Count
    surface: bool = False


FORMATS: dict[str, Format] = {
    "tiff": Format((".tif", ".tiff"), "tiff:write_imagej_file", "tiff:write_imagej_folder", _maps),
    "ome-tiff": Format((".tif", ".tiff"), "tiff:write_ome", None, _one),
    "netcdf": Format((".nc",), "netcdf:write_netcdf", None, _one),
    "ply": Format((".ply",), "ply:write_ply_file", "ply:write_ply_folder", _frames, surface=True),
    "vtk": Format((".vtp",), "vtk:write_vtk_file", "vtk:write_vtk_folder", _frames, surface=True),
    "csv": Format((".csv",), "text:write_csv_file", "text:write_csv_folder", _one),
}
"""Name -> format."""
FILES = {".txt", ".vtk", ".vtu", ".zarr", ".parquet"}.union(*(kind.suffixes for kind in FORMATS.values()))
"""Suffixes that no folder of an export has: whoever names one expects a file."""


def export(
    store: ResultStore | str | Path,
    to: str,
    path: str | Path,
    *,
    frames: str | None = None,
    maps: Sequence[str] | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write results in the format ``to``, one of ``FORMATS``; return the files.

    ``path``: a file, by its suffix, or a folder for formats of several files. ``frames``: ``"A:B"``, indices of
    frames, B excluded; ``maps``: names or patterns such as ``"velocity_*"``, ``"status"`` among them; None: all.
    ``overwrite`` replaces a file, or a folder that holds files of this format alone. What is written appears under its
    name when it is whole.
    Raises UsageError, InputError (no such map or frame, no depth for a mesh), MissingExtra, RunError (an unfinished
    store, or files that cannot be written).
    """
    if to not in FORMATS:
        raise UsageError(f"no format {to!r}: choose one of {', '.join(FORMATS)}")
    store, path, kind = store if isinstance(store, ResultStore) else ResultStore.open(store), Path(path), FORMATS[to]
    selection = Selection.of(store, frames, maps)
    if kind.surface and "depth" not in store.names:
        raise InputError(f"{store.path}: has no depth, so no surface for {to}: measure with a camera grid, or take csv")
    as_file = _as_file(kind, to, path, selection)
    _check_target(path, as_file, kind, overwrite)
    writer = _writer(kind.file if as_file else kind.folder)
    with appearing(path) as scratch:
        if not as_file:
            scratch.mkdir()
        written = writer(selection, scratch)
    return [path / file.relative_to(scratch) for file in written]


def _as_file(kind: Format, to: str, path: Path, selection: Selection) -> bool:
    """Whether ``path`` names one file, by its suffix; UsageError where that cannot be."""
    if path.suffix.lower() not in kind.suffixes:
        if kind.folder is None:
            raise UsageError(f"{path}: {to} is one file: let its name end in {kind.suffixes[0]}")
        if path.suffix.lower() in FILES:
            raise UsageError(
                f"{path}: no name for {to}: let that of a file end in {kind.suffixes[0]}, that of a folder in no suffix"
            )
        return False
    if kind.file is None or kind.parts(selection) != 1:
        raise UsageError(
            f"{path} is one file, this selection makes {kind.parts(selection)}: give a folder (a name without "
            f"{path.suffix}), or choose with --frames and --maps"
        )
    return True


def _check_target(path: Path, as_file: bool, kind: Format, overwrite: bool) -> None:
    """Refuse to replace what must be kept."""
    if not path.exists():
        return
    if path.is_dir() == as_file:
        raise UsageError(f"{path} exists and is a {'folder' if as_file else 'file'}: give another name")
    if as_file and not overwrite:
        raise UsageError(f"{path} exists: give --overwrite to replace it, or another name")
    ours = (*kind.suffixes, ".pvd")
    foreign = [] if as_file else sorted(p.name for p in path.iterdir() if p.is_dir() or p.suffix.lower() not in ours)
    if foreign:
        raise UsageError(f"{path} holds something else ({foreign[0]}), so it is not replaced: give another name")
    if not as_file and not overwrite and any(path.iterdir()):
        raise UsageError(f"{path} exists: give --overwrite to replace it, or another name")


def _writer(place: str | None) -> Writer:
    assert place is not None
    module, _, function = place.partition(":")
    return cast(Writer, getattr(import_module(f"leafflow_ti.exporters.{module}"), function))
