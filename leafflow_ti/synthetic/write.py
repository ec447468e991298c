"""A scene as files: TIFF images, the ``capture.toml`` that describes them, the exact truth as ``truth.npz``, and the
regions of its middle frame as ``labels.tif``."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from leafflow_ti.errors import RunError, UsageError
from leafflow_ti.synthetic.geometry import Array
from leafflow_ti.synthetic.scene import Scene, render_image, truth

CAPTURE_FILE = "capture.toml"
TRUTH_FILE = "truth.npz"
LABELS_FILE = "labels.tif"


def write_scene(
    scene: Scene,
    folder: Path,
    interval_s: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render ``scene`` into a new or empty ``folder``, which appears under its name only when it is whole.

    Images are uint8 or uint16 (10, 12 and 14 bits lie in 16), or float32 for ``bits`` None. ``truth.npz`` holds the
    maps of ``truth``, the index ``frame`` they belong to, ``f_px``, ``baseline_mm`` and ``principal``; ``labels.tif``
    (uint8) its ``region``, of scenes that have one.
    ``interval_s`` [s] is the time between frames; ``progress`` is called with the number of images done and of all.
    Raises UsageError if the folder holds anything, or as rendering does; RunError if it cannot be written.
    """
    if interval_s is not None and not 0.0 < interval_s < float("inf"):
        raise UsageError(f"interval = {interval_s:g} s: must be positive and finite")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder} exists and is not empty: remove it, or name another folder")
    scratch = folder.absolute().with_name(f".{folder.absolute().name}.{os.getpid()}")
    try:
        scratch.mkdir(parents=True)
        _write_images(scene, scratch, progress)
        arrays = truth_arrays(scene)
        np.savez_compressed(scratch / TRUTH_FILE, **arrays)
        if "region" in arrays:
            tifffile.imwrite(scratch / LABELS_FILE, arrays["region"].astype(np.uint8))
        (scratch / CAPTURE_FILE).write_text(capture_text(scene, interval_s), encoding="utf-8")
        if folder.exists():
            folder.rmdir()
        scratch.rename(folder)
    except OSError as error:
        raise RunError(f"{folder}: cannot be written ({error.strerror or error}): choose another folder") from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _write_images(scene: Scene, folder: Path, progress: Callable[[int, int], None] | None) -> None:
    pattern = image_pattern(scene)
    images = [(t, sy, sx) for t in range(scene.n_frames) for sy in range(scene.n_rows) for sx in range(scene.n_cols)]
    for done, (t, sy, sx) in enumerate(images, start=1):
        path = folder / pattern.format(t=t, sy=sy, sx=sx)
        path.parent.mkdir(exist_ok=True)
        tifffile.imwrite(path, _stored(scene, render_image(scene, t, sy, sx)))
        if progress is not None:
            progress(done, len(images))


def image_pattern(scene: Scene) -> str:
    """File names with a field for each axis of more than one sample, e.g. ``cam_{sx:02d}/frame_{t:03d}.tif``."""
    counts = (("sy", scene.n_rows), ("sx", scene.n_cols))
    camera = "".join(f"_{{{axis}:0{_digits(n, 2)}d}}" for axis, n in counts if n > 1)
    if scene.n_frames == 1:
        return f"cam{camera}.tif" if camera else "image.tif"
    frame = f"frame_{{t:0{_digits(scene.n_frames, 3)}d}}.tif"
    return f"cam{camera}/{frame}" if camera else frame


def capture_text(scene: Scene, interval_s: float | None = None) -> str:
    """The content of ``capture.toml`` for the images of ``image_pattern``."""
    pattern = image_pattern(scene)
    lines = ["[images]", f'{"pattern" if "{" in pattern else "path"} = "{pattern}"']
    if scene.bits not in (None, 8, 16):
        lines.append(f"bit_depth = {scene.bits}")
    lines += ["", "[camera]", f"focal_length_px = {_floats(scene.f_px)}"]
    lines.append(f"principal_point_px = [{_floats(*scene.principal)}]")
    if scene.n_cols * scene.n_rows > 1:
        lines += ["", "[grid]", f"baseline_mm = [{_floats(*scene.baseline_mm)}]"]
    if interval_s is not None:
        lines += ["", "[time]", f"interval_s = {_floats(interval_s)}"]
    return "\n".join(lines) + "\n"


def truth_arrays(scene: Scene) -> dict[str, Any]:
    """All arrays of ``truth.npz``."""
    return {
        **truth(scene),
        "frame": np.array(scene.reference_frame),
        "f_px": np.array(scene.f_px),
        "baseline_mm": np.array(scene.baseline_mm),
        "principal": np.array(scene.principal),
    }


def _stored(scene: Scene, image: Array) -> NDArray[np.generic]:
    if scene.bits is None:
        return image.astype(np.float32)
    return image.astype(np.uint8 if scene.bits == 8 else np.uint16)


def _digits(count: int, least: int) -> int:
    return max(least, len(str(count - 1)))


def _floats(*numbers: float) -> str:
    """Numbers as TOML floats that read back exactly."""
    return ", ".join(repr(float(number)) for number in numbers)
