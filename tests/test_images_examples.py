"""Every file of the TIFF example collection: the values of an independent reader, or one clear refusal."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from leafflow_ti.capture.channels import LUMINANCE
from leafflow_ti.capture.images import probe, read_gray, read_window
from leafflow_ti.errors import InputError

imagecodecs = pytest.importorskip("imagecodecs", reason="libtiff (the codecs extra) is the independent reader")
Image = pytest.importorskip("PIL.Image", reason="Pillow is the independent reader of palettes")

DATA = Path(os.environ.get("LEAFFLOW_TI_DATA", Path(__file__).parents[2] / "shared" / "data"))
EXAMPLES = DATA / "tiff_examples"
FILES = sorted(path.relative_to(EXAMPLES).as_posix() for path in EXAMPLES.rglob("*.tif*"))
pytestmark = pytest.mark.skipif(not FILES, reason=f"no example files in {EXAMPLES}")

REFUSED = {"house.tif": r"2 samples per pixel that the file does not name: choose one with channel = 0 to 1"}
SHAPES_BITS = {"shapes_lzw_12bps.tif": 12, "shapes_lzw_14bps.tif": 14, "shapes_lzw_planar_10bps.tif": 10}


def _pillow(path: Path, page: int) -> np.ndarray:
    """Colours of a palette image; Pillow does not turn it by the orientation tag of this collection."""
    with Image.open(path) as image:
        image.seek(page)
        orientation = image.tag_v2.get(274, 1)
        colours = np.asarray(image.convert("RGB"))
    stored_width = image.tag_v2[256]
    if orientation == 6 and colours.shape[1] == stored_width:
        colours = np.rot90(colours, -1)
    return colours


def _independent(path: Path, page: int) -> np.ndarray:
    """Grey values by libtiff, and by Pillow where a palette has to be looked up."""
    with Image.open(path) if path.name in PALETTES else path.open("rb") as file:
        del file
    if path.name in PALETTES:
        values = _pillow(path, page)
    else:
        values = imagecodecs.tiff_decode(path.read_bytes(), index=page)
    values = values.astype(np.float64)
    if values.ndim == 3 and values.shape[0] == 3:
        values = np.moveaxis(values, 0, -1)  # planes
    return values @ LUMINANCE if values.ndim == 3 and values.shape[2] == 3 else values


PALETTES = {"bali.tif", "mri.tif", "poppies.tif", "shapes_lzw_palette.tif", "spine.tif"}
