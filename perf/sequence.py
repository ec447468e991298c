"""Runs from files: the pace and the memory of a long sequence, and large images within a memory cap.

Images are those of the sinusoidal plane, 8 bit TIFF, written to a temporary folder beforehand; every run is a process
of its own. Time per frame is told from the moments at which units are finished.
"""

from __future__ import annotations

import statistics
import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from leafflow_ti.synthetic.plane import sinusoid_scene
from leafflow_ti.synthetic.write import write_scene
from perf.cases import Options
from perf.figures import Figure, Outcome
from perf.fresh import FreshRun, fresh_run

MODEL: dict[str, Any] = {"model": "affine-4d", "preshift": (-14, 0)}


@dataclass(frozen=True)
class Sequence:
    """A ``long`` and a ``short`` run of the same images, ``repeats`` of each.

    The frames from ``first`` to ``last``, counted from 1, must keep their pace: the means of as many as fit three
    times between them are compared, those at the beginning with those at the end.
    """

    size: tuple[int, int] = (520, 320)
    long: int = 30
    short: int = 12
    first: int = 5
    last: int = 25
    stride: int = 1
    repeats: int = 5


@dataclass(frozen=True)
class Large:
    """Images of ``size`` by 9 cameras, just enough ``frames`` for ``measured`` ones, under ``max_memory``."""

    size: tuple[int, int] = (1600, 1200)
    measured: int = 2
    stride: int = 1
    max_memory: str = "2G"


WINDOW_FRAMES = 9
"""Frames that one measurement takes: 5 samples under 5 taps."""


def write_images(folder: Path, size: tuple[int, int], frames: int) -> Path:
    """A capture of 9 cameras and ``frames`` frames; returns its folder."""
    scene = sinusoid_scene(noise=1.0, size=size, bits=8)
    # The plane may leave through the camera in a long sequence: the slower, the longer it is.
    slower = min(1.0, 9 / frames)
    velocity, omega = (tuple(slower * v for v in vector) for vector in (scene.velocity, scene.omega))
    write_scene(replace(scene, n_frames=frames, velocity=velocity, omega=omega), folder)
    return folder


def _pace(run: FreshRun) -> list[float]:
    """Seconds of every measured frame after the first, a frame being a unit."""
    assert run.bands == 1
    return [after - before for before, after in zip(run.units[:-1], run.units[1:], strict=True)]


def measure_sequence(settings: Sequence) -> Outcome:
    """Pace within the long sequence, its memory against that of the short one."""
    with tempfile.TemporaryDirectory() as name:
        capture = write_images(Path(name) / "images", settings.size, settings.long)
        whole = {**MODEL, "stride": settings.stride, "tile": settings.size[1]}

        def run(frames: int, n: int) -> FreshRun:
            # The short sequence ends where its last window does.
            options = {**whole, "frames": f"0:{frames - WINDOW_FRAMES // 2}"}
            return fresh_run(capture, Path(name) / f"out-{frames}-{n}.zarr", options)

        runs = {frames: [run(frames, n) for n in range(settings.repeats)] for frames in (settings.long, settings.short)}
    long = runs[settings.long]
    # The first time is that of the second measured frame. A unit that is told late makes the next look short: medians.
    usual = [statistics.median(times) for times in zip(*(_pace(r) for r in long), strict=True)]
    of_frame = {WINDOW_FRAMES // 2 + 2 + i: seconds for i, seconds in enumerate(usual)}
    kept = [of_frame[n] for n in range(settings.first, settings.last + 1) if n in of_frame]
    third = max(1, len(kept) // 3)
    pace = statistics.mean(kept[-third:]) / statistics.mean(kept[:third])
    pixels = long[0].pixels / len(long[0].units)
    peaks = {frames: statistics.median(r.peak_mib for r in found) for frames, found in runs.items()}
    figures = (
        Figure("time per frame", 1e3 * statistics.median(kept), "ms", note=f"images of {pixels:.0f} pixels"),
        Figure("time per pixel of the image", 1e6 * statistics.median(kept) / pixels, "us/px"),
        Figure(f"the last third of frames {settings.first}..{settings.last} over the first", pace, "x", 1.1, low=0.9),
        Figure(f"peak memory of {settings.long} frames", peaks[settings.long], "MiB"),
        Figure(f"peak memory of {settings.short} frames", peaks[settings.short], "MiB"),
        Figure("long over short", peaks[settings.long] / peaks[settings.short], "x", 1.05, low=0.95),
        Figure("memory planned for a unit", long[0].planned_mib, "MiB"),
    )
    note = "medians of the repeats, each a process of its own"
    return Outcome(figures, asdict(settings), (note,))


def measure_large(settings: Large) -> Outcome:
    """Peak memory against the cap, and the pace."""
    frames = WINDOW_FRAMES - 1 + settings.measured
    with tempfile.TemporaryDirectory() as name:
        capture = write_images(Path(name) / "images", settings.size, frames)
        options = {**MODEL, "stride": settings.stride, "max_memory": settings.max_memory}
        run = fresh_run(capture, Path(name) / "out.zarr", options)
    cap_mib = float(settings.max_memory[:-1]) * {"M": 1, "G": 1024}[settings.max_memory[-1]]
    figures = (
        Figure("peak memory", run.peak_mib, "MiB", cap_mib, note=f"cap {settings.max_memory}"),
        Figure("memory planned for a unit", run.planned_mib, "MiB", cap_mib),
        Figure("bands of an image", run.bands),
        Figure("time per measured frame", run.seconds / settings.measured, "s", note="with reading and writing"),
        Figure("time per pixel of the image", 1e6 * run.seconds / run.pixels, "us/px"),
        Figure("compiling or loading", run.compile_seconds, "s"),
    )
    note = f"{settings.measured} measured frames need {frames}: their filters are counted, too"
    return Outcome(figures, asdict(settings), (note,))


def run_sequence(options: Options) -> Outcome:
    """The case; quick: small images, a few frames."""
    small = Sequence((260, 160), long=16, short=11, first=5, last=12, stride=4, repeats=1)
    return measure_sequence(small if options.quick else Sequence())


def run_large(options: Options) -> Outcome:
    """The case; quick: a sixteenth of the pixels and half the memory."""
    small = Large((400, 300), measured=1, stride=4, max_memory="1G")
    return measure_large(small if options.quick else Large())
