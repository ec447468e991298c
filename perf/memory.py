"""``--max-memory`` against the peak memory of runs that it binds, each in a process of its own.

The scene is a plane of noise; its images are written beforehand as the cases want them: plain TIFFs, compressed ones
that are decoded as a whole, ones with a lens to rectify, large ones. A limit is kept when the whole process, with the
interpreter and the engine, and its workers if it has any, stays below it. A limit under which a plan is refused is
reported as such. Kernels are compiled by the first run of a kind, and loaded by the others.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tifffile

import leafflow_ti as lf
from leafflow_ti.api import plan_run
from leafflow_ti.bands import COMPILING_BYTES, PROCESS_BYTES
from leafflow_ti.config import load_config
from leafflow_ti.errors import ConfigError
from leafflow_ti.synthetic.plane import sinusoid_scene
from leafflow_ti.synthetic.write import CAPTURE_FILE, write_scene
from perf.cases import Options
from perf.figures import Figure, Outcome
from perf.fresh import FreshRun, fresh_run

SHIFT: dict[str, Any] = {"preshift": (-14, 0)}
AFFINE: dict[str, Any] = {**SHIFT, "model": "affine-4d"}
CALIBRATION = "lens.json"


@dataclass(frozen=True)
class Row:
    """One kind of run under several ``limits``, those that are too little last. ``images``: of ``IMAGES``."""

    name: str
    options: Mapping[str, Any]
    limits: tuple[str, ...]
    images: str = "plain"
    pictures: bool = False


ROWS = (
    Row("affine-4d, stride 1", {**AFFINE, "stride": 1}, ("1G", "500M", "400M")),
    Row("scene flow, not refined", {**SHIFT, "refine": 0, "stride": 4}, ("500M",)),
    Row("scene flow, refined", {**SHIFT, "frames": "3:4", "roi": (200, 150, 800, 600)}, ("1G", "600M", "450M")),
    Row("adaptive, refined", {"roi": (200, 150, 800, 600)}, ("1G", "780M", "600M")),
    Row("adaptive, not refined", {"refine": 0, "preshift": "adaptive"}, ("1G", "740M")),
    Row("flow of one camera, stride 1", {"model": "flow-affine", "stride": 1}, ("500M", "360M"), "alone"),
    Row("range flow", {**SHIFT, "model": "range-flow", "stride": 4}, ("600M", "420M")),
    Row("robust estimator", {**AFFINE, "stride": 2, "estimator": "robust-tls"}, ("600M", "400M")),
    Row("f64", {**AFFINE, "stride": 2, "precision": "f64"}, ("600M", "450M")),
    Row("prefilter", {**AFFINE, "stride": 2, "prefilter": "highpass"}, ("600M", "400M")),
    Row("lens", {**AFFINE, "stride": 2}, ("600M", "400M"), "lens"),
    Row("compressed, decoded images kept", {**AFFINE, "stride": 2}, ("600M", "400M"), "compressed"),
    Row("two workers", {**AFFINE, "stride": 1, "workers": 2}, ("1200M", "900M", "700M")),
    Row("2048 x 1536 px, stride 1, pictures", {**AFFINE, "stride": 1}, ("1G", "600M", "400M"), "large", True),
)


@dataclass(frozen=True)
class Settings:
    """``size`` of the images, and of the ``large`` ones."""

    size: tuple[int, int] = (1024, 768)
    large: tuple[int, int] = (2048, 1536)
    rows: tuple[Row, ...] = field(default=ROWS, repr=False)


def write_images(folder: Path, size: tuple[int, int], cameras: int, frames: int = 7) -> Path:
    """A plane of noise before cameras in a row."""
    scene = sinusoid_scene(noise=1.0, size=size, bits=8)
    slower = tuple(0.5 * v for v in scene.velocity), tuple(0.5 * v for v in scene.omega)
    texture: dict[str, Any] = {"texture": "noise", "wavelengths_mm": (0.1, 1.5), "supersampling": 1, "amplitude": 25.0}
    write_scene(replace(scene, n_cols=cameras, n_frames=frames, velocity=slower[0], omega=slower[1], **texture), folder)
    return folder


def _compressed(folder: Path, settings: Settings) -> None:
    """One strip an image: it cannot be read in parts."""
    for path in write_images(folder, settings.size, 5).rglob("*.tif"):
        tifffile.imwrite(path, tifffile.imread(path), compression="zlib", rowsperstrip=settings.size[1])


def _with_lens(folder: Path, settings: Settings) -> None:
    write_images(folder, settings.size, 5)
    (width, height), described = settings.size, (folder / CAPTURE_FILE).read_text(encoding="utf-8").splitlines()
    focal = next(line.split("=")[1] for line in described if line.startswith("focal_length_px"))
    calibration = {
        "camera_matrix": [[float(focal), 0, (width - 1) / 2], [0, float(focal), (height - 1) / 2], [0, 0, 1]],
        "distortion_coefficients": [-0.05, 0.01, 0, 0],
    }
    (folder / CALIBRATION).write_text(json.dumps(calibration), encoding="utf-8")
    named = [f'calibration = "{CALIBRATION}"' if line.startswith("focal") else line for line in described]
    (folder / CAPTURE_FILE).write_text("\n".join(named), encoding="utf-8")


IMAGES: dict[str, Callable[[Path, Settings], object]] = {
    "plain": lambda folder, settings: write_images(folder, settings.size, 5),
    "alone": lambda folder, settings: write_images(folder, settings.size, 1),
    "large": lambda folder, settings: write_images(folder, settings.large, 3, 6),
    "compressed": _compressed,
    "lens": _with_lens,
}


def measure(settings: Settings) -> Outcome:
    """Peaks against limits, and what the process takes for itself."""
    figures: list[Figure] = []
    notes: list[str] = []
    runs: list[FreshRun] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for row in settings.rows:
            capture = folder / row.images
            if not capture.exists():
                IMAGES[row.images](capture, settings)
            for limit in row.limits:
                options = {**row.options, "max_memory": limit}
                try:
                    plan = plan_run(lf.open_capture(capture), load_config(overrides=options))
                except ConfigError as error:
                    notes.append(f"{row.name}: refused: {error}")
                    continue
                out = folder / f"out-{len(runs)}.zarr"
                run = fresh_run(capture, out, options, row.pictures, folder / "kernels")
                runs.append(run)
                bound = plan.config.plan.max_memory / 2**20
                note = (
                    f"arrays planned {run.planned_mib:.0f}, process {run.base_mib:.0f}, {run.bands} bands, "
                    f"{run.seconds:.0f} s"
                )
                figures.append(Figure(f"{row.name}, limit {limit}", run.peak_mib, "MiB", bound, note=note))
    figures += [
        Figure("process with its kernels, largest", max(r.base_mib for r in runs), "MiB", PROCESS_BYTES / 2**20),
        Figure("while compiling, largest", max(r.compiling_mib for r in runs), "MiB", COMPILING_BYTES / 2**20),
    ]
    return Outcome(tuple(figures), {"size": settings.size, "large": settings.large}, tuple(notes))


def run(options: Options) -> Outcome:
    """The case; quick: small images, one limit of two kinds."""
    if options.quick:
        return measure(Settings((260, 160), rows=(Row("affine-4d", {**AFFINE, "stride": 4}, ("400M", "100M")),)))
    return measure(Settings())
