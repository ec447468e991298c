"""What an image file holds, and how one grey value is made of its samples.

Grey values keep the file's own scale: nothing is normalised, integers stay the integers of the file.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from leafflow_ti.errors import InputError

Array = npt.NDArray[Any]
Channel = str | int
"""``luminance``, ``mean``, ``red``, ``green``, ``blue``, or the index (from 0) of one stored sample."""

CHANNEL_NAMES = ("luminance", "mean", "red", "green", "blue")
LUMINANCE = (0.299, 0.587, 0.114)
"""Rec. 601 weights of red, green and blue, applied to the stored (not linearised) values."""

MAX_PIXELS = 2**31
"""Largest image (height times width) that is opened; a larger header is taken for damaged or hostile."""

Colour = Literal["gray", "rgb", "bands"]


@dataclass(frozen=True, slots=True)
class ImageInfo:
    """Header of an image file; the entries before ``pages`` are those of its first page."""

    height: int
    width: int
    dtype: np.dtype[Any]
    """Type of the stored samples (bilevel and packed samples: the unsigned integer that holds them)."""
    bits: int
    """Significant bits per sample as the file states them (12 for packed 12 bit; 16 for 12 bit padded to 16)."""
    samples: int
    """Samples per pixel, alpha included; a palette image counts as its three colours."""
    colour: Colour
    """``bands``: several samples that the file does not name; they need an explicit channel index."""
    windowed: bool
    """A window costs only its own bytes, strips or tiles; otherwise the whole page is decoded."""
    pages: int = 1
    page_shape: tuple[int, ...] = (1,)
    """Sizes of the stack's axes where the file states them (ImageJ, tifffile), else ``(pages,)``."""
    mismatch: str = ""
    """Empty if all pages agree in size, type and colour; else what differs, as a clause for an error line."""


def sample_weights(path: Path, info: ImageInfo, channel: Channel) -> tuple[tuple[int, float], ...]:
    """Stored samples, with weights, that make the grey value for ``channel``.

    Raises InputError if the image has no such channel, or unnamed samples and no channel index was given.
    """
    if isinstance(channel, int):
        if not 0 <= channel < info.samples:
            raise InputError(f"{path}: no channel {channel}, samples 0 to {info.samples - 1} exist: change channel")
        return ((channel, 1.0),)
    if info.colour == "bands":
        raise InputError(
            f"{path}: {info.samples} samples per pixel that the file does not name: "
            f"choose one with channel = 0 to {info.samples - 1}"
        )
    if info.colour == "gray":
        if channel in ("luminance", "mean"):
            return ((0, 1.0),)
        raise InputError(f"{path}: a grey image has no channel '{channel}': use channel = \"luminance\"")
    if channel == "luminance":
        return tuple(enumerate(LUMINANCE))
    if channel == "mean":
        return ((0, 1 / 3), (1, 1 / 3), (2, 1 / 3))
    return ((("red", "green", "blue").index(channel), 1.0),)


def combine(samples: Array, weights: tuple[tuple[int, float], ...]) -> Array:
    """Weighted sum over the last axis of ``samples [..., len(weights)]``; one sample alone keeps its type.

    A sum is float32 for samples of up to 16 bit and float32 itself, else float64.
    """
    if len(weights) == 1:
        return samples[..., 0]
    total = np.zeros(samples.shape[:-1], np.float64)
    for k, (_, weight) in enumerate(weights):
        total += weight * samples[..., k].astype(np.float64)
    return total.astype(np.result_type(samples.dtype, np.float32))


def check_size(path: Path, height: int, width: int) -> None:
    """Refuse an empty image and one of more than MAX_PIXELS (InputError)."""
    if height < 1 or width < 1:
        raise InputError(f"{path}: empty image, {height} x {width} pixels: write the file again")
    if height * width > MAX_PIXELS:
        raise InputError(
            f"{path}: header states {height} x {width} pixels, more than {MAX_PIXELS}: damaged file, or crop it"
        )
