"""The measured surface of each frame, packed for the page: depths, triangles and arrows in few bytes.

Arrays are little-endian integers, replaced by the differences of neighbours (modulo 2^16 or 2^32), deflated and written
as base64: regular grids of triangles then take next to nothing, and depths little more than their noise.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.field import Field
from leafflow_ti.mesh import surface_mesh

STEPS = 65535
ARROWS = 16
"""Arrows along the longer side."""

VELOCITY = ("velocity_x", "velocity_y", "velocity_z")


def has_surface(field: Field) -> bool:
    """Whether the results have a surface: depths, and the camera's geometry."""
    return "depth" in field and "f_px" in field.attrs.get("plan", {})


def packed_surfaces(fields: Sequence[Field]) -> dict[str, Any]:
    """The surfaces of all frames as JSON values, without the depths of the coarse search.

    ``view``: middle and radius [mm] of what is shown; ``depth``: lowest depth and its step [mm]; ``camera``: focal
    length and principal point [px]; ``grid``: columns and rows, first column and row and their pitch [px]; ``speed``:
    typical velocity [mm/frame], ``step``: of its packed values. Per frame: ``pixels`` [n] positions in a flattened
    map, ``depths`` [n], ``triangles`` [m, 3], ``tails`` [k] vertices at which arrows stand, ``arrows`` [k, 3] their
    velocity.
    """
    measured = [field.measured() for field in fields]
    meshes = [surface_mesh(field) for field in measured]
    points = np.concatenate([mesh.vertices for mesh in meshes])
    depths = points[:, 2] if points.size else np.array([0.0])
    low, step = float(depths.min()), max(float(np.ptp(depths)), 1e-6) / STEPS
    has_motion = all(name in fields[0] for name in VELOCITY)
    motions = [_arrows(field, mesh.pixels) for field, mesh in zip(measured, meshes, strict=True)] if has_motion else []
    lengths = np.concatenate([np.linalg.norm(v, axis=1) for _, v in motions]) if motions else np.empty(0)
    fastest = float(lengths.max()) if lengths.size else 0.0
    frames = []
    for i, mesh in enumerate(meshes):
        frame = {
            "pixels": packed(mesh.pixels, np.uint32),
            "depths": packed(np.rint((mesh.vertices[:, 2] - low) / step), np.uint16),
            "triangles": packed(mesh.triangles, np.uint32),
        }
        if motions:
            tails, velocity = motions[i]
            frame |= {"tails": packed(tails, np.uint32)}
            frame |= {"arrows": packed(np.rint(velocity / (fastest or 1.0) * 32767).astype(np.int16), np.uint16)}
        frames.append(frame)
    plan, y, x = fields[0].attrs["plan"], fields[0].y, fields[0].x
    return {
        "view": _view(points),
        "depth": [low, step],
        "camera": [float(plan["f_px"]), *(float(p) for p in plan["principal_px"])],
        "grid": [x.size, y.size, int(x[0]), int(y[0]), int(x[1] - x[0]) if x.size > 1 else 1],
        "speed": float(np.percentile(lengths, 95)) if lengths.size else 0.0,
        "step": fastest / 32767,
        "frames": frames,
    }


def packed(values: NDArray[Any], dtype: type[np.uint16] | type[np.uint32]) -> str:
    """An array of integers as base64: neighbours along the first axis replaced by differences, deflated."""
    whole = np.asarray(values).astype(np.int64)
    differences = np.diff(whole, axis=0, prepend=np.zeros_like(whole[:1])) if whole.size else whole
    wrapped = (differences % (np.iinfo(dtype).max + 1)).astype(dtype)
    return base64.b64encode(zlib.compress(wrapped.astype(wrapped.dtype.newbyteorder("<")).tobytes(), 9)).decode("ascii")


def _arrows(field: Field, pixels: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Vertices on a thin grid that have a velocity [k], and these [k, 3]."""
    step = max(1, round(max(field.shape) / ARROWS))
    rows, columns = np.divmod(pixels, field.shape[1])
    velocity = np.stack([field[name].reshape(-1)[pixels] for name in VELOCITY], axis=-1).astype(np.float64)
    on_grid = (rows % step == step // 2) & (columns % step == step // 2)
    tails = np.flatnonzero(on_grid & np.isfinite(velocity).all(axis=-1))
    return tails, velocity[tails]


def _view(points: NDArray[np.floating]) -> list[float]:
    """Middle (X, Y, Z) and radius [mm] that hold nearly all points: a few outliers must not make the rest small."""
    if not len(points):
        return [0.0, 0.0, 1.0, 1.0]
    low, high = np.percentile(points, (1, 99), axis=0)
    return [*((low + high) / 2).tolist(), max(float(np.linalg.norm(high - low)) / 2, 1e-6)]
