"""VTK: a series of surfaces (``.vtp``) with vectors and scalars, and the index ``.pvd`` that ParaView opens."""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import InputError
from leafflow_ti.exporters.selection import Selection
from leafflow_ti.field import Field, map_attributes
from leafflow_ti.mesh import SurfaceMesh, surface_mesh

INDEX = "series.pvd"
_TYPES = {"f4": "Float32", "i4": "Int32", "u1": "UInt8"}
_SHOWN = ("growth_rate", "area_rate", "depth")
"""Scalars that ParaView colours the surface by at first: the first of them that was chosen."""


def write_vtk_file(selection: Selection, path: Path) -> list[Path]:
    """The surface of the one chosen frame."""
    (field,) = selection.fields(surface=True)
    _write(selection, field, path)
    return [path]


def write_vtk_folder(selection: Selection, folder: Path) -> list[Path]:
    """One surface ``frame_0004.vtp`` per frame, and ``series.pvd`` with their times [s, else frames]."""
    written = []
    for field in selection.fields(surface=True):
        written.append(folder / f"frame_{field.frame:04d}.vtp")
        _write(selection, field, written[-1])
    times = selection.frames if selection.times_s is None else selection.times_s
    entries = [
        f'    <DataSet timestep="{time:.10g}" part="0" file={quoteattr(path.name)}/>'
        for time, path in zip(times, written, strict=True)
    ]
    head = (
        '<?xml version="1.0"?>\n<VTKFile type="Collection" version="1.0" byte_order="LittleEndian">\n  <Collection>\n'
    )
    index = folder / INDEX
    index.write_text(head + "\n".join(entries) + "\n  </Collection>\n</VTKFile>\n", encoding="utf-8")
    return [index, *written]


def point_arrays(mesh: SurfaceMesh, field: Field, names: tuple[str, ...]) -> dict[str, tuple[NDArray[np.generic], str]]:
    """Name -> values at the vertices and unit: ``NAME_x, _y, _z`` together as vectors [n, 3], the rest as they are.

    A standard error of a vector is a vector as well.
    """
    found: dict[str, tuple[NDArray[np.generic], str]] = {}
    for name in names:
        base, suffix = (name[:-4], "_std") if name.endswith("_std") else (name, "")
        parts = [f"{base[:-1]}{axis}{suffix}" for axis in "xyz"]
        unit = map_attributes(name).get("units", "")
        if base[-2:] in ("_x", "_y", "_z") and all(part in names for part in parts):
            vectors = np.stack([mesh.at(field[part]) for part in parts], axis=-1)
            found.setdefault(f"{base[:-2]}{suffix}", (vectors, unit))
        else:
            found[name] = (mesh.at(field[name]), unit)
    return found


class _Appended:
    """Arrays behind the XML, raw: the number of bytes, then the bytes, one array after the other."""

    def __init__(self) -> None:
        self.blocks: list[bytes] = []
        self._offset = 0

    def element(self, values: NDArray[np.generic], name: str, unit: str = "") -> str:
        """The XML element of an array [n] or [n, components]."""
        data = np.ascontiguousarray(values)
        data = data.astype(data.dtype.newbyteorder("<"), copy=False)
        components = f' NumberOfComponents="{data.shape[1]}"' if data.ndim == 2 else ""
        head = (
            f'<DataArray type="{_TYPES[data.dtype.str[1:]]}" Name={quoteattr(name)}{components} format="appended" '
            f'offset="{self._offset}"'
        )
        self.blocks += [np.uint64(data.nbytes).astype("<u8").tobytes(), data.tobytes()]
        self._offset += 8 + data.nbytes
        if not unit:
            return f"{head}/>"
        key = f'<InformationKey name="UNITS_LABEL" location="vtkDataArray">{unit}</InformationKey>'
        return f"{head}>{key}</DataArray>"


def _write(selection: Selection, field: Field, path: Path) -> None:
    mesh, data = surface_mesh(field), _Appended()
    arrays = point_arrays(mesh, field, selection.names)
    if "normals" in arrays:
        raise InputError("a map is called 'normals': VTK keeps that name for the surface's")
    shown = next((name for name in _SHOWN if name in arrays), None)
    active = ' Normals="normals"' + (' Vectors="velocity"' if "velocity" in arrays else "")
    active += f' Scalars="{shown}"' if shown else ""
    offsets = 3 * np.arange(1, len(mesh.triangles) + 1, dtype=np.int32)
    lines = [
        '<?xml version="1.0"?>',
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt64">',
        "<PolyData>",
        f'<Piece NumberOfPoints="{len(mesh.vertices)}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" '
        f'NumberOfPolys="{len(mesh.triangles)}">',
        f"<Points>{data.element(mesh.vertices, 'Points')}</Points>",
        f"<PointData{active}>",
        data.element(mesh.normals, "normals"),
        *(data.element(values, name, unit) for name, (values, unit) in arrays.items()),
        *([data.element(mesh.at(field.status), "status")] if selection.status else []),
        "</PointData>",
        "<Polys>",
        data.element(mesh.triangles.reshape(-1), "connectivity"),
        data.element(offsets, "offsets"),
        "</Polys>",
        "</Piece>",
        "</PolyData>",
        '<AppendedData encoding="raw">',
        "_",
    ]
    with path.open("wb") as file:
        file.write("\n".join(lines).encode())
        file.writelines(data.blocks)
        file.write(b"\n</AppendedData>\n</VTKFile>\n")
