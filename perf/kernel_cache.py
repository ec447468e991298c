"""Caches of compiled kernels in trouble: an empty one that four processes share at once, one whose files are cut off,
one whose files are garbled. Every process must measure the same, and leave a cache that the next one can use."""

from __future__ import annotations

import hashlib
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from perf.cases import Options
from perf.cold_start import command
from perf.figures import Figure, Outcome

WORDS = ["--model", "affine-4d", "--refine", "0", "--window", "11", "--stride", "4", "--no-quicklook", "--quiet"]
SHARE_GARBLED = 0.02
"""Of the bytes of each file."""


@dataclass(frozen=True)
class Settings:
    """``processes`` that begin together."""

    processes: int = 4
    size: str = "72x48"
    seed: int = 0


def cut_off(file: Path, rng: np.random.Generator) -> None:
    """As a full disk or a power loss leaves it."""
    contents = file.read_bytes()
    file.write_bytes(contents[: int(rng.integers(0, len(contents)))])


def garble(file: Path, rng: np.random.Generator) -> None:
    """Bytes changed here and there."""
    contents = np.fromfile(file, np.uint8)
    places = rng.integers(0, contents.size, max(1, int(SHARE_GARBLED * contents.size)))
    contents[places] ^= rng.integers(1, 256, places.size, np.uint8)
    contents.tofile(file)


def maps_of(store: Path) -> str:
    """A checksum of all values of a results store."""
    digest = hashlib.sha256()
    for file in sorted(store.glob("*/c/**/*")):
        if file.is_file():
            digest.update(file.read_bytes())
    return digest.hexdigest()


def measure(settings: Settings) -> Outcome:
    """Seconds, and how many results differ."""
    rng = np.random.default_rng(settings.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        capture, cache = folder / "cube", folder / "kernels"
        command(["simulate", "cube", str(capture), "--size", settings.size, "--frames", "5"], cache)
        results: list[str] = []

        def run(label: str) -> float:
            out = folder / f"{label}.zarr"
            began = time.perf_counter()
            command(["run", str(capture), "-o", str(out), *WORDS], cache)
            results.append(maps_of(out))
            return time.perf_counter() - began

        with ThreadPoolExecutor(settings.processes) as pool:
            together = list(pool.map(run, [f"together-{i}" for i in range(settings.processes)]))
        figures = [
            Figure(f"slowest of {settings.processes} on one empty cache", max(together), "s"),
            Figure("the next one", run("next"), "s"),
        ]
        damages: dict[str, Callable[[Path, np.random.Generator], None]] = {"cut off": cut_off, "garbled": garble}
        for label, damage in damages.items():
            for file in [file for file in cache.glob("*.t*") if file.stat().st_size]:
                damage(file, rng)
            figures += [
                Figure(f"files {label}", run(f"{label}-first"), "s"),
                Figure(f"the next one after files {label}", run(f"{label}-next"), "s"),
            ]
    different = sum(result != results[0] for result in results)
    figures.append(Figure(f"of {len(results)} results, different ones", different, "", 0))
    return Outcome(tuple(figures), asdict(settings))


def run(options: Options) -> Outcome:
    """The case; quick: two processes."""
    return measure(Settings(processes=2 if options.quick else Settings.processes, seed=options.seed))
