"""What a preset decides, what the model ``auto`` means, and the sizes of a refinement that are not given."""

from __future__ import annotations

from typing import NamedTuple


class Preset(NamedTuple):
    """Values where the configuration itself has none.

    ``stride``: of what is not refined, ``steps``: of the refinement of ``REFINED_MODEL``, ``thin``: the most that its
    samples are thinned (0: no limit).
    """

    precision: str
    stride: int
    steps: int = 0
    thin: int = 0


PRESETS: dict[str, Preset] = {
    "fast": Preset("f32", stride=4),
    "balanced": Preset("f32", stride=1, steps=3),
    "accurate": Preset("f64", stride=1, steps=8, thin=1),
}

REFINED_MODEL = "affine-scene-flow"
"""The model that presets refine."""
REFINED_STRIDE = 4
"""Least stride of a preset where something is refined: neighbours share nearly all of their windows."""
REFINED_WINDOW = 9
"""Least window of a refinement [px], and least number of samples across it."""
REFINED_SAMPLES = 21
"""Samples across the window of a refinement that is thinned by itself."""
MOST_THINNED_ALONE = 2
"""Most that the window of one camera is thinned by itself: its images are few, and fine speckles fall through wider
nets (of speckles of 1 to 2 px in σ every second pixel loses 5 % of the accuracy, every third 47 %)."""


def resolve_model(name: str, n_frames: int, n_rows: int, n_cols: int) -> str:
    """The model that ``auto`` means for a capture; every other name is returned as it is.

    One camera: ``flow-affine``; a grid without time: ``depth``; with time ``affine-scene-flow``.
    """
    if name != "auto":
        return name
    if n_rows * n_cols == 1:
        return "flow-affine"
    if n_frames == 1:
        return "depth"
    return "affine-scene-flow"
