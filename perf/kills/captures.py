"""Small captures whose runs have 21 units: single files and a compressed stack of pages; refined, and adaptive."""

from __future__ import annotations

import contextlib
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile

from leafflow_ti.capture.description import FILE_NAME
from leafflow_ti.cli.main import invoke

CAMERAS, FRAMES = 5, 15
SCENE = ("--size", "64x48", "--cameras", str(CAMERAS), "--frames", str(FRAMES), "--baseline-mm", "0.1",
         "--texture", "noise", "--noise", "1")  # fmt: skip
STACK = f"""path = "stack.tif"
axes = "t sx y x"
shape = {{ t = {FRAMES}, sx = {CAMERAS} }}"""
"""Instead of the pattern."""
OPTIONS = ("--window", "9", "--sigma", "3", "--stride", "2", "--set", "plan.tile=8", "--no-quicklook", "--quiet")
"""Three bands in each of seven frames."""


@dataclass(frozen=True)
class Variant:
    """``folder``: of the capture, below the one that all share; ``options``: of ``run``."""

    name: str
    folder: str
    options: tuple[str, ...] = OPTIONS


VARIANTS = (
    Variant("refined", "files"),
    Variant("adaptive", "files", (*OPTIONS, "--preshift", "adaptive")),
    Variant("stack", "stack"),
)


def make_captures(folder: Path) -> None:
    """Write ``files`` and ``stack``, which show the same."""
    files, stack = folder / "files", folder / "stack"
    with Path(os.devnull).open("w") as nowhere, contextlib.redirect_stdout(nowhere):
        invoke(["simulate", "plane", str(files), *SCENE])
    images = np.stack([tifffile.imread(path) for path in sorted(files.glob("cam_*/*.tif"))])  # [sx t, y, x]
    pages = images.reshape(-1, FRAMES, *images.shape[1:]).swapaxes(0, 1).reshape(images.shape)
    stack.mkdir()
    tifffile.imwrite(stack / "stack.tif", pages, compression="zlib", photometric="minisblack")
    text = (files / FILE_NAME).read_text(encoding="utf-8")
    text = re.sub("(?m)^pattern = .*$", STACK, text)
    (stack / FILE_NAME).write_text(text, encoding="utf-8")
