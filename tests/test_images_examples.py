"""Every file of the TIFF example collection: the values of an independent reader, or one clear refusal."""

from __future__ import annotations

import os
import re
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

UNNAMED_SAMPLES = "house.tif"  # its ExtraSamples tag is invalid: nothing says that the second sample is alpha
PALETTES = {"bali.tif", "mri.tif", "poppies.tif", "shapes_lzw_palette.tif", "spine.tif"}
COLOUR_MAP = 320
STORED_TURNED = "poppies.tif"  # orientation 6: turned to the left
UNEQUAL = {"shapes_multi_size.tif": "page 1 is 36 x 64", "shapes_multi_color.tif": "page 3 is .* 12 bit"}


def _independent(path: Path, page: int) -> np.ndarray:
    """Grey values by libtiff; colour maps are taken as Pillow parses them."""
    values = imagecodecs.tiff_decode(path.read_bytes(), index=page)
    if path.name in PALETTES or (path.name == "shapes_multi_color.tif" and page == 1):
        with Image.open(path) as image:
            image.seek(page)
            table = np.reshape(image.tag_v2[COLOUR_MAP], (3, -1)) >> 8
        values = np.moveaxis(table[:, values], 0, -1)
    values = values.astype(np.float64)
    if values.ndim == 3 and values.shape[0] == 3:
        values = np.moveaxis(values, 0, -1)  # stored plane by plane
    grey = values[..., :3] @ LUMINANCE if values.ndim == 3 else values
    return np.rot90(grey, -1) if path.name == STORED_TURNED else grey


@pytest.mark.parametrize("name", FILES)
def test_values_of_every_file(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = EXAMPLES / name
    if path.name == UNNAMED_SAMPLES:
        with pytest.raises(InputError, match=r"house\.tif: 2 samples per pixel .* choose one with channel = 0 to 1"):
            read_gray(path)
        stored = imagecodecs.tiff_decode(path.read_bytes())
        for k in range(2):
            np.testing.assert_array_equal(read_gray(path, channel=k), stored[..., k])
        return
    info = probe(path)
    for page in sorted({0, 1 % info.pages, info.pages // 2, info.pages - 1}):
        expected = _independent(path, page)
        grey = read_gray(path, page)
        assert grey.dtype == np.float32
        np.testing.assert_allclose(grey, expected, rtol=1e-6, atol=1e-6)
        height, width = expected.shape
        box = (height // 3, height - 2, 1, width // 2)
        window = read_window(path, page, "luminance", *box)
        np.testing.assert_allclose(window, expected[box[0] : box[1], box[2] : box[3]], rtol=1e-6, atol=1e-6)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", sorted(UNEQUAL))
def test_pages_of_unequal_kind_are_reported(name: str) -> None:
    assert re.search(UNEQUAL[name], probe(EXAMPLES / name).mismatch)


@pytest.mark.parametrize("bits", [8, 10, 12, 14])
def test_the_same_picture_at_every_depth(bits: int) -> None:
    """The collection holds one picture in many encodings: they agree within two steps (written by truncation)."""
    name = {8: "lzw", 10: "lzw_planar_10bps", 12: "lzw_12bps", 14: "lzw_14bps"}[bits]
    path = EXAMPLES / f"shapes_{name}.tif"
    assert probe(path).bits == bits
    plain = read_gray(EXAMPLES / "shapes_uncompressed.tif") / 255
    np.testing.assert_allclose(read_gray(path) / (2**bits - 1), plain, atol=2 / 2**bits)
