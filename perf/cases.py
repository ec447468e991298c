"""The table of cases, and what each is given."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from perf.dissertation.goals import EXPERIMENTS
from perf.figures import Outcome
from perf.kills.ways import WAYS


@dataclass(frozen=True)
class Options:
    """``out``: folder for pictures. ``quick``: a smaller version of the case, for a first look and for tests.
    ``case``: the name under which it was called. ``count``, ``seed``: of random inputs; None: the case's own count."""

    out: Path
    quick: bool = False
    case: str = ""
    count: int | None = None
    seed: int = 0


@dataclass(frozen=True)
class Case:
    """One command. ``home``: ``module:function`` of this package; the function takes Options, returns an Outcome."""

    name: str
    home: str
    summary: str

    def load(self) -> Callable[[Options], Outcome]:
        """The function, its module imported now: listing the cases starts nothing."""
        module, _, function = self.home.partition(":")
        found: Callable[[Options], Outcome] = getattr(importlib.import_module(f"perf.{module}"), function)
        return found


CASES = (
    Case("dissertation", "dissertation.case:run", "all tables and figures of the dissertation below, as one page"),
    Case("dissertation-page", "dissertation.case:run", "the page once more, from the values that are there"),
    *(Case(e.name, "dissertation.case:run", e.title) for e in EXPERIMENTS),
    Case(
        "sinusoid",
        "sinusoid:run",
        "motion of a sinusoidal plane in 4D, with and without noise, error bars (section 5.3)",
    ),
    Case(
        "hci-cotton", "cotton:run", "real 9x9 light field: disparity and normals of the whole image against its truth"
    ),
    Case(
        "leaves",
        "leaves:run",
        "leaves that hide each other and move, in changing light: each beside itself alone",
    ),
    Case("tsukuba", "tsukuba:run", "real scene of 5 to 14 px of disparity per step, against its truth"),
    Case("yosemite", "yosemite:run", "affine optical flow of the Yosemite sequence against its truth"),
    Case("estimators-scale", "estimators.scale:run", "angular error against the local scale k (Figure 2.6)"),
    Case(
        "estimators-discontinuity",
        "estimators.discontinuity:run",
        "error across a motion discontinuity, by penalty and schedule (Figures 2.8, 2.11)",
    ),
    Case("estimators-filters", "estimators.filters:run", "Yosemite with every filter set and estimator (Table 2.1)"),
    Case("estimators-edges", "estimators.edges:run", "the cube within 20 px of its edges, plain and robust"),
    Case("estimators-coverage", "estimators.coverage:run", "whether error bars are true, by estimator and noise"),
    Case("speckle", "speckle:run", "one camera as a strain gauge: rendered plate, rigid series, noise floor by window"),
    Case("strain-peers", "strain_peers:run", "strain from three images, beside muDIC and pyvale on the same ones"),
    Case("hypocotyl", "hypocotyl:run", "flow of a growing seedling, one camera"),
    Case("plan-rig", "plan_rig:run", "errors predicted for a camera rig against the scatter of simulated estimates"),
    Case("rig-check", "rig_check:run", "a camera 10 µm off its place: found by check, depth without and with its line"),
    Case("kills", "kills.case:run", "runs killed at random moments and resumed: every byte as undisturbed; all ways"),
    *(Case(f"kills-{name}", "kills.case:run", f"the same, {name} alone") for name in WAYS),
    Case("power-loss", "kills.power:run", "power that fails, a disk that fills up, at every step of filling a store"),
    Case("cold-start", "cold_start:run", "seconds from command to first result, on an empty kernel cache and after it"),
    Case("stages", "stages:run", "microseconds per output pixel and stage, share of the machine's ceilings; memory"),
    Case(
        "compare", "compare:run", "beside NumPy/SciPy, numba, PyTorch, structure-tensor, scikit-image: times, agreement"
    ),
    Case("backend-epi", "backend_epi:run", "disparity of nine noisy views beside the structure-tensor package"),
    Case("backend-flow", "backend_flow:run", "flow by noise beside OpenCV and scikit-image: errors and times"),
    Case(
        "tracking", "tracking:run", "material followed over 60 frames: drift and cumulative growth, exact and measured"
    ),
    Case("sequence", "sequence:run_sequence", "30 frames from files against 12: time per frame, peak memory"),
    Case("large", "sequence:run_large", "1600x1200 pixels by 9 cameras within a memory cap"),
    Case("memory", "memory:run", "peak memory against --max-memory, over models, options and kinds of images"),
    Case("soak", "soak:run", "520 frames, 200 runs, 200 estimates in one process: memory, handles and pace stay flat"),
    Case("scene-flow-ratio", "ratio:run", "affine-scene-flow against affine-4d on the same capture"),
    Case(
        "estimator-cells",
        "estimator_cells:run",
        "weighted estimators: what it costs that a cell's samples share a weight",
    ),
    Case("refine-cube", "refinement.cube:run_cube", "exact refinement of the rotating cube, against the affine start"),
    Case("refine-light", "refinement.cube:run_light", "the same under a fixed spot, and under one on the camera"),
    Case("refine-worse", "refinement.cube:run_worse", "share of the pixels of all scenes that refinement made worse"),
    Case("refine-sinusoid", "refinement.sinusoid:run", "exact refinement of the sinusoid, and the Cramér-Rao bound"),
    Case(
        "refine-growth", "refinement.growth:run", "growth and strain of a moving, turning, tilted patch (tobacco rig)"
    ),
    Case(
        "leaf-growth",
        "leaf_growth:run",
        "a curved leaf that grows, moves, tilts, changes its light: refined, and from the motion",
    ),
    Case(
        "refine-rigid", "refinement.rigid:run", "growth of what does not grow: cubes under every light, turning planes"
    ),
    Case("refine-coverage", "refinement.coverage:run", "whether the refinement's error bars are true, by noise"),
    Case("refine-time", "refinement.timing:run", "what the refinement costs beside the affine stages, and by image"),
    Case(
        "fuzz", "fuzz.driver:run", "hostile input of every kind: values or one clear line, in bounded time and memory"
    ),
    Case("workers", "workers:run", "what a second worker brings: processes, a local Dask cluster, whole runs"),
    Case(
        "interrupt", "interrupt:run", "every command, interrupted at moments spread over its time: seconds to its end"
    ),
    Case("kernel-cache", "kernel_cache:run", "one empty cache for four processes at once; caches cut off and garbled"),
    Case("network", "network:run", "internet sockets of the commands as strace sees them"),
    Case("scaling", "scaling:run", "cost against image size, cameras, window, stride, sigma and columns, as a picture"),
)


def find(name: str) -> Case | None:
    """The case of this name."""
    return next((case for case in CASES if case.name == name), None)
