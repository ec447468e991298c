"""Strain from three images of one camera, beside muDIC (finite elements) and pyvale (subsets, strain windows).

All get the same 8-bit images and measure displacement gradients, no finite strain, half of what changes from the first
image to the third, in the second one's lengths: per image [µε/frame]. The total is from the first image to the third,
in the first one's lengths, as is usual; ours follows from the rate, theirs are analyses of their own. Where a
displacement is known but for a constant, the mean error is taken out. All are judged in the middle of the image, where
all windows are full; the total wherever a program has it.

What noise leaves of strain depends on what it is averaged over, so settings are matched by resolution: the shortest
wavelength of a strain, along x, of which all amplitudes from there on are measured with less than 10 % of error. It
follows from the shape of a window or an element (``*_transfer``).

A program that is not installed for this interpreter is looked for in the one that LEAFFLOW_TI_PEERS names.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from leafflow_ti.api import estimate
from leafflow_ti.config_sections import SIGMA_PER_SIZE
from leafflow_ti.status import Status
from perf.cases import Options
from perf.fields import Array
from perf.figures import Figure, Outcome
from perf.inputs import absent, data_folder
from perf.speckle import GREYS, MICRO, NAME, PER_FRAME, RENDERED, STRAIN, one_camera, speckle_image

VARIABLE = "LEAFFLOW_TI_PEERS"
BIASED = 0.1
INNER = 36
"""Pixels at the border of the image that no program is judged by: half of the largest gauge and what filters take."""
COMPONENTS = {"strain_xx": (0, 0), "strain_yy": (1, 1), "strain_xy": (0, 1)}
PPM = 1e6
"""µε of a gradient of 1."""


# --- what is measured ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Triple:
    """Images [3, y, x], 8 bit, of a specimen that is stretched along x and y by ``strain`` per image, of the first
    one's lengths, about the middle of the image; ``anchored``: and moves by nothing else."""

    images: Array
    strain: tuple[float, float]
    anchored: bool

    @property
    def rate(self) -> Array:
        """Gradient [2, 2] per image, of the second one's lengths."""
        return np.diag([e / (1 + e) for e in self.strain])

    @property
    def total(self) -> Array:
        """Gradient [2, 2] from the first image to the third."""
        return 2 * np.diag(self.strain)

    def displacement(self, x: Array, y: Array) -> Array:
        """[n, 2] px per image of points in the second one."""
        height, width = self.images.shape[1:]
        return np.stack([x - (width - 1) / 2, y - (height - 1) / 2], axis=-1) @ self.rate


def plate_triple() -> Triple:
    """The rendered plate, three of its frames."""
    files = [data_folder(NAME) / f"hydro_cam0_frame{k:02d}.tiff" for k in RENDERED[:3]]
    strain = (PER_FRAME * STRAIN["strain_xx"], PER_FRAME * STRAIN["strain_yy"])
    return Triple(np.stack([np.asarray(Image.open(path)) for path in files]), strain, anchored=False)


def made_triple(noise: float, seed: int) -> Triple:
    """Speckles stretched as much as the plate, as large an image; ``noise`` is a share of 255."""
    strain = (PER_FRAME * STRAIN["strain_xx"], PER_FRAME * STRAIN["strain_yy"])
    random = np.random.default_rng(seed)
    clean = np.stack([speckle_image(0.0, 0, (400, 250), (k * strain[0], k * strain[1])) for k in range(3)])
    noisy = clean + random.normal(0.0, noise * GREYS, clean.shape)
    return Triple(np.clip(np.round(noisy), 0, GREYS).astype(np.uint8), strain, anchored=True)


@dataclass(frozen=True)
class Measured:
    """Of n points: place [n] in the second image, ``displacement`` [n, 2] px and ``rate`` [n, 2, 2] per image;
    ``total`` [m, 2, 2]; ``bars`` [n]: standard error of each component's rate [µε], where a program states it."""

    x: Array
    y: Array
    displacement: Array
    rate: Array
    total: Array
    seconds: float
    bars: dict[str, Array] = field(default_factory=dict)


# --- resolution ------------------------------------------------------------------------------------------------------


def slope_transfer(k: Array, x: Array, weights: Array) -> Array:
    """Share of a strain of wave number ``k`` [1/px] that the slope of a line through displacements at ``x`` has."""
    moment = (weights * x * x).sum()
    return np.asarray((weights * x * np.sin(k[:, None] * x)).sum(axis=1) / (k * moment))


def window_transfer(k: Array, window: int, **_: int) -> Array:
    """Of an affine motion in a Gaussian window."""
    x = np.arange(window) - window // 2
    return slope_transfer(k, x, np.exp(-0.5 * (x / (SIGMA_PER_SIZE * window)) ** 2))


