"""A small plane before five cameras in 13 frames, as tests of runs take it: in memory, or as a folder of files."""

from __future__ import annotations

import hashlib
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import tifffile

import leafflow_ti as lf
from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.config import RunConfig, load_config
from leafflow_ti.synthetic.plane import PlaneScene, render
from leafflow_ti.synthetic.write import write_scene

SCENE = PlaneScene(
    f_px=900.0,
    baseline_mm=(0.3, 0.3),
    n_cols=5,
    n_frames=13,
    size=(61, 43),
    centre=(0.3, -0.2, 80.0),
    zx=0.3,
    zy=-0.2,
    velocity=(0.021, -0.014, 0.06),
    omega=(0.002, -0.003, 0.004),
    wavelengths_mm=(0.6, 0.75),
    alpha=0.4,
    beta=1.0,
    noise=1.0,
)
OPTIONS: dict[str, object] = {
    "model": "affine-4d",
    "motion": "rotation",
    "preshift": (-3, 0),
    "window": 9,
    "sigma": 2.5,
}


def capture_of(scene: PlaneScene, **geometry: tuple[float, float]) -> Capture:
    return capture_from_array(render(scene), Geometry(scene.f_px, scene.principal, scene.baseline_mm, **geometry))


def write_compressed(folder: Path) -> np.ndarray:
    """The same as files that are compressed strip by strip, and what they hold [t, sy, sx, y, x]: floats, some of them
    not finite."""
    write_scene(replace(SCENE, bits=None), folder)
    images = render(SCENE).astype(np.float32)
    images[6, 0, 1, 20:22, 30] = np.nan
    for t, sx in np.ndindex(images.shape[0], images.shape[2]):
        path = folder / f"cam_{sx:02d}" / f"frame_{t:03d}.tif"
        tifffile.imwrite(path, images[t, 0, sx], compression="zlib", rowsperstrip=8)
    return images


def config(**options: object) -> RunConfig:
    return load_config(overrides={**OPTIONS, **options})


def files_of(store: Path) -> dict[str, str]:
    """Checksum of every file of a store but the attributes, which hold timings."""
    files = [p for p in store.rglob("*") if p.is_file() and p != store / "zarr.json"]
    return {str(p.relative_to(store)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def assert_same(one: lf.Field, two: lf.Field, part: tuple[slice, slice] = (slice(None), slice(None))) -> None:
    """``two`` equals ``part`` of ``one``, bit for bit."""
    assert list(one) == list(two)
    np.testing.assert_array_equal(one.status[part], two.status)
    assert (two.status == 0).any()
    for name in one:
        assert one[name][part].tobytes() == two[name].tobytes(), name


def running_threads() -> set[threading.Thread]:
    """All but those that the library of the stores keeps for itself."""
    return {t for t in threading.enumerate() if not t.name.startswith(("asyncio", "zarr"))}
