"""Long runs in one process: memory, open files, threads and pace, from the first frame to the last.

A sequence of many frames is made of a short simulated one, played forwards and backwards: hard links to its files, so
that any length costs no room. Beside the runs, many short runs and many single estimates are made one after the other.
Each series is a process of its own.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import tifffile

from leafflow_ti.errors import RunError
from leafflow_ti.synthetic.plane import sinusoid_scene
from leafflow_ti.synthetic.write import CAPTURE_FILE, write_scene
from perf.cases import Options
from perf.figures import Figure, Outcome
from perf.fresh import status_mib

FLAT, PACE = 1.02, 1.10
"""Memory after the first tenth at most, and CPU time of the last quarter over that of the second."""
MORE_FILES = 2
"""Open files: some are seen or not, by the moment."""
SHOWN = 10
"""Samples of a series that are printed."""


@dataclass(frozen=True)
class Series:
    """``kind``: one ``run`` over all frames; or ``runs`` or ``estimates``, one a time."""

    name: str
    kind: str
    options: Mapping[str, Any]
    count: int
    compressed: bool = False


@dataclass(frozen=True)
class Settings:
    """``frames`` of the long runs, of images of ``size`` by 3 cameras; ``repeats`` of runs and estimates."""

    frames: int = 520
    repeats: int = 200
    size: tuple[int, int] = (64, 48)
    only: tuple[str, ...] = ()

    @property
    def series(self) -> tuple[Series, ...]:
        """All of them."""
        small: dict[str, Any] = {"window": 17, "stride": 4, "preshift": (-14, 0)}
        short = {**small, "model": "affine-4d", "frames": "4:6"}
        found = (
            Series("sliding", "run", {**small, "model": "affine-4d", "stride": 2}, self.frames),
            Series("sliding, compressed", "run", {**small, "model": "affine-4d", "stride": 2}, self.frames, True),
            Series("refined", "run", {**small, "refine": 2}, self.frames),
            Series("adaptive", "run", {**small, "refine": 0, "preshift": "adaptive"}, self.frames),
            Series("runs", "runs", short, self.repeats),
            Series("estimates", "estimates", {**small, "model": "affine-4d"}, self.repeats),
        )
        return tuple(one for one in found if not self.only or one.name in self.only)


@dataclass(frozen=True)
class Sample:
    """After a frame, a run or an estimate: ``seconds`` since the begin, those of the CPU, memory, open files, threads.

    The pace is that of the CPU: other work on the machine spoils that on the clock.
    """

    seconds: float
    cpu: float
    rss_mib: float
    files: int
    threads: int

    @classmethod
    def now(cls, began: float) -> Sample:
        """Of this process."""
        rss = status_mib("VmRSS")
        if rss is None:
            raise RunError("memory and open files are told by Linux alone: run the soak there")
        files = sum(1 for _ in Path("/proc/self/fd").iterdir())
        return cls(time.perf_counter() - began, time.process_time(), rss, files, threading.active_count())


def write_images(folder: Path, settings: Settings, compressed: bool) -> Path:
    """Frames there and back again, so that nothing jumps."""
    scene, short = sinusoid_scene(noise=1.0, size=settings.size, bits=8), folder / "short"
    texture: dict[str, Any] = {"texture": "noise", "wavelengths_mm": (0.1, 1.5), "supersampling": 1, "amplitude": 25.0}
    write_scene(replace(scene, n_cols=3, n_frames=9, **texture), short)
    long = folder / "long"
    there_and_back = [*range(9), *range(7, 0, -1)]
    for camera in sorted(p for p in short.iterdir() if p.is_dir()):
        (long / camera.name).mkdir(parents=True)
        images = sorted(camera.iterdir())
        if compressed:
            for image in images:
                tifffile.imwrite(image, tifffile.imread(image), compression="zlib")
        for t in range(settings.frames):
            place = long / camera.name / f"frame_{t:05d}.tif"
            os.link(images[there_and_back[t % len(there_and_back)]], place)
    described = (short / CAPTURE_FILE).read_text(encoding="utf-8").replace("{t:03d}", "{t:05d}")
    (long / CAPTURE_FILE).write_text(described, encoding="utf-8")
    return long


def samples_of(kind: str, capture: Path, out: Path, options: Mapping[str, Any], count: int) -> Iterator[Sample]:
    """The samples of one series, made in this process."""
    import leafflow_ti as lf
    from leafflow_ti.config import load_config

    began = time.perf_counter()
    if kind == "run":
        found: list[Sample] = []
        lf.run(capture, out, load_config(overrides=options), progress=lambda state: found.append(Sample.now(began)))
        yield from found
        return
    opened = lf.open_capture(capture)
    for n in range(count):
        if kind == "runs":
            lf.run(opened, out, load_config(overrides=options))
            shutil.rmtree(out)
        else:
            lf.estimate(opened, 4 + n % (opened.n_frames - 8), **options)
        yield Sample.now(began)


def soak(capture: Path, out: Path, series: Series) -> list[Sample]:
    """The samples of one series, made in a new process; raises RunError with its last line if it fails."""
    task = json.dumps([series.kind, str(capture), str(out), dict(series.options), series.count])
    done = subprocess.run([sys.executable, "-m", "perf.soak", task], capture_output=True, text=True, check=False)
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        raise RunError(f"{series.name}: ended with code {done.returncode}: {' '.join(last)}")
    return [Sample(**sample) for sample in json.loads(done.stdout.splitlines()[-1])]


def figures_of(name: str, samples: list[Sample]) -> tuple[Figure, ...]:
    """What must stay flat, of the samples after the first tenth."""
    kept = samples[len(samples) // 10 :]

    def pace(first: float, last: float) -> float:
        """CPU seconds between two samples in a part of the series, on average."""
        part = [s.cpu for s in samples[int(first * len(samples)) : int(last * len(samples))]]
        return (part[-1] - part[0]) / (len(part) - 1)

    second, last = pace(0.25, 0.5), pace(0.75, 1.0)
    # What a series needs at times is seen in each part; a leak only ever rises.
    early, late = kept[: len(kept) // 4], kept[-(len(kept) // 4) :]
    memory = [max(s.rss_mib for s in part) for part in (early, late)]
    files = [max(s.files for s in part) for part in (early, late)]
    return (
        Figure(
            f"{name}: memory at the end over the beginning", memory[1] / memory[0], "x", FLAT,
            note=f"{memory[1]:.0f} MiB",
        ),
        Figure(
            f"{name}: open files more than at the beginning", files[1] - files[0], "", MORE_FILES, note=f"{files[1]}"
        ),
        Figure(
            f"{name}: threads at the end over the beginning", samples[-1].threads / kept[0].threads, "x", 1.0,
            note=f"{samples[-1].threads}",
        ),
        Figure(
            f"{name}: CPU time of the last quarter over the second", last / second, "x", PACE, low=1 / PACE,
            note=f"{1e3 * last:.1f} ms each",
        ),
    )  # fmt: skip


def table_of(name: str, samples: list[Sample]) -> list[str]:
    """Some samples in words, at even distances."""
    step = max(1, len(samples) // SHOWN)
    rows = [f"{name}, {len(samples)} samples: s, CPU s, MiB, open files, threads"]
    return rows + [
        f"  {s.seconds:8.1f} {s.cpu:8.1f} {s.rss_mib:8.1f} {s.files:5d} {s.threads:5d}" for s in samples[::step]
    ]


def measure(settings: Settings) -> Outcome:
    """All series."""
    figures: list[Figure] = []
    notes: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        captures = {packed: write_images(folder / str(packed), settings, packed) for packed in (False, True)}
        for n, series in enumerate(settings.series):
            samples = soak(captures[series.compressed], folder / f"out-{n}.zarr", series)
            figures += figures_of(series.name, samples)
            notes += table_of(series.name, samples)
    return Outcome(tuple(figures), asdict(settings), tuple(notes))


def run(options: Options) -> Outcome:
    """The case; quick: few frames of two series."""
    return measure(Settings(60, 20, only=("sliding", "runs")) if options.quick else Settings())


def main(task: str) -> None:
    """One series in this process, its samples on standard output."""
    kind, capture, out, options, count = json.loads(task)
    print(json.dumps([asdict(s) for s in samples_of(kind, Path(capture), Path(out), options, count)]))


if __name__ == "__main__":
    main(sys.argv[1])
