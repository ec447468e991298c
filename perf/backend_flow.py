"""Flow of ``backend.optical_flow`` beside OpenCV's (DIS, Farnebäck) and scikit-image's (ilk, TV-L1): error and time.

An affine motion with a known texture, and the Yosemite sequence without its sky, with noise of 0 to 10 % of 255. The
others take two images each, as they can; ours two, and five. OpenCV gets 8-bit images, as it asks for; all others
float32. Every program as it is by default, Farnebäck with window 21 and a Gaussian. Errors are mean end-point errors
over all pixels [px], for Yosemite also mean angular errors [deg]; times are the least of some repetitions.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import numpy as np

from leafflow_ti.metrics import aae
from leafflow_ti.synthetic.affine_images import GREYS, affine_images
from perf.backend_epi import least
from perf.cases import Options
from perf.fields import Array
from perf.figures import Figure, Outcome
from perf.inputs import absent, data_folder
from perf.yosemite import FRAME_NUMBER, NAME, Truth

NOISES = (0.0, 0.01, 0.02, 0.05, 0.1)
GRADIENT = np.array([[0.010, -0.008], [0.006, -0.012]])
FLOW = (1.3, -0.8)

Program = Callable[[Array, Array], Array]
"""Two images [y, x] to flow [2, y, x], x first."""


@dataclass(frozen=True)
class Settings:
    """``size`` of the affine images; ``noises`` as parts of 255."""

    size: int = 256
    noises: tuple[float, ...] = NOISES
    repeats: int = 3
    yosemite: bool = True


@dataclass(frozen=True)
class Sequence:
    """Five images [5, y, x], the flow [2, y, x] at the middle one, and which pixels count."""

    name: str
    images: Array
    flow: Array
    counted: Array
    angular: bool = False

    def noisy(self, noise: float, seed: int = 7) -> Array:
        """With so much noise of 255, float32."""
        random = np.random.default_rng(seed)
        return (self.images + random.normal(0.0, noise * GREYS, self.images.shape)).astype(np.float32)

    def errors(self, found: Array) -> tuple[float, float]:
        """Mean end-point error [px] and mean angular error [deg]."""
        apart = np.hypot(*(found - self.flow))[self.counted]
        angle = aae(found.transpose(1, 2, 0), self.flow.transpose(1, 2, 0))[self.counted]
        return float(apart.mean()), float(angle.mean())


def affine_sequence(settings: Settings) -> Sequence:
    """The affine motion."""
    shape = (settings.size, settings.size)
    images, flow = affine_images(shape, np.arange(5.0) - 2, FLOW, GRADIENT)
    return Sequence("affine", images, flow, np.ones(shape, bool))


def yosemite_sequence() -> Sequence:
    """Yosemite around frame 9."""
    from PIL import Image

    numbers = range(FRAME_NUMBER - 2, FRAME_NUMBER + 3)
    images = [np.asarray(Image.open(data_folder(NAME) / f"yos{n}.tif"), np.float64) for n in numbers]
    truth = Truth.read()
    return Sequence("Yosemite", np.stack(images), truth.flow.transpose(2, 0, 1), ~truth.sky, angular=True)


def programs() -> tuple[dict[str, Program], tuple[str, ...]]:
    """The others that are installed, and what is missing."""
    found: dict[str, Program] = {}
    missing = []
    try:
        cv2: Any = importlib.import_module("cv2")

        def eight_bit(image: Array) -> Array:
            return np.clip(np.round(image), 0, GREYS).astype(np.uint8)

        def of_opencv(run: Callable[[Array, Array], Array]) -> Program:
            return lambda one, two: run(eight_bit(one), eight_bit(two)).transpose(2, 0, 1)

        for name in ("ULTRAFAST", "FAST", "MEDIUM"):
            preset = cv2.DISOpticalFlow_create(getattr(cv2, f"DISOPTICAL_FLOW_PRESET_{name}"))
            found[f"OpenCV DIS {name.lower()}"] = of_opencv(partial(_calc, preset))
        gaussian = cv2.OPTFLOW_FARNEBACK_GAUSSIAN
        found["OpenCV Farnebäck"] = of_opencv(
            lambda a, b: cv2.calcOpticalFlowFarneback(a, b, None, 0.5, 4, 21, 5, 7, 1.5, gaussian)
        )
    except ImportError:
        missing.append("opencv-python is not installed")
    try:
        registration: Any = importlib.import_module("skimage.registration")

        found["scikit-image ilk"] = lambda a, b: registration.optical_flow_ilk(a / GREYS, b / GREYS)[::-1]
        found["scikit-image TV-L1"] = lambda a, b: registration.optical_flow_tvl1(a / GREYS, b / GREYS)[::-1]
    except ImportError:
        missing.append("scikit-image is not installed")
    return found, tuple(missing)


def _calc(program: Any, one: Array, two: Array) -> Array:
    return np.asarray(program.calc(one, two, None))


def measure(settings: Settings) -> Outcome:
    """Errors of all programs by noise; times on the first sequence without noise."""
    from leafflow_ti.backend.flow import optical_flow

    others, notes = programs()
    sequences = [affine_sequence(settings)]
    reason = absent(NAME) if settings.yosemite else "left out"
    if reason is None:
        sequences.append(yosemite_sequence())
    else:
        notes = (*notes, f"Yosemite: {reason}")
    figures: list[Figure] = []
    for sequence in sequences:
        for noise in settings.noises:
            images = sequence.noisy(noise)
            flows = {name: run(images[2], images[3]) for name, run in others.items()}
            best: float | None = min((sequence.errors(flow)[0] for flow in flows.values()), default=None)
            flows["ours, 2 frames"] = optical_flow(images[2:4])
            flows["ours, 5 frames"] = optical_flow(images)
            for name, flow in flows.items():
                apart, angle = sequence.errors(flow)
                note = f"{angle:.2f} deg" if sequence.angular else ""
                limit = best if name == "ours, 5 frames" else None
                label = f"{sequence.name}, noise {100 * noise:g} %, {name}"
                figures.append(Figure(label, apart, "px", limit, note=note))
        clean = sequence.noisy(0.0)
        runs: dict[str, Callable[[], object]] = {n: partial(run, clean[2], clean[3]) for n, run in others.items()}
        runs["ours, 2 frames"] = partial(optical_flow, clean[2:4])
        runs["ours, 5 frames"] = partial(optical_flow, clean)
        for name, timed in runs.items():
            wall, cpu = least(timed, settings.repeats)
            note = f"CPU {1e3 * cpu:.0f} ms"
            figures.append(Figure(f"{sequence.name}, wall time, {name}", 1e3 * wall, "ms", note=note))
    return Outcome(tuple(figures), asdict(settings), notes)


def run(options: Options) -> Outcome:
    """The case; quick: small images, two noises, no Yosemite."""
    quick = Settings(96, (0.0, 0.05), repeats=1, yosemite=False)
    return measure(quick if options.quick else Settings())
