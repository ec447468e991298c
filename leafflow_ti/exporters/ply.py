"""PLY: one binary mesh per frame, every map a property of its vertices, for MeshLab, CloudCompare and Blender."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from leafflow_ti.exporters.selection import Selection
from leafflow_ti.field import Field, map_attributes
from leafflow_ti.mesh import surface_mesh


def write_ply_file(selection: Selection, path: Path) -> list[Path]:
    """The surface of the one chosen frame."""
    (field,) = selection.fields(surface=True)
    _write(selection, field, path)
    return [path]


def write_ply_folder(selection: Selection, folder: Path) -> list[Path]:
    """One mesh ``frame_0004.ply`` per frame into ``folder``."""
    written = []
    for field in selection.fields(surface=True):
        written.append(folder / f"frame_{field.frame:04d}.ply")
        _write(selection, field, written[-1])
    return written


def _write(selection: Selection, field: Field, path: Path) -> None:
    mesh = surface_mesh(field)
    columns = {axis: mesh.vertices[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"n{axis}": mesh.normals[:, k] for k, axis in enumerate("xyz")}
    columns |= {name: mesh.at(field[name]) for name in selection.names}
    if selection.status:
        columns["status"] = mesh.at(field.status)
    vertices = np.empty(
        len(mesh.vertices), [(name, "u1" if a.dtype == np.uint8 else "<f4") for name, a in columns.items()]
    )
    for name, values in columns.items():
        vertices[name] = values
    faces = np.empty(len(mesh.triangles), [("n", "u1"), ("corners", "<i4", 3)])
    faces["n"], faces["corners"] = 3, mesh.triangles
    with path.open("wb") as file:
        file.write("\n".join(_header(selection, field, vertices, len(faces))).encode("ascii") + b"\n")
        file.write(vertices.tobytes())
        file.write(faces.tobytes())


def _header(selection: Selection, field: Field, vertices: np.ndarray, n_faces: int) -> list[str]:
    units = [(name, map_attributes(name).get("units")) for name in selection.all_names]
    return [
        "ply",
        "format binary_little_endian 1.0",
        f"comment leafflow-ti, frame {field.frame}; mm, X right, Y down, Z away from the camera",
        *(f"comment unit {name} {unit.replace('²', '^2')}" for name, unit in units if unit),
        f"element vertex {len(vertices)}",
        *(f"property {'uchar' if kind[0] == '|u1' else 'float'} {name}" for name, kind in _types(vertices)),
        f"element face {n_faces}",
        "property list uchar int vertex_indices",
        "end_header",
    ]


def _types(vertices: np.ndarray) -> list[tuple[str, tuple[str]]]:
    return [(name, (vertices.dtype[name].str,)) for name in vertices.dtype.names or ()]