def subset_transfer(k: Array, subset: int, step: int, window: int) -> Array:
    """Of a plane through the displacements of affine subsets, which are means over them."""
    x = step * (np.arange(window) - window // 2)
    return slope_transfer(k, x, np.ones(window)) * np.sin(k * subset / 2) / (subset * np.sin(k / 2))


def element_transfer(k: Array, element: int, **_: float) -> Array:
    """Of linear elements that share nodes, in their middles: the projection on them, which at first exaggerates."""
    return np.asarray(np.sinc(k * element / (2 * np.pi)) ** 3 * 3 / (2 + np.cos(k * element)))


def resolution(transfer: Callable[[Array], Array]) -> float:
    """Wavelength [px] down to which strains are measured with less than ``BIASED`` of error."""
    wavelengths = np.arange(2000.0, 8.0, -0.25)
    biased = np.abs(transfer(2 * np.pi / wavelengths) - 1) > BIASED
    return float(wavelengths[int(biased.argmax())])


# --- programs --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Method:
    """A program with settings; ``gauge`` [px]: our window whose resolution it is matched with, 0: as its own example
    has it."""

    program: str
    settings: dict[str, Any]
    gauge: int

    @property
    def label(self) -> str:
        """Program and settings."""
        return f"{self.program} ({', '.join(f'{k} {v:g}' for k, v in self.settings.items())})"

    @property
    def resolution(self) -> float:
        """See ``resolution``."""
        return resolution(lambda k: TRANSFERS[self.program](k, **self.settings))


OURS = "leafflow-ti"
TRANSFERS: dict[str, Callable[..., Array]] = {
    OURS: window_transfer, "muDIC": element_transfer, "pyvale": subset_transfer,
}  # fmt: skip
METHODS = (
    *(
        Method(OURS, {"window": window, **refined}, window)
        for window in (33, 49, 65)
        for refined in ({}, {"refine": 6, "thin": 1})
    ),
    *(
        Method("muDIC", {"element": element, "sigma": sigma}, gauge)
        for element, gauge in ((24, 33), (36, 49), (47, 65))
        for sigma in (0.0, 1.0)
    ),
    *(
        Method("pyvale", {"subset": subset, "step": step, "window": window}, gauge)
        for subset, step, window, gauge in ((17, 4, 5, 33), (23, 5, 7, 49), (31, 5, 9, 65), (31, 10, 5, 0))
    ),
)


def measure_ours(triple: Triple, method: Method, stride: int, repeats: int = 3) -> Measured:
    """Ours, at every ``stride``-th pixel; the time is the shortest of ``repeats``, kernels compiled."""
    capture = one_camera(triple.images)
    seconds = []
    for _ in range(1 + repeats):
        began = time.perf_counter()
        found = estimate(capture, model="flow-affine", taps_time="3", size_time=1, stride=stride, **method.settings)
        seconds.append(time.perf_counter() - began)
    ok = found.status == Status.OK
    y, x = (part[ok].astype(float) for part in np.meshgrid(found.y, found.x, indexing="ij"))
    shear = found["strain_xy"][ok]
    rate = 0.01 * np.array([[found["strain_xx"][ok], shear], [shear, found["strain_yy"][ok]]], float)
    rate = np.moveaxis(rate, -1, 0)
    one = np.eye(2)
    total = (one + rate) @ np.linalg.inv(one - rate) - one
    displacement = np.stack([found["flow_x"][ok], found["flow_y"][ok]], axis=-1).astype(float)
    bars = {name: MICRO * found[f"{name}_std"][ok].astype(float) for name in COMPONENTS}
    return Measured(x, y, displacement, rate, total, min(seconds[1:]), bars)


def measure_theirs(triple: Triple, method: Method) -> Measured | str:
    """muDIC or pyvale, in a process of its own; where that is not possible, why."""
    reasons = []
    for python in dict.fromkeys((sys.executable, os.environ.get(VARIABLE, sys.executable))):
        with tempfile.TemporaryDirectory() as folder:
            images, out = Path(folder, "images.npz"), Path(folder, "out.npz")
            np.savez(images, images=triple.images)
            script = Path(__file__).with_name("strain_programs.py")
            command = [python, str(script), method.program, json.dumps(method.settings), str(images), str(out)]
            # pyvale writes a log where it is started.
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
            if done.returncode == 0:
                with np.load(out) as file:
                    return Measured(**{name: file[name] for name in file.files if name != "seconds"},
                                    seconds=float(file["seconds"]))  # fmt: skip
            reasons.append((done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1])
    return f"{method.program} left out: {reasons[-1]}; {VARIABLE} may name the interpreter of another environment"


# --- figures ---------------------------------------------------------------------------------------------------------


@dataclass
class Errors:
    """Errors of one method on some triples, pooled: [µε] by component, of rate and total; displacements [px]."""

    method: Method
    rate: dict[str, list[Array]] = field(default_factory=lambda: {name: [] for name in COMPONENTS})
    total: dict[str, list[Array]] = field(default_factory=lambda: {name: [] for name in COMPONENTS})
    bars: dict[str, list[Array]] = field(default_factory=lambda: {name: [] for name in COMPONENTS})
    moved: list[Array] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def add(self, triple: Triple, found: Measured) -> None:
        """What a method measured, where it is judged."""
        height, width = triple.images.shape[1:]
        inner = (np.abs(found.x - (width - 1) / 2) <= (width - 1) / 2 - INNER) & (
            np.abs(found.y - (height - 1) / 2) <= (height - 1) / 2 - INNER
        )
        for name, (i, j) in COMPONENTS.items():
            for kept, values, true in (
                (self.rate, found.rate[inner], triple.rate), (self.total, found.total, triple.total)
            ):  # fmt: skip
                kept[name].append(PPM * ((values[:, i, j] + values[:, j, i]) / 2 - true[i, j]))
            if found.bars:
                self.bars[name].append(found.bars[name][inner])
        error = (found.displacement - triple.displacement(found.x, found.y))[inner]
        self.moved.append(error if triple.anchored else error - error.mean(axis=0))
        self.seconds.append(found.seconds)

    @property
    def rms(self) -> float:
        """Of all components of the rate [µε/frame]."""
        return rms(np.concatenate([part for parts in self.rate.values() for part in parts]))

    def figures(self, where: str) -> list[Figure]:
        """What is printed of the method."""
        label, found = f"{where}, {self.method.label}", []
        for name in COMPONENTS:
            error, total = (np.concatenate(kept[name]) for kept in (self.rate, self.total))
            note = f"mean {error.mean():+.1f}, scatter {error.std():.1f}, n = {error.size}"
            if self.bars[name]:
                bars = np.concatenate(self.bars[name])
                note += f", error bar {bars.mean():.1f}, holds {(np.abs(error) < bars).mean():.0%}"
                note += f", {(np.abs(error - error.mean()) < bars).mean():.0%} but for the mean"
            note += f"; total: rms {rms(total):.1f}, mean {total.mean():+.1f} µε"
            found.append(Figure(f"{label}: {name}, rms error", rms(error), "µε/frame", note=note))
        moved = rms(np.concatenate(self.moved))
        seconds, sharp = float(np.median(self.seconds)), self.method.resolution
        return [
            *found,
            Figure(f"{label}: displacement, rms error", 1e3 * moved, "1/1000 px/frame"),
            Figure(f"{label}: time", seconds, "s", note=f"resolution {sharp:.0f} px"),
        ]


def pooled(method: Method, triples: Sequence[Triple], stride: int) -> Errors | str:
    """Errors of a method on some triples; why it could not be run."""
    errors = Errors(method)
    for triple in triples:
        ours = method.program == OURS
        found = measure_ours(triple, method, stride) if ours else measure_theirs(triple, method)
        if isinstance(found, str):
            return found
        errors.add(triple, found)
    return errors


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def compared(where: str, errors: Sequence[Errors]) -> list[Figure]:
    """The rms error of all components: the best of ours over the best of every other program, at each gauge."""
    found = []
    for gauge in dict.fromkeys(e.method.gauge for e in errors if e.method.gauge):
        programs = dict.fromkeys(e.method.program for e in errors if e.method.gauge == gauge)
        best = {
            program: min((e for e in errors if (e.method.program, e.method.gauge) == (program, gauge)), key=_rms)
            for program in programs
        }
        ours = best.pop(OURS)
        for program, other in best.items():
            note = f"{ours.rms:.1f} / {other.rms:.1f} µε/frame: {ours.method.label}, {other.method.label}"
            name = f"{where}, gauge {gauge}: our rms error over that of {program}"
            found.append(Figure(name, ours.rms / other.rms, "x", 1.0, note=note))
    return found


def _rms(errors: Errors) -> float:
    return errors.rms


@dataclass(frozen=True)
class Settings:
    """``noises`` of the speckles that are made here, as shares of 255; ``seeds`` of it."""

    noises: tuple[float, ...] = (0.0, 0.01)
    seeds: int = 3
    stride: int = 8
    gauges: tuple[int, ...] = (33, 49, 65, 0)


def measure(settings: Settings) -> Outcome:
    """Every method on every set of images."""
    sets: dict[str, list[Triple]] = {}
    reason = absent(NAME)
    notes = [f"plate left out: {reason}"] if reason else []
    if not reason:
        sets["plate"] = [plate_triple()]
    for noise in settings.noises:
        sets[f"speckles, noise {100 * noise:g} %"] = [
            made_triple(noise, seed) for seed in range(settings.seeds if noise else 1)
        ]
    figures: list[Figure] = []
    for where, triples in sets.items():
        methods = [method for method in METHODS if method.gauge in settings.gauges]
        kept = [pooled(method, triples, settings.stride) for method in methods]
        notes += [found for found in kept if isinstance(found, str)]
        measured = [found for found in kept if isinstance(found, Errors)]
        figures += [figure for errors in measured for figure in errors.figures(where)]
        figures += compared(where, measured)
    return Outcome(tuple(figures), {"seeds": settings.seeds, "stride": settings.stride}, tuple(dict.fromkeys(notes)))


def run(options: Options) -> Outcome:
    """The case; quick: one gauge, the plate and one set of speckles."""
    return measure(Settings((0.01,), 1, 16, (65,)) if options.quick else Settings())
